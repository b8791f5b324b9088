"""Small helpers shared by the algorithm, its policy, its buffer and the zoo."""

from __future__ import annotations

import difflib
import errno
import functools
import glob
import hashlib
import importlib
import inspect
import json
import math
import operator
import os
import pkgutil
import re
import secrets
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from sb3_maddpg.errors import InvalidArgumentError

if TYPE_CHECKING:  # the command line's help should not wait for PyTorch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

# Arguments of gymnasium.make and make_vec that end up among the environment's own
NOT_THE_TASK = {"render_mode", "num_envs", "vectorization_mode", "vector_kwargs"}
# A temporary file that has not been written to for this long is left over
LEFT_OVER_SECONDS = 3600
_SOURCES = {".py", ".pyx", ".c", ".cpp", ".h", ".hpp"}


def shown(value: Any, most: int = 200) -> str:
    """
    Format a value for a message.

    :param value: any value
    :param most: maximum number of characters
    :return: the value's ``repr`` on one line, shortened if it is long
    """
    try:
        text = repr(value)
    except Exception:  # from a foreign class, or an integer with too many digits for Python
        text = f"<{type(value).__name__}>"
    return _shortened(text, most)


def told(error: BaseException) -> str:
    """
    :param error: any error
    :return: its class and message on one line, shortened if it is long
    """
    return _shortened(f"{type(error).__name__}: {error}".removesuffix(": "), 200)


def _shortened(text: str, most: int) -> str:
    text = " ".join(text.split())
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-(most // 3) :]}"


def suggest(kind: str, name: Any, known: Iterable[str]) -> str:
    """
    Compose a message about an unknown name that suggests the closest known one.

    :param kind: kind of the name, e.g. "estimator"
    :param name: the unknown name
    :param known: the known names
    :return: the message
    """
    known, name = sorted(known), name if isinstance(name, str) else shown(name)
    if nearest := _nearest(name, known, cutoff=0.6):
        return f"Unknown {kind} '{name[:100]}': did you mean '{nearest}'?"
    return f"Unknown {kind} '{name[:100]}'. Choose one of: {', '.join(known)}."


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.7) -> str:
    """
    :param name: an unknown name
    :param known: the known names
    :param cutoff: minimum similarity, see ``difflib``
    :return: a question about the closest known name, to append to a message; empty if there is none
    """
    nearest = _nearest(name, known, cutoff)
    return f" Did you mean '{nearest}'?" if nearest else ""


def _nearest(name: str, known: Iterable[str], cutoff: float) -> str | None:
    """:return: the closest known name, in whichever case, None if there is none"""
    names = {one.lower(): one for one in known}
    nearest = difflib.get_close_matches(name.lower(), list(names), n=1, cutoff=cutoff)
    return names[nearest[0]] if nearest else None


def modules_beside(name: str) -> set[str]:
    """
    :param name: name of a module, which may not exist
    :return: the modules of its package, or without a package, those of the current folder and all installed ones
    """
    package, dot, _ = name.rpartition(".")
    try:
        paths = list(importlib.import_module(package).__path__) if dot else [str(Path.cwd()), *sys.path]
    except (ImportError, AttributeError):  # not a package
        return set()
    return {package + dot + module.name for module in pkgutil.iter_modules(paths)}


def remove_empty_log_folder(model: BaseAlgorithm) -> None:
    """
    Remove the folder that Stable-Baselines3 creates among the temporary files for a logger without files.

    :param model: a model after training
    """
    folder = model.logger.get_dir() if hasattr(model, "_logger") else None
    if folder is not None and os.path.basename(folder).startswith("SB3-"):
        with suppress(OSError):  # it is not empty
            os.rmdir(folder)


