"""The notebooks run from top to bottom, and are kept with their outputs, which the site shows."""

import nbformat
import pytest

from studies.notebooks import NOTEBOOKS, executed

OF_NOTEBOOK = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells_of(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.slow
@OF_NOTEBOOK
def test_runs_from_top_to_bottom_and_prints_what_is_kept(path):
    now, kept = cells_of(executed(path)), cells_of(nbformat.read(path, as_version=4))
    for cell, before in zip(now, kept, strict=True):
        assert [one.output_type for one in cell.outputs] == [one.output_type for one in before.outputs], cell.source


@OF_NOTEBOOK
def test_is_kept_with_its_outputs_and_installs_itself(path):
    cells = cells_of(nbformat.read(path, as_version=4))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), "python -m studies.notebooks"
    assert sum("text" in output for cell in cells for output in cell.outputs) >= 2
    assert not any("execution" in cell.metadata for cell in cells), "times of running change each time"
    assert '%pip install --quiet -e "../..[' in cells[0].source


def test_there_are_notebooks_and_the_site_links_them():
    home = (NOTEBOOKS[0].parents[1] / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) >= 3
    assert all(f"notebooks/{path.stem}" in home for path in NOTEBOOKS)
