"""Journal of finished pieces of long work, kept in files until all are finished, so that killed runs can continue."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from quad_swarm.native.build import BuildError, cache_directory

# Distributions whose versions results depend on: the first two at least in their last bits, the simulators if they fly
_VERSIONS = (
    *("numpy", "torch", "casadi", "gymnasium", "pettingzoo", "stable-baselines3"),
    *("rotorpy", "crazyflow", "jax"),
)
_DAYS = 30  # after which pieces are deleted
_SOURCES = (".py", ".cpp", ".hpp")


def default_folder() -> Path | None:
    """Return the default folder of pieces, in the same cache as the compiled libraries; None, with a warning, if there
    is none."""
    try:
        return cache_directory() / "pieces"
    except BuildError as error:
        warnings.warn(f"Finished pieces are not kept: {error}.", RuntimeWarning, stacklevel=2)
        return None


class Journal:
    """JSON values in one file each, by keys of everything that they depend on.

    Files are written atomically, with a checksum. If writing fails, a warning is issued and pieces are no longer kept.

    :param folder: folder of the files; None keeps nothing
    """

    def __init__(self, folder: Path | None):
        self._folder = folder
        if folder is not None:
            _remove_old(folder)

    @staticmethod
    def key(what: str, packages: Iterable[str], files: Iterable[Path] = ()) -> str:
        """Compute the key of a piece from its description, the code and the machine.

        :param what: all arguments as text
        :param packages: names of the packages and modules whose sources the piece depends on
        :param files: other files that it depends on, such as models
        """
        digest = hashlib.sha256(what.encode())
        for part in (*origin(packages, files).values(), machine()):
            digest.update(b"\0" + part.encode())
        return digest.hexdigest()[:32]

    def fetch(self, key: str) -> Any:
        """Return the value of a piece, None if there is none, or it is not what was kept under this key."""
        if self._folder is None:
            return None
        try:
            found = json.loads(self._path(key).read_text(encoding="utf-8"))
            return found["value"] if found["sha256"] == _checksum(key, found["value"]) else None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):  # absent, or damaged
            return None

    def keep(self, key: str, value: Any) -> None:
        """Write the value of a piece."""
        if self._folder is None:
            return
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(
                "w", dir=self._folder, prefix=f"{key}.", suffix=".part", delete=False
            ) as file:
                try:
                    json.dump({"value": value, "sha256": _checksum(key, value)}, file)
                    file.flush()
                    os.fsync(file.fileno())
                    file.close()
                    os.replace(file.name, self._path(key))
                except BaseException:
                    Path(file.name).unlink(missing_ok=True)
                    raise
        except FileNotFoundError:  # another process did the same work and dropped it
            return
        except OSError as error:
            warnings.warn(
                f"Finished pieces cannot be kept in {self._folder} ({error.strerror or error}): a killed run will "
                "start from scratch.",
                RuntimeWarning,
                stacklevel=2,
            )
            self._folder = None

    def drop(self, keys: Iterable[str]) -> None:
        """Delete pieces and their temporary files, once the work that they belong to is finished."""
        if self._folder is None:
            return
        names = set(keys)
        for path in self._folder.glob("*.*"):
            if path.name.partition(".")[0] in names:
                with contextlib.suppress(OSError):
                    path.unlink()

    def _path(self, key: str) -> Path:
        assert self._folder is not None
        return self._folder / f"{key}.json"


def _remove_old(folder: Path) -> None:
    for path in folder.glob("*.*"):
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > _DAYS * 24 * 3600:
                path.unlink()


def origin(packages: Iterable[str], files: Iterable[Path] = ()) -> dict[str, str]:
    """Return digests of what results are a function of, apart from arguments and `machine`.

    :param packages: names of packages and modules, whose sources are digested wherever they are imported from
    :param files: files, whose content is digested
    """
    sources = {name: sources_digest(name) for name in sorted({package.partition(".")[0] for package in packages})}
    return sources | {str(path): _content(path) for path in files}


def differences(there: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """Return the names of what differs between two `origin`."""
    return sorted(name for name in {*there, *here} if there.get(name) != here.get(name))


def _checksum(key: str, value: Any) -> str:
    return hashlib.sha256(json.dumps([key, value], sort_keys=True).encode()).hexdigest()


@functools.lru_cache(maxsize=64)
def sources_digest(name: str) -> str:
    """Return a digest of the sources of a package or a top-level module."""
    top = name.partition(".")[0]
    spec = importlib.util.find_spec(top)
    digest = hashlib.sha256(top.encode())
    if spec is not None and spec.submodule_search_locations:
        paths = sorted(path for place in spec.submodule_search_locations for path in Path(place).rglob("*.*"))
        for path in paths:
            if path.suffix in _SOURCES and path.is_file():  # editors leave links to nowhere
                digest.update(path.read_bytes())
    elif spec is not None and spec.origin is not None and Path(spec.origin).is_file():
        digest.update(Path(spec.origin).read_bytes())
    return digest.hexdigest()


def _content(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@functools.cache
def machine() -> str:
    """Describe what exact results depend on besides the code: the processor and the versions of libraries."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            processor = sorted({line for line in file if line.startswith(("model name", "flags", "Features"))})
    except OSError:  # not Linux
        processor = [platform.processor()]
    versions = []
    for name in _VERSIONS:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f"{name} {importlib.metadata.version(name)}")
    return repr((sys.version, platform.machine(), processor, versions))
