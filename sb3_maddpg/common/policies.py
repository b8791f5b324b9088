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

from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.agent_policy import AgentPolicy
from sb3_maddpg.common.heads import TeamHead, ValueHeads
from sb3_maddpg.common.networks import StackedMLP, single_precision
from sb3_maddpg.errors import DivergedError, InvalidArgumentError
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.team.spaces import MixedActions, into_box
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import all_finite, as_numbers, shown
from sb3_maddpg.validation import PolicyArguments, ThresholdArgument, validated
from sb3_maddpg.vec_env.normalize import ObservationStatistics

Sharing = bool | Sequence[Sequence[str | int]]


def sharing_groups(share: Sharing, team: Team, argument: str) -> list[int]:
    """
    Assign agents to networks.

    :param share: True if all agents share one network (parameter sharing), False if each has its own, or lists of the
        agents that share one
    :param team: the team
    :param argument: name of the argument, for error messages
    :return: the index of each agent's network
    :raises ValueError: if ``share`` is anything else, names an agent twice, or lists heterogeneous agents together
    """
    if isinstance(share, bool):
        lists = [list(range(team.n_agents))] if share else []
    else:
        try:
            if isinstance(share, (str, Mapping)) or any(isinstance(agents, (str, Mapping)) for agents in share):
                raise TypeError
            lists = [[team.index(agent) for agent in agents] for agents in share]
        except TypeError:
            raise InvalidArgumentError(
                f"{argument}={shown(share)} must be True, False or a list of lists of agents that share a network, "
                f'such as {[[*team.names[:2]]]}; share_critic may also be "team".'
            ) from None
    named = [agent for agents in lists for agent in agents]
    if len(set(named)) < len(named):
        raise InvalidArgumentError(f"{argument}={share} names an agent twice, but an agent has only one network.")
    for first, *others in filter(None, lists):
        for other in others:
            if not team.homogeneous(first, other):
                raise InvalidArgumentError(
                    f"{argument}={share}: {team.names[first]} and {team.names[other]} have different spaces and "
                    "cannot share a network. Pass lists of homogeneous agents, or False."
                )
    lists += [[agent] for agent in range(team.n_agents) if agent not in named]
    groups = [0] * team.n_agents
    for number, agents in enumerate(sorted(filter(None, lists))):
        for agent in agents:
            groups[agent] = number
    return groups


class Actor(nn.Module):
    """
    Base class of decentralised actors: the output for agent i depends only on its own observation.

    :param actions: the team's actions
    """

    optimizer: th.optim.Optimizer

    def __init__(self, actions: TeamActions):
        super().__init__()
        self.actions = actions

    def logits(self, obs: th.Tensor) -> th.Tensor:
        """
        Compute the networks' outputs before squashing.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: the outputs, (batch, n_agents, width), minus infinity where an action mask forbids a choice, see
            ``TeamActions.mask``
        """
        raise NotImplementedError

    def single(self, agent: int) -> nn.Module:
        """
        Extract the network of one agent.

        :param agent: index of the agent
        :return: a network that maps the agent's observations without padding, (batch, the agent's obs_dim), to outputs
            without action masks applied, (batch, width)
        """
        raise NotImplementedError

    def clip_grad_norm_(self, max_norm: float) -> None:
        """
        Clip the gradient of each network, by default of all of them together.

        :param max_norm: maximum norm of a network's gradient
        """
        nn.utils.clip_grad_norm_(self.parameters(), max_norm)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: probabilities or continuous actions, (batch, n_agents, width)
        """
        return self.actions.squash(self.logits(obs))

    def act(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        Choose actions.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param deterministic: whether to act without exploration, see ``TeamActions``
        :return: encoded actions, (batch, n_agents, width)
        """
        return self.actions.act(self.logits(obs), deterministic)


