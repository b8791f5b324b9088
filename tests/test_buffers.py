"""Per-agent rewards and ends in the replay buffer."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import MADDPG, TeamReplayBuffer
from sb3_maddpg.team_tasks import OwnBit

N, D, K = 3, 2, 2


def buffer(size: int = 8, n_envs: int = 1, **kwargs) -> TeamReplayBuffer:
    return TeamReplayBuffer(
        size, spaces.Box(-9, 9, (N, D), np.float32), spaces.MultiBinary(N * K), device="cpu", n_envs=n_envs, **kwargs
    )


def add(memory: TeamReplayBuffer, index: int, reward: float = 0.0, done: bool = False, **info) -> None:
    """A transition whose observations and bits tell its index."""
    obs = np.full((1, N, D), index, np.float32)
    bits = np.array([[int(bit) for bit in f"{index:06b}"]], np.int8)
    memory.add(obs, obs + 0.5, bits, np.array([reward]), np.array([done]), [info])


def transition(memory: TeamReplayBuffer, index: int):
    return memory._get_samples(np.array([index]))


def test_agents_get_their_own_rewards_and_ends():
    memory = buffer()
    add(memory, 0, 5.0, agent_rewards=np.array([1.0, 2.0, 3.0]), agent_terminated=np.array([False, True, False]))
    sample = transition(memory, 0)
    assert sample.rewards.tolist() == [[1.0, 2.0, 3.0]]
    assert sample.dones.tolist() == [[0.0, 1.0, 0.0]]


def test_without_them_agents_share_the_teams():
    memory = buffer()
    add(memory, 0, 5.0, done=True)
    sample = transition(memory, 0)
    assert sample.rewards.tolist() == [[5.0] * N]
    assert sample.dones.tolist() == [[1.0] * N]


@pytest.mark.parametrize(("handled", "ends"), [(True, [0.0, 1.0, 0.0]), (False, [1.0, 1.0, 1.0])])
def test_a_time_limit_ends_no_agent_but_those_that_ended_themselves(handled, ends):
    memory = buffer(handle_timeout_termination=handled)
    add(memory, 0, done=True, **{"TimeLimit.truncated": True, "agent_terminated": [False, True, False]})
    assert transition(memory, 0).dones.tolist() == [ends]


def test_rewards_stay_with_their_transition_when_the_buffer_wraps_round():
    memory = buffer(size=4)
    for index in range(6):
        add(memory, index, agent_rewards=np.array([index, 10 * index, 100 * index]))
    sample = memory.sample(64)
    assert set(sample.observations[:, 0, 0].tolist()) == {2.0, 3.0, 4.0, 5.0}
    for obs, bits, reward, next_obs in zip(
        sample.observations, sample.actions, sample.rewards, sample.next_observations, strict=True
    ):
        index = int(obs[0, 0])
        assert reward.tolist() == [index, 10 * index, 100 * index]
        assert next_obs[0, 0] == index + 0.5
        assert "".join(str(bit) for bit in bits.tolist()) == f"{index:06b}"


def test_environments_are_not_mixed_up():
    memory = buffer(size=8, n_envs=2)
    for step in range(4):
        obs = np.array([step, 100 + step], np.float32)[:, None, None] * np.ones((2, N, D), np.float32)
        infos = [{"agent_rewards": np.full(N, step)}, {"agent_rewards": np.full(N, 100 + step)}]
        memory.add(obs, obs, np.zeros((2, N * K), np.int8), np.zeros(2), np.zeros(2, bool), infos)
    sample = memory.sample(64)
    assert (sample.rewards == sample.observations[:, :, 0]).all()
    assert sample.rewards.max() >= 100 > sample.rewards.min()


def test_optimize_memory_usage_gives_the_next_observation_without_storing_it():
    memory = buffer(size=8, optimize_memory_usage=True, handle_timeout_termination=False)
    assert not hasattr(memory, "next_observations")
    for index in range(6):
        obs = np.full((1, N, D), index, np.float32)
        memory.add(obs, obs + 1, np.zeros((1, N * K), np.int8), np.array([index]), np.array([False]), [{}])
    sample = memory.sample(64)
    assert (sample.next_observations == sample.observations + 1).all()
    assert (sample.rewards == sample.observations[:, :, 0]).all()


def test_optimize_memory_usage_has_sb3s_condition():
    with pytest.raises(ValueError, match="handle_timeout_termination"):
        buffer(optimize_memory_usage=True)
    env = OwnBit()
    kwargs = {"handle_timeout_termination": False}
    model = MADDPG(
        "MlpPolicy",
        env,
        optimize_memory_usage=True,
        replay_buffer_kwargs=kwargs,
        buffer_size=100,
        learning_starts=20,
        train_freq=10,
        batch_size=16,
    )
    assert model.learn(150).num_timesteps == 150


@pytest.mark.parametrize("key", ["agent_rewards", "agent_terminated"])
def test_a_wrong_number_of_agents_is_refused(key):
    with pytest.raises(ValueError, match=rf"info\['{key}'\] has shape \(2,\).*3 agents"):
        add(buffer(), 0, **{key: np.zeros(2)})


def test_vec_normalize_scales_the_agents_rewards_like_the_teams():
    env = VecNormalize(DummyVecEnv([OwnBit]), norm_obs=False, clip_reward=100.0)
    model = MADDPG("MlpPolicy", env, buffer_size=100, learning_starts=1000).learn(60)
    raw, scaled = (model.replay_buffer._get_samples(np.arange(50), env=e).rewards for e in (None, env))
    spread = float(np.sqrt(env.ret_rms.var + env.epsilon))
    assert spread > 1.1
    assert np.allclose(scaled, raw / spread, atol=1e-5)
    assert raw.std(dim=1).max() > 0
