"""Statistics of VecNormalize as JSON: they come back, and nothing else is read."""

import json
import math
import pickle
import warnings
from unittest.mock import patch

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import MADDPG
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.toys import OtherBit, OwnBit
from sb3_maddpg.vec_env.normalize import ObservationStatistics, SafeVecNormalize, for_team


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
        (
            {"ret_rms": {"mean": np.zeros(()), "var": np.ones(()), "count": 0.0}},
            "count is 0.0: it must be a positive number",
        ),
    ],
)
def test_spoilt_statistics_are_refused(tmp_path, change, message):
    from sb3_maddpg.files.typed_json import encode

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


class Fragile(ParallelEnv):
    """Both agents observe 100 +- 1. ``a`` ends in step 4 of 40, if it is not ``whole``."""

    metadata = {"name": "fragile"}  # noqa: RUF012

    def __init__(self, whole: bool = False, truncates: bool = False, rewards=(1.0, 1.0)):
        self.possible_agents, self.whole, self.truncates = ["a", "b"], whole, truncates
        self.rewards = dict(zip("ab", rewards, strict=True))
        self.rng = np.random.default_rng(0)

    def observation_space(self, agent):
        return spaces.Box(-200, 200, (2 + (agent == "b"),))

    def action_space(self, agent):
        return spaces.Discrete(2)

    def look(self, agents):
        return {agent: self.rng.normal(100, 1, 2 + (agent == "b")).astype(np.float32) for agent in agents}

    def reset(self, seed=None, options=None):
        self.agents, self.t = ["a", "b"], 0
        return self.look(self.agents), {}

    def step(self, actions):
        self.t += 1
        acted, over = self.agents, self.t == 40
        out = {agent: over or (agent == "a" and self.t == 4 and not self.whole) for agent in acted}
        self.agents = [agent for agent in acted if not out[agent]]
        cut = {agent: out[agent] and (over or self.truncates) for agent in acted}
        gone = {agent: out[agent] and not cut[agent] for agent in acted}
        seen = self.look([agent for agent in acted if not gone[agent]])
        return seen, {agent: self.rewards[agent] for agent in acted}, gone, cut, {}


FAST = {"learning_starts": 20, "batch_size": 16, "train_freq": 10, "buffer_size": 1000, "seed": 0}


@pytest.mark.slow
@pytest.mark.parametrize("make", [VecNormalize, SafeVecNormalize])
@pytest.mark.parametrize("truncates", [False, True])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_agents_that_are_gone_do_not_enter_the_statistics(make, truncates, n_steps):
    env = make(DummyVecEnv([lambda: TeamEnv(Fragile(truncates=truncates)) for _ in range(2)]), norm_reward=False)
    model = MADDPG("MlpPolicy", env, **FAST, n_steps=n_steps).learn(1000)
    assert env.obs_rms.mean[0, :2] == pytest.approx(100, abs=0.5)
    assert env.obs_rms.var[0, :2] == pytest.approx(1, abs=0.5)
    assert env.obs_rms.mean[1] == pytest.approx(100, abs=0.2)
    assert env.obs_rms.var[1] == pytest.approx(1, abs=0.2)
    assert env.obs_rms.count[0, 0] < env.obs_rms.count[1, 0] / 5
    batch = model.replay_buffer.sample(500, env=env)
    alive = batch.active[:, 0].numpy() > 0
    # The last observation of a truncated agent begins the first step without it
    kept = batch.observations[~alive, 0].any(dim=1).float().mean()
    assert 0 < kept < 0.1 if truncates else kept == 0, "zeros stay zeros"
    assert not batch.observations[:, 0, 2].any(), "and so does padding"
    assert batch.observations[alive, 0, :2].std().item() == pytest.approx(1, abs=0.4)
    if truncates and n_steps == 1:
        assert batch.next_observations[alive, 0, :2].std().item() == pytest.approx(1, abs=0.4)
    assert 0 < alive.mean() < 0.2


