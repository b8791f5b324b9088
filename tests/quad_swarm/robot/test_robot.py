import subprocess
import sys

import numpy as np
import pytest

from quad_swarm.planner import make_planner
from quad_swarm.robot import Plan, Robot, RulePolicy
from quad_swarm.task.view import View
from quad_swarm.world.beliefs import BeliefSource
from quad_swarm.world.presets import make_config

CONFIG = make_config("paper", n_robots=3)
PERIOD = 100_000
PLANNER = make_planner(CONFIG.planner, CONFIG.quadrotor, 3)
GOAL = np.array([2.0, 0.0, 1.0])
STILL = np.zeros((2, 3))
OTHERS = np.array([[0.0, 2, 1], [0, -2, 1]])
LIGHT = """
import re, sys
import quad_swarm.robot, onnxruntime
size = int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) / 1024
print(size, [name for name in ("torch", "stable_baselines3", "gymnasium", "pettingzoo") if name in sys.modules])
"""


@pytest.fixture
def robot():
    robot = Robot(CONFIG, 0, RulePolicy("none"), PLANNER)
    robot.reset(np.array([0.0, 0, 1]), GOAL, now=0)
    return robot


def state_at(x):
    state = np.zeros(9)
    state[:3] = x
    return state


def plan_from(place, velocity, stamp):
    times = 0.1 * np.arange(CONFIG.planner.horizon + 1)
    return Plan(stamp, place + times[:, None] * velocity)


def test_a_robot_imports_nothing_that_only_learners_need():
    pytest.importorskip("onnxruntime")
    done = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True, check=True)
    size, heavy = done.stdout.split(maxsplit=1)
    assert heavy.strip() == "[]"
    assert float(size) < 100


def test_a_robot_flies_to_its_goal(robot):
    state, now = state_at([0.0, 0, 1]), 0
    for _ in range(60):
        robot.decide(now, state, OTHERS, STILL)
        u = robot.plan()
        state = PLANNER.model.step(state[None], u[None])[0]
        now += PERIOD
    assert np.abs(state[:3] - GOAL).max() < 0.05


def test_it_is_a_source_of_views(robot):
    state = state_at([0.0, 0, 1])
    robot.decide(0, state, OTHERS, STILL)
    view = View(robot)
    np.testing.assert_allclose(view.pos, [[[[0, 2, 0], [0, -2, 0]]]])
    np.testing.assert_allclose(view.goal, [[[2, 0, 0]]])
    with pytest.raises(ValueError, match="does not know what the others know"):
        view.of_the_other(view.pos)


def test_a_plan_that_arrives_is_believed_and_then_remembered(robot):
    robot.decide(0, state_at([0.0, 0, 1]), OTHERS, STILL)
    robot.receive(2, plan_from(OTHERS[1], np.array([1.0, 0, 0]), -PERIOD)._replace(stamp=0))
    robot.plan()
    assert robot.source.tolist() == [[[BeliefSource.CONSTANT_VELOCITY, BeliefSource.REQUESTED]]]
    moved = OTHERS + np.array([[0.0, 0, 0], [0.1, 0, 0]])
    robot.decide(PERIOD, state_at([0.0, 0, 1]), moved, STILL)
    robot.plan()
    assert robot.source.tolist() == [[[BeliefSource.CONSTANT_VELOCITY, BeliefSource.REMEMBERED]]]
    assert robot.beliefs.age.tolist() == [[[CONFIG.planner.horizon + 2, 1]]]


def test_of_several_plans_of_one_robot_the_newest_counts(robot):
    robot.decide(2 * PERIOD, state_at([0.0, 0, 1]), OTHERS, STILL)
    newer = plan_from(OTHERS[0] - [0.1, 0, 0], np.array([1.0, 0, 0]), PERIOD)
    robot.receive(1, newer)
    robot.receive(1, plan_from(OTHERS[0], np.array([0, 3.0, 0]), 0))  # overtaken by the newer one
    robot.plan()
    assert robot.beliefs.age[0, 0, 0] == 1
    np.testing.assert_allclose(robot.beliefs._remembered[0, 0, 0, 0], OTHERS[0], atol=1e-9)


