"""The node of a robot: its parameters, its life, its goals."""

import json
import math
import re
import runpy
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import yaml
from network import alone

pytest.importorskip("rclpy")

from quad_swarm.evaluation.export import export
from quad_swarm.realtime import Mode
from quad_swarm.realtime.link import monotonic
from quad_swarm.ros import plant_node
from quad_swarm.ros.messages import msgs
from quad_swarm.ros.node import make_node, quality
from quad_swarm.ros.robot_node import PARAMETERS, RobotNode, check_walls
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import make_config
from sb3_maddpg.hub.pretrained import pretrained_folder

ROOT = Path(__file__).parents[3]
GOOD = {"policy": "full", "names": ["robot_0", "robot_1"], "index": 0}
PILLAR = "obstacles.listed=[{position: [1, 0, 0], radius: 0.3}]"
OUTSIDE = {"world": ["radius=0.3"], "limits": ["room=null"]}
MOVING = "obstacles.listed=[{position: [0, 3, 0], radius: 0.2, velocity: [1, 0, 0]}]"


@pytest.fixture
def make(monkeypatch):
    """Makes nodes that nobody sees."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    made = []

    def node(namespace="/robot_0", **parameters):
        given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
        made.append(RobotNode(["robot", "--ros-args", "-r", f"__ns:={namespace}", *given]))
        return made[-1]

    yield node
    for one in made:
        one.close()


def goal_of(robot):
    """Where a robot flies to from the next period on."""
    loop = robot.loop
    return loop.robot.goal[0, 0] if loop._next is None else loop._next[0]


def topics(robot):
    names = ("srv_name", "topic_name")
    return {getattr(one, name) for _, one in robot._mailbox.entities() for name in names if hasattr(one, name)}


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"policy": "ful"}, "ful"),
        ({"world": [MOVING]}, "nodes that start at different times do not agree"),
        ({"policy": 3}, "policy"),
        ({"preset": "fligth"}, "Did you mean 'flight'"),
        ({"world": ["radius"]}, "world 'radius': write NAME=VALUE"),
        ({"world": ["radius=-1"]}, "radius"),
        ({"names": []}, "names of all robots"),
        ({"names": ["robot_0", "robot_0"]}, "each once"),
        ({"names": ["robot_0", "a b"]}, "'a b' is no name"),
        ({"index": 2}, "index=2: give the robot's place"),
        ({"names": ["robot_1", "robot_2"], "index": -1}, "start the node with -r __ns:=/NAME"),
        ({"index": True}, "index=True"),
        ({"index": 1}, "start it with -r __ns:=/robot_1"),
        ({"wait": 0.2}, "waiting must end within the period"),
        ({"late": "soon"}, "late"),
        ({"priority": 100}, "priority"),
        ({"limits": ["stale=2"]}, "hovers before it lands"),
        ({"limits": ["stale=.nan"]}, "stale"),
        ({"limits": ["stall=2"]}, "stall"),
        ({"vehicle": "crazy"}, "Unknown vehicle 'crazy'"),
        ({"twist": "map"}, "choose 'body' or 'world'"),
        ({**OUTSIDE, "vehicle": "aerostack"}, "give the largest thrust"),
        ({**OUTSIDE, "vehicle": "px4", "origins": [0.0, 0.0]}, "origins=[0.0, 0.0]: give finite numbers, 3 for each"),
        ({**OUTSIDE, "vehicle": "px4", "origins": [0.0, 0.0, 0.0]}, "each of 2 robots"),
        ({"gains": ["hover_thrust=2"]}, "hover_thrust"),
        ({"heading": "north"}, "heading='north': give a finite number"),
        ({"goal": [0.0, 0.0]}, "goal=[0.0, 0.0]: give finite numbers, 3 for each point"),
        ({"goal": [0.0] * 6}, "give one point"),
        ({"goal": [0.0, 0.0, 90.0]}, "outside the workspace"),
        ({"world": [PILLAR], "goal": [1.0, 0.2, 1.0]}, "0.1 m inside obstacle 0"),
        ({"autostart": 1}, "autostart=1: give true or false"),
        ({"polcy": "full"}, "Unknown parameter 'polcy'"),
        ({"use_sim_time": True}, "robots fly in real time here"),
    ],
)
def test_what_is_wrong_is_told_and_nothing_stays(make, wrong, reason):
    robot = make(**{**GOOD, **wrong})
    before = topics(robot)
    with pytest.raises(ValueError, match=re.escape(reason)):
        robot.configure()
    assert robot.loop is None
    assert topics(robot) == before


def test_missing_messages_are_told(make, monkeypatch):
    monkeypatch.setitem(sys.modules, "as2_msgs.msg", None)
    robot = make(**GOOD, **OUTSIDE, vehicle="aerostack", most_thrust=20.0)
    before = topics(robot)
    with pytest.raises(ImportError, match="as2_msgs is not there: build it"):
        robot.configure()
    assert topics(robot) == before


@pytest.fixture(scope="module")
def transitions():
    from rclpy.lifecycle import TransitionCallbackReturn

    return TransitionCallbackReturn


def see(robot, age=0, height=1.5):
    """Let the robot perceive both, some time ago (us)."""
    for k in range(2):
        state = np.zeros(9)
        state[:3] = 3.0 * k, 0, height
        robot._vehicle._states[k] = monotonic() - age, state


def hear(robot, node):
    """Let a node receive the robot's commands."""
    node.create_subscription(msgs().TwistStamped, "/robot_0/cmd", lambda message: None, 10)
    while robot._vehicle.unheard():
        robot._mailbox.wait(monotonic() + 10_000, robot.loop)


