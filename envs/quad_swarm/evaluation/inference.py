"""Statistical inference from counts of collisions: intervals of rates, paired comparisons, and non-inferiority."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

# Difference of collision rates up to which a policy counts as as safe as another: 0.3 percentage points
SAFETY_MARGIN = 0.003
_Z = 1.959964  # quantile of a two-sided 95 % interval


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a rate."""
    rate = successes / trials
    centre = (rate + _Z**2 / (2 * trials)) / (1 + _Z**2 / trials)
    half = _Z * math.sqrt(rate * (1 - rate) / trials + _Z**2 / (4 * trials**2)) / (1 + _Z**2 / trials)
    return max(0.0, centre - half), min(1.0, centre + half)


def newcombe_interval(successes: int, trials: int, others: int, other_trials: int) -> tuple[float, float]:
    """Return the 95 % interval of the difference of two rates in different trials, the first minus the second, from
    their Wilson intervals (Newcombe 1998, Statistics in Medicine 17, p. 873, method 10)."""
    one, other = successes / trials, others / other_trials
    low, high = wilson_interval(successes, trials)
    other_low, other_high = wilson_interval(others, other_trials)
    below, above = math.hypot(one - low, other_high - other), math.hypot(high - one, other - other_low)
    return one - other - below, one - other + above


class Comparison(NamedTuple):
    """Collisions of two policies over the same episodes.

    :param episodes: number of episodes
    :param only_first: episodes in which only the first policy collided
    :param only_second: episodes in which only the second policy collided
    """

    episodes: int
    only_first: int
    only_second: int

    @classmethod
    def of(cls, first: Sequence[Mapping[str, float]], second: Sequence[Mapping[str, float]]) -> Comparison:
        """Compare the statistics of the same episodes, see `run_episodes`."""
        pairs = [(bool(a["collided"]), bool(b["collided"])) for a, b in zip(first, second, strict=True)]
        return cls(len(pairs), sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the difference of the rates, first minus second (Agresti and Min 2005, which adds half an
        episode to each of the four counts)."""
        n, b, c = self.episodes + 2, self.only_first + 0.5, self.only_second + 0.5
        half = _Z / n * math.sqrt(b + c - (b - c) ** 2 / n)
        return (b - c) / n - half, (b - c) / n + half

    @property
    def p_value(self) -> float:
        """P-value of McNemar's exact test of equal collision rates."""
        n = self.only_first + self.only_second
        tail = sum(math.comb(n, k) for k in range(min(self.only_first, self.only_second) + 1)) / 2**n
        return min(1.0, 2 * tail)

    def as_safe(self, margin: float = SAFETY_MARGIN) -> bool:
        """Return whether the first policy's collision rate is at most ``margin`` higher, with 97.5 % confidence."""
        return self.interval[1] < margin