def test_plans_are_shifted_by_parts_of_a_period(robot):
    robot.decide(2 * PERIOD, state_at([0.0, 0, 1]), OTHERS, STILL)
    robot.receive(1, plan_from(OTHERS[0] - [0.15, 0, 0], np.array([1.0, 0, 0]), PERIOD // 2))
    robot.plan()
    np.testing.assert_allclose(robot.beliefs._remembered[0, 0, 0, 0], OTHERS[0], atol=1e-9)
    assert robot.beliefs.age[0, 0, 0] == 1


def test_what_was_sent_is_presumed_to_be_known(robot):
    robot.decide(0, state_at([0.0, 0, 1]), OTHERS, STILL)
    robot.plan()
    robot.sent(2)
    robot.decide(PERIOD, state_at(robot.newest.positions[1]), OTHERS, STILL)
    robot.plan()
    robot.decide(2 * PERIOD, state_at(robot.newest.positions[1]), OTHERS, STILL)
    seen = robot.seen_by_others([0, 1])
    assert seen.remembers.tolist() == [[[False, True]]]
    assert seen.age[0, 0, 1] == 2


@pytest.mark.parametrize("missed", [1, 3, 50])
def test_missed_periods_are_made_up_for(robot, missed):
    """Plans and beliefs are then as if every period had been flown without hearing anything."""
    other = Robot(CONFIG, 0, RulePolicy("none"), PLANNER)
    other.reset(np.array([0.0, 0, 1]), GOAL, now=0)
    for one in (robot, other):
        one.decide(0, state_at([0.0, 0, 1]), OTHERS, STILL)
        one.receive(1, plan_from(OTHERS[0], np.zeros(3), 0))
        one.plan()
    for k in range(1, missed + 1):
        other.decide(k * PERIOD, state_at([0.0, 0, 1]), OTHERS, STILL)
        other.plan()
    for one in (robot, other):
        one.decide((missed + 1) * PERIOD, state_at([0.0, 0, 1]), OTHERS, STILL)
    horizon = CONFIG.planner.horizon
    assert robot.now == other.now == (missed + 1) * PERIOD
    assert min(robot.beliefs.age[0, 0, 0], horizon) == min(other.beliefs.age[0, 0, 0], horizon)
    assert min(robot.plans.age[0], horizon) == min(missed, horizon)
    robot.receive(1, plan_from(OTHERS[0], np.zeros(3), robot.now - PERIOD))
    assert np.isfinite(robot.plan()).all()
    assert robot.source[0, 0, 0] == BeliefSource.REQUESTED


@pytest.mark.parametrize("index", [-1, 3])
def test_there_is_no_other_robot(index):
    with pytest.raises(ValueError, match=f"index={index}: a team of 3 has the robots 0 to 2"):
        Robot(CONFIG, index, RulePolicy("none"), PLANNER)


def test_limited_neighbourhoods_are_refused():
    config = make_config("paper", {"neighbourhood": {"max_others": 1}}, n_robots=3)
    with pytest.raises(ValueError, match="perceives all others"):
        Robot(config, 0, RulePolicy("none"))


ATTITUDE_IN_DEGREES = np.array([0, 0, 1, 0, 0, 0, 0, 0, 90.0])


@pytest.mark.parametrize(
    ("state", "pos", "vel", "message"),
    [
        (np.zeros(6), OTHERS, STILL, r"state has shape \(6,\); it must be \(9,\): x, y, z, vx, vy, vz, roll"),
        (
            np.zeros(9),
            np.zeros((3, 3)),
            STILL,
            r"pos has shape \(3, 3\); it must be \(2, 3\): the others, .*robot 0",
        ),
        (np.zeros(9), OTHERS, STILL[:1], r"vel has shape \(1, 3\)"),
        (np.full(9, np.nan), OTHERS, STILL, "what a robot perceives must be finite"),
        (np.zeros(9), OTHERS + np.inf, STILL, "pos=.*what a robot perceives must be finite"),
        (ATTITUDE_IN_DEGREES, OTHERS, STILL, "roll 0, pitch 0 and yaw 90 are in rad"),
        (np.array([0, 0, 1, 0, 0, 0, 20.0, 0, 0]), OTHERS, STILL, "roll 20, pitch 0 and yaw 0 are in rad"),
    ],
)
def test_what_no_robot_perceives_is_refused_and_changes_nothing(state, pos, vel, message):
    robot = Robot(CONFIG, 0, RulePolicy("none"), PLANNER)
    robot.reset(np.array([0.0, 0, 1]), GOAL, now=0)
    with pytest.raises(ValueError, match=message):
        robot.decide(0, state, pos, vel)
    assert robot.now == -PERIOD
    robot.decide(0, state_at([0.0, 0, 1]), OTHERS, STILL)
    assert robot.plan().shape == (4,)


@pytest.mark.parametrize("now", [0, -5, 0.25, True])
def test_periods_go_forward(now):
    robot = Robot(CONFIG, 0, RulePolicy("none"), PLANNER)
    robot.reset(np.array([0.0, 0, 1]), GOAL, now=0)
    robot.decide(0, state_at([0.0, 0, 1]), OTHERS, STILL)
    with pytest.raises(ValueError, match=f"now={now}: give whole microseconds, later than 0"):
        robot.decide(now, state_at([0.0, 0, 1]), OTHERS, STILL)
