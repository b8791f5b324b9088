"""The loop of one robot, on a clock, a link and a vehicle that a test moves by hand."""

import gc

import numpy as np
import pytest

from quad_swarm.quadrotor import VELOCITY
from quad_swarm.realtime import Loop, Mode, SafetyLimits, Sensed
from quad_swarm.realtime.loop import thaw_garbage
from quad_swarm.robot import Plan, Robot, RulePolicy
from quad_swarm.world.presets import make_config

CONFIG = make_config("flight", n_robots=3)
PERIOD = 50_000
HORIZON = CONFIG.planner.horizon
OTHERS = np.array([[2.0, 0.3, 1.5], [-2.0, 1.0, 1.5]])


class Link:
    def __init__(self):
        self.time, self.requests, self.plans, self.broken = 0, [], [], False

    def now(self):
        return self.time

    def request(self, other):
        if self.broken:
            raise OSError("no network")
        self.requests.append(other)

    def send(self, other, plan, period, asked):
        if self.broken:
            raise OSError("no network")
        self.plans.append((other, plan.stamp, asked))

    def wait(self, until, handler, done=lambda: False):
        self.time = max(self.time, until)


class Vehicle:
    def __init__(self, link):
        self.link, self.commands, self.disarmed = link, [], 0
        self.state = np.zeros(9)
        self.state[2] = 1.5
        self.perceived = lambda: Sensed(self.link.time - 5_000, self.state, OTHERS, np.zeros((2, 3)))

    def sense(self):
        self.state = self.state + 1e-9
        return self.perceived()

    def command(self, setpoint, plan):
        self.commands.append((self.link.time, setpoint, plan))

    def disarm(self):
        self.disarmed += 1


def make(rule="full", limits=None, **options):
    link = Link()
    vehicle = Vehicle(link)
    policy = rule if callable(rule) else RulePolicy(rule)
    loop = Loop(Robot(CONFIG, 0, policy), link, vehicle, limits, **options)
    loop.start(np.array([0, 0, 1.5]), np.array([3.0, 0, 1.5]), 0)
    return loop, link, vehicle


def periods(loop, count):
    """The modes of periods one after another."""
    modes = []
    for _ in range(count):
        loop.link.wait(loop.next_period, loop)
        loop.begin()
        loop.finish()
        modes.append(loop.supervisor.mode)
    return modes


def plan_of(place, stamp, velocity=(0.0, 0.0, 0.0)):
    steps = np.arange(HORIZON + 1)[:, None] * PERIOD * 1e-6
    return Plan(stamp, OTHERS[place] + steps * np.array(velocity))


def test_a_period():
    loop, link, vehicle = make("cpa:9s:9|push:0")
    assert loop.begin()
    assert loop.waits
    assert loop.deadline == 5_000
    assert link.requests == [1, 2]
    assert link.plans == [(1, -PERIOD, False), (2, -PERIOD, False)], "the plan of the last period"
    link.time = 700
    loop.on_plan(1, plan_of(0, -20_000), 400, PERIOD)
    assert loop.waits
    loop.on_plan(2, plan_of(1, -20_000), 500, PERIOD)
    assert not loop.waits
    loop.on_request(2)
    assert link.plans[-1] == (2, -PERIOD, True)
    loop.finish()
    ((at, setpoint, plan),) = vehicle.commands
    assert at == 700
    assert setpoint[1] > 0.05, "towards the goal"
    assert plan.stamp == 0
    statistics = loop.stop()
    assert dict(statistics.counts) == {
        "periods": 1, "missed": 0, "late commands": 0, "requests": 2, "announcements": 2, "plans received": 2,
        "requests received": 1, "answers": 1,
    }  # fmt: skip
    assert statistics.durations["round_trip"].total == 2
    assert statistics.durations["one_way"].quantile(0.5) == pytest.approx(250, rel=0.3)
    assert statistics.durations["plan_age"].quantile(0.5) == pytest.approx(20_000, rel=0.05)
    assert statistics.durations["sensed"].quantile(0.5) == pytest.approx(5_000, rel=0.05)


