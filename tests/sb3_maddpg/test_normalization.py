"""Statistics of VecNormalize as JSON: they come back, and nothing else is read."""

import json
import math
import pickle
from unittest.mock import patch

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg.normalization import SafeVecNormalize
from sb3_maddpg.team_tasks import OtherBit, OwnBit


def seen(env_class=OwnBit, **kwargs) -> SafeVecNormalize:
    env = SafeVecNormalize(DummyVecEnv([env_class]), **kwargs)
    env.seed(0)
    env.reset()
    for _ in range(20):
        env.step(np.array([env.action_space.sample()]))
    return env


@pytest.mark.parametrize("kwargs", [{}, {"norm_obs": False}, {"norm_reward": False, "clip_obs": np.inf, "gamma": 0.9}])
def test_statistics_come_back(tmp_path, kwargs):
    env = seen(**kwargs)
    env.save(str(tmp_path / "stats.pkl"))
    with patch("pickle.load", side_effect=AssertionError), patch("pickle.loads", side_effect=AssertionError):
        loaded = SafeVecNormalize.load(str(tmp_path / "stats.pkl"), DummyVecEnv([OwnBit]))
    obs = np.random.default_rng(0).normal(size=(4, *env.observation_space.shape)).astype(np.float32)
    assert np.array_equal(loaded.normalize_obs(obs), env.normalize_obs(obs))
    assert np.array_equal(loaded.normalize_reward(np.arange(3.0)), env.normalize_reward(np.arange(3.0)))
    for name in ("training", "norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon"):
        assert getattr(loaded, name) == getattr(env, name)
    assert loaded.ret_rms.count == env.ret_rms.count


def test_statistics_of_parts_of_observations_come_back(tmp_path):
    class Parts(OwnBit):
        def __init__(self):
            super().__init__()
            self.observation_space = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Box(-1, 1, (3,))})

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 1.0, False, False, {}

    env = seen(Parts, norm_obs_keys=["b"])
    env.save(str(tmp_path / "stats.pkl"))
    loaded = SafeVecNormalize.load(str(tmp_path / "stats.pkl"), DummyVecEnv([Parts]))
    assert list(loaded.obs_rms) == ["b"]
    assert np.array_equal(loaded.obs_rms["b"].mean, env.obs_rms["b"].mean)


def test_pickles_need_trust(tmp_path):
    path = tmp_path / "stats.pkl"
    VecNormalize(DummyVecEnv([OwnBit])).save(str(path))
    with pytest.raises(ValueError, match=r"stats\.pkl does not hold statistics .*`trust=True`"):
        SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit]))
    assert isinstance(SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit]), trust=True), VecNormalize)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "has format x"),
        ({"settings": {}}, "training is missing"),
        ({"settings": 5}, "damaged"),
        ({"settings": {"$": "class", "name": "os.system"}}, "Unknown class"),
        ({"obs_rms": 5}, "damaged"),
        ({"ret_rms": {"mean": 0.0, "var": 1.0, "count": 1.0}}, r"has shape|damaged"),
        ({"ret_rms": {"mean": np.zeros(()), "var": np.full((), -1.0), "count": 1.0}}, "negative variance"),
        ({"ret_rms": {"mean": np.full((), np.nan), "var": np.ones(()), "count": 1.0}}, "NaN"),
        ({"ret_rms": {"mean": np.zeros(()), "var": np.ones(()), "count": 0.0}}, "negative variance"),
    ],
)
def test_spoilt_statistics_are_refused(tmp_path, change, message):
    from sb3_maddpg.typed_json import encode

    path = tmp_path / "stats.pkl"
    seen().save(str(path))
    plain = {key: value if "$" in str(value) else encode(value, key) for key, value in change.items()}
    path.write_text(json.dumps({**json.loads(path.read_text()), **plain}))
    with pytest.raises(ValueError, match=message):
        SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit]))


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("training", "x"),
        ("clip_obs", math.nan),
        ("clip_obs", "x"),
        ("clip_reward", 0.0),
        ("gamma", 1e300),
        ("epsilon", -10.0),
        ("epsilon", math.inf),
        ("norm_obs_keys", [5]),
    ],
)
def test_spoilt_settings_are_refused(tmp_path, name, wrong):
    path = tmp_path / "stats{}.pkl"
    env = seen()
    setattr(env, name, wrong)
    env.save(str(path))
    with pytest.raises(ValueError, match=rf"stats{{}}\.pkl: {name}=.* must be"):
        SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit]))


def test_statistics_of_other_observations_are_refused(tmp_path):
    path = tmp_path / "stats.pkl"
    seen().save(str(path))
    with pytest.raises(ValueError, match="statistics of other observations"):
        SafeVecNormalize.load(str(path), DummyVecEnv([OtherBit]))
    path.write_bytes(pickle.dumps({})[:3])
    with pytest.raises(ValueError, match="damaged"):
        SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit]), trust=True)


def test_the_suffix_may_be_left_out(tmp_path):
    env = seen()
    env.save(str(tmp_path / "stats"))
    loaded = SafeVecNormalize.load(str(tmp_path / "stats"), DummyVecEnv([OwnBit]))
    assert loaded.ret_rms.count == env.ret_rms.count
