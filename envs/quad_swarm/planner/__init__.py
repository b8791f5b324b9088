"""Planning: the optimal control problem of a robot, solvers for batches of problems, and the fallback chain."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable

from quad_swarm.errors import shown, unknown_name
from quad_swarm.native import BuildError
from quad_swarm.planner.base import Planner, Plans, PlanStatus, Solution, Solver
from quad_swarm.planner.fatrop import FatropSolver
from quad_swarm.planner.problem import OptimalControlProblem, PlannerConfig, Problems
from quad_swarm.planner.rti import RtiSolver
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

# Name -> what creates the solver of a problem: its class, or a function
SOLVERS: dict[str, Callable[[OptimalControlProblem], Solver]] = {"rti": RtiSolver, "fatrop": FatropSolver}


def make_planner(
    config: PlannerConfig, quadrotor: QuadrotorParams, n_robots: int, solver: str = "auto", n_obstacles: int = 0
) -> Planner:
    """Create the planner of a swarm.

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param n_robots: number of robots in a swarm
    :param solver: one of `SOLVERS`, or "auto" for "rti" if it can be compiled, otherwise "fatrop" with a warning
    :param n_obstacles: number of obstacles; up to ``config.max_obstacles`` are considered
    :raises ValueError: if the solver is unknown, or what `SOLVERS` holds under its name creates no `Solver`
    :raises BuildError: if the solver is "rti" and cannot be compiled
    """
    if solver != "auto" and solver not in SOLVERS:
        raise unknown_name("solver", solver, ["auto", *SOLVERS])
    n_others = n_robots - 1 if config.max_neighbours is None else min(n_robots - 1, config.max_neighbours)
    n_bodies = n_others + min(n_obstacles, config.max_obstacles)
    shaped, committed = n_obstacles > 0 or config.downwash != 1, config.commitment > 0
    disturbed = config.disturbance_time is not None
    problem = OptimalControlProblem(config, quadrotor, n_bodies, shaped, committed, disturbed)
    limit = None if n_bodies == n_robots - 1 + n_obstacles else n_bodies
    return Planner(_make_solver(problem, solver), QuadrotorModel(quadrotor, config.dt), config, limit)


def _make_solver(problem: OptimalControlProblem, name: str) -> Solver:
    chosen = "rti" if name == "auto" else name
    solver = SOLVERS[chosen](problem)
    has_solve = callable(getattr(solver, "solve", None)) and not isinstance(solver, type)
    if not has_solve or not isinstance(getattr(solver, "name", None), str):
        raise ValueError(
            f"SOLVERS[{chosen!r}] created {shown(solver)}, which is no solver: it needs a `name` and a method "
            "`solve(problems, x_guess, u_guess)`, see quad_swarm.planner.Solver."
        )
    try:
        if isinstance(solver, RtiSolver):
            solver.compile()
    except BuildError as error:
        if name != "auto":
            raise BuildError(f"solver={name!r} cannot run: {error}; solver='fatrop' needs no compiler.") from error
        _warn_once(f"quad_swarm plans with fatrop, which is hundreds of times slower than rti: {error}.")
        return SOLVERS["fatrop"](problem)
    return solver


@functools.cache
def _warn_once(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=4)


__all__ = [
    "SOLVERS",
    "BuildError",
    "FatropSolver",
    "OptimalControlProblem",
    "PlanStatus",
    "Planner",
    "PlannerConfig",
    "Plans",
    "Problems",
    "RtiSolver",
    "Solution",
    "Solver",
    "make_planner",
]
