"""``train --resume``: what the folder of a run, perhaps someone else's, says about how to go on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium

from sb3_maddpg.checkpoints.commit import newest
from sb3_maddpg.cli.algorithms import ALGORITHMS
from sb3_maddpg.cli.experiment import given_recipe
from sb3_maddpg.cli.options import PROG, general_options, import_packages, training_options
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.cli.parser import Parser
from sb3_maddpg.cli.runs import CHECKPOINTS
from sb3_maddpg.cli.safety import check_links, check_names, check_paths, is_inside, may_import, read_settings
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError, UntrustedFileError
from sb3_maddpg.files.model_files import trusted
from sb3_maddpg.team import pettingzoo_ids
from sb3_maddpg.utils import shown

# Options of a run that hold when it is resumed. All others concern its beginning, or are in its recipe.
_KEPT = (
    *("algo", "env", "n_timesteps", "seed", "vec_env", "device", "num_threads", "verbose", "progress"),
    *("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "save_replay_buffer", "log_interval"),
    *("checkpoint_every", "tensorboard_log", "gym_packages"),
)


def parsed(words: list[str], given_only: bool = False) -> argparse.Namespace:
    """
    :param words: options of ``train``
    :param given_only: whether to leave out the defaults of options that are not given
    :return: the parsed options
    """
    parser = Parser(f"{PROG} train")
    training_options(parser)
    general_options(parser)
    if given_only:
        for action in parser._actions:
            action.default = argparse.SUPPRESS
    return parser.parse_args(words)


def resumed(asked: argparse.Namespace, words: list[str]) -> tuple[Path, argparse.Namespace]:
    """
    Read the options of a run, over which those of the command line have precedence.

    :param asked: options of ``train``, with ``--resume``
    :param words: the options as they were given
    :return: folder of the run, and its options
    :raises InvalidArgumentError: if there is no run to resume
    :raises UntrustedFileError: if its options would import modules or write elsewhere; the user may name these again
    """
    run = _run(asked)
    path = _settings(run, "args.yml")
    if newest(run / CHECKPOINTS) is None:
        raise InvalidFileError(without_checkpoint(run))
    given = vars(parsed(words, given_only=True))
    written = {key: value for key, value in read_settings(path).items() if key in _KEPT and key not in given}
    args = _merged(written, words, path)
    load_environments()
    if trusted(None):
        sys.path.append(str(Path.cwd()))
        import_packages(args.gym_packages)
        return run, args
    check_links(run)
    if "algo" in written and written["algo"] not in ALGORITHMS:
        raise InvalidFileError(f"{path}: algo is {shown(written['algo'])}, whose runs have no checkpoints.")
    modules = [*written.get("gym_packages", ())]
    if "env" in written and written["env"] not in gymnasium.registry:
        modules.append(pettingzoo_ids.module_of(args.env))
    for module in modules:
        if not may_import(module):
            option = "--gym-packages" if module in written.get("gym_packages", ()) else "--env"
            raise UntrustedFileError(
                f"{path} imports {shown(module)}, which may run any code. If you trust it, name it again with "
                f"{option}, or pass --trust."
            )
    curves = written.get("tensorboard_log")
    logs = run.parent.parent if run.parent.name == args.algo else run
    if curves and not is_inside(curves, logs):
        raise UntrustedFileError(
            f"{path}: --tensorboard-log is {shown(curves)}, outside {logs}: name it again, or pass --trust."
        )
    return run, args


def _merged(written: Mapping[str, Any], words: list[str], path: Path) -> argparse.Namespace:
    """:return: the options of a run and of the command line, parsed in the same way"""
    before: list[str] = []
    for key, value in written.items():
        name = f"--{key.replace('_', '-')}"
        if isinstance(value, list):
            before += [f"{name}={one}" for one in value]
        elif value is True:
            before.append(name)
        elif value is not None and value is not False and value != "":  # 0 is a value
            before.append(f"{name}={value}")
    try:
        return parsed([*before, *words])
    except InvalidArgumentError as error:
        raise InvalidFileError(f"{path}: {error}") from error


def recipe_of(run: Path, args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """
    :param run: folder of a run
    :param args: its options, see ``resumed``
    :return: its recipe with the changes of the command line, as it is written, and where it is
    :raises UntrustedFileError: if it names classes that may run code, or paths outside the run
    """
    if args.conf_file is not None:
        return given_recipe(args)
    path = _settings(run, "config.yml")
    recipe = read_settings(path)
    if not trusted(None):
        check_names(recipe, args.env, str(path))
        check_paths(_without(recipe, args), run, str(path))
    return {**recipe, **(args.hyperparams or {})}, str(path)


def _without(recipe: Mapping[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """:return: a recipe without what the command line replaces"""
    rest = {key: value for key, value in recipe.items() if key not in (args.hyperparams or {})}
    for key in ("env_kwargs", "eval_env_kwargs"):
        if isinstance(kwargs := rest.get(key), Mapping):
            again = {**(args.env_kwargs or {}), **(args.eval_env_kwargs or {})}
            rest[key] = {name: value for name, value in kwargs.items() if name not in again}
    return rest


def _run(asked: argparse.Namespace) -> Path:
    if asked.resume:
        return Path(asked.resume)
    runs = [path.parent for path in Path(asked.log_folder).glob(f"*/*/{CHECKPOINTS}")]
    if not runs:
        raise InvalidArgumentError(f"--resume: no run in {asked.log_folder} has checkpoints; pass the folder of a run.")
    return max(runs, key=lambda path: path.stat().st_mtime)


def without_checkpoint(run: Path) -> str:
    """
    :param run: folder of a run that has no complete checkpoint
    :return: the message that says so, and how to train a finished run's model further
    """
    if finished := [path for path in run.glob("*.zip") if (run / path.stem).is_dir()]:
        return f"{run} is finished and has no checkpoints: train its model further with `train -i {finished[0]} ...`."
    return f"{run} has no complete checkpoint: begin again, without --resume."


def _settings(run: Path, name: str) -> Path:
    if not run.is_dir():
        raise InvalidArgumentError(f"--resume {shown(str(run))}: there is no such folder; name that of a run.")
    found = sorted(run.glob(f"*/{name}"))
    if len(found) != 1:
        raise InvalidArgumentError(f"{run} is not the folder of a run with checkpoints (it has {len(found)} {name}).")
    return found[0]
