"""Every level of the fallback chain, and which of the others a plan considers."""

import dataclasses
import math

import foreign
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
    planner.checks = False
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
        if self.fault == "complex":
            return Solution(x, u + 1j, success, iterations)
        if self.fault == "masked":
            return Solution(np.ma.array(x, mask=x == 0), u, success, iterations)
        if self.fault == "large":
            x[0, 1] = 1e40
            return Solution(x, u, success, iterations)
        (x if self.fault == "x" else u)[0, 1] = np.nan
        return Solution(x, u, success, iterations)


@pytest.mark.filterwarnings("ignore:the solver 'faulty' raised")
@pytest.mark.parametrize(
    "fault",
    ["x", "u", "large", "raises", "form", "shape of x", "shape of u", "numbers for success", "complex", "masked"],
)
def test_a_solver_that_breaks_its_contract_has_failed(fault):
    config = PlannerConfig()
    problems = crossing(3, config)
    planner = Planner(Faulty(fault), QuadrotorModel(QUADROTOR, config.dt), config)
    plans = planner.plan(problems, hover(problems, config))
    assert np.isfinite(plans.x).all()
    assert np.isfinite(plans.u).all()
    failed = plans.status >= PlanStatus.SHIFTED
    assert failed.tolist() == ([True, False, False] if fault in ("x", "u", "large") else [True] * 3)


def test_a_solution_of_lists_or_of_arrays_that_cannot_be_written_is_as_good():
    class Plain(FatropSolver):
        form = staticmethod(np.asarray)

        def solve(self, *arguments):
            solution = super().solve(*arguments)
            return Solution(*map(self.form, solution))

    class Lists(Plain):
        form = staticmethod(np.ndarray.tolist)

    class Tuples(FatropSolver):
        def solve(self, *arguments):
            return tuple(super().solve(*arguments))

    class Frozen(Plain):
        @staticmethod
        def form(array):
            array.setflags(write=False)
            return array

    config = PlannerConfig(horizon=3)
    problems = crossing(3, config)
    problems.others[1] = np.nan  # one fails, and the planner writes into its place
    plans = []
    for kind in (Plain, Lists, Frozen, Tuples):
        problem = OptimalControlProblem(config, QUADROTOR, 2)
        planner = Planner(kind(problem), QuadrotorModel(QUADROTOR, config.dt), config)
        planner.checks = False
        plans.append(planner.plan(problems, hover(problems, config)))
    assert plans[0].status.tolist() == [PlanStatus.SOLVED, PlanStatus.SHIFTED, PlanStatus.SOLVED]
    assert_same(plans[1], plans[0])
    assert_same(plans[2], plans[0])
    assert_same(plans[3], plans[0])


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


