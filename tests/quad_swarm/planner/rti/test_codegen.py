"""The generated C++, read as arithmetic: what it computes is what the optimal control problem says."""

import dataclasses
import math
import re

import casadi as ca
import numpy as np
import pytest
from planning import QUADROTOR

from quad_swarm.planner import OptimalControlProblem, PlannerConfig
from quad_swarm.planner.rti.codegen import generate_model
from quad_swarm.quadrotor import QuadrotorModel

CONFIG = PlannerConfig(horizon=3)
YAW = PlannerConfig(horizon=3, max_yaw_rate=1.0)
# What the operations of lanes.hpp mean, on numbers
LANES = {
    "multiply_add": lambda a, b, c: a * b + c,
    "multiply_subtract": lambda a, b, c: a * b - c,
    "negative_multiply_add": lambda a, b, c: c - a * b,
    "square_root": math.sqrt,
    "exponential": math.exp,
    "tangent": math.tan,
    "cosine": math.cos,
    "maximum": max,
    "minimum": min,
    "splat": float,
}


class Generated:
    """A problem's header, whose functions can be called with arrays."""

    def __init__(self, problem: OptimalControlProblem):
        self.text = generate_model(problem)
        found = re.findall(r"constexpr (int|double) (\w+)(\[\])? = \{?(.*?)\}?;", self.text)
        self.constants = {name: np.array([float(part) for part in values.split(", ")]) for _, name, _, values in found}

    def call(self, name: str, *arrays: np.ndarray) -> dict[str, np.ndarray]:
        """What a function writes, by argument; matrices are given and come back column by column."""
        arguments, body = re.search(rf"inline void {name}\((.*?)\) \{{\n(.*?)\}}\n", self.text, re.DOTALL).groups()
        names = re.findall(r"__restrict (\w+)", arguments)
        given = [np.ravel(array, order="F").tolist() for array in arrays]
        written = {argument: {} for argument in names[len(given) :]}
        scope = {**LANES, **dict(zip(names, given, strict=False)), **written}
        exec(re.sub(r"const V |<V>|;|^ +", "", body, flags=re.MULTILINE), scope)
        return {argument: np.array([cells[k] for k in range(len(cells))]) for argument, cells in written.items()}


@pytest.fixture(params=[CONFIG, YAW], ids=["yaw held", "yaw planned"])
def problem(request) -> OptimalControlProblem:
    return OptimalControlProblem(request.param, QUADROTOR, 2)


def state_and_input(problem: OptimalControlProblem) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return 0.3 * rng.normal(size=problem.nx), 0.2 * rng.normal(size=problem.nu)


def symmetric(packed: np.ndarray, n: int) -> np.ndarray:
    """A matrix of its lower triangle row by row."""
    matrix = np.zeros((n, n))
    matrix[np.tril_indices(n)] = packed
    return matrix + np.tril(matrix, -1).T


def test_constants_are_the_problem_s(problem):
    constants = Generated(problem).constants
    sizes = {name: int(constants[name][0]) for name in ("N", "NX", "NU", "N_OTHERS", "N_BOUNDS")}
    assert sizes == {"N": 3, "NX": problem.nx, "NU": problem.nu, "N_OTHERS": 2, "N_BOUNDS": 6}
    assert constants["BOUNDED_STATE"].tolist() == [0, 1, 2, 3, 4, 5]
    assert constants["STATE_LOW"].tolist() == [*CONFIG.workspace_low, -4.0, -4.0, -1.5]
    assert constants["STATE_HIGH"].tolist() == [*CONFIG.workspace_high, 4.0, 4.0, 1.5]
    assert constants["VIOLATION_WEIGHT"] == 1e4
    limits = [CONFIG.max_tilt, CONFIG.max_tilt, 1.0, 1.0][: problem.nu]
    assert constants["MAX_INPUT"].tolist() == limits
    assert (-constants["MIN_INPUT"]).tolist() == limits


def test_descents_may_have_limits_of_their_own():
    config = dataclasses.replace(CONFIG, max_descent_rate=0.4, max_descent_speed=0.3)
    constants = Generated(OptimalControlProblem(config, QUADROTOR, 2)).constants
    assert (constants["MIN_INPUT"][2], constants["MAX_INPUT"][2]) == (-0.4, 1.0)
    assert (constants["STATE_LOW"][5], constants["STATE_HIGH"][5]) == (-0.3, 1.5)
    alike = dataclasses.replace(CONFIG, max_descent_rate=1.0, max_descent_speed=1.5)
    texts = [generate_model(OptimalControlProblem(one, QUADROTOR, 2)) for one in (CONFIG, alike)]
    assert texts[0] == texts[1]


def test_every_number_of_the_problem_changes_the_text():
    text = generate_model(OptimalControlProblem(CONFIG, QUADROTOR, 2))
    assert text == generate_model(OptimalControlProblem(CONFIG, QUADROTOR, 2))
    for change in ({"goal_weight": 9.0}, {"dt": 0.2}, {"repulsion_steepness": 9.0}, {"separation": 0.7}):
        other = OptimalControlProblem(PlannerConfig(horizon=3, **change), QUADROTOR, 2)
        assert generate_model(other) != text


def test_dynamics_are_those_of_the_model(problem):
    x, u = state_and_input(problem)
    full_x, full_u = np.zeros((1, 9)), np.zeros((1, 4))
    full_x[0, : problem.nx], full_u[0, : problem.nu] = x, u
    turned = full_x[0, 8] + CONFIG.dt * full_u[0, 3]
    full_x[0, 8] = full_u[0, 3] = 0.0  # roll and pitch are about the world's axes
    expected = [*QuadrotorModel(QUADROTOR, CONFIG.dt).step(full_x, full_u)[0, :8], turned][: problem.nx]
    np.testing.assert_allclose(Generated(problem).call("dynamics", x, u)["x_next"], expected, atol=1e-12)


