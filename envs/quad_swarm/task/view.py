"""The knowledge of robots when they decide on requests, for rules and observations.

If the neighbourhood is limited, axes of length n - 1 have fewer entries, one per slot, see `world.neighbours`. An empty
slot shows a robot that is far away and has the same velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import closest_approach, flattened, length
from quad_swarm.native.pairs import advance, nearest_obstacle
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.world.anticipation import Scene
from quad_swarm.world.beliefs import PlanApproach, Prediction, of_others
from quad_swarm.world.knowledge import Knowledge, SeenByOthers


class ObstacleApproach(NamedTuple):
    """The point of trajectories that is nearest to the surface of an obstacle, where there is one.

    :param gap: distance between the surfaces of robot and obstacle there, (...) (m), infinity without obstacles
    :param stage: the step at which it is reached, counting from 0, (...)
    :param towards: direction from the robot to the obstacle's centre or axis, (..., 3), world frame; 0 without
        obstacles
    """

    gap: np.ndarray
    stage: np.ndarray
    towards: np.ndarray


class View:
    """The knowledge of the robots of E swarms before they make requests. Positions are relative to the robot, along the
    world's axes. Distances between robots whose radii are not the world's count as in `SwarmConfig`.

    :ivar bodies: how large the robots and their others are

    :param knowledge: the swarms, or a robot of its own
    :param rngs: one random number generator per swarm, so that an episode does not depend on the batch it is in
    """

    def __init__(self, knowledge: Knowledge, rngs: Sequence[np.random.Generator] = ()):
        self._knowledge = knowledge
        self.rngs = rngs
        self.memory = knowledge.config.memory
        self.horizon = knowledge.config.planner.horizon
        self.separation = knowledge.config.planner.separation
        self._downwash = knowledge.config.planner.downwash
        self.bodies = knowledge.bodies

    @cached_property
    def _observed(self) -> tuple[np.ndarray, np.ndarray]:
        return self._knowledge.observe()

    @cached_property
    def _estimate(self) -> np.ndarray:
        return self._knowledge.estimate()

    @property
    def own_pos(self) -> np.ndarray:
        """Estimated positions of the robots, (E, n, 3), world frame (m)."""
        return self._estimate[..., POSITION]

    @property
    def own_vel(self) -> np.ndarray:
        """Estimated velocities of the robots, (E, n, 3) (m/s)."""
        return self._estimate[..., VELOCITY]

    @cached_property
    def pos(self) -> np.ndarray:
        """Relative positions of the others, (E, n, n - 1, 3) (m)."""
        return self._observed[0] - self.own_pos[:, :, None]

    @cached_property
    def distance(self) -> np.ndarray:
        """Distances to the others, (E, n, n - 1) (m)."""
        return self._less(length(self.pos))

    def _less(self, distance: np.ndarray) -> np.ndarray:
        """Return distances between centres as distances of robots of the world's radius, (E, n, n - 1) (m)."""
        return distance if self.bodies.excess is None else distance - self.bodies.excess

    @cached_property
    def vel(self) -> np.ndarray:
        """Relative velocities of the others, (E, n, n - 1, 3) (m/s)."""
        return self._observed[1] - self.own_vel[:, :, None]

    @cached_property
    def goal(self) -> np.ndarray:
        """Relative positions of the robots' goals, (E, n, 3) (m)."""
        return self._knowledge.goal - self.own_pos

    @cached_property
    def plan(self) -> np.ndarray:
        """Positions at the next N steps by the robot's own last plan, (E, n, N, 3) (m)."""
        return self.current_plans[:, :, 1:]

    @cached_property
    def current_plans(self) -> np.ndarray:
        """Positions now and at the next N steps by the robot's own last plan, (E, n, N + 1, 3) (m)."""
        return self.absolute_plans - self.own_pos[:, :, None]

    @cached_property
    def absolute_plans(self) -> np.ndarray:
        """Like `current_plans`, but in the world frame, (E, n, N + 1, 3) (m)."""
        return advance(self._knowledge.planned_positions())

    @cached_property
    def prediction(self) -> Prediction:
        """Predictions of the others without requests, in the world frame."""
        return self._knowledge.beliefs.predict(*self._observed, Scene(self._estimate, self._knowledge.obstacles))

    def expected(self, stages: Sequence[int] | None = None) -> np.ndarray:
        """Return the predicted relative positions of the others without requests, (E, n, n - 1, stages, 3) (m).

        :param stages: indices among the next N steps, counting from 0; None for all
        """
        return self.prediction.believed(stages) - self.own_pos[:, :, None, None]

    def seen_by_others(self, stages: Sequence[int]) -> SeenByOthers:
        """Return how each of the others predicts this robot without a request, as far as this robot knows. It knows the
        plans that it sent and assumes that all of them arrived.

        :param stages: indices among the next N steps, counting from 0
        """
        return self._knowledge.seen_by_others(stages)

    def of_the_other(self, field: np.ndarray, otherwise: np.ndarray | float = 0) -> np.ndarray:
        """Swap the roles in values that robots have about others: return the values that the others have about this
        robot, (E, n, n - 1, ...).

        :param field: values that robots have about others, (E, n, n - 1, ...)
        :param otherwise: value for others that do not perceive this robot, which knows who does
        """
        return self._knowledge.neighbours.of_the_other(field, otherwise)

    def of_others(self, field: np.ndarray) -> np.ndarray:
        """Return the values of each robot's others, (E, n, n - 1, ...).

        :param field: values of all robots, (E, n, ...)
        """
        return of_others(field, self._knowledge.neighbours.others)

    @property
    def present(self) -> np.ndarray | None:
        """Whether each slot is taken, (E, n, n - 1) bool; None if all slots always are."""
        return self._knowledge.neighbours.present

    @property
    def age(self) -> np.ndarray:
        """Steps since the newest received plan of each of the others was made, N or more without one, (E, n, n - 1)."""
        return self.prediction.age

    @property
    def drift(self) -> np.ndarray:
        """Current error of the newest received plan of each of the others, (E, n, n - 1) (m)."""
        return self.prediction.error

    @cached_property
    def plan_approach(self) -> PlanApproach:
        """Closest approach of the robot's own plan to the predicted others, in the metric of the planner's downwash."""
        return self.approach_of(self.prediction)

    def approach_of(self, prediction: Prediction) -> PlanApproach:
        """Return the closest approach of the robot's own plan to other predictions, in the same metric."""
        found = prediction.flattened(1 / self._downwash).approach(self._flat(self.own_pos), self._flat(self.plan))
        if self.bodies.excess is None:
            return found
        return found._replace(least=self._less(found.least), last=self._less(found.last))

    def _flat(self, vectors: np.ndarray) -> np.ndarray:
        return flattened(vectors, self._downwash)

    @cached_property
    def own_obstacle(self) -> ObstacleApproach:
        """The nearest obstacle to the robot's own plan, (E, n) each."""
        return self._nearest_obstacle(self.absolute_plans[:, :, None, 1:], self.bodies.radius[:, None], 0)

    @cached_property
    def their_obstacle(self) -> ObstacleApproach:
        """The nearest obstacle to the predicted motion of each of the others, (E, n, n - 1) each."""
        return self._nearest_obstacle(self.prediction.believed(), self.bodies.others, None)

    def _nearest_obstacle(self, trajectories: np.ndarray, radii: np.ndarray, chosen: int | None) -> ObstacleApproach:
        """Return the nearest obstacles to trajectories, (E, n, m, N, 3), of all m or of a chosen one.

        :param radii: radii of the robots that fly them, (n, m) or (E, n, m) (m)
        """
        obstacles, config, shape = self._knowledge.obstacles, self._knowledge.config, trajectories.shape[:3]
        if obstacles is None:
            found = ObstacleApproach(np.full(shape, np.inf), np.zeros(shape, np.int64), np.zeros((*shape, 3)))
        else:
            times = config.planner.dt * np.arange(1.0, self.horizon + 1)
            nearest = nearest_obstacle(
                trajectories.reshape(shape[0], -1, self.horizon, 3),
                np.broadcast_to(radii, shape).reshape(shape[0], -1),
                obstacles.ahead(np.broadcast_to(times, (shape[0], 1, self.horizon)))[:, 0],
                obstacles.factors,
                obstacles.radius,
                obstacles.present,
            )
            found = ObstacleApproach(*(array.reshape(*shape, *array.shape[2:]) for array in nearest))
        return found if chosen is None else ObstacleApproach(*(array[:, :, chosen] for array in found))

    def approach(self, look_ahead: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the closest approach at constant velocities, in the metric of the planner's downwash.

        :param look_ahead: latest time to consider (s)
        :return: distance (m) and time from now (s), both (E, n, n - 1)
        """
        nearest, time = closest_approach(self._flat(self.pos), self._flat(self.vel), look_ahead)
        return self._less(length(nearest)), time