SHAPES = {"sphere": (1.0, 1.0, 1.0), "cylinder": (1.0, 1.0, 0.0), "ellipsoid": (1.0, 1.0, 0.5)}


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
@pytest.mark.parametrize("shape", SHAPES)
def test_keeps_clear_of_bodies_of_any_shape_and_size(shape, solver):
    """A robot flies to the other side of a body, past a robot beside it: over it, if it is not too high."""
    config = PlannerConfig(separation=0.8, workspace_high=(9.0, 9.0, 9.0), repulsion_weight=0.0)
    planner = make_planner(config, QUADROTOR, 2, solver, n_obstacles=1)
    x = np.zeros((1, 9))
    x[0, :3] = [-2.5, 0.05, 2.0]
    bodies, factors, size = np.array([[0.0, -1.6, 2.0], [0.0, 0.0, 1.2]]), np.array([(1, 1, 1), SHAPES[shape]]), 0.3
    others = np.repeat(bodies[None, :, None], config.horizon, axis=2)
    problems = Problems(x, np.array([[2.5, 0.0, 2.0]]), others, shape=factors[None], size=np.array([[0.0, size]]))
    plans, positions = hover(problems, config), []
    for _ in range(70):
        plans = planner.plan(problems, plans)
        problems = problems._replace(x=plans.x[:, 1])
        positions.append(problems.x[0, :3])
    distances = np.linalg.norm(factors * (np.array(positions)[:, None] - bodies), axis=-1).min(axis=0)
    assert distances[0] > 0.8 - 2e-3
    assert distances[1] == pytest.approx(0.8 + size, abs=2e-3)
    assert np.linalg.norm(positions[-1] - problems.goal[0]) < 0.05
    assert (max(z for _, _, z in positions) > 2.1) == (shape != "cylinder")


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_a_robot_gives_way_to_what_has_the_larger_penalty(solver):
    """It hovers between two walls that leave too little room: violations are shared by their weights."""
    config = PlannerConfig(separation=0.8, repulsion_weight=0.0, input_weight=1e-4, horizon=20)
    planner = make_planner(config, QUADROTOR, 2, solver, n_obstacles=1)
    x = np.zeros((1, 9))
    x[0, 2] = 1.0
    others = np.repeat(np.array([[[0.7, 0.0, 1.0], [-0.7, 0.0, 1.0]]])[:, :, None], config.horizon, axis=2)
    walls = np.tile([1.0, 0.0, 0.0], (1, 2, 1))
    problems = Problems(x, x[:, :3], others, shape=walls, size=np.zeros((1, 2)), penalty=np.array([[9.0, 1.0]]))
    plans = hover(problems, config)
    for _ in range(60):
        plans = planner.plan(problems, plans)
        problems = problems._replace(x=plans.x[:, 1])
    assert problems.x[0, 0] == pytest.approx(-0.08, abs=0.01)  # 9 (0.1 + x) = 0.1 - x
    alike = problems._replace(x=x, penalty=np.ones((1, 2)))
    assert_same(
        planner.plan(alike, hover(alike, config)), planner.plan(alike._replace(penalty=None), hover(alike, config))
    )
    with pytest.raises(ValueError, match="penalty: factors of the weight of violations must be positive"):
        planner.plan(problems._replace(penalty=np.array([[0.0, 1.0]])), plans)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_without_shapes_others_have_the_planners_downwash(solver):
    config = PlannerConfig(downwash=2.0)
    problems = crossing(3, config)
    last = hover(problems, config)
    shape = np.tile([1.0, 1.0, 0.5], (3, 2, 1))
    planner = make_planner(config, QUADROTOR, 3, solver)
    assert_same(planner.plan(problems, last), planner.plan(problems._replace(shape=shape), last))
    flat = make_planner(PlannerConfig(), QUADROTOR, 3, solver)
    assert not np.allclose(planner.plan(problems, last).u, flat.plan(problems, last).u)
    with pytest.raises(ValueError, match="shape: this planner avoids spheres only"):
        flat.plan(problems._replace(shape=shape), last)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_plans_keep_to_references_as_much_as_they_weigh(solver):
    config = PlannerConfig(commitment=1.0)
    problems, last = crossing(3, config), hover(crossing(3, config), config)
    planner = make_planner(config, QUADROTOR, 3, solver)
    problems.x[:, 3:] = 0.0
    reference = problems.x[:, None, :3] + np.linspace(0.02, 0.2, config.horizon)[:, None] * [0, 0, 1]
    off = []
    for weight in (0.0, 1.0, 100.0):
        plans, weights = last, np.full((3, config.horizon), weight)
        for _ in range(4):
            plans = planner.plan(problems._replace(reference=reference, reference_weight=weights), plans)
        assert (plans.status == PlanStatus.SOLVED).all()
        off.append(np.linalg.norm(plans.x[:, 1:, :3] - reference, axis=-1).mean())
    assert off[2] < 0.5 * off[1] < 0.5 * off[0]
    plain = make_planner(PlannerConfig(), QUADROTOR, 3, solver)
    assert_same(planner.plan(problems, last), plain.plan(problems, last))
    with pytest.raises(ValueError, match=r"reference: references need weights, and a planner with planner\.commitment"):
        plain.plan(problems._replace(reference=reference, reference_weight=weights), last)
    with pytest.raises(ValueError, match="reference: references need weights"):
        planner.plan(problems._replace(reference=reference), last)
    with pytest.raises(ValueError, match="reference_weight: weights must not be negative"):
        planner.plan(problems._replace(reference=reference, reference_weight=-weights), last)


