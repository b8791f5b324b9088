"""Statistics of episodes for the environments' `info`, the logs and the evaluation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quad_swarm.planner import PlanStatus
from quad_swarm.states import like
from quad_swarm.world.beliefs import BeliefSource
from quad_swarm.world.messages import REQUEST_BYTES, plan_bytes
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.swarm import StepReport

_NO_PLAN, _SHIFTED = int(BeliefSource.CONSTANT_VELOCITY), int(PlanStatus.SHIFTED)  # NumPy is slow with enumerations


def exchange_bytes(config: SwarmConfig) -> int:
    """Return the size of a request and its answer in bytes."""
    return REQUEST_BYTES + plan_bytes(config.planner.horizon)


class EpisodeStatistics:
    """Statistics of the running episodes of E swarms, as arrays of length E.

    Requests and path length count until all robots are at their goals at the same time, until a collision, or until the
    time limit, whichever comes first. Separations cover all steps flown; if an episode continues after a collision,
    they show how deep the collision is.

    :param n_swarms: number of swarms E
    :param config: the world

    :ivar steps: number of steps flown
    :ivar steps_counted: number of steps that count for requests and path length
    :ivar requests: number of requests in the steps counted
    :ivar possible_requests: number of possible requests in the steps counted: one of each robot to each perceived robot
        per step
    :ivar peak_requests: maximum number of requests in a step counted
    :ivar plans_used: number of other robots' plans believed, summed over the steps counted
    :ivar plan_ages: sum of the ages of these plans (steps)
    :ivar requests_flown: number of requests in all steps flown
    :ivar path_length: distance flown in the steps counted, mean over the robots (m)
    :ivar at_goals: whether all robots were at their goals in the last step, not part of the state
    :ivar reached: whether all robots were at their goals at the same time
    :ivar arrived: whether they were so before any collision
    :ivar collided: whether two robots collided, in the sense that ends episodes
    :ivar collided_at_steps: whether two robots collided at a step
    :ivar collided_continuous: whether two robots collided at or between steps
    :ivar min_separation: smallest distance between two robots at a step (m)
    :ivar min_separation_continuous: smallest distance between two robots at or between steps (m)
    :ivar planner_failures: number of plans without a successful solve (status SHIFTED or BRAKING)
    :ivar solve_seconds: wall-clock time of the planner, as this swarm's share of each batch call (s)
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

    at_goals: np.ndarray
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
        self.at_goals = np.zeros(n_swarms, dtype=bool)
        for name, value in self._START.items():
            setattr(self, name, np.full(n_swarms, value))

    def reset(self, swarm: int) -> None:
        """Start a new episode in one swarm."""
        for name, value in self._START.items():
            getattr(self, name)[swarm] = value

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        for name in self._START:
            setattr(self, name, getattr(self, name)[swarms])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return all statistics by name."""
        return {name: getattr(self, name).copy() for name in self._START}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore a state from `state_dict`."""
        for name in self._START:
            setattr(self, name, like(getattr(self, name), state[name], name))

    def add(self, report: StepReport, n_requests: np.ndarray, collided: np.ndarray) -> None:
        """Add one step.

        :param report: report of the step
        :param n_requests: number of requests in the step, (E,)
        :param collided: whether two robots collided in the step, in the sense that ends episodes, (E,) bool
        """
        counted = ~(self.reached | self.collided)
        requests = counted * n_requests
        used = report.belief_source != _NO_PLAN
        self.steps += 1
        self.steps_counted += counted
        self.requests += requests
        # Only a limited neighbourhood has empty slots
        possible = used[0].size if report.changed is None else (report.others >= 0).sum(axis=(1, 2))
        self.possible_requests += counted * possible
        self.peak_requests = np.maximum(self.peak_requests, requests)
        self.plans_used += counted * used.sum(axis=(1, 2))
        self.plan_ages += counted * (used * report.plan_age).sum(axis=(1, 2))
        self.requests_flown += n_requests
        self.path_length += counted * report.moved.sum(axis=1) / report.moved.shape[1]
        self.collided |= collided
        self.collided_at_steps |= report.collision
        self.collided_continuous |= report.collision_continuous
        self.at_goals = np.logical_and.reduce(report.at_goal, axis=1)
        self.arrived |= self.at_goals & ~self.collided
        self.reached |= self.at_goals
        self.min_separation = np.minimum(self.min_separation, report.min_separation)
        self.min_separation_continuous = np.minimum(self.min_separation_continuous, report.min_separation_continuous)
        self.planner_failures += (report.plan_status >= _SHIFTED).sum(axis=1)
        self.solve_seconds += report.solve_seconds / len(self.steps)

    @property
    def success(self) -> np.ndarray:
        """Whether all robots arrived and none collided, not even afterwards, (E,) bool."""
        return self.arrived & ~self.collided

    def row(self, swarm: int) -> dict[str, float]:
        """Return one swarm's statistics by name."""
        return {name: getattr(self, name)[swarm].item() for name in self._START}

    def metrics(self) -> dict[str, np.ndarray]:
        """Return metrics of the episodes so far by the names under which they are logged, each (E,)."""
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
