"""The convention of passing on the right."""

import numpy as np
import pytest

from quad_swarm.planner import SOLVERS, PlannerConfig, Plans, Problems, make_planner
from quad_swarm.planner.right_of_way import keep_right
from quad_swarm.quadrotor import QuadrotorParams

DT, N = 0.05, 20


def head_on(announced: bool = True, lateral: float = 0.0, speed: float = 2.0) -> Problems:
    """A robot that flies along x, and another one 4 m ahead that comes towards it, ``lateral`` to its left."""
    x = np.zeros((1, 9))
    x[0, :6] = [0, 0, 1, speed / 2, 0, 0]
    times = DT * np.arange(1, N + 1)
    other = np.stack([4 - speed / 2 * times, np.full(N, lateral), np.ones(N)], axis=-1)
    return Problems(x, np.array([[4.0, 0, 1]]), other[None, None], announced=np.array([[announced]]))


def test_the_other_grows_to_the_left_alone():
    problems = head_on()
    grown = keep_right(problems, 0.3, DT)
    np.testing.assert_allclose(grown.others - problems.others, np.broadcast_to([0, 0.3, 0], (1, 1, N, 3)), atol=1e-9)
    np.testing.assert_allclose(grown.clearance, 0.3)
    # On the right its boundary stays where it was, on the left it moves away by twice the distance.
    assert grown.others[..., 1] - grown.clearance == pytest.approx(0.0)


def test_both_robots_agree_on_the_sides():
    mine, other = head_on(), head_on()
    turned = other._replace(x=-other.x, goal=-other.goal, others=-other.others)
    left = keep_right(mine, 0.3, DT).others - mine.others
    assert np.allclose(keep_right(turned, 0.3, DT).others - turned.others, -left)


@pytest.mark.parametrize(
    "problems", [head_on(announced=False), head_on(speed=-2.0), head_on()._replace(announced=None)]
)
def test_who_is_unknown_or_flies_away_stays_as_it_is(problems):
    grown = keep_right(problems, 0.3, DT)
    assert np.array_equal(grown.others, problems.others)
    assert grown.clearance is None or not grown.clearance.any()


@pytest.mark.parametrize("solver", SOLVERS)
def test_planners_pass_on_the_right(solver):
    config = PlannerConfig(horizon=N, dt=DT, separation=0.72, right_of_way=0.3, max_tilt=0.35)
    near = head_on(lateral=0.02)  # hardly to the left: without the convention either side would do
    near = near._replace(others=near.others - [2.2, 0, 0])
    planner = make_planner(config, QuadrotorParams(), 2, solver)
    plan = planner.plan(near, Plans.hover(near.x, N))
    assert plan.x[0, -1, 1] < -0.05
    mirrored = near._replace(others=near.others * [1, -1, 1])
    assert planner.plan(mirrored, Plans.hover(near.x, N)).x[0, -1, 1] < -0.05


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_solvers_keep_the_clearance(solver):
    config = PlannerConfig(horizon=N, separation=0.6)
    x = np.zeros((1, 9))
    x[0, 2] = 1.0
    goal, other = np.array([[1.0, 0.0, 1.0]]), np.broadcast_to([1.2, 0.02, 1.0], (1, 1, N, 3))
    planner = make_planner(config, QuadrotorParams(), 2, solver)
    distances = []
    for clearance in (None, np.full((1, 1, N), 0.2)):
        plan = planner.plan(Problems(x, goal, other, clearance), Plans.hover(x, N))
        distances.append(np.linalg.norm(plan.x[0, :, :3] - other[0, 0, 0], axis=-1).min())
    assert distances == pytest.approx([0.6, 0.8], abs=2e-3)
