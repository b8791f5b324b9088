"""The cost of plans is the objective that solvers minimise."""

import pickle

import foreign
import numpy as np
import pytest
from planning import QUADROTOR, crossing, hover

from quad_swarm.planner import (
    FatropSolver,
    OptimalControlProblem,
    PlanCost,
    PlannerConfig,
    Plans,
    Problems,
    RtiSolver,
    make_planner,
)


@pytest.mark.parametrize(("penalty", "shaped"), [(None, False), (None, True), ([1.0, 5.0], True)])
@pytest.mark.parametrize("n_others", [0, 2])
@pytest.mark.parametrize("kind", [OptimalControlProblem, foreign.Boat])
def test_is_the_objective_of_the_reference_solver(kind, n_others, shaped, penalty):
    """At its optimum, whose slacks are as small as they may be."""
    config = PlannerConfig()
    problem, problems = kind(config, QUADROTOR, n_others, shaped), crossing(4, config, n_others)
    about = [np.zeros((4, n_others, 10)), np.ones((4, n_others, 3)), np.zeros((4, n_others))]
    if shaped and n_others:
        about[1:] = [np.tile([[1, 1, 0.5], [1, 1, 0.0]], (4, 1, 1)), np.tile([0.2, -0.1], (4, 1))]
        problems = problems._replace(shape=about[1], size=about[2])
        if penalty:
            problems = problems._replace(penalty=np.tile(penalty, (4, 1)))
            scaled = problems.penalised(config.separation)
            about[1:] = scaled.shape, scaled.size
    solver = FatropSolver(problem, tolerance=1e-8)
    guess = np.repeat(problems.x[:, None], 11, axis=1), np.zeros((4, 10, 4))
    solution = solver.solve(problems, *guess)
    assert solution.success.all()
    cost, program = PlanCost(problem)(problems, solution.x, solution.u), solver._program
    for k in range(4):
        own, bodies = problems.x[k, : problem.nx], [problems.others[k].ravel(), *(one[k].ravel() for one in about)]
        variables = np.zeros(program.bounds["lbx"].size)
        variables[program.x_index] = solution.x[k, 1:, : problem.nx]
        variables[program.u_index] = solution.u[k, :, : problem.nu]
        found = solver._solver(x0=variables, p=np.concatenate([own, problems.goal[k], *bodies]), **program.bounds)
        assert cost[k] == pytest.approx(float(found["f"]), rel=1e-4, abs=1e-6)


def test_a_better_plan_costs_less():
    config = PlannerConfig()
    problem, problems = OptimalControlProblem(config, QUADROTOR, 2), crossing(20, config, 2)
    guess = np.repeat(problems.x[:, None], 11, axis=1), np.zeros((20, 10, 4))
    cost = pickle.loads(pickle.dumps(PlanCost(problem)))
    once, often = (RtiSolver(problem, n, 0).solve(problems, *guess) for n in (1, 8))
    assert np.median(cost(problems, often.x, often.u) - cost(problems, once.x, once.u)) <= 0
    assert cost(problems.part(slice(0)), once.x[:0], once.u[:0]).shape == (0,)


@pytest.mark.parametrize("clearance", [None, 0.1])
def test_a_penalty_multiplies_what_violations_cost(clearance):
    """A robot that hovers in contact with a pillar, and beside another robot, without repulsion."""
    config, count = PlannerConfig(repulsion_weight=0.0, separation=0.8), 3
    problem = OptimalControlProblem(config, QUADROTOR, 2, True)
    x = np.zeros((count, 11, 9))
    x[..., 2] = 1.0
    others = np.repeat(np.array([[0.5, 0.0, 3.0], [0.0, 0.7, 1.0]])[None, :, None], 10, axis=2)
    problems = Problems(x[:, 0], x[:, 0, :3], np.repeat(others, count, axis=0), size=np.tile([0.3, 0.0], (count, 1)))
    problems = problems._replace(shape=np.tile([[1, 1, 0], [1, 1, 1.0]], (count, 1, 1)))
    extra = 0.0 if clearance is None else clearance
    if clearance is not None:
        problems = problems._replace(clearance=np.full((count, 2, 10), clearance))
    problems = problems._replace(penalty=np.array([[1.0, 1.0], [9.0, 1.0], [0.5, 2.0]]))
    pillar, robot = (10 * config.violation_weight * (gap + extra) ** 2 for gap in (0.6, 0.1))
    cost = PlanCost(problem)(problems, x, np.zeros((count, 10, 4)))
    np.testing.assert_allclose(cost, [pillar + robot, 9 * pillar + robot, 0.5 * pillar + 2 * robot], rtol=1e-5)


def test_planners_compute_costs_on_request_only():
    config = PlannerConfig(max_neighbours=1, right_of_way=0.3)
    problems = crossing(5, config, 2)
    plain, rated = (make_planner(config, QUADROTOR, 3, costs=costs) for costs in (False, True))
    first, second = (planner.plan(problems, hover(problems, config)) for planner in (plain, rated))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert plain.costs is None
    assert rated.costs.shape == (5,)
    assert (rated.costs > 0).all()


def test_a_robot_at_its_goal_plans_for_nothing():
    x, goal = np.zeros((1, 9)), np.array([[0.0, 0, 1.5]])
    x[0, 2] = 1.5
    planner = make_planner(PlannerConfig(), QUADROTOR, 2, costs=True)
    planner.plan(Problems(x, goal, np.full((1, 1, 10, 3), 50.0)), Plans.hover(x, 10))
    assert planner.costs[0] == pytest.approx(0, abs=1e-6)
