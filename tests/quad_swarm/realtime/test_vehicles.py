"""Simulated vehicles."""

from dataclasses import replace

import foreign
import numpy as np
import pytest

from quad_swarm.planner import PROBLEMS
from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime.vehicles import Vehicles
from quad_swarm.world.obstacles import Obstacle, ObstacleConfig
from quad_swarm.world.presets import make_config

CALM = {
    "noise": {"pos": 0.0, "vel": 0.0, "attitude": 0.0, "wind": 0.0, "gust": 0.0},
    "sensing": dict.fromkeys(("pos", "vel", "attitude", "others_pos", "others_vel"), 0.0),
    "mismatch": 0.0,
}
CONFIG = make_config("flight", CALM, n_robots=2)
STARTS, GOALS = np.array([[-2.0, 0, 1.5], [2.0, 0, 1.5]]), np.array([[2.0, 0, 1.5], [-2.0, 0, 1.5]])


def flown(seconds, command=lambda vehicles: None, config=CONFIG, starts=STARTS):
    vehicles = Vehicles(config)
    vehicles.reset(starts, GOALS, 3, now=0)
    while vehicles.now < seconds * 1e6:
        command(vehicles)
        vehicles.advance()
    return vehicles


def test_the_last_command_is_flown_until_the_autopilot_misses_it():
    def once(vehicles):
        if vehicles.now == 0:
            vehicles.command(0, np.array([0.0, 0.2, 0.0, 0.0]))

    half = flown(0.5, once)
    assert half.state[0, 7] > 0.15, "it pitches"
    level = flown(1.0, once)
    assert abs(level.state[0, 7]) < 0.05, "it has levelled"
    assert level.state[0, 2] == pytest.approx(1.5, abs=0.1)
    landed = flown(6.0, once)
    assert not landed.flying.any()
    assert landed.state[0, 2] <= 0
    assert landed.state[0, 2] == flown(7.0, once).state[0, 2], "on the ground, nothing moves any more"


def test_robots_that_meet_between_two_states_collide():
    def towards(vehicles):
        for robot, pitch in ((0, 0.3), (1, -0.3)):
            vehicles.command(robot, np.array([0.0, pitch, 0.0, 0.0]))

    vehicles = flown(2.5, towards)
    assert vehicles.collisions() == [(0, 1)]
    assert vehicles.collisions(np.array([True, False])) == []
    assert vehicles.closest[0, 1] == pytest.approx(0.0, abs=1e-9), "they passed through each other"
    assert (vehicles.state[0, 0] - vehicles.state[1, 0]) > 0


def test_robots_that_touch_a_pillar_collide_with_it():
    def towards(vehicles):
        vehicles.command(0, np.array([0.0, 0.3, 0.0, 0.0]))
        vehicles.command(1, np.array([0.0, 0.0, 0.5, 0.0]))

    pillars = [{"position": (0, 0, 0), "radius": 0.3}, {"position": (9, 9, 0), "radius": 0.3, "velocity": (0, -1, 0)}]
    config = replace(CONFIG, obstacles=ObstacleConfig(tuple(Obstacle(**one) for one in pillars)))
    vehicles = flown(2.5, towards, config)
    assert vehicles.struck() == [(0, 0)]
    assert vehicles.clearance[0, 0] == pytest.approx(-0.6, abs=0.02), "it flew through its axis"
    assert vehicles.clearance[1, 0] == pytest.approx(2 - 0.6, abs=0.02)
    np.testing.assert_allclose(vehicles.obstacles.position[0, 1], (9, 6.5, 0))
    flight = vehicles.flight(0, [None] * 2, [None] * 2, [])
    assert flight.collided
    assert (flight.collisions, flight.struck) == ([], [(0, 0)])
    vehicles.reset(STARTS, GOALS, 3, 0, ())
    vehicles.advance()
    assert np.isinf(vehicles.clearance).all(), "no obstacle in this flight"


