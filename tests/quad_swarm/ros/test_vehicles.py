"""Vehicles that are commanded over ROS 2.

The message packages of Crazyswarm2, PX4 and Aerostack2 are not to be had as wheels: their messages stand in here, with
the fields of their definitions and the checks of types that rclpy makes. A rigid body with PX4's frames flies what PX4
is told.
"""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from quad_swarm.geometry import from_quaternion, to_frd, to_ned, to_quaternion
from quad_swarm.realtime.attitude import GRAVITY, AttitudeController, AttitudeGains
from quad_swarm.realtime.link import Traffic, monotonic
from quad_swarm.robot import Plan

pytest.importorskip("rclpy")

from geometry_msgs.msg import Pose, Twist, Vector3
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from quad_swarm.ros import node as nodes
from quad_swarm.ros import vehicles
from quad_swarm.ros.messages import msgs, rotation, to_odometry
from quad_swarm.ros.world import names_of

NAMES = names_of(2)
PERIOD = 50_000


def kind(name, version=0, /, **fields):
    """A class of messages: fields by name, with the value that they have at first."""

    def __init__(self, **values):
        for field, value in fields.items():
            object.__setattr__(self, field, value() if isinstance(value, type) else value)
        for field, value in values.items():
            setattr(self, field, value)

    def __setattr__(self, field, value):
        assert field in fields, f"{name} has no field {field}"
        now = getattr(self, field)
        if isinstance(now, np.ndarray):
            assert np.shape(value) == now.shape
        else:
            assert isinstance(value, type(now)), f"{name}.{field} is {type(now)}, not {type(value)}"
        object.__setattr__(self, field, value)

    return type(name, (), {"__init__": __init__, "__setattr__": __setattr__, "MESSAGE_VERSION": version})


def floats(n):
    return np.zeros(n, np.float32)


PACKAGES = {
    "crazyflie_interfaces": [kind("FullState", header=Header, pose=Pose, twist=Twist, acc=Vector3)],
    "motion_capture_tracking_interfaces": [
        kind("NamedPose", name="", pose=Pose),
        kind("NamedPoseArray", header=Header, poses=list),
    ],
    "as2_msgs": [kind("Thrust", header=Header, thrust=0.0, thrust_normalized=0.0)],
    "px4_msgs": [
        kind(
            "VehicleOdometry",
            timestamp=0,
            timestamp_sample=0,
            pose_frame=0,
            position=floats(3),
            q=floats(4),
            velocity_frame=0,
            velocity=floats(3),
        ),
        kind("OffboardControlMode", timestamp=0, position=False, velocity=False, acceleration=False, attitude=False),
        kind("VehicleAttitudeSetpoint", 1, timestamp=0, yaw_sp_move_rate=0.0, q_d=floats(4), thrust_body=floats(3)),
        kind(
            "VehicleCommand",
            timestamp=0,
            **{f"param{k}": 0.0 for k in range(1, 8)},
            command=0,
            target_system=0,
            target_component=0,
            source_system=0,
            source_component=0,
            confirmation=0,
            from_external=False,
        ),
    ],
}


@pytest.fixture
def packages(monkeypatch):
    for package, kinds in PACKAGES.items():
        module = ModuleType(f"{package}.msg")
        for one in kinds:
            setattr(module, one.__name__, one)
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    return SimpleNamespace(**{one.__name__: one for kinds in PACKAGES.values() for one in kinds})


class Link:
    """A clock that stands still until it is moved."""

    def __init__(self):
        self.index, self.time, self.clock_error, self.traffic = 0, 1_000_000, 0, Traffic()

    def now(self):
        return self.time

    def own(self, at):
        return at - 5_000_000

    def shared(self, at):
        return at + 5_000_000


class Node:
    """Keeps what is published, and receives what is handed to it. It is its own mailbox."""

    def __init__(self):
        self.published, self.newer, self.heard = {}, {}, set()

    def create_publisher(self, kind, topic, profile):
        published = self.published.setdefault(topic, [])

        def publish(message):
            assert type(message) is kind
            published.append(message)

        return SimpleNamespace(publish=publish, get_subscription_count=lambda: int(topic in self.heard))

    def newest(self, kind, topic, raw=False):
        self.newer[topic] = kind, []
        return lambda: self.newer[topic][1].pop() if self.newer[topic][1] else None

    def receive(self, topic, message):
        kind, waiting = self.newer[topic]
        assert type(message) is kind
        waiting[:] = [message]


