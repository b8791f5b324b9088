"""Actors and critics of a team, every layer of all agents in one tensor with a leading agent axis."""

from copy import deepcopy
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_maddpg.utils import team_shape


class StackedMLP(nn.Module):
    """
    One multi-layer perceptron per agent, evaluated together. Initialised like ``torch.nn.Linear``.

    :param n_agents: number of networks
    :param in_features: inputs of each
    :param out_features: outputs of each
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param shared: one set of parameters for all agents (an agent axis of length one)
    """

    def __init__(
        self,
        n_agents: int,
        in_features: int,
        out_features: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        shared: bool = False,
    ):
        super().__init__()
        self.n_agents = n_agents
        self.activation = activation_fn()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        copies = 1 if shared else n_agents
        for width, next_width in pairwise([in_features, *net_arch, out_features]):
            bound = width**-0.5
            self.weights.append(nn.init.uniform_(th.empty(copies, width, next_width), -bound, bound))
            self.biases.append(nn.init.uniform_(th.empty(copies, 1, next_width), -bound, bound))

    def layer(self, index: int, x: th.Tensor) -> th.Tensor:
        """
        :param index: which layer
        :param x: (n_agents, batch, in)
        :return: before the activation, (n_agents, batch, out)
        """
        return th.baddbmm(self.biases[index], x, self.weights[index].expand(self.n_agents, -1, -1))

    def after_first(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: what the first layer gives before its activation, (n_agents, batch, width)
        :return: what the network gives, (n_agents, batch, out_features)
        """
        for index in range(1, len(self.weights)):
            x = self.layer(index, self.activation(x))
        return x

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (n_agents, batch, in_features)
        :return: (n_agents, batch, out_features)
        """
        return self.after_first(self.layer(0, x))

    def clip_grad_norm_(self, max_norm: float) -> None:
        """
        Clip the gradient of each agent's network by its own norm, so that no agent slows another.

        :param max_norm: largest Euclidean norm over all parameters of one network
        """
        gradients = [parameter.grad for parameter in self.parameters() if parameter.grad is not None]
        norm = th.stack([gradient.square().sum(dim=(1, 2)) for gradient in gradients]).sum(dim=0).sqrt()
        scale = (max_norm / (norm + 1e-6)).clamp(max=1.0).view(-1, 1, 1)
        for gradient in gradients:
            gradient.mul_(scale)


class TeamActor(nn.Module):
    """
    Decentralised actors f_i(z_i): agent i's output depends on its own observation only.

    :param n_agents: number of agents
    :param obs_dim: observation length of each
    :param action_dim: number of actions of each
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param shared: one network for all agents
    :param threshold: delta, for bits 1[f > delta] of scores f in [0, 1]; None for continuous actions in [-1, 1]
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        n_agents: int,
        obs_dim: int,
        action_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        shared: bool = False,
        threshold: float | None = None,
    ):
        super().__init__()
        self.net = StackedMLP(n_agents, obs_dim, action_dim, net_arch, activation_fn, shared)
        self.threshold = threshold

    def logits(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim)
        :return: the networks' outputs before they are squashed, (batch, n_agents, action_dim)
        """
        return self.net(obs.transpose(0, 1)).transpose(0, 1)

    def squash(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: (batch, n_agents, action_dim)
        :return: scores in [0, 1] for bits, or continuous actions in [-1, 1], (batch, n_agents, action_dim)
        """
        return th.tanh(logits) if self.threshold is None else th.sigmoid(logits)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim)
        :return: scores or continuous actions, (batch, n_agents, action_dim)
        """
        return self.squash(self.logits(obs))

    def act(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim)
        :param deterministic: threshold at delta; otherwise at one delta' ~ U(0, 1) per agent, shared by its bits
            (Serra-Gomez et al., IROS 2020, Sec. IV-C)
        :return: actions, (batch, n_agents, action_dim)
        """
        output = self(obs)
        if self.threshold is None:
            return output
        threshold = self.threshold if deterministic else th.rand_like(output[..., :1])
        return (output > threshold).to(output.dtype)


class TeamCritic(nn.Module):
    """
    Centralised critics Q_i(z_1..z_n, a_1..a_n). Critic i reads agent by agent, from agent i on and round the circle,
    so that its own observation and action come first: a shared critic then knows whose value it gives.

    :param n_agents: number of agents
    :param obs_dim: observation length of each
    :param action_dim: number of actions of each
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param shared: one network for all agents
    """

    optimizer: th.optim.Optimizer
    order: th.Tensor

    def __init__(
        self,
        n_agents: int,
        obs_dim: int,
        action_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        shared: bool = False,
    ):
        super().__init__()
        self.net = StackedMLP(n_agents, n_agents * (obs_dim + action_dim), 1, net_arch, activation_fn, shared)
        self.own_action = slice(obs_dim, obs_dim + action_dim)
        agents = th.arange(n_agents)
        self.register_buffer("order", (agents.unsqueeze(1) + agents) % n_agents, persistent=False)

    def _views(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim)
        :param actions: (batch, n_agents, action_dim)
        :return: what each critic reads, (n_agents, batch, n_agents * (obs_dim + action_dim)), a fresh tensor
        """
        return th.cat([obs, actions], dim=-1)[:, self.order].transpose(0, 1).flatten(2)

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim)
        :param actions: (batch, n_agents, action_dim)
        :return: Q_i of every agent i, (batch, n_agents)
        """
        return self.net(self._views(obs, actions)).squeeze(-1).T

    def forward_alternatives(self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor) -> th.Tensor:
        """
        Q_i with agent i's action replaced, the others' kept. The first layer is linear: it sees the wide joint input
        once, and each of the M alternatives only adds its own few columns.

        :param obs: (batch, n_agents, obs_dim)
        :param actions: (batch, n_agents, action_dim); the own part of each critic is not read
        :param own: alternatives for the own action, (batch, n_agents, M, action_dim)
        :return: (batch, n_agents, M)
        """
        batch, n_agents, n_alternatives, _ = own.shape
        views = self._views(obs, actions)
        views[:, :, self.own_action] = 0.0
        others = self.net.layer(0, views)
        own_weight = self.net.weights[0][:, self.own_action].expand(n_agents, -1, -1)
        mine = th.bmm(own.transpose(0, 1).flatten(1, 2), own_weight).unflatten(1, (batch, n_alternatives))
        q_values = self.net.after_first((others.unsqueeze(2) + mine).flatten(1, 2))
        return q_values.view(n_agents, batch, n_alternatives).transpose(0, 1)


class MADDPGPolicy(BasePolicy):
    """
    Policy of MADDPG: actors, critics and their targets.

    :param observation_space: ``Box(n_agents, obs_dim)``
    :param action_space: ``MultiBinary(n_agents * action_dim)`` or ``Box(n_agents * action_dim)``
    :param lr_schedule: learning rate schedule (could be constant)
    :param net_arch: widths of the hidden layers, as a list or as ``dict(pi=[...], qf=[...])``
    :param activation_fn: between the layers
    :param share_actor: one actor network for all agents
    :param share_critic: one critic network for all agents
    :param threshold: delta in [0, 1): a bit is set where its score exceeds it. Unused for continuous actions.
    :param normalize_images: kept for Stable-Baselines3, a team observation is never an image
    :param optimizer_class: ``th.optim.Adam`` by default, in its fused form
    :param optimizer_kwargs: further keyword arguments for the optimizer, the learning rate excluded
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        share_actor: bool = False,
        share_critic: bool = False,
        threshold: float = 0.5,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        optimizer_kwargs = dict(optimizer_kwargs or {})
        if optimizer_class is th.optim.Adam:
            optimizer_kwargs.setdefault("fused", True)
        super().__init__(
            observation_space,
            action_space,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=isinstance(action_space, spaces.Box),
        )
        if not 0.0 <= threshold < 1.0:
            raise ValueError(f"threshold={threshold}: scores lie in [0, 1], choose 0 <= threshold < 1.")
        self.net_arch = [64, 64] if net_arch is None else net_arch
        self.activation_fn = activation_fn
        self.share_actor = share_actor
        self.share_critic = share_critic
        self.threshold = threshold

        team = team_shape(observation_space, action_space)
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)
        delta = None if isinstance(action_space, spaces.Box) else threshold
        self.actor = TeamActor(*team, actor_arch, activation_fn, share_actor, delta)
        self.critic = TeamCritic(*team, critic_arch, activation_fn, share_critic)
        self.actor_target = deepcopy(self.actor)
        self.critic_target = deepcopy(self.critic)
        for module in (self.actor, self.critic):
            module.optimizer = optimizer_class(module.parameters(), lr=lr_schedule(1), **optimizer_kwargs)  # type: ignore[call-arg]
        for target in (self.actor_target, self.critic_target):
            target.requires_grad_(False)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "lr_schedule": self._dummy_schedule,  # dummy lr schedule, not needed for loading policy alone
            "net_arch": self.net_arch,
            "activation_fn": self.activation_fn,
            "share_actor": self.share_actor,
            "share_critic": self.share_critic,
            "threshold": self.threshold,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        obs, vectorized = super().obs_to_tensor(observation)
        assert isinstance(obs, th.Tensor)
        finite = obs.isfinite()
        if not finite.all():
            agents = (~finite).any(dim=-1).nonzero()[:, 1].unique().tolist()
            raise ValueError(
                f"The observation of agent(s) {agents} holds NaN or infinity. An action for it would mean nothing: "
                "clip or replace such values in the environment."
            )
        return obs, vectorized

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        actions = self.actor.act(observation.float(), deterministic).flatten(1)
        return actions if isinstance(self.action_space, spaces.Box) else actions.to(th.int8)
