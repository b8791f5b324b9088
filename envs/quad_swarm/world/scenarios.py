"""Starts and goals of robots (Sec. V-B), obstacles between them, waypoints, and goals that move.

A scenario is a function ``(n_robots, space, rng) -> (starts, goals)``, both (n, 3), world frame (m), or a `Scene`. To
add a scenario, write a function and add it to `SCENARIOS`, one with obstacles to `MOST_OBSTACLES`, too, and one whose
goals change to `CHANGING_GOALS`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from quad_swarm.errors import shown, unknown_name
from quad_swarm.validation import LARGEST_LENGTH, Count, Length, PositiveLength, Range, checked
from quad_swarm.world.obstacles import Obstacle, clearances, surroundings

if TYPE_CHECKING:
    from quad_swarm.world.presets import SwarmConfig

Rng = np.random.Generator
Scenario = Callable[[int, "ScenarioSpace", Rng], "tuple[np.ndarray, np.ndarray] | Scene"]

_DRAWS_PER_POINT = 100  # before the whole set is redrawn
_MAX_DRAWS = 20_000
_MOST_ATTEMPTS = 500  # draws of a whole episode
_TRIALS = 8  # episodes that are tried before the first one
_TRIALS_AMONG_OBSTACLES, _FEWEST = 40, 4  # and how many of these must succeed
_DRAWS_PER_OBSTACLE = 30
_FREE = 0.6  # distance of obstacles from starts and goals, in the distance of obstacles from each other
_POST = 1.25  # radius of the pillars beside a doorway (m)
_CROSSING = (1.0, 3.0)  # when traffic crosses the middle (s)


@checked
@dataclass(frozen=True)
class ScenarioSpace:
    """The room that scenarios draw from.

    :param half_width: starts and goals of `random` and `random_swap` lie in [-half_width, half_width]^2 (m)
    :param heights: minimum and maximum height of starts and goals (m)
    :param spacing: minimum distance between two starts, and between two goals (m), in the metric of ``downwash``
    :param downwash: how much less vertical distances count there (-); None for the planner's
    :param circle_radius: minimum and maximum radius of the circle of `symmetric_swap` (m)
    :param circle_jitter: maximum displacement of starts and goals of `symmetric_swap` along each axis (m)
    :param sector_radius: minimum and maximum distance of the starts of `asymmetric_swap` from the centre (m)
    :param pillars: minimum and maximum number of pillars in `forest`
    :param pillar_radius: minimum and maximum of their radius (m)
    :param doorway: minimum and maximum width of the opening in `doorway` (m)
    :param traffic: minimum and maximum number of spheres that cross in `crossing_traffic`
    :param traffic_radius: minimum and maximum of their radius (m)
    :param traffic_speed: minimum and maximum of their speed (m/s)
    :param waypoints: minimum and maximum number of a robot's waypoints in `tour`
    :param goal_speed: minimum and maximum speed of the goals in `moving_goals` (m/s)
    :param whole_sectors: whether sectors of `asymmetric_swap` start at the x axis and are used completely, as in the
        paper (for four robots, one anywhere in each quadrant). By default they are centred on the x axis and used to
        80 %
    :raises ValueError: if a length is out of range, or displaced starts could be farther away than 10 km
    """

    half_width: PositiveLength = 4.0
    heights: Range = (0.7, 2.1)
    spacing: Length = 1.0
    circle_radius: Range = (2.0, 3.0)
    circle_jitter: Length = 0.15
    sector_radius: Range = (2.0, 4.5)
    whole_sectors: bool = False
    pillars: tuple[Count, Count] = (3, 8)
    pillar_radius: Range = (0.1, 0.3)
    doorway: Range = (1.8, 2.4)
    traffic: tuple[Count, Count] = (2, 4)
    traffic_radius: Range = (0.2, 0.3)
    traffic_speed: Range = (0.5, 1.0)
    waypoints: tuple[Count, Count] = (1, 2)
    goal_speed: Range = (0.2, 0.4)
    downwash: Annotated[float, Field(ge=1, le=20)] | None = None

    @property
    def factors(self) -> np.ndarray:
        """Factors of differences along x, y and z in distances that ``spacing`` limits, (3,)."""
        return np.array([1.0, 1.0, 1.0 if self.downwash is None else 1 / self.downwash])

    def __post_init__(self) -> None:
        for name in ("pillars", "traffic", "waypoints"):
            if getattr(self, name)[0] > getattr(self, name)[1]:
                raise ValueError(f"space.{name}={getattr(self, name)}: it must be the lowest number first")
        for name in ("pillar_radius", "traffic_radius", "doorway", "traffic_speed", "goal_speed"):
            if not getattr(self, name)[0] > 0:
                raise ValueError(f"space.{name}={getattr(self, name)}: both must be positive")
        for name in ("circle_radius", "sector_radius"):
            if getattr(self, name)[0] < 0:
                raise ValueError(f"space.{name}={getattr(self, name)}: a radius must not be negative")
        most = LARGEST_LENGTH - max(self.circle_radius[1], -self.heights[0], self.heights[1])
        if self.circle_jitter > most:
            raise ValueError(
                f"space.circle_jitter={self.circle_jitter}: starts must stay within {LARGEST_LENGTH:.0f} m, so with "
                f"space.circle_radius={self.circle_radius} and space.heights={self.heights} it must be at most {most:g}"
            )


class Scene(NamedTuple):
    """An episode to fly.

    :param starts: starts, (n, 3), world frame (m)
    :param goals: goals, (n, 3), world frame (m)
    :param obstacles: obstacles
    :param velocities: velocities of the goals, (n, 3), world frame (m/s); None for goals that stand
    :param waypoints: what each robot passes on the way to its goal, n sequences (k, 3), world frame (m); None for
        nothing
    """

    starts: np.ndarray
    goals: np.ndarray
    obstacles: tuple[Obstacle, ...] = ()
    velocities: Any = None
    waypoints: Any = None


class Extent(NamedTuple):
    """Bounds of the starts and goals of a scenario.

    :param field: field of `ScenarioSpace` that sets the radius
    :param radius: limit of the horizontal coordinates (m)
    :param low: minimum height (m)
    :param high: maximum height (m)
    """

    field: str
    radius: float
    low: float
    high: float


class DoesNotFit(ValueError):
    """Raised if the robots do not fit into the room of a scenario."""


def _place(n_points: int, draw: Callable[[int], np.ndarray], space: ScenarioSpace) -> np.ndarray:
    """Draw points ``draw(0) ... draw(n_points - 1)``, (n, 3), until all are at least ``space.spacing`` apart.

    :raises DoesNotFit: if a limited number of draws finds no such set
    """
    points, factors = np.empty((n_points, 3)), space.factors
    placed = 0
    for k in range(_MAX_DRAWS):
        if k % (_DRAWS_PER_POINT * n_points) == 0:
            placed = 0
        point = draw(placed)
        if placed == 0 or ((factors * (points[:placed] - point)) ** 2).sum(axis=1).min() >= space.spacing**2:
            points[placed] = point
            placed += 1
            if placed == n_points:
                return points
    raise DoesNotFit(
        f"{n_points} robots at least {space.spacing} m apart do not fit into the room of this scenario: choose fewer "
        "robots or a larger room."
    )


def _in_box(n_robots: int, space: ScenarioSpace, rng: Rng) -> np.ndarray:
    low = (-space.half_width, -space.half_width, space.heights[0])
    high = (space.half_width, space.half_width, space.heights[1])
    return _place(n_robots, lambda _: rng.uniform(low, high), space)


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

    starts = _place(n_robots, draw, space)
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

    return _place(n_robots, draw_around(0.0), space), _place(n_robots, draw_around(np.pi), space)


def forest(n_robots: int, space: ScenarioSpace, rng: Rng) -> Scene:
    """Forest: the symmetric swap with pillars in between, ``space.spacing`` from each other or more. Where fewer fit
    than are drawn, there are as many as fit."""
    starts, goals = symmetric_swap(n_robots, space, rng)
    radius = float(np.hypot(*starts[:, :2].T).max())

    def draw() -> Obstacle:
        x, y = rng.uniform(-radius, radius, size=2)
        return Obstacle((x, y, 0.0), rng.uniform(*space.pillar_radius))

    count = int(rng.integers(space.pillars[0], space.pillars[1], endpoint=True))
    free = np.concatenate([starts, goals])
    return Scene(starts, goals, place_obstacles((space.pillars[0], count), draw, free, space.spacing))


def doorway(n_robots: int, space: ScenarioSpace, rng: Rng) -> Scene:
    """Doorway: two wide pillars leave an opening through which robots on either side fly to the places of those on the
    other, as far as there are any."""
    width = rng.uniform(*space.doorway)
    pillars = tuple(Obstacle((0.0, side * (width / 2 + _POST), 0.0), _POST) for side in (-1, 1))
    around, left = surroundings(pillars), (n_robots + 1) // 2
    low, high = (space.spacing / 2, -space.half_width, space.heights[0]), (space.half_width, space.half_width)

    def draw(i: int) -> np.ndarray:
        for _ in range(_DRAWS_PER_POINT):
            point = rng.uniform(low, (*high, space.heights[1]))
            if clearances(point[None], around).min() >= _FREE * space.spacing:
                break
        else:
            raise DoesNotFit(f"There is no room beside the doorway in space.half_width={space.half_width}.")
        return point * (-1 if i < left else 1, 1, 1)

    starts = _place(n_robots, draw, space)
    right = n_robots - left
    order = np.arange(n_robots)
    order[:right], order[left:] = np.arange(left, n_robots), np.arange(right)
    goals = starts[order]
    goals[right:left] *= (-1, 1, 1)  # an odd robot has no partner
    between = space.factors * (np.delete(goals, right, axis=0) - goals[right])
    if (between**2).sum(axis=1).min() < space.spacing**2 and right < left:
        raise DoesNotFit("The goal of the odd robot is taken.")
    return Scene(starts, goals, pillars)


def crossing_traffic(n_robots: int, space: ScenarioSpace, rng: Rng) -> Scene:
    """Crossing traffic: the symmetric swap, which spheres cross in straight lines at a constant speed."""
    starts, goals = symmetric_swap(n_robots, space, rng)

    def draw() -> Obstacle:
        direction, angle = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        velocity = rng.uniform(*space.traffic_speed) * np.array([np.cos(direction), np.sin(direction), 0.0])
        beside = rng.uniform(0, space.circle_radius[0] / 2)
        middle = (beside * np.cos(angle), beside * np.sin(angle), rng.uniform(*space.heights))
        start = middle - rng.uniform(*_CROSSING) * velocity
        return Obstacle(tuple(start), rng.uniform(*space.traffic_radius), "sphere", tuple(velocity))

    count = int(rng.integers(space.traffic[0], space.traffic[1], endpoint=True))
    return Scene(starts, goals, place_obstacles((count, count), draw, starts, space.spacing))


def tour(n_robots: int, space: ScenarioSpace, rng: Rng) -> Scene:
    """Tour: as random, but each robot passes waypoints on its way, all robots the same number."""
    starts, goals = random(n_robots, space, rng)
    number = int(rng.integers(space.waypoints[0], space.waypoints[1], endpoint=True))
    waypoints = np.array([_in_box(n_robots, space, rng) for _ in range(number)]).reshape(number, n_robots, 3)
    return Scene(starts, goals, waypoints=waypoints.swapaxes(0, 1))


def moving_goals(n_robots: int, space: ScenarioSpace, rng: Rng) -> Scene:
    """Moving goals: goals in one half of the room move together to the other half, at a constant speed."""
    starts, axis, way = _in_box(n_robots, space, rng), int(rng.integers(2)), int(rng.choice([-1, 1]))
    low = np.array([-space.half_width, -space.half_width, space.heights[0]])
    high = np.array([space.half_width, space.half_width, space.heights[1]])
    (high if way > 0 else low)[axis] = 0.0
    goals = _place(n_robots, lambda _: rng.uniform(low, high), space)
    velocities = np.zeros((n_robots, 3))
    velocities[:, axis] = way * rng.uniform(*space.goal_speed)
    return Scene(starts, goals, velocities=velocities)


def place_obstacles(
    number: tuple[int, int],
    draw: Callable[[], Obstacle],
    points: np.ndarray,
    spacing: float,
    present: Sequence[Obstacle] = (),
) -> tuple[Obstacle, ...]:
    """Draw obstacles whose surfaces keep a distance from each other, and a part of it from points.

    :param number: minimum and maximum number; there are as many as fit
    :param draw: draws one
    :param points: points to keep free, (k, 3), world frame (m)
    :param spacing: the distance (m)
    :param present: obstacles that are there already
    :raises DoesNotFit: if a limited number of draws finds fewer than the minimum
    """
    least, most = number
    placed = list(present)
    for _ in range(_DRAWS_PER_OBSTACLE * most):
        one = draw()
        gaps = clearances(points, surroundings([one])).min(initial=np.inf) / _FREE
        if placed:
            gaps = min(gaps, clearances(np.array([one.position]), surroundings(placed)).min() - one.radius)
        if gaps >= spacing:
            placed.append(one)
        if len(placed) == len(present) + most:
            break
    if len(placed) < len(present) + least:
        raise DoesNotFit(
            f"{least} obstacles at least {spacing:g} m from each other and {_FREE * spacing:g} m from starts and goals "
            "do not fit: choose fewer or smaller ones, or a smaller spacing."
        )
    return tuple(placed[len(present) :])


# In the order of the curriculum, by the number of requests needed (docs/method.md), then those that are in no mixture
SCENARIOS: dict[str, Scenario] = {
    "random": random,
    "random_swap": random_swap,
    "asymmetric_swap": asymmetric_swap,
    "symmetric_swap": symmetric_swap,
    "forest": forest,
    "doorway": doorway,
    "crossing_traffic": crossing_traffic,
    "tour": tour,
    "moving_goals": moving_goals,
}
# Largest number of obstacles that scenarios place themselves
MOST_OBSTACLES: dict[str, Callable[[ScenarioSpace], int]] = {
    "forest": lambda space: space.pillars[1],
    "doorway": lambda space: 2,
    "crossing_traffic": lambda space: space.traffic[1],
}
# Scenarios whose goals change in flight
CHANGING_GOALS = {"tour", "moving_goals"}
MIXTURES = ("mixed", "curriculum")


def extent(scenario: Scenario, space: ScenarioSpace) -> Extent | None:
    """Return the bounds of a scenario, None if it is not one of this module."""
    low, high = space.heights
    if scenario in (random, random_swap, doorway, tour, moving_goals):
        return Extent("half_width", space.half_width, low, high)
    if scenario is asymmetric_swap:
        return Extent("sector_radius", space.sector_radius[1], low, high)
    if scenario in (symmetric_swap, forest, crossing_traffic):
        jitter = space.circle_jitter
        return Extent("circle_radius", space.circle_radius[1] + jitter, low - jitter, high + jitter)
    return None


def without_obstacles() -> list[str]:
    """Return the names of the scenarios of mixtures, which place no obstacles and whose goals stay."""
    return [name for name in SCENARIOS if name not in MOST_OBSTACLES and name not in CHANGING_GOALS]


def most_obstacles(names: Sequence[str], world: SwarmConfig) -> int:
    """Return the largest number of obstacles in an episode of some scenarios of a world."""
    placed = [MOST_OBSTACLES[name](world.space) for name in names if name in MOST_OBSTACLES]
    return world.obstacles.least + max(placed, default=0)


def _succeeds(scenario: Scenario, n_robots: int, space: ScenarioSpace, seed: int) -> bool:
    try:
        scenario(n_robots, space, np.random.default_rng(seed))
    except DoesNotFit:
        return False
    return True


@functools.lru_cache(maxsize=256)
def _fits(scenario: Scenario, n_robots: int, space: ScenarioSpace) -> bool:
    """Return whether at least about half of the attempts to draw an episode succeed, so that `_MOST_ATTEMPTS` do."""
    found = 0
    for seed in range(_TRIALS):
        found += _succeeds(scenario, n_robots, space, seed)
        if 2 * found >= _TRIALS:
            return True
        if seed >= 2 and not found:
            return False
    return False


def _most(scenarios: Sequence[Scenario], n_robots: int, space: ScenarioSpace) -> int:
    """Return about how many robots fit into the room of all scenarios, fewer than ``n_robots``."""
    low, high = 1, n_robots
    while high - low > 1:
        middle = (low + high) // 2
        fits = all(_succeeds(scenario, middle, space, 0) for scenario in scenarios)
        low, high = (middle, high) if fits else (low, middle)
    while low > 1 and not all(_fits(scenario, low, space) for scenario in scenarios):
        low -= 1
    return low


def _larger(field: str, n_robots: int, space: ScenarioSpace) -> str:
    """Return a value of a field with which ``n_robots`` fit, as text."""
    if field == "half_width":
        return f"{math.ceil(9 * space.spacing * math.sqrt(n_robots)) / 10}"
    low, high = getattr(space, field)
    around = (space.spacing + space.circle_jitter) / (2 * math.sin(math.pi / n_robots))
    least = math.ceil(10 * max(low, around if field == "circle_radius" else 1.2 * around)) / 10
    return f"[{least},{round(least + high - low, 3)}]"


class ScenarioSampler:
    """Sampler of episodes of a scenario or a mixture of scenarios.

    Draws that fail, or that the world refuses, are repeated. The obstacles of the world follow those of the scenario.

    :param name: a name of `SCENARIOS`; "mixed" to draw uniformly among `without_obstacles`; "curriculum" to draw
        uniformly among the first ``level + 1`` of them; or a mapping of names to weights, such as
        ``{"symmetric_swap": 3, "random": 1}``, in any order
    :param n_robots: number of robots, at least 2
    :param space: the room
    :param world: the world that the episodes are flown in, whose `SwarmConfig.check_flight` then holds for each of them
    :raises ValueError: if a name is unknown, weights are invalid, there are fewer than two robots, they do not fit
        (`DoesNotFit`), or a scenario leaves the workspace or returns starts or goals that the world refuses
    """

    def __init__(
        self,
        name: str | Mapping[str, float],
        n_robots: int,
        space: ScenarioSpace,
        world: SwarmConfig | None = None,
    ):
        for one in [name] if isinstance(name, str) else name:
            if one not in SCENARIOS and (one not in MIXTURES or not isinstance(name, str)):
                raise unknown_name("scenario", one, [*SCENARIOS, *MIXTURES])
        name = name if isinstance(name, str) else dict(sorted(name.items()))  # equal mappings draw the same
        weights = [] if isinstance(name, str) else [float(weight) for weight in name.values()]
        if not isinstance(name, str) and not (all(weight >= 0 for weight in weights) and 0 < sum(weights) < np.inf):
            raise ValueError(
                f"scenario={dict(name)}: weights must not be negative, and their sum must be positive and finite."
            )
        if n_robots < 2:
            raise ValueError(f"n_robots={n_robots}: a swarm needs at least 2 robots.")
        self.name = name
        self.n_robots = n_robots
        if space.downwash is None and world is not None:
            space = replace(space, downwash=world.planner.downwash)
        self.space = space
        self.world = world
        self.level = 0
        self._weights = np.array(weights) / sum(weights) if weights else None
        if world is not None and (needed := most_obstacles(self._names, world)) > world.obstacles.slots:
            raise ValueError(
                f"obstacles.most={world.obstacles.slots}: in scenario={shown(name)}, there may be {needed} obstacles; "
                "leave it out, or set it to that"
            )
        # Fail now rather than during training
        for scenario in self._names:
            self._check_room(scenario)
        for scenario in self._names:
            if extent(SCENARIOS[scenario], space) is None:
                for seed in range(_TRIALS):
                    self._attempt(scenario, np.random.default_rng(seed))
            elif world is not None and world.obstacles.least:
                self._try_obstacles(scenario)

    def _check_room(self, name: str) -> None:
        """Check a scenario of this module.

        :raises ValueError: if it leaves the workspace, or the robots do not fit
        """
        bounds = extent(SCENARIOS[name], self.space)
        if bounds is None:
            return
        if self.world is not None:
            self.world.check_room(name, bounds)
        if _fits(SCENARIOS[name], self.n_robots, self.space):
            return
        own = [SCENARIOS[one] for one in self._names if extent(SCENARIOS[one], self.space) is not None]
        most = _most(own, self.n_robots, self.space)
        wider = _larger(bounds.field, self.n_robots, self.space)
        others = f"about {most} do" if most > 1 else "not even two do (lengths are in metres)"
        raise DoesNotFit(
            f"{self.n_robots} robots at least {self.space.spacing:g} m apart do not fit into the room of {name!r}; "
            f"{others}. Choose fewer robots, a smaller "
            + ("space.spacing" if self.world is None else f"radius than {self.world.radius:g} or space.spacing")
            + (f", or for example space.{bounds.field}={wider} if the workspace is large enough." if most > 1 else ".")
        )

    def _try_obstacles(self, name: str) -> None:
        """Check that about a tenth of the attempts to draw an episode among the world's obstacles succeed.

        :raises ValueError: if they do not
        """
        found, last = 0, ""
        for seed in range(_TRIALS_AMONG_OBSTACLES):
            try:
                self._attempt(name, np.random.default_rng(seed))
            except ValueError as error:
                last = str(error)
            else:
                found += 1
                if found == _FEWEST:
                    return
        raise DoesNotFit(
            f"{self.n_robots} robots of scenario={name!r} and the world's obstacles: {found} of "
            f"{_TRIALS_AMONG_OBSTACLES} drawn episodes have room for both. Choose fewer robots or obstacles, smaller "
            f"obstacles, or a larger space.half_width if the workspace allows it. What the last one lacked: {last}"
        )

    def _attempt(self, name: str, rng: Rng) -> Scene:
        """Draw an episode once.

        :raises DoesNotFit: if the robots do not fit
        :raises ValueError: if the world refuses what a registered scenario returns; the message names the scenario
        """
        scenario = SCENARIOS[name]
        drawn = scenario(self.n_robots, self.space, rng)
        ours = extent(scenario, self.space) is not None
        try:
            scene = Scene(*drawn)
            obstacles = tuple(scene.obstacles)
            if not all(isinstance(one, Obstacle) for one in obstacles):
                raise ValueError
        except (TypeError, ValueError):
            raise ValueError(
                f"Scenario {name!r} returns {shown(drawn)}: it must return starts and goals, or a `Scene`, whose "
                "obstacles are a sequence of `Obstacle`."
            ) from None
        if self.world is None:
            return scene
        if not ours:
            try:
                starts, targets = self.world.check_flight(
                    scene.starts, scene.goals, obstacles, scene.velocities, scene.waypoints
                )
            except ValueError as error:
                raise ValueError(f"Scenario {name!r}: {error}") from None
            scene = Scene(starts, targets.goals, obstacles, targets.velocities, targets.waypoints)
        return self._with_obstacles(scene, self.world, rng)

    def _with_obstacles(self, scene: Scene, world: SwarmConfig, rng: Rng) -> Scene:
        """Add the world's obstacles.

        :raises DoesNotFit: if those that are drawn do not fit
        :raises ValueError: if those that are listed are in the way of a start or a goal
        """
        config = world.obstacles
        if not config.least:
            return scene
        if config.listed:
            world.check_flight(scene.starts, scene.goals, config.listed, scene.velocities, scene.waypoints)
        present = (*scene.obstacles, *config.listed)
        low, high = (-self.space.half_width, self.space.heights[0]), (self.space.half_width, self.space.heights[1])

        def draw() -> Obstacle:
            x, y = rng.uniform(low[0], high[0], size=2)
            angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*config.speed)
            velocity = (speed * np.cos(angle), speed * np.sin(angle), 0.0)
            return Obstacle((x, y, rng.uniform(low[1], high[1])), rng.uniform(*config.radius), config.shape, velocity)

        spacing = self.space.spacing if config.spacing is None else config.spacing
        count = int(rng.integers(config.number[0], config.number[1], endpoint=True))
        free = np.concatenate([scene.starts, scene.goals, *(() if scene.waypoints is None else scene.waypoints)])
        drawn = place_obstacles((config.number[0], count), draw, free, spacing, present)
        return scene._replace(obstacles=(*present, *drawn))

    @property
    def _names(self) -> list[str]:
        if not isinstance(self.name, str):
            return list(self.name)
        return without_obstacles() if self.name in MIXTURES else [self.name]

    @property
    def n_levels(self) -> int:
        """Number of curriculum levels, 1 without a curriculum."""
        return len(self._names) if self.name == "curriculum" else 1

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

    def sample(self, rng: Rng) -> tuple[str, np.ndarray, np.ndarray, tuple[Obstacle, ...]]:
        """Draw an episode as `draw`, and return the scenario's name, starts (n, 3) and goals (n, 3), world frame (m),
        and obstacles."""
        name, scene = self.draw(rng)
        return name, scene.starts, scene.goals, scene.obstacles

    def draw(self, rng: Rng) -> tuple[str, Scene]:
        """Draw an episode and return the scenario's name and the episode.

        :raises ValueError: if a registered scenario returns starts or goals that the world refuses again and again
        """
        active = self._active()
        if self._weights is not None:
            name = active[int(rng.choice(len(active), p=self._weights))]
        else:
            name = active[int(rng.integers(len(active)))] if len(active) > 1 else active[0]
        for _ in range(_MOST_ATTEMPTS - 1):
            try:
                return name, self._attempt(name, rng)
            except ValueError:
                continue
        return name, self._attempt(name, rng)