def make(kind, *args, **options):
    node, link = Node(), Link()
    return kind(node, node, link, NAMES, *args, **options), node, link


def seen(node, link, states, topic="odom", world=False):
    for name, state in zip(NAMES, states, strict=True):
        message = to_odometry(state, link.shared(link.now()), "" if world else "base_link")
        if world:  # as Crazyswarm2 has it
            linear = message.twist.twist.linear
            linear.x, linear.y, linear.z = state[3:6].tolist()
        node.receive(f"/{name}/{topic}", message)


STATES = np.array([[0, 0, 1.5, 1, 0.5, -0.2, 0.1, -0.2, 0.7], [2, 1, 1.5, -1, 0.5, 0, 0.1, 0, 0]])


@pytest.mark.parametrize("twist", ["body", "world"])
def test_a_twist_has_the_axes_that_are_named(twist):
    vehicle, node, link = make(vehicles.OdometryVehicle, twist=twist)
    assert vehicle.sense() is None
    seen(node, link, STATES, world=twist == "world")
    sensed = vehicle.sense()
    assert sensed.stamp == link.now()
    np.testing.assert_allclose(sensed.state, STATES[0], atol=1e-12)
    np.testing.assert_allclose(sensed.vel, STATES[1:, 3:6], atol=1e-12)
    vehicle.command(np.array([0.1, 0.2, 0.3, 0.0]), None)
    assert len(node.published["/robot_0/cmd"]) == 1


def test_states_grow_old_of_robots_that_motion_capture_does_not_see(packages):
    """The estimator on board goes on without its markers: states are new, and drift."""
    vehicle, node, link = make(vehicles.CrazyswarmVehicle, period=PERIOD)
    vehicle.watch_poses("/poses")

    def step(*captured):
        link.time += 50_000
        message = packages.NamedPoseArray()
        for name, place in captured:
            one = packages.NamedPose(name=name)
            one.pose.position.x, one.pose.position.y, one.pose.position.z = map(float, place)
            message.poses.append(one)
        node.receive("/poses", message)
        seen(node, link, STATES, world=True)
        sensed = vehicle.sense()
        return None if sensed is None else link.now() - sensed.stamp

    own, other = zip(NAMES, STATES[:, :3], strict=True)
    assert step(own) is None, "the other one has never been seen"
    assert step(own, other) == 0
    assert [step(other) for _ in range(4)] == [0, 0, 50_000, 100_000], "it counts for a tenth of a second"
    assert step(own, other) == 0
    aside = own[0], own[1] + [0.4, 0, 0]
    assert [step(aside, other) for _ in range(2)] == [50_000, 100_000], "it is seen elsewhere"
    assert step((own[0], own[1] + [0.2, 0, 0]), other) == 0
    assert step((own[0], [np.nan] * 3), other) == 50_000
    assert link.traffic.refused == 6
    assert step(own, other, ("a drone of somebody else", [0, 0, 0])) == 0
    assert vehicle._captured.keys() == set(NAMES)

    def breaks():
        raise RuntimeError("no memory")

    vehicle._captures = breaks
    link.time += 50_000
    seen(node, link, STATES, world=True)
    assert vehicle.sense().stamp == link.now(), "seen in the last tenth of a second"
    assert link.traffic.refused == 7


@pytest.mark.parametrize(("heading", "held"), [(None, 0.7), (-0.4, -0.4)])
def test_a_flight_holds_the_heading_that_it_began_with_unless_one_is_given(packages, heading, held):
    vehicle, node, link = make(vehicles.CrazyswarmVehicle, period=PERIOD)
    vehicle.heading = heading
    for yaw in (0.7, 0.2):  # it is turned by hand while nobody flies it
        seen(node, link, STATES - [0, 0, 0, 0, 0, 0, 0, 0, 0.7 - yaw], world=True)
        vehicle.engage()
        vehicle.command(np.zeros(4), None)
        q = node.published["/robot_0/cmd_full_state"][-1].pose.orientation
        expected = yaw if heading is None else held
        assert from_quaternion(np.array([q.x, q.y, q.z, q.w]))[2] == pytest.approx(expected)
        link.time += 50_000


