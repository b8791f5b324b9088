"""What a file would need to be trusted for, found without running anything in it."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.files.model_files import pickled_values
from sb3_maddpg.files.registry import knows

_MOST = 2**24  # bytes of JSON
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
    path = Path(path)
    with path.open("rb") as file:
        first = file.read(1)
        if first == _PICKLE:
            return ["the whole file is a pickle"]
        if first == b"{":
            return _classes_of(_parsed(path, file.read(_MOST + 1), first))
        if not zipfile.is_zipfile(file):
            raise InvalidFileError(f"{path} is neither a model, a replay buffer nor statistics of VecNormalize.")
        with zipfile.ZipFile(file) as archive:
            found = []
            for member in archive.infolist():
                if member.filename == "data" or member.filename.endswith(".json"):
                    if member.file_size > _MOST:
                        raise InvalidFileError(
                            f"{path} is too large: its {member.filename} has {member.file_size} bytes."
                        )
                    data = _parsed(path, archive.read(member))
                    found += [f"{key} is pickled" for key in sorted(pickled_values(data))]
                    found += _classes_of(data)
            return found


def _parsed(path: Path, text: bytes, first: bytes = b"") -> dict[str, Any]:
    try:
        data = json.loads(first + text)
    except (ValueError, RecursionError) as error:
        raise InvalidFileError(f"{path} is damaged: its JSON cannot be read ({type(error).__name__}).") from error
    if not isinstance(data, dict):
        raise InvalidFileError(f"{path} is damaged: it holds a {type(data).__name__} instead of values by name.")
    return data


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
