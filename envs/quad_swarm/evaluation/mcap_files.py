"""Recordings as MCAP, with messages of ROS 2: what Foxglove and Lichtblick show, and ``ros2 bag`` plays.

========================= ============================ ======================================================
topic                     type                         content
========================= ============================ ======================================================
``/robot_0/odom``         nav_msgs/Odometry            state; the twist is in the robot's own frame
``/robot_0/plan``         nav_msgs/Path                planned positions
``/robot_0/cmd``          geometry_msgs/TwistStamped   set-point, see `quad_swarm.ros.messages.to_command`
``/swarm/talk``           std_msgs/String              who asked whom and who told whom, pairs of robots (JSON)
``/swarm/separation``     std_msgs/Float64             smallest distance of two robots (m)
``/swarm/about``          std_msgs/String              world, policy, goals and obstacles (JSON)
========================= ============================ ======================================================

Other recordings need ``/NAME/odom`` of each robot only, at any times: these are interpolated at those of the first.
Set-points of other recordings, ``/NAME/cmd`` as above, hold until the next.
"""

from __future__ import annotations

import bisect
import io
import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.reader import read_ros2_messages
from mcap_ros2.writer import Writer

from quad_swarm.evaluation.recordings import Recording, about, from_about
from quad_swarm.geometry import to_quaternion
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.ros.messages import FRAME, from_command, from_odometry, rotation

_NS = 1_000_000_000
_HEADER = "std_msgs/Header header"
_RULE = "=" * 80
_TYPES = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": f"{_HEADER}\ngeometry_msgs/Pose pose",
    "geometry_msgs/TwistStamped": f"{_HEADER}\ngeometry_msgs/Twist twist",
    "nav_msgs/Odometry": (
        f"{_HEADER}\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "nav_msgs/Path": f"{_HEADER}\ngeometry_msgs/PoseStamped[] poses",
    "std_msgs/String": "string data",
    "std_msgs/Float64": "float64 data",
}


def _definition(name: str) -> str:
    """Return the definition of a message and of those that it contains, as ``rosbag2`` stores it."""
    needed = [name]
    for one in needed:
        words = (line.split()[0].removesuffix("[]") for line in _TYPES[one].splitlines())
        needed.extend(word for word in words if word in _TYPES and word not in needed)
    return f"\n{_RULE}\n".join([_TYPES[name], *(f"MSG: {one}\n{_TYPES[one]}" for one in needed[1:])])


def write(path: Path, recording: Recording) -> None:
    """Write a recording, see `quad_swarm.evaluation.recordings.write`."""
    data = io.BytesIO()
    writer = _Writer(data)
    separation = recording.separation()
    writer.put(recording.time[0], "/swarm/about", "std_msgs/String", {"data": about(recording)})
    for k, time in enumerate(recording.time):
        if recording.n_robots > 1:
            writer.put(time, "/swarm/separation", "std_msgs/Float64", {"data": float(separation[k])})
        for robot in range(recording.n_robots):
            _put_robot(writer, recording, k, robot)
        talk = {name: np.argwhere(getattr(recording, name)[k]).tolist() for name in ("asked", "told")}
        if any(talk.values()):
            writer.put(time, "/swarm/talk", "std_msgs/String", {"data": json.dumps(talk)})
    writer.finish()
    path.write_bytes(data.getvalue())


