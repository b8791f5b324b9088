"""``sb3-maddpg train|tune|enjoy|record``: rl_zoo3 with MADDPG, MATD3, MASAC, IDDPG and the installed environments."""

import argparse
import difflib
import functools
import os
import re
import runpy
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, cast

import gymnasium
import yaml
from gymnasium.envs.registration import load_env_creator

try:
    import rl_zoo3.enjoy
    import rl_zoo3.train
    import rl_zoo3.utils
    import torch.utils.tensorboard  # noqa: F401
except ImportError as error:
    raise ImportError(f"{error}. This needs the extra 'zoo': in the clone, pip install -e '.[zoo]'.") from error
from huggingface_sb3 import EnvironmentName
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_maddpg.checkpoints.commit import newest
from sb3_maddpg.cli import pettingzoo_ids
from sb3_maddpg.cli.command_files import COMMAND_FILE, latest_run_number, read_command, recipe_of, resumable
from sb3_maddpg.cli.experiment import CHECKPOINTS, Checkpoints, TeamExperimentManager
from sb3_maddpg.cli.interrupts import noticed_interrupts
from sb3_maddpg.cli.literals import StoreValues
from sb3_maddpg.cli.options import (
    PROG,
    common_options,
    did_you_mean,
    helps,
    import_packages,
    importing_from,
    modules_beside,
)
from sb3_maddpg.cli.overview import ALGORITHMS, load_environments, overview, packaged_recipes
from sb3_maddpg.cli.parameter_sharing import SharedPolicy, shares_parameters
from sb3_maddpg.cli.processes import ENGINES
from sb3_maddpg.cli.recipes import LengthOption, check_env_kwargs, check_options
from sb3_maddpg.cli.safety import check_links, check_words, no_code_from_files, run_settings, shown_with
from sb3_maddpg.cli.search import search
from sb3_maddpg.cli.seeds import parse_seeds, train_seeds
from sb3_maddpg.cli.tuning import convert_params, sample_maddpg_params, sample_masac_params, sample_matd3_params
from sb3_maddpg.files.model_files import trusted
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.utils import suggest


def register() -> None:
    """Register the algorithms and all installed environments in rl_zoo3."""
    ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER.update(dict.fromkeys(ALGORITHMS, sample_maddpg_params))
    HYPERPARAMS_SAMPLER.update(matd3=sample_matd3_params, masac=sample_masac_params)
    HYPERPARAMS_CONVERTER.update(dict.fromkeys(ALGORITHMS, convert_params))
    rl_zoo3.train.ExperimentManager = TeamExperimentManager  # type: ignore[misc]
    for module in (rl_zoo3.train, rl_zoo3.enjoy, rl_zoo3.utils):  # record imports it from the last
        module.StoreDict = StoreValues  # type: ignore[attr-defined]
    load_environments()


def _call(function: Callable[[], Any], command: str, argv: list[str]) -> None:
    """Call a command of rl_zoo3, which reads its arguments from ``sys.argv``."""
    saved, sys.argv = sys.argv, [f"{PROG} {command}", *argv]
    try:
        with no_code_from_files():
            function()
    finally:
        sys.argv = saved


def packaged_config(algo: str, env_id: str) -> str | None:
    """
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :return: path of the packaged recipe for both, None if there is none
    """
    path = packaged_recipes().get(f"{algo}.yml")
    if path is not None and not {env_id, "default"}.isdisjoint(yaml.safe_load(path.read_text())):
        return str(path)
    return None


