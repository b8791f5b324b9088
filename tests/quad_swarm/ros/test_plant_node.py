"""The node of simulated vehicles. What flies in it: test_robot_node.py."""

import json

import numpy as np
import pytest

pytest.importorskip("rclpy")

from quad_swarm.realtime.link import monotonic
from quad_swarm.ros.messages import from_odometry, msgs, to_command
from quad_swarm.ros.node import make_context, make_node, quality
from quad_swarm.ros.plant_node import PlantNode

GOOD = {"names": ["a", "b"], "seed": 3}
MOVING = "obstacles.listed=[{position: [0, 3, 0], radius: 0.2, velocity: [1, 0, 0]}]"


@pytest.fixture
def make(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    made = []

    def plant(**parameters):
        given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
        node = make_node("world", context=make_context(["plant", "--ros-args", *given]))
        made.append(node)
        return PlantNode(node)

    yield plant
    for node in made:
        node.destroy_node()
        node.context.try_shutdown()


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"names": "a"}, "names='a': give a list of texts"),
        ({"seed": -1}, "seed=-1: give a whole number"),
        ({"scenario": "swop"}, "Unknown scenario 'swop'"),
        ({"world": ["radius=.inf"]}, "radius"),
        ({"plant": "gazebo:x"}, "gazebo"),
        ({"starts": [1.0, 2.0]}, "give finite numbers, 3 for each point"),
        ({"starts": [1.0, 2.0, 1.0]}, "starts"),
        ({"scenario": "doorway"}, "obstacles that are drawn here"),
        ({"world": ["obstacles.number=[1,1]"]}, "obstacles that are drawn here"),
        ({"world": [MOVING]}, "nodes that start at different times do not agree"),
        ({"policy": "full"}, "Unknown parameter 'policy'"),
    ],
)
def test_what_is_wrong_is_told(make, wrong, reason):
    with pytest.raises(ValueError, match=reason):
        make(**{**GOOD, **wrong})


def test_robots_are_held_until_their_first_command(make):
    """The node itself is the one that hears it and commands, beside it in its own wait."""
    plant = make(**GOOD)
    node, seen, told = plant._mailbox._node, {"a": [], "b": []}, []
    command = node.create_publisher(msgs().TwistStamped, "/a/cmd", quality(1))

    def take(message, handler, name):
        seen[name].append(from_odometry(message)[1][:3])
        if name == "a" and len(seen["a"]) > 5:
            command.publish(to_command(np.array([0, 0, 1.0, 0]), monotonic()))
        climbed = len(seen["a"]) > 5 and seen["a"][-1][2] > seen["a"][0][2] + 0.3
        if climbed and told and plant._ends is None:
            plant.end()
            plant._ends = 0  # nobody waits until everybody has landed

    for name in seen:
        plant._mailbox.subscribe(
            msgs().Odometry, f"/{name}/odom", quality(1), lambda m, handler, name=name: take(m, handler, name)
        )
    plant._mailbox.subscribe(
        msgs().DiagnosticArray, "/world/status", quality(5), lambda m, handler: told.append(m.status[0])
    )
    plant.run()
    with pytest.raises(SystemExit):
        plant.end()  # for the second time
    np.testing.assert_array_equal(plant.vehicles.held, [False, True])
    assert np.linalg.norm(seen["b"][-1] - seen["b"][0]) < 0.2
    values = {one.key: one.value for one in told[-1].values}
    assert values["collisions"] == ""
    assert told[-1].message.startswith("0 pairs")


def test_everybody_is_put_back(make):
    plant = make(**{**GOOD, "starts": [-2.0, 0.0, 1.5, 2.0, 0.5, 1.5]})
    starts = plant.vehicles.state[:, :3].copy()
    np.testing.assert_array_equal(starts, [[-2, 0, 1.5], [2, 0.5, 1.5]])
    for _ in range(50):
        plant.vehicles.command(0, np.array([0, 0.2, 0, 0]))
        plant.vehicles.advance()
    assert plant.vehicles.state[0, 0] > -2.0
    plant.reset()
    np.testing.assert_array_equal(plant.vehicles.state[:, :3], starts)
    assert plant.vehicles.held.all()
