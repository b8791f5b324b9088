"""Goals that change: waypoints in turn, goals that move, goals that are replaced, and what is refused."""

import copy
import itertools
import warnings

import numpy as np
import pytest

from quad_swarm.robot import Robot, RulePolicy
from quad_swarm.robot.lockstep import LockstepWorld
from quad_swarm.task.episode_statistics import EpisodeStatistics
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import make_config
from quad_swarm.world.route import MOST_WAYPOINTS, Route, Targets
from quad_swarm.world.swarm import Swarm

HUGE = {"workspace_low": (-500, -500, 0.48), "workspace_high": (500, 500, 2.4)}
STARTS = np.array([[0.0, -2, 1.5], [0, 2, 1.5]])
ASIDE = np.array([3.0, 0, 0])


def quiet(n_swarms: int = 1, **planner) -> Swarm:
    return Swarm(make_config("paper", n_robots=2, planner=planner), n_swarms)


def fly(swarm: Swarm, steps: int) -> list:
    return [swarm.step(np.ones((swarm.n_swarms, 2, 1), bool)) for _ in range(steps)]


def test_waypoints_are_passed_in_turn_and_success_is_at_the_last():
    swarm, ends = quiet(), STARTS + ASIDE
    first, second = np.array([2.0, -3, 1]), np.array([-2.0, -3, 2])
    swarm.reset(0, STARTS, ends, waypoints=[[first, second], []])
    np.testing.assert_array_equal(swarm.goal[0], [first, ends[1]])
    np.testing.assert_array_equal(swarm.final_goal[0], ends)
    aims, there = [swarm.goal[0, 0].copy()], []
    for _ in range(90):
        (report,) = fly(swarm, 1)
        passed = np.linalg.norm(swarm.pos[0, 0] - aims[-1]) <= 0.3
        assert passed == (swarm.goal[0, 0] != aims[-1]).any() or (aims[-1] == ends[0]).all()
        aims.append(swarm.goal[0, 0].copy())
        there.append(report.at_goal[0].copy())
    order = [aims[0], *(b for a, b in itertools.pairwise(aims) if (a != b).any())]
    np.testing.assert_array_equal(order, [first, second, ends[0]])
    arrived, alone = np.all(there, axis=1), np.array(there)[:, 1]
    assert alone.argmax() < arrived.argmax(), "the other one waits at its goal"
    assert arrived[-1]
    assert swarm.route is None, "nothing is left to change"


def test_a_goal_on_the_way_to_a_waypoint_does_not_count():
    swarm = quiet()
    swarm.reset(0, STARTS, STARTS, waypoints=[[STARTS[0] + ASIDE], [STARTS[1] + ASIDE]])
    (report,) = fly(swarm, 1)
    assert not report.at_goal.any()
    assert fly(swarm, 60)[-1].at_goal.all()


def test_waypoints_that_are_at_hand_are_passed_at_once():
    swarm = quiet()
    near = STARTS + np.array([0.1, 0, 0])
    swarm.reset(0, STARTS, STARTS + ASIDE, waypoints=[[near[0], STARTS[0]], [near[1]]])
    np.testing.assert_array_equal(swarm.goal[0], STARTS + ASIDE)
    assert swarm.route is None


@pytest.mark.parametrize("preset", ["paper", "flight"])
def test_robots_follow_goals_that_move_without_falling_behind(preset):
    still = {"noise": {"wind": 0, "gust": 0, "vel": 0, "attitude": 0}, "mismatch": 0.0}
    swarm = Swarm(make_config(preset, n_robots=2, planner=HUGE, **still))
    swarm.reset(0, STARTS, STARTS, velocities=[[1, 0, 0], [0.6, 0.8, 0]])
    dt = swarm.config.planner.dt
    reports = fly(swarm, round(8 / dt))
    np.testing.assert_allclose(swarm.goal[0], STARTS + 8 * np.array([[1, 0, 0], [0.6, 0.8, 0]]), atol=1e-9)
    assert np.linalg.norm(swarm.pos - swarm.goal, axis=-1).max() < 0.1, "0.9 m without looking ahead"
    assert reports[-1].at_goal.all()


def test_goals_that_are_replaced_in_flight():
    swarm = quiet()
    swarm.reset(0, STARTS, STARTS + ASIDE, waypoints=[[[1, -3, 1]], []])
    fly(swarm, 3)
    swarm.set_goals(0, [STARTS[0] - ASIDE], robots=[0])
    np.testing.assert_array_equal(swarm.goal[0], [STARTS[0] - ASIDE, STARTS[1] + ASIDE])
    assert swarm.route is None
    assert fly(swarm, 60)[-1].at_goal.all()
    np.testing.assert_allclose(swarm.pos[0], [STARTS[0] - ASIDE, STARTS[1] + ASIDE], atol=0.3)
    swarm.set_goals(0, STARTS, velocities=[[0, 0, 0], [0.5, 0, 0]], waypoints=[[[0, -4, 1]], []])
    fly(swarm, 1)
    np.testing.assert_allclose(swarm.goal[0], [[0, -4, 1], STARTS[1] + [0.05, 0, 0]])


