"""The command ``sb3-maddpg`` with its subcommands for frequent tasks."""

import argparse
import functools
import importlib
import os
import re
import shutil
import signal
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from difflib import get_close_matches
from importlib.metadata import EntryPoint, version
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import gymnasium
import yaml

from sb3_maddpg.cli.command_files import runs_of
from sb3_maddpg.cli.options import (
    PROG,
    check_writable,
    common_options,
    did_you_mean,
    helps,
    import_packages,
    importing_from,
    nearest_options,
)
from sb3_maddpg.cli.overview import ALGORITHMS, overview
from sb3_maddpg.cli.terminal import discard_output, is_unread, lasting_output
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.files.model_files import TRUST_VARIABLE, refuse_pickled, trusted
from sb3_maddpg.files.saving import Lean
from sb3_maddpg.hub.pretrained import pretrained_folder, pretrained_models
from sb3_maddpg.offers import broken, load_offer, offer_named, offers
from sb3_maddpg.starting import interruptible
from sb3_maddpg.utils import shown, suggest, told

# Errors in the user's input and errors of the system. Their messages name the remedy, so no traceback is shown.
USER_ERRORS = (
    ValueError,
    OSError,
    AssertionError,
    ImportError,
    MemoryError,
    gymnasium.error.Error,
    yaml.YAMLError,
)

DESCRIPTION = """\
Multi-agent reinforcement learning with MADDPG, MATD3 and MASAC for Stable-Baselines3.

{commands}

`<command> --help` lists a command's options and shows an example. train, tune, enjoy and record have rl_zoo3's options,
with these differences: --algo defaults to maddpg, --conf-file to the packaged recipe and --num-threads to 1;
--env-kwargs are merged over those of the recipe; and -i MODEL.zip continues training where it ended.
Values of --env-kwargs and -params are written in Python or YAML; nothing is evaluated.
--gym-packages PACKAGE ... imports packages that register environments, rules or scenarios, with every command.
--env PACKAGE/MODULE selects a PettingZoo environment (MODULE for a file in the current folder). Its --env-kwargs are
the arguments of its parallel_env, `state:true` for critics that read the global state, and SuperSuit `wrappers`. With
an algorithm of Stable-Baselines3, such as --algo ppo, all agents share one policy. Commands that take a model's zip
file also accept `latest:LOGDIR` for the newest model in a folder and `pretrained:NAME`. --trust, with any command,
loads files that may run code: models of earlier versions and of other algorithms."""


class Command(NamedTuple):
    """A subcommand with its help and examples."""

    run: Callable[[list[str]], int]
    help: str
    examples: str
    offers: str = ""
    """Group of the entry points through which packages provide the command for their environments"""


def _zoo(command: str) -> Callable[[list[str]], int]:
    """Return a command of the zoo. It imports rl_zoo3 only when called, since other commands do not need it."""

    def run(argv: list[str]) -> int:
        zoo = importlib.import_module("sb3_maddpg.cli.zoo")
        zoo.register()
        return zoo.COMMANDS[command](argv)

    return run


def _evaluate(argv: list[str]) -> int:
    return _hand_over("evaluators", argv)


def _replay(argv: list[str]) -> int:
    return _hand_over("replays", argv)


def _identify(argv: list[str]) -> int:
    return _hand_over("identifiers", argv)


def _hand_over(group: str, argv: list[str]) -> int:
    """
    Call the command that a package provides for its environment. ``--env`` is optional if there is only one.

    :param group: last part of the name of the entry points' group
    :param argv: arguments of the command
    :return: exit status
    """
    names = sorted({one.name for one in offers(group)})
    known, rest = common_options().parse_known_args(argv)
    import_packages(known.gym_packages)
    if known.env is None and len(names) != 1:
        choice = f"choose one of {', '.join(names)}" if names else f"no installed package has {group}"
        raise ValueError(f"--env is missing: {choice}.")
    known.env = known.env or names[0]
    offer = offer_named(group, known.env)
    if offer is None:
        if get_close_matches(known.env, names, n=1):
            raise ValueError(suggest("environment", known.env, names))
        raise ValueError(
            f"This command is for {', '.join(names)}, not for {shown(known.env)}: no installed package "
            f"provides {group} for it. `sb3-maddpg enjoy` and `record` run models in any environment, and "
            "evaluate_policy of Stable-Baselines3 measures their returns."
        )
    main = load_offer(offer)
    if helps(rest):
        print(f"Environments (--env, by default the first): {', '.join(names)}\n")
    if helps(rest) and group != "identifiers":
        print(f"Models: MODEL.zip, latest:LOGDIR, {', '.join(f'pretrained:{name}' for name in pretrained_models())}\n")
    rest = [_model(word, known.algo, known.env) for word in rest]
    if known.algo != "maddpg":
        algorithm = _algorithm(known.algo)
        ours = isinstance(algorithm, type) and issubclass(algorithm, TeamAlgorithm)
        if not ours and not trusted(None):
            for word in rest:
                if Path(path := word.partition("@")[0]).is_file() and zipfile.is_zipfile(path):
                    refuse_pickled(path, {})
        rest += ["--algo", known.algo if ":" in known.algo else f"{algorithm.__module__}:{algorithm.__qualname__}"]
    return _call(offer, main, rest)


