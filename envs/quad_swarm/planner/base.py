"""The interface of solvers, and the planner with its fallback chain, which always yields a flyable plan."""

from __future__ import annotations

import functools
import math
import warnings
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np

from quad_swarm.planner.problem import PlannerConfig, Problems
from quad_swarm.planner.right_of_way import keep_right
from quad_swarm.quadrotor import N_INPUTS, QuadrotorModel


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


class Planner:
    """Planner with warm-started solves and a fallback chain: solve, retry cold, continue the last plan, brake
    (Sec. III-B).

    The level is chosen independently for each robot, so a failure never affects another robot's plan.

    :param solver: the solver
    :param model: discrete dynamics, for the levels without a solver
    :param config: horizon and limits
    """

    def __init__(self, solver: Solver, model: QuadrotorModel, config: PlannerConfig):
        self.solver = solver
        self.model = model
        self.config = config

    def plan(self, problems: Problems, previous: Plans) -> Plans:
        """Solve a batch of B problems; solver failures never raise.

        :param problems: the batch
        :param previous: plans of the same robots in the previous step
        :return: the new plans
        """
        x_guess, u_guess = shift(previous.x), shift(previous.u)
        problems = self._nearest_others(problems, x_guess)
        if self.config.right_of_way:
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
            u[failed[~lasts]] = self.braking_inputs(problems.x[failed[~lasts]])
            x[failed] = self.model.rollout(problems.x[failed], u[failed])
        return Plans(x, u, age, status, iterations)

    def _solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """Call the solver. Plans that are not finite count as failed, as do all plans if the solver raises."""
        try:
            solution = _checked(self.solver.solve(problems, x_guess, u_guess), x_guess, u_guess)
        except Exception as error:
            message = f"the solver {self.solver.name!r} raised {error!r}: its problems count as failed"
            warnings.warn(message, RuntimeWarning, stacklevel=3)
            hover, none = Plans.hover(problems.x, self.config.horizon), np.zeros(len(problems.x), dtype=np.int64)
            return Solution(hover.x, hover.u, none.astype(bool), none)
        # Sums of squares are not finite if an entry is not, and cheaper than a test of each
        if math.isfinite(np.vdot(solution.x, solution.x) + np.vdot(solution.u, solution.u)):
            return solution
        finite = np.isfinite(solution.x).all(axis=(1, 2)) & np.isfinite(solution.u).all(axis=(1, 2))
        return solution._replace(success=solution.success & finite)

    def _nearest_others(self, problems: Problems, x_guess: np.ndarray) -> Problems:
        """Reduce problems to the ``max_neighbours`` others that come closest over the horizon."""
        kept = self.config.max_neighbours
        if kept is None or kept >= problems.others.shape[1]:
            return problems
        squared = sum((problems.others[..., i] - x_guess[:, None, 1:, i]) ** 2 for i in range(3))
        nearest = np.sort(np.argsort(squared.min(axis=2), axis=1, kind="stable")[:, :kept], axis=1)
        rows, clearance, announced = np.arange(len(nearest))[:, None], problems.clearance, problems.announced
        return problems._replace(
            others=problems.others[rows, nearest],
            clearance=None if clearance is None else clearance[rows, nearest],
            announced=None if announced is None else announced[rows, nearest],
        )

    def braking_inputs(self, x: np.ndarray) -> np.ndarray:
        """Compute inputs that bring robots to hover from their states without a solver, (B, 9) -> (B, N, 4).

        The commanded tilt opposes the velocity and saturates at its limit. The commanded climb rate is zero.
        """
        # Tilt a = v / (g * 0.5 s) stops the linearised robot in about half a second without overshoot
        gain = 1.0 / (self.model.params.gravity * 0.5)
        limit = self.config.max_tilt
        u = np.zeros((x.shape[0], self.config.horizon, N_INPUTS))
        state = x
        for k in range(self.config.horizon):
            u[:, k, 0] = np.clip(gain * state[:, 4], -limit, limit)
            u[:, k, 1] = np.clip(-gain * state[:, 3], -limit, limit)
            state = self.model.step(state, u[:, k])
        return u


def _checked(solution: Solution, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
    """Check the form of a solution. Its arrays become those that the planner reads and writes.

    :raises ValueError: if an array has another shape, or `success` is not boolean
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
        return solution
    success = np.array(success)
    if success.dtype != bool:  # ~1 is not False
        raise ValueError(f"success has the type {success.dtype}; a solution has booleans")
    checked = Solution(np.array(x, float), np.array(u, float), success, np.array(iterations, np.int64))
    shapes = (x_guess.shape, u_guess.shape, (count,), (count,))
    for name, array, shape in zip(Solution._fields, checked, shapes, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name} has the shape {array.shape}; a solution of these problems has {shape}")
    return checked


def shift(trajectory: np.ndarray) -> np.ndarray:
    """Shift trajectories (B, K, ...) by one step, repeating the last entry."""
    return trajectory.take(_following(trajectory.shape[1]), axis=1)


@functools.cache
def _following(length: int) -> np.ndarray:
    return np.minimum(np.arange(1, length + 1), length - 1)