def goal(x, y, z, frame="map"):
    message = msgs().PoseStamped()
    message.header.frame_id = frame
    message.pose.position.x, message.pose.position.y, message.pose.position.z = float(x), float(y), float(z)
    return message


def test_a_robot_begins_to_fly_in_the_air_if_it_sees_everybody(make, transitions, capfd):
    robot = make(**GOOD)
    node, before = robot.node, topics(robot)
    assert node.trigger_configure() == transitions.SUCCESS
    assert {"/robot_0/goal_pose", "/robot_0/robot/status", "/robot_0/cmd", "/robot_1/odom"} <= topics(robot)

    def refused():
        result, error = node.trigger_activate(), capfd.readouterr().err
        assert result == transitions.FAILURE
        assert not robot.flies
        return error

    assert "no state of each robot has arrived" in refused()
    see(robot, age=5_000_000)
    assert "limits.stale=0.2" in refused()
    robot.loop.supervisor.limits = replace(robot.loop.supervisor.limits, stale=1.0)
    see(robot, height=0.05)
    assert "take off first" in refused()
    see(robot)
    assert "robot_1 does not listen: configure all robots first" in refused()
    other = make_node("robot", "robot_1", node.context)
    other.create_subscription(msgs().Header, "/robot_1/plan_requests", lambda message: None, quality(2))
    while robot._link.absent():
        robot._mailbox.wait(monotonic() + 10_000, robot.loop)
    see(robot)
    assert "nobody receives /robot_0/cmd: start what flies the vehicle" in refused()
    hear(robot, other)
    see(robot, height=9.0)
    assert "outside the fence" in refused()
    see(robot)
    assert node.trigger_activate() == transitions.SUCCESS
    assert robot.flies
    np.testing.assert_allclose(goal_of(robot), [0, 0, 1.5])

    for message, reason in (
        (goal(1, 0, 1, "odom"), "its frame is 'odom': give it in 'map'"),
        (goal(1, 0, 1, ""), "its frame is ''"),
        (goal(np.nan, 0, 1), "finite"),
        (goal(0, np.inf, 1), "finite"),
        (goal(0, 0, 90), "outside the workspace"),
    ):
        robot._take_goal(message, None)
        assert reason in capfd.readouterr().err
        np.testing.assert_allclose(goal_of(robot), [0, 0, 1.5])
    robot._take_goal(goal(1, 0.5, 1.2), None)
    np.testing.assert_allclose(goal_of(robot), [1, 0.5, 1.2])
    turned = goal(1, 0.5, 1.2)
    turned.pose.orientation.z, turned.pose.orientation.w = math.sin(0.5), math.cos(0.5)
    robot._take_goal(turned, None)
    assert robot.loop._next[3] is None, "it may not turn"
    config = make_config(robot.loop.robot.config, planner={"max_yaw_rate": 1.0})
    robot.loop.robot.config = config
    robot._take_goal(turned, None)
    assert robot.loop._next[3] == pytest.approx(1.0)
    turned.pose.orientation.w = 5.0
    robot._take_goal(turned, None)
    assert "is no rotation" in capfd.readouterr().err
    turned.pose.orientation.z = turned.pose.orientation.w = 0.0
    robot._take_goal(turned, None)
    assert robot.loop._next[3] is None, "no heading is asked for"

    assert node.trigger_deactivate() == transitions.SUCCESS
    assert robot.loop.supervisor.shall_land
    assert node.trigger_cleanup() == transitions.FAILURE
    assert "has not landed yet" in capfd.readouterr().err
    robot._take_goal(goal(1, 0.5, 1.2), None)
    assert "activate it first" in capfd.readouterr().err
    see(robot, height=0.05)
    robot.end()
    robot.run()
    assert robot.loop.supervisor.mode is Mode.OFF
    assert not robot.flies
    assert node.trigger_cleanup() == transitions.SUCCESS
    assert topics(robot) == before
    assert node.trigger_configure() == transitions.SUCCESS


