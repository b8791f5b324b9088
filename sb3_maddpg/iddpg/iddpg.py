"""Independent DDPG: the baseline without centralised critics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.policies import Critic, MADDPGPolicy, StackedCritic, sharing_groups
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.team.team import Team


class IndependentCritic(StackedCritic):
    """
    One multi-layer perceptron per agent, which reads the agent's own observation and action: Q_i(z_i, a_i).

    :param team: the team
    :param actions: the team's actions
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    :param groups: index of each agent's network
    :param n_critics: number of critics per agent
    """

    def __init__(
        self,
        team: Team,
        actions: TeamActions,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        groups: Sequence[int] | None = None,
        n_critics: int = 1,
    ):
        groups = groups or range(team.n_agents)
        super().__init__(team, actions, team.obs_dim + actions.width, net_arch, activation_fn, groups, n_critics)
        self.obs_dim = team.obs_dim

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        inputs = th.cat([obs[..., : self.obs_dim], actions], dim=2).permute(1, 2, 0)
        return self.by_critic(self.net(inputs.repeat(self.n_critics, 1, 1)))

    def forward_alternatives(
        self, obs: th.Tensor, actions: th.Tensor, own: th.Tensor, factors: th.Tensor | None = None
    ) -> th.Tensor:
        agents = th.arange(self.n_agents, device=own.device) if factors is None else factors
        layers = self.net.layers()
        weight, bias = (self.net.of_networks(parameter, agents) for parameter in layers[0])
        # The first layer is linear, so the observation passes through it only once for all alternatives
        seen = th.baddbmm(bias, weight[..., : self.obs_dim], obs[:, agents, : self.obs_dim].permute(1, 2, 0))
        chosen = own.permute(1, 3, 2, 0)
        shape = chosen.shape[2:]
        first = th.bmm(weight[..., self.obs_dim :], chosen.flatten(2)).unflatten(2, shape) + seen.unsqueeze(2)
        values = self.net.after_first(first.flatten(2), layers, agents)
        return values.squeeze(1).unflatten(1, shape).permute(2, 0, 1)


@allow_in_files(name="sb3_maddpg.iddpg.IndependentPolicy")
class IndependentPolicy(MADDPGPolicy):
    """``MADDPGPolicy`` with critics that read only their own agent's observation and action."""

    def _make_critic(self, actions: TeamActions, net_arch: list[int]) -> Critic:
        if isinstance(self.share_critic, str):
            raise InvalidArgumentError(
                f"share_critic={self.share_critic!r} requires a centralised critic, but IDDPG has independent critics. "
                "Pass True, False or a list of lists of agents, or use MADDPG."
            )
        groups = sharing_groups(self.share_critic, self.team, "share_critic")
        return IndependentCritic(self.team, actions, net_arch, self.activation_fn, groups, self.n_critics)


class IDDPG(MADDPG):
    """
    Independent DDPG (IDDPG): each agent learns alone, with a critic of its own observation and action. This baseline
    shows what centralised critics are worth. All else is the same as in ``MADDPG``, including the arguments.

    Independent learners are compared with MADDPG in Lowe et al. (2017), https://arxiv.org/abs/1706.02275.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": IndependentPolicy}
    algorithm_name: ClassVar[str] = "IDDPG"
