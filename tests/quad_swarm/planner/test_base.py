"""Every level of the fallback chain, and which of the others a plan considers."""

import dataclasses

import numpy as np
import pytest
from planning import QUADROTOR, assert_same, crossing, hover, scattered

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
from quad_swarm.quadrotor import QuadrotorModel


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
        count = len(x)
        success, iterations = np.ones(count, dtype=bool), np.zeros(count, dtype=np.int64)
        if self.fault == "form":
            return x, u, success
        if self.fault == "shape of x":
            return Solution(x[:, :-1], u, success, iterations)
        if self.fault == "shape of u":
            return Solution(x, u[..., :3], success, iterations)
        if self.fault == "numbers for success":
            return Solution(x, u, success.astype(int), iterations)
        (x if self.fault == "x" else u)[0, 1] = np.nan
        return Solution(x, u, success, iterations)


@pytest.mark.filterwarnings("ignore:the solver 'faulty' raised")
@pytest.mark.parametrize("fault", ["x", "u", "raises", "form", "shape of x", "shape of u", "numbers for success"])
def test_a_solver_that_breaks_its_contract_has_failed(fault):
    config = PlannerConfig()
    problems = crossing(3, config)
    planner = Planner(Faulty(fault), QuadrotorModel(QUADROTOR, config.dt), config)
    plans = planner.plan(problems, hover(problems, config))
    assert np.isfinite(plans.x).all()
    assert np.isfinite(plans.u).all()
    failed = plans.status >= PlanStatus.SHIFTED
    assert failed.tolist() == ([True, False, False] if fault in ("x", "u") else [True] * 3)


def test_a_solution_of_lists_or_of_arrays_that_cannot_be_written_is_as_good():
    class Plain(FatropSolver):
        form = staticmethod(np.asarray)

        def solve(self, *arguments):
            solution = super().solve(*arguments)
            return Solution(*map(self.form, solution))

    class Lists(Plain):
        form = staticmethod(np.ndarray.tolist)

    class Frozen(Plain):
        @staticmethod
        def form(array):
            array.setflags(write=False)
            return array

    config = PlannerConfig(horizon=3)
    problems = crossing(3, config)
    problems.others[1] = np.nan  # one fails, and the planner writes into its place
    model = QuadrotorModel(QUADROTOR, config.dt)
    plans = [
        Planner(kind(OptimalControlProblem(config, QUADROTOR, 2)), model, config).plan(
            problems, hover(problems, config)
        )
        for kind in (Plain, Lists, Frozen)
    ]
    assert plans[0].status.tolist() == [PlanStatus.SOLVED, PlanStatus.SHIFTED, PlanStatus.SOLVED]
    assert_same(plans[1], plans[0])
    assert_same(plans[2], plans[0])


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


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_considers_only_the_nearest(solver):
    config = PlannerConfig(max_neighbours=2)
    (x, goal, others, *_), _, _ = scattered(config, 5, 4, scale=0.3)
    others += [3.0, 0, 0]
    others[:, [1, 3]] -= [2.0, 0, 0]  # these come nearer
    last = Plans.hover(x, config.horizon)
    limited = make_planner(config, QUADROTOR, 5, solver).plan(Problems(x, goal, others), last)
    two = make_planner(dataclasses.replace(config, max_neighbours=None), QUADROTOR, 3, solver)
    assert_same(limited, two.plan(Problems(x, goal, others[:, [1, 3]]), last))


def test_a_limit_above_the_number_of_others_changes_nothing():
    problems, _, _ = scattered(PlannerConfig(), 4, 2)
    last = Plans.hover(problems.x, 10)
    plans = [make_planner(PlannerConfig(max_neighbours=k), QUADROTOR, 3, "rti").plan(problems, last) for k in (None, 9)]
    assert_same(*plans)
