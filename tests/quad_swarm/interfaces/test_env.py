"""The Gymnasium interface: upstream's checkers, exact repetition, rewards, ends, pictures, and bad input."""

import pickle
import time
import warnings

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import quad_swarm
from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.world.scenarios import SCENARIOS


def run(env: gymnasium.Env, seed: int, steps: int) -> list:
    """Random bits over several episodes; returns everything that came back."""
    rng = np.random.default_rng(seed)
    log = [env.reset(seed=seed)]
    for _ in range(steps):
        log.append(env.step(rng.integers(0, 2, env.action_space.shape, dtype=np.int8)))
        if log[-1][2] or log[-1][3]:
            log.append(env.reset())
    return log


def without_times(log: list) -> list:
    for entry in log:
        entry[-1].get("metrics", {}).pop("planner/solve_us", None)
    return log


def assert_same(a, b):
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert np.array_equal(a, b)


@pytest.mark.parametrize("kwargs", [{}, {"preset": "dense"}, {"n_robots": 2, "scenario": "random"}])
def test_upstream_checkers(kwargs):
    env = gymnasium.make("QuadSwarm-v0", render_mode="rgb_array", **kwargs)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=UserWarning)
        warnings.filterwarnings("ignore", message=".*infinity.*")  # positions have no bound
        warnings.filterwarnings("ignore", message=".*unconventional shape.*")  # the team convention: one row an agent
        gymnasium_check_env(env.unwrapped)
        sb3_check_env(env.unwrapped)


@pytest.mark.parametrize("kwargs", [{}, {"noise": {"vel": 0.05, "wind": 1.0}, "memory": 0.3, "n_robots": 3}])
def test_a_hundred_steps_repeat_exactly(kwargs):
    first = without_times(run(gymnasium.make("QuadSwarm-v0", **kwargs), 7, 100))
    second = without_times(run(gymnasium.make("QuadSwarm-v0", **kwargs), 7, 100))
    assert_same(first, second)
    other = run(gymnasium.make("QuadSwarm-v0", **kwargs), 8, 1)
    assert not np.array_equal(first[0][0], other[0][0])


def test_observation_is_the_paper_s():
    env = QuadSwarmEnv(n_robots=3, scenario="random_swap")
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(np.ones(6, dtype=np.int8))
    swarm = env.task.swarm
    pos, vel, goal = swarm.pos[0], swarm.vel[0], swarm.goal[0]
    for i, (j, k) in enumerate([(1, 2), (0, 2), (0, 1)]):
        expected = [vel[i], goal[i] - pos[i], pos[j] - pos[i], pos[k] - pos[i], vel[j] - vel[i], vel[k] - vel[i]]
        np.testing.assert_allclose(observation[i], np.concatenate(expected), rtol=1e-6)


def test_scaling_divides_the_observation():
    plain, scaled = QuadSwarmEnv(), QuadSwarmEnv(scale_observation=True)
    np.testing.assert_allclose(plain.reset(seed=1)[0], 4 * scaled.reset(seed=1)[0], rtol=1e-6)


def test_reward_is_the_paper_s():
    env = QuadSwarmEnv(n_robots=2)
    line = np.array([[-1.0, 0, 1], [1, 0, 1]])
    env.reset(options={"starts": line, "goals": line})
    *_, info = env.step(np.array([1, 0]))
    assert info["reward_terms"] == pytest.approx({"goal": 1.3, "collision": 0.0, "requests": -0.1})
    _, reward, *_ = env.step(np.array([1, 1]))
    assert reward == pytest.approx(1.3 - 0.2)

    env.reset(options={"starts": [[0, 0, 1.0], [0.5, 0, 1.0]], "goals": [[0, 0, 1.0], [0.5, 0, 1.0]]})
    _, reward, terminated, truncated, info = env.step(np.array([0, 0]))
    assert (terminated, truncated, info["collision"], info["is_success"]) == (True, False, True, False)
    assert reward == pytest.approx(1.3 - 150)


