"""Checks of environments that are stepped together, and of the wrappers around them."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from gymnasium import Env, RewardWrapper, spaces
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import TeamEnv, TurnBased, layers_of
from sb3_maddpg.team.spaces import CategoricalActions, MixedActions, TeamObservation
from sb3_maddpg.utils import shown
from sb3_maddpg.vec_env.border import REMEDY, at_border
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

_REWARD_WRAPPERS = (RewardWrapper, NormalizeReward)


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
    _check_spaces(f"{_wrappers_of(vec_env)} change", _spaces_of(vec_env), _spaces_of(inner), of_pettingzoo)
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


def _wrappers_of(vec_env: VecEnv) -> str:
    """:return: the names of the wrappers around a vectorised environment"""
    names, env = [], vec_env
    while isinstance(env, VecEnvWrapper):
        names.append(type(env).__name__)
        env = env.venv
    return f"The wrappers {', '.join(names)}"


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
                f"{what} the {name} of the team, from {shown(own)} to {shown(seen)}: {lost} would be lost. {REMEDY}"
            )


def _only_team_reward(wrapper: str) -> InvalidEnvironmentError:
    return InvalidEnvironmentError(
        f"{wrapper} changes only the team's reward, but the algorithm learns from the agents' rewards in `info`. "
        f"{REMEDY}"
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
