"""Swarms and robots know the same things under the same names, and plan the same problems."""

import inspect

import numpy as np
import pytest

from quad_swarm.robot import Robot
from quad_swarm.world.beliefs import BeliefSource
from quad_swarm.world.knowledge import Knowledge, make_beliefs, make_problems
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm

CONFIG = make_config("flight", n_robots=3)


@pytest.mark.parametrize("source", [Swarm, Robot])
def test_swarms_and_robots_are_sources_of_knowledge(source):
    for name, member in vars(Knowledge).items():
        if name.startswith("_") or name in ("config", "goal", "beliefs", "neighbours", "obstacles", "bodies"):
            continue
        assert inspect.signature(getattr(source, name)) == inspect.signature(member), name


def test_beliefs_begin_without_plans():
    beliefs = make_beliefs(CONFIG, 2, 3)
    assert beliefs.age.shape == (2, 3, 2)
    assert (beliefs.age == CONFIG.planner.horizon).all()
    assert beliefs.misfit == pytest.approx(0.5 * CONFIG.planner.separation)


@pytest.mark.parametrize("obstacles", [{}, {"listed": [{"position": (0, 0, 0), "radius": 0.2}]}])
@pytest.mark.parametrize(("predicted", "obstacle"), [(1.0, 4.0), (0.25, 4.0), (0.25, 1.0)])
def test_violations_cost_by_how_certain_a_body_is(predicted, obstacle, obstacles):
    penalties = {"obstacle_penalty": obstacle, "prediction_penalty": predicted}
    config = make_config("flight", {"planner": penalties, "obstacles": obstacles}, n_robots=3)
    swarm, seen = Swarm(config), []
    swarm.reset(0, [[-2, 0, 1], [2, 0, 1], [0, 2, 1]], [[2, 0, 1], [-2, 0, 1], [0, -2, 1]])
    plan = swarm.planner.plan
    swarm.planner.plan = lambda problems, last: seen.append(problems) or plan(problems, last)
    some = np.array([[[True, False], [False, False], [True, True]]])
    reports = [swarm.step(some) for _ in range(4)]
    sources = np.array([report.belief_source[0] for report in reports])
    assert len(np.unique(sources == BeliefSource.CONSTANT_VELOCITY)) == 2, "some plans are known"
    for problems, source in zip(seen, sources, strict=True):
        if predicted == 1 and not obstacles:
            assert problems.penalty is None
            continue
        of_robots = np.where(source == BeliefSource.CONSTANT_VELOCITY, predicted, 1.0)
        of_obstacles = np.full((3, swarm.config.obstacles.slots), obstacle)
        np.testing.assert_array_equal(problems.penalty, np.concatenate([of_robots, of_obstacles], axis=1))


PILLAR = {"position": (0, 0, 0), "radius": 0.3}
BALL = {"position": (-2, 3, 1), "radius": 0.2, "shape": "sphere", "velocity": (0, -1, 0)}
MOVING = np.array([[-2, 0, 1, 2, 0, 1], [2, 0, 1, 2, 0, 0], [-2, 1, 1, 0, 2, 0]])
APPROACH = np.array([[2, 1], [0, 0], [0, 3]])  # to the pillar, of which climbing is no part, and to the ball (m/s)
STRONG = [{}, {}, {"max_tilt": 0.5}]


def grown(reserve, states=MOVING, passed=0.0, late=None, vehicles=()):
    """Return by how much a pillar and a ball are larger with a braking reserve, as three robots plan, (3, 2)."""
    sizes = []
    for value in (reserve, 0.0):
        world = {"planner": {"braking_reserve": value}, "obstacles": {"listed": [PILLAR, BALL]}, "vehicles": vehicles}
        swarm = Swarm(make_config("flight", world, n_robots=3))
        swarm.reset(0, MOVING[:, :3], MOVING[:, :3] * [-1, -1, 1])
        swarm.obstacles.advance(passed)
        x = np.zeros((1, 3, 9))
        x[..., : states.shape[-1]] = states
        others, source, u = np.zeros((1, 3, 2, swarm.config.planner.horizon, 3)), np.zeros((1, 3, 2)), x[..., :4] * 0
        problems = make_problems(
            swarm.config, swarm.planner.model, x, x[..., :3], others, source, u, late, swarm.obstacles
        )
        sizes.append(problems.size[:, 2:])
    return sizes[0] - sizes[1]


