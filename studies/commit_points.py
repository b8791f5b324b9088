"""Points of writing a checkpoint at which the tests and `studies.kills` kill the process or fill the disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sb3_maddpg.checkpoints import commit
from sb3_maddpg.checkpoints.writer import Segment, Writer

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
    content, write = Segment.content, Writer._write
    sync, write_synced, sync_folder = commit._sync, commit._write_synced, commit.sync_folder

    def contents(segment: Segment) -> Iterator[tuple[int, list[bytes]]]:
        fault("opened rows")
        yield from content(segment)
        fault("written rows")

    def begin(writer: Writer, path: Path) -> None:
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
        unfinished = path.name.endswith(commit.UNFINISHED)
        if not unfinished:
            fault("renamed")
        sync_folder(path)
        fault("folder synced" if unfinished else "committed")

    replace(Segment, "content", contents)
    replace(Writer, "_write", begin)
    replace(commit, "_sync", synced)
    replace(commit, "_write_synced", manifest)
    replace(commit, "sync_folder", folder_synced)
