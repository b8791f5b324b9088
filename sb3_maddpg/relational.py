"""Relational networks: actors and critics that process an agent's neighbours one by one with shared parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from itertools import chain, pairwise
from typing import Any, ClassVar, TypedDict, cast

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn
from torch.nn import functional as F

from sb3_maddpg.actions import TeamActions
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.policies import Actor, Critic, MADDPGPolicy
from sb3_maddpg.registry import allow_in_files
from sb3_maddpg.team import AgentActionSpace, Team
from sb3_maddpg.utils import shown
from sb3_maddpg.validation import PairPolicyArguments, validated


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


class PairNet(nn.Module):
    """
    Network of every pair (agent, neighbour) that also depends on the agent's whole neighbourhood. A first layer encodes
    each view. The encodings are pooled (mean and maximum, as in Deep Sets, Zaheer et al. 2017). A second network reads
    the encoding, the pool and additional inputs.

    In-place operations avoid tensors that are views, because autograd would copy their gradients. Linear layers with a
    bias return views for inputs with more than two axes.

    :param in_features: length of a view
    :param extras: lengths of the additional inputs, see ``extra``
    :param out_features: number of outputs per pair
    :param net_arch: widths of the hidden layers, the first of which is the width of the encoding
    :param activation_fn: activation function between the layers
    """

    def __init__(
        self,
        in_features: int,
        extras: Sequence[int],
        out_features: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module],
    ):
        super().__init__()
        if not net_arch:
            raise InvalidArgumentError(
                "net_arch=[]: PairPolicy needs at least one hidden layer, which encodes the views of neighbours."
            )
        width, *later = net_arch
        self.activation = nn.ReLU(inplace=True) if activation_fn is nn.ReLU else activation_fn()
        self.goes_below_zero = bool((self.activation(th.linspace(-9.0, 9.0, 181)) < 0).any())
        self.encoder = nn.Linear(in_features, width)
        widths = [*later, out_features]
        self.of_pair = nn.Linear(width, widths[0])
        self.of_pool = nn.Linear(2 * width, widths[0], bias=False)
        self.of_extras = nn.ModuleList(nn.Linear(length, widths[0], bias=False) for length in extras)
        self.later = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))

    def encode(self, views: th.Tensor, present: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        """
        Encode views and pool the encodings.

        :param views: views of neighbours, (..., n_neighbours, in_features)
        :param present: which neighbours are present, (..., n_neighbours, 1), None for all
        :return: the contribution of encoding and pool to the second network's first layer, before its activation,
            (..., n_neighbours, width), and the pool, (..., 2 * the encoding's width)
        """
        encoded = self.activation(self.encoder(views.flatten(end_dim=-2))).unflatten(0, views.shape[:-1])
        if present is None:
            mean = encoded.mean(dim=-2)
        else:
            encoded = encoded * present
            mean = encoded.sum(dim=-2) / present.sum(dim=-2).clamp(min=1.0)
        if present is not None and self.goes_below_zero:  # the zeros of absent neighbours could be the maximum
            largest = encoded.masked_fill(present == 0, -th.inf).amax(dim=-2).masked_fill(~present.any(dim=-2), 0.0)
        else:
            largest = encoded.amax(dim=-2)
        pool = th.cat([mean, largest], dim=-1)
        of_pool = self.of_pool(pool).add_(self.of_pair.bias)
        return F.linear(encoded, self.of_pair.weight).add_(of_pool.unsqueeze(-2)), pool

    def extra(self, index: int, x: th.Tensor) -> th.Tensor:
        """
        :param index: index of the additional input
        :param x: the input, (..., its length)
        :return: its contribution to the second network's first layer, before its activation, (..., width)
        """
        return self.of_extras[index](x)

    def head(self, hidden: th.Tensor) -> th.Tensor:
        """
        :param hidden: outputs of the second network's first layer, before its activation, (..., width)
        :return: the outputs, (..., out_features)
        """
        shape = hidden.shape[:-1]
        for layer in self.later:
            hidden = layer(self.activation(hidden).flatten(end_dim=-2))
        return hidden.reshape(*shape, hidden.shape[-1])


_NEVER = -120.0  # a logit whose probability is 0 in single precision


class PairActor(Actor):
    """
    Relational actor, shared by all agents: it processes neighbours one by one, is permutation-equivariant, and fits any
    number of agents. It returns an action on each neighbour, or one action that depends on all neighbours.

    :param views: splits observations into views of neighbours
    :param actions: the team's actions
    :param on_neighbours: whether the action consists of parts, one for each neighbour
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    """

    def __init__(
        self,
        views: NeighbourViews,
        actions: TeamActions,
        on_neighbours: bool,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module],
    ):
        super().__init__(actions)
        self.views = views
        self.on_neighbours = on_neighbours
        outputs = actions.width // views.n_neighbours if on_neighbours else actions.width
        self.net = PairNet(views.own_dim + views.neighbour_dim, [views.own_dim], outputs, net_arch, activation_fn)

    def logits(self, obs: th.Tensor) -> th.Tensor:
        own, neighbours, present = self.views(obs)
        each = own.unsqueeze(-2).expand(*neighbours.shape[:-1], -1)
        hidden, pool = self.net.encode(th.cat([each, neighbours], dim=-1), present)
        if self.on_neighbours:
            logits = self.net.head(hidden.add_(self.net.extra(0, own).unsqueeze(-2)))
            if self.views.mask is not None:
                logits = logits.masked_fill(self.views.mask(obs) <= 0, _NEVER)
            return self.actions.mask(logits.flatten(-2), obs)
        outputs = self.net.head(self.net.of_pool(pool) + self.net.extra(0, own) + self.net.of_pair.bias)
        return self.actions.mask(outputs, obs)

    def single(self, agent: int) -> nn.Module:
        alone = copy(self)
        alone.__dict__.pop("optimizer", None)
        return _SinglePairActor(alone)


class _SinglePairActor(nn.Module):
    """The actor of a single agent, as a team of one."""

    def __init__(self, actor: PairActor):
        super().__init__()
        self.actor = actor

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.actor.logits(obs.unsqueeze(1)).squeeze(1)


class PairCritic(Critic):
    """
    Relational critic: an agent's value is the sum over its pairs, Q_i = sum_j Q_ij. Q_ij reads i's own part, i's view
    of j, j's own part, the pool of i's neighbourhood, and the two agents' actions on each other (or their whole
    actions). With ``pair_credit`` each Q_ij is a value head, fitted to the rewards of the pair,
    ``info["pair_rewards"]``.

    :param views: splits observations into views of neighbours
    :param factors: the actions of the factors, which are pairs if agents act on neighbours, otherwise agents
    :param on_neighbours: whether the action consists of parts, one for each neighbour
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    :param pair_credit: whether pairs have their own rewards
    :param n_critics: number of critics
    """

    def __init__(
        self,
        views: NeighbourViews,
        factors: TeamActions,
        on_neighbours: bool,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module],
        pair_credit: bool = False,
        n_critics: int = 1,
    ):
        super().__init__(factors, views.n_agents, views.n_neighbours if pair_credit else 1, n_critics)
        self.pair_credit = pair_credit
        self.views = views
        self.on_neighbours = on_neighbours
        features = 2 * views.own_dim + views.neighbour_dim
        nets = (PairNet(features, [factors.width] * 2, 1, net_arch, activation_fn) for _ in range(n_critics))
        # Saved models contain this name
        self.modules_of_nets = cast("Sequence[PairNet]", nn.ModuleList(nets))

    def _pairs(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param actions: encoded actions, (batch, n_agents, width)
        :return: i's action on j and j's action on i, both (batch, n_agents, n_neighbours, the factors' width)
        """
        if not self.on_neighbours:
            mine = actions.unsqueeze(2).expand(-1, -1, self.views.n_neighbours, -1)
            return mine, self.views.of_neighbours(obs, actions)
        parts = actions.unflatten(-1, (self.views.n_neighbours, -1))
        # If i is not a neighbour of j, j does not act on i
        return parts, self.views.towards_agent(obs, parts)

    def _hidden(self, net: PairNet, obs: th.Tensor, theirs: th.Tensor) -> tuple[th.Tensor, th.Tensor | float]:
        """:return: the second network's first layer without i's own action, and which neighbours are present"""
        own, neighbours, present = self.views(obs)
        each = own.unsqueeze(-2).expand(*neighbours.shape[:-1], -1)
        hidden, _ = net.encode(th.cat([each, neighbours, self.views.of_neighbours(obs, own)], dim=-1), present)
        return hidden.add_(net.extra(1, theirs)), 1.0 if present is None else present

    def of_pairs(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Compute the values of pairs.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param actions: encoded actions, (batch, n_agents, width)
        :return: Q_ij, (n_critics, batch, n_agents * n_neighbours)
        """
        mine, theirs = self._pairs(obs, actions)
        q_values = []
        for net in self.modules_of_nets:
            hidden, present = self._hidden(net, obs, theirs)
            q_values.append((net.head(hidden.add_(net.extra(0, mine))) * present).flatten(1))
        return th.stack(q_values)

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        of_pairs = self.of_pairs(obs, actions)
        return of_pairs if self.pair_credit else self.sum_by_agent(of_pairs)

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        assert factors is None, "homogeneous agents have one kind of action"
        net = self.modules_of_nets[0]
        hidden, present = self._hidden(net, obs, self._pairs(obs, actions)[1])
        own = own.unflatten(1, hidden.shape[1:3]) if self.on_neighbours else own.unsqueeze(2)
        mine = net.extra(0, own)
        values = net.head(hidden.unsqueeze(3) + mine).squeeze(-1) * present
        return values.flatten(1, 2) if self.on_neighbours else values.sum(dim=2)

    def clip_grad_norm_(self, max_norm: float) -> None:
        for net in self.modules_of_nets:
            nn.utils.clip_grad_norm_(net.parameters(), max_norm)


@allow_in_files(name="sb3_maddpg.relational.PairPolicy")
class PairPolicy(MADDPGPolicy):
    """
    Policy for teams of homogeneous agents that observe each other, with one relational actor and one relational critic
    for all agents. The same parameters fit a team of any size:
    ``MADDPG("PairPolicy", larger_env).set_parameters("small_team.zip")``.

    :param observation_space: ``Box(n_agents, obs_dim)`` or ``TeamObservation``
    :param action_space: flat joint action, see ``Team.from_spaces``
    :param lr_schedule: learning rate schedule (could be constant)
    :param observation_layout: see ``ObservationLayout``; by default MADDPG reads it from the environment
    :param pair_credit: fit the critic of each pair to ``info["pair_rewards"]``, (n_agents, n_neighbours), whose sums
        over neighbours are the agents' rewards
    :param shared_threshold: explore with one threshold for all bits of an agent. By default, agents that act on
        neighbours explore with one threshold per neighbour.

    The other parameters are those of ``MADDPGPolicy``, except that all agents always share their networks.
    """

    env_attributes: ClassVar[tuple[str, ...]] = ("agent_names", "observation_layout")

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Any,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        observation_layout: ObservationLayout | None = None,
        pair_credit: bool = False,
        shared_threshold: bool = False,
        threshold: float = 0.5,
        random_thresholds: float = 1.0,
        n_critics: int = 1,
        agent_names: Sequence[str] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        if observation_layout is None:
            raise InvalidArgumentError(
                "PairPolicy needs to know which columns of an observation are about which neighbour: add an "
                "`observation_layout` (see sb3_maddpg.relational.ObservationLayout) to the environment as an attribute "
                "or to policy_kwargs, or use MlpPolicy."
            )
        check_layout(observation_layout)
        own = validated(PairPolicyArguments, pair_credit=pair_credit, shared_threshold=shared_threshold)
        self.observation_layout = observation_layout
        self.pair_credit = own["pair_credit"]
        self.shared_threshold = own["shared_threshold"]
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            share_actor=True,
            share_critic=True,
            threshold=threshold,
            random_thresholds=random_thresholds,
            n_critics=n_critics,
            agent_names=agent_names,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    def _make_networks(self, actor_arch: list[int], critic_arch: list[int]) -> tuple[Actor, Critic]:
        layout = self.observation_layout
        on_neighbours = layout.get("acts_on_neighbours", False)
        action_spaces = self.team.action_spaces
        views, of_critic = NeighbourViews(layout, self.team), NeighbourViews(layout, self.team, of_critic=True)
        apart = on_neighbours and not self.shared_threshold
        n_thresholds = views.n_neighbours if apart else 1
        actions = TeamActions(action_spaces, self.threshold, n_thresholds, self.random_thresholds, self.team.masks)
        factors = actions
        if on_neighbours:
            parts = [part for space in action_spaces for part in _split(space, views.n_neighbours)]
            factors = TeamActions(parts, self.threshold)
        return (
            PairActor(views, actions, on_neighbours, actor_arch, self.activation_fn),
            PairCritic(
                of_critic, factors, on_neighbours, critic_arch, self.activation_fn, self.pair_credit, self.n_critics
            ),
        )

    def resized(
        self, observation_space: spaces.Space, action_space: spaces.Space, observation_layout: ObservationLayout
    ) -> PairPolicy:
        """
        Return the same policy for a team of another size, which can act without further training.

        :param observation_space: observation space of the other team
        :param action_space: action space of the other team
        :param observation_layout: observation layout of the other team
        :return: a policy with the same weights
        :raises ValueError: if the other team's agents observe something else
        """
        arguments = self._get_constructor_parameters()
        del arguments["agent_names"]
        arguments |= {
            "observation_space": observation_space,
            "action_space": action_space,
            "observation_layout": observation_layout,
        }
        resized = type(self)(**arguments).to(self.device)
        with remedy_for_other_observations():
            resized.load_state_dict(self.state_dict())
        resized.set_training_mode(False)
        return resized

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        for name in ("share_actor", "share_critic"):
            del parameters[name]
        return {
            **parameters,
            "observation_layout": self.observation_layout,
            "pair_credit": self.pair_credit,
            "shared_threshold": self.shared_threshold,
        }


@contextmanager
def remedy_for_other_observations() -> Iterator[None]:
    """Add the remedy to PyTorch's error about differing shapes of parameters."""
    try:
        yield
    except RuntimeError as error:
        raise InvalidEnvironmentError(
            "The model was trained with other observations or networks than this team has: create the environment "
            f"with the arguments in the model's `env_spec`, except the number of agents. {error}"
        ) from error


def _split(space: AgentActionSpace, n_parts: int) -> list[AgentActionSpace]:
    """
    Split an action space into equal parts.

    :param space: an agent's action space
    :param n_parts: number of equal parts
    :return: the spaces of the parts
    :raises ValueError: if the space cannot be split
    """
    length = 1 if isinstance(space, spaces.Discrete) else space.shape[0]
    equal = not isinstance(space, spaces.MultiDiscrete) or len(set(space.nvec.tolist())) == 1
    if length % n_parts or not equal:
        raise InvalidArgumentError(
            f"observation_layout says that agents act on {n_parts} neighbours, but {space} cannot be split into as "
            "many equal parts."
        )
    k = length // n_parts
    if isinstance(space, spaces.MultiBinary):
        return [spaces.MultiBinary(k)] * n_parts
    if isinstance(space, spaces.MultiDiscrete):
        return [spaces.MultiDiscrete(part) for part in space.nvec.reshape(n_parts, k)]
    assert isinstance(space, spaces.Box)
    bounds = zip(space.low.reshape(n_parts, k), space.high.reshape(n_parts, k), strict=True)
    return [spaces.Box(low, high) for low, high in bounds]
