"""The command ``sb3-maddpg``: everything that is done often, in one line."""

import argparse
import importlib
import json
import os
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

import gymnasium

from sb3_maddpg.cli.options import PROG, common_options
from sb3_maddpg.pretrained_models import pretrained_folder, pretrained_models
from sb3_maddpg.utils import suggest

# Where evaluate and replay look unless --env says otherwise
ENV = "QuadSwarm-v0"
# Mistakes in what the user gave. Their messages say what to do, so one line is enough.
USER_ERRORS = (ValueError, FileNotFoundError, FileExistsError, AssertionError, ImportError, gymnasium.error.Error)

DESCRIPTION = """\
MADDPG for Stable-Baselines3, and a swarm of quadrotors that learns whom to ask.

{commands}

`<command> --help` lists a command's options and shows an example. Those of train, tune, enjoy and record are rl_zoo3's.
What differs: --algo is maddpg unless given (or matd3), the packaged recipe is used unless --conf-file is given,
--env-kwargs are merged over the recipe's, --num-threads is 1 unless given, and -i MODEL.zip continues the training
where it ended. --env PACKAGE/MODULE is a PettingZoo environment; its --env-kwargs are those of its parallel_env,
`state:True` for critics that read the global state, and `wrappers`. Where a command takes a model's zip,
`latest:LOGDIR` is the newest one there and `pretrained:NAME` one that comes with the package."""


class Command(NamedTuple):
    """What a command does, and how it is called."""

    run: Callable[[list[str]], int]
    help: str
    examples: str


def _zoo(command: str) -> Callable[[list[str]], int]:
    """A command of the zoo; rl_zoo3 is imported only now, for the others do without it."""

    def run(argv: list[str]) -> int:
        zoo = importlib.import_module("sb3_maddpg.cli.zoo")
        zoo.register()
        return zoo.COMMANDS[command](argv)

    return run


def _evaluate(argv: list[str]) -> int:
    return _hand_over("evaluators", argv)


def _replay(argv: list[str]) -> int:
    return _hand_over("replays", argv)


def _hand_over(group: str, argv: list[str]) -> int:
    """Call what a package offers for its environment.

    :param group: last part of the entry points' group
    """
    offers = entry_points(group=f"sb3_maddpg.{group}")
    parser = common_options()
    parser.set_defaults(env=ENV)
    known, rest = parser.parse_known_args(argv)
    for package in known.gym_packages:
        importlib.import_module(package)
    if known.env not in offers.names:
        raise ValueError(suggest(f"environment with {group}", known.env, offers.names))
    main: Callable[[list[str]], int] = offers[known.env].load()
    rest = [_model(word, known.algo, known.env) for word in rest]
    if known.algo != "maddpg":
        from rl_zoo3.utils import ALGOS

        from sb3_maddpg.cli import zoo

        zoo.register()
        if known.algo not in ALGOS:
            raise ValueError(suggest("algorithm", known.algo, ALGOS))
        algorithm = ALGOS[known.algo]
        rest += ["--algo", f"{algorithm.__module__}:{algorithm.__qualname__}"]
    return main(rest)


def _model(word: str, algo: str, env_id: str) -> str:
    """The path that ``latest:LOGDIR`` and ``pretrained:NAME`` stand for, with the threshold that may follow them."""
    name, at, threshold = word.partition("@")
    if name.startswith("latest:"):
        return latest_model(name, algo, env_id) + at + threshold
    if name.startswith("pretrained:"):
        return str(pretrained_folder(name.removeprefix("pretrained:")) / "model.zip") + at + threshold
    return word


def latest_model(word: str, algo: str, env_id: str) -> str:
    """
    :param word: ``latest:LOGDIR``
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :return: the final model of the newest run that has one, else its best model so far
    :raises FileNotFoundError: there is none
    """
    folder, name = Path(word.removeprefix("latest:"), algo), env_id.replace("/", "-")  # as rl_zoo3 calls it
    runs = [path for path in folder.glob(f"{name}_*") if path.name[len(name) + 1 :].isdigit()]
    for run in sorted(runs, key=lambda path: int(path.name[len(name) + 1 :]), reverse=True):
        for model in (run / f"{name}.zip", run / "best_model.zip"):
            if model.is_file():
                return str(model)
    raise FileNotFoundError(
        f"{word}: no trained model of {algo} for {env_id} in {folder}. Train one with "
        f"`{PROG} train --algo {algo} --env {env_id} --log-folder {folder.parent}`."
    )


