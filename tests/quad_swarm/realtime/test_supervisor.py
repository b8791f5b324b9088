"""What makes a robot hover or land."""

import threading
import time

import numpy as np
import pytest

from quad_swarm.realtime import Mode, SafetyLimits, Sensed, Supervisor, Watchdog
from quad_swarm.realtime.supervisor import room_of
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import make_config

CONFIG = make_config("flight", n_robots=3)
PERIOD = 50_000
FAR = np.array([[3.0, 0, 1], [0, 3.0, 1]])


def sensed(now, pos=(0.0, 0.0, 1.5), others=FAR, age=10_000):
    state = np.zeros(9)
    state[:3] = pos
    state[3] = 0.5 + 1e-9 * now  # a real estimate is never the same twice
    return Sensed(now - age, state, others, np.zeros((2, 3)))


def modes(supervisor, states, setpoint=(0.1, 0, 0, 0), unanswered=0.0):
    """The modes of consecutive periods."""
    return [
        supervisor.check(k * PERIOD, None if one is None else one(k * PERIOD), np.array(setpoint), unanswered)
        for k, one in enumerate(states)
    ]


def test_a_robot_that_sees_flies():
    supervisor = Supervisor(CONFIG, SafetyLimits())
    assert modes(supervisor, [sensed] * 10) == [Mode.FLY] * 10
    assert supervisor.sees
    assert not supervisor.reasons


def test_a_state_that_does_not_come_any_more():
    supervisor, last = Supervisor(CONFIG, SafetyLimits()), sensed(0)
    flown = modes(supervisor, [lambda now: last] * 30)
    assert flown == [Mode.FLY] * 4 + [Mode.HOVER] * 16 + [Mode.LAND] * 10
    assert supervisor.reasons == {"state is stale": 1}
    assert not supervisor.sees


def test_a_robot_goes_on_when_it_sees_again():
    supervisor, last = Supervisor(CONFIG, SafetyLimits()), sensed(0)
    flown = modes(supervisor, [None] + [sensed] * 2 + [lambda now: last] * 5 + [sensed] * 2)
    assert flown == [Mode.HOVER] + [Mode.FLY] * 3 + [Mode.HOVER] * 4 + [Mode.FLY] * 2


def test_a_state_that_is_repeated():
    supervisor, first = Supervisor(CONFIG, SafetyLimits()), sensed(0)
    flown = modes(supervisor, [lambda now: first._replace(stamp=now)] * 30)
    assert flown == [Mode.FLY] * 5 + [Mode.HOVER] * 16 + [Mode.LAND] * 9
    assert supervisor.reasons == {"state is frozen": 1}


def test_a_robot_at_rest_may_have_the_same_state():
    state = np.zeros(9)
    state[2] = 1.0
    supervisor = Supervisor(CONFIG, SafetyLimits())
    rests = [lambda now: Sensed(now, state, FAR, np.zeros((2, 3)))] * 40
    assert modes(supervisor, rests, setpoint=np.zeros(4)) == [Mode.FLY] * 40
    assert Mode.HOVER in modes(supervisor, rests), "unless it is told to move"


def test_landing_is_final_and_ends_on_the_ground():
    supervisor = Supervisor(CONFIG, SafetyLimits())
    high = CONFIG.planner.workspace_high
    out = (high[0] + 1.1, 0.0, 1.5)
    flight = [sensed, lambda now: sensed(now, out), sensed, *[lambda now: sensed(now, (0, 0, 0.05))] * 7, *[sensed] * 2]
    assert modes(supervisor, flight) == [Mode.FLY] + [Mode.LAND] * 8 + [Mode.OFF] * 3
    assert supervisor.reasons == {"outside the fence": 1}
    assert supervisor.setpoint(Mode.LAND).tolist() == [0, 0, -0.5, 0]
    supervisor.reset()
    assert modes(supervisor, [sensed]) == [Mode.FLY]