def test_an_episode_has_arrived_only_at_the_goals_of_now():
    swarm = quiet()
    statistics = EpisodeStatistics(1, swarm.config)
    swarm.reset(0, STARTS, STARTS + ASIDE)

    def add(steps):
        for report in fly(swarm, steps):
            statistics.add(report, np.array([2]), report.collision)

    add(50)
    assert statistics.success[0]
    counted = int(statistics.steps_counted[0])
    assert counted < 40, "until they arrived"
    swarm.set_goals(0, STARTS)
    statistics.change_goals(0)
    assert not statistics.success[0]
    add(1)
    assert not statistics.at_goals[0]
    assert statistics.steps_counted[0] == counted + 1, "what counts, counts again"
    add(49)
    assert statistics.success[0]
    assert statistics.requests[0] == 2 * statistics.steps_counted[0]


def test_swarms_have_goals_of_their_own():
    swarm = quiet(3)
    for k in range(3):
        swarm.reset(k, STARTS, STARTS + ASIDE)
    swarm.set_goals(1, STARTS, velocities=[[0.3, 0, 0], [0, 0, 0]])
    swarm.set_goals(2, STARTS, waypoints=[[[0, -4, 1], [1, -4, 1]], []])
    alone = swarm.part(np.array([False, False, True]))
    fly(swarm, 5), fly(alone, 5)
    np.testing.assert_array_equal(swarm.goal[0], STARTS + ASIDE)
    np.testing.assert_allclose(swarm.goal[1], STARTS + np.array([[0.15, 0, 0], [0, 0, 0]]))
    np.testing.assert_array_equal(swarm.state[2], alone.state[0])
    np.testing.assert_array_equal(swarm.goal[2], alone.goal[0])
    swarm.keep(np.array([True, False, False]))
    assert swarm.route is None


def test_states_and_copies_hold_goals_that_change():
    swarm = quiet(2)
    swarm.reset(0, STARTS, STARTS + ASIDE)
    swarm.reset(1, STARTS, STARTS + ASIDE, velocities=[[0.3, 0, 0]] * 2, waypoints=[[[0, -4, 1], [-2, -4, 1]], []])
    fly(swarm, 4)
    state, fork, same = swarm.state_dict(), swarm.fork(), copy.deepcopy(swarm)
    other = quiet(2)
    other.load_state_dict(state)
    for one in (swarm, fork, same, other):
        fly(one, 40)
        np.testing.assert_array_equal(one.state, swarm.state)
        np.testing.assert_array_equal(one.goal, swarm.goal)
    before = {key: value for key, value in quiet(2).state_dict().items() if key != "route"}
    other.load_state_dict(before)
    assert other.route is None, "states of before there were routes"
    for name, value in (("left", np.full((2, 2), 3)), ("final", np.zeros((1, 2, 3))), ("velocity", None)):
        with pytest.raises(ValueError, match=name):
            quiet(2).load_state_dict({**state, "route": {**state["route"], name: value}})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goals": STARTS[:1]}, r"goals must be 2 finite points"),
        ({"goals": STARTS + np.array([9, 0, 0])}, r"goals\[0\]=.* is 4\.2 m outside the workspace"),
        ({"goals": [[0, 0, 1], [0.1, 0, 1]]}, r"goals\[0\] and goals\[1\] are 0\.1 m apart"),
        ({"velocities": [[0, 0, np.nan]] * 2}, r"velocities must be 2 finite vectors"),
        ({"velocities": [1, 0, 0]}, r"velocities must be 2 finite vectors"),
        ({"waypoints": [[[0, 0, 1]]]}, r"waypoints must be 2 sequences of points"),
        ({"waypoints": [[0, 0, 1], [0, 0, 1]]}, r"waypoints\[0\] must be 3 finite points"),
        ({"waypoints": [[[0, 0, 1]], [[0, 0, np.inf]]]}, r"waypoints\[1\] must be 1 finite points"),
        ({"waypoints": [[[0, 0, 1]], [[0, 0, 9]]]}, r"waypoints\[1\]\[0\]=.* outside the workspace"),
        ({"waypoints": [np.ones((MOST_WAYPOINTS + 1, 3)), []]}, r"waypoints\[0\] are 1001: a robot may have 1000"),
        ({"waypoints": "home"}, r"waypoints must be 2 sequences"),
        ({"robots": [0, 2]}, r"robots=\[0, 2\]: .* from 0 to 1"),
        ({"robots": [0, 0]}, r"robots=\[0, 0\]: they must be different"),
        ({"robots": ["a"]}, r"robots="),
    ],
)
def test_goals_that_do_not_fit_are_refused_and_change_nothing(arguments, message):
    swarm = quiet()
    swarm.reset(0, STARTS, STARTS + ASIDE)
    with pytest.raises(ValueError, match=message):
        swarm.set_goals(0, **{"goals": STARTS, **arguments})
    np.testing.assert_array_equal(swarm.goal[0], STARTS + ASIDE)
    assert swarm.route is None
    if "robots" not in arguments:
        with pytest.raises(ValueError, match=message):
            swarm.reset(0, STARTS, **{"goals": STARTS, **arguments})


