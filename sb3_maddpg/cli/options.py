"""Options of the commands, and the checks that commands share. Importing it loads no library."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sb3_maddpg.cli.algorithms import ALGORITHMS
from sb3_maddpg.cli.literals import parse_value
from sb3_maddpg.cli.parser import Parser
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import did_you_mean, modules_beside, shown, told

PROG = "sb3-maddpg"
ENGINES = ("local", "ray")
MOST_COPIES = 10_000  # parallel environments


def integer(low: int, otherwise: int | None = None, high: int | None = None) -> Callable[[str], int]:
    """
    :param low: the lowest value
    :param otherwise: a lower value that is also allowed, because it has a special meaning
    :param high: the highest value
    :return: a type of an option
    """

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{shown(text)} is no integer") from None
        if value < low and value != otherwise:
            raise argparse.ArgumentTypeError(
                f"{value}: choose {low} or more{'' if otherwise is None else f', or {otherwise}'}"
            )
        if high is not None and value > high:
            raise argparse.ArgumentTypeError(f"{value}: choose {high} or less")
        return value

    return parse


def _storage(text: str) -> str:
    """Check a storage of Optuna, which is a journal file or a database."""
    if not text.endswith(".log"):
        from sqlalchemy.engine import make_url
        from sqlalchemy.exc import ArgumentError

        try:
            make_url(text).get_dialect()
        except ArgumentError:
            raise argparse.ArgumentTypeError(
                f"{shown(text)}: name a file FILE.log, or the URL of a database such as sqlite:///FILE.db"
            ) from None
    return text


class StoreValues(argparse.Action):
    """
    Action that stores ``key:value key:value`` as a dict. Nothing is evaluated, see ``parse_value``. If the option is
    repeated, its pairs come together.
    """

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        before = getattr(namespace, self.dest, None)
        pairs: dict[str, Any] = {} if before is None or before is self.default else dict(before)
        try:
            for word in values:
                key, _, value = word.partition(":")
                if not key or not value:
                    raise ValueError("it has no value" if len(values) == 1 else f"'{word}' has no value")
                if key in pairs:
                    raise ValueError(f"'{key}' is given twice")
                pairs[key] = parse_value(value)
        except ValueError as error:
            remedy = "" if str(error).endswith("is not a finite number") else " Write key:value."
            raise InvalidArgumentError(f"{option_string} {shown(' '.join(values))}: {error}.{remedy}") from error
        setattr(namespace, self.dest, pairs)


_ONE = integer(1)
_ONE_OR_DEFAULT = integer(1, otherwise=-1)
_PAIRS: dict[str, Any] = {"nargs": "+", "action": StoreValues, "metavar": "KEY:VALUE"}


def general_options(parser: Parser) -> None:
    """Add the options that every command has."""
    parser.add_argument(
        "--gym-packages",
        nargs="+",
        action="extend",
        default=[],
        metavar="PACKAGE",
        help="import packages that register environments, rules, scenarios or classes",
    )
    parser.rare("--trust", action="store_true", help="load files that may run code")
    parser.rare("--quiet", action="store_true", help="print results and errors only")
    parser.rare("--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error")


def task_options(parser: Parser, env: str | None = None) -> None:
    """Add the options that choose algorithm and environment."""
    parser.add_argument("--algo", default="maddpg", help="the algorithm (default %(default)s)")
    parser.add_argument(
        "--env",
        default=env,
        help="Gymnasium id, or PACKAGE/MODULE of a PettingZoo environment" + (" (default %(default)s)" if env else ""),
    )


def training_options(parser: Parser) -> None:
    """Add the options of ``train``. Their names are rl_zoo3's, as far as it has them."""
    task_options(parser)
    add, rare = parser.add_argument, parser.rare
    add("--env-kwargs", **_PAIRS, help="arguments of the environment, merged over the recipe's")
    add("-conf", "--conf-file", metavar="FILE", help="recipe: a YAML file, or a packaged one by its name")
    add("-params", "--hyperparams", **_PAIRS, help="arguments of the algorithm and other keys of the recipe")
    add("-n", "--n-timesteps", type=_ONE_OR_DEFAULT, default=-1, metavar="N", help="number of steps")
    add("--seed", type=integer(0, otherwise=-1, high=2**32 - 1), default=-1, help="random seed (default: a random one)")
    add("--seeds", metavar="0-9", help="train once per seed")
    add("--jobs", type=int, help="number of parallel trainings of --seeds (default: one per core), or workers of tune")
    add("-f", "--log-folder", default="logs", metavar="DIR", help="folder of the runs (default %(default)s)")
    add("-tb", "--tensorboard-log", default="", metavar="DIR", help="folder of TensorBoard's curves")
    add("-P", "--progress", action="store_true", help="show a progress bar")
    add("--eval-freq", type=_ONE_OR_DEFAULT, default=25_000, metavar="N", help="evaluate every N steps; -1: never")
    add("--eval-episodes", type=_ONE, default=5, metavar="N", help="episodes of an evaluation (default %(default)s)")
    add(
        "--best-by",
        default="mean_reward",
        metavar="WHAT",
        help="what makes best_model.zip the best in an evaluation: the team's mean_reward (default), success_rate, or "
        "the name of an agent for its return",
    )
    add("--resume", nargs="?", const="", metavar="RUN", help="resume a run (default: the newest)")
    add("-i", "--trained-agent", default="", metavar="MODEL", help="continue the training of a model's zip file")
    rare("--eval-env-kwargs", **_PAIRS, help="arguments of the evaluation environment, merged over --env-kwargs")
    rare("--n-eval-envs", type=integer(1, high=MOST_COPIES), default=1, metavar="N", help="environments of evaluations")
    rare("--checkpoint-every", type=int, metavar="N", help="steps between checkpoints; 0: none (default: by time)")
    rare("--save-freq", type=_ONE_OR_DEFAULT, default=-1, metavar="N", help="save the model every N steps")
    rare("--save-replay-buffer", action="store_true", help="save the replay buffer beside the model")
    rare("--vec-env", choices=["dummy", "subproc"], default="dummy", help="kind of vectorised environment")
    rare("--device", default="auto", help="PyTorch's device")
    rare("--num-threads", type=_ONE_OR_DEFAULT, default=1, metavar="N", help="PyTorch's threads; -1: its own default")
    rare("--log-interval", type=integer(-2), default=-1, metavar="N", help="episodes between tables; -2: none")
    rare("--verbose", type=integer(0), default=1, help="0: no tables, 1: tables, 2: more")
    rare("-uuid", "--uuid", action="store_true", help="name the run's folder uniquely")
    rare("--truncate-last-trajectory", type=_flag, default=True, help="for HerReplayBuffer, when it is loaded")
    rare("--engine", default="local", help=f"{', '.join(ENGINES)}: where --seeds and --jobs run (default %(default)s)")
    rare("--address", help="a running Ray cluster: auto, or HOST:PORT (default: one on this machine)")
    rare("--track", action="store_true", help="log to Weights & Biases")
    rare("--wandb-project-name", default="sb3", help="its project (default %(default)s)")
    rare("--wandb-entity", help="its team")
    rare("--wandb-group", help="its group of runs")
    rare("-tags", "--wandb-tags", nargs="+", default=[], help="its tags")
    rare("-optimize", "--optimize-hyperparameters", action="store_true", help="the same as the command tune")
    rare("--trial-id", type=integer(0), metavar="N", help="train with the hyperparameters of a trial of a study")
    for option, description in {**_STORED, **_SEARCHED}.items():
        rare(option, **description)


