"""The interface of solvers, and the planner with its fallback chain, which always yields a flyable plan."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.geometry import length, wrapped
from quad_swarm.planner.model import ProblemModel
from quad_swarm.planner.problem import PlannerConfig, Problems
from quad_swarm.planner.right_of_way import keep_right
from quad_swarm.quadrotor import N_INPUTS, N_STATES, POSITION, VELOCITY, QuadrotorModel, VehicleModel


class Solution(NamedTuple):
    """Solutions of a batch of B problems.

    :param x: states at stages 0..N, (B, N + 1, 9); stage 0 is the current state
    :param u: inputs at stages 0..N-1, (B, N, 4)
    :param success: whether each problem was solved to the solver's tolerance, (B,) bool; x and u are finite then
    :param iterations: number of iterations for each problem, (B,) int
    """

    x: np.ndarray
    u: np.ndarray
    success: np.ndarray
    iterations: np.ndarray


class Solver(Protocol):
    """Solver of batches of problems. It reports failures as data; if it raises, or returns no `Solution` of the
    problems' shapes, all its problems count as failed."""

    name: str

    def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """Solve a batch of problems.

        :param problems: the batch
        :param x_guess: initial guess of the states at stages 0..N, (B, N + 1, 9)
        :param u_guess: initial guess of the inputs, (B, N, 4)
        """
        ...


class PlanStatus(IntEnum):
    """Level of the fallback chain that a plan comes from.

    SOLVED: the solver, with the last plan as initial guess. RETRIED: the solver, with a cold initial guess. SHIFTED:
    the continuation of the last plan. BRAKING: braking to hover.
    """

    SOLVED = 0
    RETRIED = 1
    SHIFTED = 2
    BRAKING = 3


_TYPES = (np.dtype(float), np.dtype(float), np.dtype(bool), np.dtype(np.int64))  # of a solution's arrays
SAME_HEADING = 1e-6  # rad by which headings may differ that are the same
_LARGEST = 1e9  # state or input, beyond which a solver has diverged
_SOLVED, _BRAKING = int(PlanStatus.SOLVED), int(PlanStatus.BRAKING)  # NumPy is slow with enumerations


class Plans(NamedTuple):
    """Plans of B robots.

    :param x: states at stages 0..N, (B, N + 1, 9)
    :param u: inputs at stages 0..N-1, (B, N, 4)
    :param age: steps since each plan came from the solver, (B,) int
    :param status: `PlanStatus` of each plan, (B,) int
    :param iterations: number of solver iterations, (B,) int
    """

    x: np.ndarray
    u: np.ndarray
    age: np.ndarray
    status: np.ndarray
    iterations: np.ndarray

    @classmethod
    def hover(cls, x: np.ndarray, horizon: int) -> Plans:
        """Return the plans of robots at rest before their first solve, which is to stay in place."""
        count = x.shape[0]
        return cls(
            x=np.repeat(x[:, None], horizon + 1, axis=1),
            u=np.zeros((count, horizon, N_INPUTS)),
            age=np.zeros(count, dtype=np.int64),
            status=np.zeros(count, dtype=np.int64),
            iterations=np.zeros(count, dtype=np.int64),
        )

    @classmethod
    def steady(cls, x: np.ndarray, horizon: int, dt: float, late: np.ndarray | None = None) -> Plans:
        """Return the plans of robots in flight before their first solve, made a step ago, which is to keep their
        velocity, as others expect that know no plan.

        :param x: states now, (B, 9)
        :param horizon: number of stages N
        :param dt: length of a stage (s)
        :param late: when inputs take effect, as a fraction of a step, (B,); None if all do so at once
        """
        plans = cls.hover(x, horizon)
        if np.count_nonzero(x[:, VELOCITY]):
            times = dt * (np.arange(horizon + 1) - 1 + (np.zeros((len(x), 1)) if late is None else late[:, None]))
            plans.x[..., POSITION] += times[..., None] * x[:, None, VELOCITY]
        return plans


