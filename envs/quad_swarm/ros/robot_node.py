"""A robot as a lifecycle node, ``python -m quad_swarm.ros.robot_node --ros-args -r __ns:=/NAME -p NAME:=VALUE ...``.

============== ==============================================================================================
transition     what it does
============== ==============================================================================================
``configure``  reads the parameters, checks them, subscribes and publishes, and warms up
``activate``   begins to fly to ``goal``, or holds its place, if the states of all robots are fresh, it is in the air,
               everybody is configured and no guard objects. Taking off is the autopilot's or the operator's
``deactivate`` begins to land; the robot disarms on the ground, and is not activated or cleaned up before
``cleanup``    destroys publishers, subscriptions and services
``shutdown``   lands and ends the process, as SIGINT and SIGTERM do; a second signal ends it at once
============== ==============================================================================================

A robot that has landed for another reason becomes inactive by itself. With ``autostart``, it configures itself, and
activates itself once as soon as it may. Besides the topics of `RosLink` and those of the vehicle, there are

====================== =================================== ==================================================
name                   type                                content
====================== =================================== ==================================================
``/NAME/goal_pose``    geometry_msgs/PoseStamped           where to fly, in the frame "map", and with
                                                           ``planner.max_yaw_rate`` which heading to turn to
``/NAME/robot/status`` diagnostic_msgs/DiagnosticArray     once a second: what the robot does, why, and counts
``/NAME/robot/land``   std_srvs/Trigger (a service)        begins to land, as ``deactivate`` does
====================== =================================== ==================================================

A wish to land must not get lost and wants an answer, so it is a service, as with Crazyswarm2 and Aerostack2. Its name
is below the node's, as that of the status is, since Crazyswarm2 has a service ``/NAME/land`` and a topic
``/NAME/status`` of other types.
"""

from __future__ import annotations

import importlib
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.geometry import from_quaternion
from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime.attitude import AttitudeController, AttitudeGains
from quad_swarm.realtime.link import Handler, monotonic
from quad_swarm.realtime.loop import Loop, freeze_garbage, thaw_garbage
from quad_swarm.realtime.process import prepare
from quad_swarm.realtime.supervisor import Mode, SafetyLimits, Supervisor
from quad_swarm.realtime.team import Team
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.messages import FRAME, msgs, to_diagnostics
from quad_swarm.ros.node import (
    Mailbox,
    Nobody,
    checked_names,
    declare,
    leave,
    make_context,
    numbers,
    quality,
    standing,
    texts,
    values_of,
)
from quad_swarm.ros.vehicles import (
    AerostackVehicle,
    CrazyswarmVehicle,
    LegacyCrazyswarmVehicle,
    OdometryVehicle,
    Px4Vehicle,
    TeamVehicle,
)
from quad_swarm.validation import read_assignments
from quad_swarm.world.obstacles import surroundings
from quad_swarm.world.presets import REAL_TIME, SwarmConfig, make_config, points

PARAMETERS: dict[str, Any] = {
    "policy": "",
    "modules": [],
    "preset": REAL_TIME,
    "world": [],
    "names": [],
    "index": -1,
    "vehicle": "odometry",
    "wait": 0.005,
    "late": 0.25,
    "priority": 0,
    "limits": [],
    "goal": [],
    "autostart": False,
    # Of vehicles, which need some of them
    "odom_topic": "odom",
    "twist": "body",
    "poses": "",
    "origins": [],
    "most_thrust": 0.0,
    "gains": [],
    "heading": [],
}
# Vehicles that are not simulated
REAL = ("crazyswarm", "crazyswarm_legacy", "px4", "aerostack")
_IDLE = 100_000  # us after which a node without a flight looks around
_STATUS = 1_000_000  # us


