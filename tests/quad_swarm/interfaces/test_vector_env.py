"""The vector environment: step for step what its swarms do one by one."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import quad_swarm
from quad_swarm.interfaces.env import QuadSwarmEnv, info_of
from quad_swarm.world.scenarios import without_obstacles

GOALS = [[3.0, -2, 1.5], [3, 2, 1.5]]


def plain(info: dict) -> dict:
    """Without Gymnasium's masks and without times, which never repeat."""
    kept = {name: value for name, value in info.items() if name[0] != "_" and name != "planner/solve_us"}
    return {name: plain(value) if isinstance(value, dict) else value for name, value in kept.items()}


def assert_same(a: dict, b: dict) -> None:
    assert a.keys() == b.keys()
    for name in a:
        if isinstance(a[name], dict):
            assert_same(a[name], b[name])
        else:
            assert np.array_equal(a[name], b[name]), name


EVERYTHING = {"preset": "dense", "observation": "state+approach+memory+plan+told+critic", "radio": {"loss": 0.3}}


@pytest.mark.parametrize(
    "kwargs",
    [
        {"max_steps": 12},
        {"max_steps": 9, "n_robots": 3, "noise": {"vel": 0.05}},
        {"max_steps": 7, "n_robots": 3, **EVERYTHING},
        {"max_steps": 7, "n_robots": 3, "announcements": True},
        {"max_steps": 7, "n_robots": 5, "world": {"neighbourhood": {"max_others": 2, "range": 3.0}}, **EVERYTHING},
    ],
)
def test_flies_what_single_environments_fly(kwargs):
    n_envs, steps = 3, 40
    together = gymnasium.make_vec("QuadSwarm-v0", num_envs=n_envs, scenario="symmetric_swap", **kwargs)
    alone = [QuadSwarmEnv(scenario="symmetric_swap", **kwargs) for _ in range(n_envs)]
    observations, _ = together.reset(seed=5)
    for k, env in enumerate(alone):
        assert np.array_equal(env.reset(seed=5 + k)[0], observations[k])
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(steps):
        actions = rng.integers(0, 2, together.action_space.shape, dtype=np.int8)
        observations, rewards, terminations, truncations, infos = together.step(actions)
        for k, env in enumerate(alone):
            observation, reward, terminated, truncated, info = env.step(actions[k])
            assert (reward, terminated, truncated) == (rewards[k], terminations[k], truncations[k])
            if terminated or truncated:
                ended += 1
                assert infos["_final_obs"][k]
                assert np.array_equal(observation, infos["final_obs"][k])
                assert_same(plain(info), plain(info_of(plain(infos["final_info"]), k)))
                observation, _ = env.reset()
            else:
                assert not infos.get("_final_obs", np.zeros(n_envs))[k]
                batch = {name: value for name, value in plain(infos).items() if not name.startswith("final")}
                assert_same(plain(info), info_of(batch, k))
            assert np.array_equal(observation, observations[k])
    assert ended >= n_envs


def test_is_gymnasium_s_vector_environment():
    env = gymnasium.make_vec("QuadSwarm-v0", num_envs=2, preset="dense")
    assert isinstance(env.unwrapped, quad_swarm.QuadSwarmVectorEnv)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    observations, _ = env.reset(seed=0)
    assert env.observation_space.contains(observations)
    assert env.observation_space.shape == (2, 8, 48)
    observations, rewards, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observations)
    assert rewards.shape == (2,)


def test_seeds_can_be_given_one_by_one_and_go_on_without():
    env = gymnasium.make_vec("QuadSwarm-v0", num_envs=2)
    first, _ = env.reset(seed=[3, 3])
    assert np.array_equal(first[0], first[1])
    second, _ = env.reset()
    assert not np.array_equal(first, second)
    assert np.array_equal(second[0], second[1])


def test_curriculum_reaches_every_swarm():
    env = gymnasium.make_vec("QuadSwarm-v0", num_envs=8, scenario="curriculum").unwrapped
    assert set(env.reset(seed=0)[1]["scenario"]) == {"random"}
    env.set_curriculum_level(env.n_curriculum_levels - 1)
    names = [env.reset()[1]["scenario"] for _ in range(8)]
    assert set(np.concatenate(names)) == set(without_obstacles())