def test_both_solvers_keep_to_references_alike():
    config = PlannerConfig(commitment=1.0)
    problems = crossing(3, config)
    reference = problems.x[:, None, :3] + np.linspace(0.02, 0.2, config.horizon)[:, None] * [0, 1, 0]
    problems = problems._replace(reference=reference, reference_weight=np.full((3, config.horizon), 3.0))
    planned = []
    for solver in ("rti", "fatrop"):
        planner, plans = make_planner(config, QUADROTOR, 3, solver), hover(problems, config)
        for _ in range(8):
            plans = planner.plan(problems, plans)
        planned.append(plans.x[..., :3])
    np.testing.assert_allclose(*planned, atol=0.02)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_a_known_disturbance_moves_nobody_from_the_goal(solver, yaw):
    config = PlannerConfig(disturbance_time=1.0)
    planner, model = make_planner(config, QUADROTOR, 2, solver), QuadrotorModel(QUADROTOR, config.dt)
    x, push = np.zeros((1, 9)), np.array([[0.6, -0.4, -0.5]])
    x[0, :3], x[0, 8] = [0.2, 0, 1.5], yaw
    others = np.full((1, 1, config.horizon, 3), 50.0)
    problems = Problems(x, np.array([[0.0, 0.0, 1.5]]), others, disturbance=push)
    plans = hover(problems, config)
    for _ in range(70):
        plans = planner.plan(problems, plans)
        assert plans.status[0] == PlanStatus.SOLVED
        x = model.step(problems.x, plans.u[:, 0])
        for part, change in zip((slice(0, 3), slice(3, 6)), QUADROTOR.drift(config.dt), strict=True):
            x[:, part] += change * push
        np.testing.assert_allclose(x, plans.x[:, 1], atol=1e-6, err_msg="it flies as planned")
        problems = problems._replace(x=x)
    # With a yaw, the gains of roll and pitch, which differ a little, are those of a heading of 0
    np.testing.assert_allclose(x[0, :6], [0, 0, 1.5, 0, 0, 0], atol=4e-3 if yaw else 1e-4)
    plain = make_planner(PlannerConfig(), QUADROTOR, 2, solver)
    with pytest.raises(ValueError, match=r"disturbance: this planner knows none; set planner\.disturbance_time"):
        plain.plan(problems, plans)


def test_robots_brake_against_a_disturbance():
    planner = make_planner(PlannerConfig(disturbance_time=1.0, horizon=60), QUADROTOR, 2, "fatrop")
    x, push = np.zeros((2, 9)), np.array([[0.6, -0.4, -0.5], [0.0, 0.0, 0.0]])
    x[:, 2], x[:, 3] = 1.5, 1.0
    u = planner.braking_inputs(x, push)
    end = planner.model.rollout(x, u, push)[:, -1]
    assert np.linalg.norm(end[:, 3:6], axis=1).max() < 0.01
    np.testing.assert_array_equal(u[1], planner.braking_inputs(x)[1])


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_a_large_body_far_away_takes_the_place_of_a_small_one_nearby(solver):
    """What counts is the distance to the surface, in the metric of the shape."""
    config = PlannerConfig(max_obstacles=1, max_neighbours=1)
    x = np.zeros((1, 9))
    x[0, 2] = 1.0
    places = np.array([[0.9, 0, 1.0], [0, 1.2, 1.0], [-5.0, 0, 1.0], [0, -0.8, 7.0]])
    others = np.repeat(places[None, :, None], config.horizon, axis=2)
    shape, size = np.ones((1, 4, 3)), np.array([[0.0, 0.0, 4.3, 0.0]])
    shape[0, 3, 2] = 0.0  # a pillar, whose height does not matter
    problems = Problems(x, np.array([[3.0, 0.2, 1.0]]), others, shape=shape, size=size)
    last = hover(problems, config)
    limited = make_planner(config, QUADROTOR, 3, solver, n_obstacles=2)
    nearest = make_planner(config, QUADROTOR, 2, solver, n_obstacles=1)
    assert_same(limited.plan(problems, last), nearest.plan(problems.chosen(np.array([[2, 3]])), last))
    penalty = np.array([[1.0, 1.0, 3.0, 1.0]])
    limited = limited.plan(problems._replace(penalty=penalty), last)
    assert_same(limited, nearest.plan(problems._replace(penalty=penalty).chosen(np.array([[2, 3]])), last))


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_with_a_cruise_distance_far_goals_are_as_good_as_near_ones(solver):
    config = PlannerConfig(cruise_distance=6.0)
    problems = crossing(4, config, 1)._replace(others=np.full((4, 1, 10, 3), 99.0))
    way = np.array([[0.6, 0.8, 0], [-1, 0, 0], [0, 0, 1], [1, 0, 0]])
    reach = np.array([[1000.0], [50.0], [7.0], [3.0]])
    last, pos = hover(problems, config), problems.x[:, :3]
    capped = make_planner(config, QUADROTOR, 2, solver).plan(problems._replace(goal=pos + reach * way), last)
    nearby = problems._replace(goal=pos + np.minimum(reach, 6.0) * way)
    expected = make_planner(PlannerConfig(), QUADROTOR, 2, solver).plan(nearby, last)
    np.testing.assert_allclose(capped.u, expected.u, atol=1e-5)
    np.testing.assert_array_equal(capped.u[3], expected.u[3], "a goal that is near stays as it is")


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
@pytest.mark.parametrize("rate", [0.3, 2.5])
def test_climbs_and_descents_have_limits_of_their_own(solver, rate):
    room = {"workspace_low": (-5, -5, -50), "workspace_high": (5, 5, 50)}
    config = PlannerConfig(max_descent_rate=rate, max_descent_speed=4.0, **room)
    problems = crossing(2, config, 1)
    problems.x[:], problems.others[:] = 0.0, 50.0
    problems.goal[:] = [[0, 0, 4], [0, 0, -4]]
    planner = make_planner(config, QUADROTOR, 2, solver)
    plans, commands = hover(problems, config), []
    for _ in range(10):
        plans = planner.plan(problems._replace(x=plans.x[:, 1]), plans)
        commands.append(plans.u[..., 2])
    up, down = np.max(commands), np.min(commands)
    assert (up, down) == pytest.approx((1.0, -rate), rel=1e-3)
    assert -rate <= down, up <= 1.0


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_a_vertical_speed_may_have_another_limit_downwards(solver):
    room = {"workspace_low": (-5, -5, -50), "workspace_high": (5, 5, 50)}
    config = PlannerConfig(max_descent_speed=0.5, **room)
    problems = crossing(2, config, 1)
    problems.x[:], problems.others[:] = 0.0, 50.0
    problems.goal[:] = [[0, 0, 4], [0, 0, -4]]
    planner = make_planner(config, QUADROTOR, 2, solver)
    plans, speeds = hover(problems, config), []
    for _ in range(30):
        plans = planner.plan(problems._replace(x=plans.x[:, 1]), plans)
        speeds.append(plans.x[:, 1, 5])
    assert np.max(speeds) > 1.2
    assert np.min(speeds) == pytest.approx(-0.5, abs=0.01)


