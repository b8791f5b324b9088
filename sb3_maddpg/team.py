"""
Teams: the number of agents, their observations and their actions, read from the spaces of an environment. The protocols
``TeamEnvironment``, ``TeamAttributes`` and ``TeamInfo`` describe what a team environment provides.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypedDict

import numpy as np
from gymnasium import spaces

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError, InvalidFileError
from sb3_maddpg.typed_json import Json, add_codec, few, read_box, write_box
from sb3_maddpg.utils import shown

AgentActionSpace = spaces.MultiBinary | spaces.Box | spaces.Discrete | spaces.MultiDiscrete
ACTION_SPACES = (spaces.MultiBinary, spaces.Box, spaces.Discrete, spaces.MultiDiscrete)
_INTEGER = re.compile("0|-?[1-9][0-9]*")
_OF_TEAMS = (
    "If this is a single-agent environment, use an algorithm of Stable-Baselines3, such as PPO. For a team, pass a "
    "PettingZoo environment itself, not vectorised by other libraries"
)


class TeamInfo(TypedDict, total=False):
    """
    The ``info`` dictionary that ``step`` of a team environment returns. All entries are optional; arrays may be any
    array-like.
    """

    agent_rewards: np.ndarray
    """Each agent's reward, (n_agents,). By default, every agent gets the team's reward."""
    agent_terminated: np.ndarray
    """Whether each agent terminated in this step, (n_agents,) bool. Truncation does not count. By default, no agent
    terminates before the team."""
    agent_truncated: np.ndarray
    """Whether each agent was truncated in this step, (n_agents,) bool, although others go on. It bootstraps from its
    last observation, while the others go on without it. By default, agents are truncated before the team that act no
    more in the next step without having terminated."""
    agent_active: np.ndarray
    """Whether each agent acted in this step, (n_agents,) bool. By default, all agents acted."""
    pair_rewards: np.ndarray
    """The part of each agent's reward that belongs to each of its neighbours, (n_agents, n_neighbours). Required for
    ``pair_credit``."""
    pair_terminated: np.ndarray
    """Whether another neighbour, or none, takes the place of each neighbour after this step, (n_agents, n_neighbours)
    bool. Required for ``pair_credit`` if neighbours change."""
    is_success: bool
    """Whether the episode succeeded, in its last step. Used by ``rollout/success_rate`` and ``CurriculumCallback``."""
    metrics: dict[str, float]
    """Numbers whose means are logged under their keys."""
    team_reward: float
    """The reward that ``step`` returns, from which the algorithm sees that a wrapper changed it. Required in other
    processes if there are ``agent_rewards`` and the team's reward is neither their mean nor their sum."""
    episode_step: int
    """Number of the step in its episode, from 1, from which the algorithm sees that a wrapper skipped steps."""


InfoKey = Literal[
    "agent_rewards", "agent_terminated", "agent_truncated", "agent_active", "pair_rewards", "pair_terminated"
]


class TeamEnvironment(Protocol):
    """
    The interface of a team environment: Gymnasium's interface with the following spaces. ``check_team_env`` checks
    whether an environment follows it. Environments need not inherit from this protocol.
    """

    observation_space: spaces.Box
    """Observations, (n_agents, obs_dim), one row per agent. ``TeamObservation`` if rows are padded or hold a global
    state."""
    action_space: spaces.MultiBinary | spaces.MultiDiscrete | spaces.Box
    """Flat joint action of length n_agents * k, agent after agent. ``MixedActions`` if the agents' action spaces
    differ."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """:return: observation, (n_agents, obs_dim), and info"""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: flat joint action
        :return: observation, team reward, terminated, truncated, and info, see ``TeamInfo``
        """


