"""A recipe in an environment: what a training, a search and a measurement of speed have in common."""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule, set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.cli.algorithms import algorithm
from sb3_maddpg.cli.environments import Environments, find_environment
from sb3_maddpg.cli.literals import parse_literal
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.cli.parameter_sharing import shares_parameters
from sb3_maddpg.cli.recipe import SCHEDULES, check_env_kwargs, check_recipe, read_recipe, recipe_path
from sb3_maddpg.cli.runs import name_of
from sb3_maddpg.errors import InvalidArgumentError

# Keys of a recipe that say how to create environments
_OF_ENVIRONMENTS = ("env_wrapper", "vec_env_wrapper", "frame_stack", "monitor_kwargs", "normalize", "vec_env")
_OTHERS = ("n_timesteps", "n_envs", "callback", "env_kwargs", "eval_env_kwargs", "noise_type", "noise_std")


class Experiment:
    """
    A recipe in an environment.

    :param args: options of ``train``; a missing seed is drawn here
    :param written: the recipe with the changes of the command line, as it is written
    :param source: origin of the recipe, for messages
    :param exact: whether the environments must provide their state, for exact checkpoints
    :raises ValueError: if the recipe does not fit the algorithm or the environment
    """

    def __init__(self, args: argparse.Namespace, written: Mapping[str, Any], source: str, exact: bool = False):
        self.args, self.env_id, self.name = args, args.env, name_of(args.env)
        self.algorithm = algorithm(args.algo)
        given = dict(written)
        if args.n_timesteps > 0:
            given.setdefault("n_timesteps", args.n_timesteps)
        if given.get("noise_type", "") is None:  # which switches the recipe's noise off
            given = {key: value for key, value in given.items() if key not in ("noise_type", "noise_std")}
        origin = f"{source} with -params" if args.hyperparams else source
        values = check_recipe(args.algo, given, f"recipe for {args.algo} in {origin}")
        self.shares = shares_parameters(self.algorithm, args.env)
        self._check_environments(values)
        self.env_kwargs = {**(values.get("env_kwargs") or {}), **(args.env_kwargs or {})}
        own = {**(values.get("eval_env_kwargs") or {}), **(args.eval_env_kwargs or {})}
        self.eval_env_kwargs = {**self.env_kwargs, **own}
        check_env_kwargs(args.env, self.eval_env_kwargs)
        # Text stays as it is written, because YAML has no plain form for classes
        self.recipe: dict[str, Any] = {**given, "env_kwargs": self.env_kwargs, "eval_env_kwargs": own}
        self.n_timesteps = args.n_timesteps if args.n_timesteps > 0 else int(values["n_timesteps"])
        self.n_envs = 1 if args.algo == "ars" else values.get("n_envs", 1)
        self.callback, self.noise = values.get("callback"), (values.get("noise_type"), values.get("noise_std"))
        self.hyperparams = {
            key: _schedule(value) if key in SCHEDULES else value
            for key, value in values.items()
            if value is not None and key not in (*_OF_ENVIRONMENTS, *_OTHERS)
        }
        if isinstance(self.hyperparams.get("train_freq"), list):
            self.hyperparams["train_freq"] = tuple(self.hyperparams["train_freq"])
        self.environments = Environments(
            args.env,
            args.seed,
            {key: values[key] for key in _OF_ENVIRONMENTS if values.get(key)},
            gamma=values.get("gamma"),
            subproc=args.vec_env == "subproc",
            agents=self.shares,
        )
        if exact and not self.shares and not self.environments.settings.get("vec_env"):
            self.environments.require_state(self.env_kwargs)

    def _check_environments(self, values: Mapping[str, Any]) -> None:
        vec_env = values.get("vec_env")
        if vec_env not in (None, "gymnasium"):
            raise InvalidArgumentError(
                f"vec_env: {vec_env} in the recipe: only 'gymnasium' is known; --vec-env chooses dummy or subproc."
            )
        if vec_env and gymnasium.spec(self.env_id).vector_entry_point is None:
            raise InvalidArgumentError(
                f"vec_env: gymnasium in the recipe, but {self.env_id} has no vector environment of its own."
            )
        if vec_env and (wrappers := {"env_wrapper", "frame_stack", "monitor_kwargs"} & set(values)):
            raise InvalidArgumentError(
                f"vec_env: gymnasium in the recipe cannot be combined with {', '.join(sorted(wrappers))}: remove one "
                "of them."
            )
        others = ("env_wrapper", "frame_stack", "monitor_kwargs", "normalize", "vec_env_wrapper")
        if self.shares and (refused := [key for key in others if values.get(key)]):
            raise InvalidArgumentError(
                f"{', '.join(refused)} in the recipe: {self.args.algo} shares its policy among the agents of "
                f"{self.env_id}, which needs wrappers of PettingZoo. Name them in `wrappers` of env_kwargs, "
                "such as supersuit.frame_stack_v2."
            )

    def arguments(self, env: VecEnv) -> dict[str, Any]:
        """
        :param env: the environment to train in
        :return: the algorithm's arguments in the recipe
        :raises InvalidArgumentError: if the recipe has action noise, and the actions are not continuous
        """
        noise = self._action_noise(env)
        return self.hyperparams if noise is None else {**self.hyperparams, "action_noise": noise}

    def _action_noise(self, env: VecEnv) -> ActionNoise | None:
        kind, std = self.noise
        if kind is None:
            return None
        if not isinstance(env.action_space, spaces.Box):
            raise InvalidArgumentError(
                f"noise_type: {kind} in the recipe is for continuous actions, a Box, not for {env.action_space}."
            )
        noise = NormalActionNoise if "normal" in kind else OrnsteinUhlenbeckActionNoise
        n_actions = env.action_space.shape[0]
        return noise(mean=np.zeros(n_actions), sigma=np.full(n_actions, float(std or 0.0)))

    def new_model(self, env: VecEnv, **arguments: Any) -> BaseAlgorithm:
        """
        :param env: the environment to train in
        :param arguments: arguments of the algorithm
        :return: a new model
        """
        return self.algorithm(env=env, device=self.args.device, **arguments)


