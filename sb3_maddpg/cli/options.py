"""What all commands share: their name, the options that each of them looks at, and what is checked for each of them."""

import argparse
import importlib
from collections.abc import Iterable
from pathlib import Path

from sb3_maddpg.utils import shown

PROG = "sb3-maddpg"


def common_options() -> argparse.ArgumentParser:
    """The options that all commands look at; what they call reads the rest."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="maddpg")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    return parser


def import_packages(names: Iterable[str]) -> None:
    """
    Import what ``--gym-packages`` names.

    :param names: of packages or modules
    :raises ValueError: no such name can be imported
    :raises ImportError: the package is missing, or what it needs
    """
    for name in names:
        if not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"--gym-packages {shown(name)}: give the names of packages, as after `import`.")
        importlib.import_module(name)


def check_writable(path: Path) -> None:
    """
    Find out that a file cannot be written before the work whose result it shall hold; its folder is made.

    :param path: of the file
    :raises OSError: it cannot be written
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    exists = path.exists()
    path.open("ab").close()
    if not exists:
        path.unlink()
