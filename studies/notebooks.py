"""Run the notebooks of the docs from top to bottom, each in a kernel of its own, and keep their outputs.

``python -m studies.notebooks`` writes them into the notebooks, where the site shows them.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))


class HereKernelManager(AsyncKernelManager):
    """Starts kernels with this Python, whatever kernels the machine knows by name."""

    @property
    def kernel_spec(self) -> KernelSpec:
        return KernelSpec(argv=[sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"])


def executed(path: Path) -> Any:
    """Return a notebook with the outputs of all its cells, which run in an empty folder.

    :raises CellExecutionError: if a cell fails
    """
    notebook = nbformat.read(path, as_version=4)
    options: dict[str, Any] = {"timeout": 500, "kernel_manager_class": HereKernelManager, "record_timing": False}
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, **options).execute(cwd=folder)
    for cell in notebook.cells:  # progress and warnings of whatever version is installed
        if cell.cell_type == "code":
            cell.outputs = [one for one in cell.outputs if one.get("name") != "stderr"]
    return notebook


if __name__ == "__main__":
    for path in NOTEBOOKS:
        nbformat.write(executed(path), path)