def tuning_options(parser: Parser) -> None:
    """Add the options of ``tune``, which are those of ``train``."""
    training_options(parser)
    parser.set_defaults(optimize_hyperparameters=True)
    parser.frequent({*_STORED, "--n-trials", "--sampler", "--pruner"})


_STORED: dict[str, dict[str, Any]] = {
    "--storage": {"type": _storage, "help": "FILE.log or the URL of a database, where a study is kept"},
    "--study-name": {"help": "name of the study, which workers share"},
}
_SEARCHED: dict[str, dict[str, Any]] = {
    "--n-trials": {"type": _ONE, "default": 500, "metavar": "N", "help": "trials of this worker"},
    "--max-total-trials": {"type": _ONE, "metavar": "N", "help": "trials of all workers"},
    "--n-startup-trials": {"type": integer(0), "default": 10, "metavar": "N", "help": "random trials at first"},
    "--n-evaluations": {
        "type": _ONE,
        "metavar": "N",
        "help": "evaluations of a trial (default: one per 100,000 steps)",
    },
    "--n-jobs": {"type": _ONE_OR_DEFAULT, "default": 1, "metavar": "N", "help": "threads of this worker"},
    "--sampler": {"choices": ["random", "tpe", "auto"], "default": "tpe", "help": "Optuna's sampler"},
    "--pruner": {"choices": ["halving", "median", "none"], "default": "median", "help": "Optuna's pruner"},
    "--optimization-log-path": {"metavar": "DIR", "help": "folder for the best model and evaluations of each trial"},
    "--no-optim-plots": {"action": "store_true", "help": "show no plots at the end"},
}


def _flag(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"{shown(text)}: write true or false")
    return text.lower() == "true"


