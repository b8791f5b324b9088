"""Environment checker for custom team environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.env_checker import check_env

from sb3_maddpg.callbacks import check_success
from sb3_maddpg.parallel import TeamEnv
from sb3_maddpg.relational import NeighbourViews
from sb3_maddpg.team import Team, TeamInfo
from sb3_maddpg.utils import all_finite, not_finite_at, shown, suggest

_FLAGS = ("agent_terminated", "agent_active", "pair_terminated")


def check_team_env(env: gymnasium.Env | ParallelEnv, max_steps: int = 1000, seed: int = 0) -> Team:
    """
    Check that an environment follows the team convention, see ``TeamEnvironment``, ``TeamAttributes`` and ``TeamInfo``.
    Runs Stable-Baselines3's ``check_env``, then checks the spaces, the attributes and an episode of random actions.

    :param env: team environment or PettingZoo environment
    :param max_steps: maximum number of steps of the episode
    :param seed: seed of the episode and the actions
    :return: the team as MADDPG will see it
    :raises ValueError: if a check fails; the message describes the first problem and its remedy
    """
    if isinstance(env, (ParallelEnv, AECEnv)):
        env = TeamEnv(env)
    if not isinstance(env, gymnasium.Env):
        raise ValueError(f"{shown(env)} is neither a Gymnasium environment nor a PettingZoo ParallelEnv.")
    names = env.get_wrapper_attr("agent_names") if env.has_wrapper_attr("agent_names") else None
    team = Team.from_spaces(env.observation_space, env.action_space, names)
    try:
        check_env(env, warn=False, skip_render_check=True)
    except AssertionError as error:
        raise ValueError(f"Stable-Baselines3's check_env: {error}") from error
    _check_attributes(env, team)
    _check_episode(env, team, max_steps, seed)
    return team


def _check_attributes(env: gymnasium.Env, team: Team) -> None:
    if env.has_wrapper_attr("action_cost"):
        cost = np.asarray(env.get_wrapper_attr("action_cost"))
        if cost.dtype.kind not in "biuf" or not all_finite(cost) or (cost.ndim and cost.shape[0] != team.n_agents):
            raise ValueError(
                f"action_cost={cost.tolist()} must be a finite number, or an array of them of shape (n_agents, width)."
            )
    curriculum = [env.has_wrapper_attr(name) for name in ("n_curriculum_levels", "set_curriculum_level")]
    if any(curriculum) and not all(curriculum):
        raise ValueError("A curriculum needs both `n_curriculum_levels` and `set_curriculum_level(level)`.")
    if all(curriculum):
        levels = env.get_wrapper_attr("n_curriculum_levels")
        if not isinstance(levels, (int, np.integer)) or levels < 1:
            raise ValueError(f"n_curriculum_levels={shown(levels)} must be an integer of at least 1.")
        if not callable(env.get_wrapper_attr("set_curriculum_level")):
            raise ValueError("set_curriculum_level must be a method that takes the level.")
    if env.has_wrapper_attr("observation_layout"):
        NeighbourViews(env.get_wrapper_attr("observation_layout"), team)  # raises ValueError


def _check_episode(env: gymnasium.Env, team: Team, max_steps: int, seed: int) -> None:
    first, _ = env.reset(seed=seed)
    again, _ = env.reset(seed=seed)
    if not np.array_equal(first, again):
        raise ValueError(
            f"Two calls of reset(seed={seed}) returned different observations: draw all numbers from self.np_random."
        )
    env.action_space.seed(seed)
    gone = np.zeros(team.n_agents, bool)
    for step in range(1, max_steps + 1):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        where = f"in step {step}"
        if (index := not_finite_at(np.asarray(obs))) is not None:
            raise ValueError(f"The observation of agent {team.names[index[0]]} {where} holds NaN or infinity.")
        _check_numbers_of_neighbours(env, np.asarray(obs), team, where)
        if not all_finite(np.asarray(reward, float)):
            raise ValueError(f"The team's reward {where} is {reward}: it must be finite, also in single precision.")
        _check_info(info, team, where)
        acts = np.asarray(info.get("agent_active", ~gone), bool)
        if (acts & gone).any():
            name = team.names[np.flatnonzero(acts & gone)[0]]
            raise ValueError(
                f"Agent {name} is active {where}, although it has terminated: set its agent_active to False."
            )
        gone |= np.asarray(info.get("agent_terminated", np.zeros(team.n_agents)), bool)
        if terminated or truncated:
            if env.has_wrapper_attr("n_curriculum_levels") and "is_success" not in info:
                raise ValueError('CurriculumCallback needs info["is_success"] in the last step of an episode.')
            return


def _check_numbers_of_neighbours(env: gymnasium.Env, obs: np.ndarray, team: Team, where: str) -> None:
    layout = env.get_wrapper_attr("observation_layout") if env.has_wrapper_attr("observation_layout") else {}
    for agent, row in enumerate(obs[:, layout.get("who_columns", [])]):
        named = row[row != 0]
        if not set(named) <= set(range(1, team.n_agents + 1)) - {agent + 1} or len(set(named)) < len(named):
            raise ValueError(
                f"The neighbours of agent {team.names[agent]} {where}, in `who_columns` of its observation, are "
                f"{shown(row.tolist())}: each must be another agent's index plus 1, named once, or 0 for no neighbour."
            )


def _check_info(info: dict[str, Any], team: Team, where: str) -> None:
    known = set(TeamInfo.__annotations__)
    for name in info.keys() - known:
        if name.lower().replace("_", "").rstrip("s") in {key.replace("_", "").rstrip("s") for key in known}:
            raise ValueError(f"info {where}: {suggest('entry', name, known)}")
    for name in known & info.keys() - {"is_success", "metrics"}:
        value = np.asarray(info[name])
        of_pairs = name in ("pair_rewards", "pair_terminated")
        shape = value.shape[:1] if of_pairs and value.ndim == 2 else value.shape
        if shape != (team.n_agents,) or value.dtype.kind not in "biuf":
            raise ValueError(
                f"info['{name}'] {where} is {shown(info[name])}: it must hold a number for each of the {team.n_agents} "
                f"agents{' and each of its neighbours' if of_pairs else ''}."
            )
        if (index := not_finite_at(value)) is not None:
            raise ValueError(f"info['{name}'] of agent {team.names[index[0]]} {where} is not finite.")
        if name in _FLAGS and not np.isin(value, (0, 1)).all():
            raise ValueError(f"info['{name}'] {where} is {value.tolist()}: it must hold True or False for each agent.")
    metrics = info.get("metrics", {})
    if not isinstance(metrics, dict) or not all(map(_is_number, metrics.values())):
        raise ValueError(f"info['metrics'] {where} is {shown(metrics)}: it must be a flat dict of finite numbers.")
    check_success([info])


def _is_number(value: Any) -> bool:
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in "biuf" and bool(np.isfinite(array))
