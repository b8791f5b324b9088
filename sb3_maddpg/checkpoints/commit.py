"""Checkpoints on disk, written atomically.

A checkpoint is a folder ``checkpoint-STEPS`` with the model, the state of everything around it, and the names of the
segments that hold the replay buffer. Segments are files beside the checkpoints that are written once: each checkpoint
adds a segment with the transitions since the previous one. The folder is first written under a temporary name. All
files are synced to disk, then a manifest with their checksums is written, and renaming the folder commits it.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout, UnixFileLock

from sb3_maddpg.errors import InvalidFileError, TeamError
from sb3_maddpg.files.archive import opened, read_json
from sb3_maddpg.utils import shown, sync_folder

PREFIX, UNFINISHED, _MANIFEST = "checkpoint-", ".unfinished", "manifest.json"
SEGMENTS = "segments"


def newest(folder: str | os.PathLike[str]) -> Path | None:
    """
    Find the newest complete checkpoint. Damaged checkpoints are skipped with a warning.

    :param folder: folder of the checkpoints
    :return: path of the checkpoint, None if there is none
    """
    for path in reversed(finished(Path(folder))):
        if problem := _damage(path):
            warnings.warn(f"{path} is skipped: {problem}.", stacklevel=2)
        else:
            return path
    return None


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """
    Lock a folder of checkpoints for this process. The lock ends with the process, however that ends.

    :param folder: folder of the checkpoints
    :raises ValueError: if another process holds the lock
    """
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    file, holder = path / "lock", ""
    with suppress(OSError):
        holder = file.read_text(errors="replace").strip()  # earlier versions of filelock truncate the file
    lock = FileLock(file, thread_local=False)
    try:
        held = lock.acquire(blocking=False)
    except Timeout:
        raise TeamError(f"{path} is in use by {holder or 'another process'}.") from None
    with held:
        if isinstance(lock, UnixFileLock):  # on Windows, nobody can write into a locked file
            file.write_text(f"process {os.getpid()} on {platform.node()}")
        yield


def unfinished_path(target: Path) -> Path:
    """:return: path to write something under first, which no other thread, process or container uses"""
    return target.with_name(f"{target.name}.{secrets.token_hex(8)}{UNFINISHED}")


def commit(target: Path, write: Callable[[Path], None]) -> Path:
    """Write a folder atomically."""
    unfinished = unfinished_path(target)
    unfinished.mkdir(parents=True)
    write(unfinished)
    sums = {}
    for path in sorted(unfinished.iterdir()):
        _sync(path)
        sums[path.name] = sha256(path)
    _write_synced(unfinished / _MANIFEST, json.dumps(sums).encode())
    sync_folder(unfinished)
    shutil.rmtree(target, ignore_errors=True)
    os.rename(unfinished, target)
    sync_folder(target.parent)
    return target


def finished(folder: Path) -> list[Path]:
    found = (path for path in folder.glob(f"{PREFIX}*") if re.fullmatch(r"[0-9]+", path.name.removeprefix(PREFIX)))
    return sorted(found, key=lambda path: int(path.name.removeprefix(PREFIX)))


def remove_unfinished(folder: Path) -> None:
    """Remove what an interrupted process has left in a folder of checkpoints."""
    for path in folder.glob(f"*{UNFINISHED}"):
        shutil.rmtree(path, ignore_errors=True)
    for path in (folder / SEGMENTS).glob(f"*{UNFINISHED}"):
        path.unlink(missing_ok=True)


def remove_old(folder: Path, keep: int) -> None:
    """
    Remove old checkpoints, and segments that no remaining checkpoint needs.

    :param folder: folder of the checkpoints
    :param keep: number of most recent checkpoints to keep
    """
    folders = finished(folder)
    for path in folders[:-keep]:
        shutil.rmtree(path, ignore_errors=True)
    needed: set[str] = set()
    for path in folders[-keep:]:
        with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
            needed |= {one["name"] for one in json_in(path, "state.json")["segments"]}
    for path in (folder / SEGMENTS).glob("*.rows"):
        if path.name not in needed:
            path.unlink(missing_ok=True)


def _damage(path: Path) -> str | None:
    """:return: what is wrong with a checkpoint, None if it is complete"""
    try:
        for name in ("model.zip", "arrays.npz"):
            file_in(path, name)
        for name, expected in json_in(path, _MANIFEST).items():
            if sha256(file_in(path, name)) != expected:
                return f"{name} is damaged"
        segments = json_in(path, "state.json")["segments"]
        if len({one["name"] for one in segments}) < len(segments):
            return "it names a segment twice"
        for one in segments:
            if sha256(file_in(path.parent / SEGMENTS, one["name"])) != one["sha256"]:
                return f"segment {one['name']} is damaged"
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return f"{type(error).__name__}: {error}".rstrip(".")
    return None


def file_in(folder: Path, name: str) -> Path:
    """:return: path of a file in a folder, which is not a device, and not in another folder"""
    path = folder / name
    if path.name != name or not path.is_file():
        raise InvalidFileError(f"there is no file {shown(name)} in {folder}")
    return path


def json_in(folder: Path, name: str) -> dict[str, Any]:
    """:return: the values in a file of JSON in a folder, see ``file_in``"""
    with opened(path := file_in(folder, name), "checkpoint") as file:
        return read_json(file, str(path))


def sha256(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(2**20):
            found.update(block)
    return found.hexdigest()


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
