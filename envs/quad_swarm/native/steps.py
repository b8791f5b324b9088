"""What is measured and counted of every step, in compiled code if there is a compiler, otherwise in NumPy.

Both give bit-identical results. The compiled functions are those of `pairs`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import closest_approach
from quad_swarm.native import pairs
from quad_swarm.native.table import STATISTICS as STATISTICS


class Measured(NamedTuple):
    """What is measured of one step of E swarms.

    :param min_separation: smallest distance of all pairs after the step, (E,) (m)
    :param min_separation_continuous: smallest distance of all pairs during the step, (E,) (m)
    :param separation: distance of each robot to each of its ``others`` after the step, infinity for none, (E, n, m) (m)
    :param separation_continuous: smallest distance to each of them during the step, (E, n, m) (m)
    :param colliding: where ``separation`` is less than the distance of contact, (E, n, m) bool
    :param colliding_continuous: where ``separation_continuous`` is less, (E, n, m) bool
    :param moved: distance between the positions before and after the step, (E, n) (m)
    :param at_goal: whether each robot is within the goal radius, (E, n) bool
    """

    min_separation: np.ndarray
    min_separation_continuous: np.ndarray
    separation: np.ndarray
    separation_continuous: np.ndarray
    colliding: np.ndarray
    colliding_continuous: np.ndarray
    moved: np.ndarray
    at_goal: np.ndarray


def measure(
    positions: np.ndarray,
    goals: np.ndarray,
    contact: float,
    goal_radius: float,
    others: np.ndarray | None = None,
    height: float = 1.0,
    excess: np.ndarray | None = None,
) -> Measured:
    """Measure a step, with straight motion between sub-steps.

    :param positions: positions before the step and after each of the S sub-steps, (S + 1, E, n, 3) (m)
    :param goals: goals, (E, n, 3) (m)
    :param contact: distance below which two robots collide (m)
    :param goal_radius: distance within which a robot is at its goal (m)
    :param others: indices of the others whose distances to return, the robot's own index for none, (E, n, m); None for
        all n - 1 others in ascending order
    :param height: height over width of the ellipsoids around robots: vertical parts of separations are divided by it
    :param excess: what is taken off the separations of robots of other radii, (n, n) (m), see `SwarmConfig.excess`;
        None for nothing
    """
    if excess is not None:
        return _less(measure(positions, goals, contact, goal_radius, None, height), excess, contact, others)
    if height != 1:
        flown = measure(positions, goals, contact, goal_radius, others)
        flat = np.array([1.0, 1.0, 1 / height])
        of_pairs = measure(positions * flat, goals, contact, goal_radius, others)
        return of_pairs._replace(moved=flown.moved, at_goal=flown.at_goal)
    n_swarms, n = goals.shape[:2]
    shape = (n_swarms, n, n - 1) if others is None else others.shape
    empty = np.empty if others is not None else _swarms_last
    if (functions := pairs.compiled()) is not None:
        function = functions.measure_all if others is None else functions.measure
        measured = function(
            m=shape[2], contact=contact, goal_radius=goal_radius, positions=positions, goals=goals, others=others
        )
        if others is None:
            measured = (*measured[:2], *(one.transpose(2, 0, 1) for one in measured[2:6]), *measured[6:])
        return Measured(*measured)
    between = positions[:, :, :, None] - positions[:, :, None]
    start, change = between[:-1], np.diff(between, axis=0)
    closest, _ = closest_approach(start, change, 1.0, _einsum)
    after, during = np.sqrt(_einsum(between[-1], between[-1])), np.sqrt(_einsum(closest, closest).min(axis=0))
    own = np.arange(n)
    after[:, own, own] = during[:, own, own] = np.inf
    separation, separation_continuous = empty(shape), empty(shape)
    if others is None:
        separation[...] = after[:, ~np.eye(n, dtype=bool)].reshape(shape)
        separation_continuous[...] = during[:, ~np.eye(n, dtype=bool)].reshape(shape)
    else:
        separation, separation_continuous = (np.take_along_axis(one, others, axis=2) for one in (after, during))
    moved, to_goal = positions[-1] - positions[0], positions[-1] - goals
    return Measured(
        *(after.min(axis=(1, 2)), during.min(axis=(1, 2))),
        *(separation, separation_continuous, separation < contact, separation_continuous < contact),
        *(np.sqrt(_einsum(moved, moved)), _einsum(to_goal, to_goal) <= goal_radius * goal_radius),
    )


def _less(flown: Measured, excess: np.ndarray, contact: float, others: np.ndarray | None) -> Measured:
    """Take something off all separations.

    :param flown: what was measured with all others
    :param excess: what to take off, (n, n) (m)
    :param contact: distance below which two robots collide (m)
    :param others: indices of the others whose distances to return, see `measure`
    """
    n = len(excess)
    off = excess[~np.eye(n, dtype=bool)].reshape(n, n - 1)
    both = [separation - off for separation in (flown.separation, flown.separation_continuous)]
    least = [separation.min(axis=(1, 2)) for separation in both]
    if others is not None:
        own = np.arange(n)[:, None]
        # A robot's own index stands for nobody
        slots = np.where(others == own, 0, others - (others > own))
        both = [np.where(others == own, np.inf, np.take_along_axis(one, slots, axis=2)) for one in both]
    after, during = both
    return flown._replace(
        min_separation=least[0],
        min_separation_continuous=least[1],
        separation=after,
        separation_continuous=during,
        colliding=after < contact,
        colliding_continuous=during < contact,
    )


class Counted(NamedTuple):
    """What is counted of one step of E swarms, with the names of `quad_swarm.world.swarm.StepReport`.

    :param n_requests: number of requests, (E,) int64
    :param collided: whether two robots collided, in the sense that ends episodes, (E,) bool
    :param collision: whether two robots collided after the step, (E,) bool
    :param collision_continuous: whether two robots collided during the step, (E,) bool
    :param at_goal: (E, n) bool
    :param belief_source: origin of the believed trajectories, 0 without a plan, (E, n, m) int64
    :param plan_age: ages of the believed plans, (E, n, m) int64
    :param plan_status: status of the plans, (E, n) int64
    :param others: indices of the others, -1 for an empty slot, (E, n, m) int64; None without empty slots
    :param moved: mean distance that a robot flew, (E,) (m)
    :param min_separation: smallest distance of two robots after the step, (E,) (m)
    :param min_separation_continuous: smallest distance during the step, (E,) (m)
    """

    n_requests: np.ndarray
    collided: np.ndarray
    collision: np.ndarray
    collision_continuous: np.ndarray
    at_goal: np.ndarray
    belief_source: np.ndarray
    plan_age: np.ndarray
    plan_status: np.ndarray
    others: np.ndarray | None
    moved: np.ndarray
    min_separation: np.ndarray
    min_separation_continuous: np.ndarray


def count(statistics: np.ndarray, step: Counted, failed: int, seconds: float) -> None:
    """Add a step to the statistics of E swarms.

    :param statistics: the statistics, changed in place, (E,) `STATISTICS`
    :param step: the step
    :param failed: smallest status of a plan without a successful solve
    :param seconds: time of the planner for all swarms (s)
    """
    if (functions := pairs.compiled()) is not None:
        functions.count(failed=failed, seconds=seconds, statistics=statistics, **step._asdict())
        return
    s, used = statistics, step.belief_source != 0
    counted = ~(s["reached"] | s["collided"])
    requests = counted * step.n_requests
    possible = used[:1].size if step.others is None else (step.others >= 0).sum(axis=(1, 2))
    s["steps"] += 1
    s["steps_counted"] += counted
    s["requests"] += requests
    s["possible_requests"] += counted * possible
    s["peak_requests"] = np.maximum(s["peak_requests"], requests)
    s["plans_used"] += counted * used.sum(axis=(1, 2))
    s["plan_ages"] += counted * (used * step.plan_age).sum(axis=(1, 2))
    s["requests_flown"] += step.n_requests
    s["path_length"] += counted * step.moved
    s["collided"] |= step.collided
    s["collided_at_steps"] |= step.collision
    s["collided_continuous"] |= step.collision_continuous
    s["at_goals"] = step.at_goal.all(axis=1)
    s["arrived"] |= s["at_goals"] & ~s["collided"]
    s["reached"] |= s["at_goals"]
    s["min_separation"] = np.minimum(s["min_separation"], step.min_separation)
    s["min_separation_continuous"] = np.minimum(s["min_separation_continuous"], step.min_separation_continuous)
    s["planner_failures"] += (step.plan_status >= failed).sum(axis=1)
    s["solve_seconds"] += seconds / max(len(s), 1)


def _swarms_last(shape: tuple[int, ...], dtype: type = float) -> np.ndarray:
    """Return an empty array (E, n, n - 1) in which the values of a pair in all swarms are adjacent. The layout decides
    in which order NumPy sums rewards over pairs, and this one keeps them as they have always been."""
    if shape[0] == 1:
        return np.empty(shape, dtype)
    return np.empty((shape[1] * shape[2], shape[0]), dtype).T.reshape(shape)


def _einsum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dot products in the order of operations of `numpy.einsum`, in which the presets' separations were first
    computed."""
    return (a[..., 0] * b[..., 0] + a[..., 2] * b[..., 2]) + a[..., 1] * b[..., 1]
