"""Checks of the transitions that arrive at the algorithm."""

import math
import warnings
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.utils import as_number, as_numbers, integers_problem, shown
from sb3_maddpg.vec_env.border import REMEDY, check_entries
from sb3_maddpg.vec_env.checks import steps_its_envs

_SAME_ENDS = 3  # episodes, after which it is no coincidence that one ends where the next begins
# What TeamEnv always gives, except agent_truncated, which follows from agents that act no more
_OF_TEAM_ENV = frozenset({"agent_rewards", "agent_terminated", "agent_active"})


def check_outside(normalizer: VecNormalize, obs: Any, rewards: np.ndarray) -> None:
    """
    Check that wrappers outside of ``VecNormalize`` change nothing: the replay buffer stores what ``VecNormalize`` got.

    :param normalizer: the wrapper, after a step
    :param obs: the observations as they arrived, (n_envs, n_agents, columns)
    :param rewards: the team's rewards as they arrived, (n_envs,)
    :raises ValueError: if either is not what ``VecNormalize`` returned
    """
    original = np.asarray(normalizer.get_original_obs())
    absent = (original == 0) & (obs == 0)  # see TeamVecNormalize
    same_obs = obs.shape == original.shape and np.all(
        absent | np.isclose(obs, np.asarray(normalizer.normalize_obs(original)))
    )
    if not same_obs or not np.allclose(rewards, normalizer.normalize_reward(normalizer.get_original_reward())):
        raise InvalidEnvironmentError(
            f"A wrapper outside of VecNormalize changes {'rewards' if same_obs else 'observations'}, but the algorithm "
            "learns from those that VecNormalize gets: put VecNormalize outermost."
        )


def _number_in(info: Mapping[str, Any], name: str, default: Any) -> Any:
    """
    :return: a number in an info
    :raises ValueError: if it is not finite, or no number
    """
    number = info.get(name, default)
    plain = (type(number) is float and math.isfinite(number)) or (type(number) is int and abs(number) < 2**53)
    if plain or name not in info:
        return number
    number = math.nan
    with suppress(ValueError):
        number = as_number(info[name])
    if not math.isfinite(number):
        raise InvalidEnvironmentError(f"info[{name!r}] is {shown(info[name])}: it must be a finite number.")
    return number


def check_returned(n_envs: int, infos: Any, **arrays: Any) -> None:
    """
    Check the form of what ``step`` of a vectorised environment, or of a wrapper of it, returned.

    :param n_envs: number of environments
    :param infos: an info for each environment
    :param arrays: observations, (n_envs, ...), rewards, (n_envs,), and dones, (n_envs,), by these names
    :raises ValueError: if something has another form
    """
    for name, values in arrays.items():
        is_array = type(values) is np.ndarray and values.dtype.kind in "biuf"
        if not is_array or (values.shape[:1] if name == "observations" else values.shape) != (n_envs,):
            raise InvalidEnvironmentError(
                f"step() of the vectorised environment returned the {name} {shown(values)}: they must be an array of "
                f"real numbers for {n_envs} environment(s)."
            )
        if name == "dones" and values.dtype.kind != "b" and not np.isin(values, (0, 1)).all():
            raise InvalidEnvironmentError(
                f"step() of the vectorised environment returned the dones {shown(values)}: they must be True or False."
            )
    if not isinstance(infos, (list, tuple)) or len(infos) != n_envs:
        raise InvalidEnvironmentError(
            f"step() of the vectorised environment returned the infos {shown(infos)}: they must be a list of "
            f"{n_envs} dict(s), one for each environment."
        )