def test_commands_that_nobody_receives_are_named():
    vehicle, node, _ = make(vehicles.OdometryVehicle)
    assert vehicle.unheard() == ["/robot_0/cmd"]
    node.heard.add("/robot_0/cmd")
    assert vehicle.unheard() == []


def test_other_axes_are_refused():
    with pytest.raises(ValueError, match="'map': choose 'body' or 'world'"):
        make(vehicles.OdometryVehicle, twist="map")


def test_what_is_no_state_is_counted():
    vehicle, node, link = make(vehicles.OdometryVehicle)
    node.receive("/robot_0/odom", Odometry(pose=msgs().Odometry().pose))
    message = to_odometry(STATES[0], 5, "base_link")
    message.pose.pose.orientation.w = 9.0
    node.receive("/robot_0/odom", message)
    assert vehicle.sense() is None
    assert link.traffic.refused == 1


def test_a_plan_is_followed_by_its_positions_velocities_and_accelerations():
    times = np.arange(21) * 0.05
    plan = Plan(1_000_000, np.stack([0.5 * 2 * times**2, 3 * times, np.full(21, 1.5)], axis=1))
    position, velocity, acceleration = vehicles.followed(plan, 1_225_000, PERIOD)
    np.testing.assert_allclose(position, [0.225**2, 0.675, 1.5], atol=1e-3)
    np.testing.assert_allclose(velocity, [0.45, 3, 0], atol=1e-6)
    np.testing.assert_allclose(acceleration, [2, 0, 0], atol=1e-6)
    position, *still = vehicles.followed(plan, 2_000_001, PERIOD)
    np.testing.assert_array_equal(position, plan.positions[-1])
    np.testing.assert_array_equal(still, np.zeros((2, 3)))


def test_crazyswarm_follows_the_plan(packages):
    vehicle, node, link = make(vehicles.CrazyswarmVehicle, period=PERIOD)
    commands = node.published["/robot_0/cmd_full_state"]
    vehicle.command(np.zeros(4), None)
    assert not commands, "nothing is known that could be held"
    seen(node, link, STATES, world=True)
    times = np.arange(21) * 0.05
    plan = Plan(link.now(), np.stack([times, np.zeros(21), np.full(21, 1.5)], axis=1))
    vehicle.command(np.array([0.1, -0.2, 0.0, 0.0]), plan)
    message = commands[-1]
    assert message.header.frame_id == "map"
    assert message.pose.position.x == pytest.approx(0.025), "the middle of the period"
    assert message.twist.linear.x == pytest.approx(1.0)
    q = message.pose.orientation
    np.testing.assert_allclose(from_quaternion(np.array([q.x, q.y, q.z, q.w])), [0.1, -0.2, 0.0], atol=1e-9)
    link.time += 100_000
    vehicle.command(np.array([0, 0, -0.5, 0]), None)  # a landing
    assert commands[-1].pose.position.z == pytest.approx(1.5 - 0.05)
    assert commands[-1].twist.linear.z == -0.5


def test_crazyswarm_by_attitude():
    vehicle, node, link = make(
        vehicles.LegacyCrazyswarmVehicle, controller=AttitudeController(AttitudeGains(hover_thrust=0.6, integral=0.0))
    )
    unlocks, *commands = node.published["/robot_0/cmd_vel_legacy"]
    assert unlocks == msgs().Twist()
    assert not commands
    level = np.zeros((2, 9))
    level[0, 8] = 0.1  # turned to the left, so it has to turn to the right: clockwise, which is positive there
    seen(node, link, level, world=True)
    vehicle.command(np.array([0.1, -0.2, 0.0, 0.0]), None)
    twist = node.published["/robot_0/cmd_vel_legacy"][-1]
    assert (twist.linear.x, twist.linear.y) == pytest.approx(np.degrees([-0.2, 0.1]))
    assert twist.linear.z == pytest.approx(0.6 * 65535)
    assert twist.angular.z == pytest.approx(np.degrees(0.2))
    vehicle.command(np.array([0, 0, 9.0, 0.0]), None)
    assert node.published["/robot_0/cmd_vel_legacy"][-1].linear.z == 60000


