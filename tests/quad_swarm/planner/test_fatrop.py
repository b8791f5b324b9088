"""The reference solver: its optimum against an independent transcription, and an end whatever it is given."""

import math
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from planning import QUADROTOR, crossing, hover, unit

from quad_swarm.planner import (
    FatropSolver,
    OptimalControlProblem,
    PlannerConfig,
    Plans,
    PlanStatus,
    Problems,
    make_planner,
)
from quad_swarm.planner.fatrop import transcribe
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

CONFIG = PlannerConfig()
PROBLEM = OptimalControlProblem(CONFIG, QUADROTOR, 1)


@pytest.mark.parametrize("distance", [1.0, 18.0, 30.0, 45.0, 1e3, 1e5])
def test_derivatives_are_finite_however_far_the_others_are(distance):
    nlp = transcribe(PROBLEM).nlp
    hessian, gradient = ca.hessian(nlp["f"], nlp["x"])
    derivatives = ca.Function("derivatives", [nlp["x"], nlp["p"]], [hessian, gradient])
    parameters = np.zeros(nlp["p"].numel())
    parameters[-3 * CONFIG.horizon :: 3] = distance
    for values in derivatives(np.zeros(nlp["x"].numel()), parameters):
        assert np.isfinite(values.full()).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6, 1e200])
def test_what_is_no_state_fails_without_a_solve(value):
    x = np.zeros((1, 9))
    x[0, 3] = value
    problems = Problems(x, np.zeros((1, 3)), np.ones((1, 1, CONFIG.horizon, 3)))
    guess = np.zeros((1, CONFIG.horizon + 1, 9)), np.zeros((1, CONFIG.horizon, 4))
    solution = FatropSolver(PROBLEM).solve(problems, *guess)
    assert (solution.success[0], solution.iterations[0]) == (False, 0)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["attitude=1.5", "pos=1e3", "vel=1e3"])
