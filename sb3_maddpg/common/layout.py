"""Which columns of an observation describe which agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, TypedDict

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import shown


class ObservationLayout(TypedDict, total=False):
    """
    Meaning of the columns of an agent's observation, the same for all agents. An environment provides it as its
    attribute ``observation_layout``.

    - ``own``: columns about the agent itself;
    - ``neighbours``: the columns about each neighbour, of the same number and order for all neighbours;
    - ``who``: the indices of each agent's neighbours, by default all other agents in ascending order;
    - ``who_columns``: instead of ``who`` if neighbours change: one column per neighbour, which contains its index plus
      1, or 0 without a neighbour, and which only critics read. A neighbour keeps its position as long as it remains
      one; ``info["pair_terminated"]`` marks the positions that change;
    - ``acts_on_neighbours``: whether the action consists of equal parts, one for each neighbour;
    - ``critic``: additional columns about each neighbour that only critics read, because agents do not know them
      when they act;
    - ``action_mask``: for binary actions on neighbours, one column per neighbour, which is positive if the agent may
      act on that neighbour; otherwise the action is 0;
    - ``complete``: whether every neighbour is always present. If not, a neighbour whose columns are all zero is absent.

    Reading is fastest if the columns are contiguous, neighbour after neighbour.
    """

    own: Sequence[int]
    neighbours: Sequence[Sequence[int]]
    who: Sequence[Sequence[int]]
    who_columns: Sequence[int]
    acts_on_neighbours: bool
    critic: Sequence[Sequence[int]]
    action_mask: Sequence[int]
    complete: bool


def _others(n_agents: int) -> list[list[int]]:
    return [[other for other in range(n_agents) if other != agent] for agent in range(n_agents)]


def check_layout(layout: Any) -> None:
    """
    Check the form of an observation layout, without the team.

    :param layout: see ``ObservationLayout``
    :raises ValueError: if it is not a dict, or an entry is unknown, missing or of another type
    """
    known = ObservationLayout.__annotations__
    if not isinstance(layout, Mapping):
        raise InvalidArgumentError(
            f"observation_layout={shown(layout)} must be a dict with the entries of "
            "sb3_maddpg.relational.ObservationLayout."
        )
    if not {"own", "neighbours"} <= set(layout) <= set(known):
        raise InvalidArgumentError(
            f"observation_layout has entries {sorted(map(str, layout))}, but needs `own` and `neighbours`, and may "
            "only add `who`, `who_columns`, `acts_on_neighbours`, `critic`, `action_mask` and `complete`."
        )
    for name, value in layout.items():
        if name in ("acts_on_neighbours", "complete"):
            fits, what = isinstance(value, (bool, np.bool_)), "True or False"
        elif name in ("neighbours", "who", "critic"):
            fits = isinstance(value, (Sequence, np.ndarray)) and all(map(_are_integers, value))
            what = "a list of lists of integers"
        else:
            fits, what = _are_integers(value), "a list of integers"
        if not fits:
            raise InvalidArgumentError(f"observation_layout: {name}={shown(value)} must be {what}.")


def _are_integers(values: Any) -> bool:
    return isinstance(values, (Sequence, np.ndarray)) and all(
        isinstance(one, (int, np.integer)) and not isinstance(one, bool) for one in values
    )


def _check_layout(layout: ObservationLayout, team: Team) -> Sequence[Sequence[int]] | None:
    """:return: the indices of each agent's neighbours, None if they change"""
    neighbours = layout["neighbours"]
    hidden = layout.get("critic", [[]] * len(neighbours))
    mask = layout.get("action_mask", [0] * len(neighbours))
    numbers = layout.get("who_columns", [0] * len(neighbours))
    used = [*layout["own"], *chain(*neighbours, *hidden), *mask, *numbers]
    alike = len({len(columns) for columns in neighbours}) == len({len(columns) for columns in hidden}) == 1
    if (
        not alike
        or not len(hidden) == len(mask) == len(numbers) == len(neighbours)
        or not all(0 <= column < team.obs_dim for column in used)
    ):
        raise InvalidArgumentError(
            f"observation_layout={dict(layout)}: every neighbour needs the same number of columns, each from 0 to "
            f"{team.obs_dim - 1}."
        )
    binary = all(isinstance(space, spaces.MultiBinary) for space in team.action_spaces)
    if "action_mask" in layout and not (binary and layout.get("acts_on_neighbours")):
        raise InvalidArgumentError(
            "observation_layout: `action_mask` is for MultiBinary actions on neighbours, but the actions are "
            f"{team.action_spaces[0]} and acts_on_neighbours={layout.get('acts_on_neighbours', False)}."
        )
    if "who_columns" in layout:
        if "who" in layout or layout.get("complete"):
            raise InvalidArgumentError(
                "observation_layout: `who_columns` is for neighbours that change, so it cannot be combined with `who` "
                "or complete=True."
            )
        return None
    who = layout.get("who") or _others(team.n_agents)
    if {len(row) for row in who} != {len(neighbours)} or len(who) != team.n_agents:
        raise InvalidArgumentError(
            f"observation_layout has columns for {len(neighbours)} neighbours, but the {team.n_agents} agents have "
            f"{[len(row) for row in who]}: add `who`, `who_columns` or the missing columns."
        )
    if not all(set(row) <= set(others) for row, others in zip(who, _others(team.n_agents), strict=True)):
        raise InvalidArgumentError(
            f"observation_layout: who={who} must name other agents, by indices from 0 to {team.n_agents - 1}."
        )
    return who


