"""Messages hold what they are given, in the size that is charged for them."""

import numpy as np
import pytest

from quad_swarm.world.messages import REQUEST_BYTES, pack_plan, plan_bytes, unpack_plan


def test_a_plan_comes_back_to_half_a_millimetre():
    positions = np.random.default_rng(0).uniform(-30, 30, (21, 3))
    message = pack_plan(3, 7, 123_456, positions)
    assert len(message) == plan_bytes(20) == 132
    sender, receiver, step, unpacked = unpack_plan(message)
    assert (sender, receiver, step) == (3, 7, 123_456)
    np.testing.assert_allclose(unpacked, positions, atol=5.0001e-4)


def test_a_request_is_a_header():
    assert REQUEST_BYTES == 6


@pytest.mark.parametrize("bad", [np.nan, np.inf, 33.0])
def test_a_plan_that_does_not_fit_is_refused(bad):
    with pytest.raises(ValueError, match="messages hold coordinates"):
        pack_plan(0, 1, 0, np.full((3, 3), bad))


@pytest.mark.parametrize(
    "header",
    [
        (256, 0, 0),
        (0, 256, 0),
        (-1, 0, 0),
        (0, -1, 0),
        (0, 1, -1),
        (0, 1, 2**32),
        (0, 1, 5.0),
        (True, 1, 0),
        ("0", 1, 0),
    ],
)
def test_numbers_that_do_not_fit_are_refused(header):
    with pytest.raises(ValueError, match="messages hold an integer from 0 to"):
        pack_plan(*header, np.zeros((3, 3)))


def test_numbers_of_numpy_and_the_largest_ones_come_back():
    message = pack_plan(np.uint8(255), np.int64(254), 2**32 - 1, [[1, 2, 3]])
    assert unpack_plan(message)[:3] == (255, 254, 2**32 - 1)


@pytest.mark.parametrize(
    "positions", [np.zeros((0, 3)), np.zeros((3, 2)), np.zeros(3), np.zeros((1, 3), object), "abc"]
)
def test_positions_of_another_form_are_refused(positions):
    with pytest.raises(ValueError, match=r"positions have shape .* stages 0..N, \(N \+ 1, 3\)"):
        pack_plan(0, 1, 0, positions)


@pytest.mark.parametrize("message", [b"", b"123456", b"1234567"])
def test_what_is_no_plan_is_refused(message):
    with pytest.raises(ValueError, match="is not a plan"):
        unpack_plan(message)