def test_statistics_with_counts_of_their_own_come_back(tmp_path):
    env = SafeVecNormalize(DummyVecEnv([lambda: TeamEnv(Fragile())]))
    MADDPG("MlpPolicy", env, **FAST).learn(100)
    env.save(str(tmp_path / "stats.pkl"))
    loaded = SafeVecNormalize.load(str(tmp_path / "stats.pkl"), DummyVecEnv([lambda: TeamEnv(Fragile())]))
    for name in ("mean", "var", "count"):
        assert np.array_equal(getattr(loaded.obs_rms, name), getattr(env.obs_rms, name))
    loaded.reset()
    assert loaded.obs_rms.count[0, 0] == env.obs_rms.count[0, 0] + 1


def test_what_the_replay_buffer_stores_is_not_clipped():
    class Jumps(OwnBit):
        def __init__(self):
            super().__init__()
            self.observation_space = spaces.Box(-1e6, 1e6, self.observation_space.shape)

        def step(self, action):
            obs, *rest, info = super().step(action)
            return obs + (1e5 if self._steps == 10 else 0), *rest, info

    model = MADDPG("MlpPolicy", VecNormalize(DummyVecEnv([Jumps])), **FAST).learn(20)
    assert model.replay_buffer.next_observations[9].min() == pytest.approx(1e5, abs=2)


@pytest.mark.parametrize("rewards", [(1.0, -1.0), (100.0, -100.0), (5.0, -4.999)])
def test_rewards_are_scaled_by_what_agents_receive(rewards):
    """In a zero-sum game the team receives nothing."""
    env = VecNormalize(DummyVecEnv([lambda: TeamEnv(Fragile(True, rewards=rewards))]), norm_obs=False, gamma=0.5)
    model = MADDPG("MlpPolicy", env, **FAST).learn(400)
    batch = model.replay_buffer.sample(100, env=env)
    # An agent's discounted return goes to twice its reward; their spread over both agents is the scale
    expected = np.array(rewards) / (np.ptp(rewards) / 2 * 2)
    assert batch.rewards.numpy() == pytest.approx(np.tile(expected, (100, 1)), rel=0.1)


def test_rewards_of_cooperative_teams_are_scaled_as_in_stable_baselines3():
    theirs, ours = (VecNormalize(DummyVecEnv([lambda: TeamEnv(Fragile(True))])) for _ in range(2))
    for_team(ours)
    assert type(theirs) is VecNormalize is not type(ours)
    for env in (theirs, ours):
        env.reset()
        for _ in range(100):
            env.step(np.zeros((1, 2), np.int64))
    assert ours.ret_rms.var == pytest.approx(theirs.ret_rms.var, rel=1e-3)
    assert ours.obs_rms.mean == pytest.approx(theirs.obs_rms.mean, rel=1e-3)


def wrapped(**kwargs) -> VecNormalize:
    return VecNormalize(DummyVecEnv([lambda: TeamEnv(Fragile())]), norm_reward=False, **kwargs)


def trained(path=None) -> MADDPG:
    model = MADDPG("MlpPolicy", wrapped(), **FAST).learn(200)
    if path is not None:
        model.save(path)
    return model


def test_agents_carry_the_statistics(tmp_path):
    model = trained(tmp_path / "model")
    env = model.get_vec_normalize_env()
    raw = np.random.default_rng(0).normal(100, 3, (20, 2, 3)).astype(np.float32)
    expected, _ = model.predict(env.normalize_obs(raw), deterministic=True)
    assert 0 < np.mean(expected) < 1
    with pytest.warns(UserWarning, match="predict\\(\\) expects observations that are normalised"):
        loaded = MADDPG.load(tmp_path / "model")
    for agent in (model.agent_policy("b"), loaded.agent_policy("b")):
        assert [int(agent.predict(obs[1])[0]) for obs in raw] == expected[:, 1].tolist()
    agent.export(tmp_path / "b.pt")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        program = th.jit.load(tmp_path / "b.pt")
    assert program(th.as_tensor(raw[:, 1])).ravel().tolist() == expected[:, 1].tolist()
    assert loaded.agent_policy("a").predict(raw[0, 0, :2])[0].shape == ()