class NeighbourViews(nn.Module):
    """
    Splits an observation into the agent's own part and its views of its neighbours.

    :ivar changing: whether the neighbours change, so that they are read from the observation

    :param layout: see ``ObservationLayout``
    :param team: a team of homogeneous agents
    :param of_critic: whether to include the columns that only critics read
    :raises ValueError: if agents are heterogeneous, or the layout does not fit the team
    """

    neighbour_indices: th.Tensor
    reverse_indices: th.Tensor
    n_neighbours: int
    own_dim: int
    neighbour_dim: int

    def __init__(self, layout: ObservationLayout, team: Team, of_critic: bool = False):
        super().__init__()
        for agent in range(1, team.n_agents):
            if not team.homogeneous(0, agent):
                raise InvalidEnvironmentError(
                    f"PairPolicy is for teams of homogeneous agents, but {team.names[0]} and {team.names[agent]} have "
                    "different spaces: use MlpPolicy."
                )
        who = _check_layout(layout, team)
        self.n_neighbours = len(layout["neighbours"])
        neighbours = [list(columns) for columns in layout["neighbours"]]
        if of_critic and "critic" in layout:
            neighbours = [[*seen, *hidden] for seen, hidden in zip(neighbours, layout["critic"], strict=True)]
        self.own_dim, self.neighbour_dim = len(layout["own"]), len(neighbours[0])
        self.complete = layout.get("complete", False)
        self.own = _Columns([list(layout["own"])])
        self.neighbours = _Columns(neighbours)
        self.mask = _Columns([[column] for column in layout["action_mask"]]) if "action_mask" in layout else None
        self.n_agents = team.n_agents
        self.changing = who is None
        if who is None:
            self.numbers = _Columns([[column] for column in layout["who_columns"]])
            return
        back = [[who[j].index(i) if i in who[j] else -1 for j in row] for i, row in enumerate(who)]
        for name, table in (("neighbour_indices", who), ("reverse_indices", back)):
            self.register_buffer(name, th.tensor(table, dtype=th.long), persistent=False)

    def forward(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: own parts, (batch, n_agents, own_dim), views of neighbours, (batch, n_agents, n_neighbours,
            neighbour_dim), and which neighbours are present, (batch, n_agents, n_neighbours, 1), None if all are
        """
        neighbours = self.neighbours(obs)
        present = None if self.complete else (neighbours != 0).any(dim=-1, keepdim=True).to(obs.dtype)
        return self.own(obs).squeeze(-2), neighbours, present

    def of_neighbours(self, obs: th.Tensor, what: th.Tensor) -> th.Tensor:
        """
        Return the values of each agent's neighbours.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param what: values of all agents, (batch, n_agents, ...)
        :return: values of the neighbours, (batch, n_agents, n_neighbours, ...), arbitrary for absent neighbours
        """
        if not self.changing:
            return what[:, self.neighbour_indices]
        return what[_batch(what), self._who(obs).clamp(min=0)]

    def towards_agent(self, obs: th.Tensor, what: th.Tensor) -> th.Tensor:
        """
        Swap the roles in values that agents have for their neighbours.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param what: values that agents have for each neighbour, (batch, n_agents, n_neighbours, width)
        :return: values that each neighbour has for the agent, of the same shape, 0 if the agent is not one of its
            neighbours
        """
        if not self.changing:
            return what[:, self.neighbour_indices, self.reverse_indices.clamp(min=0)] * (
                self.reverse_indices >= 0
            ).unsqueeze(-1)
        who = self._who(obs)
        theirs = who[_batch(who), who.clamp(min=0)]  # the neighbours of neighbours
        is_agent = theirs == th.arange(self.n_agents, device=obs.device)[:, None, None]
        back, mutual = is_agent.long().argmax(dim=-1), is_agent.any(dim=-1) & (who >= 0)
        return what[_batch(what), who.clamp(min=0), back] * mutual.unsqueeze(-1)

    def _who(self, obs: th.Tensor) -> th.Tensor:
        """:return: indices of the neighbours, -1 without a neighbour, (batch, n_agents, n_neighbours)"""
        return self.numbers(obs).squeeze(-1).round().long() - 1


def _batch(what: th.Tensor) -> th.Tensor:
    """:return: indices along the first axis, (batch, 1, 1)"""
    return th.arange(len(what), device=what.device)[:, None, None]


class _Columns(nn.Module):
    """
    Reads columns of observations.

    :param table: indices of the columns, (rows, width)
    """

    table: th.Tensor

    def __init__(self, table: Sequence[Sequence[int]]):
        super().__init__()
        columns = th.tensor(table, dtype=th.long).reshape(len(table), -1)
        self.register_buffer("table", columns, persistent=False)
        self.rows, self.width = columns.shape
        self.first = int(columns[0, 0]) if self.width else 0
        self.step = int(columns[1, 0] - columns[0, 0]) if self.rows > 1 and self.width else self.width
        regular = self.first + self.step * th.arange(self.rows)[:, None] + th.arange(self.width)
        self.regular = self.width > 0 and self.step >= self.width and bool((columns == regular).all())

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: observations, (..., obs_dim)
        :return: their columns, (..., rows, width)
        """
        if not self.regular:
            return obs[..., self.table]
        end = self.first + (self.rows - 1) * self.step + self.width
        return obs[..., self.first : end].unfold(-1, self.width, self.step)
