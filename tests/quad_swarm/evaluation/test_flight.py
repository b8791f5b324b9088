"""Flights: their figures against episodes flown by hand, and what a flight tells of itself."""

import math

import gymnasium
import numpy as np
import pytest

from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly, fly_steps, run_episodes
from quad_swarm.evaluation.recordings import Recording
from quad_swarm.world.presets import make_config


def condition(policy: str, scenario: str = "asymmetric_swap", linger: int | None = None) -> Condition:
    return Condition(policy, scenario, make_config("paper"), linger=linger)


def test_counts_what_the_environment_shows():
    """The same episodes through Gymnasium, with the definitions of the figures written out again."""
    seeds = [first_episode(0) + k for k in range(3)]
    rows = run_episodes(condition("full"), seeds)
    for seed, row in zip(seeds, rows, strict=True):
        env = gymnasium.make("QuadSwarm-v0", scenario="asymmetric_swap").unwrapped
        env.reset(seed=seed)
        requests, path, closest, arrived_after = 0, 0.0, math.inf, None
        for step in range(1, 101):
            before = env.task.swarm.pos[0].copy()
            *_, terminated, _, info = env.step(np.ones(12, dtype=np.int8))
            closest = min(closest, info["min_separation"])
            if arrived_after is None:
                requests += 12
                path += np.linalg.norm(env.task.swarm.pos[0] - before, axis=1).mean()
                if info["at_goal"].all():
                    arrived_after = step
            if terminated:
                break
        assert row["requests"] == requests
        assert row["steps_counted"] == (arrived_after or step)
        assert row["arrived"] == (arrived_after is not None)
        assert row["path_length"] == pytest.approx(path)
        assert row["min_separation"] == closest


def test_other_seeds_are_other_episodes():
    first, second = (fly(condition("none"), seed) for seed in (0, 1))
    assert not np.array_equal(first.goal, second.goal)
    assert first.requests.shape[1:] == (4, 3)
    assert len(first.state) == len(first.plans) == len(first.requests) + 1


def test_a_rule_beside_does_not_change_the_flight():
    alone, beside = (fly(condition("random:0.5"), 0, other_rule=rule) for rule in ("none", "random:0.5"))
    assert np.array_equal(alone.requests, beside.requests)
    assert np.array_equal(alone.state, beside.state)
    assert 0 < beside.other_requests.mean() < 1
    assert not np.array_equal(beside.requests, beside.other_requests), "generators of its own"


def test_a_collision_ends_what_is_counted_but_not_the_flight():
    one = condition("none", "symmetric_swap", linger=10)
    seeds = [first_episode(0) + k for k in range(40)]
    rows = run_episodes(one, seeds)
    deep = [(seed, row) for seed, row in zip(seeds, rows, strict=True) if row["collided"]]
    assert 10 < len(deep) < 40
    for seed, row in deep[:5]:
        env = gymnasium.make("QuadSwarm-v0", scenario="symmetric_swap").unwrapped
        env.reset(seed=seed)
        terminated = False
        while not terminated:
            *_, terminated, _, _ = env.step(np.zeros(12, dtype=np.int8))
        statistics = env.task.statistics
        assert row["steps_counted"] == statistics.steps_counted[0] < row["steps"]
        assert row["min_separation"] <= statistics.min_separation[0]
        assert not row["arrived"]
        assert row["reached"]
    assert any(row["min_separation"] < 0.5 for _, row in deep), "deeper than in the step of the collision"


def test_episodes_leave_the_batch_when_they_are_over():
    policy, task, rngs = begin(condition("full", linger=3), [first_episode(0) + k for k in range(6)])
    flying, over = [], {}
    for step in fly_steps(policy, task, rngs, linger=3):
        assert len(step.requests) == len(step.episodes) == task.swarm.n_swarms
        flying.append(len(step.episodes))
        for k in np.flatnonzero(step.over):
            over[int(step.episodes[k])] = int(task.statistics.steps[k]) - int(task.statistics.steps_counted[k])
    assert flying == sorted(flying, reverse=True)
    assert over == dict.fromkeys(range(6), 3), "so many steps after the arrival"


