"""Computations for every pair of robots in every step, in compiled code if there is a compiler, otherwise in NumPy.

Both give bit-identical results. ``pairs`` stands for any leading axes that end with the robots and their others; N is
the number of stages of a plan.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import closest_approach, dot, length
from quad_swarm.native.table import compiled


def remember(
    remembered: np.ndarray, age: np.ndarray, pos: np.ndarray, memory: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Advance remembered plans by a step.

    :param remembered: positions from the last step on, (pairs, N + 1, 3) (m)
    :param age: steps since the plans were made, N or more without a plan, (pairs) int64
    :param pos: observed current positions of the others, (pairs, 3) (m)
    :param memory: maximum error of plans that are still believed (m)
    :return: positions from now on, whose last segment continues in a straight line, ages, errors (m), and which plans
        are believed, bool
    """
    if (functions := compiled()) is not None:
        return functions.remember(memory=memory, pos=pos, remembered=remembered, age=age)
    later, age = advance(remembered), age + 1
    error = length(later[..., 0, :] - pos)
    return later, age, error, (age < remembered.shape[-2] - 1) & (error <= memory)


def believe(
    pos: np.ndarray,
    vel: np.ndarray,
    remembered: np.ndarray,
    remembers: np.ndarray,
    dt: float,
    stages: Sequence[int] | None = None,
) -> np.ndarray:
    """Compute believed trajectories: remembered ones, or otherwise constant velocities.

    :param pos: current positions, (pairs, 3) (m)
    :param vel: current velocities, (pairs, 3) (m/s)
    :param remembered: remembered positions from now on, (pairs, N + 1, 3) (m)
    :param remembers: which remembered trajectories are believed, (pairs) bool
    :param dt: length of a stage (s)
    :param stages: indices among the next N steps, counting from 0; None for all
    :return: positions, (pairs, stages, 3) (m)
    """
    chosen = _first(remembered.shape[-2] - 1) if stages is None else np.array(stages, dtype=np.int64)
    if (functions := compiled()) is not None:
        return functions.believe(dt=dt, chosen=chosen, pos=pos, vel=vel, remembered=remembered, remembers=remembers)
    steady = pos[..., None, :] + (dt * (chosen + 1))[:, None] * vel[..., None, :]
    return np.where(remembers[..., None, None], remembered.take(chosen + 1, axis=-2), steady)


class Known(NamedTuple):
    """What robots know about the others before answers arrive, with the shapes of `believe` and `remember`."""

    pos: np.ndarray
    vel: np.ndarray
    remembers: np.ndarray
    age: np.ndarray
    remembered: np.ndarray


