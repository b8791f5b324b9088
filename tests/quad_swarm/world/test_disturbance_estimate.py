"""Robots estimate what pushes them, and reach their goals in spite of it."""

import numpy as np
import pytest

from quad_swarm.planner import PlannerConfig, make_planner
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.disturbance_estimate import DisturbanceEstimate
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm

PLACES = np.array([[-1.5, 0, 1.5], [1.5, 0, 1.5]])
NOBODY = np.zeros((1, 2, 1), bool)


def off_goal(wind, config, steps):
    """How far robots that shall stay where they are end up from there (m), in a wind along x."""
    swarm = Swarm(config)
    swarm.reset(0, PLACES, PLACES, noise_seed=1)
    swarm.disturbances._wind[0] = wind, 0.0
    for _ in range(steps):
        swarm.step(NOBODY)
    return np.linalg.norm(swarm.pos[0] - PLACES, axis=1).max(), swarm


@pytest.mark.parametrize(("wind", "vehicle"), [(1.0, {}), (6.0, {}), (6.0, {"drag_x": 0.02})])
def test_robots_stay_at_their_goals_in_wind(wind, vehicle):
    world = {"noise": {"wind": 1.0}, "quadrotor": vehicle}
    offset, swarm = off_goal(
        wind, make_config("paper", world | {"planner": {"disturbance_time": 1.0}}, n_robots=2), 150
    )
    assert offset < 1e-3
    drag = swarm.config.quadrotor.drag_x
    np.testing.assert_allclose(swarm.disturbance.acceleration[0], [[drag * wind, 0, 0]] * 2, atol=1e-3)
    without, _ = off_goal(wind, make_config("paper", world, n_robots=2), 150)
    assert without > 50 * offset + 0.03


def test_a_payload_is_a_disturbance_too():
    """Vehicles that sink, since they are heavier than their model."""
    config = make_config("paper", {"planner": {"disturbance_time": 1.0}}, n_robots=2)
    swarm = Swarm(config)
    swarm.reset(0, PLACES, PLACES)
    for _ in range(120):
        swarm.step(NOBODY)
        swarm.state[..., 5] -= 0.05
        swarm.state[..., 2] -= 0.0025
    assert np.abs(swarm.pos[0, :, 2] - 1.5).max() < 0.01
    assert (swarm.disturbance.acceleration[0, :, 2] < -0.3).all()


def test_small_goals_are_reached_in_the_disturbances_of_flight():
    reached = []
    for planner in ({}, {"disturbance_time": 1.0}):
        world = {"goal_radius": 0.25, "planner": planner, "noise": {"wind": 1.0}}
        _, swarm = off_goal(1.0, make_config("flight", world, n_robots=2), 200)
        near = []
        for _ in range(40):
            swarm.step(NOBODY)
            near.append(np.linalg.norm(swarm.pos[0] - PLACES, axis=1))
        reached.append(np.mean(np.array(near) < 0.1))
    assert reached[0] < 0.6
    assert reached[1] > 0.9


def test_goals_that_only_an_estimate_reaches_are_doubtful_without(recwarn):
    make_config("flight", {"goal_radius": 0.15, "planner": {"disturbance_time": 1.0}})
    assert not recwarn.list
    with pytest.warns(DoubtfulWorld, match="goal_radius=0.15"):
        make_config("flight", {"goal_radius": 0.15})
    with pytest.warns(DoubtfulWorld, match="noise.wind=99: with planner.max_tilt"):
        make_config("flight", {"noise": {"wind": 99.0}, "planner": {"disturbance_time": 1.0}})


def test_the_estimate_does_not_exceed_what_robots_can_hold_against():
    config, params = PlannerConfig(disturbance_time=0.5), QuadrotorParams()
    estimate = DisturbanceEstimate.of(make_planner(config, params, 2), 1, 1)
    for _ in range(50):
        estimate.expect(np.zeros((1, 1, 9)), np.zeros((1, 1, 4)), None)
        estimate.update(np.full((1, 1, 9), 9.0))
    held = params.steady_input(estimate.acceleration)[0, 0]
    limits = [config.max_tilt, config.max_tilt, config.max_climb_rate]
    np.testing.assert_allclose(np.abs(held[:3]), 0.9 * np.array(limits))
    before = estimate.acceleration.copy()
    estimate.miss()
    estimate.update(np.zeros((1, 1, 9)))
    assert np.array_equal(estimate.acceleration, before), "nothing was expected"
    estimate.expect(np.full((1, 1, 9), np.nan), np.zeros((1, 1, 4)), None)
    estimate.update(np.zeros((1, 1, 9)))
    assert np.array_equal(estimate.acceleration, before), "nothing is learned from what is not finite"


def test_swarms_save_copy_and_split_what_was_estimated():
    config = make_config("flight", {"planner": {"disturbance_time": 1.0}}, n_robots=2)
    swarm, other = Swarm(config, 2), Swarm(config, 2)
    for k in range(2):
        swarm.reset(k, PLACES, PLACES[::-1], noise_seed=k)
        other.reset(k, PLACES, PLACES[::-1], noise_seed=k + 7)
    nobody = np.zeros((2, 2, 1), bool)
    for _ in range(5):
        swarm.step(nobody)
    other.load_state_dict(swarm.state_dict())
    fork, second = swarm.fork(), swarm.fork()
    second.keep(np.array([False, True]))
    for _ in range(5):
        for one in (swarm, other, fork):
            one.step(nobody)
        second.step(nobody[1:])
    assert np.abs(swarm.disturbance.acceleration).max() > 0.05
    for one in (other, fork):
        assert one.state.tobytes() == swarm.state.tobytes()
        assert one.disturbance.acceleration.tobytes() == swarm.disturbance.acceleration.tobytes()
    assert second.state.tobytes() == swarm.state[1:].tobytes(), "alone as in a batch"
    swarm.reset(0, PLACES, PLACES)
    assert not swarm.disturbance.acceleration[0].any()
    assert swarm.disturbance.acceleration[1].any()
