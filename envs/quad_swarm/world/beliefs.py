"""What each robot believes the others will do (Sec. III-C and IV-A).

In order of preference: the plan it requested (made one step ago), the plan it received earlier while that still fits
what it observes, and a constant velocity.

Arrays carry a leading axis of swarms: E swarms of n robots. ``others`` axes list the n - 1 others of a robot in
ascending order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np

from quad_swarm.native import pairs
from quad_swarm.states import like


class BeliefSource(IntEnum):
    """Where a believed trajectory comes from."""

    CONSTANT_VELOCITY = 0
    REMEMBERED = 1
    REQUESTED = 2


@cache
def other_indices(n_robots: int) -> np.ndarray:
    """For each robot the indices of the others, ascending: (n, n - 1), read-only."""
    below = np.arange(n_robots - 1, dtype=np.int64)
    others = below + (below >= np.arange(n_robots)[:, None])
    others.setflags(write=False)
    return others


@cache
def reverse_indices(n_robots: int) -> np.ndarray:
    """For each robot its place among the others of each of its others, see `other_indices`: (n, n - 1), read-only."""
    numbers = np.arange(n_robots, dtype=np.int64)[:, None]
    reverse = numbers - (numbers > other_indices(n_robots))
    reverse.setflags(write=False)
    return reverse


def of_others(field: np.ndarray, others: np.ndarray) -> np.ndarray:
    """What each of its others has, of something that robots have: (E, n, ...) -> (E, n, n - 1, ...).

    :param others: see `other_indices`, or `Neighbours.others`
    """
    return field[:, others] if others.ndim == 2 else field[np.arange(len(others))[:, None, None], others]


def resampled(trajectory: np.ndarray, later: np.ndarray) -> np.ndarray:
    """A trajectory (..., K, 3) at times that are later, or all earlier, by a share of a step, (...) in [0, 1) or
    (-1, 0]; linear in between, and its first and last pieces go on in a straight line."""
    flat = trajectory.reshape(*trajectory.shape[:-2], -1)
    pieces = flat[..., 3:] - flat[..., :-3]
    pieces *= later[..., None]
    moved = flat.copy()
    if (later >= 0).all():
        moved[..., :-3] += pieces
        moved[..., -3:] += pieces[..., -3:]
    else:
        moved[..., 3:] += pieces
        moved[..., :3] += pieces[..., :3]
    return moved.reshape(trajectory.shape)


def answered(arriving: np.ndarray, trajectories: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Of trajectories of all robots, (E, n, K, 3), those that reach who asked for them, (number of answers, K, 3).

    :param arriving: whose trajectory each robot receives, (E, n, n - 1) bool; the order is that of its true entries
    :param others: see `other_indices`, or `Neighbours.others`
    """
    swarms, robots, places = np.nonzero(arriving)
    senders = others[robots, places] if others.ndim == 2 else others[swarms, robots, places]
    return trajectories[swarms, senders]


class PlanApproach(NamedTuple):
    """How close a plan comes to what is believed of the others.

    :param least: least distance over the next N steps, (E, n, n - 1) (m)
    :param stage: at which of them it is reached first, from 0 on, (E, n, n - 1)
    :param last: distance at the last of them, (E, n, n - 1) (m)
    """

    least: np.ndarray
    stage: np.ndarray
    last: np.ndarray


@dataclass(frozen=True)
class Prediction:
    """What robots predict of the others as long as they do not request their plans.

    :param pos: positions of the others, (E, n, n - 1, 3), world frame (m)
    :param vel: velocities of the others, (E, n, n - 1, 3), world frame (m/s)
    :param remembered: plans received last, from now on, (E, n, n - 1, N + 1, 3), world frame (m)
    :param remembers: whether those are believed, else a constant velocity, (E, n, n - 1) bool
    :param age: steps since the newest plan received was made, N or more: none, (E, n, n - 1)
    :param error: how far off that plan is by now, (E, n, n - 1) (m)
    :param dt: length of a stage (s)
    """

    pos: np.ndarray
    vel: np.ndarray
    remembered: np.ndarray
    remembers: np.ndarray
    age: np.ndarray
    error: np.ndarray
    dt: float

    def believed(self, stages: Sequence[int] | None = None) -> np.ndarray:
        """Positions at some of the next N steps, 0 is the first; at all of them if None: (E, n, n - 1, stages, 3),
        world frame (m)."""
        return pairs.believe(self.pos, self.vel, self.remembered, self.remembers, self.dt, stages)

    def approach(self, own: np.ndarray, plan: np.ndarray) -> PlanApproach:
        """How close plans come to what is believed.

        :param own: the robots' positions, (E, n, 3), world frame (m)
        :param plan: their positions at the next N steps relative to that, (E, n, N, 3) (m)
        """
        return PlanApproach(*pairs.approach(own, plan, self.pos, self.vel, self.remembered, self.remembers, self.dt))


