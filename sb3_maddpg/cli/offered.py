"""
``sb3-maddpg evaluate``, ``replay``, ``identify``, ``export``, ``fly``: what packages provide for environments. Without
such a command, ``evaluate`` measures returns, see ``returns``.
"""

from __future__ import annotations

import argparse
import importlib
import zipfile
from collections.abc import Callable
from difflib import get_close_matches
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

from sb3_maddpg.cli.algorithms import loader_of
from sb3_maddpg.cli.runs import model_path
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.files.model_files import refuse_pickled, trusted
from sb3_maddpg.hub.pretrained import pretrained_models
from sb3_maddpg.offers import broken, load_offer, offer_named, offers
from sb3_maddpg.team.pettingzoo_ids import register
from sb3_maddpg.utils import shown, suggest, told

GROUPS = {
    "evaluate": "evaluators",
    "replay": "replays",
    "identify": "identifiers",
    "export": "exporters",
    "fly": "flyers",
}


def run(args: argparse.Namespace, words: list[str], example: str, user_errors: tuple[type[Exception], ...]) -> int:
    """
    Call the command that a package provides for its environment. ``--env`` is optional if there is only one.

    :param args: the options that all commands have
    :param words: all other words
    :param example: call of the command, where ENV stands for the environment
    :param user_errors: errors that need no explanation
    :return: exit status
    """
    group = GROUPS[args.command]
    names = sorted({one.name for one in offers(group)})
    words = ["--help" if word == "--help-all" else word for word in words]
    helps = not {"-h", "--help"}.isdisjoint(words)
    if helps and (args.env is None or offer_named(group, args.env) is not None):
        _print_help(group, example, names)
    if args.env is None and (len(names) != 1 and not (helps and names)):
        choice = f"choose one of {', '.join(names)}" if names else f"no installed package has {group}"
        raise InvalidArgumentError(f"--env is missing: {choice}.")
    env_id = args.env or names[0]
    offer = offer_named(group, env_id)
    near = get_close_matches(env_id, names, n=1)
    if offer is None and args.command == "evaluate" and (not near or register(env_id)):
        from sb3_maddpg.cli import returns

        return returns.run(args, words)
    if offer is None:
        if near:
            raise InvalidArgumentError(suggest("environment", env_id, names))
        raise InvalidArgumentError(
            f"This command is for {', '.join(names)}, not for {shown(env_id)}: no installed package "
            f"provides {group} for it. `sb3-maddpg evaluate`, `enjoy` and `record` run models in any environment."
        )
    main = load_offer(offer)
    words = [model_path(word, args.algo, env_id) for word in words]
    if getattr(args, "debug", False) and group != "identifiers":  # which has no such option
        words.append("--debug")
    return _call(offer, main, [*words, *_loader(args.algo, words)], user_errors)


def _print_help(group: str, example: str, names: list[str]) -> None:
    print(f"examples:\n{examples(group, example)}\n\nEnvironments (--env): {', '.join(names)}\n")
    if group == "evaluators":
        print("In any other environment, evaluate compares returns: `sb3-maddpg evaluate --env ENV --help`.\n")
    if group != "identifiers":
        models = ", ".join(f"pretrained:{name}" for name in pretrained_models())
        print(f"Models: MODEL.zip, latest:LOGDIR, {models}\n")


def _loader(algo: str, words: list[str]) -> list[str]:
    """:return: the option that names the class that loads the models, if it is not MADDPG"""
    if algo == "maddpg":
        return []
    loader = loader_of(algo)
    if not (isinstance(loader, type) and issubclass(loader, TeamAlgorithm)) and not trusted(None):
        for word in words:
            if Path(path := word.partition("@")[0]).is_file() and zipfile.is_zipfile(path):
                refuse_pickled(path, {})
    return ["--algo", algo if ":" in algo else f"{loader.__module__}:{loader.__qualname__}"]


def _call(
    offer: EntryPoint, main: Callable[[list[str]], Any], words: list[str], user_errors: tuple[type[Exception], ...]
) -> int:
    """:return: the exit status of a package's command"""
    if not callable(main):
        raise broken(offer, f"is {shown(main)}, not a function of the command's arguments")
    try:
        status = main(words)
    except user_errors:
        raise
    except Exception as error:  # from foreign code
        raise broken(offer, f"failed ({told(error)})") from error
    if status is not None and not isinstance(status, int):
        raise broken(offer, f"returned {shown(status)}, which is no exit status")
    return status or 0


def examples(group: str, example: str) -> str:
    """
    :param group: last part of the name of the entry points' group
    :param example: call of the command, where ENV stands for the environment
    :return: ``EXAMPLES`` of the modules that provide it, or else the call with their environments
    """
    found = []
    for offer in offers(group):
        load_offer(offer)
        own = getattr(importlib.import_module(offer.module), "EXAMPLES", "")
        if not isinstance(own, str):
            raise broken(offer, f"has EXAMPLES={shown(own)}, which is no text")
        found.append(own.rstrip("\n") or example.replace("ENV", offer.name))
    return "\n".join(found) or example
