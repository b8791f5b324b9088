"""Environments as the algorithms train on them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common import env_util
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import TeamEnv, what_to_pass
from sb3_maddpg.team.pettingzoo_ids import register, unknown
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import shown
from sb3_maddpg.vec_env.checks import check_vec_env
from sb3_maddpg.vec_env.normalize import for_team


def as_vec_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """
    Wrap an environment the way the algorithms train on it.

    :param env: a PettingZoo environment, a team environment, or a vectorised team environment
    :param verbose: see SB3's ``BaseAlgorithm``
    :param monitor_wrapper: see SB3's ``BaseAlgorithm``
    :return: the vectorised environment
    :raises ValueError: if the spaces do not describe a team, or see ``check_vec_env``
    """
    if not isinstance(env, (ParallelEnv, AECEnv, gymnasium.Env, VecEnv)):
        raise InvalidEnvironmentError(f"env={shown(env)} is not an environment: {what_to_pass(env, 'the algorithm')}.")
    if isinstance(env, (ParallelEnv, AECEnv)):
        env = TeamEnv(env)
    vec_env = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
    for_team(vec_env)
    check_vec_env(vec_env)
    # SB3's own error would suggest policies that do not exist here
    Team.from_spaces(vec_env.observation_space, vec_env.action_space)
    return vec_env


def make_vec_env(
    env: str | Callable[..., Any],
    n_envs: int = 1,
    seed: int | None = None,
    monitor_dir: str | os.PathLike[str] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    vec_env_cls: type[VecEnv] | None = None,
    vec_env_kwargs: Mapping[str, Any] | None = None,
) -> VecEnv:
    """
    Create copies of an environment that are stepped together, as Stable-Baselines3's ``make_vec_env`` does.

    :param env: class of a PettingZoo environment, or a function that creates one, such as
        ``simple_spread_v3.parallel_env``; PACKAGE/MODULE of one; or a team environment of Gymnasium, or its id
    :param n_envs: number of copies
    :param seed: seed of the first copy; the others have the next ones
    :param monitor_dir: folder of the files of ``Monitor``, None for none
    :param env_kwargs: arguments of the environment
    :param vec_env_cls: by default ``DummyVecEnv``; ``SubprocVecEnv`` gives each copy a process
    :param vec_env_kwargs: arguments of this class
    :return: the vectorised environment
    :raises ValueError: if there is no such environment
    """
    if not isinstance(n_envs, int) or n_envs < 1:
        raise InvalidEnvironmentError(f"n_envs={shown(n_envs)}: it must be an integer of at least 1.")
    if isinstance(env, str):
        if not register(env):
            raise InvalidEnvironmentError(unknown(env))
        env = gymnasium.spec(env).make
    if not callable(env):
        raise InvalidEnvironmentError(
            f"env={shown(env)} is no class, function or id: pass what creates an environment, not an environment."
        )
    return env_util.make_vec_env(
        _Creator(env),
        n_envs=n_envs,
        seed=seed,
        monitor_dir=None if monitor_dir is None else str(monitor_dir),
        env_kwargs=dict(env_kwargs or {}),
        vec_env_cls=vec_env_cls,  # type: ignore[arg-type]
        vec_env_kwargs=dict(vec_env_kwargs or {}),
    )


class _Creator:
    """Function that creates team environments, also in another process."""

    def __init__(self, make: Callable[..., Any]):
        self.make = make

    def __call__(self, **kwargs: Any) -> gymnasium.Env:
        env = self.make(**kwargs)
        return TeamEnv(env) if isinstance(env, (ParallelEnv, AECEnv)) else env