def test_aerostack(packages):
    controller = AttitudeController(AttitudeGains(hover_thrust=0.5), yaw=0.3)
    vehicle, node, link = make(vehicles.AerostackVehicle, controller=controller, most_thrust=20.0)
    seen(node, link, np.zeros((2, 9)), "self_localization/odom")
    assert vehicle.sense() is not None
    vehicle.command(np.array([0.1, -0.2, 0.0, 0.0]), None)
    (pose,), (thrust,) = (node.published[f"/robot_0/actuator_command/{one}"] for one in ("pose", "thrust"))
    q = pose.pose.orientation
    np.testing.assert_allclose(from_quaternion(np.array([q.x, q.y, q.z, q.w])), [0.1, -0.2, 0.3], atol=1e-9)
    assert (thrust.thrust_normalized, thrust.thrust) == pytest.approx((0.5, 10.0))


def px4_odometry(packages, state, stamp, body=False):
    attitude = to_frd(state[6:9])
    velocity = to_ned(state[3:6])
    return packages.VehicleOdometry(
        timestamp=stamp + 9,
        timestamp_sample=stamp,
        pose_frame=1,
        position=to_ned(state[:3]),
        q=np.roll(to_quaternion(attitude), 1),
        velocity_frame=3 if body else 1,
        velocity=rotation(attitude).T @ velocity if body else velocity,
    )


@pytest.mark.parametrize("body", [False, True])
def test_px4_perceives(packages, body):
    origins = np.array([[0, 0, 0], [5.0, -1, 0.5]])
    vehicle, node, link = make(vehicles.Px4Vehicle, origins=origins)
    for name, state, origin in zip(NAMES, STATES, origins, strict=True):
        state = np.concatenate([state[:3] - origin, state[3:]])
        message = px4_odometry(packages, state, link.shared(link.now()), body)
        node.receive(f"/{name}/fmu/out/vehicle_odometry", message)
    sensed = vehicle.sense()
    assert sensed.stamp == link.now()
    np.testing.assert_allclose(sensed.state, STATES[0], atol=1e-9)
    np.testing.assert_allclose(sensed.pos, STATES[1:, :3], atol=1e-9)
    for wrong in ({"pose_frame": 2}, {"velocity_frame": 0}, {"position": np.full(3, np.nan)}, {"q": np.zeros(4)}):
        message = px4_odometry(packages, STATES[0] + 1, link.shared(link.now()) + 10_000)
        for field, value in wrong.items():
            setattr(message, field, value)
        before = link.traffic.refused
        node.receive("/robot_0/fmu/out/vehicle_odometry", message)
        np.testing.assert_allclose(vehicle.sense().state, STATES[0], atol=1e-9)
        assert link.traffic.refused == before + 1


def test_px4_arms_and_goes_offboard(packages):
    vehicle, node, _ = make(vehicles.Px4Vehicle, np.zeros((2, 3)))
    vehicle.arm()
    vehicle.begin_offboard()
    vehicle.disarm()
    commands = node.published["/robot_0/fmu/in/vehicle_command"]
    assert [(one.command, one.param1, one.param2) for one in commands] == [(400, 1, 0), (176, 1, 6), (400, 0, 0)]
    assert all(one.target_system == 1 and one.from_external for one in commands)


def test_px4_goes_offboard_when_it_has_had_set_points(packages):
    vehicle, node, link = make(vehicles.Px4Vehicle, np.zeros((2, 3)))
    commands = node.published["/robot_0/fmu/in/vehicle_command"]
    vehicle.command(np.zeros(4), None)
    vehicle.engage()
    for _ in range(40):
        link.time += PERIOD
        vehicle.command(np.zeros(4), None)
        assert len(commands) == (link.time >= 1_000_000 + 1_500_000)
    assert commands[0].command == 176
    odometry, _, _ = make(vehicles.OdometryVehicle)
    odometry.engage()  # which nobody else needs