class TeamAttributes(Protocol):
    """Optional attributes of a team environment."""

    agent_names: Sequence[str]
    """Names of the agents, for ``agent_policy``, parameter sharing and messages. By default agent_0, agent_1, ..."""
    observation_layout: Mapping[str, Any]
    """Meaning of the columns of an observation, see ``sb3_maddpg.relational.ObservationLayout``. Required for
    ``PairPolicy``."""
    action_cost: float | np.ndarray
    """Price of one unit of the encoded action, a number or (n_agents, width). The reward must contain the cost as a
    plain sum over the encoded action. Required for ``use_action_cost``."""
    depends_on: Mapping[str, str]
    """Names and versions of what exact results depend on besides the sources, such as a solver, for checkpoints."""
    n_curriculum_levels: int
    """Number of curriculum levels. Required for ``CurriculumCallback``, as is ``set_curriculum_level``."""

    def set_curriculum_level(self, level: int) -> None:
        """
        Set the curriculum level of the next episodes.

        :param level: the level, from 0 to ``n_curriculum_levels - 1``
        """


class TeamObservation(spaces.Box):
    """
    ``Box(n_agents, columns)`` with the names and observation spaces of the agents. Each row holds an agent's flat
    observation, padded with zeros to the longest. Additional columns hold the global state, if there is one, which
    continues from row to row.

    :param agents: name and flat observation space of each agent
    :param state: flat space of the global state, if critics should read it
    :param masks: by agent, the columns of its observation that hold its action mask: one column per category,
        sub-action after sub-action, or one per bit, positive if the choice is legal
    """

    def __init__(
        self,
        agents: Mapping[str, spaces.Box],
        state: spaces.Box | None = None,
        masks: Mapping[str, Sequence[int]] | None = None,
    ):
        self.names = tuple(agents)
        self.masks = tuple(tuple(map(int, (masks or {}).get(name, ()))) for name in self.names)
        self.obs_dims = tuple(int(np.prod(space.shape)) for space in agents.values())
        self.state_dim = 0 if state is None else int(np.prod(state.shape))
        n_agents, self.obs_dim = len(agents), max(self.obs_dims)
        columns = -(-self.state_dim // n_agents)
        bounds = np.zeros((2, n_agents, self.obs_dim + columns), np.float32)
        for row, (space, length) in enumerate(zip(agents.values(), self.obs_dims, strict=True)):
            # The row of a dead agent is zero, so the bounds must contain zero
            low, high = _bounds(space)
            bounds[0, row, :length], bounds[1, row, :length] = np.minimum(low, 0), np.maximum(high, 0)
        if state is not None:
            low, high = _bounds(state)
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
        lows, highs = zip(*(_bounds(space) for space in agent_spaces), strict=True)
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


def _bounds(space: AgentActionSpace) -> tuple[np.ndarray, np.ndarray]:
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
        lows, highs = zip(*map(_bounds, agent_spaces), strict=True)
        return spaces.Box(np.concatenate(lows), np.concatenate(highs), dtype=np.float32)
    if kinds <= {spaces.Discrete, spaces.MultiDiscrete}:
        return CategoricalActions(agent_spaces)  # type: ignore[arg-type]
    return MixedActions(agent_spaces)


@dataclass(frozen=True)
class Team:
    """
    Description of a team for its networks.

    :param names: unique names of the agents
    :param obs_dims: length of each agent's observation without padding
    :param obs_dim: length of the longest observation
    :param state_dim: length of the global state, 0 without one
    :param action_spaces: each agent's action space, categories counting from 0
    :param masks: columns of each agent's action mask, see ``TeamObservation``; empty if no agent has one
    """

    names: tuple[str, ...]
    obs_dims: tuple[int, ...]
    obs_dim: int
    state_dim: int
    action_spaces: tuple[AgentActionSpace, ...]
    masks: tuple[tuple[int, ...], ...] = ()

    @property
    def n_agents(self) -> int:
        """Number of agents."""
        return len(self.names)

    def index(self, agent: str | int) -> int:
        """
        :param agent: name or index of an agent; a name if all names are integers, as in ``possible_agents = [1, 2]``
        :return: the agent's index
        :raises ValueError: if there is no such agent
        """
        # Also an environment's own ids, such as (0, 1); plain integers may be positions
        if (type(agent) not in (bool, int) and not isinstance(agent, np.integer)) and str(agent) in self.names:
            return self.names.index(str(agent))
        named_by_integers = all(_INTEGER.fullmatch(name) for name in self.names)
        numbers = list(map(int, self.names)) if named_by_integers else range(self.n_agents)
        if isinstance(agent, (int, np.integer)) and not isinstance(agent, bool) and agent in numbers:
            return numbers.index(agent)
        positions = "" if named_by_integers else f", or 0 to {self.n_agents - 1}"
        raise InvalidArgumentError(
            f"There is no agent {shown(agent)}: the agents are {', '.join(self.names)}{positions}."
        )

    def homogeneous(self, agent: int, other: int) -> bool:
        """
        :param agent: index of an agent
        :param other: index of another agent
        :return: whether the agents have the same observation and action spaces, so that they could share a network
        """
        same_obs = self.obs_dims[agent] == self.obs_dims[other]
        same_masks = not self.masks or self.masks[agent] == self.masks[other]
        return same_obs and same_masks and self.action_spaces[agent] == self.action_spaces[other]

    @classmethod
    def from_spaces(
        cls, observation_space: spaces.Space, action_space: spaces.Space, names: Sequence[str] | None = None
    ) -> Team:
        """
        Create the description of a team from its spaces.

        :param observation_space: ``Box(n_agents, obs_dim)`` or ``TeamObservation``
        :param action_space: flat joint action, agent after agent: ``MultiBinary``, ``Box`` or ``MultiDiscrete`` of
            length ``n_agents * k``, or ``MixedActions``
        :param names: names of the agents, by default those of the observation space, or agent_0, agent_1, ...
        :return: the team
        :raises ValueError: if the spaces do not describe a team, or the names do not fit
        """
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 2:
            parts = ", each flattened if it is a Dict or Tuple" if hasattr(observation_space, "spaces") else ""
            raise InvalidEnvironmentError(
                f"A team observation is a Box of shape (n_agents, obs_dim), not {observation_space}. {_OF_TEAMS}, or "
                f"stack the agents' observations along a first axis{parts}."
            )
        if not all(observation_space.shape):
            raise InvalidEnvironmentError(
                f"The observation space {observation_space} is empty: a team needs at least one agent, and an agent "
                "needs at least one column."
            )
        n_agents, obs_dim = observation_space.shape
        if isinstance(observation_space, TeamObservation):
            shape = (observation_space.obs_dims, observation_space.obs_dim, observation_space.state_dim)
            names = names or observation_space.names
        else:
            shape = ((obs_dim,) * n_agents, obs_dim, 0)
            names = names or [f"agent_{index}" for index in range(n_agents)]
        names = tuple(map(str, names))
        if len(names) != n_agents:
            raise InvalidEnvironmentError(f"There are {len(names)} names, {', '.join(names)}, for {n_agents} agents.")
        if len(set(names)) < n_agents:
            raise InvalidEnvironmentError(f"An agent's name occurs twice: {', '.join(names)}.")
        action_spaces = _agents_spaces(action_space, n_agents)
        for name, space in zip(names, action_spaces, strict=True):
            check_action_space(name, space)
        masks: tuple[tuple[int, ...], ...] = getattr(observation_space, "masks", ())
        for name, space, columns in zip(names, action_spaces, masks, strict=False):
            if columns:
                check_mask(name, space, len(columns))
        return cls(names, *shape, action_spaces, masks if any(masks) else ())


def check_action_space(agent: Any, space: spaces.Space) -> None:
    """
    Check that actors support an action space.

    :param agent: name of the agent, for error messages
    :param space: the agent's action space
    :raises ValueError: if the action space is not supported
    """
    if not isinstance(space, ACTION_SPACES) or not heads_of(space):
        raise InvalidEnvironmentError(
            f"Agent {agent!r} has the action space {space}: only Discrete, MultiDiscrete, MultiBinary and Box with at "
            "least one number are supported. Flatten it with a wrapper."
        )
    if isinstance(space, spaces.Box):
        low, high = _bounds(space)
        with np.errstate(over="ignore", invalid="ignore"):
            span = high - low
        if not (np.isfinite(span) & (span >= 0)).all():
            raise InvalidEnvironmentError(
                f"Agent {agent!r} has the action space {space}, whose bounds are infinite or too large for single "
                "precision. Actions are scaled to the bounds: choose smaller, finite ones."
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
            f"Agent {agent!r} has an action mask of {length} numbers, but its space {space} {rule}."
        )


def _agents_spaces(action_space: spaces.Space, n_agents: int) -> tuple[AgentActionSpace, ...]:
    if isinstance(action_space, (MixedActions, CategoricalActions)):
        parts = action_space.agent_spaces
        if len(parts) != n_agents:
            raise InvalidEnvironmentError(
                f"{action_space} has {len(parts)} agents, but the observation has {n_agents} rows."
            )
        return parts
    if not isinstance(action_space, ACTION_SPACES) or action_space.shape is None or len(action_space.shape) != 1:
        raise InvalidEnvironmentError(
            f"A team action is a flat MultiBinary, Box or MultiDiscrete of length n_agents * action_dim, not "
            f"{action_space}, with {n_agents} agents, one per row of the observation. {_OF_TEAMS}, or flatten the "
            "space in the environment and reshape actions to (n_agents, action_dim) in step()."
        )
    (length,) = action_space.shape
    if isinstance(action_space, spaces.MultiDiscrete) and action_space.start.any():
        raise InvalidEnvironmentError(
            f"The categories of a team action count from 0, but those of {action_space} count from "
            f"start={action_space.start.tolist()}. Leave `start` out and add it in step(), or wrap a PettingZoo "
            "environment in a TeamEnv, which does so."
        )
    if length % n_agents:
        raise InvalidEnvironmentError(
            f"A joint action of {length} numbers cannot be divided evenly among {n_agents} agents, one per row of the "
            "observation. Give every agent the same number of actions, or describe the team with "
            f"sb3_maddpg.team.MixedActions. {_OF_TEAMS}."
        )
    k = length // n_agents
    if isinstance(action_space, spaces.MultiBinary):
        return tuple(spaces.MultiBinary(k) for _ in range(n_agents))
    if isinstance(action_space, spaces.MultiDiscrete):
        return tuple(spaces.MultiDiscrete(nvec) for nvec in action_space.nvec.reshape(n_agents, k))
    assert isinstance(action_space, spaces.Box)
    # The networks' single precision serves for all but integers and half precision
    in_float = action_space.dtype in (np.float32, np.float64)
    dtype = np.float32 if in_float else action_space.dtype.type
    bounds = _bounds(action_space) if in_float else (action_space.low, action_space.high)
    lows, highs = (bound.reshape(n_agents, k) for bound in bounds)
    return tuple(spaces.Box(low, high, dtype=dtype) for low, high in zip(lows, highs, strict=True))


def _write_observation(space: TeamObservation, part: Callable[[Any], Json]) -> dict[str, Json]:
    names = {"names": list(space.names), "lengths": list(space.obs_dims), "state": space.state_dim}
    masks: dict[str, Json] = {"masks": [list(mask) for mask in space.masks]} if any(space.masks) else {}
    return names | masks | write_box(space, part)


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
    space = TeamObservation(agents, spaces.Box(low, high, dtype=np.float32) if length else None, masks)
    if space.shape != box.shape:
        raise InvalidFileError(f"it has a team's observation of shape {box.shape} instead of {space.shape}")
    return space


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