class Planner:
    """Planner with warm-started solves and a fallback chain: solve, retry cold, continue the last plan, brake
    (Sec. III-B). All levels plan with the same dynamics.

    The level is chosen independently for each robot, so a failure never affects another robot's plan.

    :ivar rate: what computes the costs of plans after each call, see `PlanCost`; None for nothing
    :ivar costs: these costs, (B,)
    :ivar prepare: what restates problems before they are solved, see `OptimalControlProblem.prepare`; None for nothing
    :ivar checks: whether `plan` refuses invalid arrays; otherwise, problems whose numbers are not finite fail and
        brake, as in the steps of swarms, which never raise

    :param solver: the solver
    :param model: discrete dynamics, for the levels without a solver
    :param config: horizon and limits
    :param n_others: maximum number of bodies to avoid that the solver considers, those that the robot's last plan comes
        closest to; None for all
    """

    def __init__(self, solver: Solver, model: VehicleModel, config: PlannerConfig, n_others: int | None = None):
        self.solver = solver
        self.model = model
        self.config = config
        self.n_others = n_others
        self.checks = True
        self.rate: Callable[[Problems, np.ndarray, np.ndarray], np.ndarray] | None = None
        self.prepare: Callable[[Problems], Problems] | None = None
        self.costs: np.ndarray | None = None

    def plan(self, problems: Problems, previous: Plans) -> Plans:
        """Solve a batch of B problems; solver failures never raise.

        Quadrotors may have any heading, and turn to that of their problem the short way. Limits of roll and pitch hold
        along the heading.

        :param problems: the batch
        :param previous: plans of the same robots in the previous step
        :return: the new plans
        :raises ValueError: if an array has another shape or type than `Problems` and `Plans` say, or holds numbers that
            are not finite; not without `checks`
        """
        if self.checks:
            problems, previous = self.checked(problems, previous)
        if (cruise := self.config.cruise_distance) is not None:
            problems = problems._replace(goal=nearer(problems.x[:, POSITION], problems.goal, cruise))
        if problems.disturbance is not None and isinstance(self.model, QuadrotorModel):
            problems = problems._replace(steady_input=self.model.params.steady_input(problems.disturbance))
        if problems.shape is None and self.config.downwash != 1:
            flat = np.ones((*problems.others.shape[:2], 3))
            flat[..., 2] = 1 / self.config.downwash
            problems = problems._replace(shape=flat)
        heading = problems.heading if self.config.max_yaw_rate else None
        turns = np.count_nonzero(problems.x[:, 8]) or (heading is not None and np.count_nonzero(heading))
        if isinstance(self.model, ProblemModel) or not turns:
            return self._plan(problems, previous)
        # Within, roll and pitch are those about the world's axes, to which the problem has no yaw, and the yaw is that
        # from the heading. Only robots with either are turned, so that a plan does not depend on the batch it is in
        aims = np.zeros(len(problems.x)) if heading is None else heading
        rows = np.flatnonzero((problems.x[:, 8] != 0) | (aims != 0))
        yaw, old, aim = problems.x[rows, 8], previous.x[rows, :, 8], aims[rows]
        with np.errstate(invalid="ignore"):  # an infinite yaw fails like other states that are not finite
            left = wrapped(yaw - aim)
        start, before, u_before = problems.x.copy(), previous.x.copy(), previous.u.copy()
        start[rows], before[rows] = turned(start[rows], -yaw), turned(before[rows], -old)
        start[rows, 8], before[rows, :, 8] = left, old + (left - yaw)[:, None]
        u_before[rows] = turned(u_before[rows], -old[:, :-1], 0)
        plans = self._plan(problems._replace(x=start), previous._replace(x=before, u=u_before))
        planned = plans.x[rows, :-1, 8] if self.config.max_yaw_rate else np.repeat(left[:, None], old.shape[1] - 1, 1)
        planned = planned + aim[:, None]
        u, limit = turned(plans.u[rows], planned, 0), self.config.max_tilt
        u[..., :2] = np.clip(u[..., :2], -limit, limit)
        pushed = None if problems.disturbance is None else problems.disturbance[rows]
        plans.u[rows], plans.x[rows] = u, self.model.rollout(problems.x[rows], u, pushed)
        return plans

    def checked(self, problems: Problems, previous: Plans) -> tuple[Problems, Plans]:
        """Check the arrays of a call and convert them to their types, see `plan`."""
        stages, kept = self.config.horizon, self.n_others
        for name, value, kind in (("problems", problems, Problems), ("previous", previous, Plans)):
            if not isinstance(value, kind):
                remedy = "; before the first solve, Plans.hover(x, horizon)" if kind is Plans else ""
                raise ValueError(f"{name}={shown(value)}: pass {kind.__name__}{remedy}.")
        count = shape[0] if len(shape := _shape(problems.x)) == 2 else 1
        n_others = shape[1] if len(shape := _shape(problems.others)) == 4 else 0
        taken = n_others if kept is None else min(n_others, kept)
        if taken != (expected := getattr(getattr(self.solver, "problem", None), "n_others", taken)):
            n_others = expected  # what the message asks for
        x = _array("x", problems.x, (count, N_STATES))
        goal = _array("goal", problems.goal, (count, 3))
        others = _array("others", problems.others, (count, n_others, stages, 3))
        about: dict[str, np.ndarray | None] = {}
        for name, more, dtype in (
            ("clearance", (stages,), _TYPES[0]),
            ("announced", (), np.dtype(bool)),
            ("shape", (3,), _TYPES[0]),
            ("size", (), _TYPES[0]),
            ("penalty", (), _TYPES[0]),
        ):
            given = getattr(problems, name)
            about[name] = None if given is None else _array(name, given, (count, n_others, *more), dtype)
            shaped = getattr(getattr(self.solver, "problem", None), "shaped", True)
            if given is not None and name in ("shape", "size", "penalty") and not shaped:
                raise ValueError(f"{name}: this planner avoids spheres only; create it with obstacles or downwash.")
        if about["penalty"] is not None and (about["penalty"] <= 0).any():
            raise ValueError("penalty: factors of the weight of violations must be positive.")
        about |= self._checked_of_robots(problems, x)
        return Problems(x, goal, others, **about), Plans(
            # The last plan is a guess, so that numbers which are not finite only cost a retry
            _array("previous.x", previous.x, (count, stages + 1, N_STATES), finite=False),
            _array("previous.u", previous.u, (count, stages, N_INPUTS), finite=False),
            _array("previous.age", previous.age, (count,), np.dtype(np.int64)),
            _array("previous.status", previous.status, (count,), np.dtype(np.int64)),
            _array("previous.iterations", previous.iterations, (count,), np.dtype(np.int64)),
        )

    def _checked_of_robots(self, problems: Problems, x: np.ndarray) -> dict[str, np.ndarray]:
        """Check the arrays of a call that some planners alone use, and return those that are given."""
        count, stages = len(x), self.config.horizon
        shapes = {"reference": (stages, 3), "reference_weight": (stages,), "disturbance": (3,), "heading": ()}
        given = {
            name: _array(name, array, (count, *shape))
            for name, shape in shapes.items()
            if (array := getattr(problems, name)) is not None
        }
        solved = getattr(self.solver, "problem", None)
        if len(given.keys() & {"reference", "reference_weight"}) == 1 or (
            "reference" in given and not getattr(solved, "committed", True)
        ):
            raise ValueError(
                "reference: references need weights, and a planner with planner.commitment above 0, whose value only "
                "swarms use."
            )
        if "reference" in given and (given["reference_weight"] < 0).any():
            raise ValueError("reference_weight: weights must not be negative.")
        if "disturbance" in given and not getattr(solved, "disturbed", True):
            raise ValueError("disturbance: this planner knows none; set planner.disturbance_time.")
        turns = np.abs(wrapped(given["heading"] - x[:, 8])).max(initial=0.0) if "heading" in given else 0.0
        if turns > SAME_HEADING and not self.config.max_yaw_rate:
            raise ValueError("heading: this planner holds the yaw of robots; create it with max_yaw_rate above 0.")
        return given

    def _plan(self, problems: Problems, previous: Plans) -> Plans:
        """Do the same with roll and pitch about the world's axes, whatever the yaw."""
        x_guess, u_guess = shift(previous.x), shift(previous.u)
        problems = self._nearest_others(problems, x_guess)
        if self.prepare is not None:
            problems = self.prepare(problems)
        elif self.config.right_of_way:
            problems = keep_right(problems, self.config.right_of_way, self.config.dt)
        x, u, success, iterations = self._solve(problems, x_guess, u_guess)
        age = np.zeros(len(success), dtype=np.int64)
        status = age + _SOLVED
        if np.count_nonzero(success) < len(success):  # takes a quarter of the time of success.all()
            failed = np.flatnonzero(~success)
            status[failed] = _BRAKING
            # Cold initial guess: constant state and no input
            cold = Plans.hover(problems.x[failed], self.config.horizon)
            retry = self._solve(problems.part(failed), cold.x, cold.u)
            iterations[failed] += retry.iterations
            x[failed], u[failed] = retry.x, retry.u
            status[failed[retry.success]] = PlanStatus.RETRIED

            failed = failed[~retry.success]
            age[failed] = previous.age[failed] + 1
            lasts = age[failed] < self.config.horizon
            status[failed[lasts]] = PlanStatus.SHIFTED
            u[failed[lasts]] = u_guess[failed[lasts]]
            hopeless = problems.part(failed[~lasts])
            u[failed[~lasts]] = self.braking_inputs(hopeless.x, hopeless.disturbance)
            pushed = None if problems.disturbance is None else problems.disturbance[failed]
            x[failed] = self._rollout(problems.x[failed], u[failed], pushed)
        if self.rate is not None:
            self.costs = self.rate(problems, x, u)
        return Plans(x, u, age, status, iterations)

    def _rollout(self, x: np.ndarray, u: np.ndarray, disturbance: np.ndarray | None = None) -> np.ndarray:
        """Roll out states with roll and pitch about the world's axes, see `QuadrotorModel.rollout`."""
        turns = np.count_nonzero(x[:, 8]) or np.count_nonzero(u[..., 3])
        if isinstance(self.model, ProblemModel) or not turns:
            return self.model.rollout(x, u, disturbance)
        held, still = x.copy(), u.copy()
        held[:, 8] = still[..., 3] = 0.0
        states = self.model.rollout(held, still, disturbance)
        states[..., 8] = x[:, 8:]
        states[:, 1:, 8] += self.config.dt * u[..., 3].cumsum(axis=1)
        return states

    def _solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """Call the solver. Plans that are not finite, or absurdly large, count as failed, as do all plans if the solver
        raises."""
        try:
            solution = _checked(self.solver.solve(problems, x_guess, u_guess), x_guess, u_guess)
        except Exception as error:
            message = f"the solver {self.solver.name!r} raised {error!r}: its problems count as failed"
            warnings.warn(message, RuntimeWarning, stacklevel=3)
            hover, none = Plans.hover(problems.x, self.config.horizon), np.zeros(len(problems.x), dtype=np.int64)
            return Solution(hover.x, hover.u, none.astype(bool), none)
        # A sum of squares is small only if all entries are, and cheaper than a test of each
        if np.vdot(solution.x, solution.x) + np.vdot(solution.u, solution.u) < _LARGEST:
            return solution
        possible = [(np.abs(array) < _LARGEST).all(axis=(1, 2)) for array in (solution.x, solution.u)]
        return solution._replace(success=solution.success & possible[0] & possible[1])

    def _nearest_others(self, problems: Problems, x_guess: np.ndarray) -> Problems:
        """Reduce problems to the bodies that the last plan comes closest to."""
        kept, shape, size = self.n_others, problems.shape, problems.size
        if kept is None or kept >= problems.others.shape[1]:
            return problems
        between = [problems.others[..., i] - x_guess[:, None, 1:, i] for i in range(3)]
        if shape is not None:
            between = [shape[..., i, None] * one for i, one in enumerate(between)]
        squared = sum(one**2 for one in between).min(axis=2)
        gaps = squared if size is None else np.sqrt(squared) - size
        nearest = np.sort(np.argsort(gaps, axis=1, kind="stable")[:, :kept], axis=1)
        return problems.chosen(nearest)

    def braking_inputs(self, x: np.ndarray, disturbance: np.ndarray | None = None) -> np.ndarray:
        """Compute inputs that bring robots to hover from their states without a solver, (B, 9) -> (B, N, 4).

        The commanded tilt, about the world's axes, opposes the velocity and the disturbance and saturates at its limit.
        The commanded climb rate only opposes the disturbance. Vehicles with dynamics of their own follow
        `OptimalControlProblem.braking` instead.

        :param x: states, (B, 9)
        :param disturbance: see `Problems`
        """
        if isinstance(self.model, ProblemModel):
            return self.model.braking_inputs(x)
        assert isinstance(self.model, QuadrotorModel)
        # Tilt a = v / (g * 0.5 s) stops the linearised robot in about half a second without overshoot
        gain = 1.0 / (self.model.params.gravity * 0.5)
        limit = self.config.max_tilt
        u = np.zeros((x.shape[0], self.config.horizon, N_INPUTS))
        state, hold = x, np.zeros((x.shape[0], N_INPUTS))
        if disturbance is not None:
            hold = self.model.params.steady_input(disturbance)
            u[..., 2] = np.clip(hold[:, None, 2], -self.config.descent_rate, self.config.max_climb_rate)
        for k in range(self.config.horizon):
            u[:, k, 0] = np.clip(gain * state[:, 4] + hold[:, 0], -limit, limit)
            u[:, k, 1] = np.clip(-gain * state[:, 3] + hold[:, 1], -limit, limit)
            state = self._rollout(state, u[:, k : k + 1], disturbance)[:, 1]
        return u


