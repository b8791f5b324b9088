"""Plans that travel between robots: with a delay, some of them later than others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_swarm.native.pairs import advance
from quad_swarm.states import like
from quad_swarm.world.beliefs import answered


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
        age = 1 + self._delay
        received = answered(arriving, self._available[-age], others)
        if lateness is None:
            return received, age
        late = lateness[arriving]
        for k in range(1, len(self._available) - self._delay):
            received[late == k] = answered(arriving, self._available[-age - k], others)[late == k]
        return received, age + late

    def reset(self, swarm: int, plans: np.ndarray) -> None:
        """Start one swarm with plans of robots at rest, (n, N + 1, 3) (m)."""
        for earlier in self._earlier:
            earlier[swarm] = plans

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
