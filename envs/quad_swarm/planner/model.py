"""The dynamics of a problem on NumPy arrays: what plans without a solver, and vehicles, are computed with."""

from __future__ import annotations

import casadi as ca
import numpy as np

from quad_swarm.native import BuildError
from quad_swarm.native.functions import RowFunction
from quad_swarm.planner.problem import OptimalControlProblem
from quad_swarm.quadrotor import N_INPUTS, N_STATES, QuadrotorModel, VehicleModel, rk4


class ProblemModel(VehicleModel):
    """Discrete dynamics of the vehicles of a problem with dynamics of its own.

    States and inputs that the problem does not have are 0 after a step. If the problem only has `dynamics`, a step is
    the planner's, in still air, and states in between are interpolated.

    :param problem: the problem
    :param dt: length of a step (s), by default the planner's
    """

    def __init__(self, problem: OptimalControlProblem, dt: float | None = None):
        super().__init__(problem.config.dt if dt is None else dt)
        self.problem = problem
        self._rows: dict[float | None, RowFunction | None] = {}
        self._braking = ca.Function("braking", [x := ca.SX.sym("x", problem.nx)], [ca.densify(problem.braking(x))])

    def braking_inputs(self, x: np.ndarray) -> np.ndarray:
        """Compute the inputs of `OptimalControlProblem.braking` over the horizon, (B, 9) -> (B, N, 4)."""
        problem = self.problem
        u, limit = np.zeros((len(x), problem.config.horizon, N_INPUTS)), problem.max_input.full().ravel()
        for k in range(u.shape[1] if len(x) else 0):
            wanted = self._braking(x[:, : problem.nx].T).full().T
            u[:, k, : problem.nu] = np.clip(np.where(np.isfinite(wanted), wanted, 0.0), -limit, limit)
            x = self.step(x, u[:, k])
        return u

    def _function(self, dt: float | None, varied: bool, heading: bool) -> ca.Function:
        """See `quad_swarm.quadrotor.step_function`."""
        problem = self.problem
        x, u, wind = ca.SX.sym("x", N_STATES), ca.SX.sym("u", N_INPUTS), ca.SX.sym("wind", 2)
        inputs = {"x": x, "u": u, "wind": wind}
        length: float | ca.SX = self.dt
        if dt is None:
            inputs["dt"] = length = ca.SX.sym("dt")
        own, command = x[: problem.nx], u[: problem.nu]
        if problem.is_discrete():
            x_next = problem.dynamics(own, command)
            if dt is None:
                x_next = own + length / problem.config.dt * (x_next - own)
        else:
            x_next = rk4(lambda state: problem.derivative(state, command, wind), own, length)
        # What sensors see of the other states stays as it is until a command, which may be at once
        rest = x[problem.nx :] if dt is None else ca.SX.zeros(N_STATES - problem.nx)
        x_next = ca.densify(ca.cse(ca.vertcat(x_next, rest)))
        return ca.Function("vehicle_step", list(inputs.values()), [x_next], list(inputs), ["x_next"])

    def _compiled(self, dt: float | None, varied: bool, heading: bool) -> RowFunction | None:
        if dt not in self._rows:
            try:
                self._rows[dt] = RowFunction(self._function(dt, varied, heading))
            except BuildError:  # of which the planner warns
                self._rows[dt] = None
        return self._rows[dt]

    def __reduce__(self) -> tuple:
        return ProblemModel, (self.problem, self.dt)


def model_of(problem: OptimalControlProblem, dt: float | None = None) -> VehicleModel:
    """Create the model of a problem's vehicles.

    :param problem: the problem
    :param dt: length of a step (s), by default the planner's
    """
    if problem.has_own_dynamics():
        return ProblemModel(problem, dt)
    return QuadrotorModel(problem.quadrotor, problem.config.dt if dt is None else dt)


def same_dynamics(first: OptimalControlProblem, second: OptimalControlProblem) -> bool:
    """Return whether the vehicles of two problems move alike: at 16 points drawn from a normal distribution."""
    if (first.nx, first.nu) != (second.nx, second.nu):
        return False
    x, u = ca.SX.sym("x", first.nx), ca.SX.sym("u", first.nu)
    both = ca.Function("both", [x, u], [problem.dynamics(x, u) for problem in (first, second)])
    rng = np.random.default_rng(0)
    points = rng.normal(size=(16, first.nx)), 0.3 * rng.normal(size=(16, first.nu))
    found = [both(*point) for point in zip(*points, strict=True)]
    return all(np.allclose(one.full(), two.full(), rtol=1e-9, atol=1e-12, equal_nan=True) for one, two in found)
