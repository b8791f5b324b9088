"""Compiles the kernel once for each problem and keeps the result in the user's cache."""

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
from pathlib import Path

_SOURCES = Path(__file__).parent
_SUFFIX = ".dll" if sys.platform == "win32" else ".so"
# Fused multiplications stand in the source and NaN must stay NaN: nothing here may let the compiler rearrange numbers.
_FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-fvisibility=hidden")
_SHARED = ("-shared",) if sys.platform == "win32" else ("-shared", "-fPIC")
_TIMEOUT = 300  # seconds; a compiler that takes longer hangs


class BuildError(RuntimeError):
    """The kernel cannot be compiled here; the message says why and what helps."""


def cache_directory() -> Path:
    """Where compiled kernels are kept: ``QUAD_SWARM_CACHE``, or the user's cache directory."""
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
        command = shlex.split(chosen)
        if shutil.which(command[0]) is None:
            raise BuildError(f"no C++ compiler: CXX={chosen!r} is no command; unset CXX or name one")
        return command
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    raise BuildError("no C++ compiler: install g++ or clang++, or name one in CXX")


def build(model: str, precision: str) -> Path:
    """The shared library of a problem, compiled unless the cache has it.

    :param model: the header that `generate_model` wrote
    :param precision: "float32" or "float64"
    :raises BuildError: no compiler, or it fails, or the cache cannot be written
    """
    command = [*compiler(), *_FLAGS, _native_flag(), f"-DREAL={'float' if precision == 'float32' else 'double'}"]
    sources = {name: (_SOURCES / name).read_text(encoding="utf-8") for name in ("lanes.hpp", "kernel.cpp")}
    sources["model.hpp"] = model
    digest = hashlib.sha256()
    for part in (*command, _target(tuple(command)), *sources.values()):
        digest.update(part.encode() + b"\0")
    directory = cache_directory()
    library = directory / f"rti-{digest.hexdigest()[:32]}{_SUFFIX}"
    if library.exists():
        return library
    try:
        directory.mkdir(parents=True, exist_ok=True)
        # In the cache's own file system, so that the finished library appears there in one step.
        with tempfile.TemporaryDirectory(dir=directory, prefix="building-", ignore_cleanup_errors=True) as folder:
            for name, text in sources.items():
                Path(folder, name).write_text(text, encoding="utf-8")
            result = Path(folder, library.name)
            _run([*command, *_SHARED, str(Path(folder, "kernel.cpp")), "-o", str(result)])
            # On Windows a library in use cannot be replaced: then another process was faster, and made the same.
            with contextlib.suppress(PermissionError):
                os.replace(result, library)
    except OSError as error:
        raise BuildError(
            f"cannot write to the cache {directory} ({error.strerror or error}); "
            "name a writable directory in QUAD_SWARM_CACHE"
        ) from error
    return library


@functools.lru_cache(maxsize=64)
def load(path: str) -> ctypes.CDLL:
    """A compiled kernel with its types declared; see `kernel.cpp` for what it is given.

    :raises BuildError: the file is damaged or was made for another system
    """
    try:
        library = ctypes.CDLL(path)
        function = library.quad_swarm_rti
    except (OSError, AttributeError) as error:
        raise BuildError(f"cannot load {path} ({error}); delete that file to have it compiled again") from error
    function.argtypes = [ctypes.c_int64, *[ctypes.c_void_p] * 8, *[ctypes.c_int64] * 3, ctypes.c_double]
    function.restype = None
    return library


def _native_flag() -> str:
    return "-mcpu=native" if platform.machine().lower() in ("arm64", "aarch64") else "-march=native"


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
