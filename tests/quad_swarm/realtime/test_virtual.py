"""Robots with clocks and messages of their own fly safely, whatever befalls them."""

import numpy as np
import pytest

from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime import Conditions
from quad_swarm.realtime.virtual import Timing, VirtualFlight
from quad_swarm.robot import Plan, Robot, RulePolicy
from quad_swarm.robot.lockstep import LockstepWorld
from quad_swarm.world.presets import for_scenario, make_config
from quad_swarm.world.scenarios import ScenarioSampler

RULE = "cpa:1.0s:3&soon:0.5|cpa:1.0s:3&stale:4"
S = 1_000_000


def flight_of(n=8, rule=RULE, scenario="symmetric_swap", **options):
    config = for_scenario(make_config("flight", n_robots=n), scenario)
    return VirtualFlight(config, [RulePolicy(rule) for _ in range(n)], **options)


def begin(flight, episode, scenario="symmetric_swap"):
    config = flight.config
    rng = np.random.default_rng([12, episode])
    _, starts, goals, obstacles = ScenarioSampler(scenario, config.n_robots, config.space, config).sample(rng)
    flight.reset(starts, goals, episode, obstacles)


class Rounding(Robot):
    """Receives plans as messages round them."""

    def receive(self, sender, plan):
        super().receive(sender, Plan(plan.stamp, np.rint(plan.positions * 1e3) * 1e-3))


@pytest.mark.parametrize(
    ("n", "scenario", "more"),
    [
        (2, "symmetric_swap", {}),
        (4, "symmetric_swap", {}),
        (8, "symmetric_swap", {}),
        (4, "forest", {}),
        (4, "crossing_traffic", {}),
        (3, "symmetric_swap", {"vehicles": [{"radius": 0.2}, {"radius": 0.5, "quadrotor": "x500"}]}),
    ],
)
def test_without_delays_it_is_the_flight_in_lock_step(n, scenario, more):
    """If everybody asks; a robot that asks nobody plans at once, and its answer is then the newer plan."""
    world = {"clock_skew": 0.0, "radio": {"loss": 0.0, "delay": 0, "jitter": 0, "round_trip": 0}, **more}
    config = for_scenario(make_config("flight", world, n_robots=n), scenario)
    full = RulePolicy("full")
    flight = VirtualFlight(config, [full] * n, timing=Timing(*[(0.0, 0.0)] * 5), late=0.0)
    lockstep = LockstepWorld(config, [Rounding(config, k, full) for k in range(n)])
    sampler = ScenarioSampler(scenario, n, config.space, config)
    _, starts, goals, obstacles = sampler.sample(np.random.default_rng(3))
    lockstep.reset(starts, goals, 7, obstacles)
    flight.reset(starts, goals, 7, obstacles)
    for k in range(1, 61):
        lockstep.step()
        flight.run(k * config.planner.dt)
        assert flight.vehicles.state.tobytes() == lockstep.state[0].tobytes()
    assert np.linalg.norm(lockstep.state[0, :, POSITION] - starts, axis=1).min() > 1.0, "they flew"
    assert flight.result().total.counts["plans received"] >= 60 * n * (n - 1)


@pytest.mark.parametrize("scenario", ["forest", "doorway", "crossing_traffic"])
def test_robots_avoid_obstacles_though_messages_are_lost(scenario):
    flight = flight_of(4, "full", scenario, conditions=Conditions(0.1))
    begin(flight, 1, scenario)
    flight.fly(8.0)
    result = flight.result()
    assert not result.collided
    assert result.at_goal.all()
    assert np.isfinite(flight.vehicles.clearance).any(), "there were obstacles"


