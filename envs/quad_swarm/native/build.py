"""Compilation of C++, cached per source and machine in the user's cache."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

_SUFFIX = ".dll" if sys.platform == "win32" else ".so"
# The source contains explicit fused multiply-adds, and NaN must stay NaN: no flag may allow the compiler to reorder
# floating-point operations.
_FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-fvisibility=hidden")
_SHARED = ("-shared",) if sys.platform == "win32" else ("-shared", "-fPIC")
_TIMEOUT = 300  # seconds, after which the compiler is assumed to hang


class BuildError(RuntimeError):
    """Raised if code cannot be compiled or loaded; the message names the cause and the remedy."""


def cache_directory() -> Path:
    """Return the directory of compiled libraries: ``QUAD_SWARM_CACHE``, or one in the user's cache directory."""
    if chosen := os.environ.get("QUAD_SWARM_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "quad_swarm"


def compiler() -> list[str]:
    """Return the command of the C++ compiler: ``CXX``, or the first compiler found.

    :raises BuildError: if there is none
    """
    if chosen := os.environ.get("CXX"):
        try:
            command = shlex.split(chosen)
        except ValueError:  # an unclosed quote
            command = []
        if not command or shutil.which(command[0]) is None:
            raise BuildError(f"no C++ compiler: CXX={chosen!r} is not a command; unset CXX or set it to one")
        return command
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    raise BuildError("no C++ compiler: install g++ or clang++, or set CXX")


def build(name: str, main: str, sources: Mapping[str, str], defines: Sequence[str] = ()) -> Path:
    """Compile sources to a shared library, unless it is in the cache.

    Each library has a checksum, and damaged libraries are compiled again. Without a working compiler, a cached library
    that another compiler built from the same sources on the same kind of machine is used.

    :param name: prefix of the library's file name
    :param main: file to compile, which includes the others
    :param sources: text of each file by its name
    :param defines: macros, ``NAME=VALUE``
    :return: path of the library
    :raises BuildError: if there is no compiler, it fails, or the cache cannot be written
    """
    options = [*_FLAGS, _native_flag(), *(f"-D{define}" for define in defines)]
    directory = cache_directory()
    name = f"{name}-{_digest(*options, _machine(), *sources.values())}"
    try:
        command = [*compiler(), *options]
        library = directory / f"{name}-{_digest(*command, _target(tuple(command)))}{_SUFFIX}"
    except BuildError:
        for library in sorted(directory.glob(f"{name}-*{_SUFFIX}")):
            if _is_whole(library):
                return library
        raise
    if _is_whole(library):
        return library
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        _remove_leftovers(directory)
        # In the cache's file system, so that the finished library can be moved there atomically
        with tempfile.TemporaryDirectory(dir=directory, prefix="building-", ignore_cleanup_errors=True) as folder:
            for file, text in sources.items():
                Path(folder, file).write_text(text, encoding="utf-8")
            result = Path(folder, library.name)
            _run([*command, *_SHARED, str(Path(folder, main)), "-o", str(result)])
            checksum = Path(folder, _checksum_file(library).name)
            checksum.write_text(hashlib.sha256(result.read_bytes()).hexdigest(), encoding="utf-8")
            # On Windows, a library in use cannot be replaced, but then another process has built the same one
            with contextlib.suppress(PermissionError):
                os.replace(result, library)
                os.replace(checksum, _checksum_file(library))
    except OSError as error:
        raise BuildError(
            f"cannot write to the cache {directory} ({error.strerror or error}), or its files belong to another user; "
            "set QUAD_SWARM_CACHE to a writable directory"
        ) from error
    return library


@functools.lru_cache(maxsize=64)
def load(path: str, *functions: str) -> ctypes.CDLL:
    """Load a compiled library.

    :param path: path of the library
    :param functions: functions that it must contain
    :raises BuildError: if the library cannot be loaded
    """
    try:
        library = ctypes.CDLL(path)
        for name in functions:
            getattr(library, name).restype = None
    except (OSError, AttributeError) as error:
        raise BuildError(
            f"cannot load {path} ({error}); delete the file to compile it again, or set QUAD_SWARM_CACHE to a "
            "directory from which libraries may be loaded"
        ) from error
    return library


def _native_flag() -> str:
    return "-mcpu=native" if platform.machine().lower() in ("arm64", "aarch64") else "-march=native"


def _digest(*parts: str) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()[:24]


def _checksum_file(library: Path) -> Path:
    return library.with_name(f"{library.name}.sha256")


def _is_whole(library: Path) -> bool:
    """Return whether the library exists, has the right checksum, and belongs to this user or to the superuser, since
    its code will be run."""
    try:
        if hasattr(os, "getuid") and library.stat().st_uid not in (os.getuid(), 0):
            return False
        expected = _checksum_file(library).read_text(encoding="utf-8")
        return hashlib.sha256(library.read_bytes()).hexdigest() == expected.strip()
    except (OSError, UnicodeDecodeError):
        return False


def _remove_leftovers(directory: Path) -> None:
    """Remove the folders of killed builds, which are older than any compiler may run."""
    for folder in directory.glob("building-*"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > 2 * _TIMEOUT:
                shutil.rmtree(folder, ignore_errors=True)


_address, _buffer = ctypes.addressof, ctypes.c_char.from_buffer  # looking them up takes a tenth of a call


def addresses(*arrays: np.ndarray | None) -> list[int | None]:
    """Return the addresses of contiguous arrays for a compiled function, None for None."""
    buffers: tuple[Any, ...] = arrays
    try:  # takes a quarter of the time of array.ctypes.data
        return [None if one is None else _address(_buffer(one)) for one in buffers]
    except (TypeError, ValueError):  # one is read-only or empty
        return [None if one is None else one.ctypes.data for one in buffers]


@functools.cache
def _machine() -> str:
    """Describe the system and the processor that a compiled library is tied to, without using a compiler."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            lines = [line for line in file if line.startswith(("flags", "Features", "CPU part"))]
        processor = "".join(sorted(set(lines)))
    except OSError:  # not Linux: libraries are for this machine only
        processor = f"{platform.processor()} {platform.node()}"
    return f"{sys.platform} {platform.machine()} {' '.join(platform.libc_ver())} {processor}"


@functools.lru_cache(maxsize=8)
def _target(command: tuple[str, ...]) -> str:
    """Return all macros that the compiler predefines, which include its version and the processor's features."""
    return _run([*command, "-dM", "-E", "-x", "c++", os.devnull])


def _run(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"the C++ compiler {command[0]!r} does not run ({error}); set CXX to another one") from error
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise BuildError(f"the C++ compiler {command[0]!r} fails ({first.strip()}); set CXX to another one")
    return done.stdout