@pytest.mark.parametrize("heading", [0.0, np.pi / 2])
def test_px4_holds_height_and_heading_and_flies_where_it_leans(packages, heading):
    """A body with PX4's frames, whose hover thrust is 20 % less than was thought."""
    controller = AttitudeController(AttitudeGains(hover_thrust=0.5), yaw=heading)
    vehicle, node, link = make(vehicles.Px4Vehicle, np.zeros((2, 3)), controller)
    ned, velocity, attitude = np.array([0, 0, -1.5]), np.zeros(3), np.array([0, 0, np.pi / 2 - heading])
    for k in range(800):
        state = np.concatenate([to_ned(ned), to_ned(velocity), to_frd(attitude)])
        for name in NAMES:
            message = px4_odometry(packages, state, link.shared(link.now()))
            node.receive(f"/{name}/fmu/out/vehicle_odometry", message)
        if k % 5 == 0:
            height = vehicle.sense().state[2]
            pitch = 0.1 if 400 <= k < 450 else 0.0
            vehicle.command(np.array([0, pitch, 1.5 - height, 0]), None)
        wanted = node.published["/robot_0/fmu/in/vehicle_attitude_setpoint_v1"][-1]
        attitude += 0.1 * (from_quaternion(np.roll(np.asarray(wanted.q_d, float), -1)) - attitude)
        push = rotation(attitude) @ np.asarray(wanted.thrust_body, float) / 0.4 * GRAVITY
        velocity = velocity + 0.01 * (push + np.array([0, 0, GRAVITY]) - 0.3 * velocity * [1, 1, 0])
        ned, link.time = ned + 0.01 * velocity, link.time + 10_000
    assert node.published["/robot_0/fmu/in/offboard_control_mode"][-1].attitude
    assert -ned[2] == pytest.approx(1.5, abs=0.05)
    assert to_frd(attitude)[2] == pytest.approx(heading, abs=0.03)
    forward, left = rotation(np.array([0, 0, heading])).T[:2] @ to_ned(ned)
    assert forward > 0.5, "with the nose down it flies forwards"
    assert abs(left) < 0.02


def test_what_a_vehicle_cannot_know_is_asked_for(packages):
    with pytest.raises(ValueError, match="three numbers for each of 2 robots"):
        make(vehicles.Px4Vehicle, origins=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="period=0: give the length"):
        make(vehicles.CrazyswarmVehicle, period=0)
    with pytest.raises(ValueError, match="most_thrust=nan: give the largest thrust in newtons"):
        make(vehicles.AerostackVehicle, most_thrust=np.nan)


@pytest.mark.parametrize(
    ("kind", "package", "options"),
    [
        (vehicles.CrazyswarmVehicle, "crazyflie_interfaces", {"period": PERIOD}),
        (vehicles.Px4Vehicle, "px4_msgs", {"origins": np.zeros((2, 3))}),
        (vehicles.AerostackVehicle, "as2_msgs", {"most_thrust": 20.0}),
    ],
)
def test_missing_messages_are_named(kind, package, options, monkeypatch):
    monkeypatch.setitem(sys.modules, f"{package}.msg", None)
    with pytest.raises(ImportError, match=rf"{package} is not there: build it"):
        make(kind, **options)


@pytest.mark.parametrize(
    ("vehicle", "topic", "message"),
    [(vehicles.OdometryVehicle, "cmd", "TwistStamped"), (vehicles.LegacyCrazyswarmVehicle, "cmd_vel_legacy", "Twist")],
)
def test_commands_reach_subscribers_that_require_reliability(monkeypatch, vehicle, topic, message):
    """As Crazyswarm2's server does under Cyclone DDS, where the system's default is reliable."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")  # a node finds itself
    node = nodes.make_node("alone")
    mailbox, got = nodes.Mailbox(node), []
    try:
        link = Link()
        robot = vehicle(node, mailbox, link, NAMES)
        reliable_by_default = 10
        mailbox.subscribe(
            getattr(msgs(), message), f"/{NAMES[0]}/{topic}", reliable_by_default, lambda m, handler: got.append(m)
        )
        ends = monotonic() + 20_000_000
        while not got and monotonic() < ends:
            robot.command(np.array([0.1, 0.0, 0.2, 0.0]), None)
            mailbox.wait(monotonic() + 50_000, None, lambda: bool(got))
        assert got
    finally:
        mailbox.close()
