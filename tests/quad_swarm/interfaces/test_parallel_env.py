"""The PettingZoo interface: upstream's checks, the same episodes as the team's, and what learners read of it."""

import warnings

import numpy as np
import pytest
import supersuit
from pettingzoo.test import parallel_api_test
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper

import quad_swarm
from quad_swarm.interfaces.env import QuadSwarmEnv


@pytest.mark.parametrize("world", [{}, {"neighbourhood": {"max_others": 2, "range": 2.5}}])
def test_parallel_api(world):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(quad_swarm.parallel_env(max_steps=20, world=world), num_cycles=60)


@pytest.mark.parametrize("announcements", [False, True])
def test_both_interfaces_fly_the_same_episode(announcements):
    team, parallel = QuadSwarmEnv(announcements=announcements), quad_swarm.parallel_env(announcements=announcements)
    observation, _ = team.reset(seed=3)
    rows, _ = parallel.reset(seed=3)
    rng = np.random.default_rng(0)
    while parallel.agents:
        bits = rng.integers(0, 2, (4, 6 if announcements else 3), dtype=np.int8)
        assert np.array_equal(observation, np.stack([rows[f"robot_{i}"] for i in range(4)]))
        assert np.array_equal(parallel.state(), observation.ravel())
        observation, reward, terminated, truncated, _ = team.step(bits.ravel())
        rows, rewards, terminations, truncations, infos = parallel.step({f"robot_{i}": bits[i] for i in range(4)})
        assert set(rewards.values()) == {reward}
        assert set(terminations.values()) == {terminated}
        assert set(truncations.values()) == {truncated}
    assert terminated or truncated
    assert "is_success" in infos["robot_0"]


def test_missing_agents_are_named():
    env = quad_swarm.parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="No action for robot_3"):
        env.step({f"robot_{i}": np.zeros(3) for i in range(3)})


def test_the_state_is_in_its_space():
    env = quad_swarm.parallel_env(n_robots=3, observation="state+plan")
    env.reset(seed=0)
    assert env.state() in env.state_space


def test_after_the_end_nobody_is_left():
    env = quad_swarm.parallel_env(n_robots=2, max_steps=1)
    env.reset(seed=0)
    env.step({agent: np.zeros(1) for agent in env.agents})
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_every_action_has_the_shape_of_its_space():
    env = quad_swarm.parallel_env()
    env.reset(seed=0)
    widths = {"robot_0": 2, "robot_1": 4, "robot_2": 3, "robot_3": 3}  # as many as all need
    with pytest.raises(ValueError, match=r"action of robot_0 has shape \(2,\); the action space has \(3,\)"):
        env.step({agent: np.zeros(width) for agent, width in widths.items()})


def test_every_field_of_the_world_can_be_set():
    env = quad_swarm.parallel_env(n_robots=2, world={"radius": 0.12, "planner": {"horizon": 5}})
    assert (env.config.planner.separation, env.config.planner.horizon) == (0.24, 5)
    with pytest.raises(ValueError, match="Did you mean 'world'"):
        quad_swarm.parallel_env(wrld={})


class BitActions(VecEnvWrapper):
    """SB3 samples bits as floats, and SuperSuit stacks actions without a conversion."""

    def step_async(self, actions):
        self.venv.step_async(actions.astype(self.action_space.dtype))

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


@pytest.mark.slow
def test_ppo_learns_through_supersuit():
    env = supersuit.pettingzoo_env_to_vec_env_v1(quad_swarm.parallel_env(n_robots=3, max_steps=20))
    env = supersuit.concat_vec_envs_v1(env, 2, num_cpus=0, base_class="stable_baselines3")
    model = PPO("MlpPolicy", BitActions(env), n_steps=32, batch_size=64)
    before = model.policy.action_net.weight.detach().clone()
    assert model.learn(400).num_timesteps >= 400
    assert not before.equal(model.policy.action_net.weight)


@pytest.mark.parametrize("actions", [None, [], "x", np.zeros((4, 3))])
def test_actions_that_are_no_mapping_are_refused(actions):
    env = quad_swarm.parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"step\(\) takes a mapping"):
        env.step(actions)


def test_goals_change_as_in_the_team_environment():
    starts, goals = [[0, -2, 1.5], [0, 2, 1.5]], [[3, -2, 1.5], [3, 2, 1.5]]
    env = quad_swarm.parallel_env(n_robots=2, planner={"max_yaw_rate": 1.5})
    options = {"starts": starts, "goals": goals, "waypoints": [[[1, -3, 1]], []], "unknown": 1}
    observations, _ = env.reset(seed=0, options=options)
    np.testing.assert_allclose(observations["robot_0"][3:6], [1, -1, -0.5])
    observations = env.set_goals([[-3, 2, 1.5]], robots=[1], headings=[2])
    assert env.task.swarm.heading.tolist() == [[0, 2]]
    np.testing.assert_allclose(observations["robot_0"][3:6], [1, -1, -0.5])
    np.testing.assert_allclose(observations["robot_1"][3:6], [-3, 0, 0])
