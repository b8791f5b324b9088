"""E swarms of n robots: who asks whom -> beliefs -> plans -> dynamics. No reward, no episode: that is `task`."""

from __future__ import annotations

import time
from copy import copy, deepcopy
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.planner import Planner, Plans, Problems, make_planner
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.world.beliefs import Beliefs, advance, other_indices
from quad_swarm.world.presets import SwarmConfig

_FARTHEST = 1e4  # m, of starts and goals; far beyond any room, and well before squares lose their meaning


class StepReport(NamedTuple):
    """What happened in one step of E swarms.

    :param min_separation: smallest distance between two robots after the step, (E,) (m)
    :param min_separation_continuous: smallest distance during the step, each robot moving in a straight line, (E,) (m)
    :param separation: distance of each robot to each of the others after the step, (E, n, n - 1) (m)
    :param colliding: which of the others each robot collides with after the step, (E, n, n - 1) bool
    :param colliding_continuous: the same at any time during the step
    :param collision: whether two robots collide after the step (the paper's check), (E,) bool
    :param collision_continuous: whether two robots collide at any time during the step, (E,) bool
    :param moved: distance that each robot flew, (E, n) (m)
    :param at_goal: whether each robot is within the goal radius, (E, n) bool
    :param belief_source: `BeliefSource` of each believed trajectory, (E, n, n - 1)
    :param plan_status: `PlanStatus` of each robot's plan, (E, n)
    :param iterations: solver iterations of each robot, (E, n)
    :param solve_seconds: wall-clock time of the planner's batch call (s)
    """

    min_separation: np.ndarray
    min_separation_continuous: np.ndarray
    separation: np.ndarray
    colliding: np.ndarray
    colliding_continuous: np.ndarray
    collision: np.ndarray
    collision_continuous: np.ndarray
    moved: np.ndarray
    at_goal: np.ndarray
    belief_source: np.ndarray
    plan_status: np.ndarray
    iterations: np.ndarray
    solve_seconds: float


