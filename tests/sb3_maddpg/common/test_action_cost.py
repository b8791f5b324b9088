"""The known cost of actions, in the units of each kind of critic."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import MADDPG
from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.team.toys import OwnBit

PRICE = np.arange(9.0, dtype=np.float32).reshape(3, 3)


def critic(**kwargs):
    return MADDPG("MlpPolicy", OwnBit(), policy_kwargs=kwargs, seed=0).critic


@pytest.mark.parametrize("share", [False, True, "team"])
def test_what_actions_cost_is_in_the_units_of_values(share):
    of, cost = critic(share_critic=share), ActionCost(th.as_tensor(PRICE))
    actions = th.bernoulli(th.full((5, 3, 3), 0.5))
    of_agents = (actions * cost.price).sum(dim=2)
    expected = of_agents.mean(dim=1, keepdim=True) if share == "team" else of_agents
    assert th.allclose(cost.of(actions, of), expected)
    # Alternatives to each agent's own action
    alternatives = th.bernoulli(th.full((5, 3, 4, 3), 0.5))
    spent = (alternatives * cost.price[:, None]).sum(dim=3) / (3 if share == "team" else 1)
    assert th.allclose(cost.of_alternatives(alternatives, None, of), spent)
    assert th.allclose(cost.of_alternatives(alternatives[:, 1:2], th.tensor([1]), of), spent[:, 1:2])


def test_without_a_price_nothing_costs_anything():
    cost, of = ActionCost(), critic()
    assert cost.of(th.ones(1, 3, 3), of) == cost.of_alternatives(th.ones(1, 3, 1, 3), None, of) == 0.0
    assert cost.scaled(None) is cost


def test_the_price_is_scaled_as_rewards_are():
    normalizer = VecNormalize(DummyVecEnv([OwnBit]), norm_obs=False)
    normalizer.ret_rms.var = np.array(4.0 - normalizer.epsilon)
    cost = ActionCost(th.as_tensor(PRICE))
    assert cost.scaled(normalizer).price.numpy() == pytest.approx(PRICE / 2)
    normalizer.norm_reward = False
    assert cost.scaled(normalizer) is cost
