"""Starts and goals of robots (Sec. V-B).

A scenario is a function ``(n_robots, space, rng) -> (starts, goals)``, both (n, 3), world frame (m). To add a scenario,
write a function and add it to `SCENARIOS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.validation import Length, PositiveLength, Range, checked

Rng = np.random.Generator
Scenario = Callable[[int, "ScenarioSpace", Rng], tuple[np.ndarray, np.ndarray]]

_DRAWS_PER_POINT = 100  # before the whole set is redrawn
_MAX_DRAWS = 20_000


@checked
@dataclass(frozen=True)
class ScenarioSpace:
    """The room that scenarios draw from.

    :param half_width: starts and goals of `random` and `random_swap` lie in [-half_width, half_width]^2 (m)
    :param heights: minimum and maximum height of starts and goals (m)
    :param spacing: minimum distance between two starts, and between two goals (m)
    :param circle_radius: minimum and maximum radius of the circle of `symmetric_swap` (m)
    :param circle_jitter: maximum displacement of starts and goals of `symmetric_swap` along each axis (m)
    :param sector_radius: minimum and maximum distance of the starts of `asymmetric_swap` from the centre (m)
    :param whole_sectors: whether sectors of `asymmetric_swap` start at the x axis and are used completely, as in the
        paper (for four robots, one anywhere in each quadrant). By default they are centred on the x axis and used to
        80 %
    """

    half_width: PositiveLength = 4.0
    heights: Range = (0.7, 2.1)
    spacing: Length = 1.0
    circle_radius: Range = (2.0, 3.0)
    circle_jitter: Length = 0.15
    sector_radius: Range = (2.0, 4.5)
    whole_sectors: bool = False


class DoesNotFit(ValueError):
    """Raised if the robots do not fit into the room of a scenario."""


def _place(n_points: int, draw: Callable[[int], np.ndarray], spacing: float) -> np.ndarray:
    """Draw points ``draw(0) ... draw(n_points - 1)``, (n, 3), until all are at least ``spacing`` apart.

    :raises DoesNotFit: if a limited number of draws finds no such set; the message says how many points were placed
    """
    points = np.empty((n_points, 3))
    placed = most = 0
    for k in range(_MAX_DRAWS):
        if k % (_DRAWS_PER_POINT * n_points) == 0:
            placed = 0
        point = draw(placed)
        if placed == 0 or ((points[:placed] - point) ** 2).sum(axis=1).min() >= spacing**2:
            points[placed] = point
            placed += 1
            most = max(most, placed)
            if placed == n_points:
                return points
    raise DoesNotFit(
        f"{n_points} robots at least {spacing} m apart do not fit into the room of this scenario; about {most} do. "
        "Choose fewer robots or a larger room."
    )


def _in_box(n_robots: int, space: ScenarioSpace, rng: Rng) -> np.ndarray:
    low = (-space.half_width, -space.half_width, space.heights[0])
    high = (space.half_width, space.half_width, space.heights[1])
    return _place(n_robots, lambda _: rng.uniform(low, high), space.spacing)


def random(n_robots: int, space: ScenarioSpace, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Random: starts and goals are drawn independently."""
    return _in_box(n_robots, space, rng), _in_box(n_robots, space, rng)


