"""The reference solver's optimum against an independent transcription, and every level of the fallback chain."""

import math
import pickle

import casadi as ca
import numpy as np
import pytest

from quad_swarm.planner import (
    FatropSolver,
    OptimalControlProblem,
    Planner,
    PlannerConfig,
    Plans,
    PlanStatus,
    Problems,
    Solution,
    make_planner,
)
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

QUADROTOR = QuadrotorParams()


def crossing(count: int, config: PlannerConfig, n_others: int = 2, seed: int = 0) -> Problems:
    """Robots in flight with others that cross their way."""
    rng = np.random.default_rng(seed)
    x = np.zeros((count, 9))
    x[:, :3] = rng.uniform([-2, -2, 1], [2, 2, 2], (count, 3))
    x[:, 3:5] = rng.uniform(-2, 2, (count, 2))
    start = x[:, None, :3] + rng.uniform(0.8, 1.5, (count, n_others, 1)) * unit(rng.normal(size=(count, n_others, 3)))
    velocity = rng.uniform(-1.5, 1.5, (count, n_others, 3)) * [1, 1, 0.2]
    times = config.dt * np.arange(1, config.horizon + 1)
    others = start[:, :, None] + times[:, None] * velocity[:, :, None]
    return Problems(x, rng.uniform([-4, -4, 0.7], [4, 4, 2.1], (count, 3)), others)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def hover(problems: Problems, config: PlannerConfig) -> Plans:
    return Plans.hover(problems.x, config.horizon)


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
        alone = Problems(*(field[b : b + 1] for field in problems))
        assert np.array_equal(planner.plan(alone, hover(alone, config)).x[0], together.x[b])


def test_a_bad_lane_brakes_and_leaves_its_neighbours_alone():
    config = PlannerConfig()
    problems = crossing(3, config)
    planner = make_planner(config, QUADROTOR, 3, "fatrop")
    good = planner.plan(problems, hover(problems, config))
    broken = problems._replace(others=problems.others.copy())
    broken.others[1, 0, 3] = np.nan
    last = hover(problems, config)._replace(age=np.full(3, config.horizon))  # the last plan is used up
    plans = planner.plan(broken, last)
    assert plans.status.tolist() == [PlanStatus.SOLVED, PlanStatus.BRAKING, PlanStatus.SOLVED]
    assert np.array_equal(plans.x[[0, 2]], good.x[[0, 2]])
    assert np.isfinite(plans.x).all()
    assert np.isfinite(plans.u).all()


def test_flies_the_last_plan_on_while_it_lasts_and_then_brakes():
    config = PlannerConfig(horizon=5)
    problems = crossing(1, config)
    model = QuadrotorModel(QUADROTOR, config.dt)
    problem = OptimalControlProblem(config, QUADROTOR, 2)
    plans = Planner(FatropSolver(problem), model, config).plan(problems, hover(problems, config))
    failing = Planner(FatropSolver(problem, max_iterations=1), model, config)
    first = plans
    statuses = []
    for k in range(1, 7):
        problems = problems._replace(x=plans.x[:, 1])
        plans = failing.plan(problems, plans)
        statuses.append(plans.status[0])
        if k < config.horizon:
            assert np.array_equal(plans.u[0, : config.horizon - k], first.u[0, k:])
            np.testing.assert_allclose(plans.x[0, : config.horizon - k + 1], first.x[0, k:], atol=1e-3)
    assert statuses == [PlanStatus.SHIFTED] * 4 + [PlanStatus.BRAKING] * 2


class Faulty:
    """A solver that breaks its contract."""

    name = "faulty"

    def __init__(self, fault: str):
        self.fault = fault

    def solve(self, problems, x_guess, u_guess):
        if self.fault == "raises":
            raise ZeroDivisionError("in the solver")
        x, u = x_guess.copy(), u_guess.copy()
        (x if self.fault == "x" else u)[0, 1] = np.nan
        count = len(x)
        return Solution(x, u, np.ones(count, dtype=bool), np.zeros(count, dtype=np.int64))


@pytest.mark.filterwarnings("ignore:the solver 'faulty' raised")
@pytest.mark.parametrize("fault", ["x", "u", "raises"])
def test_a_solver_that_breaks_its_contract_has_failed(fault):
    config = PlannerConfig()
    problems = crossing(3, config)
    planner = Planner(Faulty(fault), QuadrotorModel(QUADROTOR, config.dt), config)
    plans = planner.plan(problems, hover(problems, config))
    assert np.isfinite(plans.x).all()
    assert np.isfinite(plans.u).all()
    failed = plans.status >= PlanStatus.SHIFTED
    assert failed.tolist() == ([True] * 3 if fault == "raises" else [True, False, False])


def test_a_solver_that_raises_is_told_of():
    config = PlannerConfig()
    problems = crossing(1, config)
    planner = Planner(Faulty("raises"), QuadrotorModel(QUADROTOR, config.dt), config)
    with pytest.warns(RuntimeWarning, match="'faulty' raised ZeroDivisionError"):
        planner.plan(problems, hover(problems, config))


def test_a_cold_retry_rescues_a_hopeless_guess():
    config = PlannerConfig()
    problems = crossing(2, config)
    planner = make_planner(config, QUADROTOR, 3, "fatrop")
    absurd = hover(problems, config)._replace(x=np.full((2, config.horizon + 1, 9), np.nan))
    plans = planner.plan(problems, absurd)
    assert (plans.status == PlanStatus.RETRIED).all()


def test_braking_stops_from_full_speed():
    planner = make_planner(PlannerConfig(horizon=60), QUADROTOR, 2, "fatrop")
    x = np.zeros((1, 9))
    x[0, 3:6] = [3.0, -3.0, 1.0]
    states = planner.model.rollout(x, planner.braking_inputs(x))
    assert np.linalg.norm(states[0, -1, 3:6]) < 0.05
    assert np.abs(states[0, :, 6:8]).max() <= planner.config.max_tilt * QUADROTOR.roll_gain + 1e-9


def test_survives_pickling():
    config = PlannerConfig()
    problems = crossing(2, config)
    planner = make_planner(config, QUADROTOR, 3, "fatrop")
    expected = planner.plan(problems, hover(problems, config))
    copy = pickle.loads(pickle.dumps(planner))
    assert np.array_equal(copy.plan(problems, hover(problems, config)).x, expected.x)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"horizon": 1}, "horizon=1: it must be greater than or equal to 2"),
        ({"dt": 0.0}, r"dt=0\.0"),
        ({"max_tilt": 1.6}, r"max_tilt=1\.6: it must be less than 1\.57"),
        ({"input_weight": float("nan")}, "input_weight=nan: it must be a finite number"),
        ({"separation": -1.0}, r"separation=-1\.0"),
        ({"workspace_low": (5.0, -4.8, 0.48)}, "Empty workspace"),
    ],
)
def test_refuses_senseless_settings(values, message):
    with pytest.raises(ValueError, match=message):
        PlannerConfig(**values)


def test_suggests_the_solver_that_was_meant():
    with pytest.raises(ValueError, match="Did you mean 'fatrop'"):
        make_planner(PlannerConfig(), QUADROTOR, 2, solver="fatrob")
