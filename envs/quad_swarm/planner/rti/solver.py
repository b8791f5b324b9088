"""The batched real-time iteration, which solves a batch of problems in one call of compiled code."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.errors import unknown_name
from quad_swarm.native.build import addresses, build, load
from quad_swarm.planner.base import Solution
from quad_swarm.planner.problem import OptimalControlProblem, Problems
from quad_swarm.planner.rti.codegen import formulas, generate_model
from quad_swarm.quadrotor import N_INPUTS, N_STATES

# Precision of the iteration -> type in C++
PRECISIONS = {"float32": "float", "float64": "double"}
_FUNCTION = "quad_swarm_rti"
_SOURCES = Path(__file__).parent


class RtiSolver:
    """Solver with few iterations of sequential quadratic programming on batches of problems (docs/planner.md).

    The result is a good controller rather than a converged optimum. The states of an initial guess are not used, since
    they follow from its inputs.

    :param problem: the problem
    :param sqp_iterations: number of quadratic programs solved for each problem
    :param extra_iterations: maximum number of additional quadratic programs for a problem whose inputs still changed by
        more than 0.3 of their limits
    :param precision: precision of the iteration, "float32" or "float64"; plans are rolled out in double precision
    :param max_iterations: number of interior-point iterations after which a quadratic program counts as failed. There
        is no time limit, so that results are reproducible
    :param tolerance: mean complementarity at which a quadratic program counts as solved
    :raises ValueError: if a number of iterations or the precision is invalid, or the method cannot solve the problem,
        whose class may be the user's
    """

    name = "rti"

    def __init__(
        self,
        problem: OptimalControlProblem,
        sqp_iterations: int = 2,
        extra_iterations: int = 6,
        precision: str = "float32",
        max_iterations: int = 50,
        tolerance: float = 1e-4,
    ):
        if sqp_iterations < 1 or extra_iterations < 0 or max_iterations < 1:
            raise ValueError(
                f"sqp_iterations={sqp_iterations} and max_iterations={max_iterations} must be at least 1, "
                f"extra_iterations={extra_iterations} at least 0."
            )
        if precision not in PRECISIONS:
            raise unknown_name("precision", precision, PRECISIONS)
        self.problem = problem
        self.sqp_iterations = sqp_iterations
        self.extra_iterations = extra_iterations
        self.precision = precision
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self._kernel: Any = None
        _generated(problem)  # raises if the method cannot solve it

    def compile(self) -> None:
        """Compile and load the kernel now instead of at the first solve.

        :raises BuildError: if it cannot be compiled
        """
        if self._kernel is None:
            library = build_kernel(_generated(self.problem), self.precision)
            self._kernel = getattr(load(str(library), _FUNCTION), _FUNCTION)
            self._kernel.argtypes = [ctypes.c_int64, *[ctypes.c_void_p] * 9, *[ctypes.c_int64] * 3, ctypes.c_double]

    def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """See `Solver.solve`."""
        self.compile()
        count, horizon, n_others = problems.x.shape[0], self.problem.config.horizon, self.problem.n_others
        clearance = problems.clearance
        arguments = (
            _array("x", problems.x, (count, N_STATES)),
            _array("goal", problems.goal, (count, 3)),
            _array("others", problems.others, (count, n_others, horizon, 3)),
            None if clearance is None else _array("clearance", clearance, (count, n_others, horizon)),
            _array("u_guess", u_guess, (count, horizon, N_INPUTS)),
        )
        solution = Solution(
            x=np.empty((count, horizon + 1, N_STATES)),
            u=np.empty((count, horizon, N_INPUTS)),
            success=np.empty(count, dtype=bool),
            iterations=np.empty(count, dtype=np.int64),
        )
        self._kernel(
            count,
            *addresses(*arguments, *solution),
            self.sqp_iterations,
            self.extra_iterations,
            self.max_iterations,
            self.tolerance,
        )
        return solution

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_kernel": None}  # loaded on demand in another process


def build_kernel(model: str, precision: str) -> Path:
    """Build the kernel of a problem, see `build`.

    :param model: header from `generate_model`
    :param precision: one of `PRECISIONS`
    :return: path of the library
    """
    sources = {name: (_SOURCES / name).read_text(encoding="utf-8") for name in ("lanes.hpp", "kernel.cpp")}
    return build("rti", "kernel.cpp", {**sources, "model.hpp": model}, [f"REAL={PRECISIONS[precision]}"])


_models: dict[tuple[object, ...], str] = {}


def _generated(problem: OptimalControlProblem) -> str:
    """Return the header of a problem from a cache by its formulas, whoever wrote them."""
    key = formulas(problem)
    if key not in _models:
        while len(_models) >= 64:
            _models.pop(next(iter(_models)))
        _models[key] = generate_model(problem)
    return _models[key]


def _array(name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Convert an array for the kernel and check its shape, which the kernel does not."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; this solver takes {shape}.")
    return array
