"""Policies of a team: decentralised actors, centralised critics and their targets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_maddpg.actions import TeamActions
from sb3_maddpg.networks import StackedMLP
from sb3_maddpg.team import MixedActions, Team
from sb3_maddpg.utils import all_finite, as_numbers, shown
from sb3_maddpg.validation import PolicyArguments, ThresholdArgument, validated

Sharing = bool | Sequence[Sequence[str | int]]


def sharing_groups(share: Sharing, team: Team, argument: str) -> list[int]:
    """
    :param share: True: all agents share one network (parameter sharing), False: each has its own, or lists of agents
        that share one
    :param team: whose agents
    :param argument: name of the argument, for the error's message
    :return: for each agent the number of its network
    :raises ValueError: something else, an agent in two lists, or heterogeneous agents in one
    """
    if isinstance(share, bool):
        lists = [list(range(team.n_agents))] if share else []
    else:
        try:
            if isinstance(share, str):
                raise TypeError
            lists = [[team.index(agent) for agent in agents] for agents in share]
        except TypeError:
            raise ValueError(
                f"{argument}={shown(share)} must be True, False or lists of agents that share a network; share_critic "
                'may also be "team".'
            ) from None
    named = [agent for agents in lists for agent in agents]
    if len(set(named)) < len(named):
        raise ValueError(f"{argument}={share} names an agent twice: an agent has one network.")
    for first, *others in filter(None, lists):
        for other in others:
            if not team.homogeneous(first, other):
                raise ValueError(
                    f"{argument}={share}: {team.names[first]} and {team.names[other]} have different spaces and "
                    "cannot share a network. Give lists of homogeneous agents, or False."
                )
    lists += [[agent] for agent in range(team.n_agents) if agent not in named]
    groups = [0] * team.n_agents
    for number, agents in enumerate(sorted(filter(None, lists))):
        for agent in agents:
            groups[agent] = number
    return groups


class Actor(nn.Module):
    """
    Decentralised actors: agent i's output depends on its own observation only.

    :param actions: how the team acts
    """

    optimizer: th.optim.Optimizer

    def __init__(self, actions: TeamActions):
        super().__init__()
        self.actions = actions

    def logits(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim or more)
        :return: the networks' outputs before they are squashed, minus infinity where an action mask forbids a choice
            (``TeamActions.mask``), (batch, n_agents, width)
        """
        raise NotImplementedError

    def single(self, agent: int) -> nn.Module:
        """
        :param agent: which one
        :return: a network that maps its observation without padding, (batch, its obs_dim), to outputs, (batch, width),
            which no action mask has touched
        """
        raise NotImplementedError

    def clip_grad_norm_(self, max_norm: float) -> None:
        """
        :param max_norm: largest norm of each network's gradient
        """
        raise NotImplementedError

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim or more)
        :return: probabilities or continuous actions, (batch, n_agents, width)
        """
        return self.actions.squash(self.logits(obs))

    def act(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim or more)
        :param deterministic: without exploration, see ``TeamActions``
        :return: encoded actions, (batch, n_agents, width)
        """
        return self.actions.act(self.logits(obs), deterministic)


class MLPActor(Actor):
    """
    One multi-layer perceptron per agent.

    :param team: the team
    :param actions: how it acts
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param groups: for each agent the number of its network
    """

    def __init__(
        self,
        team: Team,
        actions: TeamActions,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        groups: Sequence[int] | None = None,
    ):
        super().__init__(actions)
        self.team = team
        self.net = StackedMLP(groups or range(team.n_agents), team.obs_dim, actions.width, net_arch, activation_fn)

    def logits(self, obs: th.Tensor) -> th.Tensor:
        outputs = self.net(obs[..., : self.team.obs_dim].permute(1, 2, 0)).permute(2, 0, 1)
        return self.actions.mask(outputs, obs)

    def single(self, agent: int) -> nn.Module:
        return self.net.single(agent, self.team.obs_dims[agent])

    def clip_grad_norm_(self, max_norm: float) -> None:
        self.net.clip_grad_norm_(max_norm)