def _call(offer: EntryPoint, main: Any, argv: list[str]) -> int:
    """:return: the exit status of a package's command"""
    if not callable(main):
        raise broken(offer, f"is {shown(main)}, not a function of the command's arguments")
    try:
        status = main(argv)
    except USER_ERRORS:
        raise
    except Exception as error:  # from foreign code
        raise broken(offer, f"failed ({told(error)})") from error
    if status is not None and not isinstance(status, int):
        raise broken(offer, f"returned {shown(status)}, which is no exit status")
    return status or 0


def _algorithm(name: str) -> Any:
    """Return the class that loads models: an algorithm of the zoo, or ``MODULE:CLASS`` of anything with a ``load``."""
    module, colon, qualname = name.partition(":")
    if colon:
        try:
            return functools.reduce(getattr, qualname.split("."), importlib.import_module(module))
        except (Exception, SystemExit) as error:  # from foreign code
            raise ValueError(f"--algo {shown(name)} is not an importable MODULE:CLASS ({told(error)}).") from error
    from rl_zoo3.utils import ALGOS

    from sb3_maddpg.cli import zoo

    zoo.register()
    if name not in ALGOS:
        raise ValueError(suggest("algorithm", name, ALGOS))
    return ALGOS[name]


def _model(word: str, algo: str, env_id: str) -> str:
    """Replace ``latest:LOGDIR`` and ``pretrained:NAME`` by the path of the model, keeping a threshold after ``@``."""
    name, at, threshold = word.partition("@")
    if name.startswith("latest:"):
        return latest_model(name, algo, env_id) + at + threshold
    if name.startswith("pretrained:"):
        return str(pretrained_folder(name.removeprefix("pretrained:")) / "model.zip") + at + threshold
    kind, colon, _ = name.partition(":")
    if colon and (hint := did_you_mean(kind, ("latest", "pretrained"), cutoff=0.8)):
        raise ValueError(f"{word} is not a model; use latest:LOGDIR or pretrained:NAME.{hint}")
    return word


def latest_model(word: str, algo: str, env_id: str) -> str:
    """
    Find the newest model in a log folder.

    :param word: ``latest:LOGDIR``
    :param algo: name of the algorithm, or ``MODULE:CLASS``
    :param env_id: Gymnasium id
    :return: path of the final model of the newest run that has a model, or else of that run's best model so far
    :raises FileNotFoundError: if there is no model
    """
    algo = algo.rpartition(":")[2].lower()  # of MODULE:CLASS
    folder, name = Path(word.removeprefix("latest:"), algo), env_id.replace("/", "-")  # as in rl_zoo3
    for run in runs_of(folder, name).values():
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
    """List the pretrained models, or show or copy one."""
    parser = argparse.ArgumentParser(prog=f"{PROG} pretrained")
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"{', '.join(pretrained_models())}; default: all")
    parser.add_argument("--out", type=Path, metavar="DIR", help="copy the model's folder to DIR/NAME")
    args = parser.parse_args(argv)
    if args.name is None:
        if args.out:
            parser.error("--out needs the NAME of a model")
        for name in pretrained_models():
            print(f"{name:20} {_headline(pretrained_folder(name) / 'README.md')}")
        return 0
    folder = pretrained_folder(args.name)
    if args.out:
        copy = args.out / args.name
        shutil.copytree(folder, copy)
        print(f"copied to {copy}")
    else:
        if (readme := folder / "README.md").is_file():
            print(readme.read_text())
        print(f"Files: {folder}")
    return 0


