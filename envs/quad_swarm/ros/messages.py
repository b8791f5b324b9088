"""Conversion between a robot's arrays and standard messages of ROS 2 (REP 103 and 147: x forward, y left, z up; frame
"map").

Only `msgs()` imports ROS, so that the conversions are the same with wheels and with a distribution.
"""

from __future__ import annotations

import functools
import importlib
import struct
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from quad_swarm.geometry import from_quaternion, to_quaternion
from quad_swarm.quadrotor import N_STATES, POSITION, VELOCITY
from quad_swarm.robot import Plan

FRAME = "map"
_S = 1_000_000  # us
# Where the numbers of serialised odometry are: its frames alone, which come before, have lengths of their own
_STAMP = struct.Struct("<iI")  # after the four bytes that tell the encoding
_POSE = struct.Struct(f"<7d{36 * 8}x3d{(3 + 36) * 8}x")  # pose, its covariance, twist and its covariance, at the end
_LITTLE_ENDIAN = (b"\x00\x01", b"\x00\x07")  # XCDR versions 1 and 2


@functools.cache
def msgs() -> SimpleNamespace:
    """Return the classes of the messages.

    :raises ImportError: if ROS 2 is not there
    """
    names = {
        "builtin_interfaces": "Duration Time",
        "diagnostic_msgs": "DiagnosticArray DiagnosticStatus KeyValue",
        "geometry_msgs": "PoseStamped Quaternion Transform Twist TwistStamped Vector3",
        "nav_msgs": "Odometry",
        "std_msgs": "Header String",
        "trajectory_msgs": "MultiDOFJointTrajectory MultiDOFJointTrajectoryPoint",
    }
    modules = {package: importlib.import_module(f"{package}.msg") for package in names}
    return SimpleNamespace(**{name: getattr(modules[one], name) for one in names for name in names[one].split()})


