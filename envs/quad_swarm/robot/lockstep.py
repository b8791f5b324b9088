"""Robots of their own in one process, in lock-step: the world around them, with all the randomness there is.

It draws as `Swarm` does, so that both fly the same episode from the same seed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_swarm.quadrotor import N_INPUTS, N_STATES, POSITION, VELOCITY
from quad_swarm.robot.robot import Plan, Robot
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.obstacles import Obstacle
from quad_swarm.world.presets import SwarmConfig, plant_of
from quad_swarm.world.realisation import Realisation
from quad_swarm.world.route import Targets


class LockstepWorld:
    """Vehicles, sensors and radio of one team.

    :ivar state: true states, (1, n, 9)
    :ivar now: start of the current period (us)

    :param config: the world
    :param robots: the robots, in the order of their numbers
    """

    def __init__(self, config: SwarmConfig, robots: Sequence[Robot]):
        n = config.n_robots
        self.config, self.robots = config, list(robots)
        self.realisation = Realisation(config, 1)
        self.plant = plant_of(config, config.planner.dt / config.substeps, 1, n)
        self.state, self.now = np.zeros((1, n, N_STATES)), 0
        self._u = np.zeros((1, n, N_INPUTS))
        self._others = other_indices(n)
        # The plans that answers may contain, oldest first
        self._plans: list[deque[Plan]] = []
        # What is on its way, by the number of steps until it arrives: receiver, sender, plan
        self._flying: deque[list[tuple[int, int, Plan]]] = deque()

    def reset(
        self,
        starts: np.ndarray,
        goals: np.ndarray,
        noise_seed: int = 0,
        obstacles: Sequence[Obstacle] | None = None,
        velocities: Any = None,
        waypoints: Any = None,
        headings: Any = None,
        initial_velocities: Any = None,
        initial_headings: Any = None,
    ) -> None:
        """Begin an episode, see `Swarm.reset`."""
        states = self.config.initial_states(np.asarray(starts), np.asarray(goals), initial_velocities, initial_headings)
        moving, facing = states[:, VELOCITY], self.config.facing(states)
        self.state[0], self._u[:], self.now = states, 0.0, 0
        self.plant.place(0, self.state[0])
        if self.config.is_random:
            self.realisation.reset(0, noise_seed, self.state[0])
        radio, start = self.config.radio, self.realisation.start
        late = np.zeros(len(self.robots)) if start is None else start[0] / self.config.substeps
        targets = Targets.of(goals, velocities, waypoints, len(self.robots))
        for k, robot in enumerate(self.robots):
            goal, velocity, passed = (one[k] for one in targets)
            delay, kept = float(late[k]), 1 + radio.delay
            heading = None if headings is None else headings[k]
            target: dict[str, Any] = {"velocity": velocity, "waypoints": passed, "heading": heading}
            if self.config.flies_quadrotors:
                target |= {"initial_velocity": moving[k], "initial_heading": facing[k]}
            robot.reset(starts[k], goal, delay, kept=kept, obstacles=obstacles, **target)
        causal = radio.round_trip is not None
        self._flying = deque([] for _ in range(1 + (radio.round_trip or 0) + radio.jitter))
        most = 1 + radio.delay + (0 if causal else radio.jitter)
        self._plans = [
            deque(
                [Plan(-k * robot.period, robot.newest.positions - (k - 1) * stride) for k in range(most, 0, -1)], most
            )
            for robot, stride in zip(self.robots, self.config.planner.dt * moving, strict=True)
        ]

    def step(self) -> np.ndarray:
        """Let all robots fly for a period.

        :return: what they decided, (n, n - 1, 1 or 2) bool, see `Robot.decide`
        """
        perceived = zip(self.robots, *self._perceived(), strict=True)
        bits = np.stack([robot.decide(self.now, state, pos, vel) for robot, state, pos, vel in perceived])
        self._exchange(bits)
        self._fly(np.stack([robot.plan() for robot in self.robots])[None])
        self.now += self.robots[0].period
        return bits

    def _perceived(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return estimates of the robots' own states, (n, 9), and positions and velocities of their others as they
        observe them, (n, n - 1, 3) each."""
        estimate = self.realisation.estimate(self.state)
        seen = self.realisation.shown(estimate).take(self._others, axis=1)
        pos, vel = self.realisation.observe(seen[..., POSITION], seen[..., VELOCITY])
        return estimate[0], pos[0], vel[0]

    def _exchange(self, bits: np.ndarray) -> None:
        """Let the radio carry requests, answers and announcements of a period."""
        radio, n = self.config.radio, len(self.robots)
        asked, told = np.zeros((2, n, n), dtype=bool)  # [receiver, sender]
        for i in range(n):
            asked[i, self._others[i]] = bits[i, :, 0]
            if bits.shape[2] == 2:
                told[self._others[i], i] = bits[i, :, 1]
        asked, told = (np.take_along_axis(one, self._others, axis=1) for one in (asked, told))
        for plans, robot in zip(self._plans, self.robots, strict=True):
            if robot.newest.stamp != plans[-1].stamp:
                plans.append(robot.newest)
        carried = self.realisation.carried((asked | told)[None], self.state[..., POSITION], self._others)
        arriving, lateness = self.realisation.arrivals(carried, self._others)
        for i, k in np.argwhere(carried[0] | told):
            robot = self.robots[self._others[i, k]]
            robot.sent(int(i), self.now - (1 + radio.delay) * robot.period)
        for i, k in np.argwhere(arriving[0]):
            late, sender = 0 if lateness is None else int(lateness[0, i, k]), int(self._others[i, k])
            if radio.round_trip is None:
                self._flying[0].append((int(i), sender, self._plans[sender][-1 - radio.delay - late]))
            else:
                self._flying[radio.round_trip + late].append((int(i), sender, self._plans[sender][-1]))
        self._flying.append([])
        for receiver, sender, plan in self._flying.popleft():
            self.robots[receiver].receive(sender, plan)

    def _fly(self, planned: np.ndarray) -> None:
        realisation, before = self.realisation, self._u
        for k in range(self.config.substeps):
            late = realisation.start
            self._u = planned if late is None else np.where((late <= k)[..., None], planned, before)
            self.state = self.plant.step(self.state, self._u, realisation.air, realisation.factors)
        if self.config.is_random:
            self.state = realisation.advance(self.state)
