"""
What a team is: how many agents, what each observes, how each acts. Read from an environment's two spaces. And what else
a team environment may say of itself, see ``TeamEnvironment``, ``TeamAttributes`` and ``TeamInfo``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypedDict

import numpy as np
from gymnasium import spaces

from sb3_maddpg.utils import shown

AgentActionSpace = spaces.MultiBinary | spaces.Box | spaces.Discrete | spaces.MultiDiscrete
ACTION_SPACES = (spaces.MultiBinary, spaces.Box, spaces.Discrete, spaces.MultiDiscrete)


class TeamInfo(TypedDict, total=False):
    """
    What ``info`` of a step of a team environment may hold. Each entry may be left out, and may hold any array-like.
    """

    agent_rewards: np.ndarray
    """(n_agents,), each agent's reward. If left out: the team's reward for each"""
    agent_terminated: np.ndarray
    """(n_agents,) bool, whether the agent terminated in this step, not counting truncation. If left out: none did
    before the team"""
    agent_active: np.ndarray
    """(n_agents,) bool, whether the agent acted in this step. If left out: all did"""
    pair_rewards: np.ndarray
    """(n_agents, n_neighbours), the part of an agent's reward that belongs to each of its neighbours. If left out:
    ``pair_credit`` is refused"""
    pair_terminated: np.ndarray
    """(n_agents, n_neighbours) bool, whether what follows in this place is about another neighbour, or none. If left
    out: ``pair_credit`` is refused where neighbours change"""
    is_success: bool
    """In the last step of an episode, for ``rollout/success_rate`` and ``CurriculumCallback``"""
    metrics: dict[str, float]
    """Numbers, averaged and logged under their names"""


InfoKey = Literal["agent_rewards", "agent_terminated", "agent_active", "pair_rewards", "pair_terminated"]


class TeamEnvironment(Protocol):
    """
    What MADDPG needs of an environment: Gymnasium's interface with these spaces. ``check_team_env`` tells whether an
    environment keeps to it. Nothing has to be imported from here: the names are all that counts.
    """

    observation_space: spaces.Box
    """(n_agents, obs_dim), a row per agent; ``TeamObservation`` where rows are padded or carry a global state"""
    action_space: spaces.MultiBinary | spaces.MultiDiscrete | spaces.Box
    """Flat joint action, agent after agent, of length n_agents * k; ``MixedActions`` where agents act differently"""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """:return: observation, (n_agents, obs_dim), and info"""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: joint action, flat
        :return: observation, the team's reward, terminated, truncated, and info, see ``TeamInfo``
        """


class TeamAttributes(Protocol):
    """What a team environment may have besides. Each attribute may be left out."""

    agent_names: Sequence[str]
    """Names of the agents, for ``agent_policy``, parameter sharing and messages. If left out: agent_0, agent_1, ..."""
    observation_layout: Mapping[str, Any]
    """Which columns are about which neighbour, ``sb3_maddpg.relational.ObservationLayout``. If left out:
    ``PairPolicy`` is refused"""
    action_cost: float | np.ndarray
    """Cost of an action that the reward holds as a plain sum, a number or (n_agents, width). If left out:
    ``use_action_cost`` is refused"""
    n_curriculum_levels: int
    """Number of levels, for ``CurriculumCallback``, which is refused if this or the next is left out"""

    def set_curriculum_level(self, level: int) -> None:
        """:param level: from 0 to ``n_curriculum_levels - 1``, for the next episodes"""


class TeamObservation(spaces.Box):
    """
    ``Box(n_agents, columns)`` that remembers whose rows it has. Each row is an agent's flat observation, padded with
    zeros to the longest, then the agent's share of the global state, which is laid out row after row in as many
    further columns as it needs.

    :param agents: name and flat observation space of each agent
    :param state: flat space of the global state, if critics are to read it
    :param masks: for agents whose observation holds an action mask the columns of it: one for each category, sub-action
        after sub-action, or for each bit; positive where the agent may choose it
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
            # A dead agent's row is zero, which the bounds have to admit
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
    The joint action of a team with heterogeneous action spaces, as one flat ``Box``: agent after agent, continuous
    actions as they are, binary ones as 0 or 1, categorical ones as their index from 0.

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
        """Uniform in each agent's own space."""
        return np.concatenate([np.ravel(_from_zero(space, space.sample())) for space in self.agent_spaces]).astype(
            np.float32
        )

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, MixedActions) and self.agent_spaces == other.agent_spaces

    def __repr__(self) -> str:
        return f"MixedActions({', '.join(map(str, self.agent_spaces))})"