def test_a_landing_obeys_the_planner_s_limit_and_may_take_longer():
    slow = make_config(CONFIG, planner={"max_descent_rate": 0.1})
    supervisor = Supervisor(slow, SafetyLimits(landing_time=1.0))
    assert supervisor.setpoint(Mode.LAND).tolist() == [0, 0, -0.1, 0]
    assert supervisor.limits.landing_time == pytest.approx(5.0)
    fast = make_config(CONFIG, planner={"max_descent_rate": 2.0})
    assert Supervisor(fast, SafetyLimits()).limits == SafetyLimits()


@pytest.mark.parametrize(("height", "seconds"), [(0.2, 1.0), (1.5, 2 * 1.4 / 0.5)])
def test_a_landing_without_a_state_takes_twice_the_time_of_the_descent(height, seconds):
    supervisor = Supervisor(CONFIG, SafetyLimits(landing_time=1.0))
    last = sensed(0, (0, 0, height))
    flown = modes(supervisor, [lambda now: last] * 150)
    assert flown.count(Mode.LAND) == pytest.approx(seconds * 20, abs=1)
    assert flown[-1] is Mode.OFF


def test_a_landing_of_a_robot_that_was_never_seen_takes_that_of_the_whole_room():
    supervisor = Supervisor(CONFIG, SafetyLimits(landing_time=1.0))
    supervisor.land()
    seconds = 2 * (CONFIG.planner.workspace_high[2] - 0.1) / 0.5
    assert modes(supervisor, [None] * 600).count(Mode.LAND) == pytest.approx(seconds * 20, abs=1)


def test_a_robot_that_sees_itself_in_the_air_does_not_disarm():
    """Neither after the time of a landing nor by a single low state."""
    supervisor = Supervisor(CONFIG, SafetyLimits(landing_time=1.0))
    supervisor.land()
    low = [lambda now: sensed(now, (0, 0, 0.05))]
    assert modes(supervisor, [*[sensed] * 60, *low * 4, sensed, *low * 4, sensed]) == [Mode.LAND] * 70


def test_a_planner_that_fails_makes_it_land():
    supervisor = Supervisor(CONFIG, SafetyLimits())
    assert supervisor.check(0, sensed(0), np.zeros(4), unplanned=0.9) is Mode.FLY
    assert supervisor.check(PERIOD, sensed(PERIOD), np.zeros(4), unplanned=1.1) is Mode.LAND
    assert supervisor.why == {"planner fails"}
    assert supervisor.sees


def test_a_robot_lands_if_somebody_wishes_so():
    """Whatever it perceives afterwards, until it is on the ground."""
    supervisor = Supervisor(CONFIG, SafetyLimits())
    assert modes(supervisor, [sensed]) == [Mode.FLY]
    supervisor.land()
    assert modes(supervisor, [sensed] * 2) == [Mode.LAND] * 2
    assert supervisor.why == {"told to land"}
    assert modes(supervisor, [lambda now: sensed(now, (0, 0, 0.05))] * 8) == [Mode.LAND] * 6 + [Mode.OFF] * 2
    assert supervisor.reasons == {"told to land": 1}
    supervisor.reset()
    assert modes(supervisor, [sensed]) == [Mode.FLY], "the wish was that of the last flight"


@pytest.mark.parametrize(("pos", "outside"), [((0, 0, -0.2), False), ((-9, 0, 1), True), ((0, 0, 9), True)])
def test_the_fence_is_open_to_the_ground(pos, outside):
    supervisor = Supervisor(CONFIG, SafetyLimits())
    modes(supervisor, [lambda now: sensed(now, pos)])
    assert ("outside the fence" in supervisor.why) is outside


def test_robots_that_touch_hover():
    contact = 2 * CONFIG.radius - CONFIG.collision_tolerance
    supervisor = Supervisor(CONFIG, SafetyLimits())
    for gap, mode in ((0.01, Mode.FLY), (-0.01, Mode.HOVER)):
        others = np.array([[0, contact + gap, 1.5], [3, 0, 1.5]])
        assert modes(supervisor, [lambda now, others=others: sensed(now, others=others)]) == [mode]
    supervisor = Supervisor(CONFIG, SafetyLimits(separation=0.7))
    assert modes(supervisor, [lambda now: sensed(now, others=np.array([[0.69, 0, 1.5], [3, 0, 1.5]]))]) == [Mode.HOVER]


