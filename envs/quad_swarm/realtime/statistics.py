"""Statistics of flights in real time, which neither grow with the flight nor depend on how it was divided."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_PER_DECADE = 50  # so that a quantile is exact to 5 %
_DECADES = 8


class Histogram:
    """Durations (us) from 1 us to 100 s, in logarithmic bins.

    :ivar counts: number of durations in each bin
    """

    def __init__(self, counts: np.ndarray | None = None):
        self.counts = np.zeros(_PER_DECADE * _DECADES, np.int64) if counts is None else counts

    def add(self, duration: float) -> None:
        """Count a duration (us)."""
        place = int(_PER_DECADE * np.log10(max(duration, 1.0)))
        self.counts[min(place, len(self.counts) - 1)] += 1

    def __add__(self, other: Histogram) -> Histogram:
        return Histogram(self.counts + other.counts)

    @property
    def total(self) -> int:
        """Number of durations."""
        return int(self.counts.sum())

    def quantile(self, share: float) -> float:
        """Return the duration (us) that a share of all do not exceed, to within 5 %; NaN if there are none."""
        if not self.total:
            return float("nan")
        place = int(np.searchsorted(self.counts.cumsum(), max(share * self.total, 1.0)))
        return float(10 ** ((place + 0.5) / _PER_DECADE))

    def to_json(self) -> dict[str, int]:
        """Return the bins that are not empty."""
        return {str(place): int(self.counts[place]) for place in np.flatnonzero(self.counts)}

    @classmethod
    def from_json(cls, content: Mapping[str, int]) -> Histogram:
        """Return the histogram of `to_json`."""
        histogram = cls()
        for place, count in content.items():
            histogram.counts[int(place)] = count
        return histogram


def _histograms() -> dict[str, Histogram]:
    return {name: Histogram() for name in DURATIONS}


# Durations that a loop measures
DURATIONS = {
    "jitter": "from the start of a period until the loop begins it",
    "compute": "decision and planning",
    "total": "from the start of a period until its command",
    "sensed": "age of what is perceived, at the start of the period",
    "one_way": "from sending a plan until its arrival",
    "round_trip": "from a request to its answer",
    "plan_age": "age of the plans that arrived, when they are used",
}


@dataclass
class Statistics:
    """What a loop counts.

    :param counts: numbers by name: periods, missed periods, late commands, plans that were refused, by reason, errors,
        and how often each guard of the supervisor stepped in
    :param durations: durations by the names of `DURATIONS`
    :param seconds: time flown (s)
    :param cpu_seconds: processor time used meanwhile (s)
    :param last_error: the last error, which the loop survived
    """

    counts: Counter[str] = field(default_factory=Counter)
    durations: dict[str, Histogram] = field(default_factory=_histograms)
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    last_error: str = ""

    def __add__(self, other: Statistics) -> Statistics:
        return Statistics(
            self.counts + other.counts,
            {name: self.durations[name] + other.durations[name] for name in DURATIONS},
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            other.last_error or self.last_error,
        )

    def share(self, name: str) -> float:
        """Return a count as a share of the periods, including those that were missed; 0 without any."""
        periods = self.counts["periods"] + self.counts["missed"]
        return self.counts[name] / periods if periods else 0.0

    def to_json(self) -> dict[str, Any]:
        """Return everything as values of JSON, see `from_json`."""
        durations = {name: histogram.to_json() for name, histogram in self.durations.items()}
        return {**vars(self), "counts": dict(self.counts), "durations": durations}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Statistics:
        """Return the statistics of `to_json`."""
        durations = {name: Histogram.from_json(content["durations"][name]) for name in DURATIONS}
        return cls(**{**content, "counts": Counter(content["counts"]), "durations": durations})


def total(parts: Iterable[Statistics]) -> Statistics:
    """Return the statistics of several robots or flights together."""
    return sum(parts, Statistics())
