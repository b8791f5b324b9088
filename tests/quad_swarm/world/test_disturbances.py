"""The settings of what may go wrong."""

import numpy as np
import pytest

from quad_swarm.world.disturbances import ProcessNoise, Radio, SensingError


def test_nothing_goes_wrong_by_default():
    assert not ProcessNoise()
    assert not SensingError()
    assert not Radio().is_random
    assert not Radio(delay=3).is_random, "an answer that is always as late is no chance"


@pytest.mark.parametrize("field", ["pos", "vel", "attitude", "wind", "gust"])
def test_every_noise_counts(field):
    assert ProcessNoise(**{field: 0.1})


@pytest.mark.parametrize(("field", "own"), [("pos", True), ("attitude", True), ("others_pos", False)])
def test_errors_are_one_s_own_or_the_observer_s(field, own):
    errors = SensingError(**{field: 0.1})
    assert errors
    assert errors.own == own
    assert errors.others != own


@pytest.mark.parametrize(
    ("radio", "shares"),
    [
        (Radio(), [1, 1, 1, 1, 1]),
        (Radio(range=2.0), [1, 1, 1, 0, 0]),
        (Radio(half_distance=2.0), [1, 2**-0.125, 0.5, 2**-8, 0]),
        (Radio(half_distance=2.0, path_loss_exponent=2.0), [1, 2**-0.25, 0.5, 2**-4, 0]),
        (Radio(range=3.0, half_distance=2.0, path_loss_exponent=2), [1, 2**-0.25, 0.5, 0, 0]),
    ],
)
def test_the_radio_carries_less_the_farther(radio, shares):
    assert radio.carries(np.array([0.0, 1.0, 2.0, 4.0, 1e300])).tolist() == shares
    assert radio.limits_distance == (radio != Radio())
    assert radio.is_random == (radio.half_distance is not None), "a range is no chance"


@pytest.mark.parametrize(("settings", "message"), [
    (lambda: ProcessNoise(gust=-1), "gust=-1"),
    (lambda: SensingError(others_vel=float("nan")), "others_vel=nan"),
    (lambda: Radio(bursts=1.0), "bursts=1.0"),
    (lambda: Radio(burst_length=0.5), "burst_length=0.5"),
    (lambda: Radio(outage=1.5), "outage=1.5"),
    (lambda: Radio(jitter=-1), "jitter=-1"),
    (lambda: Radio(range=0.0), "range=0.0"),
    (lambda: Radio(half_distance=float("inf")), "half_distance=inf"),
    (lambda: Radio(half_distance=2.0, path_loss_exponent=0.5), "path_loss_exponent=0.5"),
])  # fmt: skip
def test_nonsense_is_refused_in_one_line(settings, message):
    with pytest.raises(ValueError, match=message):
        settings()
