"""Plans that travel between robots: with a delay, some of them later than others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_swarm.native.pairs import advance
from quad_swarm.states import like
from quad_swarm.world.beliefs import answered
from quad_swarm.world.disturbances import Radio


def make_channel(radio: Radio, plans: np.ndarray, n_slots: int) -> RadioChannel:
    """Create the channel of a radio.

    :param radio: settings
    :param plans: planned positions of robots at rest, (E, n, N + 1, 3) (m)
    :param n_slots: number of others that a robot perceives
    """
    if radio.round_trip is None:
        return RadioChannel(radio.delay, radio.jitter, plans)
    return CausalChannel(radio.round_trip, radio.jitter, plans, n_slots)


class RadioChannel:
    """The plans of E swarms that answers may contain: those of the last steps, as long as an answer may take.

    :param delay: steps that every answer takes
    :param jitter: maximum number of additional steps
    :param plans: planned positions of robots at rest, (E, n, N + 1, 3) (m)
    """

    def __init__(self, delay: int, jitter: int, plans: np.ndarray):
        self._delay = delay
        # Each from the current step on, oldest first
        self._earlier = [plans.copy() for _ in range(delay + jitter)]
        self._available: list[np.ndarray] = []

    def send(self, plans: np.ndarray) -> None:
        """Begin a step, in which the plans of the last one can be asked for.

        :param plans: planned positions at the start of the last step and of the N steps after it, (E, n, N + 1, 3) (m)
        """
        self._available = [*map(advance, self._earlier), advance(plans)]
        self._earlier = self._available[1:]

    @property
    def newest(self) -> tuple[np.ndarray, int]:
        """The newest plans that robots can send in this step, from the current step on, (E, n, N + 1, 3) (m), and
        their age (steps)."""
        age = 1 + self._delay
        return self._available[-age], age

    def answers(
        self, arriving: np.ndarray, others: np.ndarray, lateness: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | int]:
        """Return the plans that robots receive.

        :param arriving: whose plan each robot receives, (E, n, n - 1) bool
        :param others: see `other_indices` or `Neighbours.others`
        :param lateness: additional steps of each answer, (E, n, n - 1); None for none
        :return: the plans, from the current step on, in the order of ``arriving``, (number of answers, N + 1, 3) (m),
            and their ages (steps), (number of answers,), or one number for all
        """
        newest, age = self.newest
        received = answered(arriving, newest, others)
        if lateness is None:
            return received, age
        late = lateness[arriving]
        for k in range(1, len(self._available) - self._delay):
            received[late == k] = answered(arriving, self._available[-age - k], others)[late == k]
        return received, age + late

    def deliver(
        self, arriving: np.ndarray, others: np.ndarray, lateness: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | int]:
        """Return which plans robots receive in this step, (E, n, n - 1) bool, and these plans and their ages.

        :param arriving: which requests of this step are answered, (E, n, n - 1) bool
        :param others: see `answers`
        :param lateness: see `answers`
        :return: whose plan each robot receives, and what `answers` returns for these
        """
        return (arriving, *self.answers(arriving, others, lateness))

    def forget(self, slots: np.ndarray) -> None:
        """Drop what is on its way to slots whose robot has changed, (E, n, n - 1) bool."""

    def reset(self, swarm: int, plans: np.ndarray, strides: np.ndarray | None = None) -> None:
        """Start one swarm with plans of robots that keep their velocity.

        :param swarm: index of the swarm
        :param plans: planned positions of the last step, (n, N + 1, 3) (m)
        :param strides: how far the robots fly in a step, (n, 3) (m); None for robots at rest
        """
        for steps, earlier in enumerate(reversed(self._earlier), start=1):
            earlier[swarm] = plans
            if strides is not None:
                earlier[swarm] -= steps * strides[:, None]
                for _ in range(steps):
                    earlier[swarm] = advance(earlier[swarm])

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self._earlier, self._available = [plans[swarms] for plans in self._earlier], []

    def state_dict(self) -> list[np.ndarray]:
        """Return the plans of the last steps, see `load_state_dict`."""
        return [plans.copy() for plans in self._earlier]

    def load_state_dict(self, state: Sequence[Any]) -> None:
        """Restore plans from `state_dict`.

        :raises ValueError: if the state belongs to other swarms
        """
        if len(state) != len(self._earlier):
            raise ValueError(f"The state has {len(state)} earlier plans, but this world has {len(self._earlier)}.")
        self._earlier = [like(mine, one, "earlier plans") for mine, one in zip(self._earlier, state, strict=True)]
        self._available = []


class CausalChannel(RadioChannel):
    """A channel on which answers are the plans of the last step, as of their requests, and come later.

    :param round_trip: steps from a request to the use of its answer
    :param jitter: maximum number of additional steps
    :param plans: planned positions of robots at rest, (E, n, N + 1, 3) (m)
    :param n_slots: number of others that a robot perceives
    """

    def __init__(self, round_trip: int, jitter: int, plans: np.ndarray, n_slots: int):
        # The plans on their way are among those of the last steps
        super().__init__(0, round_trip + jitter, plans)
        self._round_trip = round_trip
        # Steps since the plans on their way were made, by the number of steps until they are used, from 1; 0 where
        # nothing is on its way
        self._ages = np.zeros((round_trip + jitter, *plans.shape[:2], n_slots), dtype=np.int64)

    def deliver(
        self, arriving: np.ndarray, others: np.ndarray, lateness: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | int]:
        if not len(self._ages):
            return (arriving, *self.answers(arriving, others))
        _, age = self.newest
        late = self._round_trip if lateness is None else self._round_trip + lateness
        ages = np.concatenate([self._ages + (self._ages > 0), np.zeros_like(self._ages[:1])])
        for steps in range(len(ages)):
            ages[steps][arriving & (late == steps)] = age  # newer than what arrives then from earlier steps
        used, self._ages = ages[0], ages[1:]
        swarms, robots, slots = received = np.nonzero(used)
        senders = others[robots, slots] if others.ndim == 2 else others[received]
        return used > 0, np.stack(self._available)[-used[received], swarms, senders], used[received]

    def forget(self, slots: np.ndarray) -> None:
        self._ages[:, slots] = 0

    def reset(self, swarm: int, plans: np.ndarray, strides: np.ndarray | None = None) -> None:
        super().reset(swarm, plans, strides)
        self._ages[:, swarm] = 0

    def keep(self, swarms: np.ndarray) -> None:
        super().keep(swarms)
        self._ages = self._ages[:, swarms]

    def state_dict(self) -> list[np.ndarray]:
        return [*super().state_dict(), self._ages.copy()]

    def load_state_dict(self, state: Sequence[Any]) -> None:
        *earlier, ages = state
        super().load_state_dict(earlier)
        ages, most = like(self._ages, ages, "ages of plans on their way", 0), len(self._ages)
        if (ages.max(axis=(1, 2, 3), initial=0) > np.arange(most, 0, -1)).any():
            raise ValueError(f"The state has plans on their way for more than the {most} steps of this world.")
        self._ages = ages