@pytest.mark.parametrize(("robot", "reach"), [(0, (0.5, 0.7)), (1, (0.5, 0.8)), (2, (0.7, 0.8))])
def test_unlike_robots_touch_where_their_surfaces_do(robot, reach):
    config = make_config("flight", {"vehicles": [{"radius": 0.2}, {}, {"radius": 0.5}]}, n_robots=3)
    for near, contact in enumerate(reach):
        for gap, mode in ((0.01, Mode.FLY), (-0.01, Mode.HOVER)):
            others = np.array([[0, 3, 1.5], [3, 0, 1.5]])
            others[near, :2] *= (contact + gap - config.collision_tolerance) / 3
            supervisor = Supervisor(config, SafetyLimits(), robot)
            assert modes(supervisor, [lambda now, others=others: sensed(now, others=others)]) == [mode]


def test_near_is_in_the_metric_of_collisions():
    """With downwash, contact above and below is farther away than beside."""
    config = make_config(CONFIG, {"planner": {"downwash": 3.0}})
    contact = 2 * config.radius - config.collision_tolerance
    for place, mode in (
        ((0, 0, 2.9 * contact), Mode.HOVER),
        ((0, 0, 3.1 * contact), Mode.FLY),
        ((0, 1.1 * contact, 0), Mode.FLY),
    ):
        others = np.array([[3.0, 0, 1.5], np.add([0, 0, 1.5], place)])
        assert modes(Supervisor(config, SafetyLimits()), [lambda now, others=others: sensed(now, others=others)]) == [
            mode
        ]


@pytest.mark.parametrize(("unanswered", "mode"), [(0.9, Mode.FLY), (1.1, Mode.HOVER), (10.1, Mode.LAND)])
def test_nobody_answers(unanswered, mode):
    supervisor = Supervisor(CONFIG, SafetyLimits())
    assert modes(supervisor, [sensed], unanswered=unanswered) == [mode]
    assert supervisor.sees


def test_limits_that_contradict_each_other_are_refused():
    with pytest.raises(ValueError, match="hovers before it lands"):
        SafetyLimits(stale=2.0)
    with pytest.raises(ValueError, match="hung"):
        SafetyLimits(hung=0.0)
    with pytest.raises(ValueError, match="landing"):
        SafetyLimits(landing=0.5)


class Recorder:
    def __init__(self):
        self.commands, self.levelled, self.lands = [], threading.Event(), threading.Event()

    def command(self, setpoint, plan):
        self.commands.append(setpoint)
        (self.levelled if setpoint[2] == 0 else self.lands).set()


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"ground": 1.2}, r"limits\.ground=1\.2 m: .* must be -5 to 0\.48 m"),
        ({"ground": -6.0}, r"limits\.ground=-6 m: .* planner\.workspace_low\[2\]=0\.48, .* -5 to"),
        ({"separation": 0.3}, r"limits\.separation=0\.3 m: .* contact \(0\.599\)"),
        ({"separation": 4.0}, r"limits\.separation=4 m: .* planner\.separation=0\.8"),
    ],
)
def test_limits_that_do_not_fit_the_world_are_refused(limits, message):
    with pytest.raises(ValueError, match=message):
        Supervisor(CONFIG, SafetyLimits(**limits))


def test_limits_of_unlike_robots_count_as_if_all_had_the_world_s_radius():
    config = make_config("flight", n_robots=3, vehicles=({"radius": 0.2}, {"radius": 0.4}, {}))
    for robot in range(3):
        Supervisor(config, SafetyLimits(separation=0.7), robot)


@pytest.mark.parametrize("limits", [{"fence": 300.0}, {"stale": 200.0, "lost": 1000.0}, {"hung": 300.0}])
def test_limits_in_other_units_are_refused(limits):
    with pytest.raises(ValueError, match="less than or equal to"):
        SafetyLimits(**limits)


