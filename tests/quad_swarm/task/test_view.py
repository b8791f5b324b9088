"""What a robot knows before it asks: relative to itself, and no more than it can know."""

import numpy as np
import pytest

from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.task.view import View
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm


def swarm_at(pos, vel=None, goals=None, **config) -> Swarm:
    """One swarm with its robots at ``pos``."""
    pos = np.asarray(pos, float)
    swarm = Swarm(make_config("paper", n_robots=len(pos), **config), 1)
    swarm.reset(0, pos, pos if goals is None else np.asarray(goals, float), checked=True)
    swarm.state[0, :, VELOCITY] = 0.0 if vel is None else vel
    return swarm


# Robot 1 comes towards robot 0 and passes it at 0.5 m after 2 s; robot 2 stands 3 m away.
POS = np.array([[0.0, 0, 1], [4, 0.5, 1], [0, -3, 1]])
VEL = np.array([[0.0, 0, 0], [-2, 0, 0], [0, 0, 0]])


def test_others_are_seen_from_the_robot_in_ascending_order():
    view = View(swarm_at(POS, VEL, POS + np.array([1, 2, 0])))
    for robot, others in enumerate(((1, 2), (0, 2), (0, 1))):
        for column, other in enumerate(others):
            assert view.pos[0, robot, column].tolist() == (POS[other] - POS[robot]).tolist()
            assert view.vel[0, robot, column].tolist() == (VEL[other] - VEL[robot]).tolist()
    assert view.own_vel[0].tolist() == VEL.tolist()
    assert view.goal[0].tolist() == [[1, 2, 0]] * 3


@pytest.mark.parametrize(
    ("look_ahead", "distance", "time"),
    [(3.0, 0.5, 2.0), (1.0, np.hypot(2, 0.5), 1.0), (0.0, np.hypot(4, 0.5), 0.0)],
)
def test_the_closest_approach_lies_within_the_look_ahead(look_ahead, distance, time):
    distances, times = View(swarm_at(POS, VEL)).approach(look_ahead)
    assert (distances[0, 0, 0], times[0, 0, 0]) == pytest.approx((distance, time))
    assert (distances[0, 1, 0], times[0, 1, 0]) == pytest.approx((distance, time)), "seen from both alike"
    assert (distances[0, 0, 1], times[0, 0, 1]) == (3.0, 0.0), "at rest to each other"


def test_who_flies_away_is_closest_now():
    distances, times = View(swarm_at(POS, -VEL)).approach(3.0)
    assert (distances[0, 0, 0], times[0, 0, 0]) == pytest.approx((np.hypot(4, 0.5), 0.0))


def test_plans_are_as_of_now_and_others_are_expected_where_they_head():
    swarm = swarm_at([[-3.0, 0, 1], [3, 0, 1]], goals=[[3.0, 0.2, 1], [3, 0, 1]])
    for _ in range(5):
        swarm.step(np.zeros((1, 2, 1), bool))
    view = View(swarm)
    horizon = swarm.config.planner.horizon
    assert view.plan.shape == (1, 2, horizon, 3)
    assert np.array_equal(view.plan, view.current_plans[:, :, 1:])
    np.testing.assert_allclose(view.current_plans[:, :, 0], 0.0, atol=1e-6)
    assert view.plan[0, 0, -1, 0] > 0.5, "it is on its way"
    # Nobody asked: the others go on as they fly
    times = swarm.config.planner.dt * np.arange(1, horizon + 1)
    expected = view.pos[0, 0, 0] + times[:, None] * swarm.vel[0, 1]
    np.testing.assert_allclose(view.expected()[0, 0, 0], expected, atol=1e-9)
    separation = np.linalg.norm(view.plan[0, 0] - expected, axis=-1)
    assert view.expected([1, 4])[0, 0, 0].tolist() == view.expected()[0, 0, 0, [1, 4]].tolist()
    near = (separation.min(), separation.argmin(), separation[-1])
    assert [field[0, 0, 0] for field in view.plan_approach] == pytest.approx(near, abs=1e-9)