def test_what_is_not_finite_is_no_command():
    def broken(vehicles):
        vehicles.command(0, np.full(4, np.nan))

    assert np.isfinite(flown(0.2, broken).state).all()


def test_robots_are_held_until_their_first_command():
    vehicles = Vehicles(CONFIG)
    vehicles.reset(STARTS, STARTS, 0, 0)
    vehicles.held[:] = True
    for _ in range(500):  # without commands, they would have landed by now
        vehicles.advance()
    np.testing.assert_array_equal(vehicles.state[:, :3], STARTS)
    vehicles.command(0, np.full(4, np.nan))
    assert vehicles.held.all(), "that is no command"
    vehicles.command(0, np.array([0, 0, 0.5, 0]))
    for _ in range(20):
        vehicles.advance()
    assert vehicles.state[0, 2] > STARTS[0][2]
    np.testing.assert_array_equal(vehicles.state[1, :3], STARTS[1])


def test_arrivals_are_the_first_ones():
    vehicles = flown(0.1, starts=GOALS)
    assert vehicles.arrived.tolist() == [vehicles.step_us] * 2
    assert vehicles.at_goal.all()
    assert (flown(0.1).arrived == -1).all()


def test_it_flies_as_the_swarm_does():
    """With commands from the start of each period on, disturbances are those of a swarm."""
    from quad_swarm.robot import Robot, RulePolicy
    from quad_swarm.robot.lockstep import LockstepWorld

    config = make_config("flight", {"clock_skew": 0.0, "radio": {"loss": 0.0, "jitter": 0}}, n_robots=2)
    robots = [Robot(config, k, RulePolicy("none")) for k in range(2)]
    world = LockstepWorld(config, robots)
    world.reset(STARTS, GOALS, 3)
    vehicles = Vehicles(config)
    vehicles.reset(STARTS, GOALS, 3, now=0)
    for _ in range(20):
        world.step()
        for k, robot in enumerate(robots):
            vehicles.command(k, robot.plans.u[0, 0])
        for _ in range(config.substeps):
            vehicles.advance()
        assert vehicles.state[:, POSITION].tobytes() == world.state[0, :, POSITION].tobytes()
    own, pos, vel = world._perceived()
    for k in range(2):
        seen = vehicles.sensed(k)
        assert seen.state.tobytes() == own[k].tobytes()
        assert (seen.pos.tobytes(), seen.vel.tobytes()) == (pos[k].tobytes(), vel[k].tobytes())


def test_steps_of_no_whole_microseconds_are_refused():
    with pytest.raises(ValueError, match="whole microseconds"):
        Vehicles(make_config("flight", {"substeps": 7}))


def test_vehicles_that_are_no_quadrotors_are_refused(monkeypatch):
    """They would level and land as quadrotors do."""
    monkeypatch.setitem(PROBLEMS, "boat", foreign.Boat)
    with pytest.raises(ValueError, match="vehicles in real time level and land as quadrotors do"):
        Vehicles(make_config("flight", planner={"problem": "boat"}))


def test_others_are_sensed_late_and_lost_between_the_periods_too():
    def sensed(**sensing):
        seen = []

        def push(vehicles):
            vehicles.command(0, np.array([0.0, 0.2, 0.0, 0.0]))
            seen.append(vehicles.sensed(1))

        flown(1.0, push, make_config("flight", {**CALM, "sensing": {**CALM["sensing"], **sensing}}, n_robots=2))
        return np.array([one.state[0] for one in seen]), np.array([one.pos[0, 0] for one in seen])

    (own, now), (own_late, late) = sensed(), sensed(others_delay=3)
    assert np.array_equal(own_late, own)
    assert 0.02 < (now - late).max() < 0.1, "a robot that accelerates is ahead of where it would be"
    assert (np.diff(late)[-20:] > 0).all(), "it moves on between two periods"
    _, lost = sensed(gaps=0.999, gap_length=1000)
    assert 0.3 < (now - lost)[-1] < 1, "who was lost at rest is presumed there"