def showing_options(parser: Parser, records: bool = False) -> None:
    """Add the options of ``enjoy`` and ``record``."""
    task_options(parser)
    add, rare = parser.add_argument, parser.rare
    add("-f", "--folder", default="logs", metavar="DIR", help="folder of the runs (default %(default)s)")
    add(
        "-n",
        "--n-timesteps",
        type=integer(1, high=2**63 - 1),
        default=1000,
        metavar="N",
        help="number of steps (default %(default)s)",
    )
    add(
        "--exp-id",
        type=int,
        default=0,
        metavar="N",
        help="number of the run; 0: the newest with a model, -1: no folder of its own",
    )
    add("--env-kwargs", **_PAIRS, help="arguments of the environment, merged over those of the training")
    add("--seed", type=int, default=0, help="random seed (default %(default)s)")
    add("--load-best", action="store_true", help="the best model instead of the last")
    add("--no-render", action="store_true", help="show nothing")
    if records:
        add("-o", "--output-folder", metavar="DIR", help="folder of the video (default: that of the run)")
    rare("--load-checkpoint", type=int, metavar="N", help="the model that --save-freq saved at step N")
    rare("--load-last-checkpoint", action="store_true", help="the last model that --save-freq saved")
    rare("--n-envs", type=integer(1, high=MOST_COPIES), default=1, metavar="N", help="number of environments")
    rare("--deterministic", action="store_true", help="choose the most probable actions (default, except in Atari)")
    rare("--stochastic", action="store_true", help="sample actions")
    rare("--device", default="auto", help="PyTorch's device")
    rare("--num-threads", type=_ONE_OR_DEFAULT, default=-1, metavar="N", help="PyTorch's threads")
    if not records:
        add("-P", "--progress", action="store_true", help="show a progress bar")
        rare("--norm-reward", action="store_true", help="normalise rewards as in training")
        rare("--reward-log", default="", metavar="DIR", help="folder for the rewards")
        rare("--verbose", type=integer(0), default=1, help="0: print nothing")


def recording_options(parser: Parser) -> None:
    """Add the options of ``record``."""
    showing_options(parser, records=True)


def bench_options(parser: Parser) -> None:
    """Add the options of ``bench``, which are those of ``train`` and ``--json``."""
    training_options(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result; - is the standard output")
    parser.set_defaults(seed=0, eval_freq=-1, verbose=0, checkpoint_every=0)


def pretrained_options(parser: Parser) -> None:
    """Add the options of ``pretrained``."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="a pretrained model; default: list all")
    parser.add_argument("--out", type=Path, metavar="DIR", help="copy the model's folder to DIR/NAME")


def convert_options(parser: Parser) -> None:
    """Add the options of ``convert``."""
    parser.description = (
        "Convert a model's file to this version's format, which runs no code when it is loaded. Reading an older file "
        "may run the code it holds, and therefore needs --trust."
    )
    parser.add_argument("old", type=Path, metavar="OLD.zip")
    parser.add_argument("new", type=Path, metavar="NEW.zip")
    parser.add_argument("--algo", choices=ALGORITHMS, default="maddpg", help="its algorithm (default %(default)s)")
    parser.add_argument("--lean", choices=("actor", "critic"), help="keep only the actors, or the critics too")


def publish_options(parser: Parser) -> None:
    """Add the options of ``publish``."""
    parser.description = (
        "Upload a model to the Hugging Face Hub: a file that runs no code when it is loaded, a model card, and the "
        "recipe and evaluations of its run. Log in first with `hf auth login`."
    )
    parser.add_argument("model", metavar="MODEL.zip", help="or latest:LOGDIR, pretrained:NAME")
    parser.add_argument("repository", metavar="NAME/REPOSITORY")
    parser.add_argument("--algo", default="maddpg", choices=ALGORITHMS, help="default %(default)s")
    parser.add_argument("--env", default="QuadSwarm-v0", help="for latest:LOGDIR (default %(default)s)")
    parser.add_argument("--whole", action="store_true", help="include everything that training needs to resume")
    parser.add_argument("--private", action="store_true", help="make a new repository private")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write it all into this folder instead")


_BROKEN = "--gym-packages {0}: it is there, but cannot be imported ({1}): repair it, or install what it needs."


def import_packages(names: Iterable[str]) -> None:
    """
    Import the packages of ``--gym-packages``.

    :param names: names of packages or modules
    :raises InvalidArgumentError: if a name is not the name of a module
    :raises ImportError: if a package or one of its dependencies is missing, or it raises an error
    """
    for name in names:
        if not all(part.isidentifier() for part in name.split(".")):
            raise InvalidArgumentError(f"--gym-packages {shown(name)}: write the names of packages as after `import`.")
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
def importing_from(folder: Path | None, names: Iterable[str] = ()) -> Iterator[None]:
    """
    Import the modules of a folder, after all others, only if ``--gym-packages``, ``--env`` or ``--algo MODULE:CLASS``
    names one of them, so that names in a recipe are never imported from there by accident. Nothing else is imported
    from the current folder.

    :param folder: the folder
    :param names: values of these options
    """
    tops = {re.split(r"[./:]", name)[0] for name in names} - {""}
    asked = folder is not None and any((folder / f"{top}.py").is_file() or (folder / top).is_dir() for top in tops)
    here, before = Path.cwd(), sys.path.copy()
    sys.path[:] = [path for path in before if Path(path).resolve() != here] + [str(folder)] * asked
    try:
        yield
    finally:
        sys.path[:] = before


def files_beside(path: str, pattern: str) -> list[str]:
    """
    :param path: path of a file, which may not exist
    :param pattern: glob pattern of file names
    :return: the matching files in its folder
    """
    return [str(found) for found in Path(path).parent.glob(pattern)]


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
