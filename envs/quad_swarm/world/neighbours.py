"""Whom each robot perceives: all others or, in large swarms, only the nearest of those within a range.

A robot has a place for each of the others that it perceives: m = n - 1 of them, or fewer where its neighbourhood is
limited. Wherever an axis of an array is said to list the n - 1 others of a robot, it lists these m places.
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
    """Whom a robot perceives, predicts and may ask: by default everybody.

    :param max_others: so many others at most, the nearest; None: all
    :param range: others within this distance, of sensors and radio alike (m); None: any
    :param look_ahead: who is nearest is decided by how near they would come within so long, with the present velocities
        (s); 0: by the present distance. In a crowd the nearest are not those that matter
    :raises ValueError: a value is negative, not finite or, but for the look ahead, zero
    """

    max_others: PositiveInt | None = None
    range: PositiveLength | None = None
    look_ahead: Annotated[float, Field(ge=0, le=1e3)] = 0.0

    def places(self, n_robots: int) -> int:
        """Of how many others a robot perceives something at most."""
        return min(self.max_others or n_robots, n_robots - 1)

    def limits(self, n_robots: int) -> bool:
        """Whether robots may miss others."""
        return self.range is not None or self.places(n_robots) < n_robots - 1


class Neighbours:
    """Whom the robots of E swarms perceive now.

    One that stays in the neighbourhood keeps its place, so that whatever is remembered about it needs not be moved. Who
    comes takes the first place that is free, of several who come at once the one with the lowest number first.

    :ivar others: who has each place, (n, n - 1) ascending where everybody perceives everybody, else (E, n, m); an empty
        place has the robot's own number
    :ivar reverse: place of a robot at each of those, of the same shape; -1 where that one does not perceive the robot
    :ivar present: which places are taken, (E, n, m) bool; None: always all

    :param n_swarms: number of swarms E
    :param n_robots: robots in a swarm n
    :param limit: whom they may perceive; None: everybody
    """

    def __init__(self, n_swarms: int, n_robots: int, limit: Neighbourhood | None = None):
        limit = limit or Neighbourhood()
        self.present: np.ndarray | None = None
        self._n_robots, self._look_ahead = n_robots, limit.look_ahead
        self._range = np.inf if limit.range is None else limit.range
        if limit.limits(n_robots):
            self.others, self.present = self._empty(n_swarms, limit.places(n_robots))
            self.reverse = np.full(self.others.shape, -1)
        else:
            self.others, self.reverse = other_indices(n_robots), reverse_indices(n_robots)

    def _empty(self, n_swarms: int, n_places: int) -> tuple[np.ndarray, np.ndarray]:
        shape = (n_swarms, self._n_robots, n_places)
        own = np.arange(self._n_robots)[:, None]
        return np.broadcast_to(own, shape).astype(np.int64), np.zeros(shape, dtype=bool)

    @property
    def limited(self) -> bool:
        """Whether robots may miss others."""
        return self.present is not None

    def update(self, pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
        """Look who is near now, where robots may miss others.

        :param pos: positions, (E, n, 3) (m)
        :param vel: velocities, (E, n, 3) (m/s)
        :return: the places that somebody else has now, or nobody, (E, n, m) bool
        """
        assert self.present is not None
        before = self.others
        self.others, self.present, self.reverse = pairs.neighbours(
            pos, vel, self.others, self.present, self._range, self._look_ahead
        )
        return self.others != before

    def reset(self, swarm: int, pos: np.ndarray) -> None:
        """Fill the places of one swarm, which is at rest, anew.

        :param pos: positions, (n, 3) (m)
        """
        if self.present is None:
            return
        empty = self._empty(1, self.others.shape[-1])
        fresh = pairs.neighbours(pos[None], np.zeros((1, *pos.shape)), *empty, self._range, self._look_ahead)
        for mine, new in zip((self.others, self.present, self.reverse), fresh, strict=True):
            mine[swarm] = new[0]

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        if self.present is not None:
            self.others, self.present = self.others[swarms], self.present[swarms]
            self.reverse = self.reverse[swarms]

    def state_dict(self) -> dict[str, np.ndarray]:
        """Who has each place, see `load_state_dict`; nothing where that never changes."""
        if self.present is None:
            return {}
        return {"others": self.others.copy(), "present": self.present.copy(), "reverse": self.reverse.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state_dict` gave.

        :raises ValueError: the state of other swarms
        """
        if self.present is not None:
            self.others = like(self.others, state["others"], "neighbours")
            self.present = like(self.present, state["present"], "which neighbours are present")
            self.reverse = like(self.reverse, state["reverse"], "places at the neighbours")

    def perceived(self, places: np.ndarray) -> np.ndarray:
        """Some places (mask), (E, n, m) bool, without those that are empty."""
        return places if self.present is None else places & self.present

    def of_the_other(self, field: np.ndarray, otherwise: Any = 0) -> np.ndarray:
        """What each of the others has about a robot, of something that robots have about others, (E, n, m, ...).

        :param otherwise: what counts for those that do not perceive the robot, broadcast to that shape
        """
        if self.present is None:
            return field[:, self.others, self.reverse]
        theirs = field[np.arange(len(field))[:, None, None], self.others, self.reverse]
        unseen = self.reverse < 0
        theirs[unseen] = np.broadcast_to(otherwise, theirs.shape)[unseen]
        return theirs

    def numbers(self) -> np.ndarray:
        """Who has each place, -1 for nobody, (E, n, m), or (n, n - 1) where it is the same for all swarms."""
        return self.others if self.present is None else np.where(self.present, self.others, -1)

    def numbers_in(self, swarm: int) -> np.ndarray:
        """The same in one swarm, (n, m)."""
        numbers = self.numbers()
        return numbers if self.present is None else numbers[swarm]


def spread(places: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """What is known of the places of each robot by the number of the other instead: of all n - 1 others, in ascending
    order, (..., n, n - 1).

    :param places: bool, (..., n, m)
    :param numbers: see `Neighbours.numbers`
    """
    n = places.shape[-2]
    if numbers is other_indices(n):
        return places
    all_others = np.zeros((*places.shape[:-1], n - 1), dtype=bool)
    where = np.nonzero(places & (numbers >= 0))
    other = numbers[where]
    column = (*where[:-1], other - (other > where[-2]))
    all_others[column] = True
    return all_others