def _checked(solution: Solution, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
    """Check the form of a solution. Its arrays become those that the planner reads and writes.

    :raises ValueError: if an array has another shape, `success` is not boolean, or numbers are masked or complex
    """
    count = len(x_guess)
    x, u, success, iterations = solution
    if (
        type(x) is type(u) is type(success) is type(iterations) is np.ndarray
        and (x.shape, u.shape, success.shape, iterations.shape) == (x_guess.shape, u_guess.shape, (count,), (count,))
        and (x.dtype, u.dtype, success.dtype, iterations.dtype) == _TYPES
        and x.flags.writeable
        and u.flags.writeable
        and iterations.flags.writeable
    ):
        return Solution(x, u, success, iterations)
    for name, array in zip(Solution._fields, solution, strict=True):
        if np.iscomplexobj(array) or np.ma.is_masked(array):
            raise ValueError(f"{name} is masked or complex; a solution has real numbers")
    success = np.array(success)
    if success.dtype != bool:  # ~1 is not False
        raise ValueError(f"success has the type {success.dtype}; a solution has booleans")
    checked = Solution(np.array(x, float), np.array(u, float), success, np.array(iterations, np.int64))
    shapes = (x_guess.shape, u_guess.shape, (count,), (count,))
    for name, array, shape in zip(Solution._fields, checked, shapes, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name} has the shape {array.shape}; a solution of these problems has {shape}")
    return checked


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of an array or of nested lists, () if they have none."""
    try:
        return np.shape(value)
    except (ValueError, TypeError):
        return ()


def _array(
    name: str, value: Any, shape: tuple[int, ...], dtype: np.dtype = _TYPES[0], finite: bool = True
) -> np.ndarray:
    """Check an array of a call and convert it to its type.

    :raises ValueError: if it has another shape or kind, or holds numbers that are not finite
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):  # nested lists of different lengths, or a foreign class
        array = np.array(None)
    kinds = {"f": "fiu", "i": "iu", "b": "b"}[dtype.kind]
    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(
            f"{name} has shape {array.shape} and type {array.dtype}; this planner takes {shape} and {dtype}."
        )
    if finite and not np.isfinite(array).all():
        where = [int(index) for index in np.argwhere(~np.isfinite(array))[0]]
        raise ValueError(f"{name}{where} is {array[tuple(where)]}: the numbers of a problem must be finite.")
    return array.astype(dtype, copy=False)


