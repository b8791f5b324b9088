import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quad_swarm.evaluation.flight import Condition, fly
from quad_swarm.robot import wire
from quad_swarm.robot.wire import WireError, nearest, pack_plan, pack_request, unpack
from quad_swarm.world.presets import make_config

SENT, STAMP = 2**32 + 1_234_567, 2**32 + 1_150_000


def straight(points=21):
    return np.arange(points)[:, None] * [0.1, -0.05, 0.02] + [1.0, 2.0, 1.5]


def test_a_request_has_nine_bytes():
    message = pack_request(session=7, sender=3, receiver=5, sent=SENT)
    assert message == b"\xa1\x01\x03\x05\x07" + (1_234_567).to_bytes(4, "little")
    assert unpack(message, 7) == wire.Message(wire.REQUEST, 3, 5, 1_234_567)


@pytest.mark.parametrize("checked", [False, True])
def test_a_plan_arrives_as_it_was_sent(checked):
    message = pack_plan(7, 3, wire.EVERYBODY, SENT, STAMP, 50_000, straight(), asked=False, checked=checked)
    assert len(message) == 9 + 5 + 6 + -(-(3 * 8 + 57 * 1) // 8) + 2 * checked  # +100, -50 and 20 mm; then nothing
    kind, sender, receiver, sent, stamp, period, positions = unpack(message, 7)
    assert (kind, sender, receiver, period) == (wire.ANNOUNCEMENT, 3, wire.EVERYBODY, 50_000)
    assert nearest(sent, STAMP) == SENT
    assert abs(nearest(stamp, SENT) - STAMP) <= 50
    np.testing.assert_allclose(positions, straight(), atol=1e-9)


@pytest.mark.parametrize(
    ("time", "now", "expected"), [(5, 2**32 + 3, 2**32 + 5), (2**32 - 1, 2**32, 2**32 - 1), (7, 0, 7)]
)
def test_times_are_the_nearest(time, now, expected):
    assert nearest(time, now) == expected


@settings(max_examples=100, deadline=None)
@given(
    points=st.lists(st.tuples(*[st.integers(-4000, 4000)] * 3), min_size=3, max_size=63),
    milliseconds=st.integers(1, 255),
    age=st.integers(0, 65_535),
)
def test_any_plan_on_the_grid_is_exact(points, milliseconds, age):
    positions = np.array(points) * 1e-3
    message = pack_plan(0, 0, 1, SENT, SENT - 100 * age, 1000 * milliseconds, positions)
    found = unpack(message, 0)
    np.testing.assert_allclose(found.positions, positions, atol=1e-9)
    assert (found.period, nearest(found.stamp, SENT)) == (1000 * milliseconds, SENT - 100 * age)


@pytest.mark.parametrize("preset", ["paper", "flight", "flight-hard"])
def test_plans_of_flights_are_small_and_exact_to_half_a_millimetre(preset):
    config = make_config(preset, n_robots=3)
    flight = fly(Condition("full", "symmetric_swap", config), seed=0)
    for plan in flight.plans[..., :3].reshape(-1, config.planner.horizon + 1, 3):
        message = pack_plan(1, 2, 3, SENT, STAMP, round(config.planner.dt * 1e6), plan, checked=True)
        assert len(message) <= wire.MOST_BYTES
        assert np.abs(unpack(message, 1).positions - plan).max() <= 0.5e-3 + 1e-9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": straight(2)}, "3 to 63 points"),
        ({"positions": straight(64)}, "3 to 63 points"),
        ({"positions": np.full((21, 3), np.nan)}, "finite"),
        ({"positions": straight() + 40}, "within 32.767 m"),
        ({"positions": straight() * [[0]] + 20.0 * (-1.0) ** np.arange(21)[:, None]}, "too far apart"),
        ({"period": 50_500}, "whole milliseconds"),
        ({"period": 256_000}, "up to 255"),
        ({"stamp": SENT - 7_000_000}, "at most 6.5 s"),
        ({"stamp": SENT + 1000}, "cannot be sent"),
        ({"sender": 255}, "sender=255"),
        ({"receiver": -1}, "receiver=-1"),
        ({"session": True}, "session=True"),
    ],
)
def test_what_no_message_can_hold_is_refused(change, message):
    arguments = {"session": 1, "sender": 2, "receiver": 3, "sent": SENT, "stamp": STAMP, "period": 50_000}
    with pytest.raises(WireError, match=message):
        pack_plan(**arguments | {"positions": straight()} | change)


PLAN = pack_plan(7, 3, 4, SENT, STAMP, 50_000, straight())
CHECKED = pack_plan(7, 3, 4, SENT, STAMP, 50_000, straight(), checked=True)


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (b"", "0 bytes"),
        (PLAN[:8], "8 bytes"),
        (b"\xa2" + PLAN[1:], "another protocol or version"),
        (PLAN[:4] + b"\x08" + PLAN[5:], "session 8, not 7"),
        (PLAN[:1] + b"\x05" + PLAN[2:], "kind 5"),
        (PLAN[:2] + b"\xff" + PLAN[3:], "no sender"),
        (PLAN[:-1], "sizes"),
        (PLAN + b"\0", "sizes"),
        (PLAN[:20], "too few for a plan"),
        (PLAN[:-1] + bytes([PLAN[-1] | 0x80]), "after the end"),
        (pack_request(7, 1, 2, 0) + b"\0", "A request has 9 bytes"),
        (CHECKED[:-1] + bytes([CHECKED[-1] ^ 1]), "checksum"),
        (CHECKED[:12] + bytes([CHECKED[12] ^ 4]) + CHECKED[13:], "checksum"),
        (PLAN[:14] + b"\xff\x7f" + PLAN[16:], "beyond 32.767 m"),
    ],
)
def test_other_bytes_are_refused(message, why):
    with pytest.raises(WireError, match=why):
        unpack(message, 7)


def mutated(message, rng):
    message = bytearray(message)
    match rng.integers(4):
        case 0:
            for _ in range(rng.integers(1, 4)):
                message[rng.integers(len(message))] = rng.integers(256)
        case 1:
            del message[rng.integers(len(message) + 1) :]
        case 2:
            message += rng.bytes(rng.integers(1, 5))
        case 3:
            message = bytearray(rng.bytes(rng.integers(wire.MOST_BYTES + 10)))
    return bytes(message)


def try_mutations(count, seed):
    """Return how many of some damaged messages were refused, and how many of those with a checksum."""
    rng = np.random.default_rng(seed)
    messages = [PLAN, CHECKED, pack_request(7, 1, 2, SENT), pack_request(7, 1, 2, SENT, checked=True)]
    refused = slipped = 0
    for _ in range(count):
        original = messages[rng.integers(len(messages))]
        message = mutated(original, rng)
        try:
            found = unpack(message, 7)
        except WireError:
            refused += 1
            continue
        assert found.positions is None or np.isfinite(found.positions).all()
        slipped += message != original and len(message) > 1 and bool(message[1] & wire.CHECKED)
    return refused, slipped


def test_damaged_messages_raise_one_error_only():
    refused, slipped = try_mutations(5_000, seed=0)
    assert 2_500 < refused < 5_000
    assert slipped <= 2  # of 65,536 damaged ones, a checksum of 16 bits lets one pass


@pytest.mark.slow
def test_two_hundred_thousand_damaged_messages():
    assert try_mutations(200_000, seed=1)[1] <= 12
