"""What each robot believes the others will do (Sec. III-C and IV-A).

In order of preference: the plan it requested (made one step ago), the plan it received earlier while that still fits
what it observes, and a constant velocity.

Arrays carry a leading axis of swarms: E swarms of n robots. ``others`` axes list the n - 1 others of a robot in
ascending order.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import length


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
    times = dt * np.arange(1, horizon + 1)
    return pos[..., None, :] + times[:, None] * vel[..., None, :]


def advance(trajectory: np.ndarray) -> np.ndarray:
    """A trajectory (..., K, 3) seen one step later; its last piece goes on in a straight line."""
    end = 2 * trajectory[..., -1:, :] - trajectory[..., -2:-1, :]
    return np.concatenate([trajectory[..., 1:, :], end], axis=-2)


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

    def forget(self, swarms: np.ndarray) -> None:
        """Forget every received plan in the given swarms (indices or mask)."""
        self._age[swarms] = self.horizon
        self._known = None

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (indices or mask)."""
        self._remembered, self._age = self._remembered[swarms], self._age[swarms]
        self._known = None

    def predict(self, pos: np.ndarray, vel: np.ndarray) -> Prediction:
        """What the robots believe in this step without a request; `update` has not been called for it.

        :param pos: present positions, (E, n, 3), world frame (m)
        :param vel: present velocities, (E, n, 3), world frame (m/s)
        """
        return self._predict_once(pos, vel)[0]

    def _predict_once(self, pos: np.ndarray, vel: np.ndarray) -> tuple[Prediction, np.ndarray]:
        known = self._known
        if known is None or not (np.array_equal(known[0], pos) and np.array_equal(known[1], vel)):
            known = self._known = (pos.copy(), vel.copy(), self._predict(pos, vel))
        return known[2]

    def _predict(self, pos: np.ndarray, vel: np.ndarray) -> tuple[Prediction, np.ndarray]:
        """:return: what is believed, and what is remembered, from now on; nothing else holds these arrays"""
        believed = constant_velocity(pos, vel, self.horizon, self.dt)[:, self.others]
        if not self.memory:
            never = np.full(self._age.shape, self.horizon)
            return Prediction(believed, np.zeros(never.shape, bool), never, np.zeros(never.shape)), self._remembered
        remembered, age = advance(self._remembered), self._age + 1
        error = length(remembered[..., 0, :] - pos[:, self.others])
        remembers = (age < self.horizon) & (error <= self.memory)
        believed[remembers] = remembered[remembers, 1:]
        return Prediction(believed, remembers, age, error), remembered

    def update(
        self, requests: np.ndarray, pos: np.ndarray, vel: np.ndarray, plans: np.ndarray, age: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Believed trajectories after this step's requests.

        :param requests: whose plans each robot receives, (E, n, n - 1) bool
        :param pos: present positions, (E, n, 3), world frame (m)
        :param vel: present velocities, (E, n, 3), world frame (m/s)
        :param plans: positions that each robot planned one step ago, stages 0..N, (E, n, N + 1, 3) (m)
        :param age: steps since these plans were made, if they are older and were advanced to one step ago
        :return: believed positions at the next N steps, (E, n, n - 1, N, 3) (m), and their `BeliefSource`, (E, n, n -
            1)
        """
        prediction, remembered = self._predict_once(pos, vel)
        swarms, robots, places = np.nonzero(requests)
        received = advance(plans)[swarms, self.others[robots, places]]  # now, and the next N steps
        believed = prediction.believed.copy()
        believed[requests] = received[:, 1:]
        unasked = np.where(prediction.remembers, BeliefSource.REMEMBERED, BeliefSource.CONSTANT_VELOCITY)
        source = np.where(requests, BeliefSource.REQUESTED, unasked)
        if self.memory:
            remembered[requests] = received
            self._remembered = remembered
            self._age = np.where(requests, age, prediction.age)
        self._known = None
        return believed, source
