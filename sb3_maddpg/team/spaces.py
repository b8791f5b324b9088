"""Spaces of a team: the agents' observations with their names, and joint actions of all kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError, InvalidFileError
from sb3_maddpg.files.typed_json import Json, add_codec, few, read_box, write_box
from sb3_maddpg.utils import shown

AgentActionSpace = spaces.MultiBinary | spaces.Box | spaces.Discrete | spaces.MultiDiscrete
ACTION_SPACES = (spaces.MultiBinary, spaces.Box, spaces.Discrete, spaces.MultiDiscrete)


class TeamObservation(spaces.Box):
    """
    ``Box(n_agents, columns)`` with the names and observation spaces of the agents. Each row holds an agent's flat
    observation, padded with zeros to the longest. Additional columns hold the global state, if there is one, which
    continues from row to row.

    :param agents: name and flat observation space of each agent
    :param state: flat space of the global state, if critics should read it
    :param masks: by agent, the columns of its observation that hold its action mask: one column per category,
        sub-action after sub-action, or one per bit, positive if the choice is legal
    :param own: each agent's observation space before it was flattened, by default the flat ones
    """

    def __init__(
        self,
        agents: Mapping[str, spaces.Box],
        state: spaces.Box | None = None,
        masks: Mapping[str, Sequence[int]] | None = None,
        own: Sequence[spaces.Space] | None = None,
    ):
        self.names = tuple(agents)
        self.agent_spaces: tuple[spaces.Space, ...] = tuple(agents.values() if own is None else own)
        self.masks = tuple(tuple(map(int, (masks or {}).get(name, ()))) for name in self.names)
        self.obs_dims = tuple(int(np.prod(space.shape)) for space in agents.values())
        self.state_dim = 0 if state is None else int(np.prod(state.shape))
        n_agents, self.obs_dim = len(agents), max(self.obs_dims)
        columns = -(-self.state_dim // n_agents)
        bounds = np.zeros((2, n_agents, self.obs_dim + columns), np.float32)
        for row, (space, length) in enumerate(zip(agents.values(), self.obs_dims, strict=True)):
            # The row of a dead agent is zero, so the bounds must contain zero
            low, high = bounds_of(space)
            bounds[0, row, :length], bounds[1, row, :length] = np.minimum(low, 0), np.maximum(high, 0)
        if state is not None:
            low, high = bounds_of(state)
            padding = n_agents * columns - self.state_dim
            for bound, values in zip(bounds, (np.minimum(low, 0), np.maximum(high, 0)), strict=True):
                bound[:, self.obs_dim :] = np.pad(values, (0, padding)).reshape(n_agents, columns)
        super().__init__(bounds[0], bounds[1], dtype=np.float32)

    def __eq__(self, other: Any) -> bool:
        return super().__eq__(other) and (
            not isinstance(other, TeamObservation)
            or (self.names, self.obs_dims, self.state_dim, self.masks)
            == (other.names, other.obs_dims, other.state_dim, other.masks)
        )

    def __repr__(self) -> str:
        agents = ", ".join(f"{name}: {length}" for name, length in zip(self.names, self.obs_dims, strict=True))
        more = f", state: {self.state_dim}" if self.state_dim else ""
        return f"TeamObservation({agents}{more}{', with action masks' if any(self.masks) else ''})"


class MixedActions(spaces.Box):
    """
    Joint action space of a team with heterogeneous action spaces, as one flat ``Box``: agent after agent, with
    continuous actions unchanged, binary actions as 0 or 1, and categorical actions as indices from 0.

    :param agent_spaces: each agent's action space
    """

    def __init__(self, agent_spaces: Sequence[AgentActionSpace]):
        self.agent_spaces = tuple(agent_spaces)
        lows, highs = zip(*(bounds_of(space) for space in agent_spaces), strict=True)
        super().__init__(np.concatenate(lows), np.concatenate(highs), dtype=np.float32)

    def seed(self, seed: int | None = None) -> Any:
        for index, space in enumerate(self.agent_spaces):
            space.seed(None if seed is None else seed + index)
        return super().seed(seed)

    def sample(self, mask: None = None, probability: None = None) -> np.ndarray:
        """Sample uniformly from each agent's own action space."""
        return np.concatenate([np.ravel(_from_zero(space, space.sample())) for space in self.agent_spaces]).astype(
            np.float32
        )

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, MixedActions) and self.agent_spaces == other.agent_spaces

    def __repr__(self) -> str:
        return f"MixedActions({', '.join(map(str, self.agent_spaces))})"