def test_periods_lie_on_a_grid_and_missed_ones_are_counted():
    loop, link, _vehicle = make("none")
    started = []
    for now in (0, 50_900, 100_000, 299_999, 300_000):
        link.time = now
        loop.begin()
        started.append(loop.next_period - PERIOD)
        loop.finish()
    assert started == [0, PERIOD, 2 * PERIOD, 5 * PERIOD, 6 * PERIOD]
    statistics = loop.stop()
    assert statistics.counts["missed"] == 2
    assert statistics.share("missed") == 2 / 7
    assert statistics.counts["late commands"] == 1
    assert statistics.durations["jitter"].quantile(1.0) == pytest.approx(49_999, rel=0.05)


def test_the_state_is_moved_to_the_start_of_the_period():
    seen = []

    def policy(robot):
        seen.append((robot.estimate()[0, 0, :3].copy(), robot.observe()[0][0, 0].copy()))
        return np.zeros((2, 1), bool)

    loop, link, vehicle = make(policy)
    vel = np.array([[1.0, 0, 0], [0, -2.0, 0]])
    state = np.array([0, 0, 1.5, 1.0, 0.5, 0, 0, 0, 0])
    vehicle.perceived = lambda: Sensed(link.time - 20_000, state, OTHERS, vel)
    loop.begin()
    np.testing.assert_allclose(seen[0][0], [0.02, 0.01, 1.5])
    np.testing.assert_allclose(seen[0][1], OTHERS + 0.02 * vel)


