"""Statistics of episodes for the environments' `info`, the logs and the evaluation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quad_swarm.native.steps import STATISTICS, Counted, count
from quad_swarm.planner import PlanStatus
from quad_swarm.states import like
from quad_swarm.world.messages import REQUEST_BYTES, plan_bytes
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.swarm import StepReport

_SHIFTED = int(PlanStatus.SHIFTED)
_NAMES = STATISTICS.names or ()
_STATE = [name for name in _NAMES if name != "at_goals"]
# What is counted in worlds with obstacles, and how it begins
_OBSTACLES = {"collided_obstacle": False, "min_obstacle_distance": np.inf}


def exchange_bytes(config: SwarmConfig) -> int:
    """Return the size of a request and its answer in bytes."""
    return REQUEST_BYTES + plan_bytes(config.planner.horizon)


def is_row(value: object) -> bool:
    """Return whether a value, such as one from a file, has the names and types of `EpisodeStatistics.row`."""
    if not isinstance(value, dict) or set(value) not in (set(_STATE), {*_STATE, *_OBSTACLES}):
        return False
    kinds = {name: {"b": bool, "i": int, "u": int, "f": float}[STATISTICS[name].kind] for name in _STATE}
    kinds |= {name: type(_OBSTACLES[name]) for name in value if name in _OBSTACLES}
    return all(type(value[name]) is kind and value[name] == value[name] for name, kind in kinds.items())  # not NaN


class EpisodeStatistics:
    """Statistics of the running episodes of E swarms, as arrays of length E.

    Goals are those that robots have at a time. Where they are replaced in flight (`Swarm.set_goals`), robots have not
    arrived any more, and what counts until then counts again from there on; waypoints and goals that move by themselves
    replace nothing.

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
    :ivar collided: whether two robots, or a robot and an obstacle, collided, in the sense that ends episodes
    :ivar collided_at_steps: whether they collided at a step
    :ivar collided_continuous: whether they collided at or between steps
    :ivar min_separation: smallest distance between two robots at a step (m)
    :ivar min_separation_continuous: smallest distance between two robots at or between steps (m)
    :ivar planner_failures: number of plans without a successful solve (status SHIFTED or BRAKING)
    :ivar solve_seconds: wall-clock time of the planner, as this swarm's share of each batch call (s)
    :ivar collided_obstacle: whether a robot collided with an obstacle, in the sense that ends episodes; in worlds with
        obstacles only, as is the next one
    :ivar min_obstacle_distance: smallest distance between the surfaces of a robot and an obstacle, at steps, or at any
        time if the world's collisions are continuous (m)
    """

    steps: np.ndarray
    steps_counted: np.ndarray
    requests: np.ndarray
    possible_requests: np.ndarray
    peak_requests: np.ndarray
    plans_used: np.ndarray
    plan_ages: np.ndarray
    requests_flown: np.ndarray
    path_length: np.ndarray
    at_goals: np.ndarray
    reached: np.ndarray
    arrived: np.ndarray
    collided: np.ndarray
    collided_at_steps: np.ndarray
    collided_continuous: np.ndarray
    min_separation: np.ndarray
    min_separation_continuous: np.ndarray
    planner_failures: np.ndarray
    solve_seconds: np.ndarray
    collided_obstacle: np.ndarray
    min_obstacle_distance: np.ndarray

    def __init__(self, n_swarms: int, config: SwarmConfig):
        self.config = config
        self._records = np.zeros(n_swarms, dtype=STATISTICS)
        if config.obstacles.slots:
            self._names = [*_STATE, *_OBSTACLES]
            self.collided_obstacle = np.zeros(n_swarms, dtype=bool)
            self.min_obstacle_distance = np.zeros(n_swarms)
        else:
            self._names = _STATE
        self.reset(slice(None))

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in _NAMES:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self._records[name]

    def reset(self, swarm: int | slice) -> None:
        """Start a new episode in one swarm."""
        self._records[swarm] = np.zeros((), dtype=STATISTICS)
        for name in ("min_separation", "min_separation_continuous"):
            self._records[name][swarm] = np.inf
        for name in self._names[len(_STATE) :]:
            getattr(self, name)[swarm] = _OBSTACLES[name]

    def change_goals(self, swarm: int) -> None:
        """Take note that robots of one swarm have other goals now, at which they are yet to arrive."""
        for name in ("at_goals", "reached", "arrived"):
            self._records[name][swarm] = False

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self._records = self._records[swarms]
        for name in self._names[len(_STATE) :]:
            setattr(self, name, getattr(self, name)[swarms])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return all statistics by name."""
        return {name: getattr(self, name).copy() for name in self._names}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore a state from `state_dict`."""
        for name in _STATE:
            self._records[name] = like(self._records[name], state[name], name, 0, np.inf)
        for name in self._names[len(_STATE) :]:
            setattr(self, name, like(getattr(self, name), state[name], name, -np.inf, np.inf))

    def add(self, report: StepReport, n_requests: np.ndarray, collided: np.ndarray) -> None:
        """Add one step.

        :param report: report of the step
        :param n_requests: number of requests in the step, (E,)
        :param collided: whether two robots collided in the step, in the sense that ends episodes, (E,) bool
        """
        step = Counted(
            n_requests=n_requests,
            collided=collided,
            collision=report.collision,
            collision_continuous=report.collision_continuous,
            at_goal=report.at_goal,
            belief_source=report.belief_source,
            plan_age=report.plan_age,
            plan_status=report.plan_status,
            others=None if report.changed is None else report.others,  # then there may be empty slots
            moved=report.moved.sum(axis=1) / report.moved.shape[1],
            min_separation=report.min_separation,
            min_separation_continuous=report.min_separation_continuous,
        )
        count(self._records, step, _SHIFTED, report.solve_seconds)
        if report.obstacles is not None:
            distance, colliding = report.obstacles.of(self.config.continuous_collisions)
            self.min_obstacle_distance = np.minimum(self.min_obstacle_distance, distance.min(axis=(1, 2)))
            self.collided_obstacle |= collided & colliding.any(axis=(1, 2))

    @property
    def success(self) -> np.ndarray:
        """Whether all robots arrived and none collided, not even afterwards, (E,) bool."""
        return self.arrived & ~self.collided

    def row(self, swarm: int) -> dict[str, float]:
        """Return one swarm's statistics by name."""
        return {name: getattr(self, name)[swarm].item() for name in self._names}

    def metrics(self) -> dict[str, np.ndarray]:
        """Return metrics of the episodes so far by the names under which they are logged, each (E,). The distance to
        obstacles is infinite where there are none."""
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
        } | (
            {
                "swarm/obstacle_collision_rate": self.collided_obstacle.astype(float),
                "swarm/min_obstacle_distance": self.min_obstacle_distance.copy(),
            }
            if self.config.obstacles.slots
            else {}
        )