def make_vehicle(robot: tuple[Any, Mailbox, RosLink, list[str]], values: dict[str, Any], period: int) -> TeamVehicle:
    """Create the vehicle that the parameters name.

    :param robot: node, mailbox, link and names, see `OdometryVehicle`
    :param values: the parameters
    :param period: length of a period (us)
    :raises ValueError: if it is unknown, or one of its own parameters is wrong
    :raises ImportError: if the package of its messages is not there
    """
    places = numbers("origins", values["origins"], 3)
    thrust = float(numbers("most_thrust", [values["most_thrust"]], 1)[0, 0])
    heading = float(numbers("heading", [values["heading"]], 1)[0, 0]) if np.size(values["heading"]) else None
    gains = AttitudeGains(**read_assignments("gains", texts("gains", values["gains"])))
    controller = AttitudeController(gains)
    makers: dict[str, Callable[[], TeamVehicle]] = {
        "odometry": lambda: OdometryVehicle(*robot, topic=values["odom_topic"], twist=values["twist"]),
        "crazyswarm": lambda: CrazyswarmVehicle(*robot, period=period, controller=controller),
        "crazyswarm_legacy": lambda: LegacyCrazyswarmVehicle(*robot, controller=controller),
        "px4": lambda: Px4Vehicle(*robot, origins=places, controller=controller),
        "aerostack": lambda: AerostackVehicle(*robot, most_thrust=thrust, controller=controller),
    }
    if values["vehicle"] not in makers:
        raise unknown_name("vehicle", values["vehicle"], makers)
    vehicle = makers[values["vehicle"]]()
    vehicle.heading = heading
    if values["poses"]:
        vehicle.watch_poses(values["poses"])
    return vehicle


def check_walls(world: Sequence[str], limits: Mapping[str, Any]) -> None:
    """Check that whoever starts real vehicles has said how large their room is.

    :raises ValueError: if there is no field of the world, or no ``room`` among the limits
    """
    if not world:
        raise ValueError(
            "world: give your robots' radius, planner.max_speed and workspace, as in "
            '["radius=0.15", "planner.max_speed=1", "planner.workspace_low=[-2,-2,0.5]", ...]; those of the preset are '
            "another room's"
        )
    if "room" not in limits:
        raise ValueError(
            'limits: give the lowest and the highest corner between your walls, as in ["room=[[-3,-3,0],[3,3,3]]", '
            '"fence=0.3"], or ["room=null"] where there are none'
        )