class CategoricalActions(spaces.MultiDiscrete):
    """
    Joint action space of a team whose agents all have categorical actions: a ``MultiDiscrete`` of indices from 0 that
    also holds the agents' own spaces.

    :param agent_spaces: each agent's action space, all of the same length
    """

    def __init__(self, agent_spaces: Sequence[spaces.Discrete | spaces.MultiDiscrete]):
        self.agent_spaces = tuple(agent_spaces)
        super().__init__(np.concatenate([heads_of(space) for space in agent_spaces]))

    def __eq__(self, other: Any) -> bool:
        same = not isinstance(other, CategoricalActions) or self.agent_spaces == other.agent_spaces
        return super().__eq__(other) and same


def _from_zero(space: AgentActionSpace, action: Any) -> Any:
    return action - space.start if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) else action


def bounds_of(space: AgentActionSpace) -> tuple[np.ndarray, np.ndarray]:
    """:return: flat bounds in the networks' single precision, in which large double-precision bounds are infinite"""
    if isinstance(space, spaces.Box):
        with np.errstate(over="ignore"):
            return space.low.ravel().astype(np.float32), space.high.ravel().astype(np.float32)
    sizes = heads_of(space)
    return np.zeros(len(sizes), np.float32), np.array(sizes, np.float32) - 1


def heads_of(space: AgentActionSpace) -> tuple[int, ...]:
    """
    :param space: an agent's action space
    :return: number of values of each sub-action, 0 for a continuous one
    """
    if isinstance(space, spaces.Box):
        return (0,) * int(np.prod(space.shape))
    if isinstance(space, spaces.Discrete):
        return (int(space.n),)
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(size) for size in space.nvec.ravel())
    return (2,) * int(np.prod(space.shape))


def into_box(space: spaces.Box, actions: np.ndarray) -> np.ndarray:
    """
    Round actions if the space holds integers, and clip them to its bounds.

    :param space: an agent's continuous action space
    :param actions: finite numbers, (..., *shape of the space)
    :return: actions of the space, in its data type
    """
    if space.dtype.kind in "iu":
        actions = np.rint(actions)
    return np.minimum(np.maximum(actions, space.low), space.high).astype(space.dtype)  # np.clip takes twice as long


def joint_action_space(agent_spaces: Sequence[AgentActionSpace]) -> spaces.Space:
    """
    Return the joint action space of a team, flat, agent after agent: ``MultiBinary``, ``Box`` or ``MultiDiscrete`` if
    all agents have such a space of the same length, else ``MixedActions``. Categories count from 0. ``MultiBinary`` and
    ``Box`` would lose shapes and data types of the agents' spaces, if they are not flat and float32.

    :param agent_spaces: each agent's action space
    :return: the joint action space
    """
    is_plain = all(
        isinstance(space, (spaces.Discrete, spaces.MultiDiscrete))
        or (len(space.shape) == 1 and space.dtype in (np.float32, np.int8))
        for space in agent_spaces
    )
    return plain_joint_space(agent_spaces) if is_plain else MixedActions(agent_spaces)


def plain_joint_space(agent_spaces: Sequence[AgentActionSpace]) -> spaces.Space:
    """
    :param agent_spaces: each agent's action space
    :return: the joint action space, in which agents that act alike lose shape and data type of their own spaces
    """
    kinds = {type(space) for space in agent_spaces}
    sizes = [heads_of(space) for space in agent_spaces]
    if len({len(size) for size in sizes}) > 1:
        return MixedActions(agent_spaces)
    if kinds == {spaces.MultiBinary}:
        return spaces.MultiBinary(sum(map(len, sizes)))
    if kinds == {spaces.Box}:
        lows, highs = zip(*map(bounds_of, agent_spaces), strict=True)
        return spaces.Box(np.concatenate(lows), np.concatenate(highs), dtype=np.float32)
    if kinds <= {spaces.Discrete, spaces.MultiDiscrete}:
        return CategoricalActions(agent_spaces)  # type: ignore[arg-type]
    return MixedActions(agent_spaces)


