"""Vehicles that are commanded over ROS 2. **Only** `OdometryVehicle` **has flown with nodes of ROS; none has flown on
hardware.**

=========================== =================================================== ======================================
vehicle                     perceives, of each robot                            commands
=========================== =================================================== ======================================
`OdometryVehicle`           ``/NAME/odom`` (nav_msgs/Odometry)                  ``/NAME/cmd``, see `to_command`
`CrazyswarmVehicle`         the same; Crazyswarm2's twist is the world's        ``/NAME/cmd_full_state``
                                                                                (crazyflie_interfaces/FullState)
`LegacyCrazyswarmVehicle`   the same                                            ``/NAME/cmd_vel_legacy``
                                                                                (geometry_msgs/Twist, degrees)
`Px4Vehicle`                ``/NAME/fmu/out/vehicle_odometry``                  ``/NAME/fmu/in/``...
                            (px4_msgs/VehicleOdometry)                          (px4_msgs), attitude offboard
`AerostackVehicle`          ``/NAME/self_localization/odom``                    ``/NAME/actuator_command/pose`` and
                            (nav_msgs/Odometry)                                 ``thrust`` (as2_msgs/Thrust)
=========================== =================================================== ======================================

Message packages that are not in `quad_swarm.ros.messages` are imported when a vehicle is made.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quad_swarm.geometry import from_quaternion, to_frd, to_ned, to_quaternion, wrapped
from quad_swarm.quadrotor import N_STATES, POSITION, VELOCITY
from quad_swarm.realtime.attitude import Attitude, AttitudeController
from quad_swarm.realtime.link import Sensed, sensed_together
from quad_swarm.realtime.mavlink import OFFBOARD_AFTER
from quad_swarm.robot import Plan
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.messages import FRAME, from_odometry, msgs, rotation, to_command, to_time
from quad_swarm.ros.node import Mailbox, quality

_S = 1_000_000
_UNSEEN, _ASTRAY = 100_000, 0.3  # since a robot was seen last (us), and how far from there its state may be (m)
_CRAZYFLIE_THRUST, _CRAZYFLIE_MOST = 65535, 60000
_PX4_NED, _PX4_BODY_FRD = 1, 3
_PX4_SET_MODE, _PX4_ARM, _PX4_OFFBOARD = 176, 400, 6


class TeamVehicle:
    """Perceives all robots by a topic of each. Its subclasses command.

    :ivar controller: attitude and thrust for set-points
    :ivar heading: heading to hold in flights (rad), None for the one that the robot has when they begin

    :param node: the robot's node
    :param mailbox: receives for it
    :param link: the robot's link, whose clock it uses
    :param names: names of all robots, their namespaces
    :param kind: class of the messages that hold a state
    :param topic: its topic below ``/NAME/``
    :param convert: time (us) and state, (9,), of such a message of some robot; a ValueError refuses it
    :param controller: attitude and thrust for set-points
    """

    def __init__(
        self,
        node: Any,
        mailbox: Mailbox,
        link: RosLink,
        names: Sequence[str],
        kind: type,
        topic: str,
        convert: Callable[[Any, int], tuple[int, np.ndarray]],
        controller: AttitudeController | None = None,
    ):
        self._node, self._link, self._name = node, link, names[link.index]
        self._mailbox, self._names = mailbox, list(names)
        self.heading: float | None = None
        self._captures: Callable[[], Any] | None = None
        self._captured: dict[str, tuple[int, np.ndarray]] = {}
        self.controller = controller or AttitudeController()
        self._states: dict[int, tuple[int, np.ndarray]] = {}
        self._convert = convert
        self._others = [number for number in range(len(names)) if number != link.index]
        self._commanded = link.now()
        self._publishers: dict[str, Any] = {}
        raw = kind is msgs().Odometry
        self._topics = [mailbox.newest(kind, f"/{name}/{topic}", raw) for name in names]

    def watch_poses(self, topic: str) -> None:
        """Let states count only of robots that motion capture sees, and only where it sees them. An estimator on board
        goes on without its markers, and drifts, with states that are new: what it says now grows old instead.

        :param topic: poses by the robots' names (motion_capture_tracking_interfaces/NamedPoseArray), such as "/poses"
        :raises ImportError: if the package of its messages is not there
        """
        kind = _class("motion_capture_tracking_interfaces", "NamedPoseArray")
        self._captures = self._mailbox.newest(kind, topic)

    def sense(self) -> Sensed | None:
        """See `quad_swarm.realtime.Vehicle`. The others are moved to the time of the robot's own state."""
        states = self._seen()
        if len(states) < len(self._others) + 1:
            return None
        stamp, own = states[self._link.index]
        stamps, others = zip(*(states[other] for other in self._others), strict=True)
        seen = np.array(others)
        return sensed_together(stamp, own, np.array(stamps), seen[:, POSITION], seen[:, VELOCITY])

    def engage(self) -> None:
        """Prepare for set-points: a flight begins. The controller holds `heading` from now on."""
        own = self._seen().get(self._link.index)
        self.controller.reset(self.heading if self.heading is not None or own is None else float(own[1][8]))

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        raise NotImplementedError

    def disarm(self) -> None:
        """See `quad_swarm.realtime.Vehicle`. Here, whoever stands behind the topics stops the motors of what lies on
        the ground."""

    def _seen(self) -> dict[int, tuple[int, np.ndarray]]:
        """Take what has arrived. Returns the newest states by robot."""
        self._take_poses()
        for number, newest in enumerate(self._topics):
            try:
                message = newest()
                if message is not None:
                    self._see(number, *self._convert(message, number))
            except Exception:  # whatever a foreign message, or the middleware, raises
                self._link.traffic.refused += 1
        return self._states

    def _take_poses(self) -> None:
        try:
            message = None if self._captures is None else self._captures()
            for one in () if message is None else message.poses:
                if one.name in self._names:
                    place = one.pose.position
                    self._captured[one.name] = self._link.now(), np.array([place.x, place.y, place.z])
        except Exception:  # whatever the middleware raises
            self._link.traffic.refused += 1

    def _see(self, number: int, stamp: int, state: np.ndarray) -> None:
        """Keep the newest state of a robot, with the time on this robot's clock."""
        if self._captures is not None:
            at, place = self._captured.get(self._names[number], (0, np.full(3, np.inf)))
            if self._link.now() - at > _UNSEEN or not np.linalg.norm(state[POSITION] - place) <= _ASTRAY:
                raise ValueError(f"motion capture does not see {self._names[number]} there")
        stamp = self._link.own(stamp) + self._link.clock_error
        if number not in self._states or stamp > self._states[number][0]:
            self._states[number] = stamp, state

    def _attitude(self, setpoint: np.ndarray) -> Attitude:
        """Return attitude and thrust. Before a state has been perceived, the robot is taken to be level and at rest."""
        now = self._link.now()
        state = self._seen().get(self._link.index, (0, np.zeros(N_STATES)))[1]
        attitude = self.controller(state, setpoint, (now - self._commanded) / _S)
        self._commanded = now
        return attitude

    def _stamp(self) -> int:
        return self._link.shared(self._link.now())

    def _publisher(self, kind: type, topic: str) -> Any:
        topic = f"/{self._name}/{topic}"
        self._publishers[topic] = self._node.create_publisher(kind, topic, quality(1, reliable=True))
        return self._publishers[topic]

    def unheard(self) -> list[str]:
        """Return the topics of commands that nobody receives: without a subscriber whose type, quality of service and
        middleware fit."""
        return [topic for topic, one in self._publishers.items() if not one.get_subscription_count()]