class Swarm:
    """State, plans and beliefs of E swarms that do not see each other and share one planner call.

    :param config: the world
    :param n_swarms: number of swarms E
    :param solver: see `make_planner`
    """

    def __init__(self, config: SwarmConfig, n_swarms: int = 1, solver: str = "auto"):
        self.config = config
        self.planner: Planner = make_planner(config.planner, config.quadrotor, config.n_robots, solver)
        n, horizon = config.n_robots, config.planner.horizon
        self.state = np.zeros((n_swarms, n, 9))
        self.goal = np.zeros((n_swarms, n, 3))
        self.wind = np.zeros((n_swarms, n, 2))
        beliefs = (n_swarms, n, horizon, config.planner.dt, config.memory)
        self.beliefs = Beliefs(*beliefs)
        # What they would believe had every answer arrived, which is what those who answered have to assume
        self.told = Beliefs(*beliefs) if config.radio.loss else self.beliefs
        self._plans = Plans.hover(self.state.reshape(-1, 9), horizon)
        # Positions planned in the last steps, the oldest first: what a late answer holds
        self._earlier = [self.plans[..., POSITION].copy() for _ in range(config.radio.delay)]
        self._noise_rngs = [np.random.default_rng(0) for _ in range(n_swarms)]
        self._pairs = np.triu_indices(n, k=1)
        number = np.zeros((n, n), dtype=int)
        number[self._pairs] = np.arange(len(self._pairs[0]))
        # Which pair each robot is with each of the others
        self._pair_of = np.take_along_axis(number + number.T, other_indices(n), axis=1)

    @property
    def n_swarms(self) -> int:
        """Number of swarms E."""
        return self.state.shape[0]

    @property
    def pos(self) -> np.ndarray:
        """Positions, (E, n, 3), world frame (m)."""
        return self.state[..., POSITION]

    @property
    def vel(self) -> np.ndarray:
        """Velocities, (E, n, 3), world frame (m/s)."""
        return self.state[..., VELOCITY]

    @property
    def plans(self) -> np.ndarray:
        """Planned states at stages 0..N, (E, n, N + 1, 9), as of the last step."""
        return self._plans.x.reshape(*self.state.shape[:2], *self._plans.x.shape[1:])

    def planned_separation(self, steps: int) -> np.ndarray:
        """How far each robot is from each of the others by their plans in each of the ``steps`` after the present
        one, (E, n, n - 1, steps) (m)."""
        i, j = self._pairs
        plans = self.plans[..., 2 : 2 + steps, POSITION]
        between = plans[:, i] - plans[:, j]
        return np.sqrt(_dot(between, between))[:, self._pair_of]

    def reset(self, swarm: int, starts: np.ndarray, goals: np.ndarray, noise_seed: int = 0) -> None:
        """Put one swarm's robots at rest at ``starts`` and give them ``goals``, both (n, 3), world frame (m).

        :param noise_seed: seed of the disturbances; without any, it does not matter
        :raises ValueError: starts or goals are not n finite points
        """
        n = self.config.n_robots
        starts, goals = _points("starts", starts, n), _points("goals", goals, n)
        self.state[swarm] = 0.0
        self.state[swarm, :, POSITION] = starts
        self.goal[swarm] = goals
        for beliefs in {self.beliefs, self.told}:
            beliefs.forget(np.array([swarm]))
        hover = Plans.hover(self.state[swarm], self.config.planner.horizon)
        for mine, fresh in zip(self._plans, hover, strict=True):
            mine[swarm * n : (swarm + 1) * n] = fresh
        for plans in self._earlier:
            plans[swarm] = self.plans[swarm, ..., POSITION]
        if self.config.is_random:
            rng = self._noise_rngs[swarm] = np.random.default_rng(noise_seed)
            direction = rng.uniform(0, 2 * np.pi)
            self.wind[swarm] = self.config.noise.wind * np.array([np.cos(direction), np.sin(direction)])

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.state, self.goal, self.wind = self.state[swarms], self.goal[swarms], self.wind[swarms]
        for beliefs in {self.beliefs, self.told}:
            beliefs.keep(swarms)
        self._plans = Plans(*(field[np.repeat(swarms, self.config.n_robots)] for field in self._plans))
        self._earlier = [plans[swarms] for plans in self._earlier]
        self._noise_rngs = [rng for rng, kept in zip(self._noise_rngs, swarms, strict=True) if kept]

    def part(self, swarms: np.ndarray) -> Swarm:
        """Some of the swarms (mask) to look at: a copy, but for the planner and the generators."""
        part = copy(self)
        part.beliefs = copy(self.beliefs)
        part.told = part.beliefs if self.told is self.beliefs else copy(self.told)
        part.keep(swarms)
        return part

    def fork(self) -> Swarm:
        """A copy of all swarms that flies on by itself, with the disturbances that these would meet."""
        fork = self.part(np.ones(self.n_swarms, dtype=bool))
        fork._noise_rngs = deepcopy(self._noise_rngs)
        return fork

    def step(self, requests: np.ndarray) -> StepReport:
        """Let every robot ask, plan and fly for one step.

        :param requests: whom each robot asks, (E, n, n - 1) bool, the others of a robot in ascending order
        """
        arriving, plans = self._answers(requests)
        age = 1 + self.config.radio.delay
        if self.told is not self.beliefs:
            self.told.update(requests, self.pos, self.vel, plans, age)
        believed, source = self.beliefs.update(arriving, self.pos, self.vel, plans, age)
        problems = Problems(
            x=self.state.reshape(-1, 9), goal=self.goal.reshape(-1, 3), others=believed.reshape(-1, *believed.shape[2:])
        )
        started = time.perf_counter()
        self._plans = self.planner.plan(problems, self._plans)
        solve_seconds = time.perf_counter() - started

        before = self.pos.copy()
        u = self._plans.u[:, 0].reshape(*self.state.shape[:2], -1)
        self.state = self.planner.model.step(self.state, u, self.wind)
        if self.config.noise:
            self.state = self.state + self._disturbances()
        return self._report(before, source, solve_seconds)

    def _answers(self, requests: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whose plans arrive where, (E, n, n - 1) bool, and the plans as of one step ago, (E, n, N + 1, 3) (m)."""
        radio, plans = self.config.radio, self.plans[..., POSITION]
        if radio.loss:
            kept = [rng.random(requests.shape[1:]) >= radio.loss for rng in self._noise_rngs]
            requests = requests & np.stack(kept)
        if radio.delay:
            self._earlier.append(plans.copy())
            plans = self._earlier.pop(0)
            for _ in range(radio.delay):
                plans = advance(plans)
        return requests, plans

    def _disturbances(self) -> np.ndarray:
        noise = self.config.noise
        scale = np.repeat([noise.pos, noise.vel, noise.attitude], 3)
        scale[8] = 0.0  # the yaw is held
        return np.stack([rng.normal(size=self.state.shape[1:]) for rng in self._noise_rngs]) * scale

    def _report(self, before: np.ndarray, source: np.ndarray, solve_seconds: float) -> StepReport:
        i, j = self._pairs
        pos = self.pos
        start, end = before[:, i] - before[:, j], pos[:, i] - pos[:, j]
        # Closest point of the segment from start to end to the origin.
        change = end - start
        along = -_dot(start, change) / np.maximum(_dot(change, change), 1e-12)
        closest = start + np.minimum(np.maximum(along, 0.0), 1.0)[..., None] * change
        separation, separation_continuous = np.sqrt(_dot(end, end)), np.sqrt(_dot(closest, closest))
        limit = 2 * self.config.radius - self.config.collision_tolerance
        shape = self.state.shape[:2]
        return StepReport(
            min_separation=separation.min(axis=-1),
            min_separation_continuous=separation_continuous.min(axis=-1),
            separation=separation[:, self._pair_of],
            colliding=(separation < limit)[:, self._pair_of],
            colliding_continuous=(separation_continuous < limit)[:, self._pair_of],
            collision=(separation < limit).any(axis=-1),
            collision_continuous=(separation_continuous < limit).any(axis=-1),
            moved=np.sqrt(_dot(pos - before, pos - before)),
            at_goal=_dot(pos - self.goal, pos - self.goal) <= self.config.goal_radius**2,
            belief_source=source,
            plan_status=self._plans.status.reshape(shape).copy(),  # a later reset writes into the plans
            iterations=self._plans.iterations.reshape(shape).copy(),
            solve_seconds=solve_seconds,
        )


def _points(name: str, points: Any, count: int) -> np.ndarray:
    """Points as an array, (count, 3) (m).

    :raises ValueError: another shape, no numbers, or farther away than `_FARTHEST`
    """
    try:
        array = np.asarray(points, dtype=float)
        valid = array.shape == (count, 3) and bool((np.abs(array) <= _FARTHEST).all())
    except (TypeError, ValueError, OverflowError):
        valid = False
    if not valid:
        raise ValueError(
            f"{name} must be {count} finite points, shape ({count}, 3), within {_FARTHEST:.0f} m; got {shown(points)}."
        )
    return array


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)
