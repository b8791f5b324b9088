"""The classes that files may name. Identifiers are fixed: they stay if a class moves into another module."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, TypeVar, overload

import numpy as np
import torch as th
from stable_baselines3.common import buffers, noise, torch_layers, utils
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.offers import broken, load_offer, offers
from sb3_maddpg.utils import shown, suggest

_Class = TypeVar("_Class", bound=type)
_allowed: dict[str, type] = {}
_names: dict[type, str] = {}


@overload
def allow_in_files(cls: _Class, *, name: str | None = None) -> _Class: ...
@overload
def allow_in_files(cls: None = None, *, name: str | None = None) -> Callable[[_Class], _Class]: ...
def allow_in_files(cls: Any = None, *, name: str | None = None) -> Any:
    """
    Allow model files to name a custom class, such as a policy, a replay buffer, a features extractor or a schedule. The
    class must be registered both when saving and when loading. Packages can name modules that register classes in an
    entry point of the group ``sb3_maddpg.allowed_in_files``. Also usable as a decorator.

    :param cls: the class; instances, such as schedules, are saved as their attributes
    :param name: how files name the class; by default its module and name, so that neither may change
    :return: the class; a decorator without ``cls``
    :raises InvalidArgumentError: if ``cls`` is not a class, cannot be imported from its module by its name, or the name
        belongs to another class
    """
    if cls is None and name is not None:
        return lambda one: allow_in_files(one, name=name)
    if not isinstance(cls, type) or "<locals>" in cls.__qualname__ or cls.__module__ == "__main__":
        raise InvalidArgumentError(
            f"{shown(cls)} cannot be named in files: pass a class that is defined at the top level of an importable "
            "module."
        )
    if not isinstance(name := _path(cls) if name is None else name, str):
        raise InvalidArgumentError(f"name={shown(name)} must be a string, by which files name {_path(cls)}.")
    other = (_of_libraries() | _allowed).get(name, cls)
    if _path(other) != _path(cls):  # a module that is reloaded defines its classes again
        raise InvalidArgumentError(f"Files name {_path(other)} by {name!r}: choose another name for {_path(cls)}.")
    _allowed[name] = cls
    _names[cls] = name
    return cls


def _path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


@cache
def _of_libraries() -> dict[str, type]:
    """:return: the classes of other packages that files may always name, which are the parts of models"""
    classes = [
        *(utils.ConstantSchedule, utils.LinearSchedule, utils.FloatSchedule, RunningMeanStd),
        *(noise.NormalActionNoise, noise.OrnsteinUhlenbeckActionNoise, noise.VectorizedActionNoise),
        *(one for one in vars(buffers).values() if isinstance(one, type) and issubclass(one, buffers.BaseBuffer)),
        *(getattr(th.nn.modules.activation, one) for one in th.nn.modules.activation.__all__),
        *(one for one in vars(th.optim).values() if isinstance(one, type) and issubclass(one, th.optim.Optimizer)),
        *(getattr(torch_layers, one) for one in ("FlattenExtractor", "NatureCNN", "CombinedExtractor")),
        RMSpropTFLike,
        *(np.float32, np.float64),  # of action noise
    ]
    return {_path(one): one for one in classes}


@cache
def _load_entry_points() -> None:
    for offer in offers("allowed_in_files"):
        found = load_offer(offer)
        if not isinstance(found, ModuleType) and not (isinstance(found, type) and found in _names):
            raise broken(offer, f"is {shown(found)}, neither a module nor a class registered with `allow_in_files`")


def name_in_files(cls: type) -> str | None:
    """
    :param cls: a class
    :return: how files name it, None if they may not, see ``allow_in_files``
    """
    _load_entry_points()
    if cls in _names:
        return _names[cls]
    path = _path(cls)
    return path if _of_libraries().get(path) is cls else None


def knows(name: str) -> bool:
    """
    :param name: name of a class in a file
    :return: whether a class has this name
    """
    _load_entry_points()
    return name in _of_libraries() or name in _allowed


def class_in_files(name: Any) -> type:
    """
    :param name: name of a class in a file
    :return: the class
    :raises InvalidFileError: if no class has this name
    """
    _load_entry_points()
    known = _of_libraries() | _allowed
    if not isinstance(name, str) or name not in known:
        raise InvalidFileError(
            f"{suggest('class', name, known) if isinstance(name, str) else f'{shown(name)} is not a class.'} Register "
            "custom classes with `sb3_maddpg.allow_in_files` before loading the file."
        )
    return known[name]
