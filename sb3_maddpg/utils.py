"""Small helpers shared by the algorithm, its policy, its buffer and the zoo."""

import difflib
import errno
import glob
import inspect
import json
import math
import operator
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv

# Arguments that gymnasium.make and make_vec take and keep among those of the environment
NOT_THE_TASK = {"render_mode", "num_envs", "vectorization_mode", "vector_kwargs"}
# A temporary file that nobody has written to for so long is left over
LEFT_OVER_SECONDS = 3600


def shown(value: Any, most: int = 200) -> str:
    """
    :param value: any, as it was given
    :param most: number of characters
    :return: the value as Python writes it, for a message: in one line, and shortened where it is long
    """
    try:
        text = " ".join(repr(value).split())
    except Exception:  # of an object of somebody else's, or of an integer of too many digits for Python
        text = f"<{type(value).__name__}>"
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-(most // 3) :]}"


def suggest(kind: str, name: Any, known: Iterable[str]) -> str:
    """
    Message for a name that is not known, with the nearest one that is.

    :param kind: what is named, e.g. "estimator"
    :param name: the name that was given
    :param known: the names that exist
    """
    known, name = sorted(known), name if isinstance(name, str) else shown(name)
    nearest = difflib.get_close_matches(name, known, n=1)
    if nearest:
        return f"Unknown {kind} '{name[:100]}': did you mean '{nearest[0]}'?"
    return f"Unknown {kind} '{name[:100]}'. There are: {', '.join(known)}."


def describe_env(env: VecEnv) -> dict[str, Any] | None:
    """
    What is needed to build a training environment again.

    :param env: vectorised environment; its first one is described
    :return: ``{"id": ..., "kwargs": ...}``, or None where it was not made by ``gymnasium.make`` or its arguments
        cannot be written as JSON. What is no part of the task is left out: the render mode, the number of copies.
    """
    try:
        spec = env.get_attr("spec", indices=0)[0]
    except (AttributeError, NotImplementedError):  # e.g. a SuperSuit vector environment
        return None
    if not isinstance(spec, EnvSpec):
        return None
    kwargs = {key: value for key, value in spec.kwargs.items() if key not in NOT_THE_TASK}
    try:
        return {"id": spec.id, "kwargs": json.loads(json.dumps(kwargs))}
    except (TypeError, ValueError):
        return None


@contextmanager
def atomic_write(path: str | os.PathLike[str], suffix: str) -> Iterator[BinaryIO]:
    """
    Write a file that appears whole or not at all: what stood there before stays until the last byte is on disk.

    :param path: where to write; missing folders are made
    :param suffix: added to a path without suffix, as Stable-Baselines3 does
    :raises OSError: the path is a folder or cannot be written, said before anything is done
    """
    target = Path(path)
    if not target.suffix:
        target = Path(f"{target}.{suffix}")
    if target.is_dir() or Path(path).name in ("", ".."):
        raise IsADirectoryError(errno.EISDIR, "This is a folder: name a file in it", str(target))
    # In the same folder, because a file cannot be renamed across file systems
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_left_over(target)
        file = temporary.open("wb")
    except OSError as error:
        reason = f"Cannot write here ({error.strerror}): choose another folder"
        raise OSError(error.errno, reason, str(target)) from error
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
        sync_folder(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _remove_left_over(target: Path) -> None:
    """Remove temporary files of processes that were killed while they wrote this file."""
    prefix = f".{target.name}."
    for path in target.parent.glob(f"{glob.escape(prefix)}*"):
        process = path.name.removeprefix(prefix)
        # The process may run on another machine, but not for so long without writing
        if not process.isdecimal() or time.time() - path.stat().st_mtime <= LEFT_OVER_SECONDS:
            continue
        if not process_runs(int(process)):
            path.unlink(missing_ok=True)


def process_runs(process: int) -> bool:
    """
    :param process: id of a process of this machine
    :return: whether it runs
    """
    if os.name == "nt":  # to ask for a process there would end it
        return process == os.getpid()
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OverflowError:  # no process has such a number
        return False
    except PermissionError:
        return True
    return True


def sync_folder(folder: Path) -> None:
    """Without it the new name of a file may be gone after a loss of power."""
    if os.name == "nt":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def arguments_of(cls: type) -> set[str]:
    """
    :param cls: a class, which may hand ``**kwargs`` on to its base class
    :return: names of the arguments of its constructor
    """
    names: set[str] = set()
    for base in cls.__mro__:
        if "__init__" in vars(base):
            parameters = inspect.signature(vars(base)["__init__"]).parameters
            names |= set(parameters)
            further = {name for name, one in parameters.items() if one.kind is inspect.Parameter.VAR_KEYWORD}
            names -= further
            if not further:
                break
    return names - {"self"}


def all_finite(values: np.ndarray) -> bool:
    """
    :param values: any shape
    :return: whether all are finite numbers in the networks' single precision
    """
    if values.dtype != np.float32:
        if values.dtype.kind != "f":
            return True
        with np.errstate(over="ignore"):
            values = values.astype(np.float32)
    # One quick look at all of them. Large numbers fail it too, and pass the thorough one
    return math.isfinite(np.vdot(values, values)) or bool(np.isfinite(values).all())


def not_finite_at(values: np.ndarray) -> tuple[int, ...] | None:
    """
    :param values: any shape
    :return: index of the first of them that is not finite in the networks' single precision, None if all are
    """
    if all_finite(values):
        return None
    with np.errstate(over="ignore"):
        return tuple(np.argwhere(~np.isfinite(values.astype(np.float32)))[0].tolist())


def as_numbers(values: Any) -> np.ndarray:
    """
    :param values: array-like of real numbers
    :return: in single precision
    :raises ValueError: anything else
    """
    array = np.asarray(values)
    if array.dtype.kind not in "biufO":
        raise ValueError("no real numbers")
    try:
        with np.errstate(over="ignore"):
            return array.astype(np.float32)
    except (TypeError, OverflowError):
        raise ValueError("no real numbers") from None


def as_seed(seed: Any) -> int | None:
    """
    :param seed: None, or an integer of any type
    :return: the same as Gymnasium takes it
    :raises ValueError: anything else
    """
    if seed is None:
        return None
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise ValueError(f"seed={shown(seed)} must be an integer of at least 0, or None.")
    return number
