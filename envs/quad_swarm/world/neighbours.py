"""Perception of other robots: all others or, in large swarms, only the nearest others within a range.

A robot has m slots for the others that it perceives: m = n - 1, or fewer if its neighbourhood is limited.
Array axes that are documented as the n - 1 others of a robot list these m slots.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveInt

from quad_swarm.native import pairs
from quad_swarm.states import like
from quad_swarm.validation import PositiveLength, checked
from quad_swarm.world.beliefs import other_indices, reverse_indices


@checked
@dataclass(frozen=True)
class Neighbourhood:
    """Limits of the others that a robot perceives, predicts and may request plans from, by default none.

    :param max_others: maximum number of others, of which the nearest are chosen, as the robot observes them; None for
        all
    :param range: maximum distance of others (m), beyond which robots neither perceive them nor ask them; None for any
        distance. The radio has a range of its own, see `Radio`
    :param look_ahead: time over which the smallest distance at constant velocities decides which others are nearest
        (s); 0 for the current distance. In a crowd, the others that are currently nearest are not the most relevant
    :raises ValueError: if a value is negative or not finite, or a value other than ``look_ahead`` is zero
    """

    max_others: PositiveInt | None = None
    range: PositiveLength | None = None
    look_ahead: Annotated[float, Field(ge=0, le=1e3)] = 0.0

    def slots(self, n_robots: int) -> int:
        """Return the number of slots of a robot.

        :param n_robots: number of robots n per swarm
        """
        return min(self.max_others or n_robots, n_robots - 1)

    def limits(self, n_robots: int) -> bool:
        """Return whether there may be others that a robot does not perceive.

        :param n_robots: number of robots n per swarm
        """
        return self.range is not None or self.slots(n_robots) < n_robots - 1


class Neighbours:
    """The others that the robots of E swarms currently perceive.

    A robot that stays in the neighbourhood keeps its slot, so that memories about it need not be moved. New neighbours
    take the first free slots in ascending order.

    :ivar others: index of the robot in each slot: (n, n - 1) in ascending order if all robots perceive all others,
        otherwise (E, n, m), with the robot's own index in empty slots
    :ivar reverse: slot of the robot at each of these others, of the same shape; -1 if the other does not perceive the
        robot
    :ivar present: whether each slot is taken, (E, n, m) bool; None if all slots always are

    :param n_swarms: number of swarms E
    :param n_robots: number of robots n per swarm
    :param limit: limits of the neighbourhood; None for none
    """

    def __init__(self, n_swarms: int, n_robots: int, limit: Neighbourhood | None = None):
        limit = limit or Neighbourhood()
        self.present: np.ndarray | None = None
        self._n_robots, self._look_ahead = n_robots, limit.look_ahead
        self._range = np.inf if limit.range is None else limit.range
        if limit.limits(n_robots):
            self.others, self.present = self._empty(n_swarms, limit.slots(n_robots))
            self.reverse = np.full(self.others.shape, -1)
        else:
            self.others, self.reverse = other_indices(n_robots), reverse_indices(n_robots)

    def _empty(self, n_swarms: int, n_slots: int) -> tuple[np.ndarray, np.ndarray]:
        shape = (n_swarms, self._n_robots, n_slots)
        own = np.arange(self._n_robots)[:, None]
        return np.broadcast_to(own, shape).astype(np.int64), np.zeros(shape, dtype=bool)

    @property
    def limited(self) -> bool:
        """Whether there may be others that a robot does not perceive."""
        return self.present is not None

    def update(self, pos: np.ndarray, vel: np.ndarray, errors: np.ndarray | None = None) -> np.ndarray:
        """Update the slots of limited neighbourhoods by what robots observe.

        :param pos: positions as the robots estimate their own, (E, n, 3) (m)
        :param vel: velocities as the robots estimate their own, (E, n, 3) (m/s)
        :param errors: additional errors of each robot about the others in its slots, (E, n, m, 6); None for none
        :return: whether another robot, or none, is in the slot now, (E, n, m) bool
        """
        assert self.present is not None
        before = self.others
        self.others, self.present, self.reverse = pairs.neighbours(
            pos, vel, self.others, self.present, self._range, self._look_ahead, errors
        )
        return self.others != before

    def reset(self, swarm: int, pos: np.ndarray, vel: np.ndarray | None = None) -> None:
        """Fill the slots of one swarm.

        :param swarm: index of the swarm
        :param pos: positions as the robots estimate their own, (n, 3) (m)
        :param vel: velocities as the robots estimate their own, (n, 3) (m/s); None at rest
        """
        if self.present is None:
            return
        vel = np.zeros_like(pos) if vel is None else vel
        empty = self._empty(1, self.others.shape[-1])
        fresh = pairs.neighbours(pos[None], vel[None], *empty, self._range, self._look_ahead)
        for mine, new in zip((self.others, self.present, self.reverse), fresh, strict=True):
            mine[swarm] = new[0]

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        if self.present is not None:
            self.others, self.present = self.others[swarms], self.present[swarms]
            self.reverse = self.reverse[swarms]

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the slots, see `load_state_dict`; empty if they never change."""
        if self.present is None:
            return {}
        return {"others": self.others.copy(), "present": self.present.copy(), "reverse": self.reverse.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the slots from `state_dict`.

        :raises ValueError: if the state belongs to other swarms
        """
        if self.present is not None:
            self.others = like(self.others, state["others"], "neighbours", -1, self.others.shape[1] - 1)
            self.present = like(self.present, state["present"], "presence of neighbours")
            self.reverse = like(self.reverse, state["reverse"], "slots at neighbours", -1, self.others.shape[-1] - 1)

    def perceived(self, slots: np.ndarray) -> np.ndarray:
        """Return a mask without empty slots.

        :param slots: mask of slots, (E, n, m) bool
        """
        return slots if self.present is None else slots & self.present

    def of_the_other(self, field: np.ndarray, otherwise: Any = 0) -> np.ndarray:
        """Swap the roles in values that robots have about others: return the values that the others have about the
        robot, (E, n, m, ...).

        :param field: values that robots have about others, (E, n, m, ...)
        :param otherwise: value for others that do not perceive the robot, broadcast to that shape
        """
        if self.present is None:
            return field[:, self.others, self.reverse]
        theirs = field[np.arange(len(field))[:, None, None], self.others, self.reverse]
        unseen = self.reverse < 0
        theirs[unseen] = np.broadcast_to(otherwise, theirs.shape)[unseen]
        return theirs

    def numbers(self) -> np.ndarray:
        """Return the index of the robot in each slot, -1 for an empty slot, (E, n, m), or (n, n - 1) if all robots
        perceive all others."""
        return self.others if self.present is None else np.where(self.present, self.others, -1)

    def numbers_in(self, swarm: int) -> np.ndarray:
        """Return the `numbers` of one swarm, (n, m)."""
        numbers = self.numbers()
        return numbers if self.present is None else numbers[swarm]


def slots_to_robots(slots: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Convert a mask of slots to a mask of all others in ascending order, which is False for others without a slot.

    :param slots: mask of slots, (..., n, m) bool
    :param numbers: indices of the robots in the slots, see `Neighbours.numbers`
    :return: mask of all others, (..., n, n - 1) bool
    """
    n = slots.shape[-2]
    if numbers is other_indices(n):
        return slots
    all_others = np.zeros((*slots.shape[:-1], n - 1), dtype=bool)
    where = np.nonzero(slots & (numbers >= 0))
    other = numbers[where]
    column = (*where[:-1], other - (other > where[-2]))
    all_others[column] = True
    return all_others
