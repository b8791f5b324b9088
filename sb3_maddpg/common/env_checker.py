"""Environment checker for custom team environments."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.env_checker import check_env

from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.callbacks import check_success
from sb3_maddpg.common.layout import NeighbourViews, check_layout
from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import TeamEnv, explained_reset, what_to_pass
from sb3_maddpg.team.team import Team, TeamInfo
from sb3_maddpg.utils import all_finite, not_finite_at, shown, suggest
from sb3_maddpg.vec_env.arrivals import ArrivalCheck
from sb3_maddpg.vec_env.border import watched, watcher_of
from sb3_maddpg.vec_env.checks import check_wrappers

_SCALARS = {"is_success", "metrics", "team_reward", "episode_step"}
_FLAGS = ("agent_terminated", "agent_truncated", "agent_active", "pair_terminated")


def check_team_env(env: gymnasium.Env | ParallelEnv, max_steps: int = 1000, seed: int = 0) -> Team:
    """
    Check that an environment follows the team convention, see ``TeamEnvironment``, ``TeamAttributes`` and ``TeamInfo``.
    Runs Stable-Baselines3's ``check_env``, then checks the spaces, the attributes and an episode of random actions.
    Actions that action masks forbid are replaced by legal ones. Errors that the environment itself raises pass through.
    Agents that stay in PettingZoo's ``agents`` after the episode cause a warning.

    :param env: team environment or PettingZoo environment
    :param max_steps: maximum number of steps of the episode
    :param seed: seed of the episode and the actions
    :return: the team as MADDPG will see it
    :raises ValueError: if a check fails; the message describes the first problem and its remedy
    """
    if isinstance(env, (ParallelEnv, AECEnv)):
        env = TeamEnv(env)
    if not isinstance(env, gymnasium.Env):
        raise InvalidEnvironmentError(f"{shown(env)} is not an environment: {what_to_pass(env, 'check_team_env')}.")
    check_wrappers(env)
    env = watched(env)
    names = env.get_wrapper_attr("agent_names") if env.has_wrapper_attr("agent_names") else None
    team = Team.from_spaces(env.observation_space, env.action_space, names)
    space, legal = env.observation_space, _LegalActions(env, team)
    assert isinstance(space, spaces.Box)
    with explained_reset(env):
        legal.reset(seed=seed)
    with th.random.fork_rng(devices=[]):  # legal actions are drawn by PyTorch
        th.manual_seed(seed)
        try:
            check_env(legal, warn=False, skip_render_check=True)
        except AssertionError as error:
            if "does not match the bounds" in str(error):
                raise InvalidEnvironmentError(_out_of_bounds(space, legal.obs, team)) from None
            raise InvalidEnvironmentError(
                f"Stable-Baselines3's check_env: {' '.join(str(error).split())[:500]}"
            ) from error
        _check_attributes(env, team)
        _check_episode(legal, team, max_steps, seed)
    return team


class _LegalActions(gymnasium.Wrapper):
    """
    Wrapper that replaces illegal actions, see ``TeamActions.legal``.

    :param env: the team environment
    :param team: the team
    """

    def __init__(self, env: gymnasium.Env, team: Team):
        super().__init__(env)
        self.actions = TeamActions(team.action_spaces, masks=team.masks)
        self.obs: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        returned = self.env.reset(seed=seed, **({} if options is None else {"options": options}))
        self.obs = returned[0] if isinstance(returned, tuple) and returned else None
        return returned

    def step(self, action: np.ndarray) -> Any:
        if self.actions.has_masks:
            scaled = th.as_tensor(self.actions.scale(action[np.newaxis]), dtype=th.float32)
            flat = self.actions.legal(scaled, th.as_tensor(self.obs, dtype=th.float32).unsqueeze(0))
            action = self.actions.unscale(flat.numpy())[0].astype(action.dtype)
        returned = self.env.step(action)
        self.obs = returned[0] if isinstance(returned, tuple) and returned else None
        return returned


def _out_of_bounds(space: spaces.Box, obs: np.ndarray, team: Team) -> str:
    """:return: a message about the value that is farthest out of the bounds"""
    obs = obs.astype(float)
    excess = np.maximum(space.low - obs, obs - space.high)
    row, column = np.unravel_index(excess.argmax(), excess.shape)
    where = f"column {column} of agent {team.names[row]}"
    if column >= team.obs_dim:
        where = f"column {column} of row {row}, which holds the state,"
    return (
        f"The observation is {obs[row, column]:g} in {where}, but its space allows {space.low[row, column]:g} to "
        f"{space.high[row, column]:g} there ({np.count_nonzero(excess > 0)} of {obs.size} numbers are out of bounds): "
        "correct the bounds, or clip or rescale the observation."
    )


def _check_attributes(env: gymnasium.Env, team: Team) -> None:
    if env.has_wrapper_attr("action_cost"):
        cost = np.asarray(env.get_wrapper_attr("action_cost"))
        if cost.dtype.kind not in "biuf" or not all_finite(cost) or (cost.ndim and cost.shape[0] != team.n_agents):
            raise InvalidEnvironmentError(
                f"action_cost={cost.tolist()} must be a finite number, or an array of them of shape (n_agents, width)."
            )
    curriculum = [env.has_wrapper_attr(name) for name in ("n_curriculum_levels", "set_curriculum_level")]
    if any(curriculum) and not all(curriculum):
        raise InvalidEnvironmentError(
            "A curriculum needs both `n_curriculum_levels` and `set_curriculum_level(level)`."
        )
    if all(curriculum):
        levels = env.get_wrapper_attr("n_curriculum_levels")
        if not isinstance(levels, (int, np.integer)) or levels < 1:
            raise InvalidEnvironmentError(f"n_curriculum_levels={shown(levels)} must be an integer of at least 1.")
        if not callable(env.get_wrapper_attr("set_curriculum_level")):
            raise InvalidEnvironmentError("set_curriculum_level must be a method that takes the level.")
    if env.has_wrapper_attr("observation_layout"):
        layout = env.get_wrapper_attr("observation_layout")
        check_layout(layout)
        NeighbourViews(layout, team)  # raises ValueError


def _check_episode(env: gymnasium.Env, team: Team, max_steps: int, seed: int) -> None:
    first, _ = env.reset(seed=seed)
    again, _ = env.reset(seed=seed)
    if not np.array_equal(first, again):
        raise InvalidEnvironmentError(
            f"Two calls of reset(seed={seed}) returned different observations: draw all random numbers from one "
            "generator, which reset(seed) seeds."
        )
    env.action_space.seed(seed)
    gone = np.zeros(team.n_agents, bool)
    arrivals, kept = ArrivalCheck(1, of_pettingzoo=isinstance(env.unwrapped, TeamEnv)), _Kept()
    watcher = watcher_of(env)
    for step in range(1, max_steps + 1):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        where = f"in step {step}"
        kept.check("step()")
        kept.keep(observation=obs, **{f"info[{name!r}]": value for name, value in info.items()})
        if (index := not_finite_at(np.asarray(obs))) is not None:
            raise InvalidEnvironmentError(
                f"The observation of agent {team.names[index[0]]} {where} holds NaN or infinity."
            )
        _check_numbers_of_neighbours(env, np.asarray(obs), team, where)
        if not all_finite(np.asarray(reward, float)):
            raise InvalidEnvironmentError(
                f"The team's reward {where} is {reward}: it must be finite, also in single precision."
            )
        _check_info(info, team, where)
        if watcher is not None:
            watcher.check_entries(info)
        arrivals.check(np.array([reward], np.float32), np.asarray(obs)[np.newaxis], np.zeros(1, bool), [info], True)
        acts = np.asarray(info.get("agent_active", ~gone), bool)
        if (acts & gone).any():
            name = team.names[np.flatnonzero(acts & gone)[0]]
            raise InvalidEnvironmentError(
                f"Agent {name} is active {where}, although it has terminated or was truncated: set its agent_active to "
                "False."
            )
        for name in ("agent_terminated", "agent_truncated"):
            gone |= np.asarray(info.get(name, np.zeros(team.n_agents)), bool)
        if terminated or truncated:
            if env.has_wrapper_attr("n_curriculum_levels") and "is_success" not in info:
                raise InvalidEnvironmentError(
                    'CurriculumCallback needs info["is_success"] in the last step of an episode.'
                )
            adapter = env.unwrapped
            if isinstance(adapter, TeamEnv) and (left := adapter.parallel_env.agents):
                warnings.warn(
                    f"The episode ended {where}, but `agents` still holds {shown(left)}: PettingZoo's loops, such as "
                    "`while env.agents`, end when it is empty. Remove agents that have terminated or were truncated.",
                    stacklevel=3,
                )
            env.reset()
            kept.check("reset()")
            return


class _Kept:
    """What the environment returned last, with copies. It must not change later: vectorised environments keep it."""

    def __init__(self) -> None:
        self._returned: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def keep(self, **values: Any) -> None:
        """:param values: what was returned, by name"""
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        self._returned = {name: (array, array.copy()) for name, array in arrays.items()}

    def check(self, call: str) -> None:
        """
        :param call: the call that may have changed what was kept
        :raises ValueError: if it did
        """
        for name, (array, before) in self._returned.items():
            if not np.array_equal(array, before, equal_nan=array.dtype.kind == "f"):
                raise InvalidEnvironmentError(
                    f"{call} wrote into an array that step() had returned, {name}, which vectorised environments keep "
                    "over the end of an episode: return a copy, for example `array.copy()`."
                )


def _check_numbers_of_neighbours(env: gymnasium.Env, obs: np.ndarray, team: Team, where: str) -> None:
    layout = env.get_wrapper_attr("observation_layout") if env.has_wrapper_attr("observation_layout") else {}
    for agent, row in enumerate(obs[:, layout.get("who_columns", [])]):
        named = row[row != 0]
        if not set(named) <= set(range(1, team.n_agents + 1)) - {agent + 1} or len(set(named)) < len(named):
            raise InvalidEnvironmentError(
                f"The neighbours of agent {team.names[agent]} {where}, in `who_columns` of its observation, are "
                f"{shown(row.tolist())}: each must be another agent's index plus 1, named once, or 0 for no neighbour."
            )


def _check_info(info: dict[str, Any], team: Team, where: str) -> None:
    known = set(TeamInfo.__annotations__)
    for name in info.keys() - known:
        if name.lower().replace("_", "").rstrip("s") in {key.replace("_", "").rstrip("s") for key in known}:
            raise InvalidEnvironmentError(f"info {where}: {suggest('entry', name, known)}")
    for name in known & info.keys() - _SCALARS:
        value = np.asarray(info[name])
        of_pairs = name in ("pair_rewards", "pair_terminated")
        shape = value.shape[:1] if of_pairs and value.ndim == 2 else value.shape
        if shape != (team.n_agents,) or value.dtype.kind not in "biuf":
            raise InvalidEnvironmentError(
                f"info['{name}'] {where} is {shown(info[name])}: it must hold a number for each of the {team.n_agents} "
                f"agents{' and each of its neighbours' if of_pairs else ''}."
            )
        if (index := not_finite_at(value)) is not None:
            raise InvalidEnvironmentError(f"info['{name}'] of agent {team.names[index[0]]} {where} is not finite.")
        if name in _FLAGS and not np.isin(value, (0, 1)).all():
            raise InvalidEnvironmentError(
                f"info['{name}'] {where} is {value.tolist()}: it must hold True or False for each agent."
            )
    for name in {"team_reward", "episode_step"} & info.keys():
        if not _is_number(info[name]):
            raise InvalidEnvironmentError(f"info['{name}'] {where} is {shown(info[name])}: it must be a finite number.")
    metrics = info.get("metrics", {})
    if not isinstance(metrics, dict) or not all(map(_is_number, metrics.values())):
        raise InvalidEnvironmentError(
            f"info['metrics'] {where} is {shown(metrics)}: it must be a flat dict of finite numbers."
        )
    check_success([info])


def _is_number(value: Any) -> bool:
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in "biuf" and bool(np.isfinite(array))