def _bench(argv: list[str]) -> int:
    from sb3_maddpg.cli import bench

    return bench.main(argv)


def _pretrained(argv: list[str]) -> int:
    """List the shipped models, or show one or copy it."""
    parser = argparse.ArgumentParser(prog=f"{PROG} pretrained")
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"{', '.join(pretrained_models())}; all unless given")
    parser.add_argument("--out", type=Path, metavar="DIR", help="copy the model and what belongs to it into DIR/NAME")
    args = parser.parse_args(argv)
    if args.name is None:
        if args.out:
            parser.error("--out needs the NAME of a model")
        for name in pretrained_models():
            metrics = json.loads((pretrained_folder(name) / "metrics.json").read_text().splitlines()[0])
            print(f"{name:20} {metrics['preset']}, {metrics['n_robots']} robots; {pretrained_folder(name)}")
        return 0
    folder = pretrained_folder(args.name)
    if args.out:
        copy = args.out / args.name
        shutil.copytree(folder, copy)
        print(f"copied to {copy}")
    else:
        print((folder / "README.md").read_text())
        print(f"Files: {folder}")
    return 0


COMMANDS: dict[str, Command] = {
    "train": Command(
        _zoo("train"),
        "train a team and evaluate it now and then",
        f"""\
  {PROG} train --env QuadSwarm-v0 --progress --tensorboard-log logs/tensorboard
  {PROG} train --algo matd3 --env mpe2/simple_spread_v3
  {PROG} train --env mpe2/simple_spread_v3 --env-kwargs continuous_actions:False""",
    ),
    "tune": Command(
        _zoo("tune"),
        "search hyperparameters (train -optimize)",
        f"  {PROG} tune --env OwnBit-v0 --n-trials 50 --storage logs/tune.log --study-name a",
    ),
    "enjoy": Command(_zoo("enjoy"), "watch a trained model", f"  {PROG} enjoy --env QuadSwarm-v0 -f logs"),
    "record": Command(
        _zoo("record"), "record a trained model on video", f"  {PROG} record --env QuadSwarm-v0 -f logs -n 200"
    ),
    "evaluate": Command(
        _evaluate,
        "compare policies over the same episodes",
        f"  {PROG} evaluate --policy none full cpa:0.7:1.5 pretrained:quad-swarm-paper --scenario all --jobs 2",
    ),
    "replay": Command(
        _replay,
        "make a page that replays an episode in three dimensions",
        f"  {PROG} replay --policy full pretrained:quad-swarm-paper --scenario symmetric_swap --out replay.html",
    ),
    "bench": Command(
        _bench,
        "measure how fast a recipe trains on this machine, and where the time goes",
        f"  {PROG} bench --env QuadSwarm-v0 --n-timesteps 20000",
    ),
    "pretrained": Command(
        _pretrained,
        "list, show or copy the models that come with the package",
        f"  {PROG} pretrained\n  {PROG} pretrained quad-swarm-paper --out models",
    ),
}


def _parser() -> argparse.ArgumentParser:
    commands = "\n".join(f"  {name:11} {command.help}" for name, command in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog=PROG,
        description=DESCRIPTION.format(commands=commands),
        epilog="examples:\n" + "\n".join(command.examples for command in COMMANDS.values()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument("command", choices=COMMANDS, metavar="command", help="one of those above")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="options of the command")
    return parser


def main(argv: list[str] | None = None) -> int:
    """
    :param argv: arguments, those of the command line by default
    :return: exit status, 2 for a mistake in what the user gave
    """
    if not {"", os.getcwd()} & set(sys.path):  # the script does not see what lies here, `python -m` does
        sys.path.append(os.getcwd())
    arguments = _parser().parse_args(argv)
    command, rest = arguments.command, arguments.arguments
    debug = arguments.debug or "--debug" in rest
    # What a package offers for its environment may have such an option, rl_zoo3 has none
    if command not in ("evaluate", "replay"):
        rest = [word for word in rest if word != "--debug"]
    if {"-h", "--help"} & set(rest):
        print(f"{PROG} {command}: {COMMANDS[command].help}\n\nexamples:\n{COMMANDS[command].examples}\n")
    try:
        return COMMANDS[command].run(rest)
    except USER_ERRORS as error:
        if debug:
            raise
        print(f"error: {error or type(error).__name__} (--debug shows the traceback)", file=sys.stderr)
        return 2