def train(argv: list[str], name: str = "") -> int:
    """
    Train like rl_zoo3, but with checkpoints and, by default, with the packaged recipe.

    :param argv: arguments of the command
    :param name: name of the command on the screen, by default train or tune
    :return: exit status
    """
    name = name or ("tune" if "-optimize" in argv else "train")
    resuming = _resuming(name)
    asked, argv = resuming.parse_known_args(argv)
    if helps(argv):
        import_packages(common_options().parse_known_args(argv)[0].gym_packages)
        print(f"{overview()}\n\n{resuming.format_help()}\nrl_zoo3's options:\n")
    if not asked.log_folder:
        raise ValueError("--log-folder is empty: name a folder, or leave it out for `logs`.")
    if asked.checkpoint_every is not None and asked.checkpoint_every < 0:
        raise ValueError(
            f"--checkpoint-every {asked.checkpoint_every}: pass a number of steps, or 0 for no checkpoints."
        )
    if name == "tune" and asked.jobs == 1:  # a single worker has no one to share a study with
        asked.jobs = None
    processes = asked.jobs is not None or asked.engine != "local" or asked.address is not None
    if asked.seeds is not None or processes:
        return _in_processes(name, asked, argv)
    checkpoints: Checkpoints | None = None
    if asked.resume is not None:
        checkpoints, argv, folder = _resumed(asked, argv)
        with importing_from(folder, argv):
            return _train(name, argv, checkpoints)
    argv = [*argv, "--log-folder", asked.log_folder]
    if asked.checkpoint_every != 0:
        checkpoints = Checkpoints(asked.checkpoint_every, resumable(argv))
    return _train(name, argv, checkpoints)


def _train(name: str, argv: list[str], checkpoints: Checkpoints | None) -> int:
    """Train in this process."""
    known, rest = common_options().parse_known_args(argv)
    if not helps(rest):
        _check(known)
    # One thread by default: a second speeds up small networks little, and slows them down if the core is not idle
    argv = ["--algo", known.algo, "--num-threads", "1", *argv]
    recipe = recipe_of(argv)
    if recipe is not None and not recipe.is_file():
        argv += _packaged(recipe)
    if known.env is not None and recipe is None:
        path = packaged_config(known.algo, known.env)
        argv += ["--conf-file", path] if path is not None else []
    manager = rl_zoo3.train.ExperimentManager
    with_checkpoints: Any = functools.partial(cast(Any, manager), checkpoints=checkpoints, given_seed=_seed_of(argv))
    rl_zoo3.train.ExperimentManager = with_checkpoints  # type: ignore[misc]
    try:
        _call(rl_zoo3.train.train, name, argv)
    finally:
        rl_zoo3.train.ExperimentManager = manager  # type: ignore[misc]
    return 0


def _seed_of(argv: list[str]) -> int | None:
    """:return: value of ``--seed``; rl_zoo3 replaces a missing or negative one by a random number"""
    parser = argparse.ArgumentParser(add_help=False)  # rl_zoo3 accepts abbreviations
    parser.add_argument("--seed", default="")
    seed = parser.parse_known_args(argv)[0].seed
    return int(seed) if re.fullmatch(r"[0-9]{1,18}", seed) else None


def _packaged(recipe: Path) -> list[str]:
    """:return: the option for a packaged recipe, given its name; empty if there is none"""
    packaged = packaged_recipes().get(str(recipe))
    return ["--conf-file", str(packaged)] if packaged is not None else []


def _in_processes(name: str, asked: argparse.Namespace, argv: list[str]) -> int:
    """Run trainings of several seeds, or the workers of a search, in processes of their own."""
    if asked.seeds is None and name != "tune":
        raise ValueError("--jobs, --engine and --address are for --seeds: a single training runs in this process.")
    if asked.resume is not None:
        raise ValueError("--resume continues one run; --seeds resumes the runs of its command automatically.")
    if asked.seeds is None:
        return search(argv, 1 if asked.jobs is None else asked.jobs, asked.log_folder, asked.engine, asked.address)
    seeds, jobs = parse_seeds(asked.seeds), os.cpu_count() or 1 if asked.jobs is None else asked.jobs
    return train_seeds(argv, seeds, jobs, asked.log_folder, asked.checkpoint_every, asked.engine, asked.address)


