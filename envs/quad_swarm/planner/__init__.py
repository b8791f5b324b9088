"""Planning: the optimal control problem of a robot, solvers for batches of problems, and the fallback chain."""

from __future__ import annotations

import functools
import warnings

from quad_swarm.errors import unknown_name
from quad_swarm.native import BuildError
from quad_swarm.planner.base import Planner, Plans, PlanStatus, Solution, Solver
from quad_swarm.planner.fatrop import FatropSolver
from quad_swarm.planner.problem import OptimalControlProblem, PlannerConfig, Problems
from quad_swarm.planner.rti import RtiSolver
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

SOLVERS: dict[str, type[FatropSolver] | type[RtiSolver]] = {"rti": RtiSolver, "fatrop": FatropSolver}


def make_planner(config: PlannerConfig, quadrotor: QuadrotorParams, n_robots: int, solver: str = "auto") -> Planner:
    """Create the planner of a swarm.

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param n_robots: number of robots in a swarm
    :param solver: one of `SOLVERS`, or "auto" for "rti" if it can be compiled, otherwise "fatrop" with a warning
    :raises ValueError: if the solver is unknown
    :raises RuntimeError: if the solver is "rti" and cannot be compiled
    """
    if solver != "auto" and solver not in SOLVERS:
        raise unknown_name("solver", solver, ["auto", *SOLVERS])
    n_others = n_robots - 1 if config.max_neighbours is None else min(n_robots - 1, config.max_neighbours)
    problem = OptimalControlProblem(config, quadrotor, n_others)
    return Planner(_make_solver(problem, solver), QuadrotorModel(quadrotor, config.dt), config)


def _make_solver(problem: OptimalControlProblem, solver: str) -> Solver:
    if solver == "fatrop":
        return FatropSolver(problem)
    rti = RtiSolver(problem)
    try:
        rti.compile()
    except BuildError as error:
        if solver == "rti":
            raise BuildError(f"solver='rti' cannot run: {error}; solver='fatrop' needs no compiler.") from error
        _warn_once(f"quad_swarm plans with fatrop, which is hundreds of times slower than rti: {error}.")
        return FatropSolver(problem)
    return rti


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
