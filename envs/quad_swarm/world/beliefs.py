"""What each robot believes the others will do (Sec. III-C and IV-A).

In order of preference: the plan it requested (made one step ago), the plan it received earlier while that still fits
what it observes, and a constant velocity.

Arrays carry a leading axis of swarms: E swarms of n robots. ``others`` axes list the n - 1 others of a robot in
ascending order.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import length
from quad_swarm.states import like

_FEW = 600  # numbers, below which arranging them takes longer than what is saved


class BeliefSource(IntEnum):
    """Where a believed trajectory comes from."""

    CONSTANT_VELOCITY = 0
    REMEMBERED = 1
    REQUESTED = 2


def other_indices(n_robots: int) -> np.ndarray:
    """For each robot the indices of the others, ascending: (n, n - 1)."""
    return np.array([[j for j in range(n_robots) if j != i] for i in range(n_robots)], dtype=np.int64)


def reverse_indices(n_robots: int) -> np.ndarray:
    """For each robot its own place among the others of each of its others, see `other_indices`: (n, n - 1)."""
    others = other_indices(n_robots)
    return np.array([[row.tolist().index(i) for row in others[others[i]]] for i in range(n_robots)], dtype=np.int64)


def constant_velocity(pos: np.ndarray, vel: np.ndarray, horizon: int, dt: float) -> np.ndarray:
    """Positions at the next ``horizon`` steps if the velocity stayed: (..., 3), (..., 3) -> (..., N, 3) (m)."""
    if pos.size < _FEW:
        return pos[..., None, :] + (dt * np.arange(1, horizon + 1))[:, None] * vel[..., None, :]
    # Stages and coordinates as one axis: numpy is slow along three numbers
    trajectory = np.tile(vel, horizon)
    trajectory *= np.repeat(dt * np.arange(1, horizon + 1), 3)
    trajectory += np.tile(pos, horizon)
    return trajectory.reshape(*pos.shape[:-1], horizon, 3)


def advance(trajectory: np.ndarray) -> np.ndarray:
    """A trajectory (..., K, 3) seen one step later; its last piece goes on in a straight line."""
    end = 2 * trajectory[..., -1:, :] - trajectory[..., -2:-1, :]
    return np.concatenate([trajectory[..., 1:, :], end], axis=-2)


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
    :param others: see `other_indices`
    """
    swarms, robots, places = np.nonzero(arriving)
    return trajectories[swarms, others[robots, places]]


class Prediction(NamedTuple):
    """What robots predict of the others as long as they do not request their plans.

    :param believed: positions at the next N steps, (E, n, n - 1, N, 3), world frame (m)
    :param remembers: whether an earlier plan is believed, else a constant velocity, (E, n, n - 1) bool
    :param age: steps since the newest plan received was made, N or more: none, (E, n, n - 1)
    :param error: how far off that plan is by now, (E, n, n - 1) (m)
    """

    believed: np.ndarray
    remembers: np.ndarray
    age: np.ndarray
    error: np.ndarray


class Beliefs:
    """The believed trajectories of E swarms and the memory behind them.

    :param n_swarms: number of swarms E
    :param n_robots: robots in a swarm n
    :param horizon: stages of a plan N
    :param dt: length of a stage (s)
    :param memory: a plan received earlier is believed while it predicts the observed position to within this distance
        (m) and is younger than N steps; 0 switches the memory off
    """

    def __init__(self, n_swarms: int, n_robots: int, horizon: int, dt: float, memory: float):
        if not memory >= 0:
            raise ValueError(f"memory={memory}: it is a distance in metres, or 0 to switch it off.")
        self.others, self.reverse = other_indices(n_robots), reverse_indices(n_robots)
        self.horizon = horizon
        self.dt = dt
        self.memory = memory
        shape = (n_swarms, n_robots, n_robots - 1)
        # Remembered positions of now and of the next N steps; age in steps since they were planned, N or more: none.
        self._remembered = np.zeros((*shape, horizon + 1, 3))
        self._age = np.full(shape, horizon, dtype=np.int64)
        # The last positions, velocities and prediction: who decides predicts first, and the step does so again.
        self._known: tuple[np.ndarray, np.ndarray, tuple[Prediction, np.ndarray]] | None = None

    @property
    def age(self) -> np.ndarray:
        """Steps since each believed plan was made, as of the last `update`, (E, n, n - 1)."""
        return self._age

    def forget(self, swarms: np.ndarray) -> None:
        """Forget every received plan in the given swarms (indices or mask)."""
        self._age[swarms] = self.horizon
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
        return self._predict_once(pos, vel)[0]

    def _predict_once(self, pos: np.ndarray, vel: np.ndarray) -> tuple[Prediction, np.ndarray]:
        known = self._known
        if known is None or not (np.array_equal(known[0], pos) and np.array_equal(known[1], vel)):
            known = self._known = (pos.copy(), vel.copy(), self._predict(pos, vel))
        return known[2]

    def _predict(self, pos: np.ndarray, vel: np.ndarray) -> tuple[Prediction, np.ndarray]:
        """:return: what is believed, and what is remembered, from now on; nothing else holds these arrays"""
        believed = constant_velocity(pos, vel, self.horizon, self.dt)
        if not self.memory:
            never = np.full(self._age.shape, self.horizon)
            return Prediction(believed, np.zeros(never.shape, bool), never, np.zeros(never.shape)), self._remembered
        remembered, age = advance(self._remembered), self._age + 1
        error = length(remembered[..., 0, :] - pos)
        remembers = (age < self.horizon) & (error <= self.memory)
        believed[remembers] = remembered[remembers, 1:]
        return Prediction(believed, remembers, age, error), remembered

    def update(
        self, arriving: np.ndarray, pos: np.ndarray, vel: np.ndarray, received: np.ndarray, age: np.ndarray | int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Believed trajectories after this step's requests.

        :param arriving: whose plans each robot receives, (E, n, n - 1) bool
        :param pos: present positions of the others, (E, n, n - 1, 3), world frame (m)
        :param vel: present velocities of the others, (E, n, n - 1, 3), world frame (m/s)
        :param received: the plans that arrive, as positions now and at the next N steps, (number of answers, N + 1, 3)
            (m); see `answered`
        :param age: steps since each of them was made, (number of answers,), or one number for all
        :return: believed positions at the next N steps, (E, n, n - 1, N, 3) (m), and their `BeliefSource`, (E, n, n -
            1)
        """
        prediction, remembered = self._predict_once(pos, vel)
        if isinstance(age, np.ndarray):
            # An answer may come after one that was made later.
            newer = age <= prediction.age[arriving]
            arriving, received, age = arriving.copy(), received[newer], age[newer]
            arriving[arriving] = newer
        believed = prediction.believed.copy()
        believed[arriving] = received[:, 1:]
        unasked = np.where(prediction.remembers, BeliefSource.REMEMBERED, BeliefSource.CONSTANT_VELOCITY)
        source = np.where(arriving, BeliefSource.REQUESTED, unasked)
        if self.memory:
            remembered[arriving] = received
            self._remembered = remembered
            self._age = prediction.age.copy()
            self._age[arriving] = age
        else:
            self._age = np.where(arriving, _filled(arriving, age), self.horizon)
        self._known = None
        return believed, source


def _filled(where: np.ndarray, values: np.ndarray | int) -> np.ndarray:
    """An array with values where a mask is true, in its order."""
    filled = np.zeros(where.shape, dtype=np.int64)
    filled[where] = values
    return filled