def test_robots_in_flight_begin_with_the_plan_to_keep_their_velocity():
    x = np.zeros((3, 9))
    x[:, :3], x[:2, 3:6] = 1.5, [[2.0, 0, -0.5], [0, -1, 0]]
    plans = Plans.steady(x, 10, 0.1)
    np.testing.assert_array_equal(plans.x[:, 1], x)
    np.testing.assert_allclose(plans.x[0, -1, :3], [1.5 + 0.9 * 2, 1.5, 1.5 - 0.9 * 0.5])
    np.testing.assert_allclose(plans.x[0, 0, :3], [1.3, 1.5, 1.55])
    assert_same([field[2:] for field in plans], Plans.hover(x[2:], 10))
    late = Plans.steady(x, 10, 0.1, np.array([0.0, 0.5, 0.5]))
    assert_same([field[::2] for field in late], [field[::2] for field in plans])
    np.testing.assert_allclose(late.x[1, 0, :3], [1.5, 1.55, 1.5])


def test_a_limit_above_the_number_of_others_changes_nothing():
    problems, _, _ = scattered(PlannerConfig(), 4, 2)
    last = Plans.hover(problems.x, 10)
    plans = [make_planner(PlannerConfig(max_neighbours=k), QUADROTOR, 3, "rti").plan(problems, last) for k in (None, 9)]
    assert_same(*plans)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("x", np.zeros(9), r"x has shape \(9,\) and type float64; this planner takes \(1, 9\)"),
        ("x", np.zeros((1, 12)), r"x has shape \(1, 12\) .* takes \(1, 9\)"),
        ("x", np.zeros((1, 9), complex), r"x has .* type complex128; .* and float64"),
        ("x", "state", r"x has shape \(\)"),
        ("x", [[0.0] * 9, [0.0] * 8], r"x has shape \(\) and type object"),
        ("goal", np.zeros((1, 2)), r"goal has shape \(1, 2\) .* takes \(1, 3\)"),
        ("others", np.zeros((1, 10, 2, 3)), r"others has shape \(1, 10, 2, 3\) .* takes \(1, 2, 10, 3\)"),
        ("others", np.zeros((1, 2, 11, 3)), r"others has shape \(1, 2, 11, 3\) .* takes \(1, 2, 10, 3\)"),
        ("others", np.zeros((1, 1, 10, 3)), r"others has shape \(1, 1, 10, 3\) .* takes \(1, 2, 10, 3\)"),
        ("others", np.zeros((2, 2, 10, 3)), r"others has shape \(2, 2, 10, 3\) .* takes \(1, 2, 10, 3\)"),
        ("others", np.full((1, 2, 10, 3), np.nan), r"others\[0, 0, 0, 0\] is nan: the numbers of a problem must be"),
        ("others", np.full((1, 2, 10, 3), np.inf), r"others\[0, 0, 0, 0\] is inf"),
        ("goal", np.array([[0, np.nan, 0]]), r"goal\[0, 1\] is nan"),
        ("clearance", np.zeros((1, 2)), r"clearance has shape \(1, 2\) .* takes \(1, 2, 10\)"),
        ("announced", np.ones((1, 2)), r"announced has .* type float64; this planner takes \(1, 2\) and bool"),
        ("previous.x", np.zeros((1, 10, 9)), r"previous.x has shape \(1, 10, 9\) .* takes \(1, 11, 9\)"),
        ("previous.u", np.zeros((1, 10, 3)), r"previous.u has shape \(1, 10, 3\) .* takes \(1, 10, 4\)"),
        ("previous.age", np.zeros(1), r"previous.age has .* float64; this planner takes \(1,\) and int64"),
    ],
)
def test_a_call_with_other_arrays_is_refused_in_one_sentence(solver, field, value, message):
    config = PlannerConfig()
    planner = make_planner(config, QUADROTOR, 3, solver)
    problems = crossing(1, config)
    last = hover(problems, config)
    if field.startswith("previous."):
        last = last._replace(**{field.removeprefix("previous."): value})
    else:
        problems = problems._replace(**{field: value})
    with pytest.raises(ValueError, match=message) as error:
        planner.plan(problems, last)
    assert str(error.value).count(". ") == 0