def test_goals_of_a_swarm_change_until_its_episode_ends():
    env = gymnasium.make_vec("QuadSwarm-v0", num_envs=2, n_robots=2, scenario="random", max_steps=3).unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"set_goals\(\) was called before reset"):
        env.set_goals(0, GOALS)
    before, _ = env.reset(seed=3)
    observation = env.set_goals(1, GOALS, waypoints=[[[0, 0, 1]], []])
    np.testing.assert_array_equal(observation[:, 6:], before[1, :, 6:])
    aims = observation[:, 3:6] + env.task.swarm.pos[1]
    np.testing.assert_allclose(aims, [[0, 0, 1], GOALS[1]], atol=1e-5)
    for _ in range(3):
        _, _, _, truncated, _ = env.step(np.zeros((2, 2), np.int8))
    assert truncated.all()
    assert env.task.swarm.route is None, "the next episode has its own"
    for swarm in (2, -1, True, "a"):
        with pytest.raises(ValueError, match=r"swarm=.*from 0 to 1"):
            env.set_goals(swarm, GOALS)
    with pytest.raises(ValueError, match=r"headings\[1\]=2: with planner\.max_yaw_rate=0"):
        env.set_goals(1, GOALS, headings=[0, 2])


def test_swarms_start_as_asked_all_alike_or_single_ones():
    env = gymnasium.make_vec("QuadSwarm-v0", num_envs=3, n_robots=2, scenario="random").unwrapped
    starts = np.array([[0.0, -2, 1.5], [0, 2, 1.5]])
    options = {"starts": starts, "goals": GOALS, "initial_velocities": [[1, 0, 0], [0, 0, 0]]}
    single = QuadSwarmEnv(n_robots=2)
    expected, _ = single.reset(seed=4, options=options)
    observations, infos = env.reset(seed=3, options=options)
    for observation in observations:
        np.testing.assert_array_equal(observation, expected)
    assert infos["scenario"].tolist() == ["custom"] * 3
    drawn, _ = env.reset(seed=3)
    observations, infos = env.reset(seed=3, options={"swarms": {1: options}})
    assert infos["scenario"].tolist() == ["random", "custom", "random"]
    np.testing.assert_array_equal(observations[1], expected)
    np.testing.assert_array_equal(observations[[0, 2]], drawn[[0, 2]])
    observations, _ = env.reset(seed=3, options={**options, "swarms": {2: {}}})
    np.testing.assert_array_equal(observations, [expected, expected, drawn[2]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"starts": 0}, "reset options name only 'starts'; pass both"),
        ({"swarm": {}}, r"Unknown reset option 'swarm'.*Did you mean 'swarms'"),
        ({"swarms": {2: {}}}, r"'swarms'=\{2: \{\}\}: it must be a mapping from numbers of swarms, 0 to 1"),
        ({"swarms": {True: {}}}, "'swarms'=.* mapping from numbers"),
        ({"swarms": [{}]}, "'swarms'=.* mapping from numbers"),
        ({"swarms": {1: {"goals": 0}}}, "reset options name only 'goals'; pass both"),
        ({"swarms": {1: 3}}, "options=3"),
    ],
)
def test_starts_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        quad_swarm.QuadSwarmVectorEnv(2).reset(options=options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: quad_swarm.QuadSwarmVectorEnv(0), "num_envs=0"),
        (lambda: quad_swarm.QuadSwarmVectorEnv(10**9), "num_envs=1000000000: it must be less than or equal to 100000"),
        (lambda: quad_swarm.QuadSwarmVectorEnv(2, render_mode="human"), "cannot render"),
        (lambda: quad_swarm.QuadSwarmVectorEnv(2).render(), r"render\(\): the vector environment cannot render"),
        (lambda: quad_swarm.QuadSwarmVectorEnv(2).reset(seed=[1]), "1 seeds for 2 swarms"),
    ],
)
def test_refuses_senseless_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_refuses_senseless_actions():
    env = quad_swarm.QuadSwarmVectorEnv(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(23,\); the action space has \(2, 12\)"):
        env.step(np.zeros(23))


@pytest.mark.parametrize("shape", [(12, 3), (36,), (1, 36), (3, 4, 3)])
def test_actions_have_the_shape_of_their_space(shape):
    env = quad_swarm.QuadSwarmVectorEnv(3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"has shape \(.*\); the action space has \(3, 12\)"):
        env.step(np.zeros(shape))


@pytest.mark.parametrize("seed", [np.int64(3), np.array(3), np.array([3, 4]), (3, np.int32(4))])
def test_seeds_may_be_numpy_s(seed):
    env = quad_swarm.QuadSwarmVectorEnv(2, n_robots=2)
    assert np.array_equal(env.reset(seed=seed)[0], env.reset(seed=3)[0])


@pytest.mark.parametrize("seed", [-1, 0.5, "x", [0, "x"], np.array(0.5), np.array("x"), np.zeros((2, 2), int)])
def test_refuses_senseless_seeds(seed):
    with pytest.raises(ValueError, match="a seed must be a non-negative integer"):
        quad_swarm.QuadSwarmVectorEnv(2, n_robots=2).reset(seed=seed)


def test_every_field_of_the_world_can_be_set():
    env = gymnasium.make_vec("QuadSwarm-v0", num_envs="2", n_robots=2, world={"radius": 0.12})
    assert env.unwrapped.config.planner.separation == 0.24
