"""Gymnasium's vector environments under Stable-Baselines3: the same transitions as its own DummyVecEnv."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from sb3_maddpg import MADDPG
from sb3_maddpg.parallel import TeamEnv
from sb3_maddpg.vec_env import GymnasiumVecEnv
from toys import Toy

SAME_STEP = {"autoreset_mode": AutoresetMode.SAME_STEP}


def cartpoles(num_envs: int) -> GymnasiumVecEnv:
    envs = gymnasium.make_vec("CartPole-v1", num_envs, "sync", vector_kwargs=SAME_STEP, max_episode_steps=15)
    return GymnasiumVecEnv(envs)


def test_same_transitions_as_dummy_vec_env():
    """With time limits and failures, so that both ends of an episode occur."""
    mine = cartpoles(4)
    theirs = DummyVecEnv([lambda: gymnasium.make("CartPole-v1", max_episode_steps=15) for _ in range(4)])
    mine.seed(7)
    theirs.seed(7)
    assert np.array_equal(mine.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    ends = set()
    for step in range(120):
        # Upright for a while (time limit), then pushed over (failure).
        actions = np.full(4, step % 2) if step < 60 else rng.integers(0, 2, 4) * 0
        (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) = mine.step(actions), theirs.step(actions)
        assert np.array_equal(obs, obs2)
        assert np.array_equal(rewards, rewards2)
        assert rewards.dtype == rewards2.dtype
        assert np.array_equal(dones, dones2)
        for info, info2, done in zip(infos, infos2, dones, strict=True):
            assert info["TimeLimit.truncated"] == info2["TimeLimit.truncated"]
            assert ("terminal_observation" in info) == ("terminal_observation" in info2) == done
            if done:
                assert np.array_equal(info["terminal_observation"], info2["terminal_observation"])
                ends.add(info["TimeLimit.truncated"])
    assert ends == {True, False}


def test_trains_an_sb3_algorithm_with_episode_statistics():
    env = VecMonitor(cartpoles(4))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, seed=0)
    model.learn(512)
    assert {info["l"] for info in model.ep_info_buffer} <= set(range(1, 16))
    assert len(model.ep_info_buffer) > 10


def test_attributes_and_methods_reach_the_vector_environment():
    env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=3, scenario="curriculum"))
    assert env.get_attr("n_curriculum_levels") == [4, 4, 4]
    assert env.has_attr("n_curriculum_levels")
    assert not env.has_attr("no_such_thing")
    env.env_method("set_curriculum_level", 2)
    assert env.envs.unwrapped.task.sampler.level == 2
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    with pytest.raises(ValueError, match="concerns all 3"):
        env.env_method("set_curriculum_level", 2, indices=[0])


def test_final_info_and_reset_info_are_kept_apart():
    env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2, max_steps=3))
    env.seed(1)
    env.reset()
    for _ in range(3):
        *_, dones, infos = env.step(np.ones((2, 12), dtype=np.int8))
    assert dones.all()
    for info in infos:
        assert info["TimeLimit.truncated"]
        assert info["metrics"]["comm/request_share"] == 1.0
        assert info["terminal_observation"].shape == (4, 24)
    assert all("is_success" not in info for info in env.step(np.ones((2, 12), dtype=np.int8))[3])


def test_seeds_repeat():
    def rollout() -> np.ndarray:
        env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2, max_steps=5))
        env.seed(3)
        first = env.reset()
        return np.array([first, *(env.step(np.zeros((2, 12)))[0] for _ in range(12))])

    assert np.array_equal(rollout(), rollout())


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_refuses_other_autoreset_modes(mode):
    envs = gymnasium.make_vec("CartPole-v1", 2, "sync", vector_kwargs={"autoreset_mode": mode})
    with pytest.raises(ValueError, match="SAME_STEP"):
        GymnasiumVecEnv(envs)


def test_agrees_with_single_environments_under_sb3():
    kwargs = {"scenario": "random", "max_steps": 6}
    many = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2, **kwargs))
    single = make_vec_env("QuadSwarm-v0", n_envs=2, env_kwargs=kwargs)
    many.seed(4)
    single.seed(4)
    assert np.array_equal(many.reset(), single.reset())
    for _ in range(15):
        actions = np.ones((2, 12), dtype=np.int8)
        for mine, theirs in zip(many.step(actions)[:3], single.step(actions)[:3], strict=True):
            assert np.array_equal(mine, theirs)


def test_a_seed_of_numpy_is_a_seed():
    one, other = cartpoles(2), cartpoles(2)
    one.seed(np.int64(3))
    other.seed(3)
    assert np.array_equal(one.reset(), other.reset())


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before step\(\)"):
        cartpoles(2).step(np.zeros(2, int))


@pytest.mark.parametrize("shape", [(3, 2), (2, 12, 1), (24,), (2, 11)])
def test_actions_of_another_shape_are_refused(shape):
    env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2))
    env.reset()
    with pytest.raises(ValueError, match=r"actions have shape .*2 environments .*must have shape \(2, 12\)"):
        env.step(np.zeros(shape, np.int8))


def test_actions_too_large_for_single_precision_are_refused():
    env = GymnasiumVecEnv(gymnasium.make_vec("Pendulum-v1", 2, "sync", vector_kwargs=SAME_STEP))
    env.reset()
    with pytest.raises(ValueError, match=r"action of environment 1 is \[1e\+39\]: it must be finite"):
        env.step(np.array([[0.0], [1e39]]))


def test_actions_that_are_not_finite_are_refused():
    env = GymnasiumVecEnv(gymnasium.make_vec("Pendulum-v1", 2, "sync", vector_kwargs=SAME_STEP))
    env.reset()
    with pytest.raises(ValueError, match=r"action of environment 1 is \[nan\]"):
        env.step(np.array([[0.0], [np.nan]], np.float32))


def test_what_is_no_vector_environment_is_refused():
    with pytest.raises(ValueError, match=r"not a Gymnasium VectorEnv: .*make_vec"):
        GymnasiumVecEnv(gymnasium.make("CartPole-v1"))


def test_an_episode_that_ends_without_its_last_observation_is_refused():
    env = cartpoles(2)
    step = env.envs.step
    env.envs.step = lambda actions: (*step(actions)[:4], {})
    env.reset()
    with pytest.raises(ValueError, match=r"without info\['final_obs'\]"):
        [env.step(np.zeros(2, int)) for _ in range(20)]


def test_one_pettingzoo_environment_cannot_be_stepped_twice():
    env = Toy("binary")
    for envs in (DummyVecEnv([lambda: TeamEnv(env)] * 2), make_vec_env(TeamEnv, 2, env_kwargs={"env": env})):
        with pytest.raises(ValueError, match=r"Environments 0 and 1 step the same .*: create one for each"):
            MADDPG("MlpPolicy", envs)
    MADDPG("MlpPolicy", DummyVecEnv([lambda: TeamEnv(Toy("binary"))] * 2))


def test_environments_of_different_teams_are_refused():
    envs = DummyVecEnv([lambda: TeamEnv(Toy("binary")), lambda: TeamEnv(renamed(Toy("binary")))])
    with pytest.raises(ValueError, match="Environments 0 and 1 are of different teams"):
        MADDPG("MlpPolicy", envs)


def renamed(env: Toy) -> Toy:
    env.possible_agents = env.possible_agents[::-1]
    return env


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (gymnasium.wrappers.NormalizeObservation, "changes the observations of TeamEnv.*action masks"),
        (gymnasium.wrappers.NormalizeReward, "NormalizeReward changes only the team's reward"),
        (lambda env: gymnasium.wrappers.TransformReward(env, np.negative), "TransformReward changes only the team's"),
    ],
)
def test_wrappers_that_would_have_no_effect_are_refused(wrap, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", wrap(TeamEnv(Toy("binary"))))
    MADDPG("MlpPolicy", gymnasium.wrappers.TimeLimit(TeamEnv(Toy("binary")), 5))
