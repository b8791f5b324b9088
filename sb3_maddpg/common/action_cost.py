"""The known cost of actions, which critics need not learn."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_maddpg.common.policies import Critic, MADDPGPolicy
from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.utils import as_numbers, shown


class ActionCost:
    """
    What actions cost by the environment's ``action_cost``, which the reward contains as a plain sum: critics learn the
    rest of the return, and the cost is added to targets and subtracted from values exactly. Without a price, all costs
    are 0.

    :param price: price of one unit of the encoded action, (n_agents, width), None if it is unknown
    """

    def __init__(self, price: th.Tensor | None = None):
        self.price = price

    @staticmethod
    def told_by(env: VecEnv) -> Any:
        """
        :return: the environment's ``action_cost``
        :raises InvalidEnvironmentError: if it has none
        """
        cost = env.get_attr("action_cost", indices=0)[0] if env.has_attr("action_cost") else None
        if cost is None:
            raise InvalidEnvironmentError("use_action_cost=True, but the environment has no attribute `action_cost`.")
        return cost

    @classmethod
    def of_policy(cls, told: Any, policy: MADDPGPolicy) -> ActionCost:
        """
        :param told: ``action_cost`` of an environment, None if it is unknown
        :param policy: policy of the team
        :return: the cost of the team's actions
        :raises InvalidEnvironmentError: if ``told`` holds other things than finite numbers, or does not fit the actions
        """
        if told is None:
            return cls()
        shape = (policy.team.n_agents, policy.actions.width)
        try:
            price = as_numbers(told)
        except ValueError:
            price = np.full((), np.nan)
        if not np.isfinite(price).all():
            raise InvalidEnvironmentError(
                f"action_cost={shown(told)} of the environment must be a finite number, or finite numbers of "
                f"shape (n_agents, width) = {shape}."
            )
        try:
            price = np.broadcast_to(price, shape)
        except ValueError as error:
            raise InvalidEnvironmentError(
                f"action_cost of shape {np.shape(told)} cannot be broadcast to (n_agents, width) = {shape}."
            ) from error
        return cls(th.as_tensor(price.copy(), device=policy.device))

    def scaled(self, normalizer: VecNormalize | None) -> ActionCost:
        """
        :param normalizer: what may normalise rewards
        :return: the cost on the scale of the rewards that the replay buffer returns
        """
        if self.price is None or normalizer is None or not normalizer.norm_reward:
            return self
        return ActionCost(self.price / float(np.sqrt(normalizer.ret_rms.var + normalizer.epsilon)))

    def of(self, actions: th.Tensor, critic: Critic) -> th.Tensor | float:
        """
        :param actions: encoded actions, (batch, n_agents, width)
        :param critic: the critic that predicts rewards with these costs in them
        :return: what the actions cost for each value head, (batch, n_values)
        """
        if self.price is None:
            return 0.0
        return critic.heads.of_factors(critic.factored(actions * self.price).sum(dim=-1))

    def of_alternatives(self, own: th.Tensor, factors: th.Tensor | None, critic: Critic) -> th.Tensor | float:
        """
        :param own: alternatives for the action of each factor, see ``Critic.forward_alternatives``
        :param factors: indices of the factors, None for all
        :param critic: the critic
        :return: what they cost in units of a value, (batch, len(factors), M)
        """
        if self.price is None:
            return 0.0
        price = critic.heads.in_units_of_value(critic.factored(self.price.unsqueeze(0))[0])
        return (own * (price if factors is None else price[factors]).unsqueeze(1)).sum(dim=-1)