def test_a_robot_that_has_landed_is_inactive_and_may_begin_again(make, transitions):
    """Whoever made it land: here a service, and the parameters give it a goal."""
    from std_srvs.srv import Trigger

    robot = make(**GOOD | {"index": -1}, goal=[1.0, 0.5, 1.2])
    node = robot.node
    assert node.trigger_configure() == transitions.SUCCESS
    other = make_node("robot", "robot_1", node.context)
    other.create_subscription(msgs().Header, "/robot_1/plan_requests", lambda message: None, quality(2))
    while robot._link.absent():
        robot._mailbox.wait(monotonic() + 10_000, robot.loop)
    hear(robot, other)
    assert not robot._take_wish(None, Trigger.Response()).success, "it does not fly"
    for _ in range(2):
        see(robot)
        assert node.trigger_activate() == transitions.SUCCESS
        np.testing.assert_allclose(goal_of(robot), [1, 0.5, 1.2])
        assert robot._take_wish(None, Trigger.Response()).success
        see(robot, height=0.05)
        robot._leaves = True
        robot.run()
        assert not robot.flies
        robot._leaves = robot._ended = False
    assert node.trigger_deactivate() == transitions.ERROR, "it is inactive already"
    robot.end()
    with pytest.raises(SystemExit):
        robot.end()  # for the second time


