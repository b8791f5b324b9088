"""Frames and messages of ROS 2."""

import numpy as np
import pytest

from quad_swarm.geometry import from_quaternion, to_quaternion
from quad_swarm.robot import Plan
from quad_swarm.ros import messages


def test_quaternions_are_rotations():
    rng = np.random.default_rng(0)
    for attitude in rng.uniform(-1.4, 1.4, (100, 3)):
        q = to_quaternion(attitude)
        np.testing.assert_allclose(from_quaternion(q), attitude, atol=1e-12)
        np.testing.assert_allclose(from_quaternion(-q), attitude, atol=1e-12)
        x, y, z, w = q
        vector = rng.normal(size=3)
        turned = vector + 2 * np.cross((x, y, z), np.cross((x, y, z), vector) + w * vector)
        np.testing.assert_allclose(messages.rotation(attitude) @ vector, turned, atol=1e-12)


def test_a_robot_that_pitches_down_accelerates_forwards():
    """The axes of REP 103: x forward, y left, z up."""
    np.testing.assert_allclose(messages.rotation(np.array([0, 0.1, 0])) @ [0, 0, 1], [np.sin(0.1), 0, np.cos(0.1)])
    np.testing.assert_allclose(messages.rotation(np.array([0.1, 0, 0])) @ [0, 0, 1], [0, -np.sin(0.1), np.cos(0.1)])
    np.testing.assert_allclose(messages.rotation(np.array([0, 0, np.pi / 2])) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_what_is_no_rotation_is_refused():
    for q in (np.zeros(4), np.full(4, np.nan), np.ones(4)):
        with pytest.raises(ValueError, match="no rotation"):
            from_quaternion(q)


def test_odometry_and_back():
    pytest.importorskip("rclpy")
    state = np.array([1.0, -2.0, 1.5, 2.0, 0.5, -0.3, 0.2, -0.1, 1.2])
    message = messages.to_odometry(state, 1_790_000_000_123_456, "robot_1/base_link")
    assert (message.header.frame_id, message.child_frame_id) == ("map", "robot_1/base_link")
    stamp, again = messages.from_odometry(message)
    assert stamp == 1_790_000_000_123_456
    np.testing.assert_allclose(again, state, atol=1e-12)
    linear = message.twist.twist.linear
    assert np.hypot(linear.x, linear.y) != pytest.approx(np.hypot(2.0, 0.5), abs=1e-3), "the twist is the body's"


@pytest.mark.parametrize("frames", [("map", "robot_1/base_link"), ("", ""), ("world", "b"), ("a frame", "odd")])
def test_serialised_odometry_is_that_of_the_middleware(frames):
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message, serialize_message

    rng, kind = np.random.default_rng(0), messages.msgs().Odometry
    serialised = messages.SerialisedOdometry(frames[1])
    for stamp in (0, 1_790_000_000_123_456):
        state = rng.uniform(-1, 1, 9)
        message = messages.to_odometry(state, stamp, frames[1])
        assert deserialize_message(serialised.write(state, stamp), kind) == message
        message.header.frame_id = frames[0]
        message.pose.covariance[:] = message.twist.covariance[:] = rng.normal(size=36)
        message.twist.twist.angular.x = 7.0
        for world in (False, True):
            found, expected = (messages.from_odometry(one, world) for one in (serialize_message(message), message))
            assert found[0] == expected[0] == stamp
            np.testing.assert_array_equal(found[1], expected[1])
    message.pose.pose.orientation.w = np.nan
    with pytest.raises(ValueError, match="no rotation"):
        messages.from_odometry(serialize_message(message))
    with pytest.raises(Exception, match=r"(?i)deserialize"):
        messages.from_odometry(b"\0\1" + bytes(20))


def test_trajectories_and_back():
    pytest.importorskip("rclpy")
    positions = np.arange(21)[:, None] ** 2 * np.array([0.01, 0.0, -0.002])
    plan = Plan(1_790_000_000_000_001, positions)
    message = messages.to_trajectory(plan, 50_000, "robot_3")
    name, again, period = messages.from_trajectory(message)
    assert (name, again.stamp, period) == ("robot_3", plan.stamp, 50_000)
    np.testing.assert_array_equal(again.positions, positions)
    assert message.points[10].velocities[0].linear.x == pytest.approx(0.01 * 20 / 0.05)


@pytest.mark.parametrize(
    "damage",
    [
        lambda message: message.joint_names.append("b"),
        lambda message: message.points.pop(),
        lambda message: setattr(message.points[1].time_from_start, "sec", 3),
        lambda message: message.points[0].transforms.pop(),
        lambda message: setattr(message.points[0].time_from_start, "nanosec", 1000),
    ],
)
def test_what_is_no_plan_is_refused(damage):
    pytest.importorskip("rclpy")
    message = messages.to_trajectory(Plan(0, np.zeros((3, 3))), 50_000, "a")
    damage(message)
    if len(message.points) == 2:
        message.points.pop()
    with pytest.raises(ValueError, match="plan"):
        messages.from_trajectory(message)


@pytest.mark.parametrize(("sender", "count"), [("robot_3", 21), ("a", 2), ("cf231", 11)])
def test_serialised_plans_are_those_of_messages(sender, count):
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message, serialize_message

    serialised, rng = messages.SerialisedPlans(sender, count, 50_000), np.random.default_rng(0)
    for stamp in (0, 1_790_000_000_123_456):
        plan = Plan(stamp, rng.normal(size=(count, 3)))
        data = serialised.write(plan)
        message = messages.to_trajectory(plan, 50_000, sender)
        theirs, kind = serialize_message(message), messages.msgs().MultiDOFJointTrajectory
        assert len(data) == len(theirs)
        assert deserialize_message(data, kind) == message
        name, again, period = messages.from_trajectory(message)
        for found in (again, serialised.read(data), serialised.read(theirs)):
            assert found.stamp == stamp
            np.testing.assert_array_equal(found.positions, plan.positions)
        assert (name, period) == (sender, 50_000)
    # Whatever else differs is left to the message
    others = [messages.to_trajectory(plan, *about) for about in ((50_000, sender[:-1] + "x"), (40_000, sender))]
    others.append(messages.to_trajectory(plan._replace(positions=np.zeros((count + 1, 3))), 50_000, sender))
    turned = messages.to_trajectory(plan, 50_000, sender)
    turned.points[1].transforms[0].rotation.z = 1.0
    for other in (*others, turned):
        assert serialised.read(serialize_message(other)) is None
    assert serialised.read(b"") is None


def test_commands_and_back():
    pytest.importorskip("rclpy")
    setpoint = np.array([0.1, -0.2, 0.3, 0.4])
    np.testing.assert_array_equal(messages.from_command(messages.to_command(setpoint, 5)), setpoint)
