"""Robots over ROS 2, in a network that contains nothing but this machine."""

import json
import subprocess
import sys

import numpy as np
import pytest
from network import alone

from quad_swarm.robot import Plan

pytest.importorskip("rclpy")

from quad_swarm.realtime import Channel, Conditions
from quad_swarm.realtime.link import monotonic
from quad_swarm.realtime.process import Report
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.messages import msgs, to_odometry, to_time
from quad_swarm.ros.node import Mailbox, make_node, quality
from quad_swarm.ros.world import RosVehicle, names_of

NAMES = names_of(2)
SECOND = 1_000_000
PLAN = Plan(0, np.arange(21)[:, None] * np.array([0.1, 0.05, 0.0]))


class Handler:
    def __init__(self):
        self.requests, self.plans = [], []

    def on_request(self, sender):
        self.requests.append(sender)

    def on_plan(self, *plan):
        self.plans.append(plan)


@pytest.fixture
def nodes(monkeypatch):
    """Two robots in one context, which see each other only: tests beside each other do not meet."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    made, context = [], None
    for name in NAMES:
        node = make_node("robot", name, context)
        context = node.context
        made.append((node, Mailbox(node)))
    yield made
    for _, mailbox in made:
        mailbox.close()


def until(mailbox, handler, done, again=lambda: None):
    """Wait, and repeat what may get lost before the two have found each other."""
    ends = monotonic() + 500 * SECOND
    while not done() and monotonic() < ends:
        again()
        mailbox.wait(monotonic() + 100_000, handler, done)
    assert done()


def test_requests_and_plans_travel(nodes):
    one, two = (RosLink(node, mailbox, k, NAMES) for k, (node, mailbox) in enumerate(nodes))
    handler = Handler()
    until(nodes[1][1], handler, lambda: bool(handler.requests), lambda: one.request(1))
    assert set(handler.requests) == {0}
    plan = PLAN._replace(stamp=one.now() - 20_000)
    until(nodes[1][1], handler, lambda: bool(handler.plans), lambda: one.send(1, plan, 50_000, asked=True))
    sender, arrived, sent, period = handler.plans[0]
    assert (sender, sent, period) == (0, None, 50_000)
    assert abs(arrived.stamp - plan.stamp) < 2000
    np.testing.assert_array_equal(arrived.positions, plan.positions)
    assert one.traffic.requests >= 1
    assert one.traffic.bytes > 1000
    assert two.traffic.received >= 2


def test_what_is_no_message_of_the_team_is_counted(nodes):
    link = RosLink(*nodes[0], 0, NAMES)
    node, _ = nodes[1]
    handler, kind = Handler(), msgs().MultiDOFJointTrajectory
    plans = node.create_publisher(kind, "/robot_0/plans", quality(2))
    requests = node.create_publisher(msgs().Header, "/robot_0/plan_requests", quality(2))
    until(nodes[0][1], handler, lambda: link.traffic.refused >= 1, lambda: plans.publish(kind()))
    before = link.traffic.refused
    stranger = msgs().Header(frame_id="robot_9", stamp=to_time(5))
    until(nodes[0][1], handler, lambda: link.traffic.refused > before + 3, lambda: requests.publish(stranger))
    assert not handler.requests
    link.channel = Channel(Conditions(loss=1.0))
    friend = msgs().Header(frame_id="robot_1", stamp=to_time(5))
    for _ in range(5):
        requests.publish(friend)
        nodes[0][1].wait(monotonic() + 50_000, handler)
    assert not handler.requests


def test_a_robot_perceives_by_odometry(nodes):
    link = RosLink(*nodes[0], 0, NAMES)
    vehicle = RosVehicle(*nodes[0], link, NAMES)
    assert vehicle.sense() is None
    node, _ = nodes[1]
    publishers = [node.create_publisher(msgs().Odometry, f"/{name}/odom", quality(1)) for name in NAMES]
    states = np.array([[0, 0, 1.5, 1, 0, 0, 0, 0.1, 0.5], [2, 1, 1.5, -1, 0.5, 0, 0.1, 0, 0]])
    now = link.shared(link.now())

    def publish():
        for publisher, state, stamp in zip(publishers, states, (now, now - 40_000), strict=True):
            publisher.publish(to_odometry(state, stamp, "base_link"))

    until(nodes[0][1], Handler(), lambda: vehicle.sense() is not None, publish)
    sensed = vehicle.sense()
    assert abs(link.shared(sensed.stamp) - now) < 2000
    np.testing.assert_allclose(sensed.state, states[0], atol=1e-9)
    np.testing.assert_allclose(sensed.pos, [[1.96, 1.02, 1.5]], atol=1e-3)
    np.testing.assert_allclose(sensed.vel, [[-1, 0.5, 0]], atol=1e-9)
    stamp, state = vehicle._states[1]
    vehicle._states[1] = stamp - SECOND, state
    assert vehicle.sense().stamp == vehicle._states[1][0], "whoever does not see one of the others sees too little"
    vehicle.begin({})
    assert vehicle.sense() is None


def test_reports_are_told_as_words(nodes):
    link = RosLink(*nodes[0], 0, NAMES)
    vehicle = RosVehicle(*nodes[0], link, NAMES)
    _, mailbox = nodes[1]
    heard = []
    mailbox.subscribe(msgs().String, "/world/words", quality(50), lambda message, handler: heard.append(message.data))
    report = Report(0, 1, 2, 0, 2, PLAN.positions)
    until(mailbox, None, lambda: bool(heard), lambda: vehicle.report(report))
    words = json.loads(heard[0])
    assert (words["says"], words["robot"], words["report"][:4]) == ("report", 0, [1, 2, 0, 2])
    np.testing.assert_allclose(words["report"][4], PLAN.positions, atol=1e-4)


FLIES = """
import numpy as np
from quad_swarm.evaluation.real_time import main
words = ["--policy", "full", "--n-robots", "4", "--link", "ros2", "--loss", "0.1", "--json", "rows.json"]
raise SystemExit(main(words))
"""


@pytest.mark.slow
def test_four_processes_fly(tmp_path):
    done = subprocess.run([*alone(), sys.executable, "-c", FLIES], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "rows.json").read_text())
    assert row["link"] == "ros2"
    assert row["counts"]["plans received"] > 20
    assert row["bytes_per_second"] > 1000
    assert not [name for name in row["counts"] if name.startswith("errors")]
