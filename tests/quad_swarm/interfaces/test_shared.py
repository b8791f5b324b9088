"""What the three interfaces have in common, tested on each of them."""

import gymnasium
import numpy as np
import pytest

import quad_swarm
from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.interfaces.shared import checked_bits, checked_seed

INTERFACES = {
    "team": QuadSwarmEnv,
    "parallel": quad_swarm.parallel_env,
    "vector": lambda **kwargs: quad_swarm.QuadSwarmVectorEnv(2, **kwargs),
}


@pytest.fixture(params=INTERFACES)
def env(request):
    return INTERFACES[request.param](n_robots=2)


def observed(env, seed) -> np.ndarray:
    """The observations after a reset, as one array."""
    observation, _ = env.reset(seed=seed)
    return np.stack(list(observation.values())) if isinstance(observation, dict) else observation


@pytest.mark.parametrize("seed", [3, np.int64(3), np.uint8(3)])
def test_seeds_may_be_numpy_s(env, seed):
    expected = observed(env, 3)
    assert np.array_equal(observed(env, seed), expected)
    assert not np.array_equal(observed(env, 4), expected)


@pytest.mark.parametrize("seed", [-1, 0.5, "x", np.float64(1), {}])
def test_refuses_senseless_seeds(env, seed):
    with pytest.raises(ValueError, match="a seed must be a non-negative integer or None"):
        env.reset(seed=seed)


def test_a_seed_is_a_plain_integer():
    assert type(checked_seed(np.int32(7))) is int
    assert checked_seed(None) is None


def test_a_step_before_the_reset_is_refused(env):
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"before reset\(\): reset the environment first"):
        env.step({} if hasattr(env, "possible_agents") else np.zeros(env.action_space.shape))


def test_actions_become_bits_of_each_robot_for_each_of_the_others():
    bits = [[1, 0, 0, 1, 0, 1], [0, 0, 1, 1, 1, 1]]
    asked = checked_bits(bits, (2, 6), 2)
    assert asked.dtype == bool
    assert asked[..., 0].astype(int).tolist() == [[[1, 0], [0, 1], [0, 1]], [[0, 0], [1, 1], [1, 1]]]
    both = checked_bits(bits[0] + bits[1], (12,), 2, 2)
    assert both.astype(int).tolist() == [[[1, 0], [0, 1]], [[0, 1], [0, 0]], [[1, 1], [1, 1]]]
    assert np.array_equal(checked_bits(np.array(bits, np.float32), (2, 6), 2), asked)
    assert np.array_equal(checked_bits(np.array(bits, bool), (2, 6), 2), asked)
    assert checked_bits([1, 0], (2,), 2).tolist() == [[[True], [False]]], "one robot's own"


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([1, 0], r"Whose has shape \(2,\); the action space has \(6,\): 2 bits per robot"),
        ([0, 1, 0, 1, 0, 0.3], r"Whose contains .*0\.3.*; every entry must be 0 or 1\. Threshold scores"),
        ([0, 1, 0, 1, 0, -1], "contains .*-1"),
        ([0, 1, 0, 1, 0, np.inf], "contains .*inf"),
        (["a"] * 6, "contains .*'a'"),
    ],
)
def test_what_is_no_action_is_named(actions, message):
    with pytest.raises(ValueError, match=message):
        checked_bits(actions, (6,), 2, whose="Whose")


def test_what_learners_read_is_the_team_s():
    team, parallel = QuadSwarmEnv(scenario="curriculum"), quad_swarm.parallel_env(scenario="curriculum")
    vector = quad_swarm.QuadSwarmVectorEnv(2, scenario="curriculum")
    names = ("agent_names", "n_agents", "observation_layout", "action_cost", "n_curriculum_levels", "config")
    for name in names:
        assert getattr(team, name) == getattr(parallel, name) == getattr(vector, name)
    for env in (parallel, vector):
        env.set_curriculum_level(2)
        assert env.curriculum_level == env.task.sampler.level == 2
        with pytest.raises(ValueError, match="Level 4 does not exist"):
            env.set_curriculum_level(4)
