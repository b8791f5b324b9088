"""The optimal control problem: each of its terms against its formula, and settings that make no sense."""

import math

import casadi as ca
import foreign
import numpy as np
import pytest
from planning import QUADROTOR

from quad_swarm.planner import OptimalControlProblem, PlannerConfig
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

CONFIG = PlannerConfig()
PROBLEM = OptimalControlProblem(CONFIG, QUADROTOR, 2)
WITH_YAW = OptimalControlProblem(PlannerConfig(max_yaw_rate=1.0), QUADROTOR, 1)


def number(expression, *values) -> np.ndarray:
    """The value of a term; ``expression`` takes CasADi symbols of the values' shapes."""
    symbols = [ca.SX.sym("s", *np.shape(value)) for value in values]
    terms = expression(*symbols)
    terms = ca.vertcat(*terms) if isinstance(terms, list) else terms
    return ca.Function("f", symbols, [terms])(*values).full().ravel()


@pytest.mark.parametrize("problem", [PROBLEM, WITH_YAW], ids=["yaw held", "yaw planned"])
def test_dynamics_are_those_of_the_model(problem):
    rng = np.random.default_rng(0)
    x, u = 0.3 * rng.normal(size=9), 0.2 * rng.normal(size=4)
    x[problem.nx :], u[problem.nu :] = 0.0, 0.0
    found = number(problem.dynamics, x[: problem.nx], u[: problem.nu])
    turned = x[8] + CONFIG.dt * u[3]
    x[8] = u[3] = 0.0  # roll and pitch are about the world's axes
    expected = [*QuadrotorModel(QUADROTOR, CONFIG.dt).step(x[None], u[None])[0, :8], turned]
    np.testing.assert_allclose(found, expected[: problem.nx], atol=1e-12)


def test_a_held_yaw_is_no_variable():
    assert (PROBLEM.nx, PROBLEM.nu) == (8, 3)
    assert (WITH_YAW.nx, WITH_YAW.nu) == (9, 4)
    assert WITH_YAW.max_input.full().ravel().tolist() == [CONFIG.max_tilt, CONFIG.max_tilt, 1.0, 1.0]


def test_inputs_cost_by_their_limits():
    at_limits = number(PROBLEM.input_cost, PROBLEM.max_input.full().ravel())
    assert at_limits == pytest.approx(3 * CONFIG.input_weight)
    assert number(PROBLEM.input_cost, [0.0, 0.0, 0.5]) == pytest.approx(CONFIG.input_weight * 0.25)


@pytest.mark.parametrize(("rate", "larger"), [(0.5, 1.0), (2.0, 2.0)])
def test_climbs_and_descents_cost_by_the_larger_of_their_limits(rate, larger):
    problem = OptimalControlProblem(PlannerConfig(max_descent_rate=rate), QUADROTOR, 1)
    assert problem.min_input.full().ravel().tolist() == [-CONFIG.max_tilt, -CONFIG.max_tilt, -rate]
    for climb in (-0.4, 0.4):
        cost = CONFIG.input_weight * (0.4 / larger) ** 2
        assert number(problem.input_cost, [0.0, 0.0, climb]) == pytest.approx(cost)


def test_another_limit_of_a_user_s_problem_holds_in_both_directions():
    assert foreign.Gentle(CONFIG, QUADROTOR, 1).min_input.full().ravel()[0] == pytest.approx(-0.1 * CONFIG.max_tilt)


@pytest.mark.parametrize(
    ("start", "cost"),
    [
        ([5.0, 0, 1], 8.0 * 4 / 16),  # of 4 m that were to go 2 m are left
        ([1.5, 0, 1], 8.0 * 4),  # nearer than 1 m: not relative
    ],
)
def test_the_goal_s_cost_is_relative_to_the_way_to_go(start, cost):
    goal, end = [1.0, 0, 1], [1.0, 2, 1]
    found = number(PROBLEM.goal_cost, [*end, *[0.0] * 5], [*start, *[0.0] * 5], goal)
    assert found == pytest.approx(cost)


def test_a_planned_yaw_returns_to_zero():
    state = [1.0, 0, 1, 0, 0, 0, 0, 0, 0.5]
    assert number(WITH_YAW.goal_cost, state, [0.0] * 9, state[:3]) == pytest.approx(8.0 * 0.25)


def test_distances_have_a_gradient_where_centres_coincide():
    x, others = np.array([1.0, 0, 1, 0, 0, 0, 0, 0]), np.array([[1.0, 4], [0, 4], [1, 1]])
    np.testing.assert_allclose(number(PROBLEM.distances, x, others), [1e-3, 5.0], atol=1e-6)

    def gradient(x, others):
        return ca.gradient(PROBLEM.distances(x, others)[0], x)

    assert np.isfinite(number(gradient, x, others)).all()


def test_repulsion_is_half_at_the_buffer_and_gone_far_away():
    buffer = CONFIG.repulsion_buffer * CONFIG.separation
    assert number(PROBLEM.repulsion_residual, [buffer]) == pytest.approx(math.sqrt(CONFIG.repulsion_weight) / 2)
    assert number(PROBLEM.repulsion_cost, [buffer]) == pytest.approx(CONFIG.repulsion_weight / 4)
    assert number(PROBLEM.repulsion_cost, [0.0]) == pytest.approx(CONFIG.repulsion_weight, rel=1e-3)
    assert number(PROBLEM.repulsion_cost, [4 * buffer]) < 1e-12


@pytest.mark.parametrize(
    ("column", "value", "violation"),
    [(0, -5.0, 0.2), (1, 5.0, 0.2), (2, 0.4, 0.08), (3, 4.5, 0.5), (4, -4.5, 0.5), (5, 1.6, 0.1)],
)
def test_what_leaves_the_box_is_a_violation_by_so_much(column, value, violation):
    x = np.array([0.0, 0, 1, 0, 0, 0, 0, 0])
    assert (number(PROBLEM.box_violations, x) < 0).all()
    x[column] = value
    violations = number(PROBLEM.box_violations, x)
    assert violations[violations > 0] == pytest.approx([violation])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"horizon": 1}, "horizon=1: it must be greater than or equal to 2"),
        ({"dt": 0.0}, r"dt=0\.0"),
        ({"max_tilt": 1.6}, r"max_tilt=1\.6: it must be less than 1\.57 rad"),
        ({"max_descent_rate": 0.0}, r"max_descent_rate=0\.0: it must be greater than or equal to 0\.000001"),
        ({"max_descent_speed": -1.0}, r"max_descent_speed=-1\.0: it must be greater than 0"),
        ({"input_weight": float("nan")}, "input_weight=nan: it must be a finite number"),
        ({"separation": -1.0}, r"separation=-1\.0"),
        ({"workspace_low": (5.0, -4.8, 0.48)}, "Empty workspace"),
    ],
)
def test_refuses_senseless_settings(values, message):
    with pytest.raises(ValueError, match=message):
        PlannerConfig(**values)


@pytest.mark.parametrize(
    ("config", "quadrotor", "message"),
    [
        ({"max_tilt": 1.047}, {"pitch_gain": 2.0}, r"max_tilt=1\.047: .* tilt by 120 degrees; use at most 0\.785"),
        ({"dt": 0.7}, {}, r"dt=0\.7: steps must not exceed 0\.65 s"),
    ],
)
def test_a_planner_that_does_not_fit_its_vehicle_is_refused(config, quadrotor, message):
    with pytest.raises(ValueError, match=message):
        OptimalControlProblem(PlannerConfig(**config), QuadrotorParams(**quadrotor), 1)
