"""What robots know, apart from whether one process flies all of them or each has its own.

`Knowledge` is what views, observations and rules read. A swarm holds that of all its robots, (E, n), a
`quad_swarm.robot.Robot` its own, (1, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from quad_swarm.geometry import dot, length
from quad_swarm.native.pairs import resample
from quad_swarm.planner import Problems
from quad_swarm.quadrotor import POSITION, VELOCITY, VehicleModel
from quad_swarm.world.anticipation import Anticipation, load_predictor
from quad_swarm.world.beliefs import Beliefs, BeliefSource
from quad_swarm.world.commitment import Commitment
from quad_swarm.world.disturbance_estimate import DisturbanceEstimate
from quad_swarm.world.kinds import Bodies, bodies_of
from quad_swarm.world.obstacles import Obstacles
from quad_swarm.world.presets import SwarmConfig

# Distance (in separations) from which an observation contradicts a plan that arrives: who keeps apart from the plan
# keeps less than half of it from the robot. In "flight-hard", plans are up to 0.15 m off, less than a fifth
_MISFIT = 0.5
_SMALL = 1e-9  # length of vectors without a direction (m)


class SeenByOthers(NamedTuple):
    """How each of the others predicts a robot, as far as that robot knows.

    :param believed: predicted positions at the given stages, (E, n, n - 1, stages, 3), world frame (m)
    :param remembers: whether the prediction is a plan, (E, n, n - 1) bool
    :param age: steps since that plan was made, (E, n, n - 1)
    :param error: current error of that plan, (E, n, n - 1) (m)
    """

    believed: np.ndarray
    remembers: np.ndarray
    age: np.ndarray
    error: np.ndarray


class Perceived(Protocol):
    """Whom robots perceive, see `Neighbours`."""

    @property
    def others(self) -> np.ndarray:
        """Indices of the others, (n, n - 1) or (E, n, n - 1)."""

    @property
    def present(self) -> np.ndarray | None:
        """Whether each slot is taken, (E, n, n - 1) bool; None if all slots always are."""

    def numbers(self) -> np.ndarray:
        """Return the indices of the others, -1 for an empty slot."""

    def of_the_other(self, field: np.ndarray, otherwise: Any = 0) -> np.ndarray:
        """Return the values that the others have about a robot, (E, n, n - 1, ...).

        :raises ValueError: if it is a robot that asks, which does not know them
        """


class Knowledge(Protocol):
    """The knowledge of n robots in E swarms before they make requests."""

    @property
    def config(self) -> SwarmConfig:
        """The world, as far as robots know it."""

    @property
    def goal(self) -> np.ndarray:
        """Where the robots fly to now, goals or waypoints before them, (E, n, 3), world frame (m)."""

    @property
    def bodies(self) -> Bodies:
        """How large the robots and their others are, which all robots know."""

    @property
    def beliefs(self) -> Beliefs:
        """Beliefs about the others."""

    @property
    def neighbours(self) -> Perceived:
        """The others that the robots perceive."""

    @property
    def obstacles(self) -> Obstacles | None:
        """The obstacles, which all robots know, None in a world without any."""

    def estimate(self) -> np.ndarray:
        """Return the robots' estimates of their own states, (E, n, 9)."""

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (m) and velocities (m/s) of the others as the robots observe them, (E, n, n - 1, 3) each,
        world frame."""

    def planned_positions(self) -> np.ndarray:
        """Return planned positions at the start of the last step and of the N steps after it, (E, n, N + 1, 3) (m)."""

    def seen_by_others(self, stages: Sequence[int]) -> SeenByOthers:
        """Return how each of the others predicts a robot without a request, as far as that robot knows. It knows the
        plans that it sent and assumes that all of them arrived.

        :param stages: indices among the next N steps, counting from 0
        """


def make_beliefs(config: SwarmConfig, n_swarms: int, n_robots: int, order: np.ndarray | None = None) -> Beliefs:
    """Create the beliefs that robots begin with: they have received no plan.

    :param config: the world
    :param n_swarms: number of swarms E
    :param n_robots: number of robots whose beliefs these are
    :param order: where the others are among the robots that each sees, (n, n - 1), see `Anticipation`; None for beliefs
        that are about plans only, and predict a constant velocity without one
    """
    horizon, dt, misfit = config.planner.horizon, config.planner.dt, _MISFIT * config.least_separation
    anticipation = None
    if config.predictor is not None and order is not None:
        anticipation = Anticipation(load_predictor(config.predictor), horizon, n_swarms, order)
    return Beliefs(n_swarms, n_robots, horizon, dt, config.memory, config.n_others, misfit, anticipation)


def make_problems(
    config: SwarmConfig,
    model: VehicleModel,
    estimate: np.ndarray,
    goal: np.ndarray,
    believed: np.ndarray,
    source: np.ndarray,
    u: np.ndarray,
    late: np.ndarray | None,
    obstacles: Obstacles | None,
    goal_velocity: np.ndarray | None = None,
    commitment: Commitment | None = None,
    disturbance: DisturbanceEstimate | None = None,
    heading: np.ndarray | None = None,
    bodies: Bodies | None = None,
) -> Problems:
    """Return robots' planning problems, which start when their inputs take effect.

    :param config: the world
    :param model: discrete dynamics
    :param estimate: estimated states, (E, n, 9)
    :param goal: goals, (E, n, 3), world frame (m)
    :param believed: believed positions at the next N steps, (E, n, n - 1, N, 3) (m), which become those at the
        problem's stages
    :param source: `BeliefSource` of each, (E, n, n - 1)
    :param u: inputs that act until then, (E, n, 4)
    :param late: when the inputs take effect, as a fraction of a step, (E, n); None if all do so at once
    :param obstacles: obstacles, which follow the others among the bodies of a problem, None for none
    :param goal_velocity: velocities of the goals, (E, n, 3), world frame (m/s), None for goals that stand. Robots fly
        to where their goals will be at the end of the horizon, so that they do not fall behind
    :param commitment: the plans that robots sent, None if their planner does not keep to them
    :param disturbance: accelerations that robots estimate, None for none
    :param heading: headings to turn to, (E, n) (rad), None for 0
    :param bodies: how large the robots and their others are, by default as all robots of the world perceive all others
    """
    bodies = bodies_of(config) if bodies is None else bodies
    if goal_velocity is not None:
        ahead = config.planner.dt * (config.planner.horizon + (0.0 if late is None else late[..., None]))
        goal = goal + ahead * goal_velocity
    x = estimate
    if late is not None:
        pushed = None if disturbance is None else disturbance.acceleration
        x = model.ahead(x, u, late * config.planner.dt, pushed)
        resample(believed, late)
    announced, penalty = None, None
    if config.planner.right_of_way:
        # Of those whose motion is known: a network expects them to keep to the convention
        known = (source != int(BeliefSource.CONSTANT_VELOCITY)) | (config.predictor is not None)
        announced = known.reshape(-1, source.shape[2])
    if (of_predicted := config.planner.prediction_penalty) != 1:
        known = source != int(BeliefSource.CONSTANT_VELOCITY)
        penalty = np.where(known, 1.0, of_predicted).reshape(-1, source.shape[2])
    others = believed.reshape(-1, *believed.shape[2:])
    # Copies: a solver that writes into its problem must not move robots or goals
    problems = Problems(
        x.reshape(-1, 9).copy(), goal.reshape(-1, 3).copy(), others, announced=announced, penalty=penalty
    )
    if bodies.larger is not None:
        sizes = np.broadcast_to(bodies.larger, believed.shape[:3]).reshape(others.shape[:2])
        problems = problems._replace(size=sizes)
    if disturbance is not None:
        problems = problems._replace(disturbance=disturbance.acceleration.reshape(-1, 3).copy())
    if commitment is not None:
        reference, weight = commitment.reference(late)
        problems = problems._replace(reference=reference, reference_weight=weight)
    if heading is not None:
        problems = problems._replace(heading=heading.reshape(-1).copy())
    return problems if obstacles is None else _among(obstacles, problems, config, late, bodies)


def _among(
    obstacles: Obstacles, problems: Problems, config: SwarmConfig, late: np.ndarray | None, bodies: Bodies
) -> Problems:
    """Add obstacles to problems, see `make_problems`."""
    planner, (n_swarms, k) = config.planner, obstacles.radius.shape
    count, m = problems.others.shape[:2]
    n = count // n_swarms
    start = np.zeros((n_swarms, n)) if late is None else planner.dt * late
    times = start[..., None] + planner.dt * np.arange(1.0, planner.horizon + 1)
    bodies_ahead = np.empty((n_swarms, n, m + k, planner.horizon, 3))
    bodies_ahead[:, :, :m] = problems.others.reshape(n_swarms, n, m, planner.horizon, 3)
    obstacles.ahead(times, out=bodies_ahead[:, :, m:])
    shape, size = np.ones((n_swarms, n, m + k, 3)), np.zeros((n_swarms, n, m + k))
    shape[..., :m, 2] = 1 / planner.downwash
    shape[..., m:, :] = obstacles.factors[:, None]
    if bodies.larger is not None:
        size[..., :m] = bodies.larger
    size[..., m:] = obstacles.radius[:, None] + bodies.clear[:, None] - bodies.separation[:, None]
    if planner.braking_reserve:
        x = problems.x.reshape(n_swarms, n, -1)
        size[..., m:] += planner.braking_reserve * _braking_distances(obstacles, x, start, bodies)
    announced = problems.announced
    if announced is not None:
        announced = np.concatenate([announced, np.zeros((count, k), bool)], axis=1)
    penalty = problems.penalty
    if penalty is not None or planner.obstacle_penalty != 1:
        of_robots = np.ones((count, m)) if penalty is None else penalty
        penalty = np.concatenate([of_robots, np.full((count, k), planner.obstacle_penalty)], axis=1)
    return problems._replace(
        others=bodies_ahead.reshape(count, m + k, planner.horizon, 3),
        announced=announced,
        shape=shape.reshape(count, m + k, 3),
        size=size.reshape(count, m + k),
        penalty=penalty,
    )


def _braking_distances(obstacles: Obstacles, x: np.ndarray, start: np.ndarray, bodies: Bodies) -> np.ndarray:
    """Return the distances in which robots can stop that fly toward obstacles, (E, n, K) (m), 0 for those that do not.

    :param obstacles: obstacles
    :param x: states, (E, n, 9)
    :param start: times from now at which robots are there, (E, n) (s)
    :param bodies: how well robots brake
    """
    factors = obstacles.factors[:, None]
    away = factors * (x[:, :, None, POSITION] - obstacles.ahead(start[..., None])[..., 0, :])
    relative = factors * (x[:, :, None, VELOCITY] - obstacles.velocity[:, None])
    approach = np.maximum(-dot(away, relative) / np.maximum(length(away), _SMALL), 0.0)
    return approach**2 / (2 * bodies.deceleration[:, None])