FAULTS = {
    "messages lost": (lambda flight: None, {}),
    "a process dies": (lambda flight: flight.at(int(1.5 * S), lambda: flight.kill(2)), {}),
    "a process stands still": (lambda flight: flight.at(int(1.3 * S), lambda: flight.halt(2, 0.3)), {}),
    "two halves": (lambda flight: flight.at(S, lambda: flight.part(range(4), 1.0)), {}),
    "clocks": (lambda flight: None, {"timing": Timing(clock=(-0.02, 0.02))}),
    "twice, late, in another order": (
        lambda flight: None,
        {"conditions": Conditions(0.1, 0.3, 0.0, 0.3), "timing": Timing(message=(0.0003, 0.03))},
    ),
    "malformed": (lambda flight: None, {"conditions": Conditions(0.1, malformed=0.05)}),
    "a frozen state": (lambda flight: flight.at(int(1.3 * S), lambda: flight.freeze(2, 0.3)), {}),
    "a state frozen for good": (lambda flight: flight.at(int(1.3 * S), lambda: flight.freeze(2, 9.0)), {}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_living_do_not_collide(fault):
    happens, options = FAULTS[fault]
    flight = flight_of(**{"conditions": Conditions(0.1), **options})
    begin(flight, 0)
    happens(flight)
    flight.fly(6.0)
    assert flight.vehicles.collisions(~flight.dead) == []
    counts = flight.result().total.counts
    assert counts["periods"] > 8 * 50
    assert counts["plans received"] > 20
    if "frozen" in fault:
        assert counts["state is frozen"] == 1
    if fault == "a process stands still":
        assert counts["missed"] in (5, 6)
    assert not [name for name in counts if name.startswith("errors")]


@pytest.mark.slow
def test_without_messages_they_collide():
    flight = flight_of(rule="none")
    met = []
    for episode in range(3):
        begin(flight, episode)
        flight.fly(8.0)
        met.append(bool(flight.vehicles.collisions()))
    assert any(met)
    assert flight.result().total.counts["requests"] == 0


def test_the_same_seed_is_the_same_flight():
    flight, ends = flight_of(4, conditions=Conditions(0.2, 0.1, 0.1, 0.1)), []
    for _ in range(2):
        begin(flight, 5)
        flight.run(2.0)
        ends.append(flight.vehicles.state.tobytes())
    assert ends[0] == ends[1]


def test_exchanges_arrive_as_distance_lets_them():
    """Three robots stand in a row, 1.5 m and 2.5 m apart."""
    calm = {"noise": dict.fromkeys(("vel", "attitude", "wind", "gust"), 0.0), "mismatch": 0.0}
    sensing = dict.fromkeys(("pos", "vel", "attitude", "others_pos", "others_vel"), 0.0)
    radio = {"range": 2.0, "half_distance": 1.5}
    config = make_config("flight", {**calm, "sensing": sensing, "radio": radio}, n_robots=3)
    flight = VirtualFlight(config, [RulePolicy("full")] * 3)
    places = np.array([[-2.0, 0, 1], [-0.5, 0, 1], [2, 0, 1]])
    flight.reset(places, places, 0)
    flight.run(16.0)
    counts = [one.counts for one in flight.result().statistics]
    for near in counts[:2]:
        periods = near["requests"] / 2
        assert periods > 300
        share = near["plans received"] / periods  # of the one that is near; requests and answers fare alike
        assert abs(share - 0.5) <= 4 * np.sqrt(0.25 / periods)
    assert counts[2]["requests"] > 300
    assert counts[2]["plans received"] == counts[2]["answers"] == 0
    assert not flight.vehicles.flying[2], "a robot that hears nobody lands"


def test_a_robot_that_gets_no_state_lands():
    flight = flight_of(4)
    begin(flight, 0)
    flight.at(S, lambda: flight.freeze(1, 20.0))
    flight.run(8.0)
    assert not flight.vehicles.flying[1]
    assert flight.vehicles.flying[[0, 2, 3]].all()
    assert flight.vehicles.collisions() == []


def test_a_robot_that_lands_in_flight_brakes():
    """Level, it would drift for several metres."""
    flight = flight_of(4)
    begin(flight, 1)
    flight.run(1.5)
    before = flight.vehicles.state[1].copy()
    assert np.linalg.norm(before[3:5]) > 1.5
    flight.loops[1].supervisor.land()
    flight.run(7.0)
    assert not flight.vehicles.flying[1]
    assert np.linalg.norm(flight.vehicles.state[1, :2] - before[:2]) < 2.0
    assert flight.vehicles.collisions() == []