def to_time(us: int) -> Any:
    """Return a time (us) as a message."""
    return msgs().Time(sec=us // _S, nanosec=us % _S * 1000)


def from_time(time: Any) -> int:
    """Return a message's time (us)."""
    return int(time.sec) * _S + int(time.nanosec) // 1000


def to_diagnostics(name: str, level: int, message: str, values: Mapping[str, object], stamp: int) -> Any:
    """Return a status as ``diagnostic_msgs/DiagnosticArray``.

    :param name: whose status it is
    :param level: 0 (well), 1 (warning) or 2 (error)
    :param message: the status in words
    :param values: further values by name
    :param stamp: the time (us)
    """
    names = msgs()
    status = names.DiagnosticStatus(level=bytes([level]), name=name, message=message)
    status.values = [names.KeyValue(key=key, value=str(value)) for key, value in values.items()]
    array = names.DiagnosticArray(status=[status])
    array.header.stamp = to_time(stamp)
    return array


def rotation(attitude: np.ndarray) -> np.ndarray:
    """Return the matrix that turns vectors of the body into those of the world, (3, 3).

    :param attitude: roll, pitch and yaw (rad), (3,)
    """
    (sr, sp, sy), (cr, cp, cy) = np.sin(attitude), np.cos(attitude)
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def to_odometry(state: np.ndarray, stamp: int, child: str) -> Any:
    """Return a state, (9,), as ``nav_msgs/Odometry``, whose twist is in the frame of the body.

    :param state: position (m), velocity (m/s), roll, pitch and yaw (rad), (9,)
    :param stamp: when it was so (us)
    :param child: name of the body's frame
    """
    message = msgs().Odometry()
    message.header.frame_id, message.child_frame_id = FRAME, child
    message.header.stamp = to_time(stamp)
    pose, linear = message.pose.pose, message.twist.twist.linear
    x, y, z, *q, vx, vy, vz = _seen_from_body(state)
    pose.position.x, pose.position.y, pose.position.z = x, y, z
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = q
    linear.x, linear.y, linear.z = vx, vy, vz
    return message


def from_odometry(message: Any, world_twist: bool = False) -> tuple[int, np.ndarray]:
    """Return stamp (us) and state, (9,), of ``nav_msgs/Odometry``.

    :param message: the message, or its bytes
    :param world_twist: whether its twist is in the frame of the world instead of that of the body
    :raises ValueError: if the orientation is no rotation
    """
    if isinstance(message, bytes):
        if len(message) > _POSE.size + 20 and message[:2] in _LITTLE_ENDIAN:
            sec, nanosec = _STAMP.unpack_from(message, 4)
            numbers = _POSE.unpack_from(message, len(message) - _POSE.size)
            return sec * _S + nanosec // 1000, _state_of(numbers[:7], numbers[7:], world_twist)
        from rclpy.serialization import deserialize_message

        message = deserialize_message(message, msgs().Odometry)
    place, q, linear = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    numbers = (place.x, place.y, place.z, q.x, q.y, q.z, q.w)
    return from_time(message.header.stamp), _state_of(numbers, (linear.x, linear.y, linear.z), world_twist)


def _seen_from_body(state: np.ndarray) -> list[float]:
    """Return position (m), quaternion x, y, z, w, and velocity along the axes of the body (m/s) of a state, (9,)."""
    velocity = rotation(state[6:9]).T @ state[VELOCITY]
    return [*state[POSITION].tolist(), *to_quaternion(state[6:9]).tolist(), *velocity.tolist()]


def _state_of(pose: Sequence[float], velocity: Sequence[float], world_twist: bool) -> np.ndarray:
    """Return the state, (9,), of position (m) and quaternion x, y, z, w, and of a velocity (m/s)."""
    state = np.empty(N_STATES)
    state[POSITION], state[6:9] = pose[:3], from_quaternion(np.array(pose[3:]))
    state[VELOCITY] = velocity if world_twist else rotation(state[6:9]) @ np.array(velocity)
    return state


class SerialisedOdometry:
    """States of one robot as the bytes of `to_odometry`, without the message's objects.

    :param child: name of the body's frame
    """

    def __init__(self, child: str):
        from rclpy.serialization import serialize_message

        self._bytes = serialize_message(to_odometry(np.zeros(N_STATES), 0, child))

    def write(self, state: np.ndarray, stamp: int) -> bytes:
        """Return the bytes of a state's message, see `to_odometry`."""
        data = bytearray(self._bytes)
        _STAMP.pack_into(data, 4, stamp // _S, stamp % _S * 1000)
        _POSE.pack_into(data, len(data) - _POSE.size, *_seen_from_body(state))
        return bytes(data)


def to_trajectory(plan: Plan, period: int, sender: str) -> Any:
    """Return a plan as ``trajectory_msgs/MultiDOFJointTrajectory``: positions, and velocities between them.

    :param plan: the plan, stamped with the time of the day
    :param period: length of its stages (us)
    :param sender: name of the robot
    """
    names = msgs()
    message = names.MultiDOFJointTrajectory()
    message.header.frame_id, message.header.stamp, message.joint_names = FRAME, to_time(plan.stamp), [sender]
    velocities = np.gradient(plan.positions, period / _S, axis=0)
    for k, (position, velocity) in enumerate(zip(plan.positions.tolist(), velocities.tolist(), strict=True)):
        at = k * period
        message.points.append(
            names.MultiDOFJointTrajectoryPoint(
                transforms=[names.Transform(translation=names.Vector3(**dict(zip("xyz", position, strict=True))))],
                velocities=[names.Twist(linear=names.Vector3(**dict(zip("xyz", velocity, strict=True))))],
                time_from_start=names.Duration(sec=at // _S, nanosec=at % _S * 1000),
            )
        )
    return message


def from_trajectory(message: Any) -> tuple[str, Plan, int]:
    """Return sender, plan and length of its stages (us) of ``trajectory_msgs/MultiDOFJointTrajectory``.

    :raises ValueError: if it is no plan of one robot at equal intervals
    """
    points = message.points
    if len(message.joint_names) != 1 or len(points) < 2 or any(len(point.transforms) != 1 for point in points):
        raise ValueError("a plan has the name of one robot, and two or more points with one transform each")
    times = np.array([from_time(point.time_from_start) for point in points])
    period = int(times[1] - times[0])
    if times[0] or period <= 0 or (np.diff(times) != period).any():
        raise ValueError("the points of a plan begin at its stamp and follow each other at equal intervals")
    translations = (point.transforms[0].translation for point in points)
    positions = np.array([(one.x, one.y, one.z) for one in translations])
    return message.joint_names[0], Plan(from_time(message.header.stamp), positions), period


class SerialisedPlans:
    """Plans of one robot as the bytes of `to_trajectory`. Messages of as many points at the same intervals differ in a
    time and in numbers at the same places only, which are written and read without the message's objects.

    :param sender: name of the robot
    :param count: number of points
    :param period: time between them (us)
    """

    def __init__(self, sender: str, count: int, period: int):
        from rclpy.serialization import serialize_message

        message = to_trajectory(Plan(0, np.zeros((count, 3))), period, sender)
        stamp, numbers = np.array([0x1234567, 0x2345678], np.int32), np.arange(6.0 * count).reshape(count, 6) + 0.123
        message.header.stamp = msgs().Time(sec=int(stamp[0]), nanosec=int(stamp[1]))
        for point, (x, y, z, vx, vy, vz) in zip(message.points, numbers.tolist(), strict=True):
            point.transforms[0].translation = msgs().Vector3(x=x, y=y, z=z)
            point.velocities[0].linear = msgs().Vector3(x=vx, y=vy, z=vz)
        data = serialize_message(message)
        self._period = period
        self._stamp = self._places(data, stamp)
        self._numbers = self._places(data, numbers).reshape(count, 6, 8)
        gaps = self._gaps(data, sender, self._numbers[:, 0, 0], self._numbers[:, 3, 0])
        self._bytes = np.frombuffer(data, np.uint8).copy()
        self._bytes[gaps] = 0
        fixed = np.ones(len(data), dtype=bool)
        fixed[self._stamp] = fixed[self._numbers] = fixed[gaps] = False
        self._fixed = np.flatnonzero(fixed)

    @staticmethod
    def _places(data: bytes, values: np.ndarray) -> np.ndarray:
        """Return where the bytes of values are, each of which occurs once."""
        starts = [data.index(value.tobytes()) for value in values.reshape(-1)]
        assert all(data.count(value.tobytes()) == 1 for value in values.reshape(-1))
        return np.array(starts)[:, None] + np.arange(values.itemsize)

    @staticmethod
    def _gaps(data: bytes, sender: str, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Return where bytes only align what follows, which serialisation leaves as the memory was.

        :param positions: where the position of each point begins, after the number of its transforms, (N + 1,)
        :param velocities: where its velocity begins, after seven numbers and the number of its twists, (N + 1,)
        """
        counts = np.frombuffer(data, "<u4", 2, positions[0] - 12)
        first = counts.tolist() == [len(positions), 1]
        later = positions[1:] - velocities[:-1] > 64
        ends = [*positions[: int(first)], *positions[1:][later], *velocities[velocities - positions > 60]]
        name = data.index(sender.encode() + b"\0") + len(sender.encode()) + 1
        return np.array([*range(name, name + -name % 4), *(end - k for end in ends for k in (1, 2, 3, 4))], dtype=int)

    def write(self, plan: Plan) -> bytes:
        """Return the bytes of a plan's message."""
        data = self._bytes.copy()
        data[self._stamp] = np.array([plan.stamp // _S, plan.stamp % _S * 1000], np.int32)[:, None].view(np.uint8)
        velocities = np.gradient(plan.positions, self._period / _S, axis=0)
        data[self._numbers] = np.concatenate([plan.positions, velocities], axis=1)[..., None].view(np.uint8)
        return data.tobytes()

    def read(self, data: bytes) -> Plan | None:
        """Return the plan of a message's bytes, None if it is not one of these."""
        if len(data) != len(self._bytes):
            return None
        found = np.frombuffer(data, np.uint8)
        if not np.array_equal(found[self._fixed], self._bytes[self._fixed]):
            return None
        sec, nanosec = found[self._stamp].view(np.int32)[:, 0].tolist()
        return Plan(sec * _S + nanosec // 1000, found[self._numbers[:, :3]].view(float)[..., 0])


def to_command(setpoint: np.ndarray, stamp: int) -> Any:
    """Return a set-point as ``geometry_msgs/TwistStamped``: angular x and y are roll and pitch (rad), linear z is the
    climb rate (m/s), and angular z the yaw rate (rad/s).

    :param setpoint: roll, pitch, climb rate and yaw rate, (4,)
    :param stamp: the time (us)
    """
    message = msgs().TwistStamped()
    message.header.frame_id, message.header.stamp = FRAME, to_time(stamp)
    message.twist.angular.x, message.twist.angular.y = map(float, setpoint[:2])
    message.twist.linear.z, message.twist.angular.z = map(float, setpoint[2:])
    return message


def from_command(message: Any) -> np.ndarray:
    """Return the set-point of `to_command`, (4,)."""
    twist = message.twist
    return np.array([twist.angular.x, twist.angular.y, twist.linear.z, twist.angular.z])
