"""Files of JSON, arrays and weights: opened once, checked before they are read, and written."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from stable_baselines3.common.save_util import open_path

from sb3_maddpg.errors import InvalidFileError, TeamError
from sb3_maddpg.offers import OfferError
from sb3_maddpg.utils import did_you_mean, shown, told

# What files may hold at most. Their authors are unknown, so nothing is read or built that needs much more memory than a
# file of this library does.
MOST_JSON = 2**24  # bytes of JSON beside arrays or weights; the shipped models have up to 32,000
MOST_JSON_FILE = 2**28  # bytes of a file of JSON, which holds the statistics of images or thousands of evaluations
MOST_TIMES_LARGER = 50  # all members relative to their file: this library does not compress, who packs it again may
DEEPEST = 50  # levels of JSON, since reading is recursive
LARGEST_ARRAY = 10**7  # values in an array in JSON, e.g. the bounds of a space of images
MOST_REPEATED = 2 * LARGEST_ARRAY  # values in all arrays of which only one value is written: low and high
MOST_AGENTS = 4096  # agents of a team, or parts of a space: each becomes an object
LEAST_NETWORKS = 2**28  # bytes of networks that any file may ask for: most have fewer
MOST_TIMES_WEIGHTS = 100  # networks relative to the weights: files with the actors only are much smaller than the model


def check_path(path: Any) -> None:
    """
    :param path: path of a file, or an open file
    :raises InvalidFileError: if it is neither
    """
    if not (isinstance(path, (str, os.PathLike)) or hasattr(path, "read")):
        raise InvalidFileError(f"{shown(path)} is neither a path nor a file.")


@contextmanager
def as_damage(path: Any, kind: str = "model") -> Iterator[None]:
    """
    Replace errors that a file's content causes in PyTorch, pickle and other libraries by one line about the file.

    :param path: path of the file
    :param kind: what the file should hold
    :raises InvalidFileError: instead of the original error
    """
    try:
        yield
    except (OSError, OfferError, TeamError):
        raise
    except Exception as error:
        cause = error.__cause__ or error  # SB3 says of damaged weights that the file is no zip file
        line = f"{type(cause).__name__}: {cause}".splitlines()[0][:200]
        raise InvalidFileError(f"{path} is damaged or does not hold a {kind} of sb3-maddpg ({line}).") from error


@contextmanager
def opened(path: Any, kind: str = "model", suffix: str | None = None) -> Iterator[io.BufferedIOBase]:
    """
    Open a file to read it, and tell in one line what its content causes.

    :param path: path of the file; or an open file, which is rewound before and after, and stays open
    :param kind: what the file should hold
    :param suffix: suffix that the path may lack, as in SB3
    :return: the open file
    :raises InvalidFileError: if it is neither, or a folder, or the content raises an error of another library, see
        ``as_damage``
    :raises FileNotFoundError: if there is no such file; the message names a similar one in its folder
    :raises OSError: if it cannot be read
    """
    check_path(path)
    with as_damage(path, kind), ExitStack() as at_end:
        if isinstance(path, (str, os.PathLike)):
            lacks = suffix if Path(path).suffix != f".{suffix}" else None
            try:
                file = open_path(Path(path), "r", suffix=lacks)
            except FileNotFoundError as error:
                beside = [one.name for one in Path(path).parent.glob(f"*.{suffix or '*'}")]
                hint = did_you_mean(Path(path).name, beside, 0.6)
                where = "" if Path(path).is_absolute() else f" (in the folder {os.getcwd()})"
                text = f"There is no such {kind} file{where}{hint and '.' + hint}"
                raise FileNotFoundError(error.errno, text, error.filename) from None
            except IsADirectoryError:
                raise InvalidFileError(f"{path} is a folder: name a {kind} file in it.") from None
            yield at_end.enter_context(file)
        else:
            path.seek(0)
            at_end.callback(path.seek, 0)
            yield path


def read_json(file: Any, name: str, most: int = MOST_JSON_FILE) -> dict[str, Any]:
    """
    :param file: an open file
    :param name: what it is, for error messages
    :param most: maximum number of bytes
    :return: the values in its JSON, by name
    :raises InvalidFileError: if it is longer, or holds no JSON of values by name
    """
    text = file.read(most + 1)
    if len(text) > most:
        raise InvalidFileError(f"{name} is too large: it has more than {most} bytes of JSON.")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidFileError(f"{name} is damaged: its JSON cannot be read ({told(error)}).") from error
    if not isinstance(data, dict):
        raise InvalidFileError(f"{name} is damaged: it holds a {type(data).__name__} instead of values by name.")
    return data


class Archive:
    """
    A zip file of JSON, arrays and weights. Its members have at most `MOST_TIMES_LARGER` times as many bytes as the
    file, and if arrays are read, no more than the file.

    :param file: the open file, or an open member
    :param name: what it is, for error messages
    :raises InvalidFileError: if it is no zip file, has two members of one name, or members that would be too large
    """

    def __init__(self, file: Any, name: Any):
        self.name = name
        self._size = file.seek(0, os.SEEK_END)
        try:
            self._zip = zipfile.ZipFile(file)
        except zipfile.BadZipFile as error:
            raise InvalidFileError(f"{name} is damaged or holds something else: it is no zip file.") from error
        self.members = {member.filename: member for member in self._zip.infolist()}
        if len(self.members) < len(self._zip.infolist()):
            raise InvalidFileError(f"{name} is damaged: it has duplicate members.")
        # The others can expand by any factor at once, whatever size the file tells
        if not {one.compress_type for one in self.members.values()} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise InvalidFileError(f"{name} is compressed by a method that this library does not read.")
        self._check_size(MOST_TIMES_LARGER)

    def _check_size(self, times: int) -> None:
        packed, total = (sum(getattr(one, n) for one in self.members.values()) for n in ("compress_size", "file_size"))
        if packed > self._size or total > times * self._size:
            raise InvalidFileError(
                f"{self.name} is damaged: it has members of {max(packed, total)} bytes, more than the file has."
            )

    def open(self, name: str) -> IO[bytes]:
        """:return: a member as an open file"""
        return self._zip.open(self.members[name])

    def json(self, name: str) -> dict[str, Any]:
        """
        :param name: a member
        :return: the values in its JSON, by name; empty if there is no such member
        :raises InvalidFileError: see ``read_json``
        """
        if name not in self.members:
            return {}
        with self.open(name) as file:
            return read_json(file, f"{self.name}: {name}", MOST_JSON)

    def content(self) -> str:
        """:return: what the file seems to hold, as the end of a message; empty if nobody knows"""
        names = {name.rpartition("/")[2] for name in self.members}
        if {"data", "policy.pth"} <= names:
            return " It is a model's file."
        if "buffer.json" in names:
            return " It is a replay buffer's file: read it with `load_replay_buffer`."
        if "constants.pkl" in names:
            return " It may be an exported agent: run it with `torch.jit.load`."
        return ""

    def array(self, name: str) -> np.ndarray:
        """
        :param name: a member, as ``np.save`` writes it
        :return: the array
        :raises InvalidFileError: if its header does not fit its size, or it holds pickles
        """
        with self.open(name) as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
            size = self.members[name].file_size
            if dtype.hasobject or math.prod(shape) * dtype.itemsize + file.tell() != size:
                raise InvalidFileError(
                    f"{self.name}: {name} has {size} bytes, not an array of {dtype} and shape {shape}."
                )
        with self.open(name) as file:  # anew, since Python checks no sum after a member was rewound
            return np.lib.format.read_array(file, allow_pickle=False)

    def arrays(self) -> dict[str, np.ndarray]:
        """
        :return: all arrays by the names of their members, without suffix
        :raises InvalidFileError: if members are larger than the file, or one is neither JSON nor an array
        """
        self._check_size(1)
        return {name.removesuffix(".npy"): self.array(name) for name in self.members if not name.endswith(".json")}


def write_archive(file: Any, values: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """
    Write a file for ``Archive``.

    :param file: binary file to write to
    :param values: values to write as JSON, by the names of the members
    :param arrays: arrays by the names of their members without suffix
    """
    with zipfile.ZipFile(file, "w") as archive:
        for name, one in values.items():
            archive.writestr(name, json.dumps(one))
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