class OdometryVehicle(TeamVehicle):
    """Perceives by odometry, and is commanded by ``/NAME/cmd``.

    :param node: the robot's node
    :param mailbox: receives for it
    :param link: the robot's link, whose clock it uses
    :param names: names of all robots
    :param topic: topic of the odometry below ``/NAME/``
    :param twist: whose axes the odometry's twist has, "body" (REP 147) or "world"
    :param controller: attitude and thrust for set-points, of subclasses that need them
    :raises ValueError: if the axes are unknown
    """

    def __init__(
        self,
        node: Any,
        mailbox: Mailbox,
        link: RosLink,
        names: Sequence[str],
        *,
        topic: str = "odom",
        twist: str = "body",
        controller: AttitudeController | None = None,
    ):
        if twist not in ("body", "world"):
            raise ValueError(f"twist={twist!r}: choose 'body' or 'world'")

        def convert(message: Any, number: int) -> tuple[int, np.ndarray]:
            return from_odometry(message, twist == "world")

        super().__init__(node, mailbox, link, names, msgs().Odometry, topic, convert, controller)
        self._make_publishers()

    def _make_publishers(self) -> None:
        self._commands = self._publisher(msgs().TwistStamped, "cmd")

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        self._commands.publish(to_command(setpoint, self._stamp()))