def test_what_is_no_plan_is_refused_with_the_first_one():
    planner = make_planner(PlannerConfig(), QUADROTOR, 2)
    problems = Problems(np.zeros((1, 9)), np.ones((1, 3)), np.full((1, 1, 10, 3), 9.0))
    with pytest.raises(ValueError, match=r"previous=None: pass Plans; before the first solve, Plans\.hover\(x, h"):
        planner.plan(problems, None)
    with pytest.raises(ValueError, match=r"problems=.*: pass Problems\.$"):
        planner.plan(tuple(problems), Plans.hover(problems.x, 10))


def test_lists_and_single_precision_are_as_good_as_arrays():
    config = PlannerConfig()
    problems = crossing(2, config)
    planner, last = make_planner(config, QUADROTOR, 3, "fatrop"), hover(problems, config)
    single = problems._replace(others=problems.others.astype(np.float32).astype(float))
    expected = planner.plan(single, last)
    lists = single._replace(x=problems.x.tolist(), goal=problems.goal.tolist(), others=single.others.astype(np.float32))
    assert_same(planner.plan(lists, last), expected)


HEADINGS = [math.radians(degrees) for degrees in (30, 45, 90, -120, 180, 354, 720)]


def fly_by_thrust(planner: Planner, config: PlannerConfig, yaw: float, goal: np.ndarray, seconds: float) -> np.ndarray:
    """Fly with an attitude that a rotation matrix turns into an acceleration, as that of a vehicle does."""
    q, dt = QUADROTOR, config.dt / 10
    state = np.zeros((1, 9))
    state[0, 2], state[0, 8] = 1.5, yaw
    plans, path = Plans.hover(state, config.horizon), [state.copy()]
    others = np.full((1, 1, config.horizon, 3), 50.0)
    for _ in range(round(seconds / config.dt)):
        plans = planner.plan(Problems(state, goal, others), plans)
        assert plans.status[0] == PlanStatus.SOLVED
        assert np.abs(plans.u[0, :, :2]).max() <= config.max_tilt + 1e-12
        u = plans.u[0, 0]
        for _ in range(10):
            roll, pitch, psi = state[0, 6:9]
            ahead, left = np.tan(pitch), -np.tan(roll) / np.cos(pitch)  # of the rotors' force, over that along z
            force = np.array([ahead * np.cos(psi) - left * np.sin(psi), ahead * np.sin(psi) + left * np.cos(psi)])
            acceleration = q.gravity * force - np.array([q.drag_x, q.drag_y]) * state[0, 3:5]
            climb = (q.climb_gain * u[2] - state[0, 5]) / q.climb_time_constant
            attitude = (
                (q.roll_gain * u[0] - roll) / q.roll_time_constant,
                (q.pitch_gain * u[1] - pitch) / q.pitch_time_constant,
            )
            state[0] += dt * np.array([*state[0, 3:6], *acceleration, climb, *attitude, u[3]])
        path.append(state.copy())
    return np.concatenate(path)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
