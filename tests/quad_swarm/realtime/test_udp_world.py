"""What a simulated world and its robots tell each other over UDP."""

import json

import numpy as np
import pytest

from quad_swarm.realtime import Sensed
from quad_swarm.realtime.link import monotonic
from quad_swarm.realtime.process import Report
from quad_swarm.realtime.udp import UdpLink, open_socket
from quad_swarm.realtime.udp_world import (
    UdpVehicle,
    UdpWorld,
    pack_report,
    pack_sensed,
    unpack_report,
    unpack_sensed,
)
from quad_swarm.robot import Plan

SECOND = 1_000_000


def test_what_is_perceived_is_not_rounded():
    rng = np.random.default_rng(0)
    sensed = Sensed(1_790_000_000_000_001, *(rng.normal(size=shape) for shape in ((9,), (3, 3), (3, 3))))
    again = unpack_sensed(pack_sensed(sensed), 3)
    assert again.stamp == sensed.stamp
    for one, other in zip(again[1:], sensed[1:], strict=True):
        assert one.tobytes() == other.tobytes()
    with pytest.raises(ValueError, match="no state"):
        unpack_sensed(pack_sensed(sensed), 4)


def test_reports():
    plan = np.arange(63, dtype=float).reshape(21, 3)
    report = Report(5, 1, 0b1001, 2**63, 0, plan)
    again = unpack_report(pack_report(report))
    assert again[:5] == report[:5]
    np.testing.assert_array_equal(again.plan, plan)
    with pytest.raises(ValueError, match="no report"):
        unpack_report(pack_report(report)[:-1])


class Hears:
    def __init__(self):
        self.commands, self.reports, self.words = [], [], []

    def on_command(self, robot, setpoint):
        self.commands.append((robot, setpoint.tolist()))

    def on_report(self, report):
        self.reports.append(report)

    def on_words(self, words):
        self.words.append(words)


def test_a_world_and_a_robot_talk():
    world, link, hears = UdpWorld(), UdpLink(0), Hears()
    try:
        address = world.process("team.json", 0)[-1]
        host, port = address.split(":")
        vehicle = UdpVehicle(link, (host, int(port)), 1)
        assert vehicle.sense() is None
        vehicle.say(says="hello")
        vehicle.command(np.array([0.1, 0.2, 0.3, 0.4]), Plan(0, np.zeros((21, 3))))
        vehicle.report(Report(0, 0, 0b10, 0, 0, np.ones((21, 3))))
        ends = monotonic() + 500 * SECOND
        while not (hears.words and hears.commands and hears.reports) and monotonic() < ends:
            world.receive(monotonic() + 10_000, hears)
        assert hears.words == [{"says": "hello", "robot": 0, "port": link.address[1]}]
        assert hears.commands == [(0, [0.1, 0.2, 0.3, 0.4])]
        assert hears.reports[0].asked == 0b10
        now = link.shared(link.now())
        for stamp in (now, now - 50_000):  # the second is older than the first
            world.tell(0, Sensed(stamp, np.arange(9.0), np.ones((1, 3)), np.zeros((1, 3))))
        world.say(0, says="fly", flight=1)
        link.wait(link.now() + 500 * SECOND, None, lambda: bool(vehicle.control))
        assert vehicle.control == [{"says": "fly", "flight": 1, "ports": [link.address[1]]}]
        assert abs(link.shared(vehicle.sense().stamp) - now) < 1000
        vehicle.begin(vehicle.control[0])
        assert link.addresses == {0: link.address}
        assert vehicle.sense() is None
    finally:
        world.close()
        link.close()


def test_a_robot_that_is_not_there_is_told_nothing():
    world = UdpWorld()
    world.say(3, says="bye")
    world.close()


@pytest.mark.parametrize("message", [b"", bytes([9, 9]), bytes([1]), bytes([2, 0]), b"{", b"{}", b'{"says": 1}'])
def test_messages_of_strangers_are_nothing(message):
    world, link, hears = UdpWorld(), UdpLink(0), Hears()
    try:
        host, port = world.process("team.json", 0)[-1].split(":")
        vehicle = UdpVehicle(link, (host, int(port)), 1)
        with open_socket("127.0.0.1", 0) as stranger:
            stranger.sendto(message, (host, int(port)))
            stranger.sendto(message, vehicle.address)
            stranger.sendto(json.dumps({"says": "stop"}).encode(), vehicle.address)
        world.receive(monotonic() + 50_000, hears)
        assert hears.words == hears.commands == hears.reports == []
        link.wait(link.now() + 500 * SECOND, None, lambda: bool(vehicle.control))
        assert vehicle.control == [{"says": "stop"}]
    finally:
        world.close()
        link.close()
