"""Checks of model files: which algorithm wrote them, and whether their contents are valid."""

from __future__ import annotations

import inspect
import io
import json
import math
import os
import pathlib
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.save_util import open_path
from torch.overrides import TorchFunctionMode

from sb3_maddpg.errors import InvalidFileError, TeamError, UntrustedFileError
from sb3_maddpg.files.typed_json import check_size, decode
from sb3_maddpg.offers import OfferError
from sb3_maddpg.utils import shown
from sb3_maddpg.validation import LARGEST

# Incremented when older versions cannot read new files
FILE_FORMAT = 3
_READABLE_FORMATS = (2, 3)  # values are pickled in the first of these
_WEIGHTS = ("policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "pytorch_variables.pth")
_MEMBERS = {"data", *_WEIGHTS, "_stable_baselines3_version", "system_info.txt"}
_MOST_DATA = 2**24  # bytes of the member `data`
_MOST_TIMES_LARGER = 50  # limit of a member's size relative to the file's, since members are not compressed
# Memory of the networks that a file may ask for: files with the actors only are much smaller than the model
_LEAST_LIMIT = 2**28
_MOST_TIMES_WEIGHTS = 100
_ALLOCATING = {th.empty, th.zeros, th.ones, th.full, th.eye, th.stack, th.cat, th.Tensor.repeat}
_PICKLED = ":serialized:"
# Environment variable that --trust on the command line sets, also for subprocesses
TRUST_VARIABLE = "SB3_MADDPG_TRUST"
# Attributes in files that are neither arguments, which have their own checks, nor recreated
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
    (bool,): ("use_sde", "use_sde_at_warmup", "normalized_observations"),
    (int, type(None)): ("seed",),
    (str, type(None)): ("tensorboard_log", "lean"),
    (dict, type(None)): ("env_spec",),
    (deque, type(None)): ("ep_info_buffer", "ep_success_buffer"),
}

_MOST = {"_stats_window_size": 10**9, "seed": 2**32 - 1}  # of these attributes


# Attributes of the process, which files cannot hold
_RUNTIME = ("policy", "device", "env", "_vec_normalize_env", "_logger", "_custom_logger")


def check_path(path: Any) -> None:
    """
    :param path: path of a file, or an open file
    :raises ValueError: if it is neither
    """
    if not (isinstance(path, (str, os.PathLike)) or hasattr(path, "read")):
        raise InvalidFileError(f"{shown(path)} is neither a path nor a file.")


def read_data(path: str | pathlib.Path | io.BufferedIOBase, algorithm: str, readable: set[str]) -> dict[str, Any]:
    """
    Read the attributes in a model file as JSON, after checking the file.

    :param path: path of the file, or the open file
    :param algorithm: algorithm that loads the file
    :param readable: algorithms whose files it can load
    :return: values as JSON, see ``attributes``
    :raises ValueError: if the file is of another algorithm or format, or has members that no model file has
    """

    def check(data: dict[str, Any]) -> None:
        written_by = data.get("algorithm")
        if written_by is not None and written_by not in list(readable):
            raise InvalidFileError(f"{path} holds a model of {written_by}: load it with `{written_by}.load`.")
        if written_by is None and "policy_regularization" not in data:
            raise InvalidFileError(f"{path} holds a model of another algorithm than {algorithm}.")
        if data.get("file_format", 1) not in _READABLE_FORMATS:
            raise InvalidFileError(
                f"{path} has format {data.get('file_format', 1)}, but this version of sb3-maddpg reads format "
                f"{FILE_FORMAT}: install the version that wrote it, or train again."
            )

    return check_members(path, check)


def check_members(
    path: str | pathlib.Path | io.BufferedIOBase, check: Callable[[dict[str, Any]], None] = lambda data: None
) -> dict[str, Any]:
    """
    Check the members of a model file before reading them.

    :param path: path of the file, or the open file
    :param check: function that raises an error if the attributes are not a model's
    :return: the attributes as JSON
    :raises ValueError: if the file is not a zip file, or a member is unexpected or too large
    """
    check_path(path)
    with _opened(path) as file:
        if not zipfile.is_zipfile(file):
            raise InvalidFileError(f"{path} is not a model: models are zip files.")
        with zipfile.ZipFile(file) as archive:
            _check_sizes(path, archive)
            names = archive.namelist()
            data = json.loads(archive.read("data")) if "data" in names else {}
            if not isinstance(data, dict):
                raise InvalidFileError(
                    f"{path} is damaged: its `data` holds a {type(data).__name__} instead of a model's attributes."
                )
            check(data)
            if strange := {name for name in names if name not in _MEMBERS or names.count(name) > 1}:
                raise InvalidFileError(f"{path} has unexpected or duplicate members: {shown(sorted(strange))}.")
            for name in {*_WEIGHTS} & {*names}:
                with archive.open(name) as member, zipfile.ZipFile(member) as weights:
                    _check_sizes(f"{path}: {name}", weights)
    return data


