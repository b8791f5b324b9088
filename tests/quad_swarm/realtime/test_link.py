"""Links whose messages are those of the wire."""

import numpy as np
import pytest

from quad_swarm.realtime import Channel, Conditions, WireLink, session_of
from quad_swarm.realtime.link import Traffic, sensed_together
from quad_swarm.robot import Plan, wire
from quad_swarm.world.presets import make_config

PLAN = Plan(1_000_000, np.arange(21)[:, None] * np.array([0.1, 0.05, 0.0]))


class Pipe(WireLink):
    """Keeps what it sends."""

    def __init__(self, index, **options):
        super().__init__(index, **options)
        self.messages, self.time, self.offset = [], 1_002_000, 0

    def now(self):
        return self.time

    def _offset(self):
        return self.offset + self.clock_error

    def transmit(self, other, message):
        self.messages.append(message)


class Handler:
    def __init__(self):
        self.requests, self.plans = [], []

    def on_request(self, sender):
        self.requests.append(sender)

    def on_plan(self, *plan):
        self.plans.append(plan)


@pytest.mark.parametrize("checked", [False, True])
def test_what_is_sent_arrives(checked):
    one, two, handler = Pipe(1, checked=checked), Pipe(2, checked=checked), Handler()
    one.request(2)
    one.send(2, PLAN, 50_000, asked=True)
    one.send(2, PLAN, 50_000, asked=False)
    two.time = 1_003_000
    for message in one.messages:
        two.deliver(message, handler)
    assert handler.requests == [1]
    for sender, plan, sent, period in handler.plans:
        assert (sender, plan.stamp, sent, period) == (1, 1_000_000, 1_002_000, 50_000)
        np.testing.assert_allclose(plan.positions, PLAN.positions, atol=5e-4)
    assert one.traffic == Traffic(1, 1, 1, sum(map(len, one.messages)), 0, 0)
    assert two.traffic == Traffic(received=3)


def test_clocks_of_two_machines_count_from_different_times():
    one, two, handler = Pipe(1), Pipe(2), Handler()
    one.offset, two.offset, two.time = 7 * 10**15, 7 * 10**15 - 5_000_000_000, 1_002_000 + 5_000_000_000
    one.send(2, PLAN, 50_000, asked=True)
    two.deliver(one.messages[0], handler)
    _, plan, sent, _ = handler.plans[0]
    assert (plan.stamp, sent) == (1_000_000 + 5_000_000_000, two.time)
    two.clock_error = 20_000
    two.deliver(one.messages[0], handler)
    assert handler.plans[1][2] == two.time - 20_000, "a clock that is fast makes messages older"


def test_what_is_not_for_a_robot_is_not_handled():
    one, handler = Pipe(1), Handler()
    for message in (
        wire.pack_request(0, 2, 3, 0),  # for another robot
        wire.pack_request(0, 1, 1, 0),  # its own, which a group gives back
        wire.pack_request(5, 2, 1, 0),  # of another session
        b"",
        b"{}",
    ):
        one.deliver(message, handler)
    assert not handler.requests
    assert one.traffic == Traffic(refused=3)
    one.deliver(wire.pack_request(0, 2, wire.EVERYBODY, 0), handler)
    assert handler.requests == [2]


def test_conditions_are_met_on_average():
    channel, message = Channel(Conditions(0.1, 0.2, 0.3, 0.0)), bytes(60)
    arrived = [channel.arriving(message) for _ in range(5000)]
    assert np.mean([not one for one in arrived]) == pytest.approx(0.1, abs=0.02)
    assert np.mean([len(one) == 2 for one in arrived if one]) == pytest.approx(0.2, abs=0.02)
    changed = [one[0] != message for one in arrived if one]
    assert np.mean(changed) == pytest.approx(0.3, abs=0.03)
    assert all(len(message) == 60 for one in arrived for message in one)
    assert all(sum(byte != 0 for byte in one[0]) <= 1 for one in arrived if one)


def test_reordered_messages_arrive_after_the_next_one():
    channel = Channel(Conditions(reordered=1.0))
    assert channel.arriving(b"a") == []
    assert channel.arriving(b"b") == [b"b", b"a"]
    assert Channel(Conditions()).arriving(b"a") == [b"a"]


@pytest.mark.parametrize("conditions", [{"loss": 1.1}, {"malformed": -0.1}, {"duplicates": np.nan}])
def test_shares_are_shares(conditions):
    with pytest.raises(ValueError, match=next(iter(conditions))):
        Conditions(**conditions)


def test_robots_of_another_world_have_another_session():
    config = make_config("flight-v2", n_robots=3)
    assert session_of(config) == session_of(make_config("flight-v2", n_robots=3)) != session_of(config, team=1)
    others = [
        make_config(config, radius=0.2),
        make_config(config, obstacles={"listed": [{"position": (0, 0, 0), "radius": 0.3}]}),
    ]
    assert len({session_of(one) for one in (config, *others)}) == 3
    assert all(0 <= session_of(config, team) < 256 for team in range(300))


@pytest.mark.parametrize(("stamps", "at"), [([900_000, 1_100_000], 1_000_000), ([700_000, 990_000], 700_000)])
def test_states_of_different_times_become_those_of_one_time(stamps, at):
    """Of the own one, or of one that is so much older that the guards shall see it."""
    state = np.array([1.0, 0, 1.5, 2.0, 0, 0, 0.1, 0, 0])
    pos, vel = np.zeros((2, 3)), np.array([[0, 1.0, 0], [0, -1.0, 0]])
    sensed = sensed_together(1_000_000, state, np.array(stamps), pos, vel)
    assert sensed.stamp == at
    np.testing.assert_allclose(sensed.state, [1.0 + 2 * (at - 1_000_000) * 1e-6, *state[1:]])
    np.testing.assert_allclose(sensed.pos[:, 1], (at - np.array(stamps)) * 1e-6 * [1, -1], atol=1e-12)
    assert state[0] == 1.0