class MLPActor(Actor):
    """
    Actors with one multi-layer perceptron per agent.

    :param team: the team
    :param actions: the team's actions
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    :param groups: index of each agent's network
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
    Base class of centralised critics, which read the observations and actions of all agents.

    For credit assignment, an agent may have several value heads, each fitted to its own rewards, and its action may
    consist of several factors, whose policy gradients are estimated independently. Heads and factors are ordered by
    agent, and each agent has the same number of them. By default, each agent has one head and one factor.

    :param factors: the actions of the factors
    :param heads: whose rewards the values predict
    :param n_critics: number of critics per agent (two for MATD3)
    """

    optimizer: th.optim.Optimizer

    def __init__(self, factors: TeamActions, heads: ValueHeads, n_critics: int = 1):
        super().__init__()
        self.factors = factors
        self.heads = heads
        self.n_agents = heads.n_agents
        self.n_critics = n_critics

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param actions: encoded actions, (batch, n_agents, width)
        :return: Q-values, (n_critics, batch, n_values)
        """
        raise NotImplementedError

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        """
        Compute the first critic's Q-values with the action of one factor replaced and all else kept.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param actions: encoded actions, (batch, n_agents, width); the factor's own action does not affect the result
        :param own: M alternatives for the action of each factor, (batch, len(factors), M, the factors' width)
        :param factors: indices of the factors, None for all
        :return: Q-values, (batch, len(factors), M)
        """
        raise NotImplementedError

    def clip_grad_norm_(self, max_norm: float) -> None:
        """
        Clip the gradient of each network, by default of all of them together.

        :param max_norm: maximum norm of a network's gradient
        """
        nn.utils.clip_grad_norm_(self.parameters(), max_norm)

    def factored(self, actions: th.Tensor) -> th.Tensor:
        """
        Split actions into factors.

        :param actions: actions or logits of the agents, (batch, n_agents, width)
        :return: actions or logits of the factors, (batch, n_factors, the factors' width)
        """
        return actions.reshape(len(actions), -1, self.factors.width)


class FeaturesActor(Actor):
    """
    Actors that read features of their agents' observations.

    :param features: features extractor of a team, with a method ``single`` for one agent's
    :param head: actors that read features
    """

    def __init__(self, features: nn.Module, head: MLPActor):
        super().__init__(head.actions)
        self.features = features
        self.head = head

    def logits(self, obs: th.Tensor) -> th.Tensor:
        return self.head.logits(self.features(obs))

    def single(self, agent: int) -> nn.Module:
        return nn.Sequential(self.features.single(agent), self.head.single(agent))  # type: ignore[operator]

    def clip_grad_norm_(self, max_norm: float) -> None:
        if parameters := [*self.features.parameters()]:
            nn.utils.clip_grad_norm_(parameters, max_norm)
        self.head.clip_grad_norm_(max_norm)


class FeaturesCritic(Critic):
    """
    Centralised critics that read the features of all agents' observations, and all actions.

    :param features: see ``FeaturesActor``
    :param head: critics that read features
    """

    def __init__(self, features: nn.Module, head: StackedCritic):
        super().__init__(head.factors, head.heads, head.n_critics)
        self.features = features
        self.head = head

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.head(self.features(obs), actions)

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        return self.head.forward_alternatives(self.features(obs), actions, own, factors)

    def clip_grad_norm_(self, max_norm: float) -> None:
        if parameters := [*self.features.parameters()]:
            nn.utils.clip_grad_norm_(parameters, max_norm)
        self.head.clip_grad_norm_(max_norm)


class ImageScale(nn.Module):
    """
    Division of the images in the observations by 255, as SB3 preprocesses them.

    :param factors: factor of each column, (n_agents, columns)
    """

    factors: th.Tensor

    def __init__(self, factors: th.Tensor):
        super().__init__()
        self.register_buffer("factors", factors, persistent=False)  # follows from the policy's arguments

    @classmethod
    def of(cls, columns: Sequence[Sequence[Sequence[int]]], team: Team) -> ImageScale:
        """
        :param columns: see ``MADDPGPolicy``
        :param team: the team
        :return: the module
        :raises ValueError: if columns do not exist
        """
        own = th.ones(team.n_agents, team.obs_dim)
        state = th.ones(team.n_agents * -(-team.state_dim // team.n_agents))
        lengths = [*team.obs_dims, team.state_dim]
        if len(columns) != len(lengths):
            raise InvalidArgumentError(
                f"image_columns={shown(columns)} must hold lists for the {team.n_agents} agents and for the state."
            )
        for row, images, length in zip([*own, state], columns, lengths, strict=True):
            for first, end in images:
                if not 0 <= first < end <= length:
                    raise InvalidArgumentError(
                        f"image_columns={shown(columns)}: an observation has columns 0 to {length - 1}."
                    )
                row[first:end] = 1 / 255
        return cls(th.cat([own, state.view(team.n_agents, -1)], dim=1))

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: observations, (..., n_agents, columns)
        :return: the observations with scaled images
        """
        return obs * self.factors[:, : obs.shape[-1]]

    def single(self, agent: int) -> nn.Module:
        """
        :param agent: index of the agent
        :return: the module for the agent's own observations without padding
        """
        return _OwnScale(self.factors[agent])


class _OwnScale(nn.Module):
    def __init__(self, factors: th.Tensor):
        super().__init__()
        self.register_buffer("factors", factors.clone())

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return obs * self.factors[: obs.shape[-1]]  # type: ignore[index]


class StackedCritic(Critic):
    """
    Base class of critics with one multi-layer perceptron per agent.

    :param team: the team
    :param actions: the team's actions
    :param in_features: length of each network's input
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    :param groups: index of each agent's network
    :param n_critics: number of critics per agent
    :param heads: whose rewards the values predict, by default one agent's each
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
        heads: ValueHeads | None = None,
    ):
        super().__init__(actions, heads or ValueHeads(team.n_agents), n_critics)
        # Fails at once if the networks exceed the memory, before the list below fills it
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
        Evaluate alternative actions, given the first layer's output for the original actions.

        :param changes: differences of the alternatives from the original actions, (batch, n, M, width)
        :param first: output of the first layer for the original actions, (n, hidden, batch)
        :param own_weight: weights of the first layer for the changed actions, (n, hidden, width)
        :param layers: layers of the networks, see ``StackedMLP.after_first``
        :param networks: indices of the networks, None for all
        :return: values of the alternatives, (batch, n, M)
        """
        # With the batch as the last axis, the sum below is contiguous in memory. Later layers change it in place, so
        # it must not be a view.
        changes = changes.permute(1, 3, 2, 0)
        shape = changes.shape[2:]
        first = first.repeat(1, 1, shape[0]) if shape[0] > 1 else first
        values = self.net.after_first(th.baddbmm(first, own_weight, changes.flatten(2)), layers, networks)
        return values.squeeze(1).unflatten(1, shape).permute(2, 0, 1)

    def by_critic(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: outputs of the networks, (n_critics * n_agents, 1, batch)
        :return: Q-values, (n_critics, batch, n_agents)
        """
        return outputs.squeeze(1).unflatten(0, (self.n_critics, -1)).transpose(1, 2)


class MLPCritic(StackedCritic):
    """
    Centralised critics with one multi-layer perceptron per agent, Q_i(z_1..z_n, a_1..a_n), or Q_i(s, a_1..a_n) with a
    global state s. So that critics with shared parameters know whose value they estimate, each reads the agents in its
    own order: its own agent first, then the agents it shares parameters with, then the others. With a global state, it
    also gets the index of its agent as a one-hot input.

    :param team: the team
    :param actions: the team's actions
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    :param groups: index of each agent's network
    :param n_critics: number of critics per agent
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
        # Fails at once if the tables below exceed the memory
        th.empty(n, team.state_dim + n * ((0 if team.state_dim else team.obs_dim) + actions.width), dtype=th.long)
        groups = list(groups or range(n))
        shared = len(set(groups)) < n
        parts = [team.obs_dim, actions.width] if team.state_dim == 0 else [actions.width]
        columns = np.arange(team.state_dim)[None].repeat(n, axis=0)
        for width in parts:
            block = columns.shape[1] + np.arange(n * width).reshape(n, width)
            # The position of each agent in the critic's own order, if there is one
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
        """:return: the joint input of all critics, (features, batch)"""
        inputs = _joint_inputs(self.team, obs, actions)
        if self.tells_agent:
            inputs.append(actions.new_ones(len(actions), 1))
        return th.cat(inputs, dim=1).T

    def _first(
        self, inputs: th.Tensor, layer: tuple[th.Tensor, th.Tensor], networks: th.Tensor | None = None
    ) -> th.Tensor:
        """:return: the first layer's outputs, (n_networks, width, batch)"""
        weight, bias = (self.net.of_networks(parameter, networks) for parameter in layer)
        if self.shared:  # reorder the few weights instead of the whole batch
            columns = self.columns if networks is None else self.columns[networks]
            weight = weight.gather(2, columns.unsqueeze(1).expand(-1, weight.shape[1], -1))
        return th.baddbmm(bias, weight, inputs.expand(len(weight), -1, -1))

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        layers = self.net.layers()
        return self.by_critic(self.net.after_first(self._first(self._inputs(obs, actions), layers[0]), layers))

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        # The first layer is linear: it reads the wide joint input once, and each alternative only adds its few columns
        agents = th.arange(self.team.n_agents, device=own.device) if factors is None else factors
        networks = None if factors is None and self.n_critics == 1 else agents
        layers = self.net.layers()
        first = self._first(self._inputs(obs, actions), layers[0], networks)
        weight = self.net.of_networks(layers[0][0], networks)
        own_weight = weight.gather(2, self.own_columns[agents].unsqueeze(1).expand(-1, weight.shape[1], -1))
        return self.values_of_changes(own - actions[:, agents].unsqueeze(2), first, own_weight, layers, networks)


class TeamCritic(StackedCritic):
    """
    Multi-layer perceptron with a single value for the whole team, Q(z_1..z_n, a_1..a_n), trained on the mean of the
    agents' rewards. It is meant for cooperative teams, in which all agents get the same reward or maximise that of the
    team. With n agents, a critic update takes about 1/n of the time that it takes with one value per agent. The value
    bootstraps until all agents have terminated.

    :param team: the team
    :param actions: the team's actions
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
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
        super().__init__(team, actions, n_inputs, net_arch, activation_fn, [0], n_critics, TeamHead(team.n_agents))
        self.team = team

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        inputs = th.cat(_joint_inputs(self.team, obs, actions), dim=1).T
        return self.by_critic(self.net(inputs.expand(self.n_critics, -1, -1)))

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        # The first layer is linear, so it processes the joint input once and adds the changes of each alternative
        agents = th.arange(self.n_agents, device=own.device) if factors is None else factors
        layers = self.net.layers()
        weight, bias = (parameter[0] for parameter in layers[0])
        first = th.addmm(bias, weight, th.cat(_joint_inputs(self.team, obs, actions), dim=1).T)
        first = first.expand(len(agents), -1, -1)
        own_weight = weight[:, self.seen_dim :].unflatten(1, (self.n_agents, -1))[:, agents].transpose(0, 1)
        changes = own - actions[:, agents].unsqueeze(2)
        return self.values_of_changes(changes, first, own_weight, layers, th.zeros_like(agents))


def _joint_inputs(team: Team, obs: th.Tensor, actions: th.Tensor) -> list[th.Tensor]:
    """:return: inputs of centralised critics: the global state if there is one, else all observations; all actions"""
    seen = obs[..., team.obs_dim :] if team.state_dim else obs[..., : team.obs_dim]
    return [seen.flatten(1)[:, : team.state_dim or None], actions.flatten(1)]


def _places(groups: Sequence[int], agent: int) -> list[int]:
    """
    :param groups: index of each agent's network
    :param agent: index of the agent whose critic it is
    :return: the position of each agent in that critic's input
    """
    n = len(groups)
    order = sorted(range(n), key=lambda other: (groups[other] != groups[agent], (other - agent) % n))
    return [order.index(other) for other in range(n)]


@allow_in_files(name="sb3_maddpg.policies.MADDPGPolicy")
class MADDPGPolicy(BasePolicy):
    """
    Policy of MADDPG: actors, critics and their target networks, with one multi-layer perceptron per agent.

    :param observation_space: ``Box(n_agents, obs_dim)`` or ``TeamObservation``
    :param action_space: flat joint action, see ``Team.from_spaces``
    :param lr_schedule: learning rate schedule (could be constant)
    :param net_arch: widths of the hidden layers, as a list or as ``dict(pi=[...], qf=[...])``
    :param activation_fn: activation function between the layers, which maps every number by itself and has no
        parameters
    :param share_actor: parameter sharing of actors: True for one network for all agents, False for one network per
        agent, or lists of the agents (names or indices) that share a network
    :param share_critic: parameter sharing of critics, like ``share_actor``, or "team" for a single value for the whole
        team, see ``TeamCritic``
    :param threshold: delta in [0, 1): a binary action is 1 if its probability exceeds delta. For ``MultiBinary`` only.
    :param random_thresholds: fraction of the thresholds that are drawn at random during exploration, the others
        are delta
    :param n_critics: number of critics per agent
    :param agent_names: names of the agents, by default those of the observation space, or agent_0, agent_1, ...
    :param image_columns: for each agent and for the state, first and end of the columns that hold an image of bytes
        (uint8 from 0 to 255, three axes); by default MADDPG reads them from the environment
    :param normalize_images: whether to divide such images by 255
    :param optimizer_class: the optimizer, ``th.optim.Adam`` by default, which runs fused
    :param optimizer_kwargs: additional keyword arguments, excluding the learning rate, to pass to the optimizer
    """

    # Attributes of the environment that are arguments of the policy, see MADDPG
    env_attributes: ClassVar[tuple[str, ...]] = ("agent_names", "image_columns")
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
        image_columns: Sequence[Sequence[Sequence[int]]] | None = None,
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
            image_columns=image_columns,
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
        self.image_columns = arguments["image_columns"]
        self._build(lr_schedule)

    @single_precision()
    def _build(self, lr_schedule: Schedule) -> None:
        networks = self._make_networks(*get_actor_critic_arch(self.net_arch))
        match networks:
            case (Actor(), Critic()):
                self.actor, self.critic = networks
            case _:
                raise InvalidArgumentError(
                    f"{type(self).__name__}._make_networks returned {shown(networks)} instead of an Actor and a Critic."
                )
        if self.image_columns is not None and self.normalize_images:
            self._divide_images()
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
                raise InvalidArgumentError(
                    f"optimizer_kwargs={self.optimizer_kwargs} cannot be passed to {name}: {error}."
                ) from error
        for target in (self.actor_target, self.critic_target):
            target.requires_grad_(False)

    def _divide_images(self) -> None:
        assert isinstance(self.actor, MLPActor)
        assert isinstance(self.critic, StackedCritic)
        scales = (ImageScale.of(self.image_columns or (), self.team) for _ in range(2))
        self.actor, self.critic = FeaturesActor(next(scales), self.actor), FeaturesCritic(next(scales), self.critic)

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
            **({} if self.image_columns is None else {"image_columns": self.image_columns}),
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }

    @single_precision()
    def agent_policy(self, agent: str | int, statistics: ObservationStatistics | None = None) -> AgentPolicy:
        """
        Extract the policy of one agent.

        :param agent: name or index of the agent
        :param statistics: how ``VecNormalize`` normalises the team's observations, None if it does not
        :return: the agent's policy
        :raises ValueError: if there is no such agent, or parameters are not finite
        """
        if problem := self.not_finite(self.state_dict()):
            raise DivergedError(
                f"This policy cannot act: {problem}. Its training diverged: go back to an earlier file."
            )
        team, index = self.team, self.team.index(agent)
        network = deepcopy(self.actor.single(index)).requires_grad_(False).cpu()
        columns, space = self.actions.columns_of(index), team.action_spaces[index]
        mask = team.masks[index] if team.masks else ()
        own = None if statistics is None else statistics.of_agent(index, team.obs_dims[index])
        seen = getattr(self.observation_space, "agent_spaces", None)
        arguments = (columns, space, team.obs_dims[index], self.threshold, mask, own, seen and seen[index])
        return AgentPolicy(team.names[index], network, *arguments)

    def not_finite(self, parameters: Mapping[str, th.Tensor]) -> str | None:
        """
        Find parameters that hold NaN or infinity.

        :param parameters: parameters of this policy by name, see ``state_dict``
        :return: the name of the first such parameter and its agents, None if all are finite
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
        Set the threshold of the binary actions of all agents.

        :param threshold: delta in [0, 1)
        """
        threshold = validated(ThresholdArgument, threshold=threshold)["threshold"]
        self.threshold = threshold
        for actions in {self.actor.actions, self.actor_target.actions, self.actions}:
            actions.set_threshold(threshold)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        alone = "For one agent alone: model.agent_policy(NAME).predict(its observation)."
        if isinstance(observation, Mapping):
            raise InvalidArgumentError(
                f"observation={shown(observation)} is a dict, but a team's policy observes an array of shape "
                f"{self.observation_space.shape}, as sb3_maddpg.TeamEnv(env) returns it; model.predict takes the dict "
                f"of a PettingZoo environment. {alone}"
            )
        try:
            numbers = as_numbers(observation)
        except ValueError:
            raise InvalidArgumentError(
                f"observation={shown(observation)} is not an array of numbers of shape {self.observation_space.shape} "
                "or a batch of them."
            ) from None
        if numbers.shape[-2:] != self.observation_space.shape or numbers.ndim > 3:
            raise InvalidArgumentError(
                f"The observation has shape {numbers.shape}, but a team observes {self.observation_space.shape}, or a "
                f"batch of it. {alone}"
            )
        self.check_finite(numbers)
        return super().obs_to_tensor(numbers)

    def check_finite(self, observation: np.ndarray) -> None:
        """
        :param observation: observations, (..., n_agents, obs_dim or more)
        :raises ValueError: if an observation holds NaN or infinity
        """
        if all_finite(observation):
            return
        with np.errstate(over="ignore"):
            finite = np.isfinite(observation.astype(np.float32))
        agents = np.flatnonzero(~finite.all(axis=-1).reshape(-1, self.team.n_agents).all(axis=0))
        raise InvalidArgumentError(
            f"The observation of agent(s) {', '.join(self.team.names[agent] for agent in agents)} holds NaN or "
            "infinity, so it determines no action: clip or replace such values in the environment."
        )

    def set_training_mode(self, mode: bool) -> None:
        if self.training != mode:  # SB3 sets the mode at each prediction, and visiting all modules is slow
            super().set_training_mode(mode)

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        assert isinstance(self.action_space, spaces.Box)
        return into_box(self.action_space, super().unscale_action(scaled_action))  # rounding may exceed the bounds

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    @single_precision()
    def flat_actions(self, obs: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """
        Choose actions in the format of the replay buffer.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :param deterministic: whether to act without exploration
        :return: flat joint actions, (batch, length)
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
