"""E swarms of n robots: who asks whom -> beliefs -> plans -> dynamics. No reward, no episode: that is `task`.

Axes of the n - 1 others of a robot have fewer places where its neighbourhood is limited, see `neighbours`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.native.pairs import advance, resample, separations
from quad_swarm.planner import Planner, Plans, Problems, make_planner
from quad_swarm.plants import make_plant
from quad_swarm.plants.base import MODEL
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.states import like
from quad_swarm.world.beliefs import Beliefs, BeliefSource, Prediction, answered, of_others, other_indices, resampled
from quad_swarm.world.neighbours import Neighbours
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.realisation import Realisation

# So many separations away an empty place shows a robot: nothing that anybody plans comes near it
_NOBODY = 30.0
_FARTHEST = 1e4  # m, of starts and goals; far beyond any room, and well before squares lose their meaning


class StepReport(NamedTuple):
    """What happened in one step of E swarms.

    :param min_separation: smallest distance between two robots after the step, (E,) (m)
    :param min_separation_continuous: smallest distance during the step, each robot moving in a straight line between
        two sub-steps, (E,) (m)
    :param others: who the others are, -1: an empty place, (E, n, n - 1), or (n, n - 1) where all swarms have the same
    :param separation: distance of each robot to each of the others after the step, (E, n, n - 1) (m)
    :param colliding: which of the others each robot collides with after the step, (E, n, n - 1) bool
    :param colliding_continuous: the same at any time during the step
    :param collision: whether two robots collide after the step (the paper's check), (E,) bool
    :param collision_continuous: whether two robots collide at any time during the step, (E,) bool
    :param changed: places that somebody else has after the step, or nobody, (E, n, n - 1) bool; None where that never
        happens
    :param moved: distance that each robot flew, (E, n) (m)
    :param at_goal: whether each robot is within the goal radius, (E, n) bool
    :param belief_source: `BeliefSource` of each believed trajectory, (E, n, n - 1)
    :param plan_age: steps since the plans were made that are believed, (E, n, n - 1); only where one is
    :param plan_status: `PlanStatus` of each robot's plan, (E, n)
    :param iterations: solver iterations of each robot, (E, n)
    :param solve_seconds: wall-clock time of the planner's batch call (s)
    """

    min_separation: np.ndarray
    min_separation_continuous: np.ndarray
    others: np.ndarray
    separation: np.ndarray
    colliding: np.ndarray
    colliding_continuous: np.ndarray
    collision: np.ndarray
    collision_continuous: np.ndarray
    changed: np.ndarray | None
    moved: np.ndarray
    at_goal: np.ndarray
    belief_source: np.ndarray
    plan_age: np.ndarray
    plan_status: np.ndarray
    iterations: np.ndarray
    solve_seconds: float


class Swarm:
    """State, plans and beliefs of E swarms that do not see each other and share one planner call.

    :ivar state: true states, (E, n, 9)
    :ivar goal: goals, (E, n, 3), world frame (m)
    :ivar neighbours: whom each robot perceives
    :ivar chance: errors, gusts and losses that are met
    :ivar beliefs: what each robot believes of the others
    :ivar presumed_beliefs: what each robot's others take it to believe of them: all that they answered has arrived

    :param config: the world
    :param n_swarms: number of swarms E
    :param solver: see `make_planner`
    """

    def __init__(self, config: SwarmConfig, n_swarms: int = 1, solver: str = "auto"):
        self.config = config
        self.planner: Planner = make_planner(config.planner, config.quadrotor, config.n_others + 1, solver)
        n, horizon, dt = config.n_robots, config.planner.horizon, config.planner.dt
        self._plant = make_plant(config.plant, config.quadrotor, dt / config.substeps, n_swarms, n)
        self.state = np.zeros((n_swarms, n, 9))
        self.goal = np.zeros((n_swarms, n, 3))
        self.neighbours = Neighbours(n_swarms, n, config.neighbourhood)
        self.chance = Realisation(config, n_swarms)
        beliefs = (n_swarms, n, horizon, dt, config.memory, config.n_others)
        self.beliefs = Beliefs(*beliefs)
        differ = config.radio.is_random or config.sensing.others
        self.presumed_beliefs = Beliefs(*beliefs) if differ else self.beliefs
        self._plans = Plans.hover(self.state.reshape(-1, 9), horizon)
        # Positions planned in the last steps, the oldest first: what a late answer holds
        late = config.radio.delay + config.radio.jitter
        self._earlier = [self.plans[..., POSITION].copy() for _ in range(late)]
        self._u = np.zeros((n_swarms, n, 4))  # inputs that act
        if not self.neighbours.limited:
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
        """True positions, (E, n, 3), world frame (m)."""
        return self.state[..., POSITION]

    @property
    def vel(self) -> np.ndarray:
        """True velocities, (E, n, 3), world frame (m/s)."""
        return self.state[..., VELOCITY]

    def estimate(self) -> np.ndarray:
        """The state in which each robot takes itself to be, (E, n, 9)."""
        return self.chance.estimate(self.state)

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (m) and velocities (m/s) of the others as each robot sees them, (E, n, n - 1, 3) each, world
        frame."""
        return self.chance.observe(*self._seen_by_all())

    def _seen_by_all(self) -> tuple[np.ndarray, np.ndarray]:
        """The same without what each observer gets wrong in its own way."""
        estimate, neighbours = self.estimate(), self.neighbours
        seen = of_others(estimate, neighbours.others)
        pos, vel = seen[..., POSITION], seen[..., VELOCITY]
        if neighbours.present is not None:
            pos[..., 0] += np.where(neighbours.present, 0.0, _NOBODY * self.config.planner.separation)
        return pos, vel

    def presume(self) -> Prediction:
        """What the others of each robot take it to predict of them as long as it does not ask."""
        return self.presumed_beliefs.predict(*self._seen_by_all())

    @property
    def plans(self) -> np.ndarray:
        """Planned states at stages 0..N, (E, n, N + 1, 9), as of the last step."""
        return self._plans.x.reshape(*self.state.shape[:2], *self._plans.x.shape[1:])

    def planned_positions(self) -> np.ndarray:
        """Planned positions at the beginning of the last step and of the N steps from there, (E, n, N + 1, 3) (m):
        those of `plans`, which begin where a robot's input acts."""
        plans = self.plans[..., POSITION]
        start = self.chance.start
        return plans if start is None else resampled(plans, -start / self.config.substeps)

    def planned_separation(self, steps: int, others: np.ndarray) -> np.ndarray:
        """How far each robot is from each of the others by their plans in each of the ``steps`` after the present
        one, (E, n, n - 1, steps) (m); infinity for an empty place.

        :param others: who they are, see `StepReport`
        """
        plans = self.planned_positions()[..., 2 : 2 + steps, :]
        if self.neighbours.limited:
            between = of_others(plans, np.maximum(others, 0)) - plans[:, :, None]
            return np.where(others[..., None] >= 0, np.sqrt(_dot(between, between)), np.inf)
        i, j = self._pairs
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
        self.neighbours.reset(swarm, starts)
        for beliefs in {self.beliefs, self.presumed_beliefs}:
            beliefs.forget(np.array([swarm]))
        hover = Plans.hover(self.state[swarm], self.config.planner.horizon)
        for mine, fresh in zip(self._plans, hover, strict=True):
            mine[swarm * n : (swarm + 1) * n] = fresh
        for plans in self._earlier:
            plans[swarm] = self.plans[swarm, ..., POSITION]
        self._u[swarm] = 0.0
        self._plant.place(swarm, self.state[swarm])
        if self.config.is_random:
            self.chance.reset(swarm, noise_seed)

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.state, self.goal, self._u = self.state[swarms], self.goal[swarms], self._u[swarms]
        self.neighbours.keep(swarms)
        self.chance.keep(swarms)
        self._plant.keep(swarms)
        for beliefs in {self.beliefs, self.presumed_beliefs}:
            beliefs.keep(swarms)
        self._plans = Plans(*(field[np.repeat(swarms, self.config.n_robots)] for field in self._plans))
        self._earlier = [plans[swarms] for plans in self._earlier]

    def part(self, swarms: np.ndarray) -> Swarm:
        """Some of the swarms (mask) to look at: a copy, but for the planner and the generators."""
        part = copy(self)
        part.beliefs = copy(self.beliefs)
        part.presumed_beliefs = part.beliefs if self.presumed_beliefs is self.beliefs else copy(self.presumed_beliefs)
        part.neighbours, part.chance = copy(self.neighbours), copy(self.chance)
        part._plant = self._plant.fork()
        part.keep(swarms)
        return part

    def fork(self) -> Swarm:
        """A copy of all swarms that flies on by itself, with the disturbances that these would meet."""
        fork = self.part(np.ones(self.n_swarms, dtype=bool))
        fork.chance = self.chance.fork()
        return fork

    def state_dict(self) -> dict[str, Any]:
        """All of the present state, see `load_state_dict`: plain numbers and arrays.

        :raises ValueError: a foreign simulator flies, whose state nobody can read
        """
        if self.config.plant != MODEL:
            raise ValueError(f"plant={self.config.plant!r} keeps its state to itself: only plant={MODEL!r} tells it.")
        presumed = None if self.presumed_beliefs is self.beliefs else self.presumed_beliefs.state_dict()
        return {
            "state": self.state.copy(),
            "goal": self.goal.copy(),
            "input": self._u.copy(),
            "plans": {name: field.copy() for name, field in self._plans._asdict().items()},
            "earlier": [plans.copy() for plans in self._earlier],
            "beliefs": self.beliefs.state_dict(),
            "presumed_beliefs": presumed,
            "chance": self.chance.state_dict(),
            "neighbours": self.neighbours.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state_dict` of a swarm of the same world gave, bit for bit.

        :raises ValueError: the state of other swarms
        """
        self.state = like(self.state, state["state"], "state")
        self.goal = like(self.goal, state["goal"], "goal")
        self._u = like(self._u, state["input"], "input")
        plans = state["plans"]
        self._plans = Plans(
            **{name: like(one, plans[name], f"plans.{name}") for name, one in self._plans._asdict().items()}
        )
        if len(state["earlier"]) != len(self._earlier):
            raise ValueError(f"The state holds {len(state['earlier'])} earlier plans, this world {len(self._earlier)}.")
        self._earlier = [
            like(mine, one, "earlier plans") for mine, one in zip(self._earlier, state["earlier"], strict=True)
        ]
        self.beliefs.load_state_dict(state["beliefs"])
        if self.presumed_beliefs is not self.beliefs:
            self.presumed_beliefs.load_state_dict(state["presumed_beliefs"])
        self.chance.load_state_dict(state["chance"])
        if self.neighbours.limited:
            self.neighbours.load_state_dict(state["neighbours"])

    def step(self, requests: np.ndarray) -> StepReport:
        """Let every robot ask, plan and fly for one step.

        :param requests: whom each robot asks, (E, n, n - 1) bool, the others of a robot in ascending order or as in
            `neighbours`, which has no empty place asked
        """
        believed, source = self._believe(requests)
        started = time.perf_counter()
        self._plans = self.planner.plan(self._problems(believed, source), self._plans)
        solve_seconds = time.perf_counter() - started
        report = self._report(self._fly(), source, solve_seconds)
        return report if self.neighbours.present is None else report._replace(changed=self._look_around())

    def _look_around(self) -> np.ndarray:
        """Forget those who are out of reach now, and begin with those who have come: what a robot knew of one that it
        loses sight of is of no use when they meet again.

        :return: places that somebody else has now, or nobody, (E, n, m) bool
        """
        changed = self.neighbours.update(self.pos, self.vel)
        if changed.any():
            for beliefs in {self.beliefs, self.presumed_beliefs}:
                beliefs.forget_others(changed)
            self.chance.meet(self.neighbours.perceived(changed))
        return changed

    def _believe(self, requests: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What robots believe once answers have arrived, see `Beliefs.update`."""
        radio, others = self.config.radio, self.neighbours.others
        trajectories = advance(self.planned_positions())
        if self._earlier:
            self._earlier = [*map(advance, self._earlier), trajectories]  # each as of now
            trajectories = self._earlier[-1 - radio.delay]
        age = 1 + radio.delay
        if self.presumed_beliefs is not self.beliefs:
            presumed = answered(requests, trajectories, others)
            self.presumed_beliefs.receive(requests, *self._seen_by_all(), presumed, age)
        arriving, lateness = self.chance.arrivals(requests, others)
        received, ages = answered(arriving, trajectories, others), age
        if lateness is not None:
            late = lateness[arriving]
            for k in range(1, radio.jitter + 1):
                received[late == k] = answered(arriving, self._earlier[-1 - radio.delay - k], others)[late == k]
            ages = age + late
        self._earlier = self._earlier[1:]
        return self.beliefs.update(arriving, *self.observe(), received, ages)

    def _problems(self, believed: np.ndarray, source: np.ndarray) -> Problems:
        """What each robot has to plan for, from the time on when its input will act."""
        x, start = self.estimate(), self.chance.start
        if start is not None:
            later = start / self.config.substeps
            x = self.planner.model.ahead(x, self._u, later * self.config.planner.dt)
            resample(believed, later)
        announced = None
        if self.config.planner.right_of_way:
            announced = (source != BeliefSource.CONSTANT_VELOCITY).reshape(-1, source.shape[2])
        others = believed.reshape(-1, *believed.shape[2:])
        return Problems(x.reshape(-1, 9), self.goal.reshape(-1, 3), others, announced=announced)

    def _fly(self) -> list[np.ndarray]:
        """Move the robots by a step; their positions before it and after each sub-step, (E, n, 3) each (m)."""
        chance, before, planned = self.chance, self._u, self._plans.u[:, 0].reshape(self._u.shape)
        positions = [self.pos.copy()]
        for k in range(self.config.substeps):
            self._u = planned if chance.start is None else np.where((chance.start <= k)[..., None], planned, before)
            self.state = self._plant.step(self.state, self._u, chance.air, chance.factors)
            positions.append(self.pos)
        if self.config.is_random:
            kicks = chance.advance()
            if kicks is not None:
                self.state = self.state + kicks
                positions[-1] = self.pos
        return positions

    def _report(self, positions: list[np.ndarray], source: np.ndarray, solve_seconds: float) -> StepReport:
        before, pos = positions[0], positions[-1]
        least, least_continuous, separation, separation_continuous = self._separations(positions)
        limit = 2 * self.config.radius - self.config.collision_tolerance
        shape = self.state.shape[:2]
        return StepReport(
            min_separation=least,
            min_separation_continuous=least_continuous,
            others=self.neighbours.numbers(),
            separation=separation,
            colliding=separation < limit,
            colliding_continuous=separation_continuous < limit,
            collision=least < limit,
            collision_continuous=least_continuous < limit,
            changed=None,
            moved=np.sqrt(_dot(pos - before, pos - before)),
            at_goal=_dot(pos - self.goal, pos - self.goal) <= self.config.goal_radius**2,
            belief_source=source,
            plan_age=self.beliefs.age.copy(),  # a later reset writes into it
            plan_status=self._plans.status.reshape(shape).copy(),  # a later reset writes into the plans
            iterations=self._plans.iterations.reshape(shape).copy(),
            solve_seconds=solve_seconds,
        )

    def _separations(self, positions: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See `quad_swarm.native.pairs.separations`: of all pairs, whether they perceive each other or not."""
        if self.neighbours.limited:
            return separations(np.stack(positions), self.neighbours.others)
        # The same in another order of operations, to which the figures of the presets hold to the last bit
        i, j = self._pairs
        apart = [each[:, i] - each[:, j] for each in positions]
        if len(apart) == 2:
            start, end = apart[0][None], apart[1][None]
        else:
            start, end = np.stack(apart[:-1]), np.stack(apart[1:])
        # Closest point of the segments from start to end to the origin.
        change = end - start
        along = -_dot(start, change) / np.maximum(_dot(change, change), 1e-12)
        closest = start + np.minimum(np.maximum(along, 0.0), 1.0)[..., None] * change
        separation, separation_continuous = np.sqrt(_dot(end[-1], end[-1])), np.sqrt(_dot(closest, closest).min(axis=0))
        return (
            separation.min(axis=-1),
            separation_continuous.min(axis=-1),
            separation[:, self._pair_of],
            separation_continuous[:, self._pair_of],
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