class Beliefs:
    """The believed trajectories of E swarms and the memory behind them.

    :param n_swarms: number of swarms E
    :param n_robots: robots in a swarm n
    :param horizon: stages of a plan N
    :param dt: length of a stage (s)
    :param memory: a plan received earlier is believed while it predicts the observed position to within this distance
        (m) and is younger than N steps; 0 switches the memory off
    :param n_others: of how many others a robot believes something; None: of all n - 1
    """

    def __init__(
        self, n_swarms: int, n_robots: int, horizon: int, dt: float, memory: float, n_others: int | None = None
    ):
        if not memory >= 0:
            raise ValueError(f"memory={memory}: it is a distance in metres, or 0 to switch it off.")
        self.horizon = horizon
        self.dt = dt
        self.memory = memory
        shape = (n_swarms, n_robots, n_robots - 1 if n_others is None else n_others)
        # Remembered positions of now and of the next N steps; age in steps since they were planned, N or more: none.
        self._remembered = np.zeros((*shape, horizon + 1, 3))
        self._age = np.full(shape, horizon, dtype=np.int64)
        # The last prediction: who decides predicts first, and the step does so again.
        self._known: Prediction | None = None

    @property
    def age(self) -> np.ndarray:
        """Steps since each believed plan was made, as of the last `update`, (E, n, n - 1)."""
        return self._age

    def forget(self, swarms: np.ndarray) -> None:
        """Forget every received plan in the given swarms (indices or mask)."""
        self._age[swarms] = self.horizon
        self._known = None

    def forget_others(self, places: np.ndarray) -> None:
        """Forget what was received from some of the others, (E, n, n - 1) bool."""
        self._age[places] = self.horizon
        self._remembered[places] = 0.0
        self._known = None

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (indices or mask)."""
        self._remembered, self._age = self._remembered[swarms], self._age[swarms]
        self._known = None

    def state_dict(self) -> dict[str, np.ndarray]:
        """What is remembered, see `load_state_dict`."""
        return {"remembered": self._remembered.copy(), "age": self._age.copy()}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from what `state_dict` gave.

        :raises ValueError: the state of other teams
        """
        self._remembered = like(self._remembered, state["remembered"], "remembered plans")
        self._age = like(self._age, state["age"], "ages of plans")
        self._known = None

    def predict(self, pos: np.ndarray, vel: np.ndarray) -> Prediction:
        """What the robots believe in this step without a request; `update` has not been called for it.

        :param pos: present positions of the others, (E, n, n - 1, 3), world frame (m)
        :param vel: present velocities of the others, (E, n, n - 1, 3), world frame (m/s)
        """
        known = self._known
        if known is None or not (np.array_equal(known.pos, pos) and np.array_equal(known.vel, vel)):
            known = self._known = self._predict(pos.copy(), vel.copy())
        return known

    def _predict(self, pos: np.ndarray, vel: np.ndarray) -> Prediction:
        if self.memory:
            remembered, age, error, remembers = pairs.remember(self._remembered, self._age, pos, self.memory)
        else:
            remembered, age = self._remembered, np.full(self._age.shape, self.horizon)
            error, remembers = np.zeros(age.shape), np.zeros(age.shape, dtype=bool)
        return Prediction(pos, vel, remembered, remembers, age, error, self.dt)

    def update(
        self, arriving: np.ndarray, pos: np.ndarray, vel: np.ndarray, received: np.ndarray, age: np.ndarray | int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Believed trajectories after this step's requests; arguments as in `receive`.

        :return: believed positions at the next N steps, (E, n, n - 1, N, 3) (m), and their `BeliefSource`, (E, n, n -
            1)
        """
        prediction = self.predict(pos, vel)
        believed = prediction.believed()
        arriving, received = self.receive(arriving, pos, vel, received, age)
        believed[arriving] = received[:, 1:]
        unasked = np.where(prediction.remembers, BeliefSource.REMEMBERED, BeliefSource.CONSTANT_VELOCITY)
        return believed, np.where(arriving, BeliefSource.REQUESTED, unasked)

    def receive(
        self, arriving: np.ndarray, pos: np.ndarray, vel: np.ndarray, received: np.ndarray, age: np.ndarray | int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Keep what arrives, and let a step pass for what is remembered.

        :param arriving: whose plans each robot receives, (E, n, n - 1) bool
        :param pos: present positions of the others, (E, n, n - 1, 3), world frame (m)
        :param vel: present velocities of the others, (E, n, n - 1, 3), world frame (m/s)
        :param received: the plans that arrive, as positions now and at the next N steps, (number of answers, N + 1, 3)
            (m); see `answered`
        :param age: steps since each of them was made, (number of answers,), or one number for all
        :return: those of the answers that are newer than what was known: who receives them, and the plans
        """
        prediction = self.predict(pos, vel)
        if isinstance(age, np.ndarray):
            # An answer may come after one that was made later.
            newer = age <= prediction.age[arriving]
            arriving, received, age = arriving.copy(), received[newer], age[newer]
            arriving[arriving] = newer
        if self.memory:
            self._remembered = prediction.remembered  # nobody else reads it any more
            self._remembered[arriving] = received
            self._age = prediction.age.copy()
            self._age[arriving] = age
        else:
            self._age = np.where(arriving, _filled(arriving, age), self.horizon)
        self._known = None
        return arriving, received


def _filled(where: np.ndarray, values: np.ndarray | int) -> np.ndarray:
    """An array with values where a mask is true, in its order."""
    filled = np.zeros(where.shape, dtype=np.int64)
    filled[where] = values
    return filled
