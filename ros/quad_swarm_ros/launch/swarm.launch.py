"""Start the simulated world and n robots, which configure and activate themselves:

ros2 launch quad_swarm_ros swarm.launch.py n_robots:=4 policy:=full
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

ARGUMENTS = {
    "n_robots": ("4", "number of robots"),
    "names": ("", "their names, separated by commas; robot_0, robot_1, ... if empty"),
    "policy": ("full", "a rule, or the folder of an exported model"),
    "preset": ("flight-v2", "the world"),
    "vehicle": ("odometry", "odometry, crazyswarm, crazyswarm_legacy, px4 or aerostack"),
    "scenario": ("symmetric_swap", "where simulated robots start"),
    "plant": ("", "simulated vehicle, such as crazyflow:cf21B_500; the preset's if empty"),
    "simulated": ("true", "whether to start the simulated world"),
    "parameters": ("", "file with more parameters of all robots; they replace those above"),
    "autostart": ("", "whether robots configure and activate themselves in the air; if empty, simulated ones do"),
    "priority": ("0", "real-time priority of the robots, 1 to 99; 0 for none"),
}
_LANDS = "30"  # s after Ctrl-C before a robot that still lands is killed


def robot(name, names, values):
    """Return the action that starts a robot's node, which configures and activates itself."""
    parameters = {
        "names": names,
        "policy": values["policy"],
        "preset": values["preset"],
        "vehicle": values["vehicle"],
        "priority": int(values["priority"]),
        "autostart": (values["autostart"] or values["simulated"]) == "true",
    }
    files = [values["parameters"]] if values["parameters"] else []
    return LifecycleNode(
        package="quad_swarm_ros",
        executable="robot",
        name="robot",
        namespace=name,
        parameters=[parameters, *files],
        sigterm_timeout=_LANDS,
        sigkill_timeout=_LANDS,
        output="screen",
    )


def start(context):
    """Return the actions for the arguments of the launch."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    names = values["names"].split(",") if values["names"] else [f"robot_{k}" for k in range(int(values["n_robots"]))]
    world = {"names": names, "preset": values["preset"], "scenario": values["scenario"], "plant": values["plant"]}
    plant = Node(
        package="quad_swarm_ros",
        executable="plant",
        name="world",
        parameters=[world],
        sigterm_timeout=_LANDS,
        output="screen",
        condition=IfCondition(values["simulated"]),
    )
    return [plant, *(robot(name, names, values) for name in names)]


def generate_launch_description():
    """Return the description that `ros2 launch` asks for."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
