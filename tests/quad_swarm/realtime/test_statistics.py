"""Counts and durations that can be added up."""

import json

import numpy as np
import pytest

from quad_swarm.realtime.statistics import Histogram, Statistics, total


def test_quantiles_are_exact_to_five_percent():
    durations, histogram = np.random.default_rng(0).lognormal(8, 2, 20_000), Histogram()
    for one in durations:
        histogram.add(one)
    for share in (0.01, 0.5, 0.99, 0.999):
        assert histogram.quantile(share) == pytest.approx(np.quantile(durations, share), rel=0.05)
    assert histogram.total == 20_000


def test_no_duration_is_left_out():
    histogram = Histogram()
    for one in (-5, 0, 1e12):  # clocks may differ
        histogram.add(one)
    assert histogram.total == 3
    assert np.isnan(Histogram().quantile(0.5))


def test_parts_add_up_and_survive_json():
    parts = []
    for k in range(3):
        part = Statistics(seconds=1.0, cpu_seconds=0.1 * k)
        part.counts["periods"], part.counts["missed"] = 8, k
        part.durations["compute"].add(1000)
        parts.append(Statistics.from_json(json.loads(json.dumps(part.to_json()))))
    parts[1].last_error = "policy: ValueError: no"
    both = total(parts)
    assert (both.counts["periods"], both.counts["missed"], both.seconds) == (24, 3, 3.0)
    assert both.cpu_seconds == pytest.approx(0.3)
    assert both.share("missed") == 3 / 27
    assert both.durations["compute"].total == 3
    assert both.last_error == "policy: ValueError: no"
    assert Statistics().share("missed") == 0.0
