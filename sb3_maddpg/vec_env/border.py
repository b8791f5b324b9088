"""Wrappers that check and copy what environments return, before anything casts it or writes into it."""

from collections.abc import Mapping, Set
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import Env, Wrapper

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import TeamEnv, explained_reset, layers_of
from sb3_maddpg.team.team import InfoKey, TeamInfo
from sb3_maddpg.utils import as_flag, as_number, as_numbers, integers_problem, shown

REMEDY = (
    "Wrap the PettingZoo environment instead (pettingzoo.utils.BaseParallelWrapper, SuperSuit) and put TeamEnv around "
    "it, or change step() of a Gymnasium environment of your own."
)


class Transparent(Wrapper):
    """
    Wrapper that hands all attributes on, so that neither other wrappers nor ``set_attr`` of vectorised environments
    find another environment than without it.

    :param env: an environment
    """

    _own = frozenset(
        {"env", "_action_space", "_observation_space", "_metadata", "_cached_spec"}
        | {"_step", "_given_entries", "_counts_steps", "_watcher", "_alone", "_space"}
    )

    def __getattr__(self, name: str) -> Any:
        if "env" not in self.__dict__ or name.startswith("__"):  # a copy that is being made
            raise AttributeError(name)
        return getattr(self.env, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self._own:
            super().__setattr__(name, value)
        else:
            setattr(self.env, name, value)


class WatchedEnv(Transparent):
    """
    Innermost wrapper of a team environment, which adds to its infos what the environment itself gave, ``inner_reward``
    and ``inner_step``. ``ArrivalCheck`` compares with them what arrives through all other wrappers.

    :param env: a team environment
    """

    def __init__(self, env: Env):
        super().__init__(env)
        self._step, self._counts_steps = 0, False
        self._given_entries: frozenset[str] = frozenset()

    def reset(self, **kwargs: Any) -> Any:
        self._step, self._given_entries = 0, frozenset()
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        returned = self.env.step(action)
        if not isinstance(returned, (tuple, list)) or len(returned) != 5 or not isinstance(returned[4], dict):
            raise InvalidEnvironmentError(
                f"step() of {self.env} returned {shown(returned)}: it must return five values, observation, reward, "
                "terminated, truncated, and a dict of infos."
            )
        observation, reward, terminated, truncated, info = returned
        # Monitor and other wrappers would fail at other types, or take them for something else
        reward, terminated, truncated = _plain(self.env, reward, terminated, truncated)
        info = {**info, "inner_reward": reward}
        self._step += 1
        self._given_entries |= _OF_AGENTS & info.keys()
        self._counts_steps |= bool(self._given_entries)
        if self._counts_steps:  # otherwise nothing is lost if a wrapper skips steps
            info["inner_step"] = self._step
        return observation, reward, terminated, truncated, info

    def check_entries(self, info: Mapping[str, Any]) -> None:
        """
        :param info: what arrived of the infos of all steps since the last call
        :raises ValueError: if entries about agents are missing
        """
        given, self._given_entries = self._given_entries, frozenset()
        check_entries(given, info, str(self.env))


def _plain(env: Env, reward: Any, terminated: Any, truncated: Any) -> tuple[float, bool, bool]:
    """
    :param env: the environment that returned them
    :return: reward and ends as Python's numbers and flags
    :raises ValueError: if they are something else
    """
    if type(reward) is not float:
        try:
            reward = as_number(reward)
        except ValueError:
            raise InvalidEnvironmentError(
                f"step() of {env} returned the reward {shown(reward)}: it must be a number."
            ) from None
    if type(terminated) is not bool or type(truncated) is not bool:
        try:
            return reward, as_flag(terminated), as_flag(truncated)
        except ValueError:
            raise InvalidEnvironmentError(
                f"step() of {env} returned terminated={shown(terminated)} and truncated={shown(truncated)}: they must "
                "be True or False."
            ) from None
    return reward, terminated, truncated


_OF_AGENTS = frozenset(InfoKey.__args__)  # type: ignore[attr-defined]


def check_entries(given: Set[str], info: Mapping[str, Any], env: str) -> None:
    if not given <= info.keys():
        lost = sorted(given - info.keys())
        raise InvalidEnvironmentError(
            f"{env} gave {', '.join(lost)} in `info`, which did not arrive: a wrapper skips steps, or returns another "
            f"`info`. Let it return the `info` that it gets, with additions. {REMEDY}"
        )


def watcher_of(env: Env) -> WatchedEnv | None:
    """:return: the ``WatchedEnv`` among an environment's wrappers, if there is one"""
    return next((layer for layer in layers_of(env) if isinstance(layer, WatchedEnv)), None)


def watched(env: Env) -> Env:
    """
    :param env: a team environment, with its wrappers
    :return: the same with ``WatchedEnv`` around the innermost environment, except ``TeamEnv``, which says itself what
        it gave
    """
    inner = env.unwrapped
    if isinstance(inner, TeamEnv):
        return env
    if env is inner:
        return WatchedEnv(env)
    layer = next((one for one in layers_of(env) if one.__dict__.get("env") is inner), None)
    if layer is not None and not isinstance(layer, WatchedEnv):
        layer.env = WatchedEnv(inner)
    return env


def at_border(env: Env, alone: bool = False) -> Env:
    """:return: the environment in a ``BorderEnv``, and watched"""
    return env if isinstance(env, BorderEnv) else BorderEnv(watched(env), alone)


class BorderEnv(Transparent):
    """
    Outermost wrapper of an environment that SB3's vectorised environments step. It hands on what they would spoil:
    observations are checked before they are cast and broadcast, ends before they become booleans, and what is returned
    is copied before the environment, or another one with the same arrays, writes into it again.

    :param env: a team environment
    :param alone: whether no other environment is stepped before SB3 copies the infos of this one
    :raises ValueError: in ``reset`` and ``step``, if an observation does not fit its space, reward or ends are none, or
        wrappers drop what the environment says about agents
    """

    def __init__(self, env: Env, alone: bool = False):
        super().__init__(env)
        self._watcher, self._alone, self._space = watcher_of(env), alone, env.observation_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        with explained_reset(self.env):  # not every environment has options
            observation, info = self.env.reset(seed=seed, **({} if options is None else {"options": options}))
        return self._checked(observation, "after reset()").copy(), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        reward, terminated, truncated = _plain(self.env, reward, terminated, truncated)
        observation = self._checked(observation, "after step()")
        if self._watcher is not None:
            self._watcher.check_entries(info)
        if terminated or truncated:  # the environment is reset next
            return observation.copy(), reward, terminated, truncated, deepcopy(info)
        if not self._alone:
            observation, info = observation.copy(), {name: _copied(name, value) for name, value in info.items()}
        return observation, reward, terminated, truncated, info

    def _checked(self, observation: Any, when: str) -> np.ndarray:
        """:return: the observation as an array"""
        space = self._space
        assert space.dtype is not None
        array = observation
        if type(array) is not np.ndarray or array.dtype.kind not in "biuf":
            try:
                array = as_numbers(array)
                integers = np.asarray(observation) if space.dtype.kind in "iu" else array
                array = integers if integers.dtype.kind in "iu" else array
            except ValueError:
                raise InvalidEnvironmentError(
                    f"The observation {when} of {self.env} is {shown(observation)}: it must hold real numbers."
                ) from None
        if array.shape != space.shape:
            raise InvalidEnvironmentError(
                f"The observation {when} of {self.env} has shape {array.shape}, but its space is {shown(space)}."
            )
        if space.dtype.kind in "iu" and (problem := integers_problem(array, space.dtype)) is not None:
            raise InvalidEnvironmentError(
                f"The observation of agent {problem} {when} of {self.env}, whose space is {shown(space)}."
            )
        return array


_TOLD = frozenset(TeamInfo.__annotations__)
_IMMUTABLE = frozenset({float, int, bool, str, type(None)})


def _copied(name: str, value: Any) -> Any:
    """:return: a copy of an entry of an info that the environment may write into again"""
    if type(value) in _IMMUTABLE:
        return value
    if isinstance(value, np.ndarray):
        return value.copy()
    return deepcopy(value) if name in _TOLD else value
