"""Environments as the algorithms train on them."""

from __future__ import annotations

import gymnasium
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import TeamEnv, what_to_pass
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
