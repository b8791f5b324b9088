"""Obstacles: what is refused, where they are drawn, how far robots keep from them, and who touches them."""

import pickle
from dataclasses import replace
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from quad_swarm import QuadSwarmEnv
from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly_steps, run_episodes
from quad_swarm.task.episode_statistics import is_row
from quad_swarm.world.obstacles import Obstacle, Obstacles, clearances, surroundings
from quad_swarm.world.presets import for_scenario, make_config
from quad_swarm.world.scenarios import MOST_OBSTACLES, SCENARIOS, DoesNotFit, ScenarioSampler, ScenarioSpace
from quad_swarm.world.swarm import Swarm
from sb3_maddpg.common.callbacks import record_metrics
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

OURS = sorted(MOST_OBSTACLES)
SPACE = ScenarioSpace(circle_radius=(2.5, 3.0), half_width=3.0)
PILLAR, BALL = Obstacle((0.0, 0.0, 5.0), 0.5), Obstacle((1.0, 0.0, 1.0), 0.5, "sphere", (0.0, 1.0, 0.0))


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"number": (3, 1)}, "lowest number first"),
        ({"radius": (0.0, 1.0)}, "positive"),
        ({"speed": (-1.0, 1.0)}, "not negative"),
        ({"number": (0, 4), "most": 3}, "there may be 4 obstacles"),
        ({"shape": "cube"}, "shape"),
        ({"listed": [{"position": (0, 0, np.nan), "radius": 1.0}]}, "position"),
        ({"listed": [{"position": (0, 0, 0), "radius": -1.0}]}, "radius"),
        ({"listed": [{"position": (0, 0, 0)}]}, r"^obstacles\.listed\.0\.radius is missing in \{'position'"),
        (
            {"listed": [{"position": (0, 0), "radius": 1.0}]},
            r"^obstacles\.listed\.0\.position=.*too few entries: it must have 3",
        ),
        ({"listed": [{"position": (0, 0, 0), "radius": 1.0, "velocity": 1}]}, r"velocity=1: it must be a list of 3\.$"),
        ({"listed": [3]}, r"^obstacles\.listed\.0=3: it must be a mapping, not a plain value, or an Obstacle\.$"),
        ({"number": 4}, r"^obstacles\.number=4: it must be a list of 2, as in \[4, 4\]\.$"),
        ({"number": [1, 2, 3]}, r"^obstacles\.number=\[1, 2, 3\]: it must have at most 2 entries, not 3\.$"),
        ({"listed": [{"position": (0, 0, 0), "radus": 1.0}]}, "Did you mean 'radius'"),
        ({"listed": [{"position": (0, 0, 0), "radius:0.2": None}]}, "needs a blank after the colon: radius: 0.2"),
    ],
)
def test_invalid_obstacles_are_refused(world, message):
    with pytest.raises(ValueError, match=message):
        make_config("paper", obstacles=world)


def test_distances_to_surfaces():
    points = np.array([[0.0, 2.0, 1.0], [1.0, 0.0, 3.0]])
    np.testing.assert_allclose(clearances(points, surroundings([PILLAR, BALL])), [[1.5, 5**0.5 - 0.5], [0.5, 1.5]])


@given(seed=st.integers(0, 2**32), n_robots=st.integers(2, 8))
@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("name", OURS)
def test_scenes_keep_their_spacing(name, seed, n_robots):
    sampler = ScenarioSampler(name, n_robots, SPACE)
    drawn, starts, goals, obstacles = sampler.sample(np.random.default_rng(seed))
    assert drawn == name
    assert 0 < len(obstacles) <= MOST_OBSTACLES[name](SPACE)
    least = 0.6 * SPACE.spacing - 1e-9
    assert clearances(starts, surroundings(obstacles)).min() >= least
    if name != "crossing_traffic":
        assert clearances(goals, surroundings(obstacles)).min() >= least
    if name == "doorway":
        assert (starts[:, 0] * goals[:, 0] < 0).all()
    if name == "crossing_traffic":  # each sphere passes near the middle while robots swap
        for one in obstacles:
            times = np.linspace(0, 6, 601)[:, None]
            path = np.array(one.position) + times * np.array(one.velocity)
            assert np.hypot(*path[:, :2].T).min() < SPACE.circle_radius[0] / 2 + 0.02