@pytest.mark.parametrize("yaw", HEADINGS)
def test_any_heading_flies_to_the_goal(solver, yaw):
    config = PlannerConfig()
    planner = make_planner(config, QUADROTOR, 2, solver)
    goal = np.array([[1.5, 1.0, 1.8]])
    path = fly_by_thrust(planner, config, yaw, goal, 5.0)
    assert np.linalg.norm(path[-1, :3] - goal[0]) < 0.1
    assert path[-1, 8] == yaw
    # Along the straight way
    off = np.cross(path[:, :3] - path[0, :3], (goal[0] - path[0, :3]) / np.linalg.norm(goal[0] - path[0, :3]))
    assert np.linalg.norm(off, axis=-1).max() < 0.25


@pytest.mark.parametrize("yaw", [0.5, 3.0, 6.18, -6.18, 4 * math.pi - 0.5])
def test_a_planned_yaw_turns_the_short_way(yaw):
    config = PlannerConfig(max_yaw_rate=1.5)
    path = fly_by_thrust(make_planner(config, QUADROTOR, 2, "rti"), config, yaw, np.array([[1.5, 1.0, 1.8]]), 6.0)
    nearest = 2 * math.pi * round(yaw / (2 * math.pi))
    assert path[-1, 8] == pytest.approx(nearest, abs=0.05)
    assert np.abs(path[:, 8] - yaw).max() <= abs(nearest - yaw) + 0.05
    assert np.linalg.norm(path[-1, :3] - [1.5, 1.0, 1.8]) < 0.1


def turn(planner, yaws, headings, steps=60):
    """Let robots turn on their way to a goal aside; return their yaws at each step, and how far they are from it."""
    state = np.zeros((len(yaws), 9))
    state[:, 2], state[:, 8] = 1.5, yaws
    goal, others = state[:, :3] + [1.0, 0.5, 0.0], np.full((len(yaws), 1, planner.config.horizon, 3), 50.0)
    plans, path = Plans.hover(state, planner.config.horizon), [state[:, 8].copy()]
    for _ in range(steps):
        plans = planner.plan(Problems(state, goal, others, heading=np.array(headings)), plans)
        np.testing.assert_allclose(plans.x, planner.model.rollout(state, plans.u), atol=1e-3)
        assert (np.abs(plans.u[..., :2]) <= planner.config.max_tilt + 1e-6).all()
        state = planner.model.step(state, plans.u[:, 0])
        path.append(state[:, 8].copy())
    return np.array(path), np.linalg.norm(state[:, :3] - goal, axis=-1)