def turned(values: np.ndarray, angle: np.ndarray, first: int = 6) -> np.ndarray:
    """Return states or inputs whose roll and pitch are about axes that are turned by an angle.

    :param values: states (..., 9) or inputs (..., 4)
    :param angle: angle by which the axes turn about the vertical, counter-clockwise, (...) (rad)
    :param first: index of the roll: 6 for states, 0 for inputs
    """
    values = values.copy()
    with np.errstate(invalid="ignore"):
        cos, sin = np.cos(angle), np.sin(angle)
    roll, pitch = values[..., first].copy(), values[..., first + 1].copy()
    values[..., first], values[..., first + 1] = cos * roll + sin * pitch, cos * pitch - sin * roll
    return values


def nearer(positions: np.ndarray, goals: np.ndarray, distance: float) -> np.ndarray:
    """Return goals that are at most as far away as a distance, in the same directions, (B, 3) (m).

    :param positions: positions of the robots, (B, 3), world frame (m)
    :param goals: goals, (B, 3), world frame (m)
    :param distance: the distance (m)
    """
    between = goals - positions
    with np.errstate(invalid="ignore"):  # states that are not finite fail in the solver
        far = length(between)
        points = positions + between * (distance / np.maximum(far, distance))[:, None]
        return np.where((far > distance)[:, None], points, goals)


def shift(trajectory: np.ndarray) -> np.ndarray:
    """Shift trajectories (B, K, ...) by one step, repeating the last entry."""
    return trajectory.take(_following(trajectory.shape[1]), axis=1)


@functools.cache
def _following(length: int) -> np.ndarray:
    return np.minimum(np.arange(1, length + 1), length - 1)