def test_ends_at_the_time_limit():
    env = QuadSwarmEnv(max_steps=3)
    env.reset(seed=0)
    ends = [env.step(np.ones(12, dtype=np.int8))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_collisions_between_steps_can_end_episodes():
    # Two robots fly through each other within a step: apart at both ends, in contact between.
    ends = {}
    for continuous in (False, True):
        env = QuadSwarmEnv(n_robots=2, continuous_collisions=continuous)
        env.reset(options={"starts": [[-0.35, 0.5, 1], [0.35, 0.5, 1]], "goals": [[3, 0.5, 1], [-3, 0.5, 1]]})
        env.task.swarm.state[0, :, 3] = [7.0, -7.0]
        *_, terminated, _, info = env.step(np.zeros(2))
        assert info["min_separation"] > 0.6
        assert info["min_separation_continuous"] < 0.1
        ends[continuous] = terminated
    assert ends == {False: False, True: True}


def test_info_at_the_end_carries_what_the_learner_logs():
    env = QuadSwarmEnv(max_steps=40, scenario="random")
    env.reset(seed=5)
    for _ in range(40):
        *_, info = env.step(np.ones(12, dtype=np.int8))
    assert info["is_success"]
    metrics = info["metrics"]
    assert metrics["comm/request_share"] == 1.0
    assert metrics["swarm/arrival_rate"] == 1.0
    assert metrics["swarm/collision_rate"] == 0.0
    assert metrics["planner/failure_rate"] == 0.0
    assert metrics["planner/solve_us"] > 0
    assert metrics["swarm/min_separation"] == pytest.approx(env.task.statistics.min_separation[0])


def test_a_hopeless_planner_never_raises():
    env = QuadSwarmEnv(scenario="symmetric_swap")
    env.task.swarm.planner.solver.max_iterations = 1
    env.reset(seed=0)
    for _ in range(5):
        *_, info = env.step(np.zeros(12))
        assert (info["planner"]["status"] >= 2).all()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.ones(11), r"shape \(11,\); the action space has \(12,\): 3 bits for each"),
        (np.full(12, 0.5), r"contains .*0\.5.*Threshold"),
        (np.full(12, np.nan), "contains .*nan"),
        (np.full(12, 2), "must be 0 or 1"),
    ],
)
def test_refuses_senseless_actions(action, message):
    env = QuadSwarmEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"preset": "papr"}, "Did you mean 'paper'"),
        ({"scenario": "swap"}, "Unknown scenario 'swap'"),
        ({"n_robots": 1}, "n_robots=1"),
        ({"n_robots": 200}, "do not fit"),
        ({"solver": "ipop"}, "Unknown solver 'ipop'"),
        ({"reward": {"gaol": 1}}, "Did you mean 'goal'"),
        ({"max_steps": 0}, "max_steps=0"),
        ({"memory": -1.0}, "memory=-1"),
        ({"render_mode": "ansi"}, "render_mode"),
    ],
)
def test_refuses_senseless_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        QuadSwarmEnv(**kwargs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": np.zeros((4, 3))}, "reset option 'start'"),
        ({"starts": np.zeros((4, 3))}, "give both"),
        ({"starts": np.full((4, 3), np.nan), "goals": np.zeros((4, 3))}, "finite points"),
    ],
)
def test_refuses_senseless_reset_options(options, message):
    with pytest.raises(ValueError, match=message):
        QuadSwarmEnv().reset(options=options)