def _convert(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog=f"{PROG} convert",
        description="Convert a model's file to this version's format, which runs no code when it is loaded. Reading an "
        "older file may run the code it holds, and therefore needs --trust.",
    )
    parser.add_argument("old", type=Path, metavar="OLD.zip")
    parser.add_argument("new", type=Path, metavar="NEW.zip")
    parser.add_argument(
        "--algo", choices=sorted(ALGORITHMS), default="maddpg", help="the model's algorithm (default %(default)s)"
    )
    parser.add_argument("--lean", choices=get_args(Lean), help="keep only the actors, or the critics too")
    args = parser.parse_args(argv)
    check_writable(args.new)
    ALGORITHMS[args.algo].load(args.old, device="cpu").save(args.new, lean=args.lean)
    print(f"wrote {args.new}")
    return 0


def _publish(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog=f"{PROG} publish",
        description="Upload a model to the Hugging Face Hub: a file that runs no code when it is loaded, a model card, "
        "and the recipe and evaluations of its run. Log in first with `hf auth login`.",
    )
    parser.add_argument("model", metavar="MODEL.zip", help="or latest:LOGDIR, pretrained:NAME")
    parser.add_argument("repository", metavar="NAME/REPOSITORY")
    parser.add_argument("--algo", default="maddpg", choices=sorted(ALGORITHMS), help="default %(default)s")
    parser.add_argument("--env", default="QuadSwarm-v0", help="for latest:LOGDIR (default %(default)s)")
    parser.add_argument("--whole", action="store_true", help="include everything that training needs to resume")
    parser.add_argument("--private", action="store_true", help="make a new repository private")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write it all into this folder instead")
    args = parser.parse_args(argv)
    from sb3_maddpg.hub import model_card as hub

    path = Path(_model(args.model, args.algo, args.env))
    model, lean = ALGORITHMS[args.algo].load(path, device="cpu"), None if args.whole else "critic"
    if args.out is not None:
        hub.write_model_folder(model, args.out, args.repository, path.parent, cast("Lean | None", lean))
        print(f"wrote {args.out}")
    else:
        print(hub.publish(model, args.repository, path.parent, cast("Lean | None", lean), args.private))
    return 0


def _headline(readme: Path) -> str:
    """:return: the first sentence of a model's README without Markdown; a colon also ends it"""
    text = " ".join(readme.read_text().split("\n\n")[0].split()) if readme.is_file() else ""
    return re.split(r"(?<=[.:])\s", text.lstrip("# ").replace("`", ""), maxsplit=1)[0].rstrip(".:")


def examples(name: str) -> str:
    """
    :param name: name of a command
    :return: the command's examples. For a command that packages provide, these are ``EXAMPLES`` of their modules.
    """
    command = COMMANDS[name]
    if not command.offers:
        return command.examples
    found = []
    for offer in offers(command.offers):
        load_offer(offer)
        own = getattr(importlib.import_module(offer.module), "EXAMPLES", "")
        if not isinstance(own, str):
            raise broken(offer, f"has EXAMPLES={shown(own)}, which is no text")
        found.append(own.rstrip("\n") or command.examples.replace("ENV", offer.name))
    return "\n".join(found) or command.examples


