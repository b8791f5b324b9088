"""``sb3-maddpg enjoy`` and ``record``: a trained model in the environment of its training."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecVideoRecorder, unwrap_vec_normalize
from tqdm import tqdm

from sb3_maddpg.cli.algorithms import algorithm
from sb3_maddpg.cli.environments import STATISTICS, Environments, find_environment, is_stochastic
from sb3_maddpg.cli.literals import parse_literal
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.cli.parameter_sharing import SharedPolicy, shares_parameters
from sb3_maddpg.cli.recipe import check_env_kwargs, check_shown
from sb3_maddpg.cli.runs import name_of, runs_of
from sb3_maddpg.cli.safety import check_links, check_names, check_paths, read_settings
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.files.model_files import refuse_pickled, trusted
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.utils import shown

# A model is shown without them, so that files of older versions need not hold them
_UNUSED: dict[str, Any] = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}


def enjoy(args: argparse.Namespace, words: list[str]) -> int:
    """
    Watch a trained model.

    :param args: options of ``enjoy``
    :param words: unused
    :return: exit status
    :raises KeyboardInterrupt: after the summary, if the command was interrupted
    """
    model, env, _ = _prepare(args, renders=not args.no_render, monitor=args.reward_log or None)
    returns, lengths, successes = [], [], []
    total, length, says = 0.0, 0, args.verbose > 0
    try:
        with _closed(env):
            for rewards, dones, infos in _steps(model, env, args):
                if not args.no_render:
                    env.render("human")
                total, length = total + float(rewards[0]), length + 1
                if not dones[0] or args.n_envs > 1:
                    continue
                if says:
                    print(f"Episode Reward: {total:.2f}\nEpisode Length {length}")
                returns.append(total)
                lengths.append(length)
                if (success := infos[0].get("is_success")) is not None:
                    successes.append(success)
                total, length = 0.0, 0
    finally:
        if says and successes:
            print(f"Success rate: {100 * np.mean(successes):.2f}%")
        if says and returns:
            print(f"{len(returns)} Episodes")
            print(f"Mean reward: {np.mean(returns):.2f} +/- {np.std(returns):.2f}")
            print(f"Mean episode length: {np.mean(lengths):.2f} +/- {np.std(lengths):.2f}")
    return 0


def record(args: argparse.Namespace, words: list[str]) -> int:
    """
    Record a trained model on video.

    :param args: options of ``record``
    :param words: unused
    :return: exit status
    """
    if find_spec("moviepy") is None:  # which would be missed at the end
        raise ImportError("record needs the extra 'render': in the clone, pip install -e '.[render]'.")
    model, env, (run, name) = _prepare(args, renders=True, render_mode="rgb_array")
    folder = args.output_folder or str(run / "videos")
    env = VecVideoRecorder(env, folder, lambda step: step == 0, video_length=args.n_timesteps, name_prefix=name)
    with _closed(env):
        for _ in _steps(model, env, args):
            if not args.no_render:
                env.render()
    return 0


@contextmanager
def _closed(env: VecEnv) -> Iterator[None]:
    try:
        yield
    finally:
        env.close()


def _steps(model: Any, env: VecEnv, args: argparse.Namespace) -> Iterator[tuple[np.ndarray, np.ndarray, list[dict]]]:
    """:return: rewards, ends of episodes and infos of each step"""
    deterministic = not (args.stochastic or (is_stochastic(args.env) and not args.deterministic))
    observations, state, starts = env.reset(), None, np.ones((env.num_envs,), dtype=bool)
    for _ in tqdm(range(args.n_timesteps), disable=not getattr(args, "progress", False)):
        actions, state = model.predict(observations, state=state, episode_start=starts, deterministic=deterministic)
        observations, rewards, starts, infos = env.step(actions)
        yield rewards, starts, infos


def _prepare(
    args: argparse.Namespace, renders: bool, monitor: str | None = None, render_mode: str = "human"
) -> tuple[Any, VecEnv, tuple[Path, str]]:
    """:return: the model, its environment, the folder of its run, and a name for files"""
    cls = algorithm(args.algo)
    load_environments()
    find_environment(args.env)
    name, logs = name_of(args.env), Path(args.folder, args.algo)
    number = args.exp_id or _newest_with_model(logs, name, args)
    run = logs / f"{name}_{number}" if number > 0 else logs
    settings, env_kwargs = run_settings(run, args.env, args.env_kwargs or {})
    check_env_kwargs(args.env, env_kwargs)
    if renders and render_mode == "human" and (reason := _no_window(args.env, env_kwargs)):
        print(f"Only the rewards are printed: {reason}. `record` makes a video.")
        args.no_render = True
    path, title = _model_path(run, name, args)
    print(f"Loading {path}")
    set_random_seed(args.seed)
    if args.num_threads > 0:
        th.set_num_threads(args.num_threads)
    if render_mode == "rgb_array":
        env_kwargs["render_mode"] = render_mode
    elif not args.no_render:
        env_kwargs.setdefault("render_mode", render_mode)
    statistics = run / name / STATISTICS
    if settings.get("normalize") and not statistics.exists():
        raise InvalidFileError(f"{statistics} is missing: the run normalises its observations with it.")
    shares = shares_parameters(cls, args.env)
    env = Environments(args.env, args.seed, settings, subproc=args.n_envs > 1).make(
        args.n_envs,
        env_kwargs,
        monitor=monitor,
        evaluates=True,
        statistics=statistics if settings.get("normalize") else None,
    )
    normalization = unwrap_vec_normalize(env)
    if normalization is not None and getattr(args, "norm_reward", False):
        normalization.norm_reward = True
    return (
        load_model(cls, path, shares, env, settings, args.seed, args.device),
        env,
        (run, f"{title}-{args.algo}-{name}"),
    )


def load_model(
    cls: Any, path: Path, shares: bool, env: VecEnv, settings: Mapping[str, Any], seed: int, device: str
) -> Any:
    """
    Load a model that acts, but is not trained on.

    :param cls: the algorithm
    :param path: the model's file
    :param shares: whether all agents share its policy, see ``shares_parameters``
    :param env: the environment in which it acts
    :param settings: settings of its run, see ``run_settings``
    :param seed: seed of its random numbers
    :param device: PyTorch's device
    :return: the model, or what acts with it for the whole team
    :raises ValueError: if the file is damaged, or is not trusted and may run code
    """
    kwargs: dict[str, Any] = {"seed": seed}
    if issubclass(cls, OffPolicyAlgorithm) and not issubclass(cls, TeamAlgorithm):
        kwargs |= {"buffer_size": 1, "optimize_memory_usage": False}  # nothing is stored
        if "HerReplayBuffer" in str(settings.get("replay_buffer_class", "")):
            kwargs["env"] = env
    if not trusted(None):
        refuse_pickled(path, _UNUSED)
    with warnings.catch_warnings():
        if settings.get("normalize"):  # as this environment does
            warnings.filterwarnings("ignore", ".* was trained with VecNormalize")
        model = cls.load(path, custom_objects=_UNUSED, device=device, **kwargs)
    return SharedPolicy(model) if shares else model


def run_settings(run: Path, env_id: str, given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Read what ``enjoy`` and ``record`` use of the settings of a run: its wrappers, normalisation and stacked frames, and
    the arguments of its environment.

    :param run: folder of the run
    :param env_id: Gymnasium id, which is registered
    :param given: arguments of the environment on the command line, which replace those of the run
    :return: settings for ``Environments``, and the arguments of the environment
    :raises ValueError: if a file is damaged, or is not trusted and may run code or write outside the run's folder
    """
    if not trusted(None):
        check_links(run)
    settings: dict[str, Any] = {}
    env_kwargs: dict[str, Any] = {}
    for name in ("args.yml", "config.yml"):
        path, is_config = run / name_of(env_id) / name, name == "config.yml"
        if not path.is_file():
            continue
        values = read_settings(path)
        if not is_config and "env_kwargs" not in values:
            raise InvalidFileError(f"{path} is damaged: it holds {shown(values)} instead of a run's settings.")
        keys = ("env_wrapper", "vec_env_wrapper", "env_kwargs") if is_config else ("env_kwargs",)
        if not trusted(None):
            used = {key: values.get(key) for key in keys}
            check_names(used, env_id, str(path))
            kwargs = parse_literal(used["env_kwargs"]) if isinstance(used["env_kwargs"], str) else used["env_kwargs"]
            if isinstance(kwargs, Mapping):
                used["env_kwargs"] = {key: one for key, one in kwargs.items() if key not in given}
            check_paths(used, run, str(path))
        checked = check_shown({key: values[key] for key in values if is_config or key in keys}, str(path))
        env_kwargs |= checked.pop("env_kwargs", None) or {}
        settings |= checked if is_config else {}
        if isinstance(buffer := values.get("replay_buffer_class"), str):
            settings["replay_buffer_class"] = buffer
    return settings, {**env_kwargs, **given}


