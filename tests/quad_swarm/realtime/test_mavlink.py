"""An autopilot over MAVLink, flown against a stand-in with dynamics, PX4's frames and its manners."""

import socket

import numpy as np
import pytest

from quad_swarm.geometry import to_frd, to_ned
from quad_swarm.realtime import Loop, Mode, SafetyLimits
from quad_swarm.realtime.attitude import GRAVITY, AttitudeController, AttitudeGains
from quad_swarm.realtime.mavlink import MavlinkVehicle, UdpPort
from quad_swarm.robot import Robot, RulePolicy
from quad_swarm.world.presets import make_config

common = pytest.importorskip("pymavlink.dialects.v20.common")

CONFIG = make_config("flight", n_robots=2)
FAR = np.array([[40.0, 40.0, 1.5]])
STEP = 10_000  # us


class Autopilot:
    """A vehicle in north, east, down. It follows attitudes with a lag, and ends offboard flight without set-points."""

    def __init__(self, heading=0.0, hover=0.5):
        self.mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
        self.sent, self.arriving, self.hover, self.time = b"", b"", hover, 0
        self.ned, self.velocity = np.array([0.0, 0.0, -1.5]), np.zeros(3)
        self.attitude = np.array([0.0, 0.0, heading])  # from north, clockwise from above
        self.wanted, self.thrust, self.last = self.attitude.copy(), hover, -(10**9)
        self.armed = self.offboard = False

    # The port, as the vehicle's process sees it
    def send(self, data):
        self.arriving += data

    def receive(self):
        data, self.sent = self.sent, b""
        return data

    def step(self):
        """10 ms."""
        for message in self.mav.parse_buffer(self.arriving) or ():
            self.take(message)
        self.arriving = b""
        self.time += STEP
        if self.time - self.last > 500_000:
            self.offboard = False
        wanted, thrust = (
            (self.wanted, self.thrust) if self.offboard else (np.array([0, 0, self.attitude[2]]), self.hover)
        )
        error = wanted - self.attitude
        error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
        self.attitude += STEP * 1e-6 / 0.1 * error
        (sr, sp, sy), (cr, cp, cy) = np.sin(self.attitude), np.cos(self.attitude)
        down = np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])  # the body's z axis
        force = np.array([0, 0, GRAVITY]) - thrust / self.hover * GRAVITY * down - 0.3 * self.velocity * [1, 1, 0]
        self.velocity += STEP * 1e-6 * force
        self.ned += STEP * 1e-6 * self.velocity
        milliseconds = self.time // 1000
        flags = common.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        mode = 6 << 16 if self.offboard else 4 << 16
        for message in (
            self.mav.local_position_ned_encode(milliseconds, *self.ned, *self.velocity),
            self.mav.attitude_encode(milliseconds, *self.attitude, 0, 0, 0),
            self.mav.heartbeat_encode(common.MAV_TYPE_QUADROTOR, common.MAV_AUTOPILOT_PX4, flags, mode, 4),
        ):
            self.sent += message.pack(self.mav)

    def take(self, message):
        assert (message.target_system, message.target_component) == (1, 1)
        if message.get_type() == "SET_ATTITUDE_TARGET":
            assert message.type_mask == 0b111
            w, x, y, z = message.q
            roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
            pitch = np.arcsin(2 * (w * y - z * x))
            yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            self.wanted, self.thrust, self.last = np.array([roll, pitch, yaw]), message.thrust, self.time
        elif message.command == common.MAV_CMD_COMPONENT_ARM_DISARM:
            self.armed = message.param1 == 1
        elif message.command == common.MAV_CMD_DO_SET_MODE and message.param2 == 6:
            self.offboard = self.armed and self.time - self.last < 500_000


class Clock:
    """A link without other robots, whose time is the autopilot's."""

    def __init__(self, autopilot):
        self.autopilot = autopilot

    def now(self):
        return self.autopilot.time

    def request(self, other):
        raise AssertionError("nobody is near")

    send = request

    def wait(self, until, handler, done=lambda: False):
        while self.autopilot.time < until:
            self.autopilot.step()


def flying(heading=0.0, hover=0.5, known=0.5):
    """An autopilot with a heading (from east, counter-clockwise), and the loop that flies it."""
    autopilot = Autopilot(np.pi / 2 - heading, hover)
    clock = Clock(autopilot)
    controller = AttitudeController(AttitudeGains(hover_thrust=known), yaw=heading)
    vehicle = MavlinkVehicle(autopilot, lambda: (autopilot.time, FAR, np.zeros((1, 3))), controller, clock.now)
    loop = Loop(Robot(CONFIG, 0, RulePolicy("none")), clock, vehicle, SafetyLimits(fence=5.0), late=0.0)
    start = np.array([0.0, 0.0, 1.5])
    loop.start(start, start, 0)
    return autopilot, vehicle, loop


def fly(loop, until):
    loop.run(lambda: loop.link.now() >= until)
    loop._flying = True


