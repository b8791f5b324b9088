"""``python -m sb3_maddpg.zoo train|enjoy|record|evaluate``: rl_zoo3 with MADDPG, MATD3, the installed environments."""

import argparse
import importlib
import runpy
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoints, entry_points
from importlib.resources import files
from pathlib import Path
from typing import Any

import gymnasium
import yaml
from gymnasium.envs.registration import load_env_creator

try:
    import rl_zoo3.enjoy
    import rl_zoo3.train
except ImportError as error:
    raise ImportError(f"{error}. The zoo needs its own packages: pip install 'sb3-maddpg[zoo]'.") from error
from huggingface_sb3 import EnvironmentName
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS, StoreDict, get_latest_run_id, get_saved_hyperparams

from sb3_maddpg import MADDPG, parallel
from sb3_maddpg.experiment import TeamExperimentManager
from sb3_maddpg.matd3 import MATD3
from sb3_maddpg.tuning import convert_params, sample_maddpg_params, sample_matd3_params
from sb3_maddpg.utils import suggest

USAGE = """\
Train, watch and compare teams with rl_zoo3; MADDPG, MATD3 and the installed environments are registered.

  train     train a model and evaluate it now and then
  enjoy     watch a trained model
  record    record a trained model on video
  evaluate  compare policies with the environment's own evaluator; `latest:LOGDIR` stands for the newest model there

`<command> --help` lists a command's options, which are those of rl_zoo3. What differs: --algo is maddpg unless given
(or matd3), the packaged recipe is used unless --conf-file is given, --env-kwargs are merged over the recipe's,
--num-threads is 1 unless given, and -i MODEL.zip continues the training where it ended. --env PACKAGE/MODULE is a
PettingZoo environment; its --env-kwargs are those of its parallel_env, `state:True` for critics that read the global
state, and `wrappers`."""
EPILOG = """\
examples:
  python -m sb3_maddpg.zoo train --env QuadSwarm-v0 --progress --tensorboard-log logs/tensorboard
  python -m sb3_maddpg.zoo train --env OwnBit-v0
  python -m sb3_maddpg.zoo train --algo matd3 --env mpe2/simple_spread_v3
  python -m sb3_maddpg.zoo train --env mpe2/simple_spread_v3 --env-kwargs continuous_actions:False
  python -m sb3_maddpg.zoo train -optimize --env OwnBit-v0 --n-trials 50 --storage logs/tune.log --study-name a
  python -m sb3_maddpg.zoo evaluate --env QuadSwarm-v0 --policy none full latest:logs --scenario all"""

# Mistakes in what the user gave. Their messages say what to do, so one line is enough.
USER_ERRORS = (ValueError, FileNotFoundError, AssertionError, gymnasium.error.Error)


def register() -> None:
    """Make the algorithms and every installed environment known to rl_zoo3, whose command line reads these dicts."""
    ALGOS.update({"maddpg": MADDPG, "matd3": MATD3})
    HYPERPARAMS_SAMPLER.update({"maddpg": sample_maddpg_params, "matd3": sample_matd3_params})
    HYPERPARAMS_CONVERTER.update(dict.fromkeys(("maddpg", "matd3"), convert_params))
    rl_zoo3.train.ExperimentManager = TeamExperimentManager  # type: ignore[misc]
    importlib.import_module("sb3_maddpg.team_tasks")
    for entry_point in entry_points(group="sb3_maddpg.environments"):
        entry_point.load()


def _parser(**kwargs: Any) -> argparse.ArgumentParser:
    """The options that the zoo itself looks at; rl_zoo3 or the evaluator reads the rest."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, **kwargs)
    parser.add_argument("--algo", default="maddpg")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    return parser


def _call(function: Callable[[], Any], command: str, argv: list[str]) -> None:
    """rl_zoo3's commands read ``sys.argv`` and have no other way in."""
    saved, sys.argv = sys.argv, [f"python -m sb3_maddpg.zoo {command}", *argv]
    try:
        function()
    finally:
        sys.argv = saved


def packaged_config(algo: str, env_id: str) -> str | None:
    """
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :return: path of the packaged recipe for the two, if there is one
    """
    path = Path(str(files("sb3_maddpg.zoo_configs") / f"{algo}.yml"))
    if path.is_file() and not {env_id, "default"}.isdisjoint(yaml.safe_load(path.read_text())):
        return str(path)
    return None


def train(argv: list[str]) -> int:
    """Train as rl_zoo3 does, by the packaged recipe unless another is given."""
    parser = _parser()
    parser.add_argument("-conf", "--conf-file")
    known, rest = parser.parse_known_args(argv)
    if known.env is not None and not {"-h", "--help"} & set(rest):
        _find_env(known.env, known.gym_packages)
    # One thread unless asked otherwise: small networks gain nothing by a second and lose badly where it is not free.
    argv = ["--algo", known.algo, "--num-threads", "1", *argv]
    if known.env is not None and known.conf_file is None:
        path = packaged_config(known.algo, known.env)
        argv += ["--conf-file", path] if path is not None else []
    _call(rl_zoo3.train.train, "train", argv)
    return 0