def check_action_space(agent: Any, space: spaces.Space) -> None:
    """
    Check that actors support an action space.

    :param agent: name of the agent, for error messages
    :param space: the agent's action space
    :raises ValueError: if the action space is not supported
    """
    if not isinstance(space, ACTION_SPACES) or not heads_of(space):
        raise InvalidEnvironmentError(
            f"Agent {agent!r} has the action space {shown(space)}: only Discrete, MultiDiscrete, MultiBinary and Box "
            "with at least one number are supported. Flatten it with a wrapper."
        )
    if isinstance(space, spaces.Box):
        low, high = bounds_of(space)
        with np.errstate(over="ignore", invalid="ignore"):
            span = high - low
        if not (np.isfinite(span) & (span >= 0)).all():
            raise InvalidEnvironmentError(
                f"Agent {agent!r} has the action space {shown(space)}, whose bounds are infinite or too large for "
                "single precision. Actions are scaled to the bounds: choose smaller, finite ones."
            )


def check_mask(agent: Any, space: spaces.Space, length: int) -> None:
    """
    Check that an action mask fits an action space.

    :param agent: name of the agent, for error messages
    :param space: the agent's action space
    :param length: length of its action mask
    :raises ValueError: if the mask does not fit
    """
    heads = heads_of(space)  # type: ignore[arg-type]
    expected = len(heads) if isinstance(space, spaces.MultiBinary) else sum(heads)  # 0 for continuous actions
    if length != expected:
        rule = f"needs {expected}, one per category or bit" if expected else "is continuous and takes no mask"
        raise InvalidEnvironmentError(
            f"Agent {agent!r} has an action mask of {length} numbers, but its space {shown(space)} {rule}."
        )


def _write_observation(space: TeamObservation, part: Callable[[Any], Json]) -> dict[str, Json]:
    names = {"names": list(space.names), "lengths": list(space.obs_dims), "state": space.state_dim}
    masks: dict[str, Json] = {"masks": [list(mask) for mask in space.masks]} if any(space.masks) else {}
    own: dict[str, Json] = {}
    if any(not isinstance(one, spaces.Box) or len(one.shape) != 1 for one in space.agent_spaces):
        with suppress(InvalidArgumentError):  # no file holds a space of an unknown class
            own["own"] = [*map(part, space.agent_spaces)]
    return names | masks | own | write_box(space, part)


def _read_observation(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> TeamObservation:
    box, lengths, length = read_box(entry, part), entry["lengths"], entry["state"]
    own = max(lengths)
    agents = {
        name: spaces.Box(box.low[row, :columns], box.high[row, :columns], dtype=np.float32)
        for row, (name, columns) in enumerate(zip(few(entry["names"]), lengths, strict=True))
    }
    low, high = (bound[:, own:].ravel()[:length] for bound in (box.low, box.high))
    masks = dict(zip(entry["names"], entry.get("masks", []), strict=False))
    if any(not 0 <= column < own for mask in masks.values() for column in mask):
        raise InvalidFileError(f"it has action masks outside its observation of length {own}")
    given = [*map(part, few(entry["own"]))] if "own" in entry else None
    if given is not None and [_length(one) for one in given] != list(lengths):
        raise InvalidFileError(f"its agents observe {shown(given)}, which do not have the lengths {shown(lengths)}")
    space = TeamObservation(agents, spaces.Box(low, high, dtype=np.float32) if length else None, masks, given)
    if space.shape != box.shape:
        raise InvalidFileError(f"it has a team's observation of shape {box.shape} instead of {space.shape}")
    return space


def _length(space: Any) -> int | None:
    try:
        return flatdim(space)
    except (NotImplementedError, ValueError):  # it has none, or is no space
        return None


def _write_agents(space: MixedActions | CategoricalActions, part: Callable[[Any], Json]) -> dict[str, Json]:
    return {"agents": [part(one) for one in space.agent_spaces]}


def _agents(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> list[Any]:
    return [*map(part, few(entry["agents"]))]


add_codec("TeamObservation", TeamObservation, _write_observation, _read_observation)
add_codec("MixedActions", MixedActions, _write_agents, lambda entry, part: MixedActions(_agents(entry, part)))
add_codec(
    "CategoricalActions",
    CategoricalActions,
    _write_agents,
    lambda entry, part: CategoricalActions(_agents(entry, part)),
)