@pytest.mark.parametrize(("heading", "wrong"), [(0.0, 0.8), (np.pi / 2, 1.2), (-2.0, 1.0)])
def test_a_rectangle(heading, wrong):
    """Frames, the integral of the climb rate, and the heading."""
    autopilot, vehicle, loop = flying(heading, hover=0.5 * wrong)
    fly(loop, 1_500_000)
    assert not autopilot.offboard
    vehicle.arm()
    fly(loop, 2_000_000)
    vehicle.begin_offboard()
    fly(loop, 8_000_000)
    assert vehicle.armed
    assert vehicle.offboard
    east, north = 1.5, 2.0
    for k, corner in enumerate([(east, 0), (east, north), (0, north), (0, 0)], start=1):
        loop.fly_to(np.array([*corner, 1.5]))
        fly(loop, 8_000_000 + k * 6_000_000)
        assert to_ned(autopilot.ned)[:2] == pytest.approx(corner, abs=0.1)
        assert -autopilot.ned[2] == pytest.approx(1.5, abs=0.05)
        assert to_frd(autopilot.attitude)[2] == pytest.approx(heading, abs=0.05)
    assert not [name for name in loop.stop().counts if name.startswith("errors")]


def test_frames():
    np.testing.assert_array_equal(to_ned(np.array([1.0, 2.0, 3.0])), [2, 1, -3])
    np.testing.assert_allclose(to_frd(np.array([0.1, 0.2, 0.0])), [0.1, -0.2, np.pi / 2])
    np.testing.assert_allclose(to_frd(to_frd(np.array([0.1, 0.2, 3.0]))), [0.1, 0.2, 3.0])


def test_what_is_no_message_or_not_finite_is_nothing():
    autopilot, vehicle, _ = flying()
    assert vehicle.sense() is None
    autopilot.step()
    before = vehicle.sense()
    bad = autopilot.mav.local_position_ned_encode(0, np.nan, 0, 0, 0, 0, 0).pack(autopilot.mav)
    stranger = common.MAVLink(None, srcSystem=9, srcComponent=1)
    other = stranger.local_position_ned_encode(0, 9, 9, 9, 0, 0, 0).pack(stranger)
    autopilot.sent = bytes(range(256)) + bad + other
    np.testing.assert_array_equal(vehicle.sense().state, before.state)


def test_the_older_of_position_and_attitude_counts():
    autopilot, vehicle, _ = flying()
    autopilot.step()
    assert vehicle.sense().stamp == STEP
    autopilot.time += 300_000
    autopilot.sent = autopilot.mav.attitude_encode(310, 0, 0, 0, 0, 0, 0).pack(autopilot.mav)
    assert vehicle.sense().stamp == STEP, "no position came"


def test_a_state_is_as_old_as_its_measurement():
    """By the autopilot's clock, whose offset is that of the messages that took the shortest time."""
    autopilot, vehicle, _ = flying()
    booted = 7_000  # ms later than the robot's clock

    def arrive(measured, arrived):
        autopilot.time = arrived
        for message in (
            autopilot.mav.local_position_ned_encode(measured // 1000 + booted, 0, 0, -1.5, 0, 0, 0),
            autopilot.mav.attitude_encode(measured // 1000 + booted, 0, 0, 0, 0, 0, 0),
        ):
            autopilot.sent += message.pack(autopilot.mav)
        return vehicle.sense().stamp

    assert arrive(10_000, 15_000) == 15_000
    assert arrive(20_000, 40_000) == pytest.approx(25_000, abs=10)
    assert arrive(30_000, 30_000) == 30_000
    assert arrive(400_000, 600_000) == pytest.approx(400_000, abs=200), "as after a link that was stuck"
    booted = 0  # it was switched on again
    assert arrive(700_000, 702_000) == 702_000
    later = MavlinkVehicle(autopilot, lambda: (0, FAR, np.zeros((1, 3))), now=lambda: autopilot.time, latency=0.02)
    vehicle = later
    assert arrive(800_000, 800_000) == 0, "nobody has seen the others since"
    later._others = lambda: (800_000, FAR, np.zeros((1, 3)))
    assert arrive(810_000, 810_000) == 790_000


def test_it_goes_offboard_after_some_set_points_with_the_heading_it_has():
    autopilot, vehicle, loop = flying(1.0)
    vehicle.controller.yaw = 0.0
    vehicle.arm()
    vehicle.engage()
    fly(loop, 1_400_000)
    assert not autopilot.offboard
    fly(loop, 6_000_000)
    assert autopilot.offboard
    assert to_frd(autopilot.attitude)[2] == pytest.approx(1.0, abs=0.02)


def test_neighbours_that_nobody_sees_any_more_make_it_land():
    autopilot, vehicle, loop = flying()
    seen = FAR.copy()
    vehicle._others = lambda: (min(autopilot.time, 1_000_000), seen, np.ones((1, 3)))
    fly(loop, 1_000_000)
    assert loop.supervisor.mode is Mode.FLY
    fly(loop, 1_400_000)
    assert loop.supervisor.mode is Mode.HOVER
    sensed = vehicle.sense()
    assert sensed.stamp == 1_000_000
    np.testing.assert_allclose(sensed.pos, seen, err_msg="where they were then")
    fly(loop, 2_500_000)
    assert loop.supervisor.mode is Mode.LAND


def test_where_nobody_sees_the_others_nothing_is_perceived():
    autopilot, vehicle, _ = flying()
    autopilot.step()
    vehicle._others = lambda: None
    assert vehicle.sense() is None


def test_an_autopilot_over_udp():
    port = UdpPort(("127.0.0.1", 0))
    try:
        port.send(b"nobody is there yet")
        assert port.receive() == b""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
            autopilot.settimeout(500)
            autopilot.bind(("127.0.0.1", 0))
            autopilot.sendto(b"one", port._socket.getsockname())
            received = b""
            while not received:
                received = port.receive()
            assert received == b"one"
            port.send(b"two")
            assert autopilot.recv(100) == b"two"
    finally:
        port.close()