TURNS = {30: 30, 90: 90, 180: 180, 350: -10, 0: 0, -190: 170, 725: 5}  # heading from 0 -> how far robots turn (degrees)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_robots_turn_to_headings_the_short_way_alone_and_in_a_batch(solver):
    planner = make_planner(PlannerConfig(max_yaw_rate=1.5), QUADROTOR, 2, solver)
    headings = np.radians(list(TURNS))
    path, off = turn(planner, np.zeros(len(TURNS)), headings)
    turned, expected = np.degrees(path[-1]), np.array(list(TURNS.values()))
    expected[2] *= np.sign(turned[2])  # half a turn is as short either way
    np.testing.assert_allclose(turned, expected, atol=1)
    assert (np.abs(np.degrees(path)).max(axis=0) <= np.abs(expected) + 0.5).all(), "no robot turns too far"
    assert off.max() < 0.02
    for k, heading in enumerate(headings):
        alone, _ = turn(planner, [0.0], [heading], steps=10)
        assert_same(alone[:, 0], path[:11, k])


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_from_170_to_minus_170_degrees_are_20(solver):
    planner = make_planner(PlannerConfig(max_yaw_rate=1.5), QUADROTOR, 2, solver)
    path, _ = turn(planner, np.radians([170, -170, 530, 175]), np.radians([-170, 170, 190, 190]), steps=40)
    np.testing.assert_allclose(np.degrees(path[-1]), [190, -190, 550, 190], atol=1)
    assert np.abs(np.degrees(path - path[0])).max() < 20.5


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_only_the_yaw_of_a_robot_knows_its_heading(solver):
    config = PlannerConfig(max_yaw_rate=1.5)
    problems, planner = crossing(4, config), make_planner(config, QUADROTOR, 3, solver)
    last = planner.plan(problems, hover(problems, config))
    plain = planner.plan(problems, last)
    same = planner.plan(problems._replace(heading=np.zeros(4)), last)
    assert_same(same, plain)
    aimed = planner.plan(problems._replace(heading=np.array([0.0, 1.0, 0.0, -2.0])), last)
    assert_same([field[[0, 2]] for field in aimed], [field[[0, 2]] for field in plain])
    assert (aimed.u[[1, 3], 0, 3] * [1, -1] > 0.9).all()


@pytest.mark.parametrize(
    ("rate", "heading", "message"),
    [
        (1.0, np.zeros(3), r"heading has shape \(3,\) and type float64; this planner takes \(2,\)"),
        (1.0, np.array([0.0, np.nan]), r"heading\[1\] is nan"),
        (0.0, np.array([0.0, 0.1]), r"heading: this planner holds the yaw of robots; .* max_yaw_rate above 0"),
    ],
)
def test_headings_that_do_not_fit_are_refused(rate, heading, message):
    config = PlannerConfig(max_yaw_rate=rate)
    planner = Planner(foreign.Stay(OptimalControlProblem(config, QUADROTOR, 2)), QuadrotorModel(QUADROTOR, 0.1), config)
    problems = crossing(2, config)
    with pytest.raises(ValueError, match=message):
        planner.plan(problems._replace(heading=heading), hover(problems, config))
    held = planner.plan(problems._replace(heading=problems.x[:, 8] + 2 * math.pi), hover(problems, config))
    assert (held.x[..., 8] == 0).all()


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_every_level_of_the_chain_knows_the_heading(yaw):
    config = PlannerConfig(horizon=30)
    x = np.zeros((2, 9))
    x[:, 2], x[:, 3:5], x[:, 8] = 1.5, [1.5, -1.0], yaw

    class Failing(foreign.Stay):
        def solve(self, problems, x_guess, u_guess):
            solution = super().solve(problems, x_guess, u_guess)
            return solution._replace(success=~solution.success)

    model = QuadrotorModel(QUADROTOR, config.dt)
    planner = Planner(Failing(OptimalControlProblem(config, QUADROTOR, 1)), model, config)
    old = Plans.hover(x, config.horizon)._replace(age=np.array([config.horizon, 0]))
    plans = planner.plan(Problems(x, x[:, :3], np.full((2, 1, 30, 3), 9.0)), old)
    assert plans.status.tolist() == [PlanStatus.BRAKING, PlanStatus.SHIFTED]
    assert (plans.x[..., 8] == yaw).all()
    assert np.linalg.norm(plans.x[0, -1, 3:6]) < 0.2
    np.testing.assert_allclose(plans.x, model.rollout(x, plans.u), atol=1e-12)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
@pytest.mark.parametrize("max_yaw_rate", [0.0, 1.5])
def test_a_plan_does_not_depend_on_the_headings_of_the_batch(solver, max_yaw_rate):
    config = PlannerConfig(max_yaw_rate=max_yaw_rate)
    problems = crossing(4, config)
    planner = make_planner(config, QUADROTOR, 3, solver)
    last = planner.plan(problems, hover(problems, config))
    level = planner.plan(problems, last)
    problems.x[[1, 3], 8] = [0.7, -2.0]
    mixed = planner.plan(problems, last)
    assert_same([field[[0, 2]] for field in mixed], [field[[0, 2]] for field in level])
    for k in (1, 3):
        alone = planner.plan(problems.part([k]), Plans(*(field[[k]] for field in last)))
        assert_same([field[[k]] for field in mixed], alone)
