"""Model files: whose they are, and whether what they hold can be used."""

from __future__ import annotations

import io
import json
import math
import os
import pathlib
import traceback
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import torch as th
from stable_baselines3.common.save_util import open_path

from sb3_maddpg.typed_json import decode
from sb3_maddpg.utils import shown

# Raised whenever older versions could not read the file
FILE_FORMAT = 3
_READABLE_FORMATS = (2, 3)  # in the first of these, values are pickled
_WEIGHTS = ("policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "pytorch_variables.pth")
_MEMBERS = {"data", *_WEIGHTS, "_stable_baselines3_version", "system_info.txt"}
_MOST_DATA = 2**24  # bytes of the member `data`
_MOST_TIMES_LARGER = 50  # than on disk: members are not compressed
_PICKLED = ":serialized:"
# What --trust on the command line sets, for the processes that it starts too
TRUST_VARIABLE = "SB3_MADDPG_TRUST"
# Attributes in files that are neither arguments, which have their checks, nor made anew
_ATTRIBUTES: dict[tuple[type, ...], tuple[str, ...]] = {
    (int,): (
        "num_timesteps",
        "_total_timesteps",
        "_num_timesteps_at_start",
        "_episode_num",
        "_n_updates",
        "n_envs",
        "curriculum_level",
        "verbose",
        "_stats_window_size",
    ),
    (int, float): ("_current_progress_remaining", "start_time"),
    (bool,): ("use_sde", "use_sde_at_warmup"),
    (int, type(None)): ("seed",),
    (str, type(None)): ("tensorboard_log", "lean"),
    (dict, type(None)): ("env_spec",),
    (deque, type(None)): ("ep_info_buffer", "ep_success_buffer"),
}


def check_path(path: Any) -> None:
    """
    :param path: of a file, or a file
    :raises ValueError: it is neither
    """
    if not (isinstance(path, (str, os.PathLike)) or hasattr(path, "read")):
        raise ValueError(f"{shown(path)} is neither a path nor a file.")


def read_data(path: str | pathlib.Path | io.BufferedIOBase, algorithm: str, readable: set[str]) -> dict[str, Any]:
    """
    The attributes in a model's file as they are written. Refuses what is no such file, or too large to be one, before
    anything in it is taken for anything.

    :param path: of the file, or the file
    :param algorithm: that is to load it
    :param readable: algorithms whose files it can load
    :return: values as JSON, see ``attributes``
    :raises ValueError: another algorithm or format, or members that no such file has
    """

    def check(data: dict[str, Any]) -> None:
        written_by = data.get("algorithm")
        if written_by is not None and written_by not in list(readable):
            raise ValueError(f"{path} holds a model of {written_by}: load it with `{written_by}.load`.")
        if written_by is None and "policy_regularization" not in data:
            raise ValueError(f"{path} holds a model of another algorithm than {algorithm}.")
        if data.get("file_format", 1) not in _READABLE_FORMATS:
            raise ValueError(
                f"{path} has format {data.get('file_format', 1)}, this version of sb3-maddpg reads format "
                f"{FILE_FORMAT}: install the version that wrote it, or train again."
            )

    return check_members(path, check)


def check_members(
    path: str | pathlib.Path | io.BufferedIOBase, check: Callable[[dict[str, Any]], None] = lambda data: None
) -> dict[str, Any]:
    """
    Refuse a file with members that no model has, or larger ones, before any is read.

    :param path: of the file, or the file
    :param check: raises where its attributes are no model's
    :return: the attributes as they are written
    :raises ValueError: no zip file, or such a member
    """
    check_path(path)
    file = open_path(path, "r", verbose=0, suffix="zip")
    try:
        if not zipfile.is_zipfile(file):
            raise ValueError(f"{path} is no zip file, and a model is one.")
        with zipfile.ZipFile(file) as archive:
            _check_sizes(path, archive)
            names = archive.namelist()
            data = json.loads(archive.read("data")) if "data" in names else {}
            if not isinstance(data, dict):
                raise ValueError(
                    f"{path} is damaged: its `data` holds a {type(data).__name__} instead of a model's attributes."
                )
            check(data)
            if strange := {name for name in names if name not in _MEMBERS or names.count(name) > 1}:
                raise ValueError(f"{path} has members that no model has, or has twice: {shown(sorted(strange))}.")
            for name in {*_WEIGHTS} & {*names}:
                with archive.open(name) as member, zipfile.ZipFile(member) as weights:
                    _check_sizes(f"{path}: {name}", weights)
    finally:
        if isinstance(path, (str, os.PathLike)):
            file.close()
        else:
            file.seek(0)
    return data


def _check_sizes(path: Any, archive: zipfile.ZipFile) -> None:
    """Refuse members that would be much larger in memory than in the archive."""
    file = cast("io.BufferedIOBase", archive.fp)
    here = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(here)
    for member in archive.infolist():
        most = _MOST_DATA if member.filename == "data" else _MOST_TIMES_LARGER * size
        if member.file_size > most or member.compress_size > size:
            raise ValueError(f"{path} is too large to be a model: its {member.filename} has {member.file_size} bytes.")


def trusted(trust: bool | None) -> bool:
    """
    :param trust: whether files may run code; None: as the environment variable ``SB3_MADDPG_TRUST`` says, 1 for yes
    :return: whether they may
    """
    return os.environ.get(TRUST_VARIABLE) == "1" if trust is None else trust


def attributes(data: dict[str, Any], path: Any, trust: bool | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """
    The values of a model's attributes.

    :param data: see ``read_data``
    :param path: of the file, for a message
    :param trust: leave pickled values to Stable-Baselines3, which runs what they hold, see ``trusted``
    :param given: what is taken instead of the file's
    :return: values by name, but for those that are pickled
    :raises ValueError: a pickled value, or one that cannot be read
    """
    pickled = _pickled(data) - set(given)
    if pickled and not trusted(trust):
        raise ValueError(
            f"{path} holds pickled values ({', '.join(sorted(pickled))}), which may run any code when they are loaded. "
            "If you trust whoever wrote it, load it with `trust=True` (on the command line `--trust`), or make a file "
            f"without any of it: `sb3-maddpg convert {path} NEW.zip --trust`."
        )
    return {
        key: given[key] if key in given else decode(value, f"{path}: {key}")
        for key, value in data.items()
        if key not in pickled
    }


def _pickled(data: dict[str, Any]) -> set[str]:
    """:return: the names of what Stable-Baselines3 would unpickle"""
    return {key for key, value in data.items() if isinstance(value, dict) and _PICKLED in value}


def refuse_pickled(path: str | pathlib.Path | io.BufferedIOBase, given: Mapping[str, Any]) -> None:
    """
    :param path: of a model of any algorithm of Stable-Baselines3, or the file
    :param given: values that are taken instead of the file's
    :raises ValueError: it holds others that would be unpickled
    """
    file = open_path(path, "r", verbose=0, suffix="zip")
    try:
        with zipfile.ZipFile(file) as archive:
            data = json.loads(archive.read("data")) if "data" in archive.namelist() else {}
    finally:
        if isinstance(path, (str, os.PathLike)):
            file.close()
        else:
            file.seek(0)
    if pickled := _pickled(data) - set(given):
        raise ValueError(
            f"{path} holds pickled values ({', '.join(sorted(pickled))}), as the files of most algorithms do. They may "
            "run any code when they are loaded: if you trust whoever wrote it, give --trust."
        )


def refuse_pickled_file(path: Any) -> None:
    """
    :param path: of a file that is nothing but a pickle
    :raises ValueError: in any case
    """
    raise ValueError(
        f"{path} is a pickle, which may run any code when it is loaded: if you trust whoever wrote it, give --trust."
    )


@contextmanager
def as_damage(path: Any, kind: str = "model") -> Iterator[None]:
    """
    Whatever the content of a file makes PyTorch, pickle and others raise, as one line about the file.

    :param path: of the file
    :param kind: what it should hold
    :raises ValueError: in place of theirs
    """
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        raised_in = pathlib.Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        if isinstance(error, ValueError) and raised_in.is_relative_to(pathlib.Path(__file__).parent):
            raise
        told = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        raise ValueError(f"{path} is damaged, or holds no {kind} of sb3-maddpg ({told}).") from error


def check_attributes(model: Any, path: Any) -> None:
    """
    Refuse counters and the like that no training has written.

    :param model: as it was loaded
    :param path: of its file
    :raises ValueError: the name and the value
    """
    for kinds, names in _ATTRIBUTES.items():
        for name in names:
            value = getattr(model, name)
            fits = isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))
            if isinstance(value, float):  # the progress falls a little below 0 where the last rollout ends late
                fits = fits and math.isfinite(value)
            elif isinstance(value, int):
                fits = fits and value >= 0
            if not fits:
                raise ValueError(f"{path} is damaged: its {name} is {shown(value)}.")


def optimizer_problem(state: Mapping[str, Any], present: th.optim.Optimizer) -> str | None:
    """
    :param state: that the optimizer is to take, see its ``state_dict``
    :param present: the optimizer
    :return: what does not fit, None if all does
    """
    if optimizer_not_finite(state):
        return "holds NaN or infinity"
    for given, group in zip(state["param_groups"], present.param_groups, strict=True):
        for index, parameter in zip(given["params"], group["params"], strict=True):
            for name, value in state["state"].get(index, {}).items():
                if not isinstance(value, th.Tensor) or (value.ndim and value.shape != parameter.shape):
                    return f"has a {name} that does not fit a parameter of shape {tuple(parameter.shape)}"
        for name, default in present.defaults.items():
            if name != "lr" and type(given.get(name, default)) is not type(default):
                return f"has {name}={shown(given[name])}"
    return None


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
