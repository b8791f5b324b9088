"""Start the simulated world and n robots, and configure and activate them:

ros2 launch quad_swarm_ros swarm.launch.py n_robots:=4 policy:=full
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler, TimerAction
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition

ARGUMENTS = {
    "n_robots": ("4", "number of robots"),
    "policy": ("full", "a rule, or the folder of an exported model"),
    "preset": ("flight", "the world"),
    "vehicle": ("odometry", "odometry, crazyswarm, crazyswarm_legacy, px4 or aerostack"),
    "scenario": ("symmetric_swap", "where simulated robots start"),
    "plant": ("", "simulated vehicle, such as crazyflow:cf21B_500; the preset's if empty"),
    "simulated": ("true", "whether to start the simulated world"),
    "priority": ("0", "real-time priority of the robots, 1 to 99; 0 for none"),
}
_LANDS = "30"  # s after Ctrl-C before a robot that still lands is killed
_PERCEIVES = 2.0  # s that a configured robot has to perceive the others


def robot_actions(names, index, values):
    """Return the actions that start a robot's node, and configure and activate it."""
    parameters = {
        "names": names,
        "index": index,
        "policy": values["policy"],
        "preset": values["preset"],
        "vehicle": values["vehicle"],
        "priority": int(values["priority"]),
    }
    node = LifecycleNode(
        package="quad_swarm_ros",
        executable="robot",
        name="robot",
        namespace=names[index],
        parameters=[parameters],
        sigterm_timeout=_LANDS,
        sigkill_timeout=_LANDS,
        output="screen",
    )

    def change(transition):
        return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition))

    activate = TimerAction(period=_PERCEIVES, actions=[change(Transition.TRANSITION_ACTIVATE)])
    when_configured = OnStateTransition(
        target_lifecycle_node=node, start_state="configuring", goal_state="inactive", entities=[activate]
    )
    return [RegisterEventHandler(when_configured), node, change(Transition.TRANSITION_CONFIGURE)]


def start(context):
    """Return the actions for the arguments of the launch."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    names = [f"robot_{k}" for k in range(int(values["n_robots"]))]
    world = {"names": names, "preset": values["preset"], "scenario": values["scenario"], "plant": values["plant"]}
    plant = Node(
        package="quad_swarm_ros",
        executable="plant",
        name="world",
        parameters=[world],
        output="screen",
        condition=IfCondition(values["simulated"]),
    )
    return [plant, *(action for k in range(len(names)) for action in robot_actions(names, k, values))]


def generate_launch_description():
    """Return the description that `ros2 launch` asks for."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
