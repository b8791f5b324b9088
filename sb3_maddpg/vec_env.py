"""Vectorised environments: an adapter from Gymnasium's, and checks of environments that are stepped together."""

import math
import warnings
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import Env, RewardWrapper, Wrapper, spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.parallel import TeamEnv, TurnBased, explained_reset, layers_of
from sb3_maddpg.team import CategoricalActions, InfoKey, MixedActions, TeamInfo, TeamObservation
from sb3_maddpg.utils import as_flag, as_number, as_numbers, as_seed, integers_problem, not_finite_at, shown

_REWARD_WRAPPERS = (RewardWrapper, NormalizeReward)
_SAME_ENDS = 3  # episodes, after which it is no coincidence that one ends where the next begins
_REMEDY = (
    "Wrap the PettingZoo environment instead (pettingzoo.utils.BaseParallelWrapper, SuperSuit) and put TeamEnv around "
    "it, or change step() of a Gymnasium environment of your own."
)


class GymnasiumVecEnv(VecEnv):
    """
    Adapter that turns a Gymnasium ``VectorEnv`` into an SB3 ``VecEnv``, so that environments that step many copies in
    one call keep their speed. Wrap it in ``VecMonitor`` for episode statistics.

    :param envs: a vector environment that resets in the step in which an episode ends (``AutoresetMode.SAME_STEP``),
        as SB3's vectorised environments do
    :raises ValueError: if ``envs`` is not a vector environment or has another autoreset mode
    """

    def __init__(self, envs: VectorEnv):
        if not isinstance(envs, VectorEnv):
            raise InvalidEnvironmentError(
                f"{shown(envs)} is not a Gymnasium VectorEnv: create one with gymnasium.make_vec. For a single "
                "environment use Stable-Baselines3's make_vec_env."
            )
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise InvalidEnvironmentError(
                f"The vector environment has autoreset mode {mode}; Stable-Baselines3 needs {AutoresetMode.SAME_STEP}. "
                'Create it with gymnasium.make_vec(..., vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}).'
            )
        self.envs = envs
        self._actions: np.ndarray | None = None
        self._begun = False
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> VecEnvObs:
        if any(self._options):
            raise InvalidArgumentError(
                f"Options for single environments, {self._options}, cannot be passed on to {self.envs}."
            )
        seeds = [as_seed(seed) for seed in self._seeds] if any(seed is not None for seed in self._seeds) else None
        observations, infos = self.envs.reset(seed=seeds)  # type: ignore[arg-type]  # one of each is allowed too
        self.reset_infos = unbatch(infos, self.num_envs)
        self._reset_seeds()
        self._begun = True
        return np.array(observations)  # the environments may write into theirs again

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: actions of all environments, (num_envs, ...)
        :raises ValueError: if actions have another shape or are not finite
        :raises ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._begun:
            raise ResetNeeded("The environments have not begun: call reset() before step().")
        actions = np.asarray(actions)
        shape = (self.num_envs, *(self.action_space.shape or ()))
        if actions.shape != shape:
            raise InvalidEnvironmentError(
                f"The actions have shape {actions.shape}, but there are {self.num_envs} environments with the action "
                f"space {self.action_space}: they must have shape {shape}."
            )
        if (index := not_finite_at(actions)) is not None:
            env = index[0]
            raise InvalidArgumentError(
                f"The action of environment {env} is {actions[env].tolist()}: it must be finite."
            )
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, terminations, truncations, infos = self.envs.step(self._actions)
        rows = unbatch(infos, self.num_envs)
        dones = terminations | truncations
        for k in np.flatnonzero(dones):
            if "final_obs" not in rows[k]:
                raise InvalidEnvironmentError(
                    f"{self.envs} ended an episode of environment {k} without info['final_obs'], the final "
                    "observation, which AutoresetMode.SAME_STEP requires."
                )
            # The info that came with the observation belongs to the next episode.
            self.reset_infos[k] = {name: v for name, v in rows[k].items() if name not in ("final_obs", "final_info")}
            rows[k] = {**rows[k].get("final_info", {}), "terminal_observation": rows[k]["final_obs"]}
        for row, timeout in zip(rows, (truncations & ~terminations).tolist(), strict=True):
            row["TimeLimit.truncated"] = timeout
        return np.array(observations), rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """:return: the attribute of the vector environment, once for each of the given environments"""
        value = getattr(self.envs if hasattr(self.envs, attr_name) else self.envs.unwrapped, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment, which all environments share."""
        self._only_all(indices, attr_name)
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices: VecEnvIndices = None, **method_kwargs) -> list[Any]:
        """Call a method of the vector environment once and return its result once for each environment."""
        self._only_all(indices, method_name)
        result = getattr(self.envs.unwrapped, method_name)(*method_args, **method_kwargs)
        return [result for _ in range(self.num_envs)]

    def env_is_wrapped(self, wrapper_class: type[Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """:return: False, since there are no single environments"""
        return [False for _ in self._get_indices(indices)]

    def _only_all(self, indices: VecEnvIndices, name: str) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise InvalidArgumentError(
                f"{name!r} concerns all {self.num_envs} environments of {self.envs}, not only {indices}."
            )


def unbatch(infos: dict[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """
    Split Gymnasium's batched infos into one dict per environment.

    :param infos: arrays with a leading axis of environments, possibly in nested dicts, each with a mask under the same
        name with a leading underscore
    :param num_envs: number of environments
    :return: the dicts
    """
    rows: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    last_mask: Any = None
    everywhere = True
    for name, value in infos.items():
        if str(name).startswith("_"):
            continue
        parts: Any
        if isinstance(value, dict):
            parts = unbatch(value, num_envs)
        else:
            parts = value.tolist() if value.ndim == 1 and value.dtype != object else value
        mask: Any = infos.get(f"_{name}")
        if mask is not last_mask:  # most infos share one, and testing it takes longer than the rest
            last_mask, everywhere = mask, mask is None or mask.all()
        if everywhere:
            for row, part in zip(rows, parts, strict=True):
                row[name] = part
        else:
            for k in np.flatnonzero(mask):
                rows[k][name] = parts[k]
    return rows


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
        _check_entries(given, info, str(self.env))


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
# What TeamEnv always gives, except agent_truncated, which follows from agents that act no more
_OF_TEAM_ENV = frozenset({"agent_rewards", "agent_terminated", "agent_active"})


def _check_entries(given: Set[str], info: Mapping[str, Any], env: str) -> None:
    if not given <= info.keys():
        lost = sorted(given - info.keys())
        raise InvalidEnvironmentError(
            f"{env} gave {', '.join(lost)} in `info`, which did not arrive: a wrapper skips steps, or returns another "
            f"`info`. Let it return the `info` that it gets, with additions. {_REMEDY}"
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
                f"The observation {when} of {self.env} has shape {array.shape}, but its space is {space}."
            )
        if space.dtype.kind in "iu" and (problem := integers_problem(array, space.dtype)) is not None:
            raise InvalidEnvironmentError(
                f"The observation of agent {problem} {when} of {self.env}, whose space is {space}."
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


def check_vec_env(vec_env: VecEnv) -> None:
    """
    Check what wrappers do to a team, in whichever process they do it, and put ``BorderEnv`` around the environments
    that are stepped in this process.

    :param vec_env: a vectorised team environment
    :raises ValueError: if wrappers change the spaces or only the team's reward, see ``check_single_envs``
    """
    inner = vec_env.unwrapped
    if not isinstance(inner, VecEnv):
        return  # SuperSuit's wrapper has environments of another kind, whose spaces are refused
    here: Any = inner if steps_its_envs(inner) else None
    if isinstance(inner, GymnasiumVecEnv) and isinstance(inner.envs.unwrapped, SyncVectorEnv):
        here = inner.envs.unwrapped
    envs = _single_envs(inner) if here is None else here.envs
    if envs:
        check_single_envs(envs)
    if here is not None:
        here.envs = [at_border(env, alone=len(envs) == 1) for env in envs]
    elif isinstance(inner, GymnasiumVecEnv):
        _warn_of_casts(inner.envs.unwrapped)
    of_pettingzoo = steps_team_envs(vec_env)
    _check_spaces(f"Wrappers of {shown(inner)} change", _spaces_of(vec_env), _spaces_of(inner), of_pettingzoo)
    if isinstance(inner, GymnasiumVecEnv):
        base = inner.envs.unwrapped
        own = (base.single_observation_space, base.single_action_space)
        _check_spaces(f"Wrappers of {base} change", _spaces_of(inner), own, of_pettingzoo)
    if not envs:
        for own in _team_spaces(inner):
            _check_spaces("A Gymnasium wrapper changes", _spaces_of(inner), own, always=True)
            for wrapper in _REWARD_WRAPPERS:
                with suppress(NotImplementedError):
                    if any(inner.env_is_wrapped(wrapper)):
                        raise _only_team_reward(wrapper.__name__)


def steps_team_envs(vec_env: VecEnv) -> bool:
    """:return: whether all environments are each a ``TeamEnv``, in whichever process"""
    inner = vec_env.unwrapped
    if not isinstance(inner, VecEnv):
        return False
    envs = inner.envs if isinstance(inner, DummyVecEnv) and steps_its_envs(inner) else _single_envs(inner)
    return all(isinstance(env.unwrapped, TeamEnv) for env in envs) if envs else bool(_team_spaces(inner))


def steps_its_envs(vec_env: VecEnv) -> bool:
    """:return: whether this is a ``DummyVecEnv``, or a subclass that does not step other things than its ``envs``"""
    return isinstance(vec_env, DummyVecEnv) and all(
        getattr(type(vec_env), name) is getattr(DummyVecEnv, name) for name in ("reset", "step_wait")
    )


def _warn_of_casts(vector: VectorEnv) -> None:
    space = vector.single_observation_space
    if isinstance(vector, AsyncVectorEnv) and space.dtype is not None and space.dtype.kind in "iu":
        if all(vector.call("has_wrapper_attr", "team_spaces")):  # TeamEnv checks what it returns
            return
        warnings.warn(
            f"AsyncVectorEnv casts observations to {space.dtype} in its processes, where NaN and numbers out of range "
            "become other numbers unnoticed: run check_team_env(env), or use SubprocVecEnv, where they are refused.",
            stacklevel=2,
        )


def _single_envs(vec_env: VecEnv) -> Sequence[Env]:
    """:return: the environments that Gymnasium's ``SyncVectorEnv`` steps in this process"""
    inner = vec_env.envs.unwrapped if isinstance(vec_env, GymnasiumVecEnv) else None
    envs = getattr(inner, "envs", ())
    return envs if isinstance(envs, (list, tuple)) and all(isinstance(env, Env) for env in envs) else ()


def _team_spaces(vec_env: VecEnv) -> list[tuple[spaces.Space, spaces.Space]]:
    """:return: the spaces of each ``TeamEnv`` in other processes"""
    inner: Any = vec_env
    if isinstance(vec_env, GymnasiumVecEnv):
        inner = vec_env.envs.unwrapped
        if not hasattr(inner, "call") or not all(inner.call("has_wrapper_attr", "team_spaces")):
            return []
        return list(inner.get_attr("team_spaces"))
    with suppress(NotImplementedError):
        if inner.has_attr("team_spaces"):
            return inner.get_attr("team_spaces")
    return []


def _spaces_of(env: Env | VecEnv) -> tuple[spaces.Space, spaces.Space]:
    return env.observation_space, env.action_space


def _check_spaces(what: str, outer: Any, inner: Any, always: bool = False) -> None:
    """
    :param what: begin of the message
    :param outer: spaces of the observation and the joint action that the algorithm sees
    :param inner: those that the environment has
    :param always: whether all spaces must stay, or only those that say what belongs to which agent
    :raises ValueError: if they differ
    """
    of_agents = (TeamObservation, MixedActions, CategoricalActions)
    for name, seen, own in zip(("observations", "actions"), outer, inner, strict=True):
        says_more = isinstance(own, of_agents)  # also than a space of the same numbers
        if (seen != own and (always or says_more)) or (says_more and not isinstance(seen, type(own))):
            lost = (
                "names, padding and action masks of the agents"
                if name == "observations"
                else "which numbers belong to which agent"
            )
            raise InvalidEnvironmentError(
                f"{what} the {name} of the team, from {shown(own)} to {shown(seen)}: {lost} would be lost. {_REMEDY}"
            )


def _only_team_reward(wrapper: str) -> InvalidEnvironmentError:
    return InvalidEnvironmentError(
        f"{wrapper} changes only the team's reward, but the algorithm learns from the agents' rewards in `info`. "
        f"{_REMEDY}"
    )


def check_single_envs(envs: Sequence[Env]) -> None:
    """
    Check environments that are stepped together.

    :param envs: the environments, which may be wrapped
    :raises ValueError: if two of them step the same environment or are of different teams, or wrappers hide a
        ``TeamEnv`` from the algorithm
    """
    stepped: dict[int, int] = {}
    for index, env in enumerate(envs):
        spaces_of_env = (env.observation_space, env.action_space)
        if spaces_of_env != (first := (envs[0].observation_space, envs[0].action_space)):
            raise InvalidEnvironmentError(
                f"Environments 0 and {index} are of different teams: {shown(first)} and {shown(spaces_of_env)}. Create "
                "all environments with the same arguments."
            )
        check_wrappers(env)
        inner: Any = env.unwrapped
        if isinstance(inner, TeamEnv):
            inner = inner.parallel_env.unwrapped
        if isinstance(inner, TurnBased):
            inner = inner.env.unwrapped
        if (other := stepped.setdefault(id(inner), index)) != index:
            raise InvalidEnvironmentError(
                f"Environments {other} and {index} step the same environment, {inner}: create one for each, for "
                "example DummyVecEnv([lambda: TeamEnv(make_env()) for _ in range(2)])."
            )


def check_wrappers(env: Env) -> None:
    """
    Check that wrappers around an environment leave what belongs to single agents as it is.

    :param env: a team environment, which may be wrapped
    :raises ValueError: if wrappers change which numbers belong to which agent, or rewards of the team alone
    """
    of_pettingzoo = isinstance(env.unwrapped, TeamEnv)
    _check_spaces(f"A Gymnasium wrapper, {env}, changes", _spaces_of(env), _spaces_of(env.unwrapped), of_pettingzoo)
    for layer in layers_of(env) if of_pettingzoo else ():
        if isinstance(layer, _REWARD_WRAPPERS):
            raise _only_team_reward(type(layer).__name__)


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
                _check_entries(self._entries, info, f"TeamEnv in environment {k}")
            if reads_parts or "agent_rewards" in info:
                self._check_reward(k, rewards.item(k), info)
            step = info["inner_step"] if "inner_step" in info else _number_in(info, "episode_step", 0)
            if step and self._steps[k] and step != self._steps[k] + 1:
                raise InvalidEnvironmentError(
                    f"Environment {k} went from step {self._steps[k]:g} to step {step:g} of its episode, so that what "
                    "happened to its agents in between is lost: a wrapper or a callback skips steps or resets the "
                    f"environment itself. {_REMEDY}"
                )
            self._steps[k] = 0 if dones[k] else step
            if dones[k]:
                self._check_cut(k, info)
            elif "terminal_observation" in info:
                raise InvalidEnvironmentError(
                    f"Environment {k} was reset, but a wrapper reports no end of its episode, so that the first "
                    f"observation of the next episode would pass for the next one of this one. {_REMEDY}"
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
                f"{_REMEDY}"
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
            remedy = _REMEDY
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