def test_derivatives_of_the_costs_are_those_of_the_problem(problem):
    generated = Generated(problem)
    rng = np.random.default_rng(1)
    x, x0, goal, other = (rng.normal(size=size) for size in (problem.nx, problem.nx, 3, 3))
    symbol = ca.SX.sym("x", problem.nx)
    hessian, gradient = ca.Function("goal", [symbol], ca.hessian(problem.goal_cost(symbol, x0, goal), symbol))(x)
    found = generated.call("goal_derivatives", x, x0, goal)
    np.testing.assert_allclose(found["gradient"], gradient.full().ravel(), atol=1e-12)
    np.testing.assert_allclose(symmetric(found["hessian"], problem.nx), hessian.full(), atol=1e-12)

    found = generated.call("separation", x, other)
    assert found["distance"] == pytest.approx(np.linalg.norm(x[:3] - other), abs=1e-5)
    assert found["gap"] == pytest.approx(found["distance"] - CONFIG.separation)
    np.testing.assert_allclose(found["direction"], (x[:3] - other) / found["distance"], atol=1e-9)

    d, step = 0.7, 1e-6
    around = [float(problem.repulsion_residual(d + sign * step)) for sign in (1, 0, -1)]
    slope = (around[0] - around[2]) / (2 * step)
    found = generated.call("repulsion", [d])
    assert found["gradient"] == pytest.approx(2 * around[1] * slope, rel=1e-6)
    assert found["curvature"] == pytest.approx(2 * slope**2, rel=1e-6)


def test_a_stage_of_the_riccati_recursion_is_that_of_dense_matrices(problem):
    generated = Generated(problem)
    nx, nu = problem.nx, problem.nu
    x, u = state_and_input(problem)
    symbols = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    jacobians = [ca.jacobian(problem.dynamics(*symbols), symbol) for symbol in symbols]
    a, b = (ca.Function("jacobian", symbols, [jacobian])(x, u).full() for jacobian in jacobians)
    varying = generated.call("linearise", x, u)

    rng = np.random.default_rng(2)
    root, weight = rng.normal(size=(nx, nx)), rng.uniform(0, 1, nu)
    p = root @ root.T
    found = generated.call("riccati", p[np.tril_indices(nx)], varying["a"], varying["b"], weight)
    limits = problem.max_input.full().ravel()
    r = np.diag(2 * CONFIG.input_weight / limits**2 + weight) + b.T @ p @ b
    gain = -np.linalg.solve(r, b.T @ p @ a)
    np.testing.assert_allclose(found["gain"].reshape(nx, nu).T, gain, rtol=1e-8, atol=1e-10)
    previous = a.T @ p @ a + a.T @ p @ b @ gain
    np.testing.assert_allclose(symmetric(found["p_previous"], nx), previous, rtol=1e-8, atol=1e-8)

    dx, feedforward = rng.normal(size=nx), rng.normal(size=nu)
    forward = generated.call("forward", dx, feedforward, gain, varying["a"], varying["b"])
    np.testing.assert_allclose(forward["du"], feedforward + gain @ dx, atol=1e-10)
    np.testing.assert_allclose(forward["dx_next"], a @ dx + b @ forward["du"], atol=1e-10)


class Spinning(OptimalControlProblem):
    def dynamics(self, x, u):
        return ca.atan(super().dynamics(x, u))


class Cornered(OptimalControlProblem):
    def box_violations(self, x):
        return x[0] * x[1]


class Diagonal(OptimalControlProblem):
    def box_violations(self, x):
        return x[0] + x[1] - 1


class Scaled(OptimalControlProblem):
    def box_violations(self, x):
        return 2 * super().box_violations(x)


class Twice(OptimalControlProblem):
    def box_violations(self, x):
        return ca.vertcat(super().box_violations(x), x[0] - 1)


class Unbounded(OptimalControlProblem):
    def box_violations(self, x):
        return ca.SX.zeros(0, 1)


class Quartic(OptimalControlProblem):
    def input_cost(self, u):
        return ca.sumsqr(u) ** 2


class Steeper(OptimalControlProblem):
    def repulsion_cost(self, distance):
        return 2 * super().repulsion_cost(distance)


class Foresighted(OptimalControlProblem):
    def distances(self, x, others):
        return [ca.norm_2(x[:3] + 0.1 * x[3:6] - others[:, j]) for j in range(self.n_others)]


class Respectful(OptimalControlProblem):
    def distances(self, x, others):
        return [one - 0.1 * j for j, one in enumerate(super().distances(x, others))]


class Few(OptimalControlProblem):
    def distances(self, x, others):
        return super().distances(x, others)[:1]


class Larger(OptimalControlProblem):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.nx = 12


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Spinning, "no lane form"),
        (Cornered, "box_violations must be bounds"),
        (Diagonal, "box_violations must be bounds"),
        (Scaled, "box_violations must be bounds"),
        (Twice, "box_violations must be bounds"),
        (Unbounded, "box_violations must bound at least one state"),
        (Quartic, "input_cost must be quadratic"),
        (Steeper, "repulsion_cost must be the square of repulsion_residual"),
        (Foresighted, "distances must depend on the two positions only"),
        (Respectful, "distances must depend on the two positions only, in the same way"),
        (Few, "distances must be one for each of the 2 others, not 1"),
        (Larger, "nx and nu must be at most 9 and 4, not 12 and 3"),
    ],
)
def test_what_the_method_cannot_solve_is_refused(kind, message):
    with pytest.raises(ValueError, match=message) as error:
        generate_model(kind(CONFIG, QUADROTOR, 2))
    assert "solver='fatrop'" in str(error.value)
