"""Solver that iterates to convergence with fatrop (a structure-exploiting interior-point method in CasADi's wheel)."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from quad_swarm.planner.base import Solution
from quad_swarm.planner.problem import OptimalControlProblem, Problems
from quad_swarm.quadrotor import N_INPUTS, N_STATES

_LARGEST_EXPONENT = 300.0  # of the repulsion, whose square is still far from overflow

_LARGEST_NUMBER = 1e5  # m, m/s or rad: problems with larger numbers fail without a solve
# Of points that are good enough although fatrop did not reach its tolerance
_FEASIBLE = 1e-6  # violation of constraints (m, m/s or rad)
_STATIONARY = 1e-3  # gradient of the Lagrangian over 1 + the cost
_IN_LINE = 1e-3  # distance of another robot from the line to the goal from which its sides differ (m)
_ASIDE = 0.1  # how far a guess then ends beside the line (m)


class FatropSolver:
    """Reference solver, which solves the problems of a batch to convergence, one after the other.

    :param problem: the problem
    :param tolerance: fatrop's convergence tolerance
    :param max_iterations: number of iterations after which a problem counts as failed, unless the point reached is
        feasible and stationary relative to its cost. There is no time limit, so that results are reproducible
    """

    name = "fatrop"

    def __init__(self, problem: OptimalControlProblem, tolerance: float = 1e-4, max_iterations: int = 100):
        self.problem = problem
        self.tolerance = tolerance
        self.max_iterations = max_iterations
        self._program: Program | None = None
        self._solver: ca.Function | None = None
        self._stationarity: ca.Function | None = None

    def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """See `Solver.solve`."""
        if self._program is None or self._solver is None:
            self._program = transcribe(self.problem)
            options = {
                "print_time": False,
                "error_on_fail": False,
                "fatrop.print_level": 0,
                "fatrop.tolerance": self.tolerance,
                "fatrop.mu_init": 1e-2,
                "fatrop.max_iter": self.max_iterations,
            }
            self._solver = ca.nlpsol("planner", "fatrop", self._program.nlp, self._program.structure | options)
        problems = problems.penalised(self.problem.config.separation)
        program, solver, nx, nu = self._program, self._solver, self.problem.nx, self.problem.nu
        count, horizon = u_guess.shape[:2]
        x = np.zeros((count, horizon + 1, N_STATES))
        u = np.zeros((count, horizon, N_INPUTS))
        x[:, 0] = problems.x
        success = np.zeros(count, dtype=bool)
        iterations = np.zeros(count, dtype=np.int64)
        variables = np.zeros(program.bounds["lbx"].size)
        clearance = np.zeros(problems.others.shape[:3]) if problems.clearance is None else problems.clearance
        shape = np.ones((*problems.others.shape[:2], 3)) if problems.shape is None else problems.shape
        size = np.zeros(problems.others.shape[:2]) if problems.size is None else problems.size
        reference, weight = problems.reference, problems.reference_weight
        reference = np.zeros((count, horizon, 3)) if reference is None else reference
        weight = np.zeros((count, horizon)) if weight is None else weight
        disturbance, steady = problems.disturbance, problems.steady_input
        disturbance = np.zeros((count, 3)) if disturbance is None else disturbance
        steady = np.zeros((count, N_INPUTS)) if steady is None else steady
        for b in range(count):
            about_others = (problems.others[b].ravel(), clearance[b].ravel(), shape[b].ravel(), size[b])
            kept_to = (reference[b].ravel(), weight[b]) if self.problem.committed else ()
            pushed = (disturbance[b], steady[b, :nu]) if self.problem.disturbed else ()
            parameters = np.concatenate([problems.x[b, :nx], problems.goal[b], *about_others, *kept_to, *pushed])
            variables[program.x_index] = x_guess[b, 1:, :nx] + _aside(problems, b, horizon)[:, :nx]
            variables[program.u_index] = u_guess[b, :, :nu]
            if not (_is_sane(parameters) and _is_sane(variables)):
                continue
            try:
                solution = solver(x0=variables, p=parameters, **program.bounds)
            except RuntimeError:  # fatrop failed numerically; the fallback chain takes over
                continue
            stats = solver.stats()
            success[b] = stats["success"] or self._is_good(solution, parameters)
            iterations[b] = stats["iter_count"]
            optimum = solution["x"].full().ravel()
            success[b] &= np.isfinite(optimum).all()
            x[b, 1:, :nx] = optimum[program.x_index]
            u[b, :, :nu] = optimum[program.u_index]
        return Solution(x, u, success, iterations)

    def _is_good(self, solution: dict[str, ca.DM], parameters: np.ndarray) -> bool:
        """Return whether a point at which fatrop stopped obeys the constraints and is stationary relative to its cost.
        Where robots overlap, violations cost thousands, and the last digits of the tolerance would take hundreds of
        iterations."""
        assert self._program is not None
        if self._stationarity is None:
            self._stationarity = _stationarity(self._program)
        residual = self._stationarity(solution["x"], parameters, solution["lam_g"], solution["lam_x"])
        g, bounds = solution["g"].full().ravel(), self._program.bounds
        violation = np.maximum(bounds["lbg"] - g, g - bounds["ubg"]).max(initial=0.0)
        stationary = float(ca.norm_inf(residual)) <= _STATIONARY * (1 + abs(float(solution["f"])))
        return bool(violation <= _FEASIBLE and stationary)

    def __getstate__(self) -> dict:
        return self.__dict__ | {
            "_program": None,
            "_solver": None,
            "_stationarity": None,
        }  # rebuilt on demand in another process


def _stationarity(program: Program) -> ca.Function:
    """Return the gradient of the Lagrangian as a function of variables, parameters and multipliers."""
    x, g = program.nlp["x"], program.nlp["g"]
    of_g, of_x = ca.SX.sym("lam_g", g.numel()), ca.SX.sym("lam_x", x.numel())
    gradient = ca.gradient(program.nlp["f"] + ca.dot(of_g, g), x) + of_x
    return ca.Function("stationarity", [x, program.nlp["p"], of_g, of_x], [gradient])


def _aside(problems: Problems, row: int, horizon: int) -> np.ndarray:
    """Return offsets of a guess to one side of the line to the goal, (N, 9): exactly in line with another robot,
    neither side is nearer, and the solver would stop in front of it.

    :param problems: the batch
    :param row: the problem
    :param horizon: number of stages N
    """
    along = problems.goal[row, :2] - problems.x[row, :2]
    others = problems.others[row, :, 0, :2] - problems.x[row, :2]
    offsets = np.zeros((horizon, N_STATES))
    distance = np.hypot(*along)
    side = np.array([-along[1], along[0]]) / distance if distance > 1e-9 else np.array([0.0, 1.0])
    if (np.abs(others @ side) < _IN_LINE).any():
        offsets[:, :2] = side * _ASIDE * np.linspace(1 / horizon, 1, horizon)[:, None]
    return offsets


def _is_sane(numbers: np.ndarray) -> bool:
    """Return whether numbers are finite and small enough for fatrop, which may loop forever on overflow."""
    return bool((np.abs(numbers) <= _LARGEST_NUMBER).all())


class Program(NamedTuple):
    """The problem as a nonlinear program.

    :param nlp: variables ``x``, parameters ``p`` (state, goal, others, clearance, shape, size, and with
        commitment reference and its weights, with disturbances these and the steady inputs), cost ``f`` and
        constraints ``g``
    :param bounds: bounds of variables and constraints
    :param structure: fatrop's description of the stages
    :param x_index: indices of the states at stages 1..N in the variables, (N, nx)
    :param u_index: indices of the inputs in the variables, (N, nu)
    """

    nlp: dict[str, ca.SX]
    bounds: dict[str, np.ndarray]
    structure: dict[str, Any]
    x_index: np.ndarray
    u_index: np.ndarray


def transcribe(problem: OptimalControlProblem) -> Program:
    """Transcribe the problem by multiple shooting in fatrop's stage order. x_0 is a parameter, and slacks are inputs of
    their stage."""
    config, nx, nu, n_others = problem.config, problem.nx, problem.nu, problem.n_others
    horizon = config.horizon
    x0, goal = ca.SX.sym("x0", nx), ca.SX.sym("goal", 3)
    others = ca.SX.sym("others", 3, horizon * n_others)  # column j * N + k - 1: robot j at stage k
    clearance = ca.SX.sym("clearance", horizon, n_others)
    shape, size = ca.SX.sym("shape", 3, n_others), ca.SX.sym("size", n_others)
    reference, weight = ca.SX.sym("reference", 3, horizon), ca.SX.sym("weight", horizon)
    kept_to = [ca.vec(reference), weight] if problem.committed else []
    disturbance, steady = ca.SX.sym("disturbance", 3), ca.SX.sym("steady", nu)
    pushed = [disturbance, steady] if problem.disturbed else []
    moved = problem.drift(disturbance) if problem.disturbed else ca.SX.zeros(nx)
    free = steady if problem.disturbed else ca.SX.zeros(nu)
    states = [x0] + [ca.SX.sym(f"x{k}", nx) for k in range(1, horizon + 1)]
    inputs = [ca.SX.sym(f"u{k}", nu) for k in range(horizon)]
    step = ca.Function("step", [states[1], inputs[0]], [problem.dynamics(states[1], inputs[0])])

    cost = problem.goal_cost(states[-1], x0, goal)
    variables, lower, upper, x_index, u_index = [], [], [], [], []
    constraints, constraint_lower, equality, n_slacks = [], [], [], []
    min_input, max_input = problem.min_input.full().ravel(), problem.max_input.full().ravel()
    farthest = config.separation * (_LARGEST_EXPONENT / config.repulsion_steepness + config.repulsion_buffer)
    offset = 0
    for k in range(horizon + 1):
        slack = ca.SX.sym(f"slack{k}", n_others if k > 0 else 0)
        n_slacks.append(slack.numel())
        if k > 0:
            variables.append(states[k])
            lower.append(np.full(nx, -np.inf))
            upper.append(np.full(nx, np.inf))
            x_index.append(np.arange(offset, offset + nx))
            offset += nx
            around = others[:, [j * horizon + k - 1 for j in range(n_others)]]
            distances = problem.distances(states[k], around)
            if problem.shaped:
                shaped = problem.shaped_distances(states[k], around, shape)
                distances = [d - size[j] for j, d in enumerate(shaped)]
            # At large distances, the repulsion is zero long before its exponential overflows. The overflow would make
            # derivatives NaN, with which fatrop regularises its Hessian forever.
            cost += sum((problem.repulsion_cost(ca.fmin(d, farthest)) for d in distances), start=ca.SX(0))
            if problem.committed:
                cost += weight[k - 1] * ca.sumsqr(states[k][:3] - reference[:, k - 1])
            cost += config.violation_weight * (
                ca.sumsqr(slack) + ca.sumsqr(ca.fmax(problem.box_violations(states[k]), 0))
            )
        if k < horizon:
            cost += problem.input_cost(inputs[k] - free)
            variables.append(inputs[k])
            lower.append(min_input)
            upper.append(max_input)
            u_index.append(np.arange(offset, offset + nu))
            offset += nu
            constraints.append(states[k + 1] - step(states[k], inputs[k]) - moved)
            constraint_lower.append(np.zeros(nx))
            equality += [True] * nx
        variables.append(slack)
        lower.append(np.full(n_slacks[k], -np.inf))
        upper.append(np.full(n_slacks[k], np.inf))
        offset += n_slacks[k]
        if k > 0:
            constraints += [d - config.separation - clearance[k - 1, j] + slack[j] for j, d in enumerate(distances)]
            constraint_lower.append(np.zeros(n_others))
            equality += [False] * n_others
    return Program(
        nlp={
            "x": ca.vertcat(*variables),
            "f": cost,
            "g": ca.vertcat(*constraints),
            "p": ca.vertcat(x0, goal, ca.vec(others), ca.vec(clearance), ca.vec(shape), size, *kept_to, *pushed),
        },
        bounds={
            "lbx": np.concatenate(lower),
            "ubx": np.concatenate(upper),
            "lbg": np.concatenate(constraint_lower),
            "ubg": np.where(equality, 0.0, np.inf),
        },
        structure={
            "structure_detection": "manual",
            "N": horizon,
            "nx": [0] + [nx] * horizon,
            "nu": [(nu if k < horizon else 0) + n_slacks[k] for k in range(horizon + 1)],
            "ng": n_slacks,
            "equality": equality,
        },
        x_index=np.array(x_index),
        u_index=np.array(u_index),
    )
