"""Planning: the optimal control problem of a robot, solvers for batches of problems, and the fallback chain."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.native import BuildError
from quad_swarm.planner.base import Planner, Plans, PlanStatus, Solution, Solver
from quad_swarm.planner.cost import PlanCost
from quad_swarm.planner.fatrop import FatropSolver
from quad_swarm.planner.mixed import MixedPlanner
from quad_swarm.planner.model import ProblemModel, model_of, same_dynamics
from quad_swarm.planner.orca import OrcaSolver, ReciprocalVelocities
from quad_swarm.planner.problem import PROBLEMS, OptimalControlProblem, PlannerConfig, Problems, make_problem
from quad_swarm.planner.rti import RtiSolver
from quad_swarm.planner.voronoi import VoronoiCells
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.registry import Registry

# Name -> what creates the solver of a problem: its class, or a function
SOLVERS: Registry[Callable[[OptimalControlProblem], Solver]] = Registry(
    "solver", "quad_swarm.solvers", {"rti": RtiSolver, "fatrop": FatropSolver, "orca": OrcaSolver}
)
PROBLEMS |= {"orca": ReciprocalVelocities, "voronoi": VoronoiCells}


def make_planner(
    config: PlannerConfig,
    quadrotor: QuadrotorParams,
    n_robots: int,
    solver: str = "auto",
    n_obstacles: int = 0,
    costs: bool = False,
    sizes: bool = False,
) -> Planner:
    """Create the planner of a swarm.

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param n_robots: number of robots in a swarm
    :param solver: one of `SOLVERS`, or "auto" for "rti" if it can be compiled, otherwise "fatrop" with a warning
    :param n_obstacles: number of obstacles; up to ``config.max_obstacles`` are considered
    :param costs: whether the planner also computes the costs of plans, `Planner.costs`
    :param sizes: whether other robots may differ in size from the planning one
    :raises ValueError: if an argument is of another kind, the solver or the problem is unknown, what `SOLVERS` holds
        creates no `Solver`, or one with other dynamics than the problem's, or the problem's formulas do not fit
    :raises ImportError: if an installed package offers one of them, and it cannot be loaded
    :raises BuildError: if the solver is "rti" and cannot be compiled
    """
    for name, value, kind in (("config", config, PlannerConfig), ("quadrotor", quadrotor, QuadrotorParams)):
        if not isinstance(value, kind):
            raise ValueError(f"{name}={shown(value)}: pass {kind.__name__}.")
    for name, number, least in (("n_robots", n_robots, 1), ("n_obstacles", n_obstacles, 0)):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < least:
            raise ValueError(f"{name}={shown(number)}: it must be a whole number, at least {least}.")
    if solver != "auto":
        SOLVERS.find(solver, ("auto",))
    n_others = n_robots - 1 if config.max_neighbours is None else min(n_robots - 1, config.max_neighbours)
    n_bodies = n_others + min(n_obstacles, config.max_obstacles)
    shaped = sizes or n_obstacles > 0 or config.downwash != 1 or config.prediction_penalty != 1
    problem = make_problem(config, quadrotor, n_bodies, shaped)
    limit = None if n_bodies == n_robots - 1 + n_obstacles else n_bodies
    planner = Planner(_make_solver(problem, solver), model_of(problem), config, limit)
    planner.rate = PlanCost(problem) if costs else None
    if type(problem).prepare is not OptimalControlProblem.prepare:
        planner.prepare = problem.prepare
    return planner


def _make_solver(problem: OptimalControlProblem, name: str) -> Solver:
    only = problem.solver
    if only is not None and name not in ("auto", only):
        raise ValueError(f"solver={name!r}: planner.problem={problem.config.problem!r} is for solver={only!r} only.")
    chosen = only or "rti" if name == "auto" else name
    solver = SOLVERS.find(chosen)(problem)
    has_solve = callable(getattr(solver, "solve", None)) and not isinstance(solver, type)
    if not has_solve or not isinstance(getattr(solver, "name", None), str):
        raise ValueError(
            f"SOLVERS[{chosen!r}] created {shown(solver)}, which is no solver: it needs a `name` and a method "
            "`solve(problems, x_guess, u_guess)`, see quad_swarm.planner.Solver."
        )
    solved = getattr(solver, "problem", problem)
    if solved is not problem and isinstance(solved, OptimalControlProblem) and not same_dynamics(solved, problem):
        raise ValueError(
            f"SOLVERS[{chosen!r}] plans with the dynamics of {type(solved).__name__}, while robots fly those of "
            f"planner.problem={problem.config.problem!r}: add the class to quad_swarm.planner.PROBLEMS and choose it "
            "there; then plans, the fallback chain and vehicles have one model."
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
    "PROBLEMS",
    "SOLVERS",
    "BuildError",
    "FatropSolver",
    "MixedPlanner",
    "OptimalControlProblem",
    "OrcaSolver",
    "PlanCost",
    "PlanStatus",
    "Planner",
    "PlannerConfig",
    "Plans",
    "ProblemModel",
    "Problems",
    "RtiSolver",
    "Solution",
    "Solver",
    "VoronoiCells",
    "make_planner",
    "make_problem",
    "model_of",
]