class _Writer:
    def __init__(self, data: io.BytesIO):
        self._writer, self._schemas = Writer(data), dict[str, Any]()

    def put(self, time: float, topic: str, kind: str, message: dict[str, Any]) -> None:
        """Write a message at a time (s)."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_msgdef(kind.replace("/", "/msg/"), _definition(kind))
        at = round(time * _NS)
        self._writer.write_message(topic, self._schemas[kind], message, log_time=at, publish_time=at)

    def finish(self) -> None:
        self._writer.finish()


def _put_robot(writer: _Writer, recording: Recording, k: int, robot: int) -> None:
    """Write what one robot is and does at a time."""
    time, name = recording.time[k], f"robot_{robot}"
    at = round(time * _NS)
    header = {"stamp": {"sec": at // _NS, "nanosec": at % _NS}, "frame_id": FRAME}
    state, setpoint, plan = (one[k, robot] for one in (recording.state, recording.setpoint, recording.plan))
    zeros = [0.0] * 36
    pose = {"position": _named(state[POSITION]), "orientation": _named(to_quaternion(state[6:9]))}
    twist = {"linear": _named(rotation(state[6:9]).T @ state[VELOCITY]), "angular": _named(np.zeros(3))}
    odometry = {
        "header": header,
        "child_frame_id": f"{name}/base_link",
        "pose": {"pose": pose, "covariance": zeros},
        "twist": {"twist": twist, "covariance": zeros},
    }
    writer.put(time, f"/{name}/odom", "nav_msgs/Odometry", odometry)
    if np.isfinite(setpoint).all():
        roll, pitch, climb, turn = setpoint
        command = {"linear": _named(np.array([0, 0, climb])), "angular": _named(np.array([roll, pitch, turn]))}
        writer.put(time, f"/{name}/cmd", "geometry_msgs/TwistStamped", {"header": header, "twist": command})
    if len(plan) and np.isfinite(plan).all():
        level = _named(np.array([0, 0, 0, 1]))
        poses = [{"header": header, "pose": {"position": _named(one), "orientation": level}} for one in plan]
        writer.put(time, f"/{name}/plan", "nav_msgs/Path", {"header": header, "poses": poses})


def _named(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=False))


class _Found:
    """What a file holds, by robots' names and times (ns)."""

    def __init__(self, data: io.BytesIO):
        self.states: defaultdict[str, dict[int, np.ndarray]] = defaultdict(dict)
        self.setpoints: defaultdict[str, dict[int, np.ndarray]] = defaultdict(dict)
        self.plans: defaultdict[str, dict[int, np.ndarray]] = defaultdict(dict)
        self.talk: dict[int, dict[str, list[list[int]]]] = {}
        self.rest: dict[str, Any] = {}
        for one in read_ros2_messages(data):
            name, _, kind = one.channel.topic.strip("/").rpartition("/")
            self._take(name, kind, one.log_time_ns, one.ros_msg)

    def _take(self, name: str, kind: str, time: int, message: Any) -> None:
        if kind == "odom":
            self.states[name][time] = from_odometry(message)[1]
        elif kind == "cmd":
            self.setpoints[name][time] = from_command(message)
        elif kind == "plan":
            points = (pose.pose.position for pose in message.poses)
            self.plans[name][time] = np.array([(point.x, point.y, point.z) for point in points])
        elif (name, kind) == ("swarm", "talk"):
            self.talk[time] = json.loads(message.data)
        elif (name, kind) == ("swarm", "about"):
            self.rest = json.loads(message.data)


def read(path: Path) -> Recording:
    """Read a recording, see `quad_swarm.evaluation.recordings.read`."""
    data = io.BytesIO(path.read_bytes())
    try:
        found = _Found(data)
    except Exception as error:  # its reader has no errors of its own for damaged files
        raise ValueError(str(error) or type(error).__name__) from None
    # robot_10 comes after robot_9
    names = sorted(found.states, key=lambda name: [one.zfill(9) for one in re.split(r"(\d+)", name)])
    if not names:
        raise ValueError("it needs /NAME/odom of each robot")
    begin, end = _common(found, names)
    times = [time for time in sorted(found.states[names[0]]) if begin <= time <= end]
    state = np.stack([_at(found.states[name], times) for name in names], axis=1)
    horizon = max((len(plan) for plans in found.plans.values() for plan in plans.values()), default=0)
    shape = (len(times), len(names))
    setpoint = np.stack([_held(found.setpoints[name], times, not found.rest) for name in names], axis=1)
    plan = np.full((*shape, horizon, 3), np.nan)
    asked, told = np.zeros((2, *shape, len(names)), dtype=bool)
    for k, time in enumerate(times):
        for robot, name in enumerate(names):
            plan[k, robot] = found.plans[name].get(time, np.nan)
        for kind, marks in (("asked", asked), ("told", told)):
            for pair in found.talk.get(time, {}).get(kind, ()):
                marks[k, pair[0], pair[1]] = True
    goal = np.array(found.rest["goal"]) if found.rest else state[-1, :, POSITION]
    rest = (
        from_about(found.rest) if found.rest else {"guessed": frozenset({"goal"} if found.talk else {"goal", "talk"})}
    )
    return Recording(np.array(times) / _NS, state, setpoint, plan, asked, told, goal, **rest)


def _common(found: _Found, names: list[str]) -> tuple[int, int]:
    """Return the times (ns) between which every robot has states."""
    return max(min(found.states[name]) for name in names), min(max(found.states[name]) for name in names)


def _at(states: dict[int, np.ndarray], times: list[int]) -> np.ndarray:
    """Return the states of a robot at some times (ns), interpolated where it has others, (T, 9)."""
    if all(time in states for time in times):
        return np.array([states[time] for time in times])
    known = sorted(states)
    values = np.array([states[time] for time in known])
    values[:, 6:9] = np.unwrap(values[:, 6:9], axis=0)
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)


def _held(setpoints: dict[int, np.ndarray], times: list[int], hold: bool) -> np.ndarray:
    """Return the set-points of a robot at some times (ns), NaN where there are none, (T, 4).

    :param hold: whether each holds until the next, otherwise at its time only
    """
    found = np.full((len(times), 4), np.nan)
    known = sorted(setpoints)
    for k, time in enumerate(times):
        before = bisect.bisect_right(known, time) - 1
        if before >= 0 and (hold or known[before] == time):
            found[k] = setpoints[known[before]]
    return found
