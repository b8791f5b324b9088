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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch as th
from stable_baselines3.common.save_util import open_path

from sb3_maddpg.utils import shown

# Raised whenever an older model's networks would be read wrongly
FILE_FORMAT = 2
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
    (str, type(None)): ("tensorboard_log",),
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


def check_file(path: str | pathlib.Path | io.BufferedIOBase, algorithm: str, readable: set[str]) -> None:
    """
    Refuse a model of another algorithm or of another format, before anything in it is unpickled.

    :param path: of the file, or the file
    :param algorithm: that is to load it
    :param readable: algorithms whose files it can load
    :raises ValueError: another algorithm or format
    """
    check_path(path)
    file = open_path(path, "r", verbose=0, suffix="zip")
    if not zipfile.is_zipfile(file):
        return  # SB3 says what is wrong
    with zipfile.ZipFile(file) as archive:
        data = json.loads(archive.read("data")) if "data" in archive.namelist() else {}
    if isinstance(path, (str, os.PathLike)):
        file.close()
    else:
        file.seek(0)
    if not isinstance(data, dict):
        raise ValueError(
            f"{path} is damaged: its `data` holds a {type(data).__name__} instead of a model's attributes."
        )
    written_by = data.get("algorithm")
    if written_by is not None and written_by not in list(readable):
        raise ValueError(f"{path} holds a model of {written_by}: load it with `{written_by}.load`.")
    if written_by is None and "policy_regularization" not in data:
        raise ValueError(f"{path} holds a model of another algorithm than {algorithm}.")
    if data.get("file_format", 1) != FILE_FORMAT:
        raise ValueError(
            f"{path} has format {data.get('file_format', 1)}, this version of sb3-maddpg reads format "
            f"{FILE_FORMAT}: install the version that wrote it, or train again."
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