REFUSED = {
    "other periods": lambda: (plan_of(0, 0), PERIOD + 1000),
    "from the future": lambda: (plan_of(0, 90_000), PERIOD),
    "too old": lambda: (plan_of(0, -HORIZON * PERIOD), PERIOD),
    "not where its robot is": lambda: (plan_of(1, 0), PERIOD),
    "not finite": lambda: (Plan(0, plan_of(0, 0).positions * np.nan), PERIOD),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_a_plan_that_cannot_be_is_refused(reason):
    loop, _link, _ = make()
    periods(loop, 1)
    plan, period = REFUSED[reason]()
    loop.on_plan(1, plan, 0, period)
    assert loop.statistics.counts[f"refused: {reason}"] == 1
    assert not loop.robot.inbox
    loop.on_plan(1, plan_of(0, 0), 0, PERIOD)
    assert list(loop.robot.inbox) == [0]


def test_plans_of_another_length_are_refused():
    loop, _, _ = make()
    periods(loop, 1)
    loop.on_plan(1, Plan(0, plan_of(0, 0).positions[:-1]), 0, PERIOD)
    assert loop.statistics.counts["refused: other periods"] == 1


@pytest.mark.parametrize("sender", [0, 3, 200])
def test_only_the_team_is_heard(sender):
    loop, link, _ = make("none")
    periods(loop, 1)
    loop.on_plan(sender, plan_of(0, 0), 0, PERIOD)
    loop.on_request(sender)
    assert loop.statistics.counts["refused: not of the team"] == 2
    assert not link.plans


def test_a_plan_of_the_past_is_compared_with_where_its_robot_is_now():
    loop, link, vehicle = make()
    vel = np.array([[4.0, 0, 0], [0, 0, 0]])
    moved = OTHERS + 0.3 * vel
    vehicle.perceived = lambda: Sensed(link.time, vehicle.state, moved, vel)
    link.time = 300_000
    periods(loop, 1)
    loop.on_plan(1, plan_of(0, 0, (4.0, 0, 0)), 0, PERIOD)
    assert loop.statistics.counts["plans received"] == 1


def test_who_gets_no_answers_hovers_and_asks_everybody():
    loop, link, _vehicle = make(lambda robot: np.array([[True], [False]]))
    modes = periods(loop, 30)
    assert modes[:20] == [Mode.FLY] * 20
    assert modes[-8:] == [Mode.HOVER] * 8
    assert link.requests[:3] == [1, 1, 1]
    assert link.requests[-2:] == [1, 2]
    assert np.linalg.norm(loop.robot.goal[0, 0] - [0, 0, 1.5]) < 0.01, "it holds its place"
    loop.on_request(2)
    assert periods(loop, 1) == [Mode.FLY]
    np.testing.assert_array_equal(loop.robot.goal[0, 0], [3.0, 0, 1.5])


def test_who_believes_nobody_s_plans_hovers_and_lands():
    """As when clocks disagree: messages arrive, and each of them is refused."""
    loop, _link, _vehicle = make("full")
    modes = []
    for _ in range(210):
        modes += periods(loop, 1)
        loop.on_request(1)
        loop.on_plan(1, plan_of(0, loop.link.now() + 200_000), 0, PERIOD)
    assert modes[:20] == [Mode.FLY] * 20
    assert modes[25:200] == [Mode.HOVER] * 175
    assert modes[-1] is Mode.LAND
    assert loop.supervisor.why >= {"no answers"}


def test_one_plan_that_is_refused_is_no_silence():
    loop, _link, _vehicle = make("full")
    modes = []
    for _ in range(40):
        modes += periods(loop, 1)
        loop.on_plan(1, plan_of(0, loop.link.now() + 200_000), 0, PERIOD)
        loop.on_plan(2, plan_of(1, loop.link.now()), 0, PERIOD)
    assert modes == [Mode.FLY] * 40


def test_a_robot_that_never_sees_lands():
    loop, _link, vehicle = make("none")
    vehicle.perceived = lambda: None
    modes = periods(loop, 23)
    assert modes[:21] == [Mode.HOVER] * 21
    assert modes[-1] is Mode.LAND


def test_another_goal_counts_from_the_next_period_on():
    loop, _link, _vehicle = make()
    periods(loop, 1)
    loop.fly_to([-3.0, 0, 1.5], [0.5, 0, 0], [[0, 3.0, 1.5]])
    np.testing.assert_array_equal(loop.robot.goal[0, 0], [3.0, 0, 1.5])
    periods(loop, 1)
    np.testing.assert_array_equal(loop.robot.goal[0, 0], [0, 3.0, 1.5])
    loop.fly_to([-3.0, 0, 1.5], [0.5, 0, 0])
    periods(loop, 2)
    np.testing.assert_allclose(loop.robot.goal[0, 0], [-3.0 + 2 * 0.5 * PERIOD * 1e-6, 0, 1.5])
    loop.fly_to([2.0, 0, 1.5])
    with pytest.raises(ValueError, match="goals"):
        loop.fly_to([np.nan, 0, 1.5])
    with pytest.raises(ValueError, match=r"heading\[0\]=1: with planner\.max_yaw_rate=0"):
        loop.fly_to([2.0, 0, 1.5], heading=1.0)
    periods(loop, 1)
    np.testing.assert_array_equal(loop.robot.goal[0, 0], [2.0, 0, 1.5])


def test_silence_that_nobody_broke_is_no_fault():
    loop, _, _ = make("none")
    assert periods(loop, 60) == [Mode.FLY] * 60


@pytest.mark.parametrize("bad", [None, np.full(9, np.nan), np.zeros(8)])
def test_a_robot_without_a_state_hovers_and_then_lands(bad):
    loop, link, vehicle = make("none")
    periods(loop, 2)
    vehicle.perceived = lambda: None if bad is None else Sensed(link.time, bad, OTHERS, np.zeros((2, 3)))
    modes = periods(loop, 40)
    assert modes[-1] is Mode.LAND
    assert Mode.HOVER in modes
    _at, setpoint, plan = vehicle.commands[-1]
    assert (setpoint.tolist(), plan) == ([0, 0, -0.5, 0], None)
    counts = loop.stop().counts
    assert counts["state is stale"] == 1
    assert counts["errors: sensing"] == (0 if bad is None else 40)


def test_a_state_with_the_stamp_of_another_clock_is_none():
    """A time of the day would never be stale, and the state would be moved by years."""
    loop, link, vehicle = make()
    periods(loop, 2)
    vehicle.perceived = lambda: Sensed(link.time + 1_700_000_000_000_000, vehicle.state, OTHERS, np.zeros((2, 3)))
    modes = periods(loop, 24)
    assert modes[6] is Mode.HOVER
    assert modes[-1] is Mode.LAND
    assert loop.statistics.counts["errors: sensing"] >= 24
    assert "link.own" in loop.statistics.last_error


def test_a_landing_brakes_and_sinks_whatever_the_planner_wants():
    loop, _link, vehicle = make("full")
    periods(loop, 1)
    vehicle.state[VELOCITY] = [1.5, 0, 0]
    loop.supervisor.land()
    assert periods(loop, 1) == [Mode.LAND]
    _at, setpoint, plan = vehicle.commands[-1]
    assert setpoint[1] < -0.1, "nose up, against the motion"
    assert setpoint[2] == -0.5
    newest = loop.robot.newest
    assert np.array_equal(plan.positions[:, :2], newest.positions[:, :2]), "who follows plans brakes and evades, too"
    assert np.allclose(np.diff(plan.positions[:, 2]), -0.5 * PERIOD * 1e-6)
    assert plan.positions[0, 2] == newest.positions[0, 2]
    assert loop.robot.newest.positions[-1, 2] < 1.4, "others are told that it sinks"
    loop.robot.plan = lambda: np.full(4, np.nan)
    periods(loop, 1)
    assert vehicle.commands[-1][1].tolist() == [0, 0, -0.5, 0]
    assert vehicle.commands[-1][2] is None


def test_after_landing_the_motors_stop():
    loop, _link, vehicle = make("none", SafetyLimits(fence=0.0))
    vehicle.state[0] = 50.0
    assert periods(loop, 2) == [Mode.LAND] * 2
    vehicle.state[2] = 0.0
    assert periods(loop, 6) == [Mode.LAND] * 6
    assert periods(loop, 4) == [Mode.OFF] * 4
    assert not loop.has_landed
    periods(loop, 1)
    assert loop.has_landed
    assert vehicle.disarmed == 5
    assert len(vehicle.commands) == 8


def test_until_all_begin_it_holds_its_start_and_needs_nobody():
    loop, link, vehicle = make("full")
    start = np.array([0, 0, 1.5])
    loop.start(start, np.array([3.0, 0, 1.5]), 0, begins=15 * 1_000_000)
    assert periods(loop, 300) == [Mode.FLY] * 300
    np.testing.assert_array_equal(loop.robot.goal[0, 0], start)
    assert np.abs(vehicle.commands[-1][1]).max() < 1e-3
    assert link.requests, "and hears them if they are there"
    periods(loop, 1)
    np.testing.assert_array_equal(loop.robot.goal[0, 0], [3.0, 0, 1.5])
    assert vehicle.commands[-1][1][1] > 0.05
    assert Mode.HOVER in periods(loop, 25), "from then on, silence counts"


def test_a_robot_that_waits_can_be_told_to_land():
    loop, _link, vehicle = make("none")
    loop.start(np.array([0, 0, 1.5]), np.array([3.0, 0, 1.5]), 0, begins=10**9)
    periods(loop, 2)
    loop.supervisor.land()
    assert periods(loop, 1) == [Mode.LAND]
    assert vehicle.commands[-1][1][2] == -0.5


NOT_READY = {
    "from 5 s in the future": lambda now, state: Sensed(now + 5_000_000, state, OTHERS, 0 * OTHERS),
    "no state of each robot": lambda now, state: None,
    "0.300 s old": lambda now, state: Sensed(now - 300_000, state, OTHERS, 0 * OTHERS),
    "on the ground": lambda now, state: Sensed(now, state * [1, 1, 0, 1, 1, 1, 1, 1, 1], OTHERS, 0 * OTHERS),
    "finite": lambda now, state: Sensed(now, state * np.nan, OTHERS, 0 * OTHERS),
    "too close": lambda now, state: Sensed(now, state, OTHERS * 0 + [0.1, 0, 1.5], 0 * OTHERS),
}


@pytest.mark.parametrize("reason", NOT_READY)
def test_who_must_not_take_over_is_told_why(reason):
    loop, link, vehicle = make()
    assert loop.ready().state[2] == pytest.approx(1.5)
    vehicle.perceived = lambda: NOT_READY[reason](link.time, vehicle.state)
    with pytest.raises(ValueError, match=reason):
        loop.ready()


def test_a_planner_that_fails_for_good_lands():
    loop, _link, vehicle = make("none")
    periods(loop, 1)
    plan, loop.robot.plan = loop.robot.plan, lambda: 1 / 0
    assert periods(loop, 21) == [Mode.FLY] * 21
    assert vehicle.commands[-1][1].tolist() == [0, 0, 0, 0]
    assert periods(loop, 2)[-1] is Mode.LAND
    assert vehicle.commands[-1][1].tolist() == [0, 0, -0.5, 0]
    loop.robot.plan = plan
    assert periods(loop, 1) == [Mode.LAND]


def test_a_planner_that_fails_at_times_flies():
    loop, _link, _vehicle = make("none")
    periods(loop, 1)
    plan = loop.robot.plan
    for _ in range(3):
        loop.robot.plan = lambda: 1 / 0
        periods(loop, 15)
        loop.robot.plan = plan
        assert periods(loop, 1) == [Mode.FLY]


def test_a_link_that_cannot_wait_does_not_end_the_flight():
    loop, link, vehicle = make("full")

    def wait(until, handler, done=lambda: False):
        link.time = max(link.time, until)
        raise OSError("no network")

    link.wait = wait
    statistics = loop.run(lambda: link.time >= 4 * PERIOD)
    assert statistics.counts["periods"] == 4
    assert statistics.counts["errors: link"] >= 4
    assert len(vehicle.commands) == 4


def test_errors_of_policies_planners_links_and_vehicles_do_not_end_the_loop():
    def policy(robot):
        raise RuntimeError("of a stranger")

    loop, link, vehicle = make(policy)
    periods(loop, 1)
    assert link.requests == [1, 2], "then everybody is asked"
    assert loop.statistics.last_error == "policy: RuntimeError: of a stranger"
    link.broken = True
    periods(loop, 1)
    loop.on_request(1)
    loop.robot.plan = lambda: np.full(4, np.nan)
    periods(loop, 1)
    assert vehicle.commands[-1][1].tolist() == [0, 0, 0, 0]
    vehicle.command = None
    periods(loop, 1)
    counts = loop.stop().counts
    assert counts["errors: policy"] == 4
    assert counts["errors: link"] == 3 * 2 + 1
    assert counts["errors: planner"] == 2
    assert counts["errors: vehicle"] == 1


def test_a_policy_of_another_shape_asks_everybody():
    loop, link, _ = make(lambda robot: np.zeros((5, 1), bool))
    periods(loop, 1)
    assert link.requests == [1, 2]


def test_what_was_not_sent_is_not_presumed_to_be_known():
    loop, link, _ = make("none")
    periods(loop, 1)
    link.broken = True
    loop.on_request(1)
    assert not loop.robot._sent
    link.broken = False
    loop.on_request(1)
    assert list(loop.robot._sent) == [0]


def test_run_flies_until_it_ends_and_can_begin_again():
    loop, link, vehicle = make("none")
    beats = []
    statistics = loop.run(lambda: link.time >= 10 * PERIOD, beats.append)
    assert (statistics.counts["periods"], len(beats)) == (10, 10)
    loop.start(np.zeros(3), np.ones(3), 20 * PERIOD)
    assert loop.run(lambda: link.time >= 22 * PERIOD).counts["periods"] == 2
    assert vehicle.commands[-1][0] == 21 * PERIOD


def test_warming_up_leaves_no_trace():
    loop, link, vehicle = make("full")
    first = periods(loop, 3) and [setpoint for _, setpoint, _ in vehicle.commands]
    loop, link, vehicle = make("full")
    loop.warm_up()
    assert not link.requests
    assert not vehicle.commands
    loop.start(np.array([0, 0, 1.5]), np.array([3.0, 0, 1.5]), 0)
    periods(loop, 3)
    np.testing.assert_array_equal([setpoint for _, setpoint, _ in vehicle.commands], first)


@pytest.mark.parametrize("times", [{"wait": 0.05}, {"wait": -1}, {"late": 1.0}, {"late": -0.1}, {"wait": np.nan}])
def test_times_that_do_not_fit_are_refused(times):
    with pytest.raises(ValueError, match=next(iter(times))):
        make(**times)


def test_garbage_is_collected_again():
    gc.disable()
    try:
        gc.freeze()
        thaw_garbage()
        assert gc.isenabled()
        assert not gc.get_freeze_count()
    finally:
        gc.enable()