def test_every_solve_ends(noise):
    name, value = noise.split("=")
    code = f"""
import numpy as np
from quad_swarm import QuadSwarmEnv
env = QuadSwarmEnv(solver="fatrop", noise={{"{name}": {value}}})
env.reset(seed=0)
for _ in range(6):
    assert np.isfinite(env.step(np.zeros(12))[0]).all()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=500, capture_output=True)


def single_shooting_cost(config: PlannerConfig, n_others: int) -> ca.Function:
    """Eq. (2) written a second time: states eliminated, violations penalised directly instead of by slacks."""
    problem = OptimalControlProblem(config, QUADROTOR, n_others)
    x0, u = ca.SX.sym("x0", 9), ca.SX.sym("u", 3, config.horizon)
    goal, others = ca.SX.sym("goal", 3), ca.SX.sym("others", 3, config.horizon * n_others)
    model = QuadrotorModel(QUADROTOR, config.dt)
    x, cost = x0[:8], ca.SX(0)
    for k in range(config.horizon):
        cost += config.input_weight * sum((u[i, k] / problem.max_input[i]) ** 2 for i in range(3))
        x = problem.dynamics(x, u[:, k])
        for j in range(n_others):
            d = ca.norm_2(x[:3] - others[:, j * config.horizon + k])
            sigmoid = 1 / (1 + ca.exp(config.repulsion_steepness * (d / config.separation - config.repulsion_buffer)))
            cost += config.repulsion_weight * sigmoid**2
            cost += config.violation_weight * ca.fmax(config.separation - d, 0) ** 2
        cost += config.violation_weight * ca.sumsqr(ca.fmax(problem.box_violations(x), 0))
    cost += config.goal_weight * ca.sumsqr(x[:3] - goal) / ca.fmax(ca.sumsqr(x0[:3] - goal), 1)
    assert model.dt == config.dt
    return ca.Function("cost", [u, x0, goal, others], [cost])


@pytest.mark.parametrize("horizon", [5, 10])
def test_finds_what_ipopt_finds_on_another_transcription(horizon):
    config = PlannerConfig(horizon=horizon)
    problems = crossing(12, config)
    plans = make_planner(config, QUADROTOR, 3, "fatrop").plan(problems, hover(problems, config))
    assert (plans.status == PlanStatus.SOLVED).all()
    cost = single_shooting_cost(config, 2)
    u = ca.SX.sym("u", 3, horizon)
    p = ca.SX.sym("p", 9), ca.SX.sym("g", 3), ca.SX.sym("o", 3, horizon * 2)
    ipopt = ca.nlpsol(
        "ipopt",
        "ipopt",
        {"x": ca.vec(u), "f": cost(u, *p), "p": ca.vertcat(*map(ca.vec, p))},
        {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes"},
    )
    limit = np.tile([config.max_tilt, config.max_tilt, config.max_climb_rate], horizon)
    for b in range(len(problems.x)):
        mine = plans.u[b, :, :3]
        parameters = np.concatenate([problems.x[b], problems.goal[b], problems.others[b].ravel()])
        reference = ipopt(x0=mine.ravel(), p=parameters, lbx=-limit, ubx=limit)
        assert ipopt.stats()["success"]
        my_cost = float(cost(mine.T, problems.x[b], problems.goal[b], problems.others[b].reshape(-1, 3).T))
        # Started from the plan, an exact solver finds nothing noticeably better.
        assert my_cost == pytest.approx(float(reference["f"]), rel=1e-3, abs=1e-3)


def test_plans_obey_dynamics_and_limits():
    config = PlannerConfig()
    problems = crossing(10, config)
    plans = make_planner(config, QUADROTOR, 3, "fatrop").plan(problems, hover(problems, config))
    model = QuadrotorModel(QUADROTOR, config.dt)
    np.testing.assert_allclose(plans.x, model.rollout(problems.x, plans.u), atol=1e-4)
    limits = np.array([config.max_tilt, config.max_tilt, config.max_climb_rate, 0.0])
    assert (np.abs(plans.u) <= limits + 1e-6).all()
    assert np.array_equal(plans.x[:, 0], problems.x)


def test_keeps_the_separation_where_it_can():
    config = PlannerConfig()
    x = np.zeros((1, 9))
    x[0, :4] = [-1.5, 0, 1.5, 1.0]
    standing = np.tile([0.0, 0.05, 1.5], (config.horizon, 1))
    problems = Problems(x, np.array([[3.0, 0, 1.5]]), standing[None, None])
    planner = make_planner(config, QUADROTOR, 2, "fatrop")
    plans = hover(problems, config)
    closest = np.inf
    for _ in range(40):
        plans = planner.plan(problems, plans)
        problems = problems._replace(x=plans.x[:, 1])
        closest = min(closest, np.linalg.norm(problems.x[0, :3] - standing[0]))
    assert closest > config.separation - 1e-3
    assert np.linalg.norm(problems.x[0, :3] - problems.goal[0]) < 0.1


def test_order_of_the_others_does_not_matter():
    config = PlannerConfig()
    problems = crossing(6, config, n_others=3)
    swapped = problems._replace(others=problems.others[:, [2, 0, 1]])
    planner = make_planner(config, QUADROTOR, 4, "fatrop")
    first = planner.plan(problems, hover(problems, config))
    second = planner.plan(swapped, hover(problems, config))
    np.testing.assert_allclose(first.x, second.x, atol=2e-3)


def test_yaw_can_be_planned_too():
    config = PlannerConfig(max_yaw_rate=math.radians(90))
    problems = crossing(2, config)
    problems.x[:, 8] = [0.5, -0.5]
    plans = make_planner(config, QUADROTOR, 3, "fatrop").plan(problems, hover(problems, config))
    assert (plans.status == PlanStatus.SOLVED).all()
    assert (np.abs(plans.x[:, -1, 8]) < 0.05).all()


def test_a_batch_solves_each_problem_as_if_alone():
    config = PlannerConfig()
    problems = crossing(5, config)
    planner = make_planner(config, QUADROTOR, 3, "fatrop")
    together = planner.plan(problems, hover(problems, config))
    for b in range(5):
        alone = problems.part(slice(b, b + 1))
        assert np.array_equal(planner.plan(alone, hover(alone, config)).x[0], together.x[b])


@pytest.mark.parametrize("gap", [0.7, 1.0, 1.5])
def test_a_robot_exactly_in_line_is_flown_around(gap):
    """Neither side is nearer: the solver stopped in front of it for ever."""
    planner = make_planner(PlannerConfig(), QuadrotorParams(), 2, "fatrop")
    x, goal = np.zeros((1, 9)), np.array([[2.0, 0.0, 1.5]])
    x[0, :3] = -2.0, 0.0, 1.5
    other = np.tile(np.array([-2 + gap, 0.0, 1.5]), (1, 1, planner.config.horizon, 1))
    plans, closest = Plans.hover(x, planner.config.horizon), np.inf
    for _ in range(60):
        plans = planner.plan(Problems(x, goal, other), plans)
        assert plans.status[0] == 0
        x = planner.model.rollout(x, plans.u[:, :1])[:, 1]
        closest = min(closest, float(np.linalg.norm(x[0, :3] - other[0, 0, 0])))
    assert np.linalg.norm(x[0, :3] - goal[0]) < 0.1
    assert closest > 0.59


@pytest.mark.parametrize("towards", [(3.0, 0.0, 0.0), (2.0, 2.0, 0.0)])
@pytest.mark.parametrize("distance", [0.0, 0.1, 0.3, 0.5, 0.6, 1.0, 1.5])
def test_a_robot_leaves_another_that_it_overlaps_or_that_is_in_line(distance, towards):
    config, model = PlannerConfig(), QuadrotorModel(QUADROTOR, 0.1)
    planner = make_planner(config, QUADROTOR, 2, "fatrop")
    state = np.zeros((1, 9))
    state[0, 2] = 1.5
    goal = state[:, :3] + towards
    others = np.tile(state[0, :3] + distance * unit(np.array(towards)), (1, 1, 10, 1))
    plans = Plans.hover(state, config.horizon)
    for _ in range(80):
        plans = planner.plan(Problems(state, goal, others), plans)
        assert plans.status[0] == PlanStatus.SOLVED
        state = model.step(state, plans.u[:, 0])
    assert np.linalg.norm(state[0, :3] - goal) < 0.1


def test_points_that_are_not_stationary_have_failed():
    config = PlannerConfig()
    problems = crossing(4, config)
    problem = OptimalControlProblem(config, QUADROTOR, 2)
    guess = np.repeat(problems.x[:, None], 11, axis=1), np.zeros((4, 10, 4))
    assert FatropSolver(problem).solve(problems, *guess).success.all()
    assert not FatropSolver(problem, max_iterations=3).solve(problems, *guess).success.any()
