"""Checks of model files: which algorithm wrote them, and whether their contents are valid."""

from __future__ import annotations

import inspect
import math
import os
import pathlib
import warnings
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from torch.overrides import TorchFunctionMode

from sb3_maddpg.errors import InvalidFileError, UntrustedFileError
from sb3_maddpg.files.archive import LEAST_NETWORKS, MOST_TIMES_WEIGHTS, Archive, opened
from sb3_maddpg.files.typed_json import check_size, decode
from sb3_maddpg.utils import shown
from sb3_maddpg.validation import LARGEST

# Incremented when older versions cannot read new files
FILE_FORMAT = 3
_READABLE_FORMATS = (2, 3)  # values are pickled in the first of these
_WEIGHTS = {"policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "pytorch_variables.pth"}
_MEMBERS = {"data", "_stable_baselines3_version", "system_info.txt"} | _WEIGHTS
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
    (dict,): ("agent_windows",),
    (deque, type(None)): ("ep_info_buffer", "ep_success_buffer"),
}

_MOST = {"_stats_window_size": 10**9, "seed": 2**32 - 1}  # of these attributes

# Attributes of the process, which files cannot hold
_RUNTIME = ("policy", "device", "env", "_vec_normalize_env", "_logger", "_custom_logger")


def read_data(archive: Archive, algorithm: str, readable: set[str]) -> dict[str, Any]:
    """
    Read the attributes in a model file as JSON, after checking the file.

    :param archive: the file
    :param algorithm: algorithm that loads the file
    :param readable: algorithms whose files it can load
    :return: values as JSON, see ``attributes``
    :raises InvalidFileError: if the file is of another algorithm or format, or see ``check_members``
    """
    data, path = archive.json("data"), archive.name
    written_by = data.get("algorithm")
    if written_by is not None and written_by not in list(readable):
        raise InvalidFileError(f"{path} holds a model of {written_by}: load it with `{written_by}.load`.")
    if written_by is None and "policy_regularization" not in data:
        what = "a model of another algorithm than" if "policy_class" in data else "no model of"
        raise InvalidFileError(f"{path} holds {what} {algorithm}.{archive.content() if not data else ''}")
    if data.get("file_format", 1) not in _READABLE_FORMATS:
        raise InvalidFileError(
            f"{path} has format {data.get('file_format', 1)}, but this version of sb3-maddpg reads format "
            f"{FILE_FORMAT}: install the version that wrote it, or train again."
        )
    check_members(archive)
    return data


def check_members(archive: Archive) -> None:
    """
    Check the members of a model file, and those of its weights, which are zip files themselves.

    :param archive: the file
    :raises InvalidFileError: if a member is unexpected, or the weights would be too large, see ``Archive``
    """
    if strange := {*archive.members} - _MEMBERS:
        raise InvalidFileError(f"{archive.name} has unexpected members: {shown(sorted(strange))}.")
    for name in _WEIGHTS & {*archive.members}:
        with archive.open(name) as member:
            Archive(member, f"{archive.name}: {name}")


class NetworkLimit(TorchFunctionMode):
    """
    Refuse to build networks that need much more memory than the weights in a model's file.

    :param archive: the file
    :param trust: whether the author of the file is trusted, see ``trusted``; nothing is limited then
    :raises UntrustedFileError: if the networks are larger
    """

    def __init__(self, archive: Archive, trust: bool | None):
        super().__init__()
        self.path = archive.name
        weights = archive.members["policy.pth"].file_size if "policy.pth" in archive.members else 0
        self.limit: float = math.inf if trusted(trust) else LEAST_NETWORKS + MOST_TIMES_WEIGHTS * weights
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
    here = pathlib.Path.cwd().resolve()
    if isinstance(folder, str) and ("\0" in folder or not pathlib.Path(folder).resolve().is_relative_to(here)):
        values["tensorboard_log"] = None
        warnings.warn(
            f"{path} logs to {shown(folder)}, which is outside the current folder: training will write no curves. If "
            "they should go there, pass tensorboard_log to load, or set the model's tensorboard_log.",
            stacklevel=3,
        )


def _is_method(cls: type, name: str) -> bool:
    defined = inspect.getattr_static(cls, name, None)
    return isinstance(defined, (property, classmethod, staticmethod)) or inspect.isroutine(defined)


def pickled_values(data: dict[str, Any]) -> set[str]:
    """
    :param data: member ``data`` of a model file, as JSON
    :return: the names of values that Stable-Baselines3 would unpickle
    """
    return {key for key, value in data.items() if isinstance(value, dict) and _PICKLED in value}


def refuse_pickled(path: Any, given: Mapping[str, Any]) -> None:
    """
    Refuse a model file with pickled values.

    :param path: path of a model of any Stable-Baselines3 algorithm, or the open file
    :param given: values that replace the file's
    :raises UntrustedFileError: if any other value is pickled
    :raises InvalidFileError: if the file is damaged
    """
    with opened(path, suffix="zip") as file:
        data = Archive(file, path).json("data")
    if pickled := pickled_values(data) - set(given):
        raise UntrustedFileError(
            f"{path} holds pickled values ({', '.join(sorted(pickled))}), as the files of most algorithms do. They may "
            "run any code when they are loaded: if you trust their author, pass --trust."
        )


def not_ours(path: Any, what: str) -> UntrustedFileError:
    """
    :param path: path of a file that was not written by this version
    :param what: e.g. "is not a replay buffer"
    :return: the error that it may be a pickle
    """
    return UntrustedFileError(
        f"{path} {what} that this version writes. If it is pickled, it may run any code when it is "
        "loaded: if you trust its author, load it with `trust=True` (on the command line `--trust`)."
    )


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
            elif fits and name == "agent_windows":
                fits = all(isinstance(key, str) and _is_window(window) for key, window in value.items())
            if not fits:
                raise InvalidFileError(f"{path} is damaged: its {name} is {shown(value)}.")
    if (model.ep_info_buffer is None) != (model.ep_success_buffer is None):
        raise InvalidFileError(f"{path} is damaged: it has only one of ep_info_buffer and ep_success_buffer.")


def _is_real(value: Any) -> bool:
    return isinstance(value, (bool, int, float, np.bool_, np.number)) and math.isfinite(value)


def _is_window(value: Any) -> bool:
    """:return: whether a value holds the last values of a metric, of which there is at least one"""
    return isinstance(value, deque) and len(value) > 0 and all(map(_is_real, value))


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
    leaves = th.utils._pytree.tree_leaves(state)
    return any(isinstance(one, th.Tensor) and not one.isfinite().all() for one in leaves)