def test_a_robot_that_leaves_the_workspace_stops_before_the_walls():
    slow = make_config("flight", n_robots=3, radius=0.15, planner={"max_speed": 1.0})
    low, high = np.array(slow.planner.workspace_low), np.array(slow.planner.workspace_high)
    apart = np.array([1.05, 1.05, 0.95])  # 0.3 m, braking from 1 m/s within 0.6 m, upwards 0.5 m, and the radius

    def make(fence, less=(0, 0, 0), more=(0, 0, 0), config=slow):
        room = (tuple(low - apart + less), tuple(high + apart - more))
        return Supervisor(config, SafetyLimits(fence=fence, room=room))

    make(0.3, less=(0, 0, 0.7))
    with pytest.raises(
        ValueError,
        match=r"1 m between planner\.workspace_low\[1\]=.* needs 1\.05 m to stop: give planner\.workspace_low=",
    ):
        make(0.3, less=(0, 0.05, 0))
    upwards = r"0\.9 m between planner\.workspace_high\[2\]=.* the ceiling at .* needs 0\.95 m to stop: .* or a lower"
    with pytest.raises(ValueError, match=upwards):
        make(0.3, more=(0, 0, 0.05))
    with pytest.raises(ValueError, match=r"the fence \(1 m\) needs 1\.75 m to stop"):
        make(1.0)
    with pytest.raises(ValueError, match=r"needs 1\.85 m to stop.*, or planner\.max_speed below 2$"):
        make(0.3, config=make_config(slow, {"planner": {"max_speed": 2.0}}))
    with pytest.raises(ValueError, match=r"needs 1\.75 m to stop: (?!.*max_speed)"):
        make(1.0)  # 1.05 m are less than fence and radius: no speed is slow enough
    with pytest.raises(ValueError, match=r"room"):
        SafetyLimits(room=((0, 0, 0), (1, 1, float("inf"))))
    with pytest.raises(ValueError, match=r"the workspace, .* is not inside"):
        Supervisor(slow, SafetyLimits(fence=0.3, room=((0, 0, 0), (12, 12, 4))))
    with pytest.raises(ValueError, match=r"0\.1 m between the floor and .*: nothing guards the floor"):
        make(0.3, less=(0, 0, 0.85))
    with pytest.warns(DoubtfulWorld, match=r"295 m beside the workspace: lengths are in metres"):
        Supervisor(slow, SafetyLimits(fence=0.3, room=((-300, -300, 0), (300, 300, 260))))
    limits = SafetyLimits(fence=0.3, room=(tuple(low - apart), tuple(high + apart)))
    assert room_of(slow, limits).startswith("walls 1.05 m from the workspace (1.05 m needed), ceiling 0.95 m (0.95 m)")


def test_a_loop_that_hangs_is_noticed():
    vehicle = Recorder()
    watchdog = Watchdog(vehicle, SafetyLimits(hung=0.05, stale=0.1, lost=0.2))  # lands for 20 s
    try:
        assert not vehicle.levelled.wait(0.2), "before it is armed"
        watchdog.beat()
        assert vehicle.levelled.wait(500)
        assert vehicle.lands.wait(500)
        assert watchdog.barks == 1
        assert not any(setpoint[2] for setpoint in vehicle.commands[:1]), "it levels first"
    finally:
        watchdog.close()
    before = len(vehicle.commands)
    time.sleep(0.1)
    assert len(vehicle.commands) == before


def test_an_error_of_the_vehicle_does_not_end_the_watchdog():
    calls, enough = [], threading.Event()

    class Vehicle:
        def command(self, setpoint, plan):
            calls.append(setpoint)
            if len(calls) == 3:
                enough.set()
            raise OSError("no link")

    watchdog = Watchdog(Vehicle(), SafetyLimits(hung=0.02))
    watchdog.beat()
    assert enough.wait(30)
    watchdog.close()


def test_the_watchdog_ends_with_the_landing():
    """Then, the autopilot's failsafe has to act."""
    vehicle = Recorder()
    watchdog = Watchdog(vehicle, SafetyLimits(hung=0.02, stale=0.1, lost=0.1, landing_time=0.1))
    watchdog.beat()
    assert vehicle.lands.wait(500)
    time.sleep(1.0)
    before = len(vehicle.commands)
    time.sleep(0.3)
    watchdog.close()
    assert len(vehicle.commands) == before
