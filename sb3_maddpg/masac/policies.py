"""Policies of MASAC: actors with an entropy, and twin critics."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_maddpg.common.actions import Binary, TeamActions
from sb3_maddpg.common.networks import StackedMLP
from sb3_maddpg.common.policies import Actor, Critic, MADDPGPolicy, MLPActor, sharing_groups
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.team.team import Team

# Bounds of the logarithm of the standard deviation, as in SB3's SAC
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


class SoftActor(MLPActor):
    """
    Actors whose continuous actions are drawn from a Gaussian before they are squashed. Its mean and the logarithm of
    its standard deviation are outputs of the same network. Bits and categories are drawn from their probabilities.

    :param team: the team
    :param actions: the team's actions
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    :param groups: index of each agent's network
    """

    log_ent_coef: th.Tensor
    """Logarithm of each agent's entropy coefficient, (n_agents,)"""

    def __init__(
        self,
        team: Team,
        actions: TeamActions,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        groups: Sequence[int] | None = None,
    ):
        super().__init__(team, actions, net_arch, activation_fn, groups)
        width = actions.width * (2 if actions.has_continuous else 1)
        self.net = StackedMLP(groups or range(team.n_agents), team.obs_dim, width, net_arch, activation_fn)
        self.log_ent_coef = nn.Parameter(th.zeros(team.n_agents))

    def _outputs(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """:return: logits, (batch, n_agents, width), and further outputs, (batch, n_agents, width or 0)"""
        outputs = self.net(obs[..., : self.team.obs_dim].permute(1, 2, 0)).permute(2, 0, 1)
        width = self.actions.width
        return self.actions.mask(outputs[..., :width], obs), outputs[..., width:]

    def logits(self, obs: th.Tensor) -> th.Tensor:
        return self._outputs(obs)[0]

    def act(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        if deterministic:
            return super().act(obs)
        return self.actions.act(self.sample(obs)[0], deterministic=False)

    def sample(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Draw continuous actions with the reparameterisation trick.

        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: logits, (batch, n_agents, width), those of continuous actions drawn from their Gaussians; and the
            entropy of each agent's policy, (batch, n_agents): a sample for continuous actions, exact for categories,
            and for bits the sum of each one's
        """
        logits, log_std = self._outputs(obs)
        entropy = self._entropy_of_choices(logits)
        if self.actions.has_continuous:
            log_std = log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
            noise = th.randn_like(log_std)
            drawn = logits + log_std.exp() * noise
            # Of the Gaussian, and of a change of variables to tanh(x / 2), see Continuous.squash
            log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
            log_slope = math.log(2.0) - drawn - 2 * nn.functional.softplus(-drawn)
            is_drawn = self.actions.continuous_columns
            entropy = entropy + ((log_slope - log_prob) * is_drawn).sum(dim=-1)
            logits = th.where(is_drawn, drawn, logits)
        return logits, entropy

    def _entropy_of_choices(self, logits: th.Tensor) -> th.Tensor:
        """:return: the entropy of bits and categories, (batch, n_agents)"""
        entropy = logits.new_zeros(logits.shape[:2])
        if not self.actions.discrete:
            return entropy
        for kind in self.actions.kinds:
            chosen = self.actions.discrete_columns[kind.agents, : kind.width]
            if chosen.any():
                p = kind.squash(logits[:, kind.agents, : kind.width])
                nats = _of_outcome(p) + (_of_outcome(1 - p) if isinstance(kind, Binary) else 0.0)
                entropy[:, kind.agents] = (nats * chosen).sum(dim=-1)
        return entropy

    def single(self, agent: int) -> nn.Module:
        network = super().single(agent)
        assert isinstance(network, nn.Sequential)
        *hidden, last = network
        assert isinstance(last, nn.Linear)
        mean = nn.utils.skip_init(nn.Linear, last.in_features, self.actions.width, device=last.weight.device)
        with th.no_grad():
            mean.weight.copy_(last.weight[: self.actions.width])
            mean.bias.copy_(last.bias[: self.actions.width])
        return nn.Sequential(*hidden, mean)


def _of_outcome(p: th.Tensor) -> th.Tensor:
    """:return: what outcomes of these probabilities add to an entropy; its gradient is finite also at 0"""
    return -p * p.clamp_min(1e-20).log()


@allow_in_files(name="sb3_maddpg.masac.SoftPolicy")
class SoftPolicy(MADDPGPolicy):
    """
    ``MADDPGPolicy`` with actors that have an entropy, and twin critics. As in SAC, targets read the actors themselves,
    so that the target actors are not used.
    """

    def _make_networks(self, actor_arch: list[int], critic_arch: list[int]) -> tuple[Actor, Critic]:
        actions = TeamActions(
            self.team.action_spaces,
            self.threshold,
            random_thresholds=self.random_thresholds,
            masks=self.team.masks,
        )
        groups = sharing_groups(self.share_actor, self.team, "share_actor")
        actor = SoftActor(self.team, actions, actor_arch, self.activation_fn, groups)
        return actor, self._make_critic(actions, critic_arch)

    def _divide_images(self) -> None:
        raise InvalidArgumentError(
            "MASAC has no policy for images: use MADDPG with CnnPolicy, or divide them by 255 in the environment and "
            "pass policy_kwargs={'normalize_images': False}."
        )
