"""The cost of plans, as the problem states it."""

from __future__ import annotations

import casadi as ca
import numpy as np

from quad_swarm.planner.problem import OptimalControlProblem, Problems


class PlanCost:
    """The objective of a problem as a function of plans: the costs of inputs, repulsion, goal and references, and the
    weighted squares of all violations of soft constraints.

    :param problem: the problem
    """

    def __init__(self, problem: OptimalControlProblem):
        self.problem = problem
        self._function: ca.Function | None = None

    def __call__(self, problems: Problems, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Compute the cost of plans.

        :param problems: B problems with as many bodies as the problem considers
        :param x: states at stages 0..N, (B, N + 1, 9)
        :param u: inputs at stages 0..N-1, (B, N, 4)
        :return: the costs, (B,)
        """
        problem, (count, m) = self.problem, problems.others.shape[:2]
        problems = problems.penalised(problem.config.separation)
        if self._function is None:
            self._function = _objective(problem)
        nothing, stages = np.zeros((count, 0)), problem.config.horizon
        reference, weight, free = problems.reference, problems.reference_weight, problems.steady_input
        parts = (
            x[:, :, : problem.nx],
            u[:, :, : problem.nu],
            problems.goal,
            problems.others,
            np.zeros((count, m, stages)) if problems.clearance is None else problems.clearance,
            np.ones((count, m, 3)) if problems.shape is None else problems.shape,
            np.zeros((count, m)) if problems.size is None else problems.size,
            np.zeros((count, stages, 3)) if reference is None else reference,
            np.zeros((count, stages)) if weight is None else weight,
            np.zeros((count, problem.nu)) if free is None else free[:, : problem.nu],
        )
        columns = [np.ascontiguousarray(part, float).reshape(count, -1).T if part.size else nothing.T for part in parts]
        return self._function(*columns).full().ravel() if count else np.zeros(0)

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_function": None}  # rebuilt on demand in another process


def _objective(problem: OptimalControlProblem) -> ca.Function:
    """Return the objective as a function of flattened rows, see `PlanCost`."""
    config, nx, nu, m, horizon = problem.config, problem.nx, problem.nu, problem.n_others, problem.config.horizon
    x, u, goal = ca.SX.sym("x", nx, horizon + 1), ca.SX.sym("u", nu, horizon), ca.SX.sym("goal", 3)
    others, clearance = ca.SX.sym("others", 3, horizon * m), ca.SX.sym("clearance", horizon, m)
    shape, size = ca.SX.sym("shape", 3, m), ca.SX.sym("size", m)
    reference, weight, free = ca.SX.sym("reference", 3, horizon), ca.SX.sym("weight", horizon), ca.SX.sym("free", nu)
    cost = problem.goal_cost(x[:, horizon], x[:, 0], goal)
    for k in range(horizon):
        cost += problem.input_cost(u[:, k] - free)
        at = x[:, k + 1]
        cost += weight[k] * ca.sumsqr(at[:3] - reference[:, k])
        around = others[:, [j * horizon + k for j in range(m)]]
        distances = problem.distances(at, around)
        if problem.shaped:
            distances = [d - size[j] for j, d in enumerate(problem.shaped_distances(at, around, shape))]
        violations = [config.separation + clearance[k, j] - d for j, d in enumerate(distances)]
        violations.append(problem.box_violations(at))
        cost += sum((problem.repulsion_cost(d) for d in distances), start=ca.SX(0))
        cost += config.violation_weight * ca.sumsqr(ca.fmax(ca.vertcat(*violations), 0))
    inputs = (x, u, goal, others, clearance, shape, size, reference, weight, free)
    return ca.Function("cost", [ca.vec(one) for one in inputs], [cost])
