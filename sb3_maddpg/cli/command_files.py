"""The command that started a run, which its folder keeps for ``--resume``, signed by the user who started it."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import hmac
import json
import os
import re
import secrets
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from sb3_maddpg.utils import atomic_write, shown, told

COMMAND_FILE = "command.json"
_KEY_BYTES = 32


class Command(NamedTuple):
    """Command that started a run."""

    argv: list[str]
    """Arguments of ``train``"""
    every: int | None
    """Number of steps between checkpoints, None for checkpoints by time"""
    folder: Path | None
    """Folder in which this user started the run; None if someone else did, or if the folder is gone"""


def runs_of(folder: Path, name: str) -> dict[int, Path]:
    """
    :param folder: folder of an algorithm's runs
    :param name: name of the environment
    :return: number -> folder of each run, the highest number first
    """
    form = re.compile(rf"{re.escape(name)}_([0-9]{{1,18}})")
    paths = [path for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    found = {int(match[1]): path for path in paths if (match := form.fullmatch(path.name))}
    return dict(sorted(found.items(), reverse=True))


def latest_run_number(folder: str = "", name: str = "") -> int:
    """
    Like the functions of rl_zoo3 and Stable-Baselines3, which fail at folders such as ``NAME_²``.

    :param folder: folder of runs, or of TensorBoard's logs
    :param name: name of the environment, or of the log
    :return: the highest number, 0 if there is no run
    """
    return next(iter(runs_of(Path(folder), str(name))), 0)


def resumable(argv: list[str]) -> list[str]:
    """
    :param argv: arguments of ``train``
    :return: the arguments with the absolute path of the recipe, since the run may be resumed from another folder
    """
    path = recipe_of(argv)
    return argv if path is None or path.is_absolute() or not path.is_file() else [*argv, "-conf", str(path.absolute())]


def recipe_of(argv: list[str]) -> Path | None:
    """
    :param argv: arguments of ``train``
    :return: value of ``--conf-file``
    """
    parser = argparse.ArgumentParser(add_help=False)  # rl_zoo3 accepts abbreviations
    parser.add_argument("-conf", "--conf-file", type=Path)
    return parser.parse_known_args(argv)[0].conf_file


def write_command(run: Path, argv: list[str], every: int | None) -> None:
    """
    Write and sign the command that starts a run in the current folder.

    :param run: folder of the run
    :param argv: arguments of ``train``, see ``resumable``
    :param every: number of steps between checkpoints, None for checkpoints by time
    """
    folder = os.getcwd()
    command = {"argv": argv, "every": every, "folder": folder, "signature": _signature(argv, folder)}
    with atomic_write(run / COMMAND_FILE, "json") as file:
        file.write(json.dumps(command).encode())


def read_command(run: Path) -> Command:
    """
    Read the command that started a run.

    :param run: folder of the run
    :return: the command
    :raises ValueError: if there is none
    """
    try:
        command = json.loads((run / COMMAND_FILE).read_text())
        argv, every = [str(word) for word in command["argv"]], command["every"]
        if every is not None and (type(every) is not int or every < 1):
            raise ValueError(f"checkpoints every {shown(every)} steps")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{run} is not the folder of a run with checkpoints ({told(error)}).") from error
    folder, signature = str(command.get("folder")), _signature(argv, str(command.get("folder")))
    own = signature is not None and hmac.compare_digest(signature.encode(), str(command.get("signature")).encode())
    return Command(argv, every, Path(folder) if own and Path(folder).is_dir() else None)


def own_words(run: Path) -> list[str]:
    """
    :param run: folder of a run
    :return: the words of the command with which this user started it, none if someone else did
    """
    with contextlib.suppress(ValueError):
        command = read_command(run)
        if command.folder is not None:
            return command.argv
    return []


def _signature(argv: list[str], folder: str) -> str | None:
    """:return: a signature by the user's key, None if there is no place to keep a key"""
    with contextlib.suppress(OSError, RuntimeError):  # a full disk, or no home
        key = _key()
        if len(key) == _KEY_BYTES:  # anyone could sign with an empty one
            return hmac.new(key, json.dumps([argv, folder]).encode(), hashlib.sha256).hexdigest()
    return None


def _key() -> bytes:
    """Read the user's key, and create it if there is none."""
    path = _state_directory() / "key"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        # Complete before it gets its name, and never replaced, since other processes may create one at the same time
        with tempfile.NamedTemporaryFile(dir=path.parent) as file:
            file.write(secrets.token_bytes(_KEY_BYTES))
            file.flush()
            with contextlib.suppress(FileExistsError):
                os.link(file.name, path)
    return path.read_bytes()


def _state_directory() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "sb3_maddpg"