def test_the_world_draws_obstacles_beside_those_of_a_scenario_and_its_list():
    config = make_config("paper", obstacles={"listed": [{"position": (0, 0, 0), "radius": 0.2}], "number": (1, 3)})
    config = for_scenario(config, "crossing_traffic")
    sampler = ScenarioSampler("crossing_traffic", 4, config.space, config)
    counts = set()
    for seed in range(20):
        *_, obstacles = sampler.sample(np.random.default_rng(seed))
        shapes = [one.shape for one in obstacles]
        balls = shapes.count("sphere")
        counts.add((balls, len(obstacles) - balls - 1))
        assert obstacles[balls] == config.obstacles.listed[0]
    assert {balls for balls, _ in counts} == {2, 3, 4}
    assert {pillars for _, pillars in counts} == {1, 2, 3}


def test_random_numbers_without_obstacles_are_those_of_before():
    config = make_config("paper")
    rng, other = np.random.default_rng(5), np.random.default_rng(5)
    _, starts, goals, obstacles = ScenarioSampler("symmetric_swap", 4, config.space, config).sample(rng)
    again = SCENARIOS["symmetric_swap"](4, config.space, other)
    assert obstacles == ()
    assert np.array_equal([starts, goals], again)
    assert rng.random() == other.random()


@pytest.mark.parametrize(
    ("starts", "goals", "message"),
    [
        ([[0.0, 0.7, 1.0], [0.0, 3.0, 1.0]], [[3.0, 0.0, 1.0], [-3.0, 0.0, 1.0]], r"starts\[0\].* obstacle 0"),
        ([[3.0, 0.0, 1.0], [0.0, 3.0, 1.0]], [[0.0, 0.0, 1.0], [-3.0, 0.0, 1.0]], r"goals\[0\].* obstacle 0"),
    ],
)
def test_starts_and_goals_inside_obstacles_are_refused(starts, goals, message):
    env = QuadSwarmEnv(n_robots=2, world={"obstacles": {"listed": [PILLAR]}})
    with pytest.raises(ValueError, match=message):
        env.reset(options={"starts": starts, "goals": goals})


def test_scenarios_draw_again_what_an_obstacle_is_in_the_way_of():
    world = {"obstacles": {"listed": [{"position": (0, 0, 0), "radius": 0.7}]}}
    config = make_config("flight", world)
    sampler, rng = ScenarioSampler("random", config.n_robots, config.space, config), np.random.default_rng(0)
    for _ in range(50):
        _, starts, goals, obstacles = sampler.sample(rng)
        config.check_flight(starts, goals, obstacles)
        assert np.hypot(*np.concatenate([starts, goals])[:, :2].T).min() >= 0.7 + config.radius
    world["obstacles"]["listed"][0]["radius"] = 1.5
    config = make_config("flight", world)
    with pytest.raises(
        DoesNotFit, match=r"8 robots of scenario='random' .* 0 of 40 .*half_width.*starts\[0\]=.*1\.\d+ m"
    ):
        ScenarioSampler("random", config.n_robots, config.space, config)


def test_more_obstacles_than_there_is_room_for_are_refused():
    swarm = Swarm(make_config("paper"))
    with pytest.raises(ValueError, match=r"obstacles\.most=0: set it to 1"):
        swarm.reset(0, np.eye(4, 3) * 3 + 1, np.eye(4, 3) * 3 + 1, [PILLAR], checked=True)
    with pytest.raises(ValueError, match="there may be 8 obstacles"):
        ScenarioSampler("forest", 4, SPACE, make_config("paper"))


