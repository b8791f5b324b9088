"""Recordings for Foxglove, Lichtblick and ``ros2 bag``."""

import io

import numpy as np
import pytest

pytest.importorskip("mcap_ros2")
from mcap_ros2.reader import read_ros2_messages
from mcap_ros2.writer import Writer

from quad_swarm.evaluation.mcap_files import _definition
from quad_swarm.evaluation.recordings import Recording, read, write


def straight(n=2, times=5):
    """Robots that fly straight, one of them with a plan."""
    state = np.zeros((times, n, 9))
    time = 1_790_000_000.25 + 0.05 * np.arange(times)
    state[..., 0] = 0.05 * np.arange(times)[:, None] + np.arange(n)
    state[..., 3], state[..., 8] = 1.0, np.pi / 2
    plan = np.full((times, n, 3, 3), np.nan)
    plan[:, 0] = np.arange(9).reshape(3, 3)
    asked = np.zeros((times, n, n), bool)
    asked[2, 1, 0] = True
    return Recording(time, state, np.full((times, n, 4), np.nan), plan, asked, np.zeros_like(asked), state[-1, :, :3])


def test_other_tools_find_standard_messages(tmp_path):
    path = tmp_path / "flight.mcap"
    write(path, straight())
    found = {}
    for one in read_ros2_messages(str(path)):
        found.setdefault(one.channel.topic, []).append((one.schema.name, one.log_time_ns, one.ros_msg))
    assert {topic: kinds[0][0] for topic, kinds in found.items()} == {
        "/swarm/about": "std_msgs/msg/String",
        "/swarm/separation": "std_msgs/msg/Float64",
        "/swarm/talk": "std_msgs/msg/String",
        "/robot_0/odom": "nav_msgs/msg/Odometry",
        "/robot_0/plan": "nav_msgs/msg/Path",
        "/robot_1/odom": "nav_msgs/msg/Odometry",
    }
    _, time, odometry = found["/robot_1/odom"][1]
    assert time == 1_790_000_000_300_000_000
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (1_790_000_000, 300_000_000)
    assert odometry.header.frame_id == "map"
    assert odometry.pose.pose.position.x == pytest.approx(1.05)
    linear = odometry.twist.twist.linear
    np.testing.assert_allclose([linear.x, linear.y], [0.0, -1.0], atol=1e-12)  # it looks along y
    assert len(found["/robot_0/plan"][0][2].poses) == 3


def test_odometry_of_other_times_is_interpolated(tmp_path):
    """As a bag of a laboratory has it: names of their own, and one robot after the other."""
    path, data = tmp_path / "lab.mcap", io.BytesIO()
    writer = Writer(data)
    schema = writer.register_msgdef("nav_msgs/msg/Odometry", _definition("nav_msgs/Odometry"))
    quaternion, zeros = dict(zip("xyzw", (0.0, 0.0, 0.0, 1.0), strict=True)), dict.fromkeys("xyz", 0.0)
    for k in range(40):
        for robot, late in (("cf9", 0), ("cf10", 4_000_000)):
            at = k * 10_000_000 + late
            message = {
                "header": {"stamp": {"sec": 0, "nanosec": at}, "frame_id": "map"},
                "child_frame_id": robot,
                "pose": {
                    "pose": {"position": {"x": at * 1e-9, "y": 0.0, "z": 1.0}, "orientation": quaternion},
                    "covariance": [0.0] * 36,
                },
                "twist": {"twist": {"linear": zeros, "angular": zeros}, "covariance": [0.0] * 36},
            }
            writer.write_message(f"/{robot}/odom", schema, message, log_time=at, publish_time=at)
    writer.finish()
    path.write_bytes(data.getvalue())
    found = read(path)
    assert found.n_robots == 2
    np.testing.assert_allclose(found.time, 0.01 * np.arange(1, 40))
    np.testing.assert_allclose(found.state[..., 0], found.time[:, None] * [1, 1], atol=1e-9)
    assert found.world == {}
    assert found.plan.shape == (39, 2, 0, 3)


def test_a_file_without_robots_is_no_flight(tmp_path):
    path, data = tmp_path / "lab.mcap", io.BytesIO()
    writer = Writer(data)
    writer.write_message("/chatter", writer.register_msgdef("std_msgs/msg/String", "string data"), {"data": "hello"})
    writer.finish()
    path.write_bytes(data.getvalue())
    with pytest.raises(ValueError, match="/NAME/odom of each robot"):
        read(path)