def test_a_flight_knows_its_arrival_its_collision_and_its_closest_pair():
    safe = fly(condition("full", "symmetric_swap", linger=10), 0)
    crashes = (fly(condition("none", "symmetric_swap", linger=10), 0, number) for number in range(10))
    crash = next(flight for flight in crashes if flight.collision is not None)
    assert safe.collision is None
    assert safe.arrival == len(safe.requests) - 10
    at_goal = np.linalg.norm(safe.pos[safe.arrival] - safe.goal, axis=-1) <= 0.3
    assert at_goal.all()
    i, j = crash.closest_pair(crash.collision)
    gap = np.linalg.norm(crash.pos[crash.collision, i] - crash.pos[crash.collision, j])
    assert gap == pytest.approx(crash.separation[crash.collision].min())
    assert gap < 0.599 <= crash.separation[crash.collision - 1].min()
    assert crash.min_separation == pytest.approx(crash.separation.min(axis=(1, 2)))
    distance, time = crash.closest_approach
    assert (distance <= crash.separation + 1e-12).all()
    assert (time >= 0).all()


def test_contact_between_steps_is_a_collision_of_a_flight_where_the_world_says_so():
    brushes = make_config("flight", {"planner": {"separation": 0.6}})
    flights = [fly(Condition("none", "symmetric_swap", brushes, solver="rti"), 0, number) for number in range(4)]
    for flight in flights:
        at_steps = flight.separation.min(axis=(1, 2))
        assert (flight.min_separation <= at_steps + 1e-12).all()
        assert flight.collision == 1 + (flight.min_separation[1:] < 0.599).argmax()
    assert any(
        (flight.min_separation < 0.599).sum() > (flight.separation.min(axis=(1, 2)) < 0.599).sum() for flight in flights
    )


def test_contact_with_an_obstacle_is_a_collision_of_a_flight():
    """The pillar is in the way of all, and planners keep no distance."""
    for continuous in (False, True):
        world = {"listed": [{"position": (0, 0, 0), "radius": 0.5}], "margin": 0.0}
        config = make_config("paper", {"obstacles": world, "continuous_collisions": continuous})
        one = Condition("none", "symmetric_swap", config, 60)
        flight, (row,) = fly(one, 0), run_episodes(one, [first_episode(0)])
        assert flight.obstacle_pos is not None
        assert flight.min_obstacle_distance is not None
        assert flight.obstacles[0].radius == 0.5
        assert len(flight.obstacle_pos) == len(flight.min_obstacle_distance) == len(flight.state)
        to_axis = np.hypot(*flight.pos[..., :2].transpose(2, 0, 1)).min(axis=1) - 0.5 - config.radius
        if not continuous:
            np.testing.assert_allclose(flight.min_obstacle_distance, to_axis)
        assert (flight.min_obstacle_distance <= to_axis + 1e-9).all()
        touching = flight.min_obstacle_distance < -config.collision_tolerance
        np.testing.assert_array_equal(flight.colliding, touching | (flight.min_separation < 0.599))
        assert row["collided"] == (flight.collision is not None)


@pytest.mark.parametrize(("scenario", "final"), [("tour", False), ("moving_goals", True)])
def test_flights_to_goals_that_change_arrive_at_the_last(scenario, final):
    condition = Condition("full", scenario, make_config("paper", n_robots=2, max_steps=150))
    flight = fly(condition, 0)
    assert flight.goals.shape == (151, 2, 3)
    assert flight.at_goal.shape == (150, 2)
    (row,) = run_episodes(condition, [first_episode(0)])
    assert row["arrived"]
    assert flight.arrival == row["steps_counted"]
    there = np.linalg.norm(flight.pos[1:] - flight.goal, axis=-1) <= flight.config.goal_radius
    assert np.array_equal(there.all(axis=1), flight.at_goal.all(axis=1)) == (not final), "goals move on"
    recording = Recording.of(flight, "full")
    assert recording.guessed == {"goal"}, "which nobody judges arrivals by"
    assert fly(Condition("full", "random", condition.config), 0).goals is None