@contextmanager
def _opened(path: str | pathlib.Path | io.BufferedIOBase) -> Iterator[io.BufferedIOBase]:
    """Open a model file, whose path may lack the suffix, as in SB3; rewind a file that is open already."""
    named = not isinstance(path, (str, os.PathLike)) or pathlib.Path(path).suffix == ".zip"
    file = open_path(path, "r", verbose=0, suffix=None if named else "zip")
    try:
        yield file
    finally:
        if isinstance(path, (str, os.PathLike)):
            file.close()
        else:
            file.seek(0)


def _check_sizes(path: Any, archive: zipfile.ZipFile) -> None:
    """Refuse members that would be much larger in memory than in the archive."""
    size = _size_of(archive)
    for member in archive.infolist():
        most = _MOST_DATA if member.filename == "data" else _MOST_TIMES_LARGER * size
        if member.file_size > most or member.compress_size > size:
            raise InvalidFileError(
                f"{path} is too large to be a model: its {member.filename} has {member.file_size} bytes."
            )


def check_not_compressed(path: Any, archive: zipfile.ZipFile) -> None:
    """
    Check that an archive of arrays takes no more memory than its file has bytes.

    :param path: path of the archive, for error messages
    :param archive: the archive, whose members are stored without compression if this library wrote it
    :raises ValueError: if the members are larger than the file
    """
    total = sum(member.file_size for member in archive.infolist())
    if total > _size_of(archive):
        raise InvalidFileError(f"{path} is damaged: it has members of {total} bytes, more than the file has.")


def _size_of(archive: zipfile.ZipFile) -> int:
    file = cast("io.BufferedIOBase", archive.fp)
    here = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(here)
    return size


class NetworkLimit(TorchFunctionMode):
    """
    Refuse to build networks that need much more memory than the weights in a model's file.

    :param path: path of the file, or the open file
    :param trust: whether the author of the file is trusted, see ``trusted``; nothing is limited then
    :raises ValueError: if the networks are larger
    """

    def __init__(self, path: str | pathlib.Path | io.BufferedIOBase, trust: bool | None):
        super().__init__()
        self.path = path
        with _opened(path) as file, zipfile.ZipFile(file) as archive:
            weights = sum(member.file_size for member in archive.infolist() if member.filename == "policy.pth")
        self.limit: float = math.inf if trusted(trust) else _LEAST_LIMIT + _MOST_TIMES_WEIGHTS * weights
        self.allocated = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if func in _ALLOCATING:
            self.allocated += result.numel() * result.element_size()
            if self.allocated > self.limit:
                raise UntrustedFileError(
                    f"{self.path} is damaged or asks for too much memory: its networks need more than "
                    f"{int(self.limit) >> 20} MB, many times its weights. If you trust its author, load it with "
                    "`trust=True` (on the command line `--trust`)."
                )
        return result


def trusted(trust: bool | None) -> bool:
    """
    :param trust: whether files may run code; by default, the environment variable ``SB3_MADDPG_TRUST`` decides (1
        means yes)
    :return: whether files may run code
    """
    return os.environ.get(TRUST_VARIABLE) == "1" if trust is None else trust


def attributes(
    data: dict[str, Any], algorithm: type, path: Any, trust: bool | None, given: Mapping[str, Any]
) -> dict[str, Any]:
    """
    Decode the attributes of a model.

    :param data: see ``read_data``
    :param algorithm: class of the model
    :param path: path of the file, for error messages
    :param trust: leave pickled values to Stable-Baselines3, which may run their code, see ``trusted``
    :param given: values that replace the file's
    :return: values by name, except pickled ones
    :raises ValueError: if a value is pickled and not trusted, cannot be decoded, or would replace a method
    """
    check_size(data, path)
    pickled = pickled_values(data) - set(given)
    if pickled and not trusted(trust):
        raise UntrustedFileError(
            f"{path} holds pickled values ({', '.join(sorted(pickled))}), which may run any code when they are loaded. "
            "If you trust their author, load the file with `trust=True` (on the command line `--trust`), or convert it "
            f"to a file without pickled values: `sb3-maddpg convert {path} NEW.zip --trust`."
        )
    values = {
        key: given[key] if key in given else decode(value, f"{path}: {key}")
        for key, value in data.items()
        if key not in pickled
    }
    if wrong := sorted(key for key in set(values) - set(given) if key in _RUNTIME or _is_method(algorithm, key)):
        raise InvalidFileError(f"{path} is damaged: it has values for {', '.join(wrong)}, which models do not save.")
    return values