def test_a_scenario_from_outside_may_have_obstacles():
    def column(n_robots, space, rng):
        return *SCENARIOS["symmetric_swap"](n_robots, space, rng), [Obstacle((0.0, 0.0, 0.0), 0.3)]

    def wrong(n_robots, space, rng):
        return *SCENARIOS["symmetric_swap"](n_robots, space, rng), ["pillar"]

    with patch.dict(SCENARIOS, column=column, wrong=wrong):
        env = QuadSwarmEnv(scenario="column", world={"obstacles": {"most": 1}})
        env.reset(seed=0)
        assert env.unwrapped.task.swarm.obstacles.radius.tolist() == [[0.3]]
        with pytest.raises(ValueError, match="sequence of `Obstacle`"):
            QuadSwarmEnv(scenario="wrong", world={"obstacles": {"most": 1}})


def closest(robots, one, times):
    """Smallest distance between surfaces, from positions at many times."""
    factors = np.array([1, 1, one.shape == "sphere"])
    centres = np.array(one.position) + times[:, None] * np.array(one.velocity)
    return np.linalg.norm(factors * (robots - centres), axis=-1).min() - one.radius


def test_contact_is_found_at_any_time_of_a_step():
    """Of straight motion between sub-steps, against positions at a thousand times."""
    rng = np.random.default_rng(0)
    obstacles = Obstacles(3, 3)
    listed = [
        [Obstacle(tuple(rng.normal(size=3)), 0.3, shape, tuple(rng.normal(size=3))) for shape in ("sphere", "cylinder")]
        for _ in range(3)
    ]
    for k, some in enumerate(listed):
        obstacles.reset(k, some)
    positions = rng.normal(size=(5, 3, 4, 3))
    after, during = obstacles.measure(positions, np.full(positions.shape[2], 0.2), 0.4)
    assert np.isinf(after[..., 2]).all()
    grid = np.linspace(0, 4, 1001)
    for k, robot in np.ndindex(3, 4):
        path = np.stack([np.interp(grid, range(5), positions[:, k, robot, i]) for i in range(3)], axis=1)
        for j, one in enumerate(listed[k]):
            assert during[k, robot, j] == pytest.approx(closest(path, one, 0.1 * grid) - 0.2, abs=1e-3)
            assert after[k, robot, j] == pytest.approx(closest(path[-1:], one, np.array([0.4])) - 0.2, abs=1e-12)


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("preset", ["paper", "flight"])
def test_flights_are_safe_reported_rightly_and_the_same_alone_and_in_a_batch(preset, name):
    config = make_config(preset, n_robots=4)
    seeds = [first_episode(0) + k for k in range(3)]
    policy, task, rngs = begin(Condition("full", name, config), seeds)
    alone = [begin(Condition("full", name, config), [seed]) for seed in seeds]
    world, dt, centres = task.swarm.config, config.planner.dt, task.swarm.obstacles.position.copy()
    for step in range(1, 41):
        report = task.act(policy(task, rngs)).report
        obstacles = task.swarm.obstacles
        np.testing.assert_allclose(obstacles.position, centres + step * dt * obstacles.velocity, atol=1e-12)
        for k, (their_policy, one, their_rngs) in enumerate(alone):
            theirs = one.act(their_policy(one, their_rngs)).report
            assert np.array_equal(one.swarm.state[0], task.swarm.state[k])
            assert np.array_equal(theirs.obstacles.distance[0], report.obstacles.distance[k])
        between = obstacles.factors[:, None] * (task.swarm.pos[:, :, None] - obstacles.position[:, None])
        expected = np.linalg.norm(between, axis=-1) - (obstacles.radius + world.radius)[:, None]
        there = obstacles.radius > 0
        np.testing.assert_allclose(report.obstacles.distance.swapaxes(1, 2)[there], expected.swapaxes(1, 2)[there])
        assert np.isinf(report.obstacles.distance.swapaxes(1, 2)[~there]).all()
    assert not task.statistics.collided.any()
    assert (task.statistics.min_obstacle_distance > 0).all()
    assert np.isfinite(task.swarm.state).all()


