"""One planner for teams of unlike vehicles."""

import numpy as np
import pytest
from planning import assert_same, crossing, hover

from quad_swarm.planner import MixedPlanner, PlannerConfig, make_planner
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.vehicles import VEHICLES

CONFIG, SLOW = PlannerConfig(), PlannerConfig(separation=0.9, max_tilt=0.1, max_speed=1.0)
KIND_OF = [0, 1, 0]


@pytest.fixture
def planners():
    kinds = [(CONFIG, QuadrotorParams()), (SLOW, VEHICLES["x500"])]
    return [make_planner(config, quadrotor, 3, sizes=True) for config, quadrotor in kinds]


def test_each_robot_plans_as_with_its_own_planner(planners):
    problems = crossing(6, CONFIG)._replace(size=np.linspace(-0.2, 0.3, 12).reshape(6, 2))
    last = hover(problems, CONFIG)
    plans = MixedPlanner(planners, KIND_OF).plan(problems, last)
    for row in range(6):
        alone = planners[KIND_OF[row % 3]].plan(problems.part([row]), type(last)(*(array[[row]] for array in last)))
        assert_same([array[[row]] for array in plans], alone)
    assert np.abs(plans.u[1::3, :, :2]).max() <= 0.1 < np.abs(plans.u[::3, :, :2]).max()


def test_failures_are_those_of_single_planners(planners):
    problems = crossing(3, CONFIG)
    problems.x[1] = np.nan
    mixed = MixedPlanner(planners, KIND_OF)
    mixed.checks = False
    with np.errstate(all="ignore"):
        status = mixed.plan(problems, hover(crossing(3, CONFIG), CONFIG)).status
    assert (status[[0, 2]] == 0).all()
    assert status[1] > 0


@pytest.mark.parametrize(
    ("count", "message"),
    [(4, "there are 4, but this planner plans for teams of 3"), (0, None), (3, "x\\[1, 0\\] is nan")],
)
def test_what_is_no_team_or_not_finite_is_refused(planners, count, message):
    problems = crossing(count, CONFIG)
    if count == 3:
        problems.x[1] = np.nan
    mixed = MixedPlanner(planners, KIND_OF)
    if message is None:
        assert len(mixed.plan(problems, hover(problems, CONFIG)).x) == 0
    else:
        with pytest.raises(ValueError, match=message):
            mixed.plan(problems, hover(problems, CONFIG))


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_larger_robots_are_kept_away_from_by_as_much_more(solver):
    planner = make_planner(CONFIG, QuadrotorParams(), 2, solver, sizes=True)
    far, gaps = crossing(1, CONFIG, n_others=1), {}
    x, goal = np.zeros((1, 9)), np.array([[4.0, 0, 1]])
    x[0, :3], others = [0.0, 0, 1], np.broadcast_to([2.0, 0.05, 1], far.others.shape)
    for size in (-0.2, 0.0, 0.3):
        problems = far._replace(x=x, goal=goal, others=others.copy(), size=np.array([[size]]))
        plans = hover(problems, CONFIG)
        for _ in range(30):
            plans = planner.plan(problems, plans)
            problems = problems._replace(x=plans.x[:, 1])
            gaps[size] = min(gaps.get(size, np.inf), np.linalg.norm(plans.x[0, 1, :3] - others[0, 0, 0]))
    assert [round(gap - CONFIG.separation, 1) for gap in gaps.values()] == [-0.2, 0.0, 0.3]