class Critic(nn.Module):
    """
    Centralised critics (centralised training, decentralised execution): they read all observations and all actions.

    Credit assignment: an agent may have several value heads, each fitted to rewards of its own, and its action may be
    made of several factors, whose policy gradients are estimated independently. Heads and factors lie agent after
    agent, the same number for each; in the plain case each agent has one of both.

    :param factors: how the factors of the joint action act
    :param n_agents: number of agents
    :param values_per_agent: number of value heads of an agent
    :param n_critics: number of critics (two for MATD3)
    """

    optimizer: th.optim.Optimizer
    agent_of_value: th.Tensor

    def __init__(self, factors: TeamActions, n_agents: int, values_per_agent: int = 1, n_critics: int = 1):
        super().__init__()
        self.factors = factors
        self.n_agents = n_agents
        self.n_critics = n_critics
        self.register_buffer(
            "agent_of_value", th.arange(n_agents).repeat_interleave(values_per_agent), persistent=False
        )

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim or more)
        :param actions: (batch, n_agents, width)
        :return: Q-values, (n_critics, batch, n_values)
        """
        raise NotImplementedError

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        """
        The first critic's Q-value with one factor's action replaced and everything else kept.

        :param obs: (batch, n_agents, obs_dim or more)
        :param actions: (batch, n_agents, width); the factor's own part is not read
        :param own: alternatives for the factor's action, (batch, len(factors), M, the factors' width)
        :param factors: which factors, None for all
        :return: (batch, len(factors), M)
        """
        raise NotImplementedError

    def clip_grad_norm_(self, max_norm: float) -> None:
        """
        :param max_norm: largest norm of each network's gradient
        """
        raise NotImplementedError

    def factored(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: actions or logits of agents, (batch, n_agents, width)
        :return: those of factors, (batch, n_factors, the factors' width)
        """
        return actions.reshape(len(actions), -1, self.factors.width)

    def rewards(self, of_agents: th.Tensor) -> th.Tensor:
        """
        :param of_agents: (batch, n_agents)
        :return: what each value head is fitted to, (batch, n_values)
        """
        return of_agents

    def per_value(self, of_agents: th.Tensor) -> th.Tensor:
        """
        :param of_agents: (batch, n_agents)
        :return: broadcast to the agents' value heads, (batch, n_values)
        """
        one_each = len(self.agent_of_value) == self.n_agents
        return of_agents if one_each else of_agents[..., self.agent_of_value]

    def owners(self, values: th.Tensor) -> th.Tensor:
        """
        :param values: numbers of value heads, (any number,)
        :return: the agents whose values these are, (any number,)
        """
        return self.agent_of_value[values]

    def cost_of_factors(self, action_cost: th.Tensor) -> th.Tensor:
        """
        :param action_cost: (n_agents, width)
        :return: what a factor's action takes from its agent's value, (n_factors, the factors' width)
        """
        return self.factored(action_cost.unsqueeze(0))[0]

    def sum_by_agent(self, values: th.Tensor) -> th.Tensor:
        """
        :param values: of value heads or of factors, (..., n)
        :return: their sums over each agent's, (..., n_agents)
        """
        # The same number for each agent: a reshape does what index_add would
        one_each = values.shape[-1] == self.n_agents
        return values if one_each else values.unflatten(-1, (self.n_agents, -1)).sum(dim=-1)

    def known_cost(self, actions: th.Tensor, action_cost: th.Tensor) -> th.Tensor:
        """
        :param actions: (batch, n_agents, width)
        :param action_cost: (n_agents, width)
        :return: what the actions cost, as each value head's rewards hold it, (batch, n_values)
        """
        cost = self.factored(actions * action_cost).sum(dim=-1)
        if cost.shape[-1] == len(self.agent_of_value):
            return cost
        values_per_agent = len(self.agent_of_value) // self.n_agents
        return self.per_value(self.sum_by_agent(cost)) / values_per_agent


