"""A robot as a lifecycle node, ``python -m quad_swarm.ros.robot_node --ros-args -r __ns:=/NAME -p NAME:=VALUE ...``.

============== ==============================================================================================
transition     what it does
============== ==============================================================================================
``configure``  reads the parameters, checks them, subscribes and publishes, and warms up
``activate``   begins to fly from where the robot is and holds that place, if the states of all robots are
               fresh and it is in the air. Taking off is the autopilot's or the operator's
``deactivate`` begins to land; the robot disarms on the ground, and is not activated or cleaned up before
``cleanup``    destroys publishers and subscriptions
``shutdown``   lands and ends the process, as SIGINT and SIGTERM do
============== ==============================================================================================

Besides the topics of `RosLink` and those of the vehicle, there are

====================== =================================== ==================================================
topic                  type                                content
====================== =================================== ==================================================
``/NAME/goal_pose``    geometry_msgs/PoseStamped           where to fly, in the frame "map"; no heading
``/NAME/status``       diagnostic_msgs/DiagnosticArray     once a second: what the robot does, why, and counts
====================== =================================== ==================================================
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime.attitude import AttitudeController, AttitudeGains
from quad_swarm.realtime.link import Handler, Vehicle, monotonic
from quad_swarm.realtime.loop import Loop, freeze_garbage
from quad_swarm.realtime.process import set_priority
from quad_swarm.realtime.supervisor import Mode, SafetyLimits, Watchdog
from quad_swarm.realtime.team import Team
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.messages import FRAME, msgs, to_diagnostics
from quad_swarm.ros.node import Mailbox, Nobody, checked_names, declare, make_context, quality, texts, values_of
from quad_swarm.ros.vehicles import (
    AerostackVehicle,
    CrazyswarmVehicle,
    LegacyCrazyswarmVehicle,
    OdometryVehicle,
    Px4Vehicle,
)
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import make_config, points

PARAMETERS: dict[str, Any] = {
    "policy": "",
    "preset": "flight",
    "world": [],
    "names": [],
    "index": -1,
    "vehicle": "odometry",
    "wait": 0.005,
    "late": 0.25,
    "priority": 0,
    "limits": [],
    # Of vehicles, which need some of them
    "odom_topic": "odom",
    "twist": "body",
    "origins": [],
    "most_thrust": 0.0,
    "gains": [],
    "heading": 0.0,
}
_IDLE = 100_000  # us after which a node without a flight looks around
_STATUS = 1_000_000  # us
_DISARMS = 5  # times that the vehicle is told so: messages get lost
_OFFBOARD = 1_500_000  # us of set-points that PX4 has had before it is told to fly them


def make_vehicle(robot: tuple[Any, Mailbox, RosLink, list[str]], values: dict[str, Any], period: int) -> Vehicle:
    """Create the vehicle that the parameters name.

    :param robot: node, mailbox, link and names, see `OdometryVehicle`
    :param values: the parameters
    :param period: length of a period (us)
    :raises ValueError: if it is unknown, or one of its own parameters is wrong
    :raises ImportError: if the package of its messages is not there
    """
    origins, thrust, heading = values["origins"], values["most_thrust"], values["heading"]
    is_list = isinstance(origins, Sequence) and not isinstance(origins, str)
    numbers: list[Any] = [*origins, thrust, heading] if is_list else [None]
    if not all(type(one) in (int, float) and np.isfinite(one) for one in numbers) or len(origins) % 3:
        raise ValueError(
            f"origins={shown(origins)}, most_thrust={shown(thrust)}, heading={shown(heading)}: give finite numbers, "
            "x, y and z of each robot one after the other as origins"
        )
    gains = AttitudeGains(**read_assignments("gains", texts("gains", values["gains"])))
    controller = AttitudeController(gains, float(heading))
    places = np.array(origins, float).reshape(-1, 3)
    makers: dict[str, Callable[[], Vehicle]] = {
        "odometry": lambda: OdometryVehicle(*robot, topic=values["odom_topic"], twist=values["twist"]),
        "crazyswarm": lambda: CrazyswarmVehicle(*robot, period=period, controller=controller),
        "crazyswarm_legacy": lambda: LegacyCrazyswarmVehicle(*robot, controller=controller),
        "px4": lambda: Px4Vehicle(*robot, origins=places, controller=controller),
        "aerostack": lambda: AerostackVehicle(*robot, most_thrust=float(thrust), controller=controller),
    }
    if values["vehicle"] not in makers:
        raise unknown_name("vehicle", values["vehicle"], makers)
    return makers[values["vehicle"]]()


class RobotNode:
    """The node of a robot. All of it runs in the thread of `run`: messages and transitions are taken while the loop
    waits, since one thread must not publish while another one spins.

    :ivar node: the node of ROS
    :ivar loop: the robot's loop, None unless it is configured
    :ivar flies: whether it flies, or lands

    :param args: command line
    :raises ImportError: if ROS 2 is not there
    :raises ValueError: if the arguments of ROS are wrong
    """

    def __init__(self, args: Sequence[str] | None = None):
        self.node = _lifecycle_node(self, make_context(args))
        declare(self.node, PARAMETERS)
        self._mailbox = Mailbox(self.node)
        self.loop: Loop | None = None
        self.flies = self._ended = self._leaves = self._is_fresh = False
        self._own: list[tuple[Callable[[Any], Any], Any]] = []
        self._off, self._told, self._offboard_at, self._mode = 0, 0, 0, Mode.OFF

    def run(self) -> None:
        """Run until `end` or the transition ``shutdown``."""
        while not self._ended:
            loop = self.loop
            if loop is not None and self.flies:
                loop.run(self._is_down, self._after_period)
                self._watchdog.beat(armed=False)
                self.flies = False
                self._log(f"landed ({loop.statistics.counts['periods']} periods flown)")
            else:
                if self._is_fresh:
                    self._is_fresh = False
                    freeze_garbage()
                self._mailbox.wait(monotonic() + _IDLE, loop or Nobody(), lambda: self.flies or self._leaves)
                self._tell()
            self._ended = self._leaves and not self.flies

    def end(self) -> None:
        """Land if the robot flies, and end `run`."""
        self._leaves = True
        self._land()

    def close(self) -> None:
        """Release everything."""
        self._release()
        self._mailbox.close()

    def configure(self) -> None:
        """Take the transition ``configure``.

        :raises ValueError: if a parameter is wrong
        :raises ImportError: if a package of messages is not there
        :raises OSError: if the folder of a model cannot be read
        """
        before = {id(one) for one in (*self.node.publishers, *self.node.subscriptions)}
        try:
            self._configure(values_of(self.node, PARAMETERS))
        finally:
            for kind, destroy in (("publishers", "destroy_publisher"), ("subscriptions", "destroy_subscription")):
                made = [one for one in getattr(self.node, kind) if id(one) not in before]
                self._own += [(getattr(self.node, destroy), one) for one in made]
            if self.loop is None:
                self._release()

    def activate(self) -> None:
        """Take the transition ``activate``.

        :raises ValueError: if the robot must not begin to fly
        """
        loop = self._grounded()
        now, sensed, limits = loop.link.now(), loop.vehicle.sense(), loop.supervisor.limits
        if sensed is None:
            raise ValueError("no state of each robot has arrived: is their odometry published?")
        age = (now - sensed.stamp) * 1e-6
        if not age <= limits.stale:
            raise ValueError(f"the oldest state is {age:.3f} s old, more than limits.stale={limits.stale:g}")
        own = sensed.state[POSITION].copy()
        if not np.isfinite(own).all():
            raise ValueError("the own state is not finite")
        if own[2] <= limits.ground:
            raise ValueError(f"the robot is on the ground ({own[2]:.2f} m high): take off first")
        loop.start(own, own, now + loop.robot.period)
        self._off, self._mode, self._offboard_at = 0, Mode.FLY, now + _OFFBOARD
        self.flies = True

    def deactivate(self) -> None:
        """Take the transition ``deactivate``: begin to land."""
        self._land()

    def cleanup(self) -> None:
        """Take the transition ``cleanup``.

        :raises ValueError: if the robot flies or lands
        """
        self._grounded()
        self._release()

    def _configure(self, values: dict[str, Any]) -> None:
        names, index = checked_names(values["names"]), values["index"]
        config = make_config(
            values["preset"], read_assignments("world", texts("world", values["world"])), n_robots=len(names)
        )
        limits = SafetyLimits(**read_assignments("limits", texts("limits", values["limits"])))
        team = Team(config, values["policy"], limits, values["wait"], values["late"], priority=values["priority"])
        if type(index) is not int or not 0 <= index < len(names):
            raise ValueError(f"index={shown(index)}: give the robot's place among the {len(names)} names, from 0")
        name = names[index]
        if self.node.get_namespace() != f"/{name}":
            raise ValueError(
                f"the node's namespace is {self.node.get_namespace()}: start it with -r __ns:=/{name}, so that robots "
                "have services of their own"
            )
        robot = team.robot(index)
        link = RosLink(self.node, self._mailbox, index, names)
        vehicle = make_vehicle((self.node, self._mailbox, link, names), values, robot.period)
        loop = Loop(robot, link, vehicle, team.limits, team.wait, team.late)
        self._status = self.node.create_publisher(msgs().DiagnosticArray, f"/{name}/status", quality(5))
        # Goals must arrive; whoever sends one to a robot that does not fly yet is told so by the log
        self._mailbox.subscribe(msgs().PoseStamped, f"/{name}/goal_pose", 10, self._take_goal)
        loop.warm_up()
        if not set_priority(team.priority):
            self._log("no real-time priority: the system does not allow it")
        self._is_fresh = True
        self.name, self._link, self._vehicle = name, link, vehicle
        self._watchdog = Watchdog(vehicle, team.limits)
        self.loop = loop

    def _grounded(self) -> Loop:
        """Return the loop of a robot that neither flies nor lands."""
        if self.loop is None:
            raise ValueError("the robot is not configured")
        if self.flies:
            raise ValueError("the robot has not landed yet: wait until its status says so")
        return self.loop

    def _land(self) -> None:
        if self.loop is not None and self.flies:
            self.loop.supervisor.land()

    def _release(self) -> None:
        """Destroy what `configure` created."""
        if self.loop is not None:
            self._watchdog.close()
        self.loop = None
        for destroy, one in self._own:
            destroy(one)
        self._own.clear()

    def _is_down(self) -> bool:
        assert self.loop is not None
        return self._off >= _DISARMS and self.loop.supervisor.shall_land

    def _after_period(self, loop: Loop) -> None:
        mode = loop.supervisor.mode
        self._watchdog.beat(armed=mode is not Mode.OFF)  # motors that have stopped shall not start again
        self._off += mode is Mode.OFF
        if mode is not self._mode:
            self._mode = mode
            self._log(f"{mode.name.lower()}: {', '.join(sorted(loop.supervisor.why)) or 'all is well'}")
        if isinstance(self._vehicle, Px4Vehicle) and 0 < self._offboard_at <= loop.link.now():
            self._offboard_at = 0
            self._vehicle.begin_offboard()
        self._tell()

    def _tell(self) -> None:
        """Publish the status once a second."""
        loop, now = self.loop, monotonic()
        if loop is None or now - self._told < _STATUS:
            return
        self._told = now
        counts, traffic, supervisor = loop.statistics.counts, self._link.traffic, loop.supervisor
        mode = supervisor.mode.name.lower() if self.flies else "idle"
        values = {
            "mode": mode,
            "why": ", ".join(sorted(supervisor.why)) if self.flies else "",
            "periods": counts["periods"],
            "missed": counts["missed"],
            "late commands": counts["late commands"],
            "plans sent": traffic.answers + traffic.announcements,
            "bytes": traffic.bytes,
            "last error": loop.statistics.last_error,
        }
        is_well = not self.flies or supervisor.mode is Mode.FLY or supervisor.shall_land
        stamp = self._link.shared(self._link.now())
        self._status.publish(to_diagnostics(self.name, 0 if is_well else 1, mode, values, stamp))

    def _take_goal(self, message: Any, handler: Handler) -> None:
        try:
            self._fly_to(message)
        except ValueError as error:
            self._log(f"goal refused: {error}")

    def _fly_to(self, message: Any) -> None:
        loop, place = self.loop, message.pose.position
        if message.header.frame_id != FRAME:
            raise ValueError(f"its frame is {shown(message.header.frame_id)}: give it in {FRAME!r}")
        goal = points("the goal", [[place.x, place.y, place.z]], 1)[0]
        if loop is None or not self.flies or loop.supervisor.shall_land or loop.supervisor.mode >= Mode.LAND:
            raise ValueError("the robot does not fly: activate it first")
        planner = loop.robot.config.planner
        low, high = np.array(planner.workspace_low), np.array(planner.workspace_high)
        if (goal < low).any() or (goal > high).any():
            raise ValueError(f"{goal.tolist()} is outside the workspace, {low.tolist()} to {high.tolist()}")
        loop.fly_to(goal)

    def _log(self, text: str) -> None:
        self.node.get_logger().warning(text)


def _lifecycle_node(robot: RobotNode, context: Any) -> Any:
    """Return a lifecycle node that hands its transitions to a robot's node."""
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    def taken(transition: Callable[[], None]) -> Any:
        try:
            transition()
        except Exception as error:  # of a policy or a planner from outside, too
            kind = "" if isinstance(error, (ValueError, OSError, ImportError)) else f"{type(error).__name__}: "
            robot.node.get_logger().error(f"{transition.__name__} refused: {kind}{error}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    class Node(LifecycleNode):
        def on_configure(self, state: Any) -> Any:
            return taken(robot.configure)

        def on_activate(self, state: Any) -> Any:
            return taken(robot.activate)

        def on_deactivate(self, state: Any) -> Any:
            return taken(robot.deactivate)

        def on_cleanup(self, state: Any) -> Any:
            return taken(robot.cleanup)

        def on_shutdown(self, state: Any) -> Any:
            return taken(robot.end)

    return Node("robot", context=context)


def main() -> int:
    """Run the node.

    :return: exit status
    """
    try:
        robot = RobotNode(sys.argv)
    except (ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: robot.end())
    robot.run()
    robot.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
