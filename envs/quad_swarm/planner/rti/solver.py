"""The batched real-time iteration, which solves a batch of problems in one call of compiled code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.errors import unknown_name
from quad_swarm.native.build import build, load
from quad_swarm.native.signature import Signature
from quad_swarm.planner.base import Solution
from quad_swarm.planner.problem import OptimalControlProblem, Problems
from quad_swarm.planner.rti.codegen import formulas, generate_model
from quad_swarm.quadrotor import N_INPUTS, N_STATES

# Precision of the iteration -> type in C++
PRECISIONS = {"float32": "float", "float64": "double"}
_SOURCES = Path(__file__).parent

# B problems of N stages with m others
SIGNATURE = Signature(
    "quad_swarm_rti",
    "B",
    x=f"B {N_STATES} f8",
    goal="B 3 f8",
    others="B m N 3 f8",
    clearance="B m N f8 optional",
    shape="B m 3 f8 optional",
    size="B m f8 optional",
    reference="B N 3 f8 optional",
    reference_weight="B N f8 optional",
    disturbance="B 3 f8 optional",
    steady_input=f"B {N_INPUTS} f8 optional",
    u_guess=f"B N {N_INPUTS} f8",
    x_plan=f"B N+1 {N_STATES} f8 out",
    u_plan=f"B N {N_INPUTS} f8 out",
    success="B bool out",
    iterations="B i8 out",
    sqp_iterations="int",
    extra_iterations="int",
    max_iterations="int",
    tolerance="real",
    result=Solution,
)
# What the function takes of problems
_GIVEN = tuple(name for name in SIGNATURE.parameters if name in Problems._fields)


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
        self._kernel: Callable[..., Any] | None = None
        _generated(problem)  # raises if the method cannot solve it

    def compile(self) -> None:
        """Compile and load the kernel now instead of at the first solve.

        :raises BuildError: if it cannot be compiled
        """
        self._compiled()

    def _compiled(self) -> Callable[..., Any]:
        if self._kernel is None:
            library = load(str(build_kernel(_generated(self.problem), self.precision)), SIGNATURE.name)
            self._kernel = SIGNATURE.of(library, N=self.problem.config.horizon, m=self.problem.n_others)
        return self._kernel

    def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """See `Solver.solve`.

        :raises ValueError: if an array has another shape than the problem's
        """
        problems = problems.penalised(self.problem.config.separation)
        given = {
            name: None if (array := getattr(problems, name)) is None else np.asarray(array, float) for name in _GIVEN
        }
        return self._compiled()(
            **given,
            u_guess=np.asarray(u_guess, float),
            sqp_iterations=self.sqp_iterations,
            extra_iterations=self.extra_iterations,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
        )

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