def test_a_goal_too_close_to_that_of_another_robot_or_to_an_obstacle_is_refused():
    pillar = {"position": (0.0, 0.0, 0.0), "radius": 0.3}
    swarm = Swarm(make_config("paper", n_robots=2, obstacles={"listed": (pillar,)}))
    swarm.reset(0, STARTS, STARTS + ASIDE)
    with pytest.raises(ValueError, match=r"goals\[0\] and goals\[1\] are 0\.5 m apart"):
        swarm.set_goals(0, [STARTS[1] + ASIDE + [0.5, 0, 0]], robots=[0])
    with pytest.raises(ValueError, match=r"goals\[0\]=.* 0 m from the surface of obstacle 0 \(radius 0.3 m, "):
        swarm.set_goals(0, [[0.3, 0, 1]], robots=[0])
    with pytest.raises(ValueError, match=r"goals\[0\]=.* 0.2 m inside obstacle 0 .* at least 0.35 m from its surf"):
        swarm.set_goals(0, [[0.1, 0, 1]], robots=[0])
    with pytest.raises(ValueError, match=r"waypoints\[1\]\[0\]=.* from the surface of obstacle 0"):
        swarm.set_goals(0, STARTS, waypoints=[[], [[0.3, 0, 1]]])


def test_doubtful_goals_are_warned_of():
    swarm = quiet(**HUGE)
    with pytest.warns(
        DoubtfulWorld, match=r"velocities\[1\]=\[0\.0, 5\.0, 0\.0\]: .* faster than the 4 m/s .* along y"
    ):
        swarm.reset(0, STARTS, STARTS, velocities=[[0, 0, 0], [0, 5, 0]])
    with pytest.warns(DoubtfulWorld, match=r"more than 41 m away"):
        swarm.set_goals(0, STARTS + 60 * ASIDE)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DoubtfulWorld)
        steps = [STARTS + k * np.array([30, 0, 0]) for k in range(1, 6)]
        swarm.set_goals(0, STARTS + 60 * ASIDE, waypoints=np.swapaxes(steps, 0, 1))


def test_robots_of_their_own_fly_to_other_goals_as_the_swarm_does():
    config = make_config("flight", n_robots=2, planner={"max_yaw_rate": 1.0})
    swarm = Swarm(config)
    starts = STARTS * [1, 0.7, 1]
    robots = [Robot(config, k, RulePolicy("full")) for k in range(2)]
    world = LockstepWorld(config, robots)
    swarm.reset(0, starts, starts + ASIDE / 2, noise_seed=7, headings=[2.0, 0])
    world.reset(starts, starts + ASIDE / 2, 7, headings=[2.0, 0])
    goal, velocity, waypoints = [-1.0, 2, 1.5], [0.2, 0, 0], [[0.0, 2.5, 1], [-2, 2, 1]]
    for step in range(90):
        if step == 10:
            swarm.set_goals(0, [goal], [velocity], [waypoints], robots=[1], headings=[-3.0])
            robots[1].fly_to(goal, velocity, waypoints, -3.0)
        world.step()
        fly(swarm, 1)
        np.testing.assert_array_equal(world.state, swarm.state)
    for k, robot in enumerate(robots):
        np.testing.assert_array_equal(robot.goal[0, 0], swarm.goal[0, k])
    assert swarm.route.at_last.all()
    np.testing.assert_allclose(swarm.state[0, :, 8], [2.0, -3.0], atol=0.3)
    for arguments in (([1, 2],), (goal, [np.nan, 0, 0]), (goal, None, [[1, 2]]), (goal, None, None, np.inf)):
        with pytest.raises(ValueError, match=r"goals|velocities|waypoints|heading"):
            robots[1].fly_to(*arguments)


def test_routes_grow_with_the_longest_queue():
    route = Route(np.zeros((2, 2, 3)))
    route.set(0, slice(None), Targets.of(np.ones((2, 3)), None, [[[5, 0, 0]], []], 2))
    route.set(1, [1], Targets.of([[2, 2, 2]], None, [[[6, 0, 0], [7, 0, 0], [8, 0, 0]]], 1))
    assert route.current()[..., 0].tolist() == [[5, 1], [0, 6]]
    route.take(np.array([[[5, 0, 0], [9, 9, 9]], [[9, 9, 9], [6.2, 0, 0]]]), 0.3)
    assert route.current()[..., 0].tolist() == [[1, 1], [0, 7]]
    assert route.left.tolist() == [[0, 0], [0, 2]]
