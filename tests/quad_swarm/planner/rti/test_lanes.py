"""The real-time iteration lane by lane: to the last bit, whatever is asked of it and of its neighbours."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning import QUADROTOR, Call, assert_same, scattered

from quad_swarm.planner import (
    FatropSolver,
    OptimalControlProblem,
    Planner,
    PlannerConfig,
    Plans,
    PlanStatus,
    Problems,
    RtiSolver,
    make_planner,
)
from quad_swarm.quadrotor import QuadrotorModel


def part(call: Call, index) -> Call:
    problems, x_guess, u_guess = call
    return problems.part(index), x_guess[index], u_guess[index]


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_problem_does_not_feel_its_batch(precision):
    config = PlannerConfig(horizon=6)
    solver = RtiSolver(OptimalControlProblem(config, QUADROTOR, 2), precision=precision)
    call = scattered(config, 45, 2)
    whole = solver.solve(*call)
    assert len(np.unique(whole.iterations)) > 5  # so that lanes do freeze at different times
    order = np.random.default_rng(1).permutation(45)
    assert_same(solver.solve(*part(call, order)), [field[order] for field in whole])
    for start, size in ((0, 1), (7, 1), (3, 2), (11, 5), (20, 9), (4, 17)):
        index = slice(start, start + size)
        assert_same(solver.solve(*part(call, index)), [field[index] for field in whole])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30, -1e200])
def test_absurd_problems_stay_in_their_lanes(bad):
    config = PlannerConfig(horizon=6)
    solver = RtiSolver(OptimalControlProblem(config, QUADROTOR, 2))
    call = scattered(config, 30, 2)
    expected = solver.solve(*call)
    (x, goal, others), x_guess, u_guess = ([field.copy() for field in call[0][:3]], call[1], call[2].copy())
    x[3, 0] = goal[8] = others[13, 1, 2] = x[17] = bad
    if np.isnan(bad):
        u_guess[25] = bad
    solution = solver.solve(Problems(x, goal, others), x_guess, u_guess)
    good = np.setdiff1d(np.arange(30), [3, 8, 13, 17, 25])
    assert_same([field[good] for field in solution], [field[good] for field in expected])
    finite = np.isfinite(solution.x).all((1, 2)) & np.isfinite(solution.u).all((1, 2))
    assert (finite | ~solution.success).all()
    if not np.isfinite(bad):
        assert not solution.success[[3, 8, 13, 17]].any()


@pytest.mark.slow
@given(seed=st.integers(0, 2**32), scale=st.floats(0.01, 20), n_others=st.sampled_from([1, 3]), yaw=st.booleans())
@settings(max_examples=60, deadline=None)
def test_plans_obey_dynamics_and_limits_whatever_is_asked(seed, scale, n_others, yaw):
    config = PlannerConfig(horizon=5, max_yaw_rate=math.pi / 2 if yaw else 0.0, max_descent_rate=0.6 if yaw else None)
    solver = RtiSolver(OptimalControlProblem(config, QUADROTOR, n_others))
    call = scattered(config, 7, n_others, seed, scale)
    plan = solver.solve(*call)
    reachable = np.abs(call[0].x[:, 6:8]).max(1) < 0.8  # rad; farther out the tangent is an approximation
    assert plan.success[reachable].all()
    assert np.isfinite(plan.x[reachable]).all()
    assert (np.abs(plan.u) <= [config.max_tilt, config.max_tilt, config.max_climb_rate, config.max_yaw_rate]).all()
    assert (plan.u[..., 2] >= -config.descent_rate).all()
    held, tilting = call[0].x.copy(), plan.u.copy()  # about the world's axes
    held[:, 8] = tilting[..., 3] = 0.0
    rolled = QuadrotorModel(QUADROTOR, config.dt).rollout(held, tilting)
    if yaw:
        rolled[..., 8] = call[0].x[:, 8:]
        rolled[:, 1:, 8] += config.dt * plan.u[..., 3].cumsum(axis=1)
    np.testing.assert_allclose(plan.x[reachable, 1:], rolled[reachable, 1:], rtol=1e-8, atol=1e-8)


def test_reports_what_it_could_not_solve():
    config = PlannerConfig(horizon=6)
    call = scattered(config, 20, 2)
    solution = RtiSolver(OptimalControlProblem(config, QUADROTOR, 2), max_iterations=2).solve(*call)
    assert not solution.success.all()
    assert (solution.iterations <= 4).all()
    assert np.isfinite(solution.x).all()


def test_the_fallback_chain_holds_the_failed_lane_only():
    config = PlannerConfig()
    problems, _, _ = scattered(config, 6, 3, scale=0.5)
    planner = make_planner(config, QUADROTOR, 4, "rti")
    last = Plans.hover(problems.x, config.horizon)
    good = planner.plan(problems, last)
    assert (good.status == PlanStatus.SOLVED).all()
    broken = problems._replace(others=problems.others.copy())
    broken.others[2, 0, 4] = np.nan
    planner.checks = False
    plans = planner.plan(broken, last)
    assert plans.status.tolist() == [PlanStatus.SHIFTED if k == 2 else PlanStatus.SOLVED for k in range(6)]
    assert_same([field[[0, 1, 3, 4, 5]] for field in plans], [field[[0, 1, 3, 4, 5]] for field in good])
    assert np.isfinite(plans.x).all()


def test_plans_the_yaw_too():
    config = PlannerConfig(max_yaw_rate=math.pi / 2)
    problem = OptimalControlProblem(config, QUADROTOR, 1)
    (x, goal, others, *_), x_guess, _ = scattered(config, 8, 1, scale=0.1)
    x[:, 2] += 1.5
    x[:, 8] *= 20
    goal[:, 2] = 1.0
    call = Problems(x, goal, others + np.array([1.2, 0, 1.5])), x_guess + x[:, None], np.zeros((8, config.horizon, 4))
    mine = RtiSolver(problem, 5, precision="float64", tolerance=1e-7).solve(*call)
    reference = FatropSolver(problem, 1e-6).solve(*call)
    assert mine.success.all()
    assert (np.abs(mine.u[:, 0, 3]) > 0.1).any()
    np.testing.assert_allclose(mine.x, reference.x, atol=1e-2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sqp_iterations": 0}, "sqp_iterations=0"),
        ({"max_iterations": 0}, "max_iterations=0"),
        ({"extra_iterations": -1}, "extra_iterations=-1"),
        ({"precision": "float23"}, "Did you mean 'float32'"),
    ],
)
def test_refuses_senseless_options(options, message):
    with pytest.raises(ValueError, match=message):
        RtiSolver(OptimalControlProblem(PlannerConfig(), QUADROTOR, 1), **options)


def test_refuses_arrays_of_another_problem():
    config = PlannerConfig()
    solver = RtiSolver(OptimalControlProblem(config, QUADROTOR, 3))
    with pytest.raises(ValueError, match=r"others has shape \(4, 2, 10, 3\)"):
        solver.solve(*scattered(config, 4, 2))
    planner = Planner(solver, QuadrotorModel(QUADROTOR, config.dt), config)
    problems, _, _ = scattered(config, 0, 3)
    assert planner.plan(problems, Plans.hover(problems.x, config.horizon)).x.shape == (0, 11, 9)