COMMANDS: dict[str, Command] = {
    "train": Command(
        _zoo("train"),
        "train a team and evaluate it periodically",
        f"""\
  {PROG} train --env mpe2/simple_spread_v3 --progress --tensorboard-log logs/tensorboard
  {PROG} train --algo matd3 --env mpe2/simple_spread_v3 --env-kwargs continuous_actions:false
  {PROG} train --algo iddpg --env mpe2/simple_spread_v3
  {PROG} train --env mpe2/simple_spread_v3 --seeds 0-4 --jobs 2
  {PROG} train --algo ppo --env mpe2/simple_spread_v3 -params n_envs:8 learning_rate:lin_1e-3
  {PROG} train --gym-packages my_package --env MyTeam-v0 --conf-file recipes.yml""",
    ),
    "tune": Command(
        _zoo("tune"),
        "search hyperparameters (train -optimize)",
        f"  {PROG} tune --env OwnBit-v0 --n-trials 50 --storage logs/tune.log --study-name a --jobs 2",
    ),
    "enjoy": Command(_zoo("enjoy"), "watch a trained model", f"  {PROG} enjoy --env mpe2/simple_spread_v3 -f logs"),
    "record": Command(
        _zoo("record"),
        "record a trained model on video",
        f"  {PROG} record --env mpe2/simple_spread_v3 -f logs -n 200",
    ),
    "evaluate": Command(
        _evaluate,
        "compare policies over the same episodes",
        f"  {PROG} evaluate --env ENV --policy latest:logs",
        "evaluators",
    ),
    "replay": Command(
        _replay,
        "write a web page that replays an episode in three dimensions",
        f"  {PROG} replay --env ENV --policy latest:logs --out replay.html",
        "replays",
    ),
    "identify": Command(
        _identify,
        "fit the vehicle model of an environment to a simulator",
        f"  {PROG} identify --env ENV --plant SIMULATOR:VEHICLE --out vehicle.yml",
        "identifiers",
    ),
    "bench": Command(
        _bench,
        "measure how fast a recipe trains on this machine and where the time goes",
        f"  {PROG} bench --env mpe2/simple_spread_v3 --n-timesteps 20000",
    ),
    "publish": Command(
        _publish,
        "upload a model to the Hugging Face Hub",
        f"  {PROG} publish --algo maddpg --env mpe2/simple_spread_v3 latest:logs me/maddpg-simple_spread",
    ),
    "convert": Command(
        _convert,
        "convert a model's file to one that runs no code when it is loaded",
        f"  {PROG} convert old.zip new.zip --trust",
    ),
    "pretrained": Command(
        _pretrained,
        "list, show or copy the pretrained models of the installed packages",
        f"  {PROG} pretrained\n  {PROG} pretrained NAME --out models",
    ),
}


class _Parser(argparse.ArgumentParser):
    """Parser that lists the installed environments and models for ``--help`` only, since that takes a second."""

    def format_help(self) -> str:
        self.epilog = f"{overview()}\n\nexamples:\n" + "\n".join(map(examples, COMMANDS))
        return super().format_help()


def _parser() -> argparse.ArgumentParser:
    commands = "\n".join(f"  {name:11} {command.help}" for name, command in COMMANDS.items())
    parser = _Parser(
        prog=PROG,
        description=DESCRIPTION.format(commands=commands),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{PROG} {version('sb3-maddpg')}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument("command", choices=COMMANDS, metavar="command", help="one of those above")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="options of the command")
    return parser


@contextmanager
def _trust() -> Iterator[None]:
    """Allow files to run code, in this process and its subprocesses."""
    before = os.environ.get(TRUST_VARIABLE)
    os.environ[TRUST_VARIABLE] = "1"
    try:
        yield
    finally:
        os.environ.pop(TRUST_VARIABLE)
        if before is not None:
            os.environ[TRUST_VARIABLE] = before


def main(argv: list[str] | None = None) -> int:
    """
    Run a command.

    :param argv: arguments, by default those of the command line
    :return: exit status, 2 for an error in the user's input, 130 after Ctrl-C
    """
    interruptible()
    words = sys.argv[1:] if argv is None else argv
    debug = "--debug" in words
    try:
        with lasting_output(), nearest_options():
            status = _run(words)
            sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        if debug:
            raise
        print("Interrupted.", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError as error:
        if debug or not is_unread():
            return _told(error, debug)
        discard_output()
        return 128 + signal.SIGPIPE
    except USER_ERRORS as error:
        return _told(error, debug)


def _run(words: list[str]) -> int:
    arguments = _parser().parse_args(words)
    command, rest = arguments.command, arguments.arguments
    # Commands of packages may have this option, rl_zoo3's do not
    if command not in ("evaluate", "replay"):
        rest = [word for word in rest if word != "--debug"]
    trusts, rest = "--trust" in rest, [word for word in rest if word != "--trust"]
    if helps(rest):
        print(f"{PROG} {command}: {COMMANDS[command].help}\n\nexamples:\n{examples(command)}\n")
    with importing_from(Path.cwd(), rest), _trust() if trusts else nullcontext():
        return COMMANDS[command].run(rest)


def _told(error: BaseException, debug: bool) -> int:
    """Print an error on one line, or raise it for its traceback."""
    if debug:
        raise error
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    print(f"error: {' '.join(text.split()) or type(error).__name__} (--debug shows the traceback)", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
