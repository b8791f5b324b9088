"""Obstacles: spheres and vertical cylinders that stand, or move along lines that all robots know.

For a planner, an obstacle is one more body to avoid, see `quad_swarm.planner.Problems`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from quad_swarm.geometry import closest_approach, dot
from quad_swarm.states import like
from quad_swarm.validation import Coordinate, Count, Length, PositiveLength, Range, checked

Shape = Literal["cylinder", "sphere"]
_FACTORS = {"cylinder": (1.0, 1.0, 0.0), "sphere": (1.0, 1.0, 1.0)}
_NOWHERE = 500.0  # x of obstacles that are not there (m)


@checked
@dataclass(frozen=True)
class Obstacle:
    """An obstacle.

    :param position: centre at the start of an episode, world frame (m); of a cylinder, which is as high as the world,
        the height does not matter
    :param radius: radius (m)
    :param shape: "cylinder" (vertical) or "sphere"
    :param velocity: constant velocity, world frame (m/s)
    :raises ValueError: if a value is out of range
    """

    position: tuple[Coordinate, Coordinate, Coordinate]
    radius: PositiveLength
    shape: Shape = "cylinder"
    velocity: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return any(self.velocity)

    def after(self, time: float) -> Obstacle:
        """Return the obstacle where it is after some time (s)."""
        if not self.moves:
            return self
        x, y, z = (where + time * speed for where, speed in zip(self.position, self.velocity, strict=True))
        return replace(self, position=(x, y, z))


@checked
@dataclass(frozen=True)
class ObstacleConfig:
    """The obstacles of a world: those that are listed, and some that are drawn for each episode.

    :param listed: obstacles of every episode
    :param number: minimum and maximum number of obstacles that are drawn, of which there are as many as fit
    :param shape: shape of those
    :param radius: minimum and maximum of their radius (m)
    :param speed: minimum and maximum of their horizontal speed (m/s), in any direction
    :param spacing: minimum distance between the surfaces of an obstacle that is drawn and of others (m), by default
        that of starts; it is at least 0.6 times as far from starts and goals
    :param margin: distance that planners keep between the surfaces of robots and obstacles (m); by default that between
        two robots, at least 5 cm
    :param most: largest number of obstacles of an episode, which sets the sizes of arrays and observations; by default
        those listed and the most that are drawn. Scenarios with obstacles of their own set it
    :raises ValueError: if a value is out of range, or ``most`` is too small
    """

    listed: tuple[Obstacle, ...] = ()
    number: tuple[Count, Count] = (0, 0)
    shape: Shape = "cylinder"
    radius: Range = (0.15, 0.4)
    speed: Range = (0.0, 0.0)
    spacing: Length | None = None
    margin: Length | None = None
    most: Count | None = None

    def __post_init__(self) -> None:
        if self.number[0] > self.number[1]:
            raise ValueError(f"obstacles.number={self.number}: it must be the lowest number first, then the highest")
        if self.radius[0] <= 0 or self.speed[0] < 0:
            raise ValueError(
                f"obstacles.radius={self.radius}, obstacles.speed={self.speed}: radii must be positive, and speeds not "
                "negative"
            )
        if self.most is not None and self.most < self.least:
            raise ValueError(
                f"obstacles.most={self.most}: there may be {self.least} obstacles, {len(self.listed)} listed and "
                f"{self.number[1]} drawn; leave it out"
            )

    @property
    def least(self) -> int:
        """Largest number of obstacles without those of a scenario."""
        return len(self.listed) + self.number[1]

    @property
    def slots(self) -> int:
        """Largest number K of obstacles of an episode."""
        return self.least if self.most is None else self.most


class Surroundings(NamedTuple):
    """Obstacles as arrays.

    :param position: centres now, (K, 3), world frame (m)
    :param velocity: velocities, (K, 3), world frame (m/s)
    :param radius: radii, (K,) (m)
    :param factors: factors of differences along x, y and z in distances to them, (K, 3), see
        `quad_swarm.planner.Problems`
    """

    position: np.ndarray
    velocity: np.ndarray
    radius: np.ndarray
    factors: np.ndarray


def surroundings(obstacles: Sequence[Obstacle], slots: int | None = None) -> Surroundings:
    """Return obstacles as arrays.

    :param obstacles: obstacles
    :param slots: number of rows K, the last of which are obstacles of no size, far away; by default as many as there
        are obstacles
    :raises ValueError: if there are more
    """
    count = len(obstacles)
    slots = count if slots is None else slots
    if count > slots:
        raise ValueError(
            f"There are {count} obstacles, but obstacles.most={slots}: set it to {count} in the world, whose arrays "
            "and observations have that size."
        )
    nowhere = (_NOWHERE, 0.0, 0.0)
    rest = slots - count
    return Surroundings(
        np.array([*(one.position for one in obstacles), *[nowhere] * rest], float).reshape(slots, 3),
        np.array([*(one.velocity for one in obstacles), *[(0.0, 0.0, 0.0)] * rest], float).reshape(slots, 3),
        np.array([*(one.radius for one in obstacles), *[0.0] * rest], float),
        np.array([*(_FACTORS[one.shape] for one in obstacles), *[_FACTORS["sphere"]] * rest], float).reshape(slots, 3),
    )


def between(points: np.ndarray, centres: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return what is as long as points are away from centres, or from the axes of cylinders.

    :param points: points, (..., n, 3) (m)
    :param centres: centres of obstacles, (..., K, 3) (m)
    :param factors: see `Surroundings`, (..., K, 3)
    :return: vectors, (..., n, K, 3) (m)
    """
    return factors[..., None, :, :] * (points[..., :, None, :] - centres[..., None, :, :])


