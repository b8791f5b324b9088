"""A node whose messages are taken while a loop waits."""

import sys

import pytest

from quad_swarm.realtime.link import monotonic
from quad_swarm.ros import node as nodes


def test_without_ros_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ImportError, match=r"setup\.bash.*pip install -e '\.\[ros\]'"):
        nodes.make_node("alone")


def test_nothing_leaves_the_machine_unless_the_user_says_so(monkeypatch):
    pytest.importorskip("rclpy")
    for key in nodes.DEFAULTS:
        monkeypatch.setenv(key, nodes.DEFAULTS[key])
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    node = nodes.make_node("alone", "robot_7")
    try:
        import os

        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "OFF", "what is set stays"
        assert node.get_fully_qualified_name() == "/robot_7/alone"
    finally:
        nodes.Mailbox(node).close()


def test_messages_are_handed_over_while_somebody_waits(monkeypatch):
    pytest.importorskip("rclpy")
    from quad_swarm.ros.messages import msgs

    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")  # a node finds itself
    node = nodes.make_node("alone")
    mailbox, got = nodes.Mailbox(node), []
    try:
        for lasting in (False, True):
            profile = nodes.quality(5, lasting=lasting)
            publisher = node.create_publisher(msgs().String, f"/test_{lasting}", profile)
            mailbox.subscribe(
                msgs().String, f"/test_{lasting}", profile, lambda m, handler: got.append((m.data, handler))
            )
            for k in range(3):
                publisher.publish(msgs().String(data=str(k)))
            ends = monotonic() + 500_000_000
            mailbox.wait(ends, "me", lambda: len(got) == 3)
            assert got == [("0", "me"), ("1", "me"), ("2", "me")]
            got.clear()
        began = monotonic()
        mailbox.wait(began + 20_000, None)
        assert monotonic() >= began + 20_000
    finally:
        mailbox.close()
