"""Compiles C++ once for each text and machine and keeps the result in the user's cache."""

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

_SUFFIX = ".dll" if sys.platform == "win32" else ".so"
# Fused multiplications stand in the source and NaN must stay NaN: nothing here may let the compiler rearrange numbers.
_FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-fvisibility=hidden")
_SHARED = ("-shared",) if sys.platform == "win32" else ("-shared", "-fPIC")
_TIMEOUT = 300  # seconds; a compiler that takes longer hangs


class BuildError(RuntimeError):
    """Nothing can be compiled here; the message says why and what helps."""


def cache_directory() -> Path:
    """Where compiled libraries are kept: ``QUAD_SWARM_CACHE``, or the user's cache directory."""
    if chosen := os.environ.get("QUAD_SWARM_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "quad_swarm"


def compiler() -> list[str]:
    """The command of the C++ compiler: ``CXX``, or the first that is found.

    :raises BuildError: there is none
    """
    if chosen := os.environ.get("CXX"):
        try:
            command = shlex.split(chosen)
        except ValueError:  # an unclosed quotation
            command = []
        if not command or shutil.which(command[0]) is None:
            raise BuildError(f"no C++ compiler: CXX={chosen!r} is no command; unset CXX or name one")
        return command
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    raise BuildError("no C++ compiler: install g++ or clang++, or name one in CXX")


def build(name: str, main: str, sources: Mapping[str, str], defines: Sequence[str] = ()) -> Path:
    """The shared library of some sources, compiled unless the cache has it whole.

    Beside each library stands its checksum: a damaged one is compiled again. Without a compiler that works, a library
    that any compiler made of the same sources on such a machine will do.

    :param name: how the library's file begins
    :param main: the file that is compiled; it includes the others
    :param sources: texts by the names of their files
    :param defines: macros, ``NAME=VALUE``
    :raises BuildError: no compiler, or it fails, or the cache cannot be written
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
        # In the cache's own file system, so that the finished library appears there in one step.
        with tempfile.TemporaryDirectory(dir=directory, prefix="building-", ignore_cleanup_errors=True) as folder:
            for file, text in sources.items():
                Path(folder, file).write_text(text, encoding="utf-8")
            result = Path(folder, library.name)
            _run([*command, *_SHARED, str(Path(folder, main)), "-o", str(result)])
            checksum = Path(folder, _checksum_file(library).name)
            checksum.write_text(hashlib.sha256(result.read_bytes()).hexdigest(), encoding="utf-8")
            # On Windows a library in use cannot be replaced: then another process was faster, and made the same.
            with contextlib.suppress(PermissionError):
                os.replace(result, library)
                os.replace(checksum, _checksum_file(library))
    except OSError as error:
        raise BuildError(
            f"cannot write to the cache {directory} ({error.strerror or error}), or what lies there is another user's; "
            "name a writable directory in QUAD_SWARM_CACHE"
        ) from error
    return library


@functools.lru_cache(maxsize=64)
def load(path: str, *functions: str) -> ctypes.CDLL:
    """A compiled library.

    :param functions: what it must hold
    :raises BuildError: the system does not load it
    """
    try:
        library = ctypes.CDLL(path)
        for name in functions:
            getattr(library, name).restype = None
    except (OSError, AttributeError) as error:
        raise BuildError(
            f"cannot load {path} ({error}); delete that file to have it compiled again, or name a directory from which "
            "libraries may be loaded in QUAD_SWARM_CACHE"
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
    """Whether the library is there, has the checksum with which it was made, and was put there by this user or the
    system's: it is code that will run."""
    try:
        if hasattr(os, "getuid") and library.stat().st_uid not in (os.getuid(), 0):
            return False
        expected = _checksum_file(library).read_text(encoding="utf-8")
        return hashlib.sha256(library.read_bytes()).hexdigest() == expected.strip()
    except (OSError, UnicodeDecodeError):
        return False


def _remove_leftovers(directory: Path) -> None:
    """Remove the folders of builds that were killed: those older than any compiler may run."""
    for folder in directory.glob("building-*"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > 2 * _TIMEOUT:
                shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _machine() -> str:
    """What a compiled library is tied to, as far as can be told without a compiler: the system and the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            lines = [line for line in file if line.startswith(("flags", "Features", "CPU part"))]
        processor = "".join(sorted(set(lines)))
    except OSError:  # no Linux: libraries serve this very machine alone
        processor = f"{platform.processor()} {platform.node()}"
    return f"{sys.platform} {platform.machine()} {' '.join(platform.libc_ver())} {processor}"


@functools.lru_cache(maxsize=8)
def _target(command: tuple[str, ...]) -> str:
    """Every macro that the compiler predefines: its version and the processor's features, which the key must name."""
    return _run([*command, "-dM", "-E", "-x", "c++", os.devnull])


def _run(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"the C++ compiler {command[0]!r} does not run ({error}); name another in CXX") from error
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise BuildError(f"the C++ compiler {command[0]!r} fails ({first.strip()}); name another in CXX")
    return done.stdout
