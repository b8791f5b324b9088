"""A price for every threshold, thresholds that are seldom random, and thresholds chosen after the training."""

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_maddpg import MADDPG
from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.maddpg.maddpg import _price_up_to
from toys import SMALL, Neighbours

PRICES = (0.001, 1.0)


class Gains(gymnasium.Env):
    """Two agents with two bits each; a bit is worth its gain, whatever else happens."""

    gains = np.array([0.02, 0.2, 0.005, 0.5])

    def __init__(self):
        self.observation_space = spaces.Box(-1, 1, (2, 3))
        self.action_space = spaces.MultiBinary(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones((2, 3), np.float32), {}

    def step(self, action):
        values = (action * self.gains).reshape(2, 2).sum(axis=1)
        return np.ones((2, 3), np.float32), float(values.sum()), True, False, {"agent_rewards": values}


def test_a_score_pays_the_prices_up_to_it():
    scores = th.linspace(0, 1, 7)
    fine = np.linspace(0, 1, 100_001)
    prices = PRICES[0] * (PRICES[1] / PRICES[0]) ** fine
    integral = np.concatenate([[0], np.cumsum((prices[1:] + prices[:-1]) / 2) * (fine[1] - fine[0])])
    np.testing.assert_allclose(_price_up_to(scores, PRICES), np.interp(scores, fine, integral), rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_scores_say_up_to_which_price_a_bit_is_worth_setting():
    kwargs = {"learning_rate": 3e-3, "learning_starts": 200, "train_freq": 1, "batch_size": 64, "gamma": 0.0}
    model = MADDPG("MlpPolicy", Gains(), threshold_price=PRICES, policy_regularization=0.0, seed=0, **kwargs)
    model.learn(4_000)
    with th.no_grad():
        scores = model.actor(th.ones(1, 2, 3))[0].numpy().ravel()
    expected = np.log(Gains.gains / PRICES[0]) / np.log(PRICES[1] / PRICES[0])
    np.testing.assert_allclose(scores, expected, atol=0.08)
    asked = []
    for threshold in (0.1, 0.3, 0.5, 0.7, 0.85):
        model.set_threshold(threshold)
        asked.append(int(model.predict(np.ones((2, 3), np.float32), deterministic=True)[0].sum()))
    assert asked == [4, 3, 2, 2, 1]


def test_the_threshold_is_saved(tmp_path):
    model = MADDPG("MlpPolicy", Gains(), **SMALL)
    model.set_threshold(0.9)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    assert loaded.policy.threshold == 0.9
    assert np.array_equal(*(m.predict(np.ones((2, 3), np.float32), deterministic=True)[0] for m in (model, loaded)))
    with pytest.raises(ValueError, match=r"threshold=1\.5"):
        model.set_threshold(1.5)


def test_few_thresholds_may_be_random():
    team, logits = [spaces.MultiBinary(3)], th.full((4000, 1, 3), 1.0)  # scores 0.73
    for share, expected in ((1.0, 0.731), (0.25, 0.75 + 0.25 * 0.731)):
        bits = TeamActions(team, 0.5, 3, share).act(logits, deterministic=False)
        assert bits.mean().item() == pytest.approx(expected, abs=0.02)


def test_the_policy_fits_a_team_of_another_size():
    small, large = Neighbours(n_agents=3), Neighbours(n_agents=5)
    model = MADDPG("PairPolicy", small, **SMALL)
    policy = model.policy_for(large.observation_space, large.action_space, large.observation_layout)
    obs, _ = large.reset(seed=0)
    other = MADDPG("PairPolicy", large, **SMALL)
    other.set_parameters(model.get_parameters())
    assert np.array_equal(policy.predict(obs, deterministic=True)[0], other.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match="fits a single team size"):
        MADDPG("MlpPolicy", small, **SMALL).policy_for(
            large.observation_space, large.action_space, large.observation_layout
        )


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"threshold_price": (0.5, 0.1)}, "a positive price and a higher one"),
        ({"threshold_price": (0.0, 0.1)}, "a positive price and a higher one"),
        ({"policy_kwargs": {"random_thresholds": 0.0}}, "0 would not explore"),
    ],
)
def test_senseless_arguments_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", Gains(), **{**SMALL, **kwargs})


def test_prices_are_for_bits():
    env = Gains()
    env.action_space = spaces.Box(-1, 1, (4,))
    with pytest.raises(ValueError, match="threshold_price is for binary actions"):
        MADDPG("MlpPolicy", env, threshold_price=PRICES, **SMALL)