def test_pictures_show_the_swarm():
    env = gymnasium.make("QuadSwarm-v0", render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(10):
        env.step(np.ones(12, dtype=np.int8))
    after = env.render()
    assert before.shape == after.shape == (480, 640, 3)
    assert before.dtype == np.uint8
    assert len(np.unique(after.reshape(-1, 3), axis=0)) > 50
    assert (before != after).any(axis=-1).mean() > 0.005
    with pytest.raises(ValueError, match="render_mode='rgb_array'"):
        QuadSwarmEnv().render()


def test_a_window_shows_every_step(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    with pytest.raises(gymnasium.error.Error, match="rgb_array"):
        gymnasium.make("QuadSwarm-v0", render_mode="human").reset(seed=0)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make("QuadSwarm-v0", render_mode="human")
    env.reset(seed=0)
    first = pygame.surfarray.array3d(pygame.display.get_surface())
    started = time.perf_counter()
    for _ in range(5):
        env.step(np.ones(12, dtype=np.int8))
    assert time.perf_counter() - started > 0.3, "ten steps a second"
    assert (pygame.surfarray.array3d(pygame.display.get_surface()) != first).any()
    assert env.render() is None
    env.close()
    assert pygame.display.get_surface() is None


def test_videos_are_recorded(tmp_path):
    env = RecordVideo(gymnasium.make("QuadSwarm-v0", render_mode="rgb_array", max_steps=5), str(tmp_path))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(12, dtype=np.int8))
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


def test_survives_pickling_in_the_middle_of_an_episode():
    env = QuadSwarmEnv()
    env.reset(seed=2)
    for _ in range(3):
        env.step(np.ones(12, dtype=np.int8))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        assert np.array_equal(env.step(np.zeros(12))[0], copy.step(np.zeros(12))[0])


@pytest.mark.parametrize("scenario", [*SCENARIOS, "mixed", "curriculum"])
def test_info_names_the_scenario(scenario):
    env = QuadSwarmEnv(scenario=scenario)
    _, info = env.reset(seed=0)
    assert info["scenario"] in SCENARIOS
    assert env.n_curriculum_levels == (4 if scenario == "curriculum" else 1)


def test_near_misses_cost_in_proportion():
    weights = {"near_miss": 2.0, "near_miss_distance": 0.8, "near_miss_width": 0.1}
    env = QuadSwarmEnv(n_robots=2, reward=weights)
    for distance, cost in ((0.9, 0.0), (0.75, 1.0), (0.65, 2.0)):
        line = np.array([[0, 0, 1.0], [distance, 0, 1.0]])
        env.reset(options={"starts": line, "goals": line})
        *_, info = env.step(np.array([1, 1]))
        separation = info["min_separation"]
        assert info["reward_terms"]["near_miss"] == pytest.approx(-2 * np.clip((0.8 - separation) / 0.1, 0, 1))
        assert -info["reward_terms"]["near_miss"] == pytest.approx(cost, abs=0.3)


def test_near_misses_may_look_ahead_along_the_plans():
    weights = {"near_miss": 1.0, "near_miss_distance": 0.6, "near_miss_width": 0.3}
    costs = []
    for ahead in (0, 8):
        env = QuadSwarmEnv(n_robots=2, reward={**weights, "near_miss_ahead": ahead})
        # Head-on, and neither knows of the other's plan
        ends = np.array([[-2.0, 0, 1], [2.0, 0.02, 1]])
        env.reset(options={"starts": ends, "goals": ends[::-1]})
        rows = [env.step(np.array([0, 0]))[-1]["reward_terms"]["near_miss"] for _ in range(12)]
        costs.append(np.flatnonzero(np.array(rows) < 0)[:1].tolist() or [99])
    assert costs[1] < costs[0]


def test_near_misses_far_ahead_may_count_from_less_distance():
    weights = {"near_miss": 1.0, "near_miss_distance": 0.6, "near_miss_width": 0.3, "near_miss_ahead": 8}
    # Both would stop at the same place: the miss is in the last steps that are looked at
    ends = np.array([[-0.5, 0, 1], [0.5, 0.02, 1]])
    costs = {}
    for narrowing in (0.0, 0.1, 0.7):
        env = QuadSwarmEnv(n_robots=2, reward={**weights, "near_miss_narrowing": narrowing})
        env.reset(options={"starts": ends, "goals": np.tile([0.0, 0, 1], (2, 1))})
        costs[narrowing] = -env.step(np.array([0, 0]))[-1]["reward_terms"]["near_miss"]
    assert costs[0.0] > costs[0.1] > costs[0.7] == 0


def test_episodes_may_end_at_arrival():
    env = QuadSwarmEnv(n_robots=2, end_at_arrival=True)
    line = np.array([[-1.0, 0, 1], [1, 0, 1]])
    env.reset(options={"starts": line, "goals": line})
    *_, terminated, truncated, info = env.step(np.array([0, 0]))
    assert (terminated, truncated, info["is_success"]) == (True, False, True)


@pytest.mark.parametrize("seed", [3, np.int64(3)])
def test_seeds_may_be_numpy_s(seed):
    env = QuadSwarmEnv(n_robots=2)
    assert np.array_equal(env.reset(seed=seed)[0], env.reset(seed=3)[0])


@pytest.mark.parametrize("seed", [-1, 0.5, "x", [1]])
def test_refuses_senseless_seeds(seed):
    with pytest.raises(ValueError, match="a seed is an integer of at least 0"):
        QuadSwarmEnv(n_robots=2).reset(seed=seed)


def test_a_step_before_the_reset_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"before reset\(\)"):
        QuadSwarmEnv(n_robots=2).step(np.zeros(2))


@pytest.mark.parametrize("shape", [(4, 3), (1, 12), (12, 1), ()])
def test_an_action_has_the_shape_of_its_space(shape):
    env = QuadSwarmEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"has shape \(.*\); the action space has \(12,\)"):
        env.step(np.zeros(shape))


def test_every_field_of_the_world_can_be_set():
    world = {"radius": 0.12, "goal_radius": 0.2, "quadrotor": {"drag_x": 0.1}, "noise": {"wind": 1.0}}
    env = gymnasium.make("QuadSwarm-v0", n_robots=2, world=world)
    env.reset(seed=0)
    config = env.unwrapped.config
    assert (config.radius, config.planner.separation, config.noise.wind) == (0.12, 0.24, 1.0)
    env.step(np.zeros(2, dtype=np.int8))


def test_unknown_arguments_are_named():
    with pytest.raises(ValueError, match=r"Unknown argument 'sceanrio'.*Did you mean 'scenario'"):
        QuadSwarmEnv(sceanrio="random")


@pytest.mark.parametrize("options", [5, "x", int, [1], {1: 2}])
def test_options_that_are_no_mapping_of_names_are_refused(options):
    for env in (
        QuadSwarmEnv(),
        gymnasium.make_vec("QuadSwarm-v0", num_envs=2).unwrapped,
        quad_swarm.parallel_env(),
    ):
        with pytest.raises(ValueError, match="the options of reset"):
            env.reset(options=options)


def test_points_beyond_any_number_are_refused_in_one_line():
    for starts in (10**400, np.full((4, 3), np.nan)):
        with pytest.raises(ValueError, match="starts must be 4 finite points") as told:
            QuadSwarmEnv().reset(options={"starts": starts, "goals": np.ones((4, 3))})
        assert "\n" not in str(told.value)


@pytest.mark.parametrize("level", ["x", 0.5, None, -1])
def test_a_level_that_is_none_is_refused(level):
    with pytest.raises(ValueError, match=r"Level .* does not exist"):
        QuadSwarmEnv(scenario="curriculum").set_curriculum_level(level)
