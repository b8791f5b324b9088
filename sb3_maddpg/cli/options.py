"""Options and checks that all commands share."""

import argparse
import difflib
import importlib
import pkgutil
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from sb3_maddpg.utils import shown, told

PROG = "sb3-maddpg"


def common_options() -> argparse.ArgumentParser:
    """:return: a parser of the options that all commands share"""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="maddpg")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", action="extend", default=[])
    return parser


def helps(words: Iterable[str]) -> bool:
    """
    :param words: arguments of a command
    :return: whether they ask for help
    """
    return not {"-h", "--help"}.isdisjoint(words)


_BROKEN = "--gym-packages {0}: it is there, but cannot be imported ({1}): repair it, or install what it needs."


def import_packages(names: Iterable[str]) -> None:
    """
    Import the packages of ``--gym-packages``.

    :param names: names of packages or modules
    :raises ValueError: if a name is not the name of a module
    :raises ImportError: if a package or one of its dependencies is missing, or it raises an error
    """
    for name in names:
        if not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"--gym-packages {shown(name)}: write the names of packages as after `import`.")
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if not f"{name}.".startswith(f"{error.name}."):
                raise ImportError(_BROKEN.format(name, told(error)), name=error.name) from error
            raise ModuleNotFoundError(
                f"--gym-packages {name}: there is no module {error.name}, neither installed nor in this folder."
                f"{did_you_mean(str(error.name), modules_beside(str(error.name)))}",
                name=error.name,
            ) from None
        except (Exception, SystemExit) as error:  # from foreign code
            raise ImportError(_BROKEN.format(name, told(error)), name=name) from error


@contextmanager
def importing_from(folder: Path | None, words: Sequence[str] = ()) -> Iterator[None]:
    """
    Import the modules of a folder, after all others, only if ``--gym-packages``, ``--env`` or ``--algo MODULE:CLASS``
    names one of them, so that names in a recipe are never imported from there by accident. Nothing else is imported
    from the current folder.

    :param folder: the folder
    :param words: arguments of a command
    """
    known, _ = common_options().parse_known_args(words)
    names = [*known.gym_packages, known.env or "", *([known.algo] if ":" in known.algo else [])]
    tops = {re.split(r"[./:]", name)[0] for name in names} - {""}
    asked = folder is not None and any((folder / f"{top}.py").is_file() or (folder / top).is_dir() for top in tops)
    here, before = Path.cwd(), sys.path.copy()
    sys.path[:] = [path for path in before if Path(path).resolve() != here] + [str(folder)] * asked
    try:
        yield
    finally:
        sys.path[:] = before


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.7) -> str:
    """
    :param name: an unknown name
    :param known: the known names
    :param cutoff: minimum similarity, see ``difflib``
    :return: a question about the closest known name, to append to a message; empty if there is none
    """
    nearest = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f" Did you mean '{nearest[0]}'?" if nearest else ""


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


def files_beside(path: str, pattern: str) -> list[str]:
    """
    :param path: path of a file, which may not exist
    :param pattern: glob pattern of file names
    :return: the matching files in its folder
    """
    return [str(found) for found in Path(path).parent.glob(pattern)]


@contextmanager
def nearest_options() -> Iterator[None]:
    """Make all parsers, including rl_zoo3's, suggest the closest option for an unknown one, and the closest choice."""
    error = argparse.ArgumentParser.error

    def with_hint(self: argparse.ArgumentParser, message: str) -> NoReturn:
        if unknown := re.match(r"unrecognized arguments: (--?[\w-]+)", message):
            options = [option for action in self._actions for option in action.option_strings]
            message += did_you_mean(unknown[1], options).replace(" D", "; d")
        elif chosen := re.match(r"argument .*: invalid choice: '(.*?)' \(choose from (.*)\)", message):
            message += did_you_mean(chosen[1], re.findall(r"[\w-]+", chosen[2]), cutoff=0.6).replace(" D", "; d")
        error(self, message)

    argparse.ArgumentParser.error = with_hint  # type: ignore[method-assign]
    try:
        yield
    finally:
        argparse.ArgumentParser.error = error  # type: ignore[method-assign]


def check_writable(path: Path) -> None:
    """
    Check that a file can be written before doing the work that it will hold. This creates its folder.

    :param path: path of the file
    :raises OSError: if the file cannot be written
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        path.open("ab").close()
        return
    try:
        # Without a name, so that other processes never find an empty file under this one
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
