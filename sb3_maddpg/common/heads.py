"""Value heads: whose rewards each value of a critic predicts."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_maddpg.common.buffers import TeamReplayBufferSamples


class ValueHeads(nn.Module):
    """
    The value heads of a critic, by default one per agent, which predicts the agent's rewards. Heads are ordered by
    agent, and each agent has the same number of them.

    :param n_agents: number of agents
    :param per_agent: number of value heads per agent
    """

    agent_of: th.Tensor
    """The agent that each head belongs to, (n_values,)"""

    def __init__(self, n_agents: int, per_agent: int = 1):
        super().__init__()
        self.n_agents, self.per_agent = n_agents, per_agent
        self.register_buffer("agent_of", th.arange(n_agents).repeat_interleave(per_agent), persistent=False)

    def __len__(self) -> int:
        return len(self.agent_of)

    def rewards(self, batch: TeamReplayBufferSamples) -> th.Tensor:
        """:return: the rewards that the heads predict, (batch, n_values)"""
        return batch.rewards

    def discounts(self, batch: TeamReplayBufferSamples) -> th.Tensor:
        """:return: factors of the heads' next values in their targets, (batch, n_values)"""
        return self.per_value((1 - batch.dones) * batch.discounts)

    def per_value(self, of_agents: th.Tensor) -> th.Tensor:
        """
        Broadcast values of agents to their heads.

        :param of_agents: values of the agents, (batch, n_agents)
        :return: values of the heads, (batch, n_values)
        """
        return of_agents if self.per_agent == 1 else of_agents[..., self.agent_of]

    def of_factors(self, values: th.Tensor) -> th.Tensor:
        """
        Sum what the rewards of heads contain of numbers that belong to factors of actions, such as costs.

        :param values: numbers of the factors, which are agents or parts of their actions, (batch, n_factors)
        :return: numbers of the heads, (batch, n_values)
        """
        if values.shape[-1] == len(self):
            return values
        return self.per_value(self.sum_by_agent(values)) / self.per_agent

    def in_units_of_value(self, of_agents: th.Tensor) -> th.Tensor:
        """
        :param of_agents: rewards of agents, any shape
        :return: what they add to a head's value
        """
        return of_agents

    def sum_by_agent(self, values: th.Tensor) -> th.Tensor:
        """
        Sum over the heads, or factors, of each agent.

        :param values: values of all heads or factors, (..., n)
        :return: sums, (..., n_agents)
        """
        # Every agent has the same number, so a reshape replaces index_add
        one_each = values.shape[-1] == self.n_agents
        return values if one_each else values.unflatten(-1, (self.n_agents, -1)).sum(dim=-1)

    def owners(self, heads: th.Tensor) -> th.Tensor:
        """
        :param heads: indices of heads, (n,)
        :return: indices of the agents whose values these heads predict
        """
        return self.agent_of[heads]

    def of_agent(self, agent: int) -> th.Tensor:
        """
        :param agent: index of an agent
        :return: indices of the heads that predict this agent's rewards alone, (n,)
        """
        return (self.agent_of == agent).nonzero().flatten()


class PairHeads(ValueHeads):
    """
    One value head per neighbour of an agent, which predicts the rewards of the pair, ``info["pair_rewards"]``.

    :param n_agents: number of agents
    :param n_neighbours: number of neighbours of an agent
    """

    def rewards(self, batch: TeamReplayBufferSamples) -> th.Tensor:
        assert batch.pair_rewards is not None
        return batch.pair_rewards.flatten(1)

    def discounts(self, batch: TeamReplayBufferSamples) -> th.Tensor:
        discounts = super().discounts(batch)
        return discounts if batch.pair_goes_on is None else discounts * batch.pair_goes_on.flatten(1)


class TeamHead(ValueHeads):
    """
    A single head for the whole team, which predicts the mean of the agents' rewards until all have terminated.

    :param n_agents: number of agents
    """

    def __init__(self, n_agents: int):
        super().__init__(n_agents)
        self.agent_of = th.zeros(1, dtype=th.long)

    def rewards(self, batch: TeamReplayBufferSamples) -> th.Tensor:
        return batch.rewards.mean(dim=-1, keepdim=True)

    def per_value(self, of_agents: th.Tensor) -> th.Tensor:
        return of_agents.amax(dim=-1, keepdim=True)

    def of_factors(self, values: th.Tensor) -> th.Tensor:
        return values.mean(dim=-1, keepdim=True)

    def in_units_of_value(self, of_agents: th.Tensor) -> th.Tensor:
        return of_agents / self.n_agents

    def sum_by_agent(self, values: th.Tensor) -> th.Tensor:
        return values.expand(*values.shape[:-1], self.n_agents)

    def owners(self, heads: th.Tensor) -> th.Tensor:
        return th.arange(self.n_agents)

    def of_agent(self, agent: int) -> th.Tensor:
        return th.empty(0, dtype=th.long, device=self.agent_of.device)