def test_robots_that_do_not_know_an_obstacle_hit_it():
    """Without obstacles in the planner, the statistics see the collision, which ends episodes."""
    config = make_config("paper", n_robots=2, obstacles={"listed": [PILLAR]})
    starts, goals = np.array([[-3.0, 0.0, 1.0], [3.0, 3.0, 1.0]]), np.array([[3.0, 0.1, 1.0], [-3.0, 3.0, 1.0]])
    swarm = Swarm(config)
    blind = Swarm(replace(config, obstacles=replace(config.obstacles, listed=())))
    for one in (swarm, blind):
        one.reset(0, starts, goals)
    swarm.planner = blind.planner
    with patch.object(swarm, "_problems", blind._problems):
        hits = []
        for _ in range(25):
            blind.state, blind._u = swarm.state, swarm._u
            report = swarm.step(np.zeros((1, 2, 1), bool))
            hits.append(bool(report.collision[0]))
            assert hits[-1] == bool(report.obstacles.colliding.any())
    assert any(hits)
    assert not hits[0]


def test_rows_tell_of_obstacles_only_where_there_are_any():
    config = make_config("paper")
    without, among = (
        run_episodes(Condition("none", name, config), [first_episode(0)])[0] for name in ("random", "forest")
    )
    assert is_row(without)
    assert is_row(among)
    assert among.keys() - without.keys() == {"collided_obstacle", "min_obstacle_distance"}
    assert among["min_obstacle_distance"] > 0


@pytest.mark.parametrize("kind", ["dummy", "gymnasium"])
def test_trainings_log_the_distance_to_obstacles_of_episodes_that_have_some(kind):
    arguments = {"n_robots": 3, "scenario": {"random": 1, "forest": 1}, "max_steps": 2}
    if kind == "dummy":
        envs = DummyVecEnv([lambda: QuadSwarmEnv(**arguments)] * 8)
    else:
        envs = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=8, **arguments))
    envs.seed(1)
    envs.reset()
    for _ in range(2):
        infos = envs.step(np.zeros((8, envs.action_space.n), np.int8))[3]
    logger = Logger(None, [])
    record_metrics(logger, infos)
    assert 0 < logger.name_to_value["swarm/min_obstacle_distance"] < 5
    told = {name: {} for name in ("random", "forest")}
    for info in infos:
        told[info["scenario"]][info["metrics"].get("swarm/min_obstacle_distance")] = True
    assert list(told["random"]) == [None]
    assert None not in told["forest"]


def test_states_resume_among_obstacles_bit_for_bit():
    env = QuadSwarmEnv(scenario="crossing_traffic")
    env.reset(seed=3)
    for _ in range(5):
        env.step(np.zeros(env.action_space.shape, np.int8))
    other, state = QuadSwarmEnv(scenario="crossing_traffic"), env.unwrapped.state_dict()
    other.reset(seed=4)
    other.unwrapped.load_state_dict(pickle.loads(pickle.dumps(state)))
    for _ in range(10):
        mine, theirs = (one.step(np.ones(env.action_space.shape, np.int8)) for one in (env, other))
        assert np.array_equal(mine[0], theirs[0])
        assert mine[1] == theirs[1]
    assert np.array_equal(env.unwrapped.task.swarm.obstacles.position, other.unwrapped.task.swarm.obstacles.position)


def test_steps_of_a_recorded_flight_keep_clear():
    policy, task, rngs = begin(Condition("full", "doorway", make_config("flight", n_robots=6)), [first_episode(1)])
    distances = [step.outcome.report.obstacles.distance_continuous.min() for step in fly_steps(policy, task, rngs, 5)]
    assert min(distances) > 0
