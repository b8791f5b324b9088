"""Points of writing a checkpoint at which the tests and `studies.kills` kill the process or fill the disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sb3_maddpg.checkpoints import checkpoints

# In the order in which they are reached
POINTS = (
    "opened rows",
    "written rows",
    "begin",
    *(f"{done} {name}" for name in ("arrays.npz", "model.zip", "state.json") for done in ("written", "synced")),
    "opened manifest",
    "manifest",
    "folder synced",
    "renamed",
    "committed",
)


def interrupt(fault: Callable[[str], None], replace: Callable[[Any, str, Any], None] = setattr) -> None:
    """
    Have a function called at each point.

    :param fault: function of the point's name, which may raise an error or kill the process
    :param replace: what replaces a function of a module or class, e.g. pytest's ``monkeypatch.setattr``
    """
    content, write = checkpoints._Segment.content, checkpoints._Writer._write
    sync, write_synced, sync_folder = checkpoints._sync, checkpoints._write_synced, checkpoints.sync_folder

    def contents(segment: checkpoints._Segment) -> Iterator[tuple[int, list[bytes]]]:
        fault("opened rows")
        yield from content(segment)
        fault("written rows")

    def begin(writer: checkpoints._Writer, path: Path) -> None:
        fault("begin")
        write(writer, path)

    def synced(path: Path) -> None:
        fault(f"written {path.name}")
        sync(path)
        fault(f"synced {path.name}")

    def manifest(path: Path, written: bytes) -> None:
        path.write_bytes(b"")
        fault("opened manifest")
        write_synced(path, written)
        fault("manifest")

    def folder_synced(path: Path) -> None:
        unfinished = path.name.endswith(checkpoints._UNFINISHED)
        if not (unfinished or path.name == checkpoints._SEGMENTS):
            fault("renamed")
        sync_folder(path)
        if path.name != checkpoints._SEGMENTS:
            fault("folder synced" if unfinished else "committed")

    replace(checkpoints._Segment, "content", contents)
    replace(checkpoints._Writer, "_write", begin)
    replace(checkpoints, "_sync", synced)
    replace(checkpoints, "_write_synced", manifest)
    replace(checkpoints, "sync_folder", folder_synced)