def random_swap(n_robots: int, space: ScenarioSpace, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Random swap: each robot flies to another robot's start (a uniform permutation without fixed points)."""
    starts = _in_box(n_robots, space, rng)
    while True:
        order = rng.permutation(n_robots)
        if (order != np.arange(n_robots)).all():
            return starts, starts[order]


def asymmetric_swap(n_robots: int, space: ScenarioSpace, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Asymmetric swap: one robot anywhere in each of n sectors, which flies to the start in the opposite sector.

    Sectors are centred on the axes and used to 80 % of their width, as in the only such generator that the paper's
    laboratory published (tud-amr/mrca_vc). With `ScenarioSpace.whole_sectors` they are as in the paper.
    """
    sector = 2 * np.pi / n_robots
    low, high = (0.0, 1.0) if space.whole_sectors else (-0.4, 0.4)

    def draw(i: int) -> np.ndarray:
        angle = sector * (i + rng.uniform(low, high))
        radius = rng.uniform(*space.sector_radius)
        return np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(*space.heights)])

    starts = _place(n_robots, draw, space.spacing)
    return starts, starts[(np.arange(n_robots) + n_robots // 2) % n_robots]


def symmetric_swap(n_robots: int, space: ScenarioSpace, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Symmetric swap: robots start evenly on a circle at one height and fly to the opposite points; all points are
    slightly displaced.

    Without the displacement, mirrored robots evade to the same side forever, however much they communicate.
    """
    radius, phase, height = rng.uniform(*space.circle_radius), rng.uniform(0, 2 * np.pi), rng.uniform(*space.heights)

    def draw_around(turn: float) -> Callable[[int], np.ndarray]:
        def draw(i: int) -> np.ndarray:
            angle = phase + turn + 2 * np.pi * i / n_robots
            point = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
            return point + rng.uniform(-space.circle_jitter, space.circle_jitter, size=3)

        return draw

    return _place(n_robots, draw_around(0.0), space.spacing), _place(n_robots, draw_around(np.pi), space.spacing)


# In the order of the curriculum, by the number of requests needed (docs/method.md)
SCENARIOS: dict[str, Scenario] = {
    "random": random,
    "random_swap": random_swap,
    "asymmetric_swap": asymmetric_swap,
    "symmetric_swap": symmetric_swap,
}
MIXTURES = ("mixed", "curriculum")


class ScenarioSampler:
    """Sampler of episodes of a scenario or a mixture of scenarios.

    :param name: a name of `SCENARIOS`; "mixed" to draw uniformly among all of them; "curriculum" to draw uniformly
        among the first ``level + 1`` of them; or a mapping of names to weights, such as ``{"symmetric_swap": 3,
        "random": 1}``
    :param n_robots: number of robots, at least 2
    :param space: the room
    :raises ValueError: if a name is unknown, weights are invalid, there are fewer than two robots, or they do not fit
        (`DoesNotFit`)
    """

    def __init__(self, name: str | Mapping[str, float], n_robots: int, space: ScenarioSpace):
        for one in [name] if isinstance(name, str) else name:
            if one not in SCENARIOS and (one not in MIXTURES or not isinstance(name, str)):
                raise unknown_name("scenario", one, [*SCENARIOS, *MIXTURES])
        weights = [] if isinstance(name, str) else [float(weight) for weight in name.values()]
        if not isinstance(name, str) and not (all(weight >= 0 for weight in weights) and 0 < sum(weights) < np.inf):
            raise ValueError(
                f"scenario={dict(name)}: weights must not be negative, and their sum must be positive and finite."
            )
        if n_robots < 2:
            raise ValueError(f"n_robots={n_robots}: a swarm needs at least 2 robots.")
        self.name = name
        self.n_robots = n_robots
        self.space = space
        self.level = 0
        self._weights = np.array(weights) / sum(weights) if weights else None
        for scenario in self._names:
            # Fail now rather than during training if the robots do not fit
            SCENARIOS[scenario](n_robots, space, np.random.default_rng(0))

    @property
    def _names(self) -> list[str]:
        if not isinstance(self.name, str):
            return list(self.name)
        return list(SCENARIOS) if self.name in MIXTURES else [self.name]

    @property
    def n_levels(self) -> int:
        """Number of curriculum levels, 1 without a curriculum."""
        return len(SCENARIOS) if self.name == "curriculum" else 1

    def _active(self) -> list[str]:
        return self._names[: self.level + 1] if self.name == "curriculum" else self._names

    def set_level(self, level: int) -> None:
        """Set the level of the curriculum.

        :raises ValueError: if there is no such level
        """
        if not isinstance(level, (int, np.integer)) or not 0 <= level < self.n_levels:
            raise ValueError(
                f"Level {shown(level)} does not exist: scenario {self.name!r} has levels 0 to {self.n_levels - 1}."
            )
        self.level = level

    def sample(self, rng: Rng) -> tuple[str, np.ndarray, np.ndarray]:
        """Draw an episode and return the scenario's name, starts (n, 3) and goals (n, 3), world frame (m)."""
        active = self._active()
        if self._weights is not None:
            name = active[int(rng.choice(len(active), p=self._weights))]
        else:
            name = active[int(rng.integers(len(active)))] if len(active) > 1 else active[0]
        return name, *SCENARIOS[name](self.n_robots, self.space, rng)
