"""
The command ``sb3-maddpg``: one tree of parsers, whose commands are imported when they run. The help answers before
PyTorch is loaded.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sb3_maddpg.cli import options
from sb3_maddpg.cli.options import PROG, import_packages, importing_from
from sb3_maddpg.cli.parser import Parser, UsageError
from sb3_maddpg.cli.terminal import discard_output, is_unread, lasting_output
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.starting import interruptible

# The environment variable of `files.model_files`, which loads PyTorch
TRUST_VARIABLE = "SB3_MADDPG_TRUST"

DESCRIPTION = """\
Multi-agent reinforcement learning with MADDPG, MATD3, MASAC and IDDPG for Stable-Baselines3.

commands:
{commands}

`COMMAND --help` shows examples and the frequent options of a command, `COMMAND --help-all` all of them. Options and
recipes are those of rl_zoo3, but --algo defaults to maddpg and --conf-file to the packaged recipe; --env-kwargs are
merged over those of the recipe; -i MODEL.zip continues a training where it ended; and values are plain literals, which
run no code.
--env PACKAGE/MODULE is a PettingZoo environment (MODULE for a file in the current folder). Its --env-kwargs are the
arguments of its parallel_env, `state:true` for critics that read the global state, and SuperSuit `wrappers`. With an
algorithm of Stable-Baselines3, such as --algo ppo, all agents share one policy.
Models are MODEL.zip, latest:LOGDIR for the newest in a folder, and pretrained:NAME.

with any command:
  --gym-packages PACKAGE ...  import packages that register environments, rules, scenarios or classes
  --trust                     load files that may run code: models of earlier versions and of other algorithms
  --quiet                     print results and errors only
  --debug                     show the traceback of an error