def reachable(goal: Any, config: SwarmConfig, robot: int) -> np.ndarray:
    """Return a goal of a robot that lies in the workspace and beside the obstacles, (3,) (m).

    :raises ValueError: if it does not, or is no finite point
    """
    goal = points("the goal", np.asarray(goal, float)[None], 1)[0]
    low, high = np.array(config.planner.workspace_low), np.array(config.planner.workspace_high)
    if (goal < low).any() or (goal > high).any():
        raise ValueError(f"{goal.tolist()} is outside the workspace, {low.tolist()} to {high.tolist()}")
    config.check_clear("goal", goal[None], surroundings(config.obstacles.listed), slice(robot, robot + 1))
    return goal


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
        self.flies = self._ended = self._leaves = self._is_fresh = self._is_active = False
        self._starts, self._refused = self.node.get_parameter("autostart").value is True, ""
        self._own: list[tuple[Callable[[Any], Any], Any]] = []
        self._told, self._mode = 0, Mode.OFF

    def run(self) -> None:
        """Run until `end` or the transition ``shutdown``."""
        if self._starts:
            self.node.trigger_configure()
        while not self._ended:
            loop = self.loop
            if loop is not None and self.flies:
                loop.run(self._has_landed, self._after_period)
                self._watchdog.beat(armed=False)
                self.flies = False
                self._log(f"landed ({loop.statistics.counts['periods']} periods flown)")
                if self._is_active:  # nobody deactivated it
                    self.node.trigger_deactivate()
            else:
                if self._is_fresh:
                    self._is_fresh = False
                    freeze_garbage()
                self._mailbox.wait(monotonic() + _IDLE, loop or Nobody(), lambda: self.flies or self._leaves)
                if self._tell() and self._starts and not self._leaves:
                    self.node.trigger_activate()
            self._ended = self._leaves and not self.flies

    def end(self) -> None:
        """Land if the robot flies, and end `run`.

        :raises SystemExit: if that has been called before
        """
        if self._leaves:
            raise SystemExit(1)
        self._leaves = True
        self.land()

    def close(self) -> None:
        """Release everything."""
        self._release()
        self._mailbox.close()

    def configure(self) -> None:
        """Take the transition ``configure``.

        :raises ValueError: if a parameter is wrong
        :raises ImportError: if a package of messages, or one of the modules, is not there
        :raises OSError: if the folder of a model cannot be read
        """
        if self.flies:
            raise ValueError("the robot has not landed yet: wait until its status says so")
        before = {id(one) for _, one in self._mailbox.entities()}
        try:
            self._configure(values_of(self.node, PARAMETERS))
        finally:
            self._own += [(destroy, one) for destroy, one in self._mailbox.entities() if id(one) not in before]
            if self.loop is None:
                self._release()

    def activate(self) -> None:
        """Take the transition ``activate``.

        :raises ValueError: if the robot must not begin to fly
        """
        loop = self._grounded()
        sensed = loop.ready()
        if absent := self._link.absent():
            raise ValueError(f"{absent[0]} does not listen: configure all robots first")
        if unheard := self._vehicle.unheard():
            raise ValueError(
                f"nobody receives {', '.join(unheard)}: start what flies the vehicle, with the same middleware, and "
                f"compare both ends by `ros2 topic info -v {unheard[0]}`"
            )
        own = sensed.state[POSITION].copy()
        goal, first = own if self._goal is None else self._goal, loop.link.now() + loop.robot.period
        loop.start(own, goal, first, heading=float(sensed.state[8]))
        self._vehicle.engage()
        self._mode = Mode.FLY
        self.flies = self._is_active = True
        self._starts = False

    def deactivate(self) -> None:
        """Take the transition ``deactivate``: begin to land."""
        self._is_active = False
        self.land()

    def cleanup(self) -> None:
        """Take the transition ``cleanup``.

        :raises ValueError: if the robot flies or lands
        """
        self._grounded()
        self._starts = False
        self._release()

    def land(self) -> bool:
        """Begin to land. Return whether the robot flies."""
        if self.loop is not None and self.flies:
            self.loop.supervisor.land()
        return self.flies

    def refuse(self, transition: str, reason: str) -> None:
        """Tell why a transition is refused, but not again and again while the robot starts by itself."""
        if not self._starts or transition not in self._refused:
            self.node.get_logger().error(f"{transition} refused: {reason}")
        self._refused = f"{transition} refused: {reason}"

    def _configure(self, values: dict[str, Any]) -> None:
        from std_srvs.srv import Trigger

        for module in texts("modules", values["modules"]):
            importlib.import_module(module)
        names, index = checked_names(values["names"]), values["index"]
        config = make_config(
            values["preset"], read_assignments("world", texts("world", values["world"])), n_robots=len(names)
        )
        standing(config)
        given = read_assignments("limits", texts("limits", values["limits"]))
        if values["vehicle"] in REAL:
            check_walls(values["world"], given)
        limits = SafetyLimits(**given)
        team = Team(config, values["policy"], limits, values["wait"], values["late"], priority=values["priority"])
        if index == -1 and (place := self.node.get_namespace().strip("/")) in names:
            index = names.index(place)
        if type(index) is not int or not 0 <= index < len(names):
            raise ValueError(
                f"index={shown(index)}: give the robot's place among the {len(names)} names, from 0, or start the node "
                "with -r __ns:=/NAME"
            )
        name = names[index]
        if self.node.get_namespace() != f"/{name}":
            raise ValueError(
                f"the node's namespace is {self.node.get_namespace()}: start it with -r __ns:=/{name}, so that robots "
                "have services of their own"
            )
        if type(values["autostart"]) is not bool:
            raise ValueError(f"autostart={shown(values['autostart'])}: give true or false")
        Supervisor(config, limits, index)  # what does not fit is told also where the vehicle's messages are missing
        goals = numbers("goal", values["goal"], 3)
        if len(goals) > 1:
            raise ValueError(f"goal={shown(values['goal'])}: give one point")
        self._goal = reachable(goals[0], config, index) if len(goals) else None
        link = RosLink(self.node, self._mailbox, index, names)
        period = round(config.planner.dt * 1e6)
        vehicle = make_vehicle((self.node, self._mailbox, link, names), values, period)
        self._status = self.node.create_publisher(
            msgs().DiagnosticArray, f"/{name}/robot/status", quality(5, reliable=True)
        )
        # Goals must arrive; whoever sends one to a robot that does not fly yet is told so by the log
        self._mailbox.subscribe(msgs().PoseStamped, f"/{name}/goal_pose", 10, self._take_goal)
        self.node.create_service(Trigger, "~/land", self._take_wish)
        self.name, self._link, self._vehicle = name, link, vehicle
        self.loop, self._watchdog = prepare(team, link, vehicle)
        self._is_fresh = True

    def _grounded(self) -> Loop:
        """Return the loop of a robot that neither flies nor lands."""
        if self.loop is None:
            raise ValueError("the robot is not configured")
        if self.flies:
            raise ValueError("the robot has not landed yet: wait until its status says so")
        return self.loop

    def _release(self) -> None:
        """Destroy what `configure` created."""
        if self.loop is not None:
            self._watchdog.close()
        self.loop = None
        for destroy, one in self._own:
            destroy(one)
        self._own.clear()
        self._is_fresh = False
        thaw_garbage()

    def _has_landed(self) -> bool:
        return self.loop is not None and self.loop.has_landed

    def _after_period(self, loop: Loop) -> None:
        mode = loop.supervisor.mode
        self._watchdog.beat(armed=mode is not Mode.OFF)  # motors that have stopped shall not start again
        if mode is not self._mode:
            self._mode = mode
            self._log(f"{mode.name.lower()}: {', '.join(sorted(loop.supervisor.why)) or 'all is well'}")
        self._tell()

    def _tell(self) -> bool:
        """Publish the status once a second. Return whether that was now."""
        loop, now = self.loop, monotonic()
        if loop is None or now - self._told < _STATUS:
            return False
        self._told = now
        counts, traffic, supervisor = loop.statistics.counts, self._link.traffic, loop.supervisor
        mode = supervisor.mode.name.lower() if self.flies else "idle"
        values = {
            "mode": mode,
            "why": ", ".join(sorted(supervisor.why)) if self.flies else "",
            "periods": counts["periods"],
            "missed": counts["missed"],
            "late commands": counts["late commands"],
            "age of plans (ms)": f"{loop.statistics.durations['plan_age'].quantile(0.5) * 1e-3:.0f}",
            "plans sent": traffic.answers + traffic.announcements,
            "bytes": traffic.bytes,
            "last error": loop.statistics.last_error,
        }
        is_well = not self.flies or supervisor.mode is Mode.FLY or supervisor.shall_land
        stamp = self._link.shared(self._link.now())
        self._status.publish(to_diagnostics(self.name, 0 if is_well else 1, mode, values, stamp))
        return True

    def _take_goal(self, message: Any, handler: Handler) -> None:
        try:
            self._fly_to(message)
        except ValueError as error:
            self._log(f"goal refused: {error}")

    def _fly_to(self, message: Any) -> None:
        loop, place, turned = self.loop, message.pose.position, message.pose.orientation
        if message.header.frame_id != FRAME:
            raise ValueError(f"its frame is {shown(message.header.frame_id)}: give it in {FRAME!r}")
        if loop is None or not self.flies or loop.supervisor.shall_land or loop.supervisor.mode >= Mode.LAND:
            raise ValueError("the robot does not fly: activate it first")
        config, heading = loop.robot.config, None
        quaternion = np.array([turned.x, turned.y, turned.z, turned.w])
        if config.turning[loop.robot.index] and quaternion.any():  # who leaves it out asks for no heading
            heading = from_quaternion(quaternion)[2]
        loop.fly_to(reachable([place.x, place.y, place.z], config, loop.robot.index), heading=heading)

    def _take_wish(self, request: Any, response: Any) -> Any:
        response.success = self.land()
        response.message = "lands" if response.success else "the robot does not fly"
        return response

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
            robot.refuse(transition.__name__, f"{kind}{error}")
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

    :return: exit status, if it cannot start
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
    leave()


if __name__ == "__main__":
    sys.exit(main())
