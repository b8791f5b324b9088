"""Goals that change in flight: they move with a velocity, and robots pass waypoints on the way to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.geometry import length
from quad_swarm.states import like
from quad_swarm.validation import points, vectors

MOST_WAYPOINTS = 1000  # of a robot


class Targets(NamedTuple):
    """Where n robots fly to.

    :param goals: goals now, (n, 3), world frame (m)
    :param velocities: velocities of the goals, (n, 3), world frame (m/s)
    :param waypoints: what each robot passes on the way to its goal, in this order, n arrays (k, 3), world frame (m)
    """

    goals: np.ndarray
    velocities: np.ndarray
    waypoints: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, goals: Any, velocities: Any, waypoints: Any, count: int) -> Targets:
        """Convert goals to arrays.

        :param goals: goals, (n, 3), world frame (m)
        :param velocities: velocities of the goals, (n, 3), world frame (m/s); None for goals that stand
        :param waypoints: waypoints of each robot, n sequences (k, 3), world frame (m), of any lengths; None for none
        :param count: number of robots n
        :raises ValueError: if something has another shape, or numbers are not finite or too large
        """
        return cls(points("goals", goals, count), _velocities(velocities, count), _waypoints(waypoints, count))

    @property
    def change(self) -> bool:
        """Whether the robots' goals change in flight."""
        return bool(np.any(self.velocities)) or any(map(len, self.waypoints))


def _velocities(values: Any, count: int) -> np.ndarray:
    return np.zeros((count, 3)) if values is None else vectors("velocities", values, count)


def _waypoints(values: Any, count: int) -> tuple[np.ndarray, ...]:
    if values is None:
        return (np.zeros((0, 3)),) * count
    if not _is_row(values) or len(values) != count or not all(map(_is_row, values)):
        raise ValueError(
            f"waypoints must be {count} sequences of points, those of each robot, shape (any number, 3) (m), or None; "
            f"got {shown(values)}."
        )
    for k, one in enumerate(values):
        if len(one) > MOST_WAYPOINTS:
            raise ValueError(f"waypoints[{k}] are {len(one)}: a robot may have {MOST_WAYPOINTS}.")
    found = (points(f"waypoints[{k}]", one, len(one)) if len(one) else np.zeros((0, 3)) for k, one in enumerate(values))
    return tuple(found)


def _is_row(values: Any) -> bool:
    return isinstance(values, (list, tuple)) or (isinstance(values, np.ndarray) and values.ndim > 0)


class Route:
    """Goals of E swarms of n robots, some of which change.

    :ivar final: the goals where they are now, (E, n, 3), world frame (m)
    :ivar velocity: their velocities, (E, n, 3), world frame (m/s)
    :ivar waypoints: waypoints of the robots, the last of M of each before its goal, (E, n, M, 3), world frame (m)
    :ivar left: number of those that are still ahead, (E, n)

    :param goal: goals that stand, (E, n, 3), world frame (m)
    """

    def __init__(self, goal: np.ndarray):
        self.final, self.velocity = goal.copy(), np.zeros_like(goal)
        self.waypoints = np.zeros((*goal.shape[:2], 0, 3))
        self.left = np.zeros(goal.shape[:2], dtype=np.int64)

    @property
    def changes(self) -> bool:
        """Whether any goal still changes."""
        return bool(self.left.any()) or bool(self.velocity.any())

    @property
    def at_last(self) -> np.ndarray:
        """Whether no waypoint is ahead of a robot, (E, n) bool."""
        return self.left == 0

    def current(self) -> np.ndarray:
        """Return where the robots fly to now: the next waypoint, or the goal, (E, n, 3), world frame (m)."""
        most = self.waypoints.shape[2]
        if not most:
            return self.final.copy()
        place = np.minimum(most - self.left, most - 1)[..., None, None]
        following = np.take_along_axis(self.waypoints, place, axis=2)[:, :, 0]
        return np.where(self.at_last[..., None], self.final, following)

    def current_velocity(self) -> np.ndarray:
        """Return the velocities of these points, (E, n, 3), world frame (m/s)."""
        return np.where(self.at_last[..., None], self.velocity, 0.0)

    def set(self, swarm: int, robots: Any, targets: Targets) -> None:
        """Give other goals to some robots of a swarm.

        :param swarm: index of the swarm
        :param robots: what indexes the robots
        :param targets: where they fly to
        """
        longest, most = max(map(len, targets.waypoints)), self.waypoints.shape[2]
        if longest > most:
            self.waypoints = np.pad(self.waypoints, ((0, 0), (0, 0), (longest - most, 0), (0, 0)))
            most = longest
        self.final[swarm, robots], self.velocity[swarm, robots] = targets.goals, targets.velocities
        rows = np.zeros((len(targets.goals), most, 3))
        for row, one in zip(rows, targets.waypoints, strict=True):
            row[most - len(one) :] = one
        self.waypoints[swarm, robots] = rows
        self.left[swarm, robots] = [len(one) for one in targets.waypoints]

    def advance(self, time: float) -> None:
        """Let time pass (s)."""
        self.final = self.final + time * self.velocity

    def take(self, positions: np.ndarray, radius: float) -> None:
        """Let robots pass the waypoints that they are at.

        :param positions: where the robots believe to be, (E, n, 3), world frame (m)
        :param radius: distance within which a robot is at a waypoint (m)
        """
        while (passed := ~self.at_last & (length(positions - self.current()) <= radius)).any():
            self.left = self.left - passed

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        for name in ("final", "velocity", "waypoints", "left"):
            setattr(self, name, getattr(self, name)[swarms])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state, see `of_state`."""
        return {name: getattr(self, name).copy() for name in ("final", "velocity", "waypoints", "left")}

    @classmethod
    def of_state(cls, state: Mapping[str, Any], goal: np.ndarray) -> Route:
        """Restore a route from its `state_dict`.

        :param state: the state
        :param goal: goals of the same swarms, (E, n, 3)
        :raises ValueError: if it belongs to other swarms
        """
        route = cls(goal)
        most = np.shape(state["waypoints"])[2] if np.ndim(state["waypoints"]) == 4 else 0
        if most > MOST_WAYPOINTS:
            raise ValueError(f"waypoints: the state has {most} of a robot, which may have {MOST_WAYPOINTS}.")
        route.waypoints = np.zeros((*goal.shape[:2], most, 3))
        for name in ("final", "velocity", "waypoints"):
            setattr(route, name, like(getattr(route, name), state[name], f"{name} of goals"))
        route.left = like(route.left, state["left"], "left of waypoints", 0, most)
        return route

    def __copy__(self) -> Route:
        other = object.__new__(type(self))
        other.__dict__ = self.state_dict()
        return other
