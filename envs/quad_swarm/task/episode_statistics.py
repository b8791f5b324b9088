"""What happened in an episode, counted once for the environments' `info`, the logs and the evaluation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quad_swarm.planner import PlanStatus
from quad_swarm.states import like
from quad_swarm.world.beliefs import BeliefSource
from quad_swarm.world.messages import REQUEST_BYTES, plan_bytes
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.swarm import StepReport

_NO_PLAN = int(BeliefSource.CONSTANT_VELOCITY)


def exchange_bytes(config: SwarmConfig) -> int:
    """Size of a request and its answer."""
    return REQUEST_BYTES + plan_bytes(config.planner.horizon)


class EpisodeStatistics:
    """Figures of the running episodes of E swarms, as arrays of length E.

    :param n_swarms: number of swarms E
    :param config: the world

    Requests and path count from the start until all robots are at their goals at once, a collision, or the time limit,
    whichever comes first. Separations are taken over all steps flown: where an episode goes on after a collision they
    say how deep it got.

    :ivar steps: steps flown
    :ivar steps_counted: steps in which requests and path counted
    :ivar requests: requests made in them
    :ivar possible_requests: how many could have been made in them: of each robot to each that it perceives
    :ivar peak_requests: most requests in one of them
    :ivar plans_used: plans of others that were believed in them, and
    :ivar plan_ages: the sum of their ages when they were (steps)
    :ivar requests_flown: requests made in all steps flown
    :ivar path_length: distance flown in the steps counted, mean over the robots (m)
    :ivar reached: all robots were at their goals at once
    :ivar arrived: the same, before any collision
    :ivar collided: two robots collided, by the collisions that end episodes
    :ivar collided_at_steps: a collision seen at a step
    :ivar collided_continuous: a collision seen at or between steps
    :ivar min_separation: smallest distance between two robots at a step (m)
    :ivar min_separation_continuous: the same at or between steps (m)
    :ivar planner_failures: plans without a successful solve (status SHIFTED or BRAKING)
    :ivar solve_seconds: wall-clock time of the planner, this swarm's share of each batch call (s)
    """

    _START = {  # noqa: RUF012 - never changed
        "steps": 0,
        "steps_counted": 0,
        "requests": 0,
        "possible_requests": 0,
        "peak_requests": 0,
        "plans_used": 0,
        "plan_ages": 0,
        "requests_flown": 0,
        "path_length": 0.0,
        "reached": False,
        "arrived": False,
        "collided": False,
        "collided_at_steps": False,
        "collided_continuous": False,
        "min_separation": np.inf,
        "min_separation_continuous": np.inf,
        "planner_failures": 0,
        "solve_seconds": 0.0,
    }

    steps: np.ndarray
    steps_counted: np.ndarray
    requests: np.ndarray
    possible_requests: np.ndarray
    peak_requests: np.ndarray
    plans_used: np.ndarray
    plan_ages: np.ndarray
    requests_flown: np.ndarray
    path_length: np.ndarray
    reached: np.ndarray
    arrived: np.ndarray
    collided: np.ndarray
    collided_at_steps: np.ndarray
    collided_continuous: np.ndarray
    min_separation: np.ndarray
    min_separation_continuous: np.ndarray
    planner_failures: np.ndarray
    solve_seconds: np.ndarray

    def __init__(self, n_swarms: int, config: SwarmConfig):
        self.config = config
        for name, value in self._START.items():
            setattr(self, name, np.full(n_swarms, value))

    def reset(self, swarm: int) -> None:
        """Begin a new episode in one swarm."""
        for name, value in self._START.items():
            getattr(self, name)[swarm] = value

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        for name in self._START:
            setattr(self, name, getattr(self, name)[swarms])

    def state_dict(self) -> dict[str, np.ndarray]:
        """All figures by name."""
        return {name: getattr(self, name).copy() for name in self._START}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from what `state_dict` gave."""
        for name in self._START:
            setattr(self, name, like(getattr(self, name), state[name], name))

    def add(self, report: StepReport, n_requests: np.ndarray, collided: np.ndarray) -> None:
        """Count one step.

        :param report: what happened in it
        :param n_requests: requests made in it, (E,)
        :param collided: whether two robots collided in it, by the collisions that end episodes, (E,) bool
        """
        counted = ~(self.reached | self.collided)
        self.steps += 1
        self.steps_counted += counted
        self.requests += counted * n_requests
        # The same in every swarm where nobody is missed
        self.possible_requests += counted * (report.others >= 0).sum(axis=(-2, -1))
        self.peak_requests = np.maximum(self.peak_requests, counted * n_requests)
        used = report.belief_source.reshape(len(counted), -1) != _NO_PLAN
        self.plans_used += counted * used.sum(axis=1)
        self.plan_ages += counted * (used * report.plan_age.reshape(used.shape)).sum(axis=1)
        self.requests_flown += n_requests
        self.path_length += counted * report.moved.mean(axis=1)
        self.collided |= collided
        self.collided_at_steps |= report.collision
        self.collided_continuous |= report.collision_continuous
        at_goals = report.at_goal.all(axis=1)
        self.arrived |= at_goals & ~self.collided
        self.reached |= at_goals
        self.min_separation = np.minimum(self.min_separation, report.min_separation)
        self.min_separation_continuous = np.minimum(self.min_separation_continuous, report.min_separation_continuous)
        self.planner_failures += (report.plan_status >= PlanStatus.SHIFTED).sum(axis=1)
        self.solve_seconds += report.solve_seconds / len(self.steps)

    @property
    def success(self) -> np.ndarray:
        """All robots arrived and none collided, not even afterwards."""
        return self.arrived & ~self.collided

    def row(self, swarm: int) -> dict[str, float]:
        """One swarm's figures by name."""
        return {name: getattr(self, name)[swarm].item() for name in self._START}

    def metrics(self) -> dict[str, np.ndarray]:
        """Figures of the episodes so far, each (E,), by the names under which they are logged."""
        n, dt = self.config.n_robots, self.config.planner.dt
        plans = self.steps * n
        return {
            "swarm/collision_rate": self.collided.astype(float),
            "swarm/arrival_rate": self.success.astype(float),
            "swarm/min_separation": self.min_separation.copy(),
            "comm/request_share": self.requests / np.maximum(self.possible_requests, 1),
            "comm/peak_requests": self.peak_requests.astype(float),
            "comm/bytes_per_second": exchange_bytes(self.config) * self.requests / (self.steps_counted * n * dt),
            "comm/plan_age": dt * self.plan_ages / np.maximum(self.plans_used, 1),
            "planner/failure_rate": self.planner_failures / plans,
            "planner/solve_us": 1e6 * self.solve_seconds / plans,
        }
