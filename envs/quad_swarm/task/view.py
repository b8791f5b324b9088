"""What a robot knows when it decides whom to ask, for rules and for observations.

Axes of the n - 1 others of a robot have fewer places where its neighbourhood is limited, see `world.neighbours`. Nobody
is in an empty place: it shows a robot that is far away and flies along.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import length
from quad_swarm.native.pairs import advance
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.world.beliefs import PlanApproach, Prediction, of_others
from quad_swarm.world.swarm import Swarm


class Presumed(NamedTuple):
    """What each of the others predicts of a robot, as far as that robot can tell; absolute positions.

    :param believed: where it would be at the stages asked for, (E, n, n - 1, stages, 3) (m)
    :param remembers: whether by a plan, else by a constant velocity, (E, n, n - 1) bool
    :param age: steps since that plan was made, (E, n, n - 1)
    :param error: how far off it is by now, (E, n, n - 1) (m)
    """

    believed: np.ndarray
    remembers: np.ndarray
    age: np.ndarray
    error: np.ndarray


class View:
    """What the robots of E swarms know before they ask, relative to themselves, along the world's axes.

    :param swarm: the swarms
    :param rngs: one generator for each swarm, so that an episode's draws do not depend on what else is in the batch
    """

    def __init__(self, swarm: Swarm, rngs: Sequence[np.random.Generator] = ()):
        self._swarm = swarm
        self.rngs = rngs
        self.memory = swarm.config.memory
        self.horizon = swarm.config.planner.horizon
        self.separation = swarm.config.planner.separation

    @cached_property
    def _observed(self) -> tuple[np.ndarray, np.ndarray]:
        return self._swarm.observe()

    @cached_property
    def _estimate(self) -> np.ndarray:
        return self._swarm.estimate()

    @property
    def own_pos(self) -> np.ndarray:
        """The robot's position, (E, n, 3), world frame (m)."""
        return self._estimate[..., POSITION]

    @property
    def own_vel(self) -> np.ndarray:
        """The robot's velocity, (E, n, 3) (m/s)."""
        return self._estimate[..., VELOCITY]

    @cached_property
    def pos(self) -> np.ndarray:
        """Positions of the others, (E, n, n - 1, 3) (m)."""
        return self._observed[0] - self.own_pos[:, :, None]

    @cached_property
    def vel(self) -> np.ndarray:
        """Velocities of the others relative to the robot's, (E, n, n - 1, 3) (m/s)."""
        return self._observed[1] - self.own_vel[:, :, None]

    @cached_property
    def goal(self) -> np.ndarray:
        """The robot's goal, (E, n, 3) (m)."""
        return self._swarm.goal - self.own_pos

    @cached_property
    def plan(self) -> np.ndarray:
        """The robot's positions at the next N steps by its last plan, (E, n, N, 3) (m)."""
        return self.current_plans[:, :, 1:]

    @cached_property
    def current_plans(self) -> np.ndarray:
        """The same from now on, stages 0..N, (E, n, N + 1, 3) (m)."""
        return self.absolute_plans - self.own_pos[:, :, None]

    @cached_property
    def absolute_plans(self) -> np.ndarray:
        """The same in the world frame, (E, n, N + 1, 3) (m)."""
        return advance(self._swarm.planned_positions())

    @cached_property
    def prediction(self) -> Prediction:
        """What the robot predicts of those it does not ask; absolute positions."""
        return self._swarm.beliefs.predict(*self._observed)

    def expected(self, stages: Sequence[int] | None = None) -> np.ndarray:
        """Where the others will be as far as the robot knows without asking, (E, n, n - 1, stages, 3) (m).

        :param stages: which of the next N steps, from 0 on; None: all
        """
        return self.prediction.believed(stages) - self.own_pos[:, :, None, None]

    def presumed(self, stages: Sequence[int]) -> Presumed:
        """What each of the others predicts of this robot unless it asks, as far as this robot can tell: it knows what
        it answered, and takes every answer to have arrived.

        :param stages: which of the next N steps, from 0 on
        """
        presumed = self._swarm.presume()
        # Who does not perceive this robot has no plan of it
        times = self._swarm.config.planner.dt * (np.array(stages) + 1)
        steady = self.own_pos[:, :, None] + times[:, None] * self.own_vel[:, :, None]
        return Presumed(
            self.of_the_other(presumed.believed(stages), steady[:, :, None]),
            self.of_the_other(presumed.remembers),
            self.of_the_other(presumed.age, self.horizon),
            self.of_the_other(presumed.error),
        )

    def of_the_other(self, field: np.ndarray, otherwise: np.ndarray | float = 0) -> np.ndarray:
        """What each of the others has about this robot, of something that robots have about others, (E, n, n - 1,
        ...).

        :param otherwise: what counts for those that do not perceive this robot: it knows who does
        """
        return self._swarm.neighbours.of_the_other(field, otherwise)

    def of_others(self, field: np.ndarray) -> np.ndarray:
        """What each of its others has, of something that robots have, (E, n, n - 1, ...)."""
        return of_others(field, self._swarm.neighbours.others)

    @property
    def present(self) -> np.ndarray | None:
        """Which of its places for others are taken, (E, n, n - 1) bool; None: all."""
        return self._swarm.neighbours.present

    @property
    def age(self) -> np.ndarray:
        """Steps since the newest plan of each of the others was made, N or more without any, (E, n, n - 1)."""
        return self.prediction.age

    @property
    def drift(self) -> np.ndarray:
        """How far off that plan is by now, (E, n, n - 1) (m)."""
        return self.prediction.error

    @cached_property
    def plan_approach(self) -> PlanApproach:
        """How close the robot's plan comes to what it expects of the others."""
        return self.prediction.approach(self.own_pos, self.plan)

    def approach(self, look_ahead: float) -> tuple[np.ndarray, np.ndarray]:
        """Closest approach if everybody kept the present velocity.

        :param look_ahead: latest time to look at (s)
        :return: distance (m) and time from now (s), both (E, n, n - 1)
        """
        closing = -(self.pos * self.vel).sum(axis=-1)
        speed2 = (self.vel**2).sum(axis=-1)
        time = np.clip(closing / np.maximum(speed2, 1e-12), 0.0, look_ahead)
        return length(self.pos + time[..., None] * self.vel), time
