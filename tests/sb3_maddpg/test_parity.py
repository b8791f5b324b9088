"""What Stable-Baselines3 asks of its own algorithms, of every action space and both algorithms."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_maddpg import MADDPG
from sb3_maddpg.masac.masac import MASAC
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo import TeamEnv
from toys import AGENT_SPACES, SMALL, Toy, toy

pytestmark = [
    pytest.mark.parametrize("kind", AGENT_SPACES),
    pytest.mark.parametrize("algorithm", [MADDPG, MATD3, MASAC]),
]


def learned(algorithm, env, steps: int = 60, **kwargs):
    return algorithm("MlpPolicy", env, **{**SMALL, **kwargs}).learn(steps)


def observations(model, n: int = 30) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (n, *model.observation_space.shape)).astype(np.float32)


def same(a, b) -> bool:
    """Networks and optimizers, leaf by leaf."""
    leaves = (th.utils._pytree.tree_leaves(model.get_parameters()) for model in (a, b))
    pairs = list(zip(*leaves, strict=True))
    assert len(pairs) > 20
    return all(th.equal(x, y) if isinstance(x, th.Tensor) else x == y for x, y in pairs)


def same_predictions(a, b) -> bool:
    obs = observations(a)
    return np.array_equal(a.predict(obs, deterministic=True)[0], b.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize("n_envs", [1, 2])
def test_runs_and_acts_in_the_action_space(algorithm, kind, n_envs):
    env = make_vec_env(lambda: toy(kind, state=n_envs == 2), n_envs)
    before = algorithm("MlpPolicy", env, **SMALL)
    after = learned(algorithm, env)
    assert after.num_timesteps == 60
    assert after._n_updates > 0
    # Targets of MASAC read the actors themselves
    for network in ("actor", "critic", "critic_target", *(() if algorithm is MASAC else ("actor_target",))):
        old, new = (getattr(model.policy, network).parameters() for model in (before, after))
        assert all(b.isfinite().all() and not th.equal(a, b) for a, b in zip(old, new, strict=True))
    obs = observations(after)
    for deterministic in (True, False):
        actions, _ = after.predict(obs, deterministic=deterministic)
        assert actions.dtype == after.action_space.dtype
        assert all(after.action_space.contains(action) for action in actions)
    single, _ = after.predict(obs[3], deterministic=True)
    many, _ = after.predict(obs, deterministic=True)
    assert np.allclose(single, many[3], atol=1e-6)
    assert after.action_space.contains(single)


def test_deterministic_predictions_repeat_and_others_vary(algorithm, kind):
    model = learned(algorithm, toy(kind))
    obs = observations(model)
    assert np.array_equal(model.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    exploring = [model.predict(obs)[0] for _ in range(2)]
    # The noise of numbers is the algorithm's, as in Stable-Baselines3, but MASAC's actors draw them
    varies = ~model.policy.actions.is_continuous | (algorithm is MASAC)
    assert np.array_equal((exploring[0] != exploring[1]).any(axis=0), varies)


def test_a_loaded_model_is_the_saved_one(algorithm, kind, tmp_path):
    model = learned(algorithm, toy(kind))
    model.save(tmp_path / "model")
    for loaded in (algorithm.load(tmp_path / "model"), algorithm.load(tmp_path / "model", env=TeamEnv(Toy(kind)))):
        assert same(model, loaded)
        assert same_predictions(model, loaded)
        assert loaded.action_space == model.action_space
        assert loaded.policy.team == model.policy.team


def test_a_resumed_run_is_the_uninterrupted_one(algorithm, kind, tmp_path):
    whole = learned(algorithm, toy(kind), n_steps=2)
    whole.save(tmp_path / "model")
    whole.save_replay_buffer(tmp_path / "buffer")
    resumed = algorithm.load(tmp_path / "model", env=toy(kind))
    resumed.load_replay_buffer(tmp_path / "buffer")
    for model in (whole, resumed):
        model.set_env(toy(kind))
        model.set_random_seed(7)
        model.learn(40, reset_num_timesteps=False)
    assert whole.num_timesteps == resumed.num_timesteps == 100
    assert same(whole, resumed)


def test_set_parameters_brings_networks_and_optimizers(algorithm, kind, tmp_path):
    model, other = learned(algorithm, toy(kind)), learned(algorithm, toy(kind), seed=1)
    assert not same(model, other)
    model.save(tmp_path / "model")
    other.set_parameters(tmp_path / "model")
    assert same(model, other)


def test_same_seed_same_parameters(algorithm, kind):
    model = learned(algorithm, toy(kind), seed=3)
    assert same(model, learned(algorithm, toy(kind), seed=3))
    assert not same_predictions(model, learned(algorithm, toy(kind), seed=4))


def test_callbacks_evaluate_and_keep_checkpoints(algorithm, kind, tmp_path):
    evaluation = EvalCallback(
        toy(kind), n_eval_episodes=2, eval_freq=30, log_path=str(tmp_path), best_model_save_path=str(tmp_path),
        verbose=0, warn=False,
    )  # fmt: skip
    checkpoints = CheckpointCallback(30, str(tmp_path), save_replay_buffer=True)
    model = algorithm("MlpPolicy", toy(kind), **SMALL).learn(60, callback=[evaluation, checkpoints])
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (2, 2)
    assert algorithm.load(tmp_path / "best_model.zip").num_timesteps in (30, 60)
    last = algorithm.load(tmp_path / "rl_model_60_steps.zip", env=toy(kind))
    last.load_replay_buffer(tmp_path / "rl_model_replay_buffer_60_steps.pkl")
    assert last.num_timesteps == 60
    # A callback comes before the transition of its step is stored
    assert last.replay_buffer.size() == 59
    assert np.array_equal(last.replay_buffer.actions[:59], model.replay_buffer.actions[:59])


def test_vec_normalize(algorithm, kind, tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: TeamEnv(Toy(kind)), lambda: TeamEnv(Toy(kind))]))
    model = learned(algorithm, env)
    # The buffer holds plain observations, the networks see normalised ones
    assert np.abs(model.replay_buffer.observations).max() <= 1.0
    assert env.normalize_obs(model.replay_buffer.observations[:60]).max() > 1.0
    env.training = False
    assert np.isfinite(evaluate_policy(model, env, n_eval_episodes=2, warn=False)[0])
    model.save(tmp_path / "model")
    env.save(tmp_path / "statistics")
    normalized = VecNormalize.load(tmp_path / "statistics", DummyVecEnv([lambda: TeamEnv(Toy(kind))] * 2))
    assert same_predictions(model, algorithm.load(tmp_path / "model", env=normalized))


def test_the_memory_efficient_buffer_gives_the_same_parameters(algorithm, kind):
    """Where it loses an observation, at the end of an episode, nothing is learned from it."""
    as_it_is = {"replay_buffer_kwargs": {"handle_timeout_termination": False}}
    plain, saving = (learned(algorithm, toy(kind), optimize_memory_usage=on, **as_it_is) for on in (False, True))
    assert saving.replay_buffer.records.itemsize < plain.replay_buffer.records.itemsize
    assert same(plain, saving)


def test_returns_of_several_steps(algorithm, kind):
    one, three = learned(algorithm, toy(kind)), learned(algorithm, toy(kind), n_steps=3)
    assert three.n_steps == three.replay_buffer.n_steps == 3
    assert three.replay_buffer.gamma == three.gamma
    assert not same(one, three)


def test_what_a_team_has_not_is_refused(algorithm, kind):
    with pytest.raises(ValueError, match=r"HerReplayBuffer .*: derive it from .*TeamReplayBuffer.*goals"):
        algorithm("MlpPolicy", toy(kind), replay_buffer_class=HerReplayBuffer)
    with pytest.raises(ValueError, match=r"'TeamReplayBuffer' is a name, .*: pass the class"):
        algorithm("MlpPolicy", toy(kind), replay_buffer_class="TeamReplayBuffer")
    env = toy(kind)
    env.observation_space = spaces.Dict({"observation": env.observation_space})
    with pytest.raises(ValueError, match=r"shape \(n_agents, obs_dim\), not Dict.*flattened"):
        algorithm("MlpPolicy", env)