# Limits that a busy machine does not reach
LIMITS = ["stale=60", "lost=60", "frozen=60", "unanswered=60", "silence=200", "hung=60", "landing_time=200"]
BEGIN = f"""
import sys
sys.path.insert(0, {str(ROOT / "examples")!r})
import numpy as np
from ros2_nodes import Operator, swap

LIMITS = {LIMITS}
"""
LIFE = (
    BEGIN
    + """
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters

def log():
    return open("robot_0.log").read()

with Operator(["robot_0", "robot_1"]) as operator:
    operator.start_robot("robot_0", open("robot_0.log", "wb"), policy="ful", limits=LIMITS)
    assert not operator.change("robot_0", "configure")
    operator.wait(lambda: "configure refused" in log() and "'ful'" in log())
    client = operator.node.create_client(SetParameters, "/robot_0/robot/set_parameters")
    operator.wait(client.service_is_ready)
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="full")
    future = client.call_async(SetParameters.Request(parameters=[Parameter(name="policy", value=value)]))
    operator.wait(future.done)
    assert operator.change("robot_0", "configure")
    assert not operator.change("robot_0", "activate"), "nobody publishes any state"
    operator.start_robot("robot_1", policy="full", limits=LIMITS)
    assert operator.change("robot_1", "configure")
    operator.start_world(scenario="random", seed=3)
    for name in operator.names:
        operator.activate(name)
    start = operator.position["robot_0"].copy()
    operator.send("robot_0", start, "odom")
    operator.send("robot_0", [np.nan, 0, 1])
    operator.wait(lambda: "its frame is 'odom'" in log() and "finite" in log())
    goal = start + [0, 0, 0.5]
    operator.send("robot_0", goal)
    operator.wait(lambda: np.linalg.norm(operator.position["robot_0"] - goal) < 0.2)
    operator.wait(lambda: operator.told("robot_0", "mode") == "fly")
    assert {"why", "missed", "late commands", "plans sent", "bytes"} <= operator.status["robot_0"].keys()
    assert operator.change("robot_0", "deactivate")
    operator.wait(lambda: operator.told("robot_0", "mode") == "idle")
    operator.wait(lambda: "robot_0" in (operator.told("world", "on the ground") or ""))
    assert operator.position["robot_0"][2] < 0.1
    assert operator.change("robot_0", "cleanup")
    operator.wait(lambda: operator.node.count_publishers("/robot_0/robot/status") == 0)
    assert operator.change("robot_0", "configure")
    assert not operator.change("robot_0", "activate"), "it lies on the ground"
    process = operator.processes.pop("robot_1")
    process.terminate()
    operator.wait(lambda: process.poll() is not None)
    assert process.returncode == 0
    operator.wait(lambda: operator.told("world", "on the ground") == "robot_0 robot_1")
"""
)
SWAP = (
    BEGIN
    + """
with Operator([f"robot_{k}" for k in range(4)]) as operator:
    operator.start_world(scenario="symmetric_swap")
    errors = swap(operator, "full", limits=LIMITS)
    assert max(errors) < 0.3, errors
    assert operator.told("world", "collisions") == "", operator.status
"""
)