def describe_env(env: VecEnv) -> dict[str, Any] | None:
    """
    Describe a training environment so that it can be created again.

    :param env: vectorised environment, whose first environment is described
    :return: ``{"id": ..., "kwargs": ...}`` without arguments that do not define the task, such as the render mode. None
        if the environment was not created by ``gymnasium.make`` or its arguments cannot be written as JSON.
    """
    from gymnasium.envs.registration import EnvSpec

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
    Write a file atomically: an existing file stays until the last byte of the new one is on disk. If threads, processes
    or containers write the same file at the same time, one of their files remains, whole.

    :param path: path of the file; missing folders are created
    :param suffix: suffix added to a path without one, as Stable-Baselines3 does
    :return: the file to write to
    :raises OSError: if the path is a folder, pipe or device, or cannot be written; raised before anything is written
    """
    target = Path(path)
    if not target.suffix:
        target = Path(f"{target}.{suffix}")
    if target.is_dir() or Path(path).name in ("", ".."):
        raise IsADirectoryError(errno.EISDIR, "This is a folder: pass the path of a file", str(target))
    if target.exists() and not target.is_file():  # the new file would replace the device itself
        raise OSError(errno.EINVAL, "This is a pipe or a device: pass the path of a file", str(target))
    # In the same folder, because a file cannot be renamed across file systems
    temporary = target.with_name(f"{_prefix(target.name)}{os.getpid()}-{secrets.token_hex(8)}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_left_over(target)
        file = temporary.open("xb")  # not with mkstemp, which ignores the umask
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


def _prefix(name: str) -> str:
    return f".{name[:50]}."  # file systems limit names to 255 bytes


def _remove_left_over(target: Path) -> None:
    """Remove temporary files of processes that were killed while writing this file."""
    prefix = _prefix(target.name)
    for path in target.parent.glob(f"{glob.escape(prefix)}*"):
        # Earlier versions named them by the process alone
        found = re.fullmatch(r"([0-9]+)(-[0-9a-f]{16})?", path.name.removeprefix(prefix))
        with suppress(FileNotFoundError):  # its process has just renamed it
            # The process may run on another machine, but would not pause for that long
            if found is None or time.time() - path.stat().st_mtime <= LEFT_OVER_SECONDS:
                continue
            if not process_runs(int(found[1])):
                path.unlink(missing_ok=True)


def process_runs(process: int) -> bool:
    """
    :param process: id of a process on this machine
    :return: whether the process is running
    """
    if os.name == "nt":  # os.kill would terminate the process there
        return process == os.getpid()
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OverflowError:  # too large for a process id
        return False
    except PermissionError:
        return True
    return True


_REMEDIES = {
    errno.ENOSPC: "free space",
    errno.EDQUOT: "free space",
    errno.EFBIG: "raise the limit of file sizes (`ulimit -f`)",
    errno.EIO: "check the disk",
}


def remedy_of(error: BaseException) -> str | None:
    """
    :param error: any error
    :return: what helps if a disk or the user's share of it is full, files may not grow, or a disk fails; else None
    """
    return _REMEDIES.get(error.errno or 0) if isinstance(error, OSError) else None


def is_full_disk(error: BaseException) -> bool:
    """
    :param error: any error
    :return: whether a file cannot be written now, but may be later, see ``remedy_of``
    """
    return remedy_of(error) is not None


def sync_folder(folder: Path) -> None:
    """Flush a folder to disk, so that the new name of a file survives a power loss."""
    if os.name == "nt":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@functools.lru_cache(maxsize=256)
def sources_of(module: str) -> str:
    """
    Digest the sources that an imported module belongs to.

    :param module: name of the module
    :return: digest of the sources of its top-level package, or of its own file if that is a script or a namespace; ""
        if there are none
    """
    package = sys.modules.get(module.partition(".")[0])
    folders = getattr(package, "__path__", None) if getattr(package, "__file__", None) else None
    if folders is None:
        paths = [Path(str(getattr(sys.modules.get(module), "__file__", "")))]
    else:
        paths = sorted(path for folder in folders for path in Path(folder).rglob("*.*"))
    digest = hashlib.sha256()
    found = [path for path in paths if path.suffix in _SOURCES and path.is_file()]
    for path in found:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12] if found else ""


def arguments_of(cls: type) -> set[str]:
    """
    :param cls: a class, which may pass ``**kwargs`` on to its base class
    :return: the names of all arguments of its constructor
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
    :param values: an array of any shape
    :return: whether all values are finite in single precision, which networks use
    """
    if values.dtype != np.float32:
        if values.dtype.kind != "f":
            return True
        with np.errstate(over="ignore"):
            values = values.astype(np.float32)
    # A fast check first, which large finite numbers may also fail
    return math.isfinite(np.vdot(values, values)) or bool(np.isfinite(values).all())


def not_finite_at(values: np.ndarray) -> tuple[int, ...] | None:
    """
    :param values: an array of any shape
    :return: index of the first value that is not finite in single precision, None if all are
    """
    if all_finite(values):
        return None
    with np.errstate(over="ignore"):
        return tuple(np.argwhere(~np.isfinite(values.astype(np.float32)))[0].tolist())


def integers_problem(values: np.ndarray, dtype: np.dtype) -> str | None:
    """
    Describe the first value that would change if the array were cast to integers.

    :param values: an array of at least one axis
    :param dtype: the type of integers
    :return: index and value, None if all values stay what they are
    """
    if values.dtype == dtype or values.dtype.kind not in "biuf":
        return None
    limits = np.iinfo(dtype)
    fits = (values >= limits.min) & (values <= limits.max) & (values == np.rint(values))
    if fits.all():
        return None
    index = tuple(np.argwhere(~fits)[0].tolist())
    return f"{index[0]} is {values[index]} in column {', '.join(map(str, index[1:]))}, no integer of {dtype},"


def as_numbers(values: Any) -> np.ndarray:
    """
    Convert numbers to an array.

    :param values: array-like of real numbers
    :return: the numbers in single precision
    :raises ValueError: if they are not real numbers
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biufO" or (array.dtype.kind == "O" and any(one is None for one in array.flat)):
            raise ValueError
        if np.ma.is_masked(values):  # NumPy would read what lies below the mask
            raise ValueError
        with np.errstate(over="ignore"):
            return array.astype(np.float32)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors with a gradient
        raise InvalidArgumentError("no real numbers") from None


def as_number(value: Any) -> float:
    """
    Convert a number to Python's.

    :param value: a real number of any type, also an array without axes
    :return: the number
    :raises ValueError: if it is not a real number
    """
    if isinstance(value, (int, float)) or as_numbers(value).ndim == 0:
        with suppress(TypeError, ValueError, OverflowError):
            return float(value)
    raise InvalidArgumentError("no real number")


def as_flag(value: Any) -> bool:
    """
    Convert a flag to Python's.

    :param value: True or False, or 1 or 0 of any type
    :return: the flag
    :raises ValueError: if it is something else
    """
    number = as_number(value)
    if number not in (0.0, 1.0):
        raise InvalidArgumentError("neither True nor False")
    return number == 1.0


def as_seed(seed: Any) -> int | None:
    """
    Convert a seed to the type that Gymnasium needs.

    :param seed: None, or a non-negative integer of any type
    :return: the seed
    :raises ValueError: if the seed is anything else
    """
    if seed is None:
        return None
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise InvalidArgumentError(f"seed={shown(seed)} must be an integer of at least 0, or None.")
    return number
