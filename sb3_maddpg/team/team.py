"""What describes a team, and what an environment of a team tells."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypedDict

import numpy as np
from gymnasium import spaces

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.team.spaces import (
    ACTION_SPACES,
    AgentActionSpace,
    CategoricalActions,
    MixedActions,
    TeamObservation,
    bounds_of,
    check_action_space,
    check_mask,
)
from sb3_maddpg.utils import shown

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
                f"A team observation is a Box of shape (n_agents, obs_dim), not {shown(observation_space)}. "
                f"{_OF_TEAMS}, or stack the agents' observations along a first axis{parts}."
            )
        if not all(observation_space.shape):
            raise InvalidEnvironmentError(
                f"The observation space {shown(observation_space)} is empty: a team needs at least one agent, and an "
                "agent needs at least one column."
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


def _agents_spaces(action_space: spaces.Space, n_agents: int) -> tuple[AgentActionSpace, ...]:
    if isinstance(action_space, (MixedActions, CategoricalActions)):
        parts = action_space.agent_spaces
        if len(parts) != n_agents:
            raise InvalidEnvironmentError(
                f"{shown(action_space)} has {len(parts)} agents, but the observation has {n_agents} rows."
            )
        return parts
    if not isinstance(action_space, ACTION_SPACES) or action_space.shape is None or len(action_space.shape) != 1:
        raise InvalidEnvironmentError(
            f"A team action is a flat MultiBinary, Box or MultiDiscrete of length n_agents * action_dim, not "
            f"{shown(action_space)}, with {n_agents} agents, one per row of the observation. {_OF_TEAMS}, or flatten "
            "the space in the environment and reshape actions to (n_agents, action_dim) in step()."
        )
    (length,) = action_space.shape
    if isinstance(action_space, spaces.MultiDiscrete) and action_space.start.any():
        raise InvalidEnvironmentError(
            f"The categories of a team action count from 0, but those of {shown(action_space)} count from "
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
    bounds = bounds_of(action_space) if in_float else (action_space.low, action_space.high)
    lows, highs = (bound.reshape(n_agents, k) for bound in bounds)
    return tuple(spaces.Box(low, high, dtype=dtype) for low, high in zip(lows, highs, strict=True))