def _resuming(name: str) -> argparse.ArgumentParser:
    """:return: a parser of the options that rl_zoo3 does not have"""
    parser = argparse.ArgumentParser(prog=f"{PROG} {name}", add_help=False, allow_abbrev=False, usage=argparse.SUPPRESS)
    group = parser.add_argument_group("options in addition to rl_zoo3's")
    group.add_argument("--checkpoint-every", type=int, metavar="STEPS", help="0 for none (default: by time)")
    group.add_argument("--resume", nargs="?", const="", metavar="RUN", help="resume a run (default: the newest)")
    group.add_argument(
        "-f", "--log-folder", default="logs", metavar="DIR", help="folder of the runs (default %(default)s)"
    )
    group.add_argument("--seeds", metavar="0-9", help="train once per seed")
    group.add_argument(
        "--jobs", type=int, help="number of parallel trainings of --seeds (default: one per core), or workers of tune"
    )
    group.add_argument("--engine", default="local", help=f"{', '.join(ENGINES)}: where they run (default local)")
    group.add_argument("--address", help="a running Ray cluster: auto, or HOST:PORT (default: one on this machine)")
    return parser


def _resumed(asked: argparse.Namespace, argv: list[str]) -> tuple[Checkpoints, list[str], Path | None]:
    """
    :return: the checkpoints of the run that ``--resume`` names, by default the newest; the run's command; and the
        folder from which that may import modules
    """
    if argv:
        raise ValueError(f"--resume uses the command of the run: leave out {' '.join(argv)}.")
    run = Path(asked.resume)
    if not asked.resume:
        runs = [path.parent for path in Path(asked.log_folder).glob(f"*/*/{CHECKPOINTS}")]
        if not runs:
            raise ValueError(f"--resume: no run in {asked.log_folder} has checkpoints; pass the folder of a run.")
        run = max(runs, key=lambda path: path.stat().st_mtime)
    command = read_command(run)
    path = newest(run / CHECKPOINTS)
    if path is None:
        raise ValueError(f"{run} has no complete checkpoint.")
    folder = Path.cwd() if command.folder is None and trusted(None) else command.folder
    if folder is None:
        check_links(run)
        check_words(command.argv, run, str(run / COMMAND_FILE))
    words = [*command.argv, "-i", str(path / "model.zip")]
    if command.folder is not None and (recipe := recipe_of(words)) is not None:
        words += _packaged(recipe)  # a file of this name in the current folder is not the one that was meant
    checkpoints = Checkpoints(asked.checkpoint_every or command.every, command.argv, run, foreign=folder is None)
    return checkpoints, words, folder


def _show(command: str, function: Callable[[], Any], argv: list[str]) -> int:
    """Show a trained model in an environment with the arguments of its training."""
    # With abbreviations, which rl_zoo3 accepts: it must open the run that was checked here
    parser = argparse.ArgumentParser(add_help=False, parents=[common_options()])
    parser.add_argument("-f", "--folder", default="logs")
    parser.add_argument("--exp-id", type=int, default=0)
    parser.add_argument("--n-timesteps", "-n", type=int, default=1000)
    parser.add_argument("--env-kwargs", nargs="+", action=StoreValues, default={})
    known, rest = parser.parse_known_args(argv)
    rest += ["--n-timesteps", str(known.n_timesteps)]
    exp_id, algorithm, shows = known.exp_id, None, cast("AbstractContextManager[None]", nullcontext())
    if not helps(rest):
        check_options(known, LengthOption)
        _check(known)
        name, folder = EnvironmentName(known.env), Path(known.folder, known.algo)
        exp_id = known.exp_id or latest_run_number(str(folder), name)
        settings, env_kwargs = run_settings(
            folder / f"{name}_{exp_id}" if exp_id > 0 else folder, known.env, known.env_kwargs
        )
        check_env_kwargs(known.env, env_kwargs)
        shows = shown_with(settings, env_kwargs)
        rest += ["--env", known.env, *(["--env-kwargs", "merged"] if env_kwargs else [])]
        if command == "enjoy" and "--no-render" not in rest:
            reason = "there is no display" if _is_headless() else f"{known.env} has no window to show"
            if _is_headless() or not _has_window(known.env, env_kwargs):
                print(f"Only the rewards are printed: {reason}. `record` makes a video.")
                rest.append("--no-render")
        if shares_parameters(ALGOS[known.algo], known.env):
            algorithm = ALGOS[known.algo]
            ALGOS[known.algo] = SharedPolicy.loader(algorithm.load)
    words = ["--algo", known.algo, "--folder", known.folder, "--exp-id", str(exp_id), *rest]
    try:
        with noticed_interrupts() as pressed, shows:
            _call(function, command, words)
    finally:
        if algorithm is not None:
            ALGOS[known.algo] = algorithm
    if pressed.is_set():
        raise KeyboardInterrupt
    return 0