def receive(
    known: Known,
    arriving: np.ndarray,
    received: np.ndarray,
    age: np.ndarray | int,
    dt: float,
    memory: bool,
    predicts: bool = True,
    misfit: float = np.inf,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Take received plans instead of older ones. They are believed unless they were made N or more steps ago or
    contradict the observation.

    :param known: what is known; received plans are written into ``known.remembered``, which is contiguous, if there is
        a memory
    :param arriving: whose plans arrive, (pairs) bool
    :param received: these plans in the order of ``arriving``, (number of answers, N + 1, 3) (m)
    :param age: steps since each of them was made, (number of answers,), of which those that are older than the known
        plan are ignored; or one number for all
    :param dt: length of a stage (s)
    :param memory: whether received plans are remembered
    :param predicts: whether to return more than the ages
    :param misfit: largest distance between the observed position and that of a received plan which is believed (m)
    :return: ages of the newest plans, believed positions at the next N steps, (pairs, N, 3) (m), and where they come
        from, (pairs): 2 for a plan that arrives now, 1 for a remembered one, 0 for a constant velocity
    :raises ValueError: if ``known.remembered`` cannot be written into
    """
    ages = age if isinstance(age, np.ndarray) else None
    if memory:
        _check_in_place("known.remembered", known.remembered)
    if (functions := compiled()) is not None:
        return functions.receive(
            age=0 if ages is not None else age,
            dt=dt,
            misfit=misfit,
            arriving=arriving,
            received=received if len(received) else None,
            ages=ages if ages is not None and len(ages) else None,
            pos=known.pos,
            vel=known.vel,
            remembers=known.remembers,
            known_age=known.age,
            known=known.remembered,
            remembered=known.remembered if memory else None,
            believed=predicts,
            source=predicts,
        )
    if ages is not None:
        newer = ages <= known.age[arriving]
        arriving, received, age = arriving.copy(), received[newer], ages[newer]
        arriving[arriving] = newer
    if memory:
        known.remembered[arriving] = received
    next_age = known.age.copy()
    next_age[arriving] = age
    if not predicts:
        return next_age, None, None
    remembers = known.remembers & ~arriving
    believed = believe(known.pos, known.vel, known.remembered, remembers, dt)
    fits = (age < received.shape[-2] - 1) & (length(received[:, 0] - known.pos[arriving]) <= misfit)
    arriving = arriving.copy()
    arriving[arriving] = fits
    believed[arriving] = received[fits, 1:]
    return next_age, believed, np.where(arriving, 2, np.where(remembers, 1, 0))


def _check_in_place(name: str, array: np.ndarray) -> None:
    """Check an array that is changed in place, of which the compiled code must not get a copy."""
    if array.dtype != np.float64 or not array.flags.c_contiguous or not array.flags.writeable:
        raise ValueError(
            f"{name} is changed in place: it must be contiguous, writable and of the type float64, not {array.dtype}."
        )


@functools.cache
def _first(count: int) -> np.ndarray:
    return np.arange(count)


def approach(
    own: np.ndarray,
    plan: np.ndarray,
    pos: np.ndarray,
    vel: np.ndarray,
    remembered: np.ndarray,
    remembers: np.ndarray,
    dt: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the distances between the robots' plans and believed trajectories. The other arguments are those of
    `believe`.

    :param own: positions of the robots, (E, n, 3) (m)
    :param plan: planned positions at the next N steps relative to ``own``, (E, n, N, 3) (m)
    :return: the smallest distance (m), the first stage at which it is reached, counting from 0, and the distance at the
        last stage (m), each (E, n, n - 1)
    """
    if (functions := compiled()) is not None:
        return functions.approach(
            dt=dt, own=own, plan=plan, pos=pos, vel=vel, remembered=remembered, remembers=remembers
        )
    expected = believe(pos, vel, remembered, remembers, dt) - own[:, :, None, None]
    distances = length(plan[:, :, None] - expected)
    return distances.min(axis=-1), distances.argmin(axis=-1), distances[..., -1]


def nearest_obstacle(
    trajectories: np.ndarray,
    radii: np.ndarray,
    centres: np.ndarray,
    factors: np.ndarray,
    radius: np.ndarray,
    present: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the points of trajectories that are nearest to the surface of an obstacle.

    :param trajectories: positions at the next N steps, (E, pairs, N, 3), world frame (m)
    :param radii: radii of the robots that fly them, (E, pairs) (m)
    :param centres: where the obstacles will be, (E, obstacles, N, 3), world frame (m)
    :param factors: factors of their metrics, (E, obstacles, 3), see `quad_swarm.world.obstacles`
    :param radius: radii of the obstacles, (E, obstacles) (m)
    :param present: which obstacles there are, (E, obstacles) bool
    :return: distances between the surfaces there, infinite without obstacles (m), the first steps at which they are
        reached, counting from 0, (E, pairs) each, and directions to the obstacles, (E, pairs, 3)
    """
    if (functions := compiled()) is not None:
        return functions.nearest_obstacle(
            trajectories=trajectories, radii=radii, centres=centres, factors=factors, radius=radius, present=present
        )
    between = factors[:, None, :, None] * (centres[:, None] - trajectories[:, :, None])
    distance = length(between)
    gaps = distance - (radius[:, None] + radii[..., None])[..., None]
    gaps[np.broadcast_to(~present[:, None, :, None], gaps.shape)] = np.inf
    flat = gaps.reshape(*radii.shape, gaps.shape[2] * gaps.shape[3])
    nearest = flat.argmin(axis=-1)[..., None]
    gap = np.take_along_axis(flat, nearest, axis=-1)[..., 0]
    away = np.take_along_axis(distance.reshape(flat.shape), nearest, axis=-1)
    towards = np.take_along_axis(between.reshape(*flat.shape, 3), nearest[..., None], axis=-2)[..., 0, :]
    towards = np.where(np.isfinite(gap)[..., None], towards / np.maximum(away, 1e-6), 0.0)
    return gap, nearest[..., 0] % trajectories.shape[2], towards


def resample(trajectories: np.ndarray, later: np.ndarray) -> None:
    """Resample trajectories at later times, in place, by linear interpolation. The last segment continues in a straight
    line.

    :param trajectories: believed trajectories of each robot's others, contiguous, (E, n, n - 1, N, 3) (m)
    :param later: time shift as a fraction of a step, (E, n) in [0, 1)
    :raises ValueError: if the trajectories cannot be written into
    """
    _check_in_place("trajectories", trajectories)
    if (functions := compiled()) is not None:
        functions.resample(later=later, trajectories=trajectories)
        return
    pieces = np.diff(trajectories, axis=-2)
    pieces *= later[..., None, None, None]
    trajectories[..., :-1, :] += pieces
    trajectories[..., -1, :] += pieces[..., -1, :]


def keep_right(
    x: np.ndarray, others: np.ndarray, known: np.ndarray, width: float, dt: float, fade: float, slow: float
) -> tuple[np.ndarray, np.ndarray]:
    """Enlarge other robots on one side, see `quad_swarm.planner.right_of_way`.

    :param x: states of B robots, (B, 9)
    :param others: positions of their others, (B, m, N, 3) (m)
    :param known: which others' plans are known, (B, m) bool
    :param width: distance by which the others are enlarged (m)
    :param dt: length of a stage (s)
    :param fade: time before the closest approach from which the effect fades (s)
    :param slow: closing speed below which the effect is reduced (m/s)
    :return: shifted positions of the others, (B, m, N, 3) (m), and additional clearances, (B, m, N) (m)
    """
    if (functions := compiled()) is not None:
        others, clearance = np.array(others, order="C"), np.zeros(others.shape[:-1])
        functions.keep_right(
            width=width, dt=dt, fade=fade, slow=slow, x=x, known=known, others=others, clearance=clearance
        )
        return others, clearance
    velocity = (others[:, :, 1] - others[:, :, 0]) / dt
    pos = others[:, :, 0] - dt * velocity - x[:, None, :3]
    vel = velocity - x[:, None, 3:6]
    speed = np.hypot(vel[..., 0], vel[..., 1])
    _, time = closest_approach(pos, vel, fade)
    grown = width * known * (time / fade) * np.clip(speed / slow, 0.0, 1.0)
    left = np.stack([vel[..., 1], -vel[..., 0], np.zeros_like(speed)], axis=-1) / np.maximum(speed, 1e-9)[..., None]
    return others + (grown[..., None] * left)[:, :, None], np.repeat(grown[..., None], others.shape[2], axis=2)


def neighbours(
    pos: np.ndarray,
    vel: np.ndarray,
    others: np.ndarray,
    present: np.ndarray,
    limit: float,
    look_ahead: float,
    errors: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Update the neighbours of each robot. A robot that remains a neighbour keeps its slot, see
    `quad_swarm.world.neighbours`.

    :param pos: positions, (E, n, 3) (m)
    :param vel: velocities, (E, n, 3) (m/s)
    :param others: index of the robot that was in each slot, the robot's own index in empty slots, (E, n, m) int64
    :param present: whether each slot was taken, (E, n, m) bool
    :param limit: maximum distance of a neighbour (m), infinity for any distance
    :param look_ahead: time over which the smallest distance at constant velocities decides which robots are nearest
        (s); 0 for the current distance
    :param errors: errors of the position and the velocity that each robot observes of the others in its slots,
        (E, n, m, 6) (m and m/s); None for none
    :return: the new ``others`` and ``present``, and the slot of the robot at each of its neighbours, -1 without one,
        (E, n, m)
    """
    if (functions := compiled()) is not None:
        others, present = np.array(others, order="C"), np.array(present, order="C")
        reverse = functions.neighbours(
            limit=limit, look_ahead=look_ahead, pos=pos, vel=vel, errors=errors, others=others, present=present
        )
        return others, present, reverse
    n_swarms, n, m = others.shape
    numbers = np.arange(n)
    apart, along = (each[:, :, None] - each[:, None] for each in (pos, vel))
    if errors is not None:
        where = np.nonzero(present)
        seen = (*where[:2], others[where])
        apart[seen] -= errors[where][:, :3]
        along[seen] -= errors[where][:, 3:]
    within = dot(apart, apart) <= limit * limit
    within[:, numbers, numbers] = False
    apart, _ = closest_approach(apart, along, look_ahead)
    nearest = np.argsort(np.where(within, dot(apart, apart), np.inf), axis=-1, kind="stable")[..., :m]
    near = np.zeros(within.shape, dtype=bool)
    np.put_along_axis(near, nearest, np.take_along_axis(within, nearest, axis=-1), axis=-1)

    stays = present & np.take_along_axis(near, others, axis=-1)
    swarms, robots, slots = np.nonzero(stays)
    near[swarms, robots, others[swarms, robots, slots]] = False  # the remaining ones are new
    others = np.where(stays, others, numbers[:, None])
    free = np.argsort(stays, axis=-1, kind="stable")  # free slots first
    swarms, robots, come = np.nonzero(near)
    slots = free[swarms, robots, (near.cumsum(axis=-1) - 1)[swarms, robots, come]]
    others[swarms, robots, slots] = come
    present = stays.copy()
    present[swarms, robots, slots] = True

    seen = others[np.arange(n_swarms)[:, None, None], others] == numbers[:, None, None]
    seen &= present[np.arange(n_swarms)[:, None, None], others]
    reverse = np.where(present & seen.any(axis=-1), seen.argmax(axis=-1), -1)
    return others, present, reverse


def advance(trajectory: np.ndarray) -> np.ndarray:
    """Advance trajectories (..., K, 3) by a step; the last segment continues in a straight line."""
    later = np.empty_like(trajectory)
    later[..., :-1, :] = trajectory[..., 1:, :]
    later[..., -1, :] = 2 * trajectory[..., -1, :] - trajectory[..., -2, :]
    return later