def last_observation(env: int, info: Mapping[str, Any], next_obs: np.ndarray) -> Any:
    """
    :param env: index of an environment whose episode ended
    :param info: its info
    :param next_obs: the first observation of the next episode
    :return: the last observation of the episode, not normalised
    :raises ValueError: if there is none although it was truncated, or it does not fit
    """
    # VecNormalize keeps the original besides the normalised one, which may have been clipped
    last = info.get("original_terminal_observation", info.get("terminal_observation"))
    if last is None:
        if info.get("TimeLimit.truncated"):
            raise InvalidEnvironmentError(
                f"The episode of environment {env} was truncated without info['terminal_observation'], the last "
                "observation, from which the values of agents go on: return it, as Stable-Baselines3's vectorised "
                "environments do, and keep it in wrappers."
            )
        return next_obs
    array = np.asarray(last)
    problem = None
    if array.shape != next_obs.shape or array.dtype.kind not in "biuf":
        problem = f"has shape {array.shape} and type {array.dtype}, but observations have shape {next_obs.shape}"
    elif next_obs.dtype.kind in "iu" and (found := integers_problem(array, next_obs.dtype)) is not None:
        problem = f"of agent {found.rstrip(',')}"
    if problem is not None:
        raise InvalidEnvironmentError(f"info['terminal_observation'] of environment {env} {problem}.")
    return array


