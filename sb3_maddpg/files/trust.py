"""What a file would need to be trusted for, found without running anything in it."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from typing import Any

from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.files.archive import Archive, opened, read_json
from sb3_maddpg.files.model_files import pickled_values
from sb3_maddpg.files.registry import knows

_PICKLE = b"\x80"  # first byte of pickles since Python 2


def untrusted(path: str | os.PathLike[str]) -> list[str]:
    """
    List what a model, a replay buffer or statistics of ``VecNormalize`` would need to be trusted for. Nothing of the
    file is run or imported. Unregistered classes need `allow_in_files` rather than trust.

    :param path: path of the file
    :return: one line for each value that is pickled and each class that is not registered; empty if the file loads
        without ``trust``
    :raises InvalidFileError: if it is none of these files
    :raises OSError: if it cannot be read
    """
    with opened(path) as file:
        first = file.read(1)
        file.seek(0)
        if first == _PICKLE:
            return ["the whole file is a pickle"]
        if first == b"{":
            return _classes_of(read_json(file, str(path)))
        if not zipfile.is_zipfile(file):
            raise InvalidFileError(f"{path} is neither a model, a replay buffer nor statistics of VecNormalize.")
        archive, found = Archive(file, path), []
        for name in archive.members:
            if name == "data" or name.endswith(".json"):
                data = archive.json(name)
                found += [f"{key} is pickled" for key in sorted(pickled_values(data))]
                found += _classes_of(data)
        return found


def _classes_of(data: Any) -> list[str]:
    return [f"{name} is not registered" for name in sorted(set(_names(data))) if not knows(name)]


def _names(value: Any) -> Iterator[str]:
    """:return: the names of classes in typed JSON"""
    stack = [value]
    while stack:
        part = stack.pop()
        if isinstance(part, dict):
            name = {"class": part.get("name"), "object": part.get("class")}.get(str(part.get("$")))
            if name is not None:
                yield str(name)
            stack.extend(part.values())
        elif isinstance(part, list):
            stack.extend(part)