def _replay(command: str, function: Callable[[], Any], argv: list[str]) -> int:
    """Show a trained model in an environment with the arguments it was trained with."""
    parser = _parser()
    parser.add_argument("-f", "--folder", default="logs")
    parser.add_argument("--exp-id", type=int, default=0)
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict, default={})
    known, rest = parser.parse_known_args(argv)
    if known.env is not None and not {"-h", "--help"} & set(rest):
        _find_env(known.env, known.gym_packages)
        name = EnvironmentName(known.env)
        exp_id = known.exp_id or get_latest_run_id(str(Path(known.folder, known.algo)), name)
        run = Path(known.folder, known.algo, f"{name}_{exp_id}" if exp_id > 0 else "")
        hyperparams, _ = get_saved_hyperparams(str(run / name))
        env_kwargs = {**hyperparams.get("env_kwargs", {}), **known.env_kwargs}
        rest += ["--env", known.env]
        # rl_zoo3 reads these values as Python; its own merging forgets some of them
        rest += ["--env-kwargs", *(f"{key}:{value!r}" for key, value in env_kwargs.items())] if env_kwargs else []
        if command == "enjoy" and "--no-render" not in rest and not _has_window(known.env, env_kwargs):
            print(f"{known.env} has no window to show: only the rewards are printed. `record` makes a video.")
            rest.append("--no-render")
    _call(function, command, ["--algo", known.algo, "--folder", known.folder, "--exp-id", str(known.exp_id), *rest])
    return 0


def enjoy(argv: list[str]) -> int:
    """Watch a trained model."""
    return _replay("enjoy", rl_zoo3.enjoy.enjoy, argv)


def record(argv: list[str]) -> int:
    """Record a trained model on video."""
    # A script without a function to call
    return _replay("record", lambda: runpy.run_module("rl_zoo3.record_video", run_name="__main__"), argv)


def evaluate(argv: list[str]) -> int:
    """Hand over to the evaluator that a package offers for its environment."""
    evaluators = entry_points(group="sb3_maddpg.evaluators")
    parser = _parser(prog="python -m sb3_maddpg.zoo evaluate")
    known, rest = parser.parse_known_args(argv)
    if known.env is None:
        parser.error(f"--env is needed, one of: {', '.join(sorted(evaluators.names))}; further options are its own")
    for package in known.gym_packages:
        importlib.import_module(package)
    main = _evaluator(evaluators, known.env)
    rest = [latest_model(word, known.algo, known.env) if word.startswith("latest:") else word for word in rest]
    if known.algo != "maddpg":
        if known.algo not in ALGOS:
            raise ValueError(suggest("algorithm", known.algo, ALGOS))
        algorithm = ALGOS[known.algo]
        rest += ["--algo", f"{algorithm.__module__}:{algorithm.__qualname__}"]
    return main(rest)


def _evaluator(evaluators: EntryPoints, env_id: str) -> Callable[[list[str]], int]:
    if env_id not in evaluators.names:
        raise ValueError(suggest("environment with an evaluator", env_id, evaluators.names))
    return evaluators[env_id].load()


def latest_model(word: str, algo: str, env_id: str) -> str:
    """
    :param word: ``latest:LOGDIR``
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :return: the final model of the newest run that has one, else its best model so far
    """
    folder, name = Path(word.removeprefix("latest:"), algo), EnvironmentName(env_id)
    runs = [path for path in folder.glob(f"{name}_*") if path.name[len(name) + 1 :].isdigit()]
    for run in sorted(runs, key=lambda path: int(path.name[len(name) + 1 :]), reverse=True):
        for model in (run / f"{name}.zip", run / "best_model.zip"):
            if model.is_file():
                return str(model)
    raise FileNotFoundError(
        f"{word}: no trained model of {algo} for {env_id} in {folder}. Train one with "
        f"`python -m sb3_maddpg.zoo train --algo {algo} --env {env_id} --log-folder {folder.parent}`."
    )


def _find_env(env_id: str, packages: list[str]) -> None:
    """Make the environment known to Gymnasium: one that is registered, or a PettingZoo module."""
    for package in packages:
        importlib.import_module(package)
    if parallel.register(env_id):
        return
    package, slash, _ = env_id.rpartition("/")
    known = parallel.siblings(env_id) or gymnasium.registry
    if slash and not any(name.startswith(f"{package}/") for name in known):
        raise ValueError(
            f"Unknown environment '{env_id}': there is no module {env_id.replace('/', '.')} with a function "
            "parallel_env, as PettingZoo's have. Is its package installed?"
        )
    raise ValueError(suggest("environment", env_id, known))


def _has_window(env_id: str, env_kwargs: dict[str, Any]) -> bool:
    spec = gymnasium.spec(env_id)
    if spec.entry_point == parallel.ENTRY_POINT:
        # Only the environment itself knows
        env = parallel.make(**{**spec.kwargs, **env_kwargs})
        env.close()
        return "human" in env.metadata["render_modes"]
    creator = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    return "human" in getattr(creator, "metadata", {}).get("render_modes", ["human"])


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "enjoy": enjoy,
    "record": record,
    "evaluate": evaluate,
}


def main(argv: list[str] | None = None) -> int:
    """
    :param argv: arguments, those of the command line by default
    :return: exit status, 2 for a mistake in what the user gave
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_maddpg.zoo",
        description=USAGE,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument("command", choices=COMMANDS)
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="options of the command")
    arguments = parser.parse_args(argv)
    command, rest = arguments.command, arguments.arguments
    debug = arguments.debug or "--debug" in rest
    try:
        register()
        # rl_zoo3 has no such option, an evaluator may have one
        return COMMANDS[command](rest if command == "evaluate" else [word for word in rest if word != "--debug"])
    except USER_ERRORS as error:
        if debug:
            raise
        print(f"error: {error or type(error).__name__} (--debug shows the traceback)", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
