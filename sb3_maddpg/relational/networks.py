"""Networks that see each neighbour with the same weights."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import pairwise
from typing import cast

import torch as th
from torch import nn

from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.heads import PairHeads, ValueHeads
from sb3_maddpg.common.layout import NeighbourViews
from sb3_maddpg.common.policies import Actor, Critic
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.relational.operations import Linear, largest, linear


class PairNet(nn.Module):
    """
    Network of every pair (agent, neighbour) that also depends on the agent's whole neighbourhood. A first layer encodes
    each view. The encodings are pooled (mean and maximum, as in Deep Sets, Zaheer et al. 2017). A second network reads
    the encoding, the pool and additional inputs.

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
        self.encoder = Linear(in_features, width)
        widths = [*later, out_features]
        self.of_pair = Linear(width, widths[0])
        self.of_pool = Linear(2 * width, widths[0], bias=False)
        self.of_extras = nn.ModuleList(Linear(length, widths[0], bias=False) for length in extras)
        self.later = nn.ModuleList(Linear(a, b) for a, b in pairwise(widths))

    def encode(self, views: th.Tensor, present: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        """
        Encode views and pool the encodings.

        :param views: views of neighbours, (..., n_neighbours, in_features)
        :param present: which neighbours are present, (..., n_neighbours, 1), None for all
        :return: the contribution of encoding and pool to the second network's first layer, before its activation,
            (..., n_neighbours, width), and the pool, (..., 2 * the encoding's width)
        """
        encoded = self.activation(self.encoder(views))
        if present is None:
            mean = encoded.mean(dim=-2)
        else:
            encoded = encoded * present
            mean = encoded.sum(dim=-2) / present.sum(dim=-2).clamp(min=1.0)
        if present is not None and self.goes_below_zero:  # the zeros of absent neighbours could be the maximum
            most = encoded.masked_fill(present == 0, -th.inf).amax(dim=-2).masked_fill(~present.any(dim=-2), 0.0)
        else:
            most = largest(encoded)
        pool = th.cat([mean, most], dim=-1)
        of_pool = self.of_pool(pool).add_(self.of_pair.bias)
        return linear(encoded, self.of_pair.weight).add_(of_pool.unsqueeze(-2)), pool

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
        for layer in self.later:
            hidden = layer(self.activation(hidden))
        return hidden


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
        heads = PairHeads(views.n_agents, views.n_neighbours) if pair_credit else ValueHeads(views.n_agents)
        super().__init__(factors, heads, n_critics)
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
        return of_pairs if self.pair_credit else self.heads.sum_by_agent(of_pairs)

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        assert factors is None, "homogeneous agents have one kind of action"
        net = self.modules_of_nets[0]
        hidden, present = self._hidden(net, obs, self._pairs(obs, actions)[1])
        own = own.unflatten(1, hidden.shape[1:3]) if self.on_neighbours else own.unsqueeze(2)
        # One after another, since the memory takes longer than the arithmetic
        each = [net.head(hidden + net.extra(0, alternative)) for alternative in own.unbind(3)]
        values = th.cat(each, dim=-1) * present
        return values.flatten(1, 2) if self.on_neighbours else values.sum(dim=2)

    def clip_grad_norm_(self, max_norm: float) -> None:
        for net in self.modules_of_nets:
            nn.utils.clip_grad_norm_(net.parameters(), max_norm)
