"""Model files: whose they are, and whether what they hold can be used."""

from __future__ import annotations

import io
import json
import os
import pathlib
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any

import torch as th
from stable_baselines3.common.save_util import open_path

# Raised whenever an older model's networks would be read wrongly
FILE_FORMAT = 2


def check_file(path: str | pathlib.Path | io.BufferedIOBase, algorithm: str, readable: set[str]) -> None:
    """
    Refuse a model of another algorithm or of another format, before anything in it is unpickled.

    :param path: of the file, or the file
    :param algorithm: that is to load it
    :param readable: algorithms whose files it can load
    :raises ValueError: another algorithm or format
    """
    file = open_path(path, "r", verbose=0, suffix="zip")
    if not zipfile.is_zipfile(file):
        return  # SB3 says what is wrong
    with zipfile.ZipFile(file) as archive:
        data = json.loads(archive.read("data")) if "data" in archive.namelist() else {}
    if isinstance(path, (str, os.PathLike)):
        file.close()
    else:
        file.seek(0)
    written_by = data.get("algorithm")
    if written_by not in (None, *readable):
        raise ValueError(f"{path} holds a model of {written_by}: load it with `{written_by}.load`.")
    if written_by is None and "policy_regularization" not in data:
        raise ValueError(f"{path} holds a model of another algorithm than {algorithm}.")
    if data.get("file_format", 1) != FILE_FORMAT:
        raise ValueError(
            f"{path} has format {data.get('file_format', 1)}, this version of sb3-maddpg reads format "
            f"{FILE_FORMAT}: install the version that wrote it, or train again."
        )


def optimizer_not_finite(state: Mapping[str, Any]) -> bool:
    """
    :param state: of an optimizer, see its ``state_dict``
    :return: whether any tensor in it holds NaN or infinity
    """
    return any(not tensor.isfinite().all() for tensor in _tensors(state))


def _tensors(tree: Any) -> Iterator[th.Tensor]:
    if isinstance(tree, th.Tensor):
        yield tree
    elif isinstance(tree, Mapping):
        for value in tree.values():
            yield from _tensors(value)