class CrazyswarmVehicle(OdometryVehicle):
    """Crazyflies behind Crazyswarm2: the firmware follows the plan's positions, velocities and accelerations.

    **Not tested on hardware.** Crazyswarm2 must log ``odom`` of each Crazyflie at the rate of the periods or faster,
    and take off and land before and after (services ``takeoff``, ``notify_setpoints_stop``, ``land``).

    :param robot: node, mailbox, link and names, see `OdometryVehicle`
    :param period: length of a plan's stages (us), `Robot.period`
    :param lead: time ahead of now that is commanded (us), by default half of a period
    :param controller: holds the heading
    :raises ValueError: if the period is not positive
    """

    def __init__(self, *robot: Any, period: int, lead: int | None = None, controller: AttitudeController | None = None):
        if not period > 0:
            raise ValueError(f"period={period}: give the length of the plans' stages in microseconds, `Robot.period`")
        self._period, self._lead = period, period // 2 if lead is None else lead
        self._held: np.ndarray | None = None
        super().__init__(*robot, twist="world", controller=controller)

    def engage(self) -> None:
        """See `TeamVehicle`. No place is held yet."""
        super().engage()
        self._held = None

    def _make_publishers(self) -> None:
        self._full_state = _class("crazyflie_interfaces", "FullState")
        self._commands = self._publisher(self._full_state, "cmd_full_state")

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`. Without a plan, the last position is held, and moved by the climb rate."""
        before, attitude = self._commanded, self._attitude(setpoint)
        if plan is not None:
            position, velocity, acceleration = followed(plan, self._link.now() + self._lead, self._period)
        else:
            place = self._place()
            if place is None:
                return
            velocity, acceleration = np.array([0.0, 0.0, setpoint[2]]), np.zeros(3)
            position = place + min((self._link.now() - before) / _S, 0.2) * velocity
        self._held = position
        message = self._full_state()
        message.header.frame_id, message.header.stamp = FRAME, to_time(self._stamp())
        _fill(message.pose.position, position)
        _fill(message.pose.orientation, to_quaternion(np.array(attitude[:3])), "xyzw")
        _fill(message.twist.linear, velocity)
        message.twist.angular.z = float(setpoint[3])
        _fill(message.acc, acceleration)
        self._commands.publish(message)

    def _place(self) -> np.ndarray | None:
        own = self._seen().get(self._link.index)
        return self._held if self._held is not None else None if own is None else own[1][POSITION]


class LegacyCrazyswarmVehicle(OdometryVehicle):
    """Crazyflies behind Crazyswarm2: roll, pitch, yaw rate and thrust, which the firmware's attitude controller flies.

    **Not tested on hardware.**

    :param robot: node, mailbox, link and names, see `OdometryVehicle`
    :param controller: attitude and thrust for set-points
    """

    def __init__(self, *robot: Any, controller: AttitudeController | None = None):
        super().__init__(*robot, twist="world", controller=controller)

    def _make_publishers(self) -> None:
        self._commands = self._publisher(msgs().Twist, "cmd_vel_legacy")
        self._commands.publish(msgs().Twist())  # which unlocks the thrust

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        attitude = self._attitude(setpoint)
        message = msgs().Twist()
        message.linear.x, message.linear.y = map(float, np.degrees([attitude.pitch, attitude.roll]))
        message.linear.z = float(min(attitude.thrust * _CRAZYFLIE_THRUST, _CRAZYFLIE_MOST))
        own = self._seen().get(self._link.index)
        heading = attitude.yaw if own is None else own[1][8]
        error = wrapped(attitude.yaw - heading)
        message.angular.z = -float(np.degrees(2.0 * error + setpoint[3]))  # the firmware inverts it
        self._commands.publish(message)


class AerostackVehicle(OdometryVehicle):
    """A platform of Aerostack2 in the control mode ATTITUDE with YAW_ANGLE, armed, offboard and in the air.

    **Not tested on hardware, nor with Aerostack2's simulators.**

    :param robot: node, mailbox, link and names, see `OdometryVehicle`
    :param most_thrust: largest thrust (N): some platforms take newtons
    :param controller: attitude and thrust for set-points
    :raises ValueError: if the largest thrust is not positive and finite
    """

    def __init__(self, *robot: Any, most_thrust: float, controller: AttitudeController | None = None):
        if not 0 < most_thrust < np.inf:
            raise ValueError(f"most_thrust={most_thrust}: give the largest thrust in newtons")
        self._most_thrust = most_thrust
        super().__init__(*robot, topic="self_localization/odom", controller=controller)

    def _make_publishers(self) -> None:
        self._pose, self._thrust = msgs().PoseStamped, _class("as2_msgs", "Thrust")
        self._poses = self._publisher(self._pose, "actuator_command/pose")
        self._thrusts = self._publisher(self._thrust, "actuator_command/thrust")

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        attitude, stamp = self._attitude(setpoint), to_time(self._stamp())
        pose, thrust = self._pose(), self._thrust()
        for message in (pose, thrust):
            message.header.frame_id, message.header.stamp = "earth", stamp
        _fill(pose.pose.orientation, to_quaternion(np.array(attitude[:3])), "xyzw")
        thrust.thrust, thrust.thrust_normalized = attitude.thrust * self._most_thrust, attitude.thrust
        self._poses.publish(pose)
        self._thrusts.publish(thrust)


class Px4Vehicle(TeamVehicle):
    """PX4 over its uXRCE-DDS bridge: attitude and thrust offboard. **Not tested on hardware, nor with PX4 itself.**

    The x axis of the world is taken for east and y for north. PX4's positions begin where the vehicle was switched on.

    :param node: the robot's node
    :param mailbox: receives for it
    :param link: the robot's link, whose clock it uses
    :param names: names of all robots
    :param origins: where each robot's local frame begins, (n, 3), world frame (m)
    :param controller: attitude and thrust for set-points
    :raises ValueError: if there are not as many origins as robots
    """

    def __init__(
        self,
        node: Any,
        mailbox: Mailbox,
        link: RosLink,
        names: Sequence[str],
        origins: np.ndarray,
        controller: AttitudeController | None = None,
    ):
        self._origins = np.asarray(origins, float)
        if self._origins.shape != (len(names), 3) or not np.isfinite(self._origins).all():
            raise ValueError(f"origins={self._origins.tolist()}: give three numbers for each of {len(names)} robots")
        kinds = ("VehicleOdometry", "OffboardControlMode", "VehicleAttitudeSetpoint", "VehicleCommand")
        odometry, *self._kinds = (_class("px4_msgs", kind) for kind in kinds)
        topic = _px4("out/vehicle_odometry", odometry)
        super().__init__(node, mailbox, link, names, odometry, topic, self._from_odometry, controller)
        topics = ("in/offboard_control_mode", "in/vehicle_attitude_setpoint", "in/vehicle_command")
        self._modes, self._attitudes, self._commands = (
            self._publisher(kind, _px4(topic, kind)) for topic, kind in zip(topics, self._kinds, strict=True)
        )
        self._offboard_at: int | None = None

    def engage(self) -> None:
        """Go offboard after 1.5 s of set-points: PX4 wants to have had some for a second before."""
        super().engage()
        self._offboard_at = self._link.now() + OFFBOARD_AFTER

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        if self._offboard_at is not None and self._link.now() >= self._offboard_at:
            self._offboard_at = None
            self.controller.reset()  # nobody flew what it was told so far
            self.begin_offboard()
        mode, attitudes, _ = self._kinds
        attitude, stamp = self._attitude(setpoint), self._stamp()
        self._modes.publish(mode(timestamp=stamp, attitude=True))
        message = attitudes(timestamp=stamp)
        x, y, z, w = to_quaternion(to_frd(np.array(attitude[:3]))).tolist()
        message.q_d = np.array([w, x, y, z], np.float32)
        message.thrust_body = np.array([0.0, 0.0, -attitude.thrust], np.float32)
        self._attitudes.publish(message)

    def arm(self) -> None:
        """Ask the autopilot to start the motors."""
        self._tell(_PX4_ARM, 1.0)

    def disarm(self) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        self._tell(_PX4_ARM, 0.0)

    def begin_offboard(self) -> None:
        """Ask the autopilot to fly our set-points. It wants to have had some for a second before."""
        self._tell(_PX4_SET_MODE, 1.0, float(_PX4_OFFBOARD))

    def _tell(self, command: int, *parameters: float) -> None:
        target = {"target_system": self._link.index + 1, "target_component": 1}
        source = {"source_system": self._link.index + 1, "source_component": 1, "from_external": True}
        values = {f"param{k}": value for k, value in enumerate(parameters, start=1)}
        kind = self._kinds[2]
        self._commands.publish(kind(timestamp=self._stamp(), command=command, **target, **source, **values))

    def _from_odometry(self, message: Any, number: int) -> tuple[int, np.ndarray]:
        pose, velocity_of = message.pose_frame, message.velocity_frame
        if pose != _PX4_NED or velocity_of not in (_PX4_NED, _PX4_BODY_FRD):
            raise ValueError(f"pose_frame={pose} and velocity_frame={velocity_of} are none that can be converted")
        position, velocity, q = (np.asarray(one, float) for one in (message.position, message.velocity, message.q))
        attitude = from_quaternion(np.roll(q, -1))  # w comes first
        if velocity_of == _PX4_BODY_FRD:
            velocity = rotation(attitude) @ velocity
        state = np.concatenate([to_ned(position) + self._origins[number], to_ned(velocity), to_frd(attitude)])
        if not np.isfinite(state).all():
            raise ValueError("a state is not finite")
        return int(message.timestamp_sample or message.timestamp), state


def followed(plan: Plan, at: int, period: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position (m), velocity (m/s) and acceleration (m/s^2), (3,) each, of a plan at some time; after its end,
    those of its end, at rest.

    :param plan: the plan
    :param at: the time (us)
    :param period: length of its stages (us)
    """
    k = (at - plan.stamp) / period
    stages = np.arange(len(plan.positions))
    if k >= stages[-1]:
        return plan.positions[-1].copy(), np.zeros(3), np.zeros(3)
    velocities = np.gradient(plan.positions, period / _S, axis=0)
    curves = plan.positions, velocities, np.gradient(velocities, period / _S, axis=0)
    position, velocity, acceleration = (np.array([np.interp(k, stages, one) for one in curve.T]) for curve in curves)
    return position, velocity, acceleration


def _class(package: str, name: str) -> Any:
    """Return the class of a message.

    :raises ImportError: if its package is not there
    """
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        raise ImportError(f"{package} is not there: build it in your workspace, and source its setup.bash.") from None


def _px4(topic: str, kind: type) -> str:
    """Return a topic of PX4, whose name holds the version of its messages from the second one on."""
    version = getattr(kind, "MESSAGE_VERSION", 0)
    return f"fmu/{topic}" + (f"_v{version}" if version else "")


def _fill(message: Any, values: np.ndarray, names: str = "xyz") -> None:
    for name, value in zip(names, values.tolist(), strict=True):
        setattr(message, name, value)
