"""Intervals and comparisons against published numbers."""

import pytest

from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison, newcombe_interval, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_interval_as_published(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_comparison_counts_episodes_in_which_one_collided():
    first = [{"collided": c} for c in (1, 1, 0, 0, 1)]
    second = [{"collided": c} for c in (1, 0, 0, 1, 0)]
    assert Comparison.of(first, second) == Comparison(5, 2, 1)


def test_comparison_of_known_numbers():
    # Agresti and Min (2005) for 4,000 pairs of which 5 and 1 differ; McNemar's exact p of 5 against 1 is 14/64
    low, high = Comparison(4000, 5, 1).interval
    assert (low, high) == (pytest.approx(-0.00030, abs=2e-5), pytest.approx(0.00230, abs=2e-5))
    assert Comparison(4000, 5, 1).p_value == pytest.approx(14 / 64)
    assert Comparison(4000, 0, 0).p_value == 1.0
    assert Comparison(4000, 0, 0).interval[1] > 0, "no collisions in 4,000 episodes do not prove that there are none"


def test_as_safe_has_a_margin():
    assert SAFETY_MARGIN == 0.003
    assert Comparison(4000, 5, 1).as_safe()
    assert not Comparison(4000, 12, 1).as_safe()
    assert Comparison(4000, 12, 1).as_safe(0.005)
    assert not Comparison(100, 0, 0).as_safe(), "too few episodes"


@pytest.mark.parametrize(
    ("first", "second", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), p. 873, table II, method 10.
        ((56, 70), (48, 80), 0.0524, 0.3339),
        ((9, 10), (3, 10), 0.1705, 0.8090),
        ((5, 56), (0, 29), -0.0381, 0.1926),
        ((0, 10), (0, 20), -0.1611, 0.2775),
        ((10, 10), (0, 20), 0.6791, 1.0),
    ],
)
def test_rates_in_different_trials_are_compared(first, second, low, high):
    assert newcombe_interval(*first, *second) == pytest.approx((low, high), abs=5e-5)
