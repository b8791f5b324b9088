"""An agent's own observation and action, and their places in the rows and the joint action of its team."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.team.spaces import AgentActionSpace, heads_of, into_box
from sb3_maddpg.utils import as_numbers, shown


class AgentAction(NamedTuple):
    """The place of an agent's action in the joint action, and how to convert it."""

    begin: int
    end: int
    space: AgentActionSpace
    clips: bool
    """Whether to clip again, because the space's precision is not that of the joint action"""
    start: Any
    scalar: Any
    """The type of a number of the space"""

    def of(self, joint: np.ndarray) -> Any:
        """
        :param joint: flat joint action, in which continuous actions are within their bounds in single precision, and
            categories count from 0
        :return: the agent's action, in its space
        """
        begin, end, space, clips, start, scalar = self
        part: Any
        if isinstance(space, spaces.Discrete):
            part = joint[begin]
            return scalar(int(part) + start) if start or type(part) is not scalar else part
        if isinstance(space, spaces.Box):
            part = joint[begin:end].reshape(space.shape)
            return into_box(space, part) if clips else part
        part = joint[begin:end].astype(space.dtype).reshape(space.shape)
        if start is not None:
            part += start
        return part


def agent_actions(action_spaces: Sequence[AgentActionSpace]) -> list[AgentAction]:
    """
    :param action_spaces: each agent's action space
    :return: the place of each agent's action in the joint action
    """
    ends = np.cumsum([len(heads_of(space)) for space in action_spaces]).tolist()
    found = []
    for space, begin, end in zip(action_spaces, [0, *ends], ends, strict=False):
        start: Any = getattr(space, "start", None)
        start = int(start) if isinstance(space, spaces.Discrete) else start
        clips = isinstance(space, spaces.Box) and space.dtype != np.float32
        found.append(AgentAction(begin, end, space, clips, start, np.dtype(space.dtype).type))
    return found


def fits(space: spaces.Space, value: Any) -> bool:
    """
    Check whether a value has the structure, shapes and categories of a space. Unlike ``contains``, this accepts any
    data type.
    """
    if isinstance(space, spaces.Box):
        return np.shape(value) == space.shape
    if isinstance(space, spaces.Dict):
        return isinstance(value, Mapping) and all(
            name in value and fits(part, value[name]) for name, part in space.items()
        )
    if isinstance(space, spaces.Tuple):
        return isinstance(value, (tuple, list)) and len(value) == len(space) and all(map(fits, space, value))
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        array = np.asarray(value)
        sizes = np.array(heads_of(space))
        if array.dtype.kind not in "biuf" or array.size != len(sizes):
            return False
        index = array.ravel() - np.ravel(getattr(space, "start", 0))
        return bool(((index == np.rint(index)) & (index >= 0) & (index < sizes)).all())
    return bool(space.contains(value))


def flat(space: spaces.Space, value: Any) -> np.ndarray:
    """
    Flatten a value like Gymnasium's ``flatten``, but without casting numbers to the type of a ``Box``: NaN, infinity
    and numbers out of an integer type's range would pass for others.

    :raises ValueError: if the value does not hold real numbers
    """
    if isinstance(space, spaces.Box):
        real = type(value) is np.ndarray and value.dtype.kind in "biuf"
        return np.ravel(value if real else as_numbers(value))
    if isinstance(space, spaces.Dict):
        return np.concatenate([flat(part, value[name]) for name, part in space.items()])
    if isinstance(space, spaces.Tuple):
        return np.concatenate([*map(flat, space, value)])
    return np.asarray(flatten(space, value))


def flat_observation(agent: str, space: spaces.Space, length: int, observation: Any) -> np.ndarray:
    """
    Flatten what an agent observes.

    :param agent: name of the agent
    :param space: its observation space
    :param length: length of a flat observation
    :param observation: an observation of the space, or a flat one, (length,), or a batch of flat ones, (batch, length)
    :return: numbers, (length,) or (batch, length)
    :raises ValueError: if the observation does not fit
    """
    expected = f"has shape ({length},)"
    if not isinstance(space, spaces.Box):
        with suppress(TypeError, ValueError, LookupError, OverflowError):
            if fits(space, observation):
                return as_numbers(flat(space, observation))
        expected = f"is one of {shown(space)}, or flat and {expected}"
    if isinstance(observation, Mapping) and agent in observation:
        raise InvalidArgumentError(f"These are observations of several agents: pass observations[{agent!r}] alone.")
    try:
        obs = as_numbers(observation)
    except ValueError:
        raise InvalidArgumentError(
            f"An observation of {agent} {expected}, and holds numbers; it is not {shown(observation)}."
        ) from None
    if isinstance(space, spaces.Box) and len(space.shape) > 1 and obs.shape[1:] == space.shape:
        return obs.reshape(len(obs), -1)
    if obs.size == length and obs.shape[-1:] != (length,):
        obs = obs.ravel()
    if obs.shape[-1:] != (length,) or obs.ndim > 2:
        raise InvalidArgumentError(
            f"An observation of {agent} {expected}, not {obs.shape}. "
            f"gymnasium.spaces.flatten(env.observation_space({agent!r}), observation) flattens one."
        )
    return obs