def braking(tilt):
    vehicle = CONFIG.quadrotor
    return vehicle.gravity * np.tan(min(vehicle.roll_gain, vehicle.pitch_gain) * tilt)


def test_robots_keep_further_from_obstacles_by_a_share_of_their_braking_distance():
    np.testing.assert_array_equal(grown(0.0), 0.0)
    expected = APPROACH**2 / (2 * braking(CONFIG.planner.max_tilt))
    np.testing.assert_allclose(grown(0.5), 0.5 * expected, atol=1e-12)
    np.testing.assert_allclose(grown(2.0), 2.0 * expected, atol=1e-12)


def test_robots_that_brake_harder_keep_less_in_reserve():
    unlike, alike = grown(0.5, vehicles=STRONG), grown(0.5)
    np.testing.assert_allclose(unlike[:2], alike[:2], atol=1e-12)
    np.testing.assert_allclose(unlike[2] * braking(0.5), alike[2] * braking(CONFIG.planner.max_tilt), atol=1e-12)


def test_braking_distances_are_those_when_inputs_take_effect():
    x = np.zeros((1, 3, 9))
    x[..., :6] = MOVING
    late = np.full((1, 3), 0.5)
    model = Swarm(CONFIG).planner.model
    then = model.ahead(x, np.zeros((1, 3, 4)), late * CONFIG.planner.dt, None)[0]
    np.testing.assert_allclose(grown(0.5, late=late), grown(0.5, then, 0.5 * CONFIG.planner.dt), atol=1e-9)
    assert (grown(0.5, late=late)[[0, 2], [0, 1]] < grown(0.5)[[0, 2], [0, 1]]).all(), "drag slowed them"


def test_robots_come_to_a_pillar_slower_with_a_braking_reserve():
    fastest = []
    for reserve in (0.0, 1.0):
        obstacles = {"listed": [{"position": (0, 0.05, 0), "radius": 0.4}]}
        world = {"planner": {"braking_reserve": reserve}, "obstacles": obstacles}
        swarm = Swarm(make_config("paper", world, n_robots=2))
        swarm.reset(0, [[-3, 0, 1], [3, 3, 1]], [[3, 0, 1], [-3, 3, 1]])
        nearby = []
        for _ in range(40):
            swarm.step(np.ones((1, 2, 1), bool))
            x, y, _, *velocity = swarm.state[0, 0, :6]
            if np.hypot(x, y - 0.05) < 1.5 and x < 0:
                nearby.append(np.linalg.norm(velocity))
        fastest.append(max(nearby))
    assert fastest[1] < 0.95 * fastest[0], fastest


@pytest.mark.parametrize("late", [None, 0.5])
def test_problems_start_when_inputs_take_effect(late):
    swarm = Swarm(CONFIG)
    estimate = np.zeros((1, 3, 9))
    estimate[..., 3] = 2.0  # m/s
    believed = np.zeros((1, 3, 2, CONFIG.planner.horizon, 3))
    believed[..., 0] = np.arange(CONFIG.planner.horizon)
    source = np.full((1, 3, 2), BeliefSource.CONSTANT_VELOCITY)
    source[0, 1, 0] = BeliefSource.REMEMBERED
    shares = None if late is None else np.full((1, 3), late)
    arguments = (estimate, np.ones((1, 3, 3)), believed, source, np.zeros((1, 3, 4)), shares)
    problems = make_problems(CONFIG, swarm.planner.model, *arguments, None)
    moved = 0.0 if late is None else late * CONFIG.planner.dt * 2.0
    np.testing.assert_allclose(problems.x[:, 0], moved, rtol=0.02)
    np.testing.assert_allclose(problems.others[..., 0, 0], late or 0.0)
    assert problems.announced.tolist() == [[False, False], [True, False], [False, False]]
    problems.goal[:] = 7.0
    assert (arguments[1] == 1).all(), "solvers get copies"