exit status: 0, or 1 for a failure, 2 for wrong usage, 130 after Ctrl-C"""


class Command(NamedTuple):
    """A subcommand."""

    help: str
    """What it does, on one line"""
    run: str
    """``MODULE:FUNCTION`` of its options and the words they were parsed from, imported when it runs"""
    add_options: Callable[[Parser], None] | None
    """Adds its options; None for a command that packages provide, which parses its own"""
    examples: str = ""
    """Calls to show with its help. ENV stands for the environments of a command that packages provide."""
    quiet: bool = False
    """Whether all that it prints is about its progress"""


COMMANDS: dict[str, Command] = {
    "train": Command(
        "train a team and evaluate it periodically",
        "training:train",
        options.training_options,
        f"""\
  {PROG} train --env mpe2/simple_spread_v3 --progress --tensorboard-log logs/tensorboard
  {PROG} train --algo matd3 --env mpe2/simple_spread_v3 --env-kwargs continuous_actions:false
  {PROG} train --algo masac --env mpe2/simple_spread_v3
  {PROG} train --env mpe2/simple_spread_v3 --seeds 0-4 --jobs 2
  {PROG} train --algo ppo --env mpe2/simple_spread_v3 -params n_envs:8 learning_rate:lin_1e-3
  {PROG} train --gym-packages my_package --env MyTeam-v0 --conf-file recipes.yml""",
        quiet=True,
    ),
    "tune": Command(
        "search hyperparameters",
        "study:tune",
        options.tuning_options,
        f"  {PROG} tune --env OwnBit-v0 --n-trials 50 --storage logs/tune.log --study-name a --jobs 2",
        quiet=True,
    ),
    "enjoy": Command(
        "watch a trained model",
        "show:enjoy",
        options.showing_options,
        f"  {PROG} enjoy --env mpe2/simple_spread_v3 -f logs",
    ),
    "record": Command(
        "record a trained model on video",
        "show:record",
        options.recording_options,
        f"  {PROG} record --env mpe2/simple_spread_v3 -f logs -n 200",
        quiet=True,
    ),
    "evaluate": Command(
        "compare policies over the same episodes, in any environment, or judge recorded flights",
        "offered:run",
        None,
        f"  {PROG} evaluate --env ENV --policy latest:logs",
    ),
    "replay": Command(
        "write a web page that replays an episode in three dimensions",
        "offered:run",
        None,
        f"  {PROG} replay --env ENV --policy latest:logs --out replay.html",
    ),
    "identify": Command(
        "fit the vehicle model of an environment to a simulator or to logged flights",
        "offered:run",
        None,
        f"  {PROG} identify --env ENV --plant SIMULATOR:VEHICLE --out vehicle.yml",
    ),
    "export": Command(
        "write what the robots of an environment load to fly with a model",
        "offered:run",
        None,
        f"  {PROG} export --env ENV pretrained:NAME --out FOLDER",
    ),
    "fly": Command(
        "fly the robots of an environment in real time, a process each",
        "offered:run",
        None,
        f"  {PROG} fly --env ENV --policy latest:logs",
    ),
    "bench": Command(
        "measure how fast a recipe trains on this machine and where the time goes",
        "bench:bench",
        options.bench_options,
        f"  {PROG} bench --env mpe2/simple_spread_v3 --n-timesteps 20000",
    ),
    "publish": Command(
        "upload a model to the Hugging Face Hub",
        "models:publish",
        options.publish_options,
        f"  {PROG} publish --algo maddpg --env mpe2/simple_spread_v3 latest:logs me/maddpg-simple_spread",
        quiet=True,
    ),
    "convert": Command(
        "convert a model's file to one that runs no code when it is loaded",
        "models:convert",
        options.convert_options,
        f"  {PROG} convert old.zip new.zip --trust",
        quiet=True,
    ),
    "pretrained": Command(
        "list, show or copy the pretrained models of the installed packages",
        "models:pretrained",
        options.pretrained_options,
        f"  {PROG} pretrained\n  {PROG} pretrained NAME --out models",
    ),
}


def _overview() -> str:
    return importlib.import_module("sb3_maddpg.cli.overview").overview()


def build_parser() -> tuple[Parser, dict[str, Parser]]:
    """:return: the parser of the command, and those of its subcommands"""
    lines = "\n".join(f"  {name:11} {command.help}" for name, command in COMMANDS.items())
    parser = Parser(
        prog=PROG, description=DESCRIPTION.format(commands=lines), usage=f"{PROG} COMMAND [options]", further=_overview
    )
    parser.add_argument("--version", action="store_true", default=argparse.SUPPRESS, help="show the version")
    parser.rare("--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", help=argparse.SUPPRESS, parser_class=Parser)
    found = {}
    for name, command in COMMANDS.items():
        own = subparsers.add_parser(
            name,
            prog=f"{PROG} {name}",
            description=f"{command.help[0].upper()}{command.help[1:]}.",
            usage=f"{PROG} {name} [options]",
            epilog=f"examples:\n{command.examples}",
            further=_overview,
            add_help=command.add_options is not None,
            allow_abbrev=command.add_options is not None,
        )
        if command.add_options is None:
            options.task_options(own)
        else:
            command.add_options(own)
        options.general_options(own)
        found[name] = own
    return parser, found


def main(argv: list[str] | None = None) -> int:
    """
    Run a command.

    :param argv: arguments, by default those of the command line
    :return: exit status: 1 for a failure, 2 for wrong usage, 130 after Ctrl-C
    """
    words = sys.argv[1:] if argv is None else argv
    debug = "--debug" in words
    try:
        with lasting_output():
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
            return _report(error, debug)
        discard_output()
        return 128 + signal.SIGPIPE
    except Exception as error:
        if not isinstance(error, user_errors()):
            raise
        return _report(error, debug)


def _run(words: list[str]) -> int:
    parser, commands = build_parser()
    _complete(parser)
    args, rest = parser.parse_known_args(words)
    if getattr(args, "version", False):
        from importlib.metadata import version

        print(f"{PROG} {version('sb3-maddpg')}")
        return 0
    if args.command is None:
        parser.error("a command is missing")
    command = COMMANDS[args.command]
    if rest and command.add_options is not None:
        commands[args.command].error(f"unrecognized arguments: {' '.join(rest)}")
    given = words[words.index(args.command) + 1 :] if command.add_options is not None else rest
    algo, env = getattr(args, "algo", ""), getattr(args, "env", None)
    names = [*args.gym_packages, env or "", *([algo] if ":" in algo else [])]
    with importing_from(Path.cwd(), names), _trust(args.trust), _quiet(args.quiet, command.quiet):
        import_packages(args.gym_packages)
        module, _, function = command.run.partition(":")
        run = getattr(importlib.import_module(f"sb3_maddpg.cli.{module}"), function)
        interruptible()  # after the imports, which could catch the exception
        if command.add_options is not None:
            return run(args, given)
        return run(args, given, command.examples, user_errors())


def _complete(parser: Parser) -> None:
    """Complete words for a shell that asks for it, see argcomplete."""
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)


@contextlib.contextmanager
def _trust(trusts: bool) -> Iterator[None]:
    """Allow files to run code, in this process and its subprocesses."""
    before = os.environ.get(TRUST_VARIABLE)
    if trusts:
        os.environ[TRUST_VARIABLE] = "1"
    try:
        yield
    finally:
        os.environ.pop(TRUST_VARIABLE, None)
        if before is not None:
            os.environ[TRUST_VARIABLE] = before


@contextlib.contextmanager
def _quiet(quiet: bool, all_of_it: bool) -> Iterator[None]:
    """Hide progress bars, and all that a command prints if it is only about progress."""
    if not quiet:
        yield
        return
    os.environ["TQDM_DISABLE"] = "1"  # which tqdm reads when it is imported
    with contextlib.ExitStack() as stack:
        if all_of_it:
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        yield


def user_errors() -> tuple[type[Exception], ...]:
    """:return: errors in the user's input and errors of the system, whose messages name the remedy"""
    found: list[Any] = [ValueError, OSError, AssertionError, ImportError, MemoryError]
    for module, name in (("gymnasium.error", "Error"), ("yaml", "YAMLError")):  # as far as they are imported
        if module in sys.modules:
            found.append(getattr(sys.modules[module], name))
    return tuple(found)


def _report(error: BaseException, debug: bool) -> int:
    """Print an error on one line, or raise it for its traceback."""
    if debug:
        raise error
    text, prog = str(error), ""
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, UsageError):
        prog, hint = f"{error.prog}: ", f"{error.prog} --help shows the options"
    else:
        prog, hint = "", "--debug shows the traceback"
    print(f"{prog}error: {' '.join(text.split()) or type(error).__name__} ({hint})", file=sys.stderr)
    return 2 if isinstance(error, InvalidArgumentError) else 1


if __name__ == "__main__":
    sys.exit(main())