def enjoy(argv: list[str]) -> int:
    """Watch a trained model."""
    return _show("enjoy", rl_zoo3.enjoy.enjoy, argv)


def record(argv: list[str]) -> int:
    """Record a trained model on video."""
    # This module of rl_zoo3 is a script
    return _show("record", lambda: runpy.run_module("rl_zoo3.record_video", run_name="__main__"), argv)


def _check(known: argparse.Namespace) -> None:
    """Check that the algorithm and the environment exist, and register a PettingZoo module in Gymnasium."""
    if known.algo not in ALGOS:
        raise ValueError(suggest("algorithm", known.algo, ALGOS))
    if known.env is None:
        raise ValueError(
            "--env is missing: pass the id of a Gymnasium environment, or PACKAGE/MODULE of a PettingZoo environment."
        )
    import_packages(known.gym_packages)
    if pettingzoo_ids.register(known.env):
        return
    package, slash, _ = known.env.rpartition("/")
    ids = pettingzoo_ids.siblings(known.env) or list(gymnasium.registry)
    if slash and not any(name.startswith(f"{package}/") for name in ids):
        raise ValueError(
            f"Unknown environment '{known.env}': there is no module {known.env.replace('/', '.')} with a function "
            "parallel_env, as PettingZoo's modules have. Is its package installed or in this folder?"
            f"{did_you_mean(package, modules_beside(package))}"
        )
    if difflib.get_close_matches(known.env, ids, n=1):
        raise ValueError(suggest("environment", known.env, ids))
    nearest = ", ".join(difflib.get_close_matches(known.env, ids, n=3, cutoff=0))
    raise ValueError(
        f"Unknown environment '{known.env}'. The nearest ids are {nearest}. A PettingZoo environment is "
        "PACKAGE/MODULE, or MODULE for a file in this folder, with a function parallel_env. --gym-packages imports "
        "packages that register other environments."
    )


def _is_headless() -> bool:
    """:return: whether there is no display; setting SDL_VIDEODRIVER allows windows without one"""
    known = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    return sys.platform.startswith("linux") and not any(os.environ.get(name) for name in known)


def _has_window(env_id: str, env_kwargs: dict[str, Any]) -> bool:
    spec = gymnasium.spec(env_id)
    if spec.entry_point == parallel.ENTRY_POINT:
        # Only an instance of the environment knows its render modes
        env = parallel.make(**{**spec.kwargs, **env_kwargs})
        env.close()
        return "human" in env.metadata["render_modes"]
    creator = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    return "human" in getattr(creator, "metadata", {}).get("render_modes", ["human"])


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "tune": lambda argv: train(["-optimize", *argv]),
    "enjoy": enjoy,
    "record": record,
}


if __name__ == "__main__":
    sys.exit(f"error: this module is not a command: use `{PROG} train` or `python -m sb3_maddpg train`.")
