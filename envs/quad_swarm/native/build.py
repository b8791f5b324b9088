"""Compilation of C++, cached per source and machine in the user's cache."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import itertools
import os
import platform
import re
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
    """Return the directory of compiled libraries: ``QUAD_SWARM_CACHE``, or one in the user's cache directory.

    :return: its absolute path
    :raises BuildError: if the user has no home directory, and no environment variable names another place
    """
    chosen, home = os.environ.get("QUAD_SWARM_CACHE"), Path("~")
    if chosen:
        directory = Path(chosen)
    elif sys.platform == "win32":
        directory = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "quad_swarm"
    else:
        directory = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "quad_swarm"
    try:
        # A path without a folder would be looked up where the system's libraries are
        return Path(os.path.abspath(directory.expanduser()))
    except (RuntimeError, OSError) as error:  # nobody's home, or a current folder that was removed
        raise BuildError(
            f"there is no cache {directory} ({error}); set QUAD_SWARM_CACHE to a writable directory"
        ) from error


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
    :raises BuildError: if there is no compiler, it fails, the cache cannot be written, or another user's file is in the
        library's place
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
        # Not where another user could exchange the folder
        place = directory if _is_private(directory) else None
        with tempfile.TemporaryDirectory(dir=place, prefix="building-", ignore_cleanup_errors=True) as folder:
            for file, text in sources.items():
                Path(folder, file).write_text(text, encoding="utf-8")
            result = Path(folder, library.name)
            _run([*command, *_SHARED, str(Path(folder, main)), "-o", str(result)], folder)
            content = result.read_bytes()
        # On Windows, a library in use cannot be replaced, but then another process has built the same one. Elsewhere, a
        # file of another user may be in the way
        with contextlib.suppress(PermissionError):
            _put(content, library)
            _put(hashlib.sha256(content).hexdigest().encode(), _checksum_file(library))
    except OSError as error:
        raise BuildError(
            f"cannot write to the cache {directory} ({error.strerror or error}), or its files belong to another user; "
            "set QUAD_SWARM_CACHE to a writable directory"
        ) from error
    if not _is_whole(library):
        raise BuildError(
            f"cannot replace {library}, which is damaged or belongs to another user; set QUAD_SWARM_CACHE to a "
            "directory of your own"
        )
    return library


@functools.lru_cache(maxsize=64)
def load(path: str, *functions: str) -> ctypes.CDLL:
    """Load a library that `build` compiled.

    :param path: path of the library
    :param functions: functions that it must contain
    :raises BuildError: if the library cannot be loaded, is damaged, or another user could have written it
    """
    try:
        with open(path, "rb") as file:
            _check(file.fileno(), Path(path))
            library = ctypes.CDLL(_opened(file.fileno()) or path)
        for name in functions:
            getattr(library, name).restype = None
    except (OSError, ValueError, AttributeError) as error:
        told = re.sub(r"^/proc/self/fd/+\d+: ", "", str(error))
        if "undefined symbol" in told:
            remedy = "its compiler did not link C++'s library: set CXX to a compiler of C++, such as g++ instead of gcc"
        else:
            remedy = (
                "delete the file to compile it again, or set QUAD_SWARM_CACHE to a directory from which libraries may "
                "be loaded"
            )
        raise BuildError(f"cannot load {path} ({told}); {remedy}") from error
    return library


_loads = itertools.count(1)


def _opened(descriptor: int) -> str:
    """Return a path of an open file, so that what is loaded is what was checked, whoever exchanges the file meanwhile;
    empty if the system has none.

    The number of slashes differs each time: the loader takes equal paths for one library.
    """
    folder = "/proc/self/fd"
    if not os.path.isdir(folder):
        return ""
    return f"{folder}{'/' * next(_loads)}{descriptor}"


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
    """Return whether the library exists and passes `_check`."""
    try:
        with library.open("rb") as file:
            _check(file.fileno(), library)
    except (OSError, ValueError):
        return False
    return True


def _check(descriptor: int, library: Path) -> None:
    """Check an open library, since its code will be run: its checksum is right, and only this user or the superuser can
    have written the two files.

    :raises ValueError: if not
    :raises OSError: if a file cannot be read
    """
    with _checksum_file(library).open("rb") as checksum:
        for file in (descriptor, checksum.fileno()):
            status = os.fstat(file)
            if hasattr(os, "getuid") and (status.st_uid not in (os.getuid(), 0) or status.st_mode & 0o022):
                raise ValueError("another user owns it or may write into it")
        expected = checksum.read().strip()
    with open(descriptor, "rb", closefd=False) as content:
        if hashlib.sha256(content.read()).hexdigest().encode() != expected:
            raise ValueError("its checksum is wrong")


def _is_private(directory: Path) -> bool:
    """Return whether no other user but the superuser can change the entries of a directory."""
    if not hasattr(os, "getuid"):
        return True
    status = directory.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022


def _put(content: bytes, path: Path) -> None:
    """Write a file atomically, which only this user may change."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o755)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


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


def _run(command: list[str], temporary: str | None = None) -> str:
    """Run the compiler.

    :param command: the command
    :param temporary: its folder of temporary files, by default the system's
    """
    environment = {**os.environ, "TMPDIR": temporary} if temporary else None
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False, env=environment)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"the C++ compiler {command[0]!r} does not run ({error}); set CXX to another one") from error
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise BuildError(f"the C++ compiler {command[0]!r} fails ({first.strip()}); set CXX to another one")
    return done.stdout