def test_answers_age_and_drift():
    swarm = swarm_at([[-3.0, 0, 1], [3, 0, 1]], memory=1.0)
    horizon = swarm.config.planner.horizon
    assert (View(swarm).age >= horizon).all(), "no plan is known"
    swarm.step(np.array([[[True], [False]]]))  # robot 0 asks robot 1
    ages = []
    for _ in range(3):
        ages.append(View(swarm).age[0, :, 0])
        swarm.step(np.zeros((1, 2, 1), bool))
    assert [asker for asker, _ in ages] == [2, 3, 4]
    assert all(silent >= horizon for _, silent in ages)
    assert View(swarm).drift[0, 0, 0] == pytest.approx(0.0, abs=1e-3)
    swarm.state[0, 1, POSITION] += [0.0, 0.3, 0.0]
    assert View(swarm).drift[0, 0, 0] == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize("loss", [0.0, 1.0])
def test_a_robot_knows_whom_it_answered_but_not_whether_the_answer_arrived(loss):
    swarm = swarm_at(POS, goals=POS[[1, 0, 2]], memory=1.0, radio={"loss": loss})
    asked = np.zeros((1, 3, 2), bool)
    asked[0, 0, 0] = True  # robot 0 asks robot 1
    swarm.step(asked)
    view = View(swarm)
    horizon = swarm.config.planner.horizon
    assert view.age[0, 0, 0] == 2 if loss == 0 else view.age[0, 0, 0] >= horizon
    told = view.seen_by_others(range(horizon))
    assert told.age[0, 1, 0] == 2, "robot 1 takes its answer to have arrived"
    assert (told.age[0, 0] >= horizon).all(), "nobody asked robot 0"
    assert view.seen_by_others([0, 3]).believed.shape[-2] == 2
    assert np.array_equal(view.seen_by_others([3]).believed[..., 0, :], told.believed[..., 3, :])


def test_downwash_makes_others_above_and_below_nearer():
    above = np.array([[0.0, 0, 1], [0, 0.4, 2.4], [3, 0, 1]])
    view, flat = (View(swarm_at(above, planner={"downwash": c})) for c in (3.5, 1.0))
    assert view.approach(1.0)[0][0, 0].tolist() == pytest.approx([np.hypot(0.4, 0.4), 3.0])
    assert flat.approach(1.0)[0][0, 0].tolist() == pytest.approx([np.hypot(0.4, 1.4), 3.0])
    assert view.plan_approach.least[0, 0].tolist() == pytest.approx([np.hypot(0.4, 0.4), 3.0])


AMONG = {"listed": [{"position": (2.0, 0, 0), "radius": 0.5}, {"position": (9.0, 0.5, 1), "radius": 0.1}], "most": 3}


def test_the_nearest_obstacle_to_plans_and_to_predicted_motion():
    """Robot 1 flies at 2 m/s past the pillar, at 0.5 m beside its axis."""
    view = View(swarm_at(POS, VEL, obstacles=AMONG))
    horizon = view.horizon
    own, their = view.own_obstacle, view.their_obstacle
    assert own.gap[0, 0] == pytest.approx(2.0 - 0.5 - 0.3)
    assert own.towards[0, 0].tolist() == pytest.approx([1.0, 0.0, 0.0])
    # In 1 s, robot 1 gets from x = 4 to x = 2, where the pillar is to its right
    assert (their.gap[0, 0, 0], their.stage[0, 0, 0]) == (pytest.approx(0.5 - 0.8), horizon - 1)
    assert their.towards[0, 0, 0].tolist() == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)
    assert their.gap[0, 2, 1] == pytest.approx(their.gap[0, 0, 0]), "whoever sees it"


def test_without_obstacles_there_is_nothing_near():
    view = View(swarm_at(POS, VEL))
    assert np.isinf(view.own_obstacle.gap).all()
    assert np.isinf(view.their_obstacle.gap).all()
    assert not view.their_obstacle.towards.any()