def _schedule(value: Any) -> Any:
    if isinstance(value, str):
        return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
    return ConstantSchedule(float(value)) if value >= 0 else value  # a negative number has a meaning of its own


def begin(args: argparse.Namespace) -> None:
    """
    Prepare a training or a search: find the environment, and seed and limit PyTorch.

    :param args: options of ``train``; a missing seed is drawn
    :raises ValueError: if algorithm or environment do not exist
    """
    algorithm(args.algo)
    load_environments()
    find_environment(args.env)
    if args.seed < 0:
        args.seed = secrets.randbelow(2**32 - 1)
    set_random_seed(args.seed)
    if args.num_threads > 0:
        th.set_num_threads(args.num_threads)
    print("=" * 10, args.env, "=" * 10)
    print(f"Seed: {args.seed}")


def given_recipe(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """
    :param args: options of ``train``
    :return: the recipe with the changes of the command line, as it is written, and where it is
    """
    path = recipe_path(args.conf_file, args.algo, args.env)
    print(f"Loading hyperparameters from: {path}")
    return {**read_recipe(path, args.algo, args.env), **(args.hyperparams or {})}, path


def merged(hyperparams: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """
    Merge the changes of a trial over a recipe, including the arguments of the policy.

    :param hyperparams: hyperparameters of a recipe
    :param changes: hyperparameters of a trial
    :return: the merged hyperparameters
    """
    policy_kwargs = hyperparams.get("policy_kwargs") or {}
    if isinstance(policy_kwargs, str):  # text of a recipe
        policy_kwargs = parse_literal(policy_kwargs)
    changed = {**hyperparams, **changes}
    if "policy_kwargs" in changes:
        changed["policy_kwargs"] = {**policy_kwargs, **changes["policy_kwargs"]}
    return changed