def _newest_with_model(logs: Path, name: str, args: argparse.Namespace) -> int:
    """:return: number of the newest run that has the model, or of the newest, 0 without any"""
    runs = runs_of(logs, name)
    newest = next(iter(runs), 0)
    for number, run in runs.items():
        with suppress(FileNotFoundError):
            _model_path(run, name, args)
            if number != newest:
                print(f"Runs after {run.name} have no such model: they failed, or are not over.")
            return number
    return newest


def _model_path(run: Path, name: str, args: argparse.Namespace) -> tuple[Path, str]:
    """:return: path of the model, and what kind it is"""
    if not run.is_dir():
        raise FileNotFoundError(f"The {run} folder was not found: train a model, or pass its folder with -f.")
    path, title = run / f"{name}.zip", "final-model"
    if args.load_best:
        path, title = run / "best_model.zip", "best-model"
    elif args.load_checkpoint is not None:
        path, title = run / f"rl_model_{args.load_checkpoint}_steps.zip", f"checkpoint-{args.load_checkpoint}"
    elif args.load_last_checkpoint:
        steps = {
            int(one.stem.split("_")[-2]): one
            for one in run.glob("rl_model_*_steps.zip")
            if one.stem.split("_")[-2].isdecimal()
        }
        if not steps:
            raise FileNotFoundError(f"No checkpoint found for {args.algo} on {name} in {run}.")
        path, title = steps[max(steps)], f"checkpoint-{max(steps)}"
    if not path.is_file():
        raise FileNotFoundError(
            f"No model found for {args.algo} on {name}: there is no {path}. Train one with `train --algo {args.algo} "
            f"--env {args.env} -f {args.folder}`, or name its folder with -f, its run with --exp-id."
        )
    return path, title


def _no_window(env_id: str, env_kwargs: Mapping[str, Any]) -> str | None:
    """:return: why no window can be shown; setting SDL_VIDEODRIVER allows windows without a display"""
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in displays):
        return "there is no display"
    spec = gymnasium.spec(env_id)
    if spec.entry_point == parallel.ENTRY_POINT:
        # Only an instance of the environment knows its render modes
        env = parallel.make(**{**spec.kwargs, **env_kwargs})
        env.close()
        modes = env.metadata["render_modes"]
    else:
        creator = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
        modes = getattr(creator, "metadata", {}).get("render_modes", ["human"])
    return None if "human" in modes else f"{env_id} has no window to show"