def keep_curves_inside(values: dict[str, Any], path: Any) -> None:
    """
    Leave out the folder for TensorBoard that a file names, if training would write outside the current folder.

    :param values: attributes of the file, changed in place
    :param path: path of the file, for the warning
    """
    folder = values.get("tensorboard_log")
    if isinstance(folder, str) and not _is_below(folder, pathlib.Path.cwd()):
        values["tensorboard_log"] = None
        warnings.warn(
            f"{path} logs to {shown(folder)}, which is outside the current folder: training will write no curves. If "
            "they should go there, pass tensorboard_log to load, or set the model's tensorboard_log.",
            stacklevel=3,
        )


def _is_below(path: str, folder: pathlib.Path) -> bool:
    return "\0" not in path and pathlib.Path(path).resolve().is_relative_to(folder.resolve())


def _is_method(cls: type, name: str) -> bool:
    defined = inspect.getattr_static(cls, name, None)
    return isinstance(defined, (property, classmethod, staticmethod)) or inspect.isroutine(defined)


def pickled_values(data: dict[str, Any]) -> set[str]:
    """
    :param data: member ``data`` of a model file, as JSON
    :return: the names of values that Stable-Baselines3 would unpickle
    """
    return {key for key, value in data.items() if isinstance(value, dict) and _PICKLED in value}


def refuse_pickled(path: str | pathlib.Path | io.BufferedIOBase, given: Mapping[str, Any]) -> None:
    """
    Refuse a model file with pickled values.

    :param path: path of a model of any Stable-Baselines3 algorithm, or the open file
    :param given: values that replace the file's
    :raises ValueError: if any other value is pickled
    """
    with _opened(path) as file, zipfile.ZipFile(file) as archive:
        data = json.loads(archive.read("data")) if "data" in archive.namelist() else {}
    if pickled := pickled_values(data) - set(given):
        raise UntrustedFileError(
            f"{path} holds pickled values ({', '.join(sorted(pickled))}), as the files of most algorithms do. They may "
            "run any code when they are loaded: if you trust their author, pass --trust."
        )


def not_ours(path: Any, what: str) -> UntrustedFileError:
    """
    :param path: path of a file that was not written by this version
    :param what: what it should hold
    :return: the error that it may be a pickle
    """
    return UntrustedFileError(
        f"{path} does not hold {what} that this version writes. If it is pickled, it may run any code when it is "
        "loaded: if you trust its author, load it with `trust=True` (on the command line `--trust`)."
    )


@contextmanager
def as_damage(path: Any, kind: str = "model") -> Iterator[None]:
    """
    Replace errors that a file's content causes in PyTorch, pickle and other libraries by one line about the file.

    :param path: path of the file
    :param kind: what the file should hold
    :raises ValueError: instead of the original error
    """
    try:
        yield
    except (OSError, OfferError, TeamError):
        raise
    except Exception as error:
        told = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        raise InvalidFileError(f"{path} is damaged or does not hold a {kind} of sb3-maddpg ({told}).") from error


def check_attributes(model: Any, path: Any) -> None:
    """
    Check counters and similar attributes of a loaded model.

    :param model: the model
    :param path: path of its file
    :raises ValueError: if a value is invalid
    """
    for kinds, names in _ATTRIBUTES.items():
        for name in names:
            value = getattr(model, name)
            fits = isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))
            if isinstance(value, float):  # the progress can drop slightly below 0 in the last rollout
                fits = fits and math.isfinite(value)
            elif isinstance(value, int):
                fits = fits and 0 <= value <= _MOST.get(name, LARGEST - 1)
            elif isinstance(value, deque):
                fits = all(map(_is_episode if name == "ep_info_buffer" else _is_real, value))
            if not fits:
                raise InvalidFileError(f"{path} is damaged: its {name} is {shown(value)}.")
    if (model.ep_info_buffer is None) != (model.ep_success_buffer is None):
        raise InvalidFileError(f"{path} is damaged: it has only one of ep_info_buffer and ep_success_buffer.")


def _is_real(value: Any) -> bool:
    return isinstance(value, (bool, int, float, np.bool_, np.number)) and math.isfinite(value)


def _is_episode(value: Any) -> bool:
    """:return: whether a value holds return and length of an episode, as SB3's ``Monitor`` tells them"""
    return isinstance(value, Mapping) and _is_real(value.get("r")) and _is_real(value.get("l"))


def optimizer_problem(state: Mapping[str, Any], present: th.optim.Optimizer) -> str | None:
    """
    :param state: state to load into the optimizer, see its ``state_dict``
    :param present: the optimizer
    :return: what does not fit, None if everything does
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
    :param state: state of an optimizer, see its ``state_dict``
    :return: whether any of its tensors holds NaN or infinity
    """
    return any(not tensor.isfinite().all() for tensor in _tensors(state))


def _tensors(tree: Any) -> Iterator[th.Tensor]:
    if isinstance(tree, th.Tensor):
        yield tree
    elif isinstance(tree, Mapping):
        for value in tree.values():
            yield from _tensors(value)