def run(script, folder):
    done = subprocess.run([*alone(), sys.executable, "-c", script], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_life(tmp_path):
    run(LIFE, tmp_path)


def test_the_launch_file_gives_the_nodes_their_parameters(monkeypatch):
    """What it imports stands in here: it is no wheel."""
    made = []

    def module(name, *names):
        one = ModuleType(name)
        for each in names:
            setattr(one, each, lambda *args, each=each, **options: made.append((each, args, options)) or made[-1])
        monkeypatch.setitem(sys.modules, name, one)
        return one

    module("launch", "LaunchDescription")
    module("launch.actions", "DeclareLaunchArgument", "OpaqueFunction")
    module("launch.conditions", "IfCondition")
    module("launch_ros.actions", "LifecycleNode", "Node")
    values = {"n_robots": "3"}
    substitutions = module("launch.substitutions")
    path = ROOT / "ros" / "quad_swarm_ros" / "launch" / "swarm.launch.py"
    substitutions.LaunchConfiguration = lambda name: SimpleNamespace(
        perform=lambda context: values.get(name, launch["ARGUMENTS"][name][0])
    )
    launch = runpy.run_path(str(path))
    launch["generate_launch_description"]()
    launch["start"](None)
    (plant,) = (options["parameters"][0] for kind, _, options in made if kind == "Node")
    assert plant.keys() <= plant_node.PARAMETERS.keys()
    robots = [options for kind, _, options in made if kind == "LifecycleNode"]
    assert [one["namespace"] for one in robots] == ["robot_0", "robot_1", "robot_2"]
    for one in robots:
        assert one["parameters"][0].keys() <= PARAMETERS.keys()
        assert one["parameters"][0]["names"] == ["robot_0", "robot_1", "robot_2"]
        assert one["parameters"][0]["autostart"] is True
    made.clear()
    values["simulated"] = "false"
    launch["start"](None)
    started = [options["parameters"][0]["autostart"] for kind, _, options in made if kind == "LifecycleNode"]
    assert started == [False] * 3


def test_real_vehicles_say_how_large_their_room_is(make, monkeypatch):
    monkeypatch.setattr("quad_swarm.ros.robot_node.make_vehicle", lambda robot, values, period: SimpleNamespace())
    given = {**GOOD, "vehicle": "crazyswarm"}
    for parameters, reason in (
        ({}, "world: give your robots' radius"),
        ({"world": ["radius=0.2"]}, "limits: give the lowest and the highest corner between your walls"),
        ({"world": ["radius=0.2"], "limits": ["room=[[-5,-5,0],[5,5,3]]"]}, "needs 4.8 m to stop"),
    ):
        with pytest.raises(ValueError, match=re.escape(reason)):
            make(**given, **parameters).configure()
    check_walls(["radius=0.2"], {"room": None})


@pytest.mark.slow
def test_four_exchange_their_places(tmp_path):
    run(SWAP, tmp_path)


ALONE = (
    BEGIN
    + """
with Operator(["robot_0", "robot_1"]) as operator:
    goals = {"robot_0": [1.0, 0.5, 1.5], "robot_1": [-1.0, 0.5, 1.5]}
    starts = [-1.0, -0.5, 1.2, 1.0, -0.5, 1.2]
    for name, goal in goals.items():
        operator.start_robot(name, policy="full", limits=LIMITS, goal=goal, index=-1, autostart=True)
    operator.start_world(starts=starts)
    there = lambda: operator.position and all(
        np.linalg.norm(np.subtract(operator.position.get(name, np.inf), goal)) < 0.2 for name, goal in goals.items()
    )
    operator.wait(there)
    assert operator.trigger("/robot_0/robot/land")
    operator.wait(lambda: operator.told("robot_0", "mode") == "idle")
    operator.wait(lambda: operator.told("world", "on the ground") == "robot_0")
    operator.wait(lambda: operator.state("robot_0") == "inactive")
    assert not operator.trigger("/robot_0/robot/land"), "it does not fly"
    assert operator.trigger("/world/reset")
    operator.wait(lambda: operator.change("robot_0", "activate"))
    operator.wait(there)
    assert operator.told("world", "collisions") == ""
"""
)


@pytest.mark.slow
def test_robots_start_by_themselves_land_by_a_service_and_fly_again(tmp_path):
    run(ALONE, tmp_path)


def test_the_file_of_the_walk_through_configures_a_robot_with_an_exported_policy(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    page = (ROOT / "docs" / "ros2.md").read_text()
    (text,) = (block for block in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "ros__parameters" in block)
    parameters = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert parameters["vehicle"] == "crazyswarm"
    tutorial = (ROOT / "docs" / "tutorials" / "robots.md").read_text()
    (room,) = re.findall(r"ROOM=\((.*?)\)\n", tutorial, re.DOTALL)
    (pillar,) = re.findall(r"# A pillar: ROOM\+=\((.*?)\)\n", tutorial)
    assert sorted(parameters["world"]) == sorted([*shlex.split(f"{room} {pillar}"), "planner.downwash=3"])
    config = make_config(
        PARAMETERS["preset"],
        read_assignments("world", parameters["world"]),
        n_robots=len(parameters["names"]),
    )
    export(str(pretrained_folder("quad-swarm-flight-v2") / "model.zip"), config, tmp_path / "robots")
    monkeypatch.chdir(tmp_path)
    # Crazyswarm2's messages are no wheel
    assert parameters["poses"] == "/poses"
    here = text.replace("vehicle: crazyswarm", "vehicle: odometry").replace("policy: full", "policy: robots")
    here = re.sub(r" *poses: /poses\n", "", here)
    Path("robots.yaml").write_text(here)
    node = RobotNode(["robot", "--ros-args", "-r", "__ns:=/cf1", "--params-file", "robots.yaml"])
    try:
        node.configure()
        assert node.loop.robot.config.quadrotor == config.quadrotor
        assert node.loop.supervisor.limits.room == ((-3, -3, 0), (3, 3, 3))
    finally:
        node.close()
