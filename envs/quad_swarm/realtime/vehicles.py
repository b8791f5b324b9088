"""Simulated vehicles in real or virtual time: physics, sensors, failsafe, and who collides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quad_swarm.geometry import closest_approach, flattened, length
from quad_swarm.quadrotor import N_INPUTS, N_STATES, POSITION, VELOCITY
from quad_swarm.realtime.link import Sensed, Traffic
from quad_swarm.realtime.statistics import Statistics, total
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.obstacles import Obstacle, Obstacles
from quad_swarm.world.presets import SwarmConfig, plant_of
from quad_swarm.world.realisation import Realisation

_US = 1_000_000
# Seconds without commands after which an autopilot levels, and after which it lands
LEVELS_AFTER, LANDS_AFTER = 0.5, 1.0
_LANDING = np.array([0.0, 0.0, -0.5, 0.0])


@dataclass
class Flight:
    """What happened in a flight.

    :param collisions: pairs of robots that collided
    :param struck: robots that touched an obstacle, and the number of the obstacle
    :param closest: smallest distance of two robots (m)
    :param arrived: when each robot was at its goal for the first time (s); NaN if it never was
    :param at_goal: which robots were at their goals at the end, (n,) bool
    :param seconds: duration (s)
    :param statistics: statistics of each robot's loop; None of one whose process ended
    :param traffic: what each robot sent and received
    :param killed: robots whose processes were ended
    :param pauses: how often the world itself stood still, as busy machines let it
    """

    collisions: list[tuple[int, int]]
    struck: list[tuple[int, int]]
    closest: float
    arrived: np.ndarray
    at_goal: np.ndarray
    seconds: float
    statistics: list[Statistics | None]
    traffic: list[Traffic | None]
    killed: list[int]
    pauses: int = 0

    @property
    def collided(self) -> bool:
        """Whether robots collided, with each other or an obstacle."""
        return bool(self.collisions or self.struck)

    @property
    def total(self) -> Statistics:
        """The statistics of all robots together."""
        return total(one for one in self.statistics if one is not None)


class Vehicles:
    """One team's vehicles. They fly the last command until they get another, as autopilots do, and level and land by
    themselves without any.

    :ivar now: time (us)
    :ivar step_us: length of a sub-step (us)
    :ivar state: true states, (n, 9)
    :ivar closest: smallest distance of each pair of robots while both were flying, (n, n) (m), see `SwarmConfig` for
        unlike radii
    :ivar obstacles: the obstacles, None without any
    :ivar clearance: smallest distance between the surfaces of each robot and each of K obstacles while it was flying,
        (n, K) (m)
    :ivar flying: which robots are in the air, (n,) bool
    :ivar held: which robots are held where they are until their first command, (n,) bool; `reset` holds nobody

    :param config: the world; its clock skew is not used, since commands take effect when they arrive
    :raises ValueError: if a sub-step is no whole number of microseconds, or the world's vehicles are no quadrotors
    """

    def __init__(self, config: SwarmConfig):
        if not config.flies_quadrotors:
            raise ValueError(
                f"planner.problem={config.planner.problem!r}: vehicles in real time level and land as quadrotors do; "
                "fly this world as a swarm, or give a quad_swarm.realtime.Loop a vehicle of your own."
            )
        n, step = config.n_robots, config.planner.dt / config.substeps
        self.config, self.step_us = config, round(step * _US)
        if abs(self.step_us - step * _US) > 1e-6:
            raise ValueError(f"planner.dt / substeps = {step} s: in real time, it must be whole microseconds.")
        self._realisation = Realisation(config, 1)
        self._plant = plant_of(config, step, 1, n)
        self._others = other_indices(n)
        self.obstacles = Obstacles.of(config.obstacles, 1)
        self._state = np.zeros((1, n, N_STATES))

    @property
    def state(self) -> np.ndarray:
        return self._state[0]

    @property
    def setpoint(self) -> np.ndarray:
        """The last commands, (n, 4)."""
        return self._u[0]

    def reset(
        self,
        starts: np.ndarray,
        goals: np.ndarray,
        noise_seed: int,
        now: int,
        obstacles: Sequence[Obstacle] | None = None,
    ) -> None:
        """Begin a flight.

        :param starts: starts, where robots hover, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        :param noise_seed: seed of the disturbances
        :param now: the time (us)
        :param obstacles: the obstacles, where they are then; by default those that the world lists
        :raises ValueError: if there are more obstacles than the world has room for
        """
        n = self.config.n_robots
        self.now, self._steps, self.goals = now, 0, np.array(goals, float)
        self._state = np.zeros((1, n, N_STATES))
        self.state[:, POSITION] = starts
        self._plant.place(0, self._state[0])
        if self.config.is_random:
            self._realisation.reset(0, noise_seed, self._state[0])
        self._u = np.zeros((1, n, N_INPUTS))
        self._commanded = np.full(n, now)
        self.flying, self.held = np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
        self.closest = np.full((n, n), np.inf)
        listed = self.config.obstacles.listed if obstacles is None else obstacles
        if self.obstacles is not None or listed:
            (self.obstacles or Obstacles(1, 0)).reset(0, listed)
        self.clearance = np.full((n, 0 if self.obstacles is None else self.obstacles.slots), np.inf)
        self.arrived = np.full(n, -1)
        self._sense()

    def warm_up(self) -> None:
        """Fly for a moment: simulators compile what they need at first use."""
        n = self.config.n_robots
        places = np.arange(1.0, n + 1)[:, None] * np.ones(3)
        self.reset(places, places, 0, 0)
        for _ in range(2 * self.config.substeps):
            self.advance()

    def command(self, robot: int, setpoint: np.ndarray) -> None:
        """Take a robot's command.

        :param robot: number of the robot
        :param setpoint: roll, pitch (rad), climb rate (m/s), yaw rate (rad/s), (4,)
        """
        if not np.isfinite(setpoint).all():
            return
        self._u[0, robot], self._commanded[robot] = setpoint, self.now
        if self.held[robot]:
            self.held[robot] = False
            self._plant.place(0, self._state[0])  # simulators have flown on meanwhile

    def sensed(self, robot: int) -> Sensed:
        """Return what a robot perceives of the last sub-step."""
        own, pos, vel = self._perceived
        return Sensed(self.now, own[robot].copy(), pos[robot].copy(), vel[robot].copy())

    def advance(self) -> None:
        """Fly for a sub-step."""
        silent = (self.now - self._commanded) / _US
        u = np.where((silent > LEVELS_AFTER)[:, None], 0.0, self._u[0])
        u = np.where((silent > LANDS_AFTER)[:, None], _LANDING, u)
        before, realisation = self.state[:, POSITION].copy(), self._realisation
        still = ~self.flying | self.held
        stays = self.state[still].copy()
        self._state = self._plant.step(self._state, u[None], realisation.air, realisation.factors)
        self.state[still] = stays
        self._steps += 1
        if self._steps % self.config.substeps == 0 and self.config.is_random:
            self._state = realisation.advance(self._state)
            self.state[still] = stays
        self.now += self.step_us
        self._meet(before)
        self.flying &= self.state[:, 2] > 0.0
        distance = np.linalg.norm(self.state[:, POSITION] - self.goals, axis=1)
        self.arrived[(distance <= self.config.goal_radius) & (self.arrived < 0)] = self.now
        self._sense()

    @property
    def at_goal(self) -> np.ndarray:
        """Which robots are within the goal radius, (n,) bool."""
        return np.linalg.norm(self.state[:, POSITION] - self.goals, axis=1) <= self.config.goal_radius

    def collisions(self, among: np.ndarray | None = None) -> list[tuple[int, int]]:
        """Return the pairs of robots that have collided.

        :param among: only pairs of these robots, (n,) bool
        """
        contact = 2 * self.config.radius - self.config.collision_tolerance
        met = np.triu(self.closest < contact, 1)
        if among is not None:
            met &= among[:, None] & among
        return [(int(i), int(j)) for i, j in np.argwhere(met)]

    def struck(self) -> list[tuple[int, int]]:
        """Return the robots that touched an obstacle, with the number of the obstacle."""
        return [(int(i), int(k)) for i, k in np.argwhere(self.clearance < -self.config.collision_tolerance)]

    def flight(
        self,
        began: int,
        statistics: list[Statistics | None],
        traffic: list[Traffic | None],
        killed: list[int],
        pauses: int = 0,
    ) -> Flight:
        """Return what happened since some time (us). The other parameters are those of `Flight`."""
        arrived = np.where(self.arrived < 0, np.nan, (self.arrived - began) / _US)
        closest = float(self.closest.min())
        seconds = (self.now - began) / _US
        met = self.collisions(), self.struck()
        return Flight(*met, closest, arrived, self.at_goal, seconds, statistics, traffic, killed, pauses)

    def _meet(self, before: np.ndarray) -> None:
        """Update the smallest distances with straight motion during the sub-step."""
        after = self.state[:, POSITION]
        start, end = before[:, None] - before, after[:, None] - after
        between, _ = closest_approach(start, end - start, 1.0)
        distance = length(flattened(between, self.config.planner.downwash))
        if self.config.excess is not None:
            distance = distance - self.config.excess
        both = self.flying[:, None] & self.flying
        np.fill_diagonal(both, False)
        self.closest[both] = np.minimum(self.closest, distance)[both]
        if self.obstacles is not None:
            seconds = self.step_us / _US
            moved = np.stack([before, after])[:, None]
            _, during = self.obstacles.measure(moved, self.config.radii, seconds)
            self.clearance[self.flying] = np.minimum(self.clearance, during[0])[self.flying]
            self.obstacles.advance(seconds)

    def _sense(self) -> None:
        estimate = self._realisation.estimate(self._state)
        since = self._steps % self.config.substeps * self.step_us / _US
        seen = self._realisation.shown(estimate, since).take(self._others, axis=1)
        pos, vel = self._realisation.observe(seen[..., POSITION], seen[..., VELOCITY])
        self._perceived = estimate[0], pos[0], vel[0]
