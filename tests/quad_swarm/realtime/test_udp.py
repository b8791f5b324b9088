"""Messages over UDP, on this machine."""

import socket

import numpy as np
import pytest

from quad_swarm.realtime import Channel, Conditions
from quad_swarm.realtime.link import monotonic
from quad_swarm.realtime.udp import UdpLink, open_socket
from quad_swarm.robot import Plan

PLAN = Plan(0, np.arange(21)[:, None] * np.array([0.1, 0.05, 0.0]))
SECOND = 1_000_000


class Handler:
    def __init__(self):
        self.requests, self.plans = [], []

    def on_request(self, sender):
        self.requests.append(sender)

    def on_plan(self, *plan):
        self.plans.append(plan)

    def got(self, requests=0, plans=0):
        return lambda: len(self.requests) >= requests and len(self.plans) >= plans


@pytest.fixture
def links():
    opened = []

    def make(count, **options):
        opened.extend(UdpLink(k, **options) for k in range(count))
        for link in opened:
            link.addresses = {k: other.address for k, other in enumerate(opened) if other is not link}
        return opened

    yield make
    for link in opened:
        link.close()


def test_two_robots_talk(links):
    one, two = links(2)
    handler = Handler()
    plan = PLAN._replace(stamp=monotonic() - 20_000)
    one.request(1)
    one.send(1, plan, 50_000, asked=True)
    two.wait(two.now() + 500 * SECOND, handler, handler.got(1, 1))
    assert handler.requests == [0]
    ((sender, arrived, sent, period),) = handler.plans
    assert (sender, period) == (0, 50_000)
    assert abs(arrived.stamp - plan.stamp) < 1000, "0.1 ms are a message's unit"
    assert plan.stamp < sent <= two.now() + 1000
    assert two.address[0] == "127.0.0.1"


def test_waiting_ends_in_time_without_messages(links):
    (one,) = links(1)
    began = one.now()
    one.wait(began + 20_000, Handler())
    assert one.now() >= began + 20_000
    one.wait(0, Handler())  # handles what is there


def test_a_group_hears_everything_and_each_takes_its_own(links):
    (port,) = {open_and_close()}
    try:
        three = links(3, group=("239.255.77.77", port))
    except OSError as error:
        pytest.skip(f"no multicast here: {error}")
    handlers = [Handler() for _ in three]
    three[0].request(1)
    three[0].request(2)
    for link, handler in zip(three[1:], handlers[1:], strict=True):
        link.wait(link.now() + 10 * SECOND, handler, handler.got(1))
        assert handler.requests == [0]
    three[0].wait(0, handlers[0])
    assert not handlers[0].requests


def open_and_close():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        return opened.getsockname()[1]


def test_bytes_of_strangers_are_counted(links):
    (one,) = links(1)
    with open_socket("127.0.0.1", 0) as stranger:
        for message in (b"", b"hello", bytes(2000)):
            stranger.sendto(message, one.address)
    one.wait(one.now() + 500 * SECOND, Handler(), lambda: one.traffic.refused == 3)
    assert one.traffic.refused == 3


def test_a_robot_that_is_gone_stops_nobody(links):
    one, two, three = links(3)
    two.close()
    handler = Handler()
    for _ in range(3):
        one.request(1)
        one.request(2)
        one.wait(0, handler)
    three.wait(three.now() + 500 * SECOND, handler, handler.got(3))
    assert handler.requests == [0, 0, 0]
    with pytest.raises(KeyError):
        one.request(7)


def test_conditions_and_partitions(links):
    one, two = links(2)
    handler = Handler()
    two.channel = Channel(Conditions(loss=1.0))
    one.request(1)
    two.wait(two.now() + 50_000, handler)
    assert two.traffic == type(two.traffic)()
    two.channel = None
    two.deaf_to = frozenset([0])
    one.request(1)
    two.wait(two.now() + 50_000, handler)
    one.deaf_to = frozenset([1])
    two.deaf_to = frozenset()
    one.request(1)
    two.wait(two.now() + 50_000, handler)
    assert not handler.requests
    one.deaf_to = frozenset()
    one.request(1)
    two.wait(two.now() + 500 * SECOND, handler, handler.got(1))
    assert handler.requests == [0]


def test_a_group_is_a_multicast_address():
    with pytest.raises(ValueError, match="multicast"):
        UdpLink(0, group=("127.0.0.1", 5000))


def test_an_address_of_another_machine_is_refused():
    with pytest.raises(OSError, match="assign"):
        UdpLink(0, host="192.0.2.1")
