"""Planning: the optimal control problem of one robot, solvers for batches of it, and the ladder below them."""

from ..errors import unknown_name
from ..quadrotor import QuadrotorModel, QuadrotorParams
from .base import Planner, Plans, PlanStatus, Problems, Solution, Solver
from .fatrop import FatropSolver
from .problem import OptimalControlProblem, PlannerConfig

SOLVERS: dict[str, type] = {"fatrop": FatropSolver}


def make_planner(config: PlannerConfig, quadrotor: QuadrotorParams, n_robots: int, solver: str = "auto") -> Planner:
    """The planner of a swarm.

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param n_robots: number of robots in a swarm
    :param solver: one of `SOLVERS`, or "auto" for the best one that runs here
    :raises ValueError: unknown solver
    """
    name = "fatrop" if solver == "auto" else solver
    if name not in SOLVERS:
        raise unknown_name("solver", solver, ["auto", *SOLVERS])
    problem = OptimalControlProblem(config, quadrotor, n_robots - 1)
    return Planner(SOLVERS[name](problem), QuadrotorModel(quadrotor, config.dt), config)


__all__ = [
    "SOLVERS",
    "FatropSolver",
    "OptimalControlProblem",
    "PlanStatus",
    "Planner",
    "PlannerConfig",
    "Plans",
    "Problems",
    "Solution",
    "Solver",
    "make_planner",
]