def test_a_model_goes_on_only_with_its_statistics(tmp_path):
    model = trained(tmp_path / "model")
    with pytest.raises(ValueError, match="does not normalise observations: wrap it in VecNormalize"):
        MADDPG.load(tmp_path / "model", env=TeamEnv(Fragile()))
    with pytest.raises(ValueError, match="does not normalise observations"):
        model.set_env(TeamEnv(Fragile()))
    env = wrapped()
    loaded = MADDPG.load(tmp_path / "model", env=env)
    assert np.array_equal(env.obs_rms.mean, model.get_vec_normalize_env().obs_rms.mean)
    loaded.learn(40, reset_num_timesteps=False)
    by_itself = MADDPG.load(tmp_path / "model", env=TeamEnv(Fragile()), normalized_observations=False)
    by_itself.learn(40, reset_num_timesteps=False)
    by_itself.agent_policy("a")


def test_statistics_that_have_seen_less_are_not_those_of_the_training(tmp_path):
    model = trained(tmp_path / "model")
    begun = wrapped()
    begun.reset()
    with pytest.raises(ValueError, match="has seen 1 observations, fewer than the 201 of the model's training"):
        MADDPG.load(tmp_path / "model", env=begun)
    later = trained(tmp_path / "earlier").learn(100, reset_num_timesteps=False).get_vec_normalize_env()
    MADDPG.load(tmp_path / "model", env=later)
    model.set_env(model.get_env())


def test_a_model_of_plain_observations_meets_no_others(tmp_path):
    model = MADDPG("MlpPolicy", TeamEnv(Fragile()), **FAST).learn(40)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="observations that were not normalised, but this environment normalises them"):
        MADDPG.load(tmp_path / "model", env=wrapped())
    with pytest.raises(ValueError, match=r"set VecNormalize\(norm_obs=False\)"):
        model.set_env(wrapped())
    rewards = VecNormalize(DummyVecEnv([lambda: TeamEnv(Fragile())]), norm_obs=False)
    MADDPG.load(tmp_path / "model", env=rewards).learn(20, reset_num_timesteps=False)
    untrained = MADDPG("MlpPolicy", TeamEnv(Fragile()), **FAST)
    untrained.set_env(wrapped())
    assert untrained.normalized_observations


def test_a_model_knows_one_normalizer():
    twice = VecNormalize(wrapped(), norm_obs=False)
    with pytest.raises(ValueError, match="wrapped in VecNormalize 2 times"):
        MADDPG("MlpPolicy", twice, **FAST)


def test_files_without_statistics_need_those_of_the_training(tmp_path):
    """As earlier versions wrote them."""
    model = trained()
    SafeVecNormalize.save(model.get_vec_normalize_env(), str(tmp_path / "vecnormalize.pkl"))
    model.save(tmp_path / "model", exclude=["observation_statistics"])
    with pytest.warns(UserWarning, match="predict"):
        loaded = MADDPG.load(tmp_path / "model")
    with pytest.raises(ValueError, match="neither its file nor an environment holds the statistics"):
        loaded.agent_policy(0)
    with pytest.raises(ValueError, match="has not seen any observation yet"):
        MADDPG.load(tmp_path / "model", env=wrapped())
    env = SafeVecNormalize.load(str(tmp_path / "vecnormalize.pkl"), DummyVecEnv([lambda: TeamEnv(Fragile())]))
    MADDPG.load(tmp_path / "model", env=env).agent_policy(0)


@pytest.mark.parametrize("change", [{"mean": 1.0}, {"var": np.full((2, 3), -1.0)}, {"clip": 0.0}, {"epsilon": "x"}])
def test_statistics_of_a_model_are_checked(change, tmp_path):
    model = trained()
    statistics = model._present_statistics()._asdict() | change
    with patch.object(MADDPG, "_present_statistics", lambda self: ObservationStatistics(**statistics)):
        model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="model"):
        MADDPG.load(tmp_path / "model")