class StackedCritic(Critic):
    """
    Critics that are one multi-layer perceptron per agent.

    :param team: the team
    :param actions: how it acts
    :param in_features: length of what each reads
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param groups: for each agent the number of its network
    :param n_critics: number of critics
    """

    def __init__(
        self,
        team: Team,
        actions: TeamActions,
        in_features: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        groups: Sequence[int],
        n_critics: int,
    ):
        super().__init__(actions, team.n_agents, n_critics=n_critics)
        # Raises at once if so many do not fit into memory, where the list below would fill it first
        th.empty(n_critics, team.n_agents, in_features, *net_arch[:1])
        networks = [group + (max(groups) + 1) * copy for copy in range(n_critics) for group in groups]
        self.net = StackedMLP(networks, in_features, 1, net_arch, activation_fn)

    def clip_grad_norm_(self, max_norm: float) -> None:
        self.net.clip_grad_norm_(max_norm)

    def values_of_changes(
        self,
        changes: th.Tensor,
        first: th.Tensor,
        own_weight: th.Tensor,
        layers: Sequence[tuple[th.Tensor, th.Tensor]],
        networks: th.Tensor | None,
    ) -> th.Tensor:
        """
        :param changes: of actions, (batch, n, M, width)
        :param first: what the first layer makes of the unchanged input, (n, hidden, batch)
        :param own_weight: what it makes of changes, (n, hidden, width)
        :param layers: of the networks, see ``StackedMLP.after_first``
        :param networks: which networks, None for all
        :return: values with each of the changes, (batch, n, M)
        """
        # The batch comes last: what is added to every alternative then runs along memory. Views would be slow here:
        # what is changed in place later must not be one.
        changes = changes.permute(1, 3, 2, 0)
        shape = changes.shape[2:]
        first = first.repeat(1, 1, shape[0]) if shape[0] > 1 else first
        values = self.net.after_first(th.baddbmm(first, own_weight, changes.flatten(2)), layers, networks)
        return values.squeeze(1).unflatten(1, shape).permute(2, 0, 1)

    def by_critic(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: of the networks, (n_critics * n_agents, 1, batch)
        :return: (n_critics, batch, n_agents)
        """
        return outputs.squeeze(1).unflatten(0, (self.n_critics, -1)).transpose(1, 2)


class MLPCritic(StackedCritic):
    """
    One multi-layer perceptron per agent, Q_i(z_1..z_n, a_1..a_n), or Q_i(s, a_1..a_n) with a global state s. Critics
    that share parameters read the agents in another order each: the own agent first, then those it shares with, then
    the others. So they know whose value they give; with a global state a further input tells them.

    :param team: the team
    :param actions: how it acts
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param groups: for each agent the number of its network
    :param n_critics: number of critics
    """

    columns: th.Tensor
    own_columns: th.Tensor

    def __init__(
        self,
        team: Team,
        actions: TeamActions,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        groups: Sequence[int] | None = None,
        n_critics: int = 1,
    ):
        n = team.n_agents
        groups = list(groups or range(n))
        shared = len(set(groups)) < n
        parts = [team.obs_dim, actions.width] if team.state_dim == 0 else [actions.width]
        columns = np.arange(team.state_dim)[None].repeat(n, axis=0)
        for width in parts:
            block = columns.shape[1] + np.arange(n * width).reshape(n, width)
            # Where in the own view, if there is one, each agent stands
            place = np.array([_places(groups, agent) if shared else np.arange(n) for agent in range(n)])
            columns = np.concatenate([columns, block[place].reshape(n, -1)], axis=1)
        own = columns.reshape(n, -1)[:, -n * actions.width :].reshape(n, n, -1)[np.arange(n), np.arange(n)]
        tells_agent = shared and team.state_dim > 0
        if tells_agent:
            columns = np.concatenate([columns, columns.shape[1] + np.arange(n)[:, None]], axis=1)
        super().__init__(team, actions, int(columns.max()) + 1, net_arch, activation_fn, groups, n_critics)
        self.team = team
        self.shared = shared
        self.tells_agent = tells_agent
        self.register_buffer("columns", th.as_tensor(columns).repeat(n_critics, 1), persistent=False)
        self.register_buffer("own_columns", th.as_tensor(own), persistent=False)

    def _inputs(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """:return: what all critics read, (features, batch)"""
        inputs = _joint_inputs(self.team, obs, actions)
        if self.tells_agent:
            inputs.append(actions.new_ones(len(actions), 1))
        return th.cat(inputs, dim=1).T

    def _first(
        self, inputs: th.Tensor, layer: tuple[th.Tensor, th.Tensor], networks: th.Tensor | None = None
    ) -> th.Tensor:
        """:return: the first layer's outputs, (n_networks, width, batch)"""
        weight, bias = (self.net.of_networks(parameter, networks) for parameter in layer)
        if self.shared:  # reordering the few weights does what reordering the whole batch would
            columns = self.columns if networks is None else self.columns[networks]
            weight = weight.gather(2, columns.unsqueeze(1).expand(-1, weight.shape[1], -1))
        return th.baddbmm(bias, weight, inputs.expand(len(weight), -1, -1))

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        layers = self.net.layers()
        return self.by_critic(self.net.after_first(self._first(self._inputs(obs, actions), layers[0]), layers))

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        # The first layer is linear: it reads the wide joint input once, and every alternative adds its few columns
        agents = th.arange(self.team.n_agents, device=own.device) if factors is None else factors
        networks = None if factors is None and self.n_critics == 1 else agents
        layers = self.net.layers()
        first = self._first(self._inputs(obs, actions), layers[0], networks)
        weight = self.net.of_networks(layers[0][0], networks)
        own_weight = weight.gather(2, self.own_columns[agents].unsqueeze(1).expand(-1, weight.shape[1], -1))
        return self.values_of_changes(own - actions[:, agents].unsqueeze(2), first, own_weight, layers, networks)


class TeamCritic(StackedCritic):
    """
    One multi-layer perceptron for the whole team, Q(z_1..z_n, a_1..a_n), fitted to the mean of the agents' rewards: for
    cooperative teams, where agents get the same reward or maximise the team's. With n agents a critic update takes
    about an n-th of the time that one value for each agent takes. An episode goes on as long as any agent is in it.

    :param team: the team
    :param actions: how it acts
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param n_critics: number of critics
    """

    def __init__(
        self,
        team: Team,
        actions: TeamActions,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 1,
    ):
        self.seen_dim = team.state_dim or team.n_agents * team.obs_dim
        n_inputs = self.seen_dim + team.n_agents * actions.width
        super().__init__(team, actions, n_inputs, net_arch, activation_fn, [0], n_critics)
        self.team = team
        self.agent_of_value = th.zeros(1, dtype=th.long)

    def rewards(self, of_agents: th.Tensor) -> th.Tensor:
        return of_agents.mean(dim=-1, keepdim=True)

    def per_value(self, of_agents: th.Tensor) -> th.Tensor:
        return of_agents.amax(dim=-1, keepdim=True)

    def owners(self, values: th.Tensor) -> th.Tensor:
        return th.arange(self.n_agents)

    def sum_by_agent(self, values: th.Tensor) -> th.Tensor:
        return values.expand(*values.shape[:-1], self.n_agents)

    def known_cost(self, actions: th.Tensor, action_cost: th.Tensor) -> th.Tensor:
        return self.rewards((actions * action_cost).sum(dim=-1))

    def cost_of_factors(self, action_cost: th.Tensor) -> th.Tensor:
        return super().cost_of_factors(action_cost) / self.n_agents

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        inputs = th.cat(_joint_inputs(self.team, obs, actions), dim=1).T
        return self.by_critic(self.net(inputs.expand(self.n_critics, -1, -1)))

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        # The first layer is linear: it reads the joint input once, and every alternative adds its few columns
        agents = th.arange(self.n_agents, device=own.device) if factors is None else factors
        layers = self.net.layers()
        weight, bias = (parameter[0] for parameter in layers[0])
        first = th.addmm(bias, weight, th.cat(_joint_inputs(self.team, obs, actions), dim=1).T)
        first = first.expand(len(agents), -1, -1)
        own_weight = weight[:, self.seen_dim :].unflatten(1, (self.n_agents, -1))[:, agents].transpose(0, 1)
        changes = own - actions[:, agents].unsqueeze(2)
        return self.values_of_changes(changes, first, own_weight, layers, th.zeros_like(agents))


def _joint_inputs(team: Team, obs: th.Tensor, actions: th.Tensor) -> list[th.Tensor]:
    """:return: what centralised critics read: the global state, if there is one, else all observations; all actions"""
    seen = obs[..., team.obs_dim :] if team.state_dim else obs[..., : team.obs_dim]
    return [seen.flatten(1)[:, : team.state_dim or None], actions.flatten(1)]


def _places(groups: Sequence[int], agent: int) -> list[int]:
    """
    :param groups: for each agent the number of its network
    :param agent: whose critic
    :return: for each agent its place in what that critic reads
    """
    n = len(groups)
    order = sorted(range(n), key=lambda other: (groups[other] != groups[agent], (other - agent) % n))
    return [order.index(other) for other in range(n)]


class MADDPGPolicy(BasePolicy):
    """
    Policy of MADDPG: actors, critics and their targets, a multi-layer perceptron for each agent.

    :param observation_space: ``Box(n_agents, obs_dim)`` or ``TeamObservation``
    :param action_space: flat joint action, see ``Team.from_spaces``
    :param lr_schedule: learning rate schedule (could be constant)
    :param net_arch: widths of the hidden layers, as a list or as ``dict(pi=[...], qf=[...])``
    :param activation_fn: between the layers
    :param share_actor: parameter sharing; True: one actor network for all agents, False: one for each; or lists of
        agents (names or numbers) that share one
    :param share_critic: the same for critics; "team": one value for the whole team, see ``TeamCritic``
    :param threshold: delta in [0, 1): a binary action is 1 where its probability exceeds it. For ``MultiBinary`` alone.
    :param random_thresholds: share of the thresholds that are drawn to explore, the others are delta
    :param n_critics: number of critics of each agent
    :param agent_names: by default those of the observation space, or agent_0, agent_1, ...
    :param normalize_images: kept for Stable-Baselines3, a team observation is never an image
    :param optimizer_class: ``th.optim.Adam`` by default, in its fused form
    :param optimizer_kwargs: further keyword arguments for the optimizer, the learning rate excluded
    """

    # Attributes of the environment that are arguments of the policy, see MADDPG
    env_attributes: ClassVar[tuple[str, ...]] = ("agent_names",)
    actor: Actor
    actor_target: Actor
    critic: Critic
    critic_target: Critic

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        share_actor: Sharing = False,
        share_critic: Sharing | Literal["team"] = False,
        threshold: float = 0.5,
        random_thresholds: float = 1.0,
        n_critics: int = 1,
        agent_names: Sequence[str] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        arguments = validated(
            PolicyArguments,
            net_arch=[64, 64] if net_arch is None else net_arch,
            threshold=threshold,
            random_thresholds=random_thresholds,
            n_critics=n_critics,
            activation_fn=activation_fn,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            agent_names=agent_names,
            normalize_images=normalize_images,
        )
        optimizer_kwargs = dict(optimizer_kwargs or {})
        if optimizer_class is th.optim.Adam:
            optimizer_kwargs.setdefault("fused", True)
        super().__init__(
            observation_space,
            action_space,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=isinstance(action_space, spaces.Box) and not isinstance(action_space, MixedActions),
        )
        self.team = Team.from_spaces(observation_space, action_space, arguments["agent_names"])
        self.net_arch = arguments["net_arch"]
        self.activation_fn = activation_fn
        self.share_actor = share_actor
        self.share_critic = share_critic
        self.threshold = arguments["threshold"]
        self.random_thresholds = arguments["random_thresholds"]
        self.n_critics = arguments["n_critics"]
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor, self.critic = self._make_networks(*get_actor_critic_arch(self.net_arch))
        self.actions = self.actor.actions
        self.actor_target = deepcopy(self.actor)
        self.critic_target = deepcopy(self.critic)
        for module in (self.actor, self.critic):
            try:
                module.optimizer = self.optimizer_class(  # type: ignore[call-arg]
                    module.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs
                )
            except (TypeError, ValueError, RuntimeError) as error:
                name = self.optimizer_class.__name__
                raise ValueError(f"optimizer_kwargs={self.optimizer_kwargs} do not fit {name}: {error}.") from error
        for target in (self.actor_target, self.critic_target):
            target.requires_grad_(False)

    def _make_networks(self, actor_arch: list[int], critic_arch: list[int]) -> tuple[Actor, Critic]:
        actions = TeamActions(
            self.team.action_spaces,
            self.threshold,
            random_thresholds=self.random_thresholds,
            masks=self.team.masks,
        )
        actor_groups = sharing_groups(self.share_actor, self.team, "share_actor")
        actor = MLPActor(self.team, actions, actor_arch, self.activation_fn, actor_groups)
        return actor, self._make_critic(actions, critic_arch)

    def _make_critic(self, actions: TeamActions, net_arch: list[int]) -> Critic:
        if self.share_critic == "team":
            return TeamCritic(self.team, actions, net_arch, self.activation_fn, self.n_critics)
        groups = sharing_groups(self.share_critic, self.team, "share_critic")
        return MLPCritic(self.team, actions, net_arch, self.activation_fn, groups, self.n_critics)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "lr_schedule": self._dummy_schedule,  # dummy lr schedule, not needed for loading policy alone
            "net_arch": self.net_arch,
            "activation_fn": self.activation_fn,
            "share_actor": self.share_actor,
            "share_critic": self.share_critic,
            "threshold": self.threshold,
            "random_thresholds": self.random_thresholds,
            "n_critics": self.n_critics,
            "agent_names": self.team.names,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }

    def not_finite(self, parameters: Mapping[str, th.Tensor]) -> str | None:
        """
        :param parameters: of this policy by their names, see ``state_dict``
        :return: which of them hold NaN or infinity, and of which agents, None if none does
        """
        for name, parameter in parameters.items():
            finite = parameter.isfinite()
            if not finite.all():
                module = getattr(self, name.split(".")[0], None)
                network = getattr(module, "net", None)
                agents: Iterable[int] = range(self.team.n_agents)
                if isinstance(network, StackedMLP) and not isinstance(module, TeamCritic):
                    groups = finite.flatten(1).all(dim=1)[network.groups.to(finite.device)].tolist()
                    agents = sorted({index % self.team.n_agents for index, good in enumerate(groups) if not good})
                names = ", ".join(self.team.names[agent] for agent in agents)
                return f"parameter {name}, of agent(s) {names}, holds NaN or infinity"
        return None

    def set_threshold(self, threshold: float) -> None:
        """
        :param threshold: delta in [0, 1), for the binary actions of all agents from now on
        """
        threshold = validated(ThresholdArgument, threshold=threshold)["threshold"]
        self.threshold = threshold
        for actions in {self.actor.actions, self.actor_target.actions, self.actions}:
            actions.set_threshold(threshold)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        try:
            numbers = as_numbers(observation)
        except ValueError:
            raise ValueError(
                f"observation={shown(observation)} is no array of numbers of shape {self.observation_space.shape}, or "
                "several of them."
            ) from None
        self.check_finite(numbers)
        return super().obs_to_tensor(numbers)

    def check_finite(self, observation: np.ndarray) -> None:
        """
        :param observation: (..., n_agents, obs_dim or more)
        :raises ValueError: NaN or infinity
        """
        if all_finite(observation):
            return
        with np.errstate(over="ignore"):
            finite = np.isfinite(observation.astype(np.float32))
        agents = np.flatnonzero(~finite.all(axis=-1).reshape(-1, self.team.n_agents).all(axis=0))
        raise ValueError(
            f"The observation of agent(s) {', '.join(self.team.names[agent] for agent in agents)} holds NaN or "
            "infinity. An action for it would mean nothing: clip or replace such values in the environment."
        )

    def set_training_mode(self, mode: bool) -> None:
        if self.training != mode:  # SB3 asks for it at each prediction, and going through all modules takes its time
            super().set_training_mode(mode)

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    def flat_actions(self, obs: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim or more)
        :param deterministic: without exploration
        :return: buffer actions, (batch, length)
        """
        return self.actions.decode(self.actor.act(obs.float(), deterministic))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        flat = self.flat_actions(observation, deterministic)
        if self.squash_output:  # Stable-Baselines3 unscales a Box itself
            return flat
        if isinstance(self.action_space, MixedActions):
            return th.as_tensor(self.actions.unscale(flat.cpu().numpy()))
        return flat.to(th.int8 if isinstance(self.action_space, spaces.MultiBinary) else th.int64)