class ArrivalCheck:
    """
    Compares the transitions that arrive at the algorithm with what the environments say they gave. Wrappers in any
    process may have changed or added up the team's reward, changed how episodes end, skipped steps, or kept arrays that
    were overwritten.

    :param n_envs: number of environments
    :param copied: whether the last observations are copies, see ``BorderEnv``
    :param of_pettingzoo: whether the environments are each a ``TeamEnv``, whose infos tell about each agent
    """

    def __init__(self, n_envs: int, copied: bool = False, of_pettingzoo: bool = False):
        self._entries: Set[str] = _OF_TEAM_ENV if of_pettingzoo else frozenset()
        # Number of each environment's last step in its episode, 0 if it is not known
        self._steps = [0] * n_envs
        # First observations of episodes that equal the last ones of the episodes before, None if one differed
        self._firsts: list[list[np.ndarray] | None] = [None if copied else [] for _ in range(n_envs)]
        self._only_firsts = 0  # episodes in a row of which wrappers changed the first observation, but not the last

    def check(
        self,
        rewards: np.ndarray,
        observations: np.ndarray,
        dones: np.ndarray,
        infos: Sequence[Mapping[str, Any]],
        reads_parts: bool = False,
    ) -> None:
        """
        :param rewards: the team's rewards as they arrived, not normalised, (n_envs,)
        :param observations: observations after the step or first ones of next episodes, not normalised, (n_envs, ...)
        :param dones: which episodes ended, (n_envs,)
        :param infos: infos of the environments
        :param reads_parts: whether the algorithm reads parts of the team's reward even if agents have none of their
            own, as with ``pair_credit`` and ``use_action_cost``
        :raises ValueError: if the reward that arrived differs from what the environment gave, see ``WatchedEnv``, or in
            other processes ``info["team_reward"]``, or without it both mean and sum of ``info["agent_rewards"]``; if
            steps are skipped, an end was dropped or made a truncation, or the last observations of episodes are missing
            or are the first ones of the next episodes, or entries of infos are missing
        """
        for k, info in enumerate(infos):
            if not self._entries <= info.keys():
                check_entries(self._entries, info, f"TeamEnv in environment {k}")
            if reads_parts or "agent_rewards" in info:
                self._check_reward(k, rewards.item(k), info)
            step = info["inner_step"] if "inner_step" in info else _number_in(info, "episode_step", 0)
            if step and self._steps[k] and step != self._steps[k] + 1:
                raise InvalidEnvironmentError(
                    f"Environment {k} went from step {self._steps[k]:g} to step {step:g} of its episode, so that what "
                    "happened to its agents in between is lost: a wrapper or a callback skips steps or resets the "
                    f"environment itself. {REMEDY}"
                )
            self._steps[k] = 0 if dones[k] else step
            if dones[k]:
                self._check_cut(k, info)
            elif "terminal_observation" in info:
                raise InvalidEnvironmentError(
                    f"Environment {k} was reset, but a wrapper reports no end of its episode, so that the first "
                    f"observation of the next episode would pass for the next one of this one. {REMEDY}"
                )
            if dones[k] and self._firsts[k] is not None:
                last = info.get("original_terminal_observation", info.get("terminal_observation"))
                self._check_end(k, observations[k], last)

    def check_lasts(
        self, inner: VecEnv, observations: np.ndarray, dones: np.ndarray, infos: Sequence[Mapping[str, Any]]
    ) -> None:
        """
        Warn of wrappers that change observations, but not the last ones of episodes, which come in infos.

        :param inner: the vectorised environment without its wrappers, after the step
        :param observations: see ``check``
        :param dones: see ``check``
        :param infos: see ``check``
        """
        if not (isinstance(inner, DummyVecEnv) and steps_its_envs(inner)) or self._only_firsts > _SAME_ENDS:
            return
        for k in np.flatnonzero(dones).tolist():
            last: Any = infos[k].get("original_terminal_observation", infos[k].get("terminal_observation"))
            given: Any = inner.buf_obs[None]  # type: ignore[index]  # of observations that are no dict
            own_last: Any = inner.buf_infos[k].get("terminal_observation")
            changed, same_last = not np.array_equal(observations[k], given[k]), np.array_equal(last, own_last)
            self._only_firsts = self._only_firsts + 1 if changed and same_last else 0
            if self._only_firsts == _SAME_ENDS:
                self._only_firsts += 1
                warnings.warn(
                    "A wrapper changes observations, but not the last ones of episodes, which the algorithm bootstraps "
                    "from: let it change info['terminal_observation'], too.",
                    stacklevel=2,
                )

    @staticmethod
    def _check_cut(env: int, info: Mapping[str, Any]) -> None:
        try:
            ended = as_numbers(info.get("agent_terminated", False)).astype(bool)
            cut = as_numbers(info.get("agent_truncated", False)).astype(bool) & ~ended
        except ValueError:  # the replay buffer says what is wrong
            return
        if "TimeLimit.truncated" not in info and cut.any():
            raise InvalidEnvironmentError(
                f"The episode of environment {env} was truncated, but its `info` has no 'TimeLimit.truncated', without "
                "which the value of the last observation is unknown: let wrappers keep what vectorised environments of "
                "Stable-Baselines3 add to `info`."
            )
        if info.get("TimeLimit.truncated") and ended.all():
            raise InvalidEnvironmentError(
                f"The episode of environment {env} was truncated, but all agents terminated in its last step: a "
                "wrapper changes only the team's end, while the algorithm learns from the agents' ends in `info`. "
                f"{REMEDY}"
            )

    @staticmethod
    def _check_reward(env: int, arrived: float, info: Mapping[str, Any]) -> None:
        # Rewards arrive in single precision
        own = info["inner_reward"] if "inner_reward" in info else _number_in(info, "team_reward", None)
        if own is not None and abs(arrived - own) <= 1e-5 * max(abs(own), 1e-3):
            return
        try:
            agents = as_numbers(info.get("agent_rewards", ())).astype(float)
        except ValueError:  # the replay buffer says what is wrong
            return
        if not math.isfinite(arrived):
            return
        given = [] if agents.size == 0 else [agents.mean(), agents.sum()]
        if own is not None:
            given = [own]
        error = 1e-5 * max(abs(arrived), 1e-3, *np.abs(agents).flat)
        if given and not any(abs(arrived - value) <= error for value in given):
            remedy = REMEDY
            if own is None:
                remedy += " If the team's reward is meant so, return it in info['team_reward'], too."
            gave = f"{given[0]:g}{f' (agents: {shown(agents.tolist())})' if agents.size else ''}"
            raise InvalidEnvironmentError(
                f"The team's reward of environment {env} arrived as {arrived:g}, but the environment gave {gave}: a "
                "wrapper changes only the team's reward or adds up those of several steps, while the algorithm learns "
                f"from its parts in `info`, or the environment writes into arrays that it has returned. {remedy}"
            )

    def _check_end(self, env: int, first: np.ndarray, last: Any) -> None:
        firsts = self._firsts[env]
        if last is None or not np.array_equal(first, last):
            self._firsts[env] = None
            return
        assert firsts is not None
        firsts.append(first.copy())
        if len(firsts) >= _SAME_ENDS and any((one != first).any() for one in firsts):
            raise InvalidEnvironmentError(
                f"The last observations of {len(firsts)} episodes of environment {env} are the first ones of the next "
                "episodes: the environment writes into an array that it has returned. Return a copy, `obs.copy()`; if "
                "episodes do go on where the last one ended, use DummyVecEnv."
            )