def clearances(points: np.ndarray, obstacles: Surroundings) -> np.ndarray:
    """Return the distances between points, (n, 3), and the surfaces of obstacles, (n, K) (m), negative inside."""
    away = between(points, obstacles.position, obstacles.factors)
    return np.sqrt(dot(away, away)) - obstacles.radius


class Obstacles:
    """The obstacles of E swarms, K each.

    :ivar position: centres now, (E, K, 3), world frame (m)
    :ivar velocity: velocities, (E, K, 3), world frame (m/s)
    :ivar radius: radii, (E, K) (m); 0 of those that are not there
    :ivar factors: see `Surroundings`, (E, K, 3)

    :param n_swarms: number of swarms E
    :param slots: largest number K of obstacles
    """

    def __init__(self, n_swarms: int, slots: int):
        nobody = surroundings((), slots)
        self.position, self.velocity, self.radius, self.factors = (
            np.repeat(array[None], n_swarms, axis=0) for array in nobody
        )

    @classmethod
    def of(cls, config: ObstacleConfig, n_swarms: int) -> Obstacles | None:
        """Return the obstacles of a world, None if it has none."""
        return cls(n_swarms, config.slots) if config.slots else None

    @property
    def slots(self) -> int:
        """Largest number K of obstacles."""
        return self.radius.shape[1]

    @property
    def present(self) -> np.ndarray:
        """Which of them are there, (E, K) bool."""
        return self.radius > 0

    def reset(self, swarm: int, obstacles: Sequence[Obstacle]) -> None:
        """Place the obstacles of one swarm.

        :raises ValueError: if there are more than K
        """
        for mine, fresh in zip(self._arrays(), surroundings(obstacles, self.slots), strict=True):
            mine[swarm] = fresh

    def of_swarm(self, swarm: int) -> tuple[Obstacle, ...]:
        """Return the obstacles of one swarm, where they are now."""
        arrays = zip(*(array[swarm][self.present[swarm]].tolist() for array in self._arrays()), strict=True)
        return tuple(
            Obstacle(tuple(position), radius, "sphere" if factors[2] else "cylinder", tuple(velocity))
            for position, velocity, radius, factors in arrays
        )

    def ahead(self, times: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return where robots expect the obstacles.

        :param times: times from now, (E, n, N) (s)
        :param out: array to fill and return
        :return: centres, (E, n, K, N, 3), world frame (m)
        """
        moved = np.multiply(times[:, :, None, :, None], self.velocity[:, None, :, None], out=out)
        moved += self.position[:, None, :, None]
        return moved

    def advance(self, time: float) -> None:
        """Let time pass (s)."""
        self.position = self.position + time * self.velocity

    def measure(self, positions: np.ndarray, radii: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Measure the distances between the surfaces of robots and obstacles, which both move in straight lines between
        sub-steps. Call this before `advance`.

        :param positions: positions of the robots before a step and after each of its S sub-steps, (S + 1, E, n, 3) (m)
        :param radii: radii of the robots, (n,) (m)
        :param dt: length of the step (s)
        :return: distances after the step and the smallest during it, (E, n, K) each (m), infinity for obstacles that
            are not there, negative where bodies overlap
        """
        parts = len(positions) - 1
        times = dt / parts * np.arange(parts + 1)
        centres = self.position + times[:, None, None, None] * self.velocity
        away = between(positions, centres, self.factors)
        closest, _ = closest_approach(away[:-1], away[1:] - away[:-1], 1.0)
        reach = self.radius[:, None] + radii[:, None]
        after, during = np.sqrt(dot(away[-1], away[-1])), np.sqrt(dot(closest, closest).min(axis=0))
        there = self.present[:, None]
        return np.where(there, after - reach, np.inf), np.where(there, during - reach, np.inf)

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.position, self.velocity, self.radius, self.factors = (array[swarms] for array in self._arrays())

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state, see `load_state_dict`."""
        return dict(zip(Surroundings._fields, (array.copy() for array in self._arrays()), strict=True))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`.

        :raises ValueError: if it belongs to other swarms
        """
        self.position, self.velocity, self.radius, self.factors = (
            like(array, state[name], f"{name} of obstacles")
            for name, array in zip(Surroundings._fields, self._arrays(), strict=True)
        )

    def __copy__(self) -> Obstacles:
        other = object.__new__(type(self))
        other.position, other.velocity, other.radius, other.factors = (array.copy() for array in self._arrays())
        return other

    def _arrays(self) -> Surroundings:
        return Surroundings(self.position, self.velocity, self.radius, self.factors)
