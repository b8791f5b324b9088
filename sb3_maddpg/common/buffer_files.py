"""Files of replay buffers: JSON and arrays, which run no code when they are loaded."""

from __future__ import annotations

import io
import json
import math
import os
import pathlib
import zipfile
from typing import Any, cast

import numpy as np
import torch as th

from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.files.model_files import check_not_compressed
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.utils import shown

_FORMAT = 1
_STATE = "buffer.json"
_MOST_JSON = 2**24  # bytes


def write_buffer(buffer: TeamReplayBuffer, file: io.BufferedIOBase) -> None:
    """
    Write a replay buffer to a file.

    :param buffer: a team's replay buffer
    :param file: binary file to write to
    :raises ValueError: if files may not name the buffer's class, see ``allow_in_files``
    """
    arguments, counters, arrays = buffer.contents()
    state = {"format": _FORMAT, "class": type(buffer), "arguments": arguments, "counters": counters}
    with zipfile.ZipFile(cast(Any, file), "w") as archive:
        archive.writestr(_STATE, json.dumps({key: encode(value, key) for key, value in state.items()}))
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def is_buffer_file(path: Any) -> bool:
    """
    :param path: path of a file, or an open file
    :return: whether ``write_buffer`` may have written the file, rather than pickle
    """
    found = zipfile.is_zipfile(path)
    if not isinstance(path, (str, os.PathLike)):
        path.seek(0)
    return found


def read_buffer(path: str | pathlib.Path | io.BufferedIOBase, device: th.device | str) -> TeamReplayBuffer:
    """
    Read a replay buffer from a file of ``write_buffer``.

    :param path: path of the file, or the open file
    :param device: device of the samples
    :return: the buffer
    :raises ValueError: if the file holds no valid replay buffer
    """
    with zipfile.ZipFile(cast(Any, path)) as archive:
        members = {member.filename: member for member in archive.infolist()}
        if _STATE not in members or len(members) < len(archive.infolist()) or members[_STATE].file_size > _MOST_JSON:
            raise InvalidFileError(f"{path} holds no replay buffer of sb3-maddpg.")
        check_not_compressed(path, archive)
        state = json.loads(archive.read(_STATE))
        if not isinstance(state, dict) or state.get("format") != _FORMAT:
            raise InvalidFileError(f"{path} holds no replay buffer of format {_FORMAT}.")
        cls, arguments, counters = (
            decode(state.get(key), f"{path}: {key}") for key in ("class", "arguments", "counters")
        )
        if not (isinstance(cls, type) and issubclass(cls, TeamReplayBuffer)):
            raise InvalidFileError(f"{path} holds a {shown(cls)}, but the model needs a TeamReplayBuffer.")
        if not isinstance(arguments, dict) or not isinstance(counters, dict):
            raise InvalidFileError(f"{path} is damaged: its arguments or counters have no names.")
        buffer = cls(**arguments, device=device)
        arrays = {name: _read_array(archive, member) for name, member in members.items() if name != _STATE}
        buffer.restore(counters, {name.removesuffix(".npy"): array for name, array in arrays.items()})
    return buffer


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read an array after checking that its header fits the file's size."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize + file.tell() != member.file_size:
            raise InvalidFileError(
                f"{member.filename} has {member.file_size} bytes, not an array of {dtype} and shape {shape}."
            )
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