class CategoricalActions(spaces.MultiDiscrete):
    """
    The joint action of a team whose agents all have categorical actions: a ``MultiDiscrete`` of their indices from 0
    that remembers the agents' own spaces.

    :param agent_spaces: each agent's action space, all of one length
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
    """Flat bounds in the networks' precision, in which a huge bound of double precision is infinite."""
    if isinstance(space, spaces.Box):
        with np.errstate(over="ignore"):
            return space.low.ravel().astype(np.float32), space.high.ravel().astype(np.float32)
    sizes = heads_of(space)
    return np.zeros(len(sizes), np.float32), np.array(sizes, np.float32) - 1


def heads_of(space: AgentActionSpace) -> tuple[int, ...]:
    """
    :param space: an agent's action space
    :return: number of values of each of its sub-actions, 0 for a continuous one
    """
    if isinstance(space, spaces.Box):
        return (0,) * int(np.prod(space.shape))
    if isinstance(space, spaces.Discrete):
        return (int(space.n),)
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(size) for size in space.nvec.ravel())
    return (2,) * int(np.prod(space.shape))


def joint_action_space(agent_spaces: Sequence[AgentActionSpace]) -> spaces.Space:
    """
    The joint action space of a team, flat, agent after agent: ``MultiBinary``, ``Box`` or ``MultiDiscrete`` where all
    agents have such a space of one length, else ``MixedActions``. Categories count from 0.

    :param agent_spaces: each agent's action space
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
    A team as its networks see it.

    :param names: of the agents, each once
    :param obs_dims: length of each agent's observation without padding
    :param obs_dim: the longest of them
    :param state_dim: length of the global state, 0 without
    :param action_spaces: each agent's action space, categories counting from 0
    :param masks: columns of each agent's action mask, none for an agent without, see ``TeamObservation``; empty where
        no agent has one
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
        :param agent: name or number of an agent
        :return: its number
        :raises ValueError: no such agent
        """
        if isinstance(agent, str) and agent in self.names:
            return self.names.index(agent)
        if isinstance(agent, (int, np.integer)) and not isinstance(agent, bool) and 0 <= agent < self.n_agents:
            return int(agent)
        raise ValueError(
            f"There is no agent {shown(agent)}: the agents are {', '.join(self.names)}, or 0 to {self.n_agents - 1}."
        )

    def homogeneous(self, agent: int, other: int) -> bool:
        """
        :param agent: number of an agent
        :param other: number of another
        :return: whether they observe and act in the same spaces, so that they could share a network
        """
        same_obs = self.obs_dims[agent] == self.obs_dims[other]
        same_masks = not self.masks or self.masks[agent] == self.masks[other]
        return same_obs and same_masks and self.action_spaces[agent] == self.action_spaces[other]

    @classmethod
    def from_spaces(
        cls, observation_space: spaces.Space, action_space: spaces.Space, names: Sequence[str] | None = None
    ) -> Team:
        """
        Read the team out of its spaces and refuse spaces that do not describe one.

        :param observation_space: ``Box(n_agents, obs_dim)`` or ``TeamObservation``
        :param action_space: flat joint action, agent after agent: ``MultiBinary``, ``Box`` or ``MultiDiscrete`` of
            length ``n_agents * k``, or ``MixedActions``
        :param names: of the agents; those of the observation space, or agent_0, agent_1, ..., unless given
        :raises ValueError: other spaces, or names that do not fit
        """
        if isinstance(observation_space, spaces.Dict):
            raise ValueError(
                f"A team observation is a Box of shape (n_agents, obs_dim), not {observation_space}. Flatten each "
                "agent's dictionary, as the adapter for PettingZoo environments does (sb3_maddpg.parallel)."
            )
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 2:
            raise ValueError(
                f"A team observation is a Box of shape (n_agents, obs_dim), not {observation_space}. "
                "Stack the agents' observations along a first axis; pad them if they differ in length."
            )
        if not all(observation_space.shape):
            raise ValueError(
                f"The observation space {observation_space} is empty: a team needs at least one agent, and an agent at "
                "least one column."
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
            raise ValueError(f"There are {len(names)} names, {', '.join(names)}, for {n_agents} agents.")
        if len(set(names)) < n_agents:
            raise ValueError(f"An agent's name occurs twice: {', '.join(names)}.")
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
    :param agent: its name, for the message
    :param space: its action space
    :raises ValueError: an action space that actors cannot have
    """
    if not isinstance(space, ACTION_SPACES) or not heads_of(space):
        raise ValueError(
            f"Agent {agent!r} has the action space {space}: only Discrete, MultiDiscrete, MultiBinary and Box with at "
            "least one number are supported. Flatten it with a wrapper."
        )
    if isinstance(space, spaces.Box):
        low, high = _bounds(space)
        with np.errstate(over="ignore", invalid="ignore"):
            span = high - low
        if not (np.isfinite(span) & (span >= 0)).all():
            raise ValueError(
                f"Agent {agent!r} has the action space {space} without bounds, which say how far actions reach, or "
                "with bounds too large for single precision. Give it smaller, finite ones."
            )


def check_mask(agent: Any, space: spaces.Space, length: int) -> None:
    """
    :param agent: its name, for the message
    :param space: its action space
    :param length: of its action mask
    :raises ValueError: a mask that does not fit
    """
    heads = heads_of(space)  # type: ignore[arg-type]
    expected = len(heads) if isinstance(space, spaces.MultiBinary) else sum(heads)  # 0 for continuous actions
    if length != expected:
        rule = "one number for each category, or for each bit" if expected else "none: it has continuous actions"
        raise ValueError(f"Agent {agent!r} has an action mask of {length} numbers; its space {space} takes {rule}.")


def _agents_spaces(action_space: spaces.Space, n_agents: int) -> tuple[AgentActionSpace, ...]:
    if isinstance(action_space, (MixedActions, CategoricalActions)):
        parts = action_space.agent_spaces
        if len(parts) != n_agents:
            raise ValueError(f"{action_space} has {len(parts)} agents, but the observation has {n_agents} rows.")
        return parts
    if not isinstance(action_space, ACTION_SPACES) or action_space.shape is None or len(action_space.shape) != 1:
        raise ValueError(
            f"A team action is flat, a MultiBinary, Box or MultiDiscrete of length n_agents * action_dim, not "
            f"{action_space}. Flatten it in the environment and reshape it there to (n_agents, action_dim)."
        )
    (length,) = action_space.shape
    if isinstance(action_space, spaces.MultiDiscrete) and action_space.start.any():
        raise ValueError(
            f"The categories of a team action count from 0, but those of {action_space} from "
            f"start={action_space.start.tolist()}. Leave `start` out and add it in step(), or make a TeamEnv of a "
            "PettingZoo environment, which does so."
        )
    if length % n_agents:
        raise ValueError(
            f"A joint action of {length} numbers cannot be shared out evenly among {n_agents} agents. "
            "Give every agent the same number of actions, or describe the team with sb3_maddpg.team.MixedActions."
        )
    k = length // n_agents
    if isinstance(action_space, spaces.MultiBinary):
        return tuple(spaces.MultiBinary(k) for _ in range(n_agents))
    if isinstance(action_space, spaces.MultiDiscrete):
        return tuple(spaces.MultiDiscrete(nvec) for nvec in action_space.nvec.reshape(n_agents, k))
    lows, highs = (bound.reshape(n_agents, k) for bound in _bounds(action_space))
    return tuple(spaces.Box(low, high, dtype=np.float32) for low, high in zip(lows, highs, strict=True))
