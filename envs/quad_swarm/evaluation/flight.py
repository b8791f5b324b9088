"""Episodes flown by a policy: a single one step by step, or a batch for statistics."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.evaluation.policies import RequestPolicy, is_policy, make_policy, name_of, policy_of
from quad_swarm.geometry import closest_approach, flattened, length
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.task.request_task import Outcome, RequestTask, RewardConfig, requests_of
from quad_swarm.task.rules import parse_rule
from quad_swarm.task.view import View
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.doubts import too_short, warn
from quad_swarm.world.neighbours import slots_to_robots
from quad_swarm.world.obstacles import Obstacle, clearances, surroundings
from quad_swarm.world.presets import SwarmConfig, for_scenario
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm

# First seed of held-out episodes; training seeds count from 0
_FIRST_SEED = 10**9


@dataclass(frozen=True)
class Condition:
    """A policy in a scenario and a world.

    :param policy: a rule or the path of a model's zip, as on the command line, an object with ``predict``, or a
        function of a view, see `quad_swarm.evaluation.policies`. Conditions with objects are equal if their objects are
        the same
    :param scenario: a name of `SCENARIOS`
    :param config: the world
    :param max_steps: time limit (steps), by default the world's
    :param algo: ``module:Class`` that loads models
    :param solver: see `make_planner`
    :param linger: number of steps to fly after all robots have reached their goals; None for flying until the time
        limit
    :raises ValueError: if the policy, the scenario or the world is of another kind, ``max_steps`` is less than 1,
        ``linger`` is negative, or the scenario does not fit the world
    """

    policy: Any
    scenario: str
    config: SwarmConfig
    max_steps: int | None = None
    algo: str = "sb3_maddpg:MADDPG"
    solver: str = "auto"
    linger: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.policy, os.PathLike):
            object.__setattr__(self, "policy", os.fspath(self.policy))
        if not is_policy(self.policy):
            raise ValueError(
                f"policy={shown(self.policy)}: it must be a rule, the path of a model's zip, an object with "
                "predict(observation), or a function of a view that returns requests."
            )
        if not isinstance(self.scenario, str):
            raise ValueError(f"scenario={shown(self.scenario)}: it must be the name of a scenario.")
        if not isinstance(self.config, SwarmConfig):
            raise ValueError(f"config={shown(self.config)}: it must be a world, as make_config('paper') returns.")
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(f"max_steps={self.max_steps}: an episode needs at least one step.")
        world = for_scenario(self.config, self.scenario)
        ScenarioSampler(self.scenario, world.n_robots, world.space, world)
        for sentence in too_short(self.config, self.max_steps) if self.max_steps is not None else ():
            warn(sentence)
        if self.linger is not None and self.linger < 0:
            raise ValueError(f"linger={self.linger} must be a number of steps, or None to fly until the time limit.")

    def _identity(self) -> tuple[Any, ...]:
        # Foreign objects may neither be hashable nor compare to one truth value
        policy = self.policy if isinstance(self.policy, str) else id(self.policy)
        return (policy, *(getattr(self, field.name) for field in fields(self) if field.name != "policy"))

    def __eq__(self, other: object) -> bool:
        return self._identity() == other._identity() if isinstance(other, Condition) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._identity())


def checked_condition(condition: Any) -> None:
    """Check that something is a `Condition`.

    :raises ValueError: if it is not
    """
    if not isinstance(condition, Condition):
        raise ValueError(
            f"{shown(condition)} is no condition: write quad_swarm.evaluation.Condition(policy, scenario, world)."
        )


def first_episode(seed: int) -> int:
    """Return the seed of the first episode of a set of held-out episodes. The other episodes have consecutive seeds.

    :param seed: index of the set
    :raises ValueError: if the index is negative, which could select seeds of training
    """
    if seed < 0:
        raise ValueError(f"seed={seed}: sets of held-out episodes count from 0.")
    return _FIRST_SEED + seed * 10**6


def begin(
    condition: Condition, episodes: Sequence[int], model: Any = None
) -> tuple[RequestPolicy, RequestTask, list[np.random.Generator]]:
    """Start episodes. Collisions do not end them, which shows how deep collisions are, but end their statistics.

    :param condition: policy, scenario and world
    :param episodes: seeds, see `first_episode`; ``env.reset(seed=...)`` of `QuadSwarm-v0` draws the same episodes
    :param model: model that flies instead of the condition's policy
    :return: the policy, the task, and random number generators for random rules
    """
    config = for_scenario(condition.config, condition.scenario)
    if model is None:
        policy, observation = make_policy(condition.policy, config, condition.algo)
    else:
        policy, observation = policy_of(model, name_of(condition.policy), config)
    task = RequestTask(
        Swarm(config, len(episodes), condition.solver),
        ScenarioSampler(condition.scenario, config.n_robots, config.space, config),
        RewardConfig(),
        condition.max_steps,
        observation,
        end_at_collision=False,
    )
    for k, seed in enumerate(episodes):
        task.reset(k, np.random.default_rng(seed))
    return policy, task, [np.random.default_rng([seed, 1]) for seed in episodes]


class FlownStep(NamedTuple):
    """One step of a batch of episodes.

    :param episodes: indices of the running episodes, (E,)
    :param requests: whose plan each robot got, (E, n, n - 1) bool, with all others in ascending order even if the
        neighbourhood is limited
    :param announced: which of these plans were announced without a request, (E, n, n - 1) bool
    :param outcome: outcome of the step
    :param over: which episodes end with this step, (E,) bool
    """

    episodes: np.ndarray
    requests: np.ndarray
    announced: np.ndarray
    outcome: Outcome
    over: np.ndarray


def fly_steps(
    policy: RequestPolicy, task: RequestTask, rngs: Sequence[np.random.Generator], linger: int | None = None
) -> Iterator[FlownStep]:
    """Fly all episodes of a task and yield their steps. Finished episodes leave the batch after their last step.

    :param policy: see `begin`
    :param task: see `begin`
    :param rngs: see `begin`
    :param linger: see `Condition`
    """
    episodes = np.arange(task.swarm.n_swarms)
    since_arrival = np.zeros(episodes.size, dtype=int)
    rngs = list(rngs)
    while episodes.size:
        bits = task.sent(policy(task, rngs))
        requests = requests_of(bits, task.swarm.neighbours)
        announced = requests & ~bits[..., 0]
        outcome = task.act(bits)
        since_arrival += task.statistics.reached
        over = outcome.terminated | outcome.truncated
        if linger is not None:
            over |= since_arrival > linger
        others = outcome.report.others
        yield FlownStep(episodes, slots_to_robots(requests, others), slots_to_robots(announced, others), outcome, over)
        if over.any():
            task.keep(~over)
            episodes, since_arrival = episodes[~over], since_arrival[~over]
            rngs = [rng for rng, ended in zip(rngs, over, strict=True) if not ended]


def run_episodes(condition: Condition, episodes: Sequence[int]) -> list[dict[str, float]]:
    """Fly a batch of episodes of a condition.

    :param condition: policy, scenario and world
    :param episodes: seeds, see `begin`
    :return: statistics of each episode, see `EpisodeStatistics`
    """
    policy, task, rngs = begin(condition, episodes)
    rows: dict[int, dict[str, float]] = {}
    for step in fly_steps(policy, task, rngs, condition.linger):
        rows |= {int(step.episodes[k]): task.statistics.row(int(k)) for k in np.flatnonzero(step.over)}
    return [rows[k] for k in range(len(episodes))]


@dataclass(frozen=True)
class Flight:
    """Recording of an episode of T steps and n robots.

    :param config: the world
    :param state: states, (T + 1, n, 9)
    :param plans: planned states at stages 0..N, (T + 1, n, N + 1, 9)
    :param goal: goals, (n, 3), world frame (m); those after the last step if they change
    :param requests: whose plan each robot got in each step, (T, n, n - 1) bool, with all others in ascending order even
        if the neighbourhood is limited
    :param announced: which of these plans were announced without a request, (T, n, n - 1) bool
    :param other_requests: requests of a second rule in each step, which were not executed, (T, n, n - 1) bool
    :param min_separation: smallest distance between two robots at the start and in each step, (T + 1,) (m): at any time
        of the step if the world's collisions are continuous, otherwise after the step
    :param inputs: inputs that the robots chose in each step, (T, n, 4); None if they are not known
    :param obstacles: obstacles, where they are at the start
    :param obstacle_pos: their centres, (T + 1, K, 3), world frame (m); None without any
    :param min_obstacle_distance: smallest distance between the surfaces of a robot and an obstacle, (T + 1,) (m), when
        ``min_separation`` is; None without any
    :param goals: where the robots flew to at each step, goals or waypoints, (T + 1, n, 3), world frame (m); None if
        this never changed
    :param at_goal: which robots were at their goals after each step, (T, n) bool; None if the goals tell

    With `PlannerConfig.downwash`, distances between robots are those in the ellipsoids' metric. Those of robots whose
    radii are not the world's count as in `SwarmConfig`.
    """

    config: SwarmConfig
    state: np.ndarray
    plans: np.ndarray
    goal: np.ndarray
    requests: np.ndarray
    announced: np.ndarray
    other_requests: np.ndarray
    min_separation: np.ndarray
    inputs: np.ndarray | None = None
    obstacles: tuple[Obstacle, ...] = ()
    obstacle_pos: np.ndarray | None = None
    min_obstacle_distance: np.ndarray | None = None
    goals: np.ndarray | None = None
    at_goal: np.ndarray | None = None

    @property
    def n_robots(self) -> int:
        """Number of robots n."""
        return len(self.goal)

    def obstacles_at(self, step: int) -> tuple[Obstacle, ...]:
        """Return the obstacles where they are after a step."""
        if self.obstacle_pos is None:
            return ()
        return tuple(
            replace(one, position=tuple(where))
            for one, where in zip(self.obstacles, self.obstacle_pos[step].tolist(), strict=True)
        )

    @property
    def pos(self) -> np.ndarray:
        """Positions, (T + 1, n, 3), world frame (m)."""
        return self.state[..., POSITION]

    @cached_property
    def relative_pos(self) -> np.ndarray:
        """Positions of the others relative to each robot, (T + 1, n, n - 1, 3) (m)."""
        return self.pos[:, other_indices(self.n_robots)] - self.pos[:, :, None]

    @cached_property
    def relative_vel(self) -> np.ndarray:
        """Velocities of the others relative to each robot, (T + 1, n, n - 1, 3) (m/s)."""
        vel = self.state[..., VELOCITY]
        return vel[:, other_indices(self.n_robots)] - vel[:, :, None]

    @cached_property
    def separation(self) -> np.ndarray:
        """Distances of each robot to the others, (T + 1, n, n - 1) (m)."""
        return self._less(length(flattened(self.relative_pos, self.config.planner.downwash)))

    def _less(self, distance: np.ndarray) -> np.ndarray:
        """Return distances between centres as distances of robots of the world's radius, (T + 1, n, n - 1) (m)."""
        excess, others = self.config.excess, other_indices(self.n_robots)
        return distance if excess is None else distance - np.take_along_axis(excess, others, axis=1)

    @cached_property
    def closest_approach(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance (m) and time (s) of the closest approach at constant velocities from each step on, without a time
        limit, both (T + 1, n, n - 1)."""
        downwash = self.config.planner.downwash
        nearest, time = closest_approach(flattened(self.relative_pos, downwash), flattened(self.relative_vel, downwash))
        return self._less(length(nearest)), time

    @cached_property
    def arrival(self) -> int | None:
        """First step after which all robots are at their goals at the same time, None if they never are."""
        known = self.at_goal is not None
        at_goal = self.at_goal if known else length(self.pos[1:] - self.goal) <= self.config.goal_radius
        arrived = np.all(at_goal, axis=1)
        return int(arrived.argmax()) + 1 if arrived.any() else None

    @cached_property
    def colliding(self) -> np.ndarray:
        """Whether two robots, or a robot and an obstacle, collide at the start and in each step as the world counts
        collisions, (T + 1,) bool."""
        colliding = self.min_separation < 2 * self.config.radius - self.config.collision_tolerance
        if self.min_obstacle_distance is not None:
            colliding |= self.min_obstacle_distance < -self.config.collision_tolerance
        return colliding

    @cached_property
    def collision(self) -> int | None:
        """First step with a collision, None without a collision."""
        return int(self.colliding[1:].argmax()) + 1 if self.colliding[1:].any() else None

    def closest_pair(self, step: int) -> tuple[int, int]:
        """Return the two robots that are closest to each other after a step."""
        i, m = np.unravel_index(self.separation[step].argmin(), self.separation.shape[1:])
        return int(i), int(other_indices(self.n_robots)[i, m])


def fly(condition: Condition, seed: int, number: int = 0, other_rule: str = "none", model: Any = None) -> Flight:
    """Fly and record a held-out episode.

    :param condition: policy, scenario and world
    :param seed: index of the set of held-out episodes
    :param number: index of the episode in the set
    :param other_rule: a rule whose requests are also recorded, but not executed
    :param model: model that flies instead of the condition's policy, or any object with ``predict`` or function of a
        view, see `quad_swarm.evaluation.policies`
    :raises ValueError: if an argument is of another kind
    """
    checked_condition(condition)
    episode = first_episode(seed) + number
    policy, task, rngs = begin(condition, [episode], model)
    rule, other_rngs = parse_rule(other_rule), [np.random.default_rng([episode, 2])]
    state, plans, inputs = [task.swarm.state[0].copy()], [task.swarm.plans[0].copy()], list[np.ndarray]()
    goals, at_goal, changes = [task.swarm.goal[0].copy()], list[np.ndarray](), task.swarm.route is not None
    requests: list[np.ndarray] = []
    announced: list[np.ndarray] = []
    other_requests: list[np.ndarray] = []

    def recorded(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        neighbours = task.swarm.neighbours
        asked = neighbours.perceived(rule(View(task.swarm, other_rngs)))
        other_requests.append(slots_to_robots(asked, neighbours.numbers())[0])
        return policy(task, rngs)

    closest: list[float] = []
    among, beside = task.swarm.obstacles, list[float]()
    obstacles = () if among is None else among.of_swarm(0)
    centres = [] if among is None else [among.position[0, among.present[0]]]
    for step in fly_steps(recorded, task, rngs, condition.linger):
        report = step.outcome.report
        closest.append((report.min_separation_continuous if task.continuous_collisions else report.min_separation)[0])
        if among is not None and report.obstacles is not None:
            beside.append(report.obstacles.of(task.continuous_collisions)[0].min())
            centres.append(among.position[0, among.present[0]])
        requests.append(step.requests[0])
        announced.append(step.announced[0])
        state.append(task.swarm.state[0].copy())
        plans.append(task.swarm.plans[0].copy())
        inputs.append(task.swarm.inputs[0].copy())
        goals.append(task.swarm.goal[0].copy())
        at_goal.append(report.at_goal[0].copy())
        goal = task.swarm.final_goal[0].copy()
    start, config = state[0][:, POSITION], condition.config
    others = other_indices(len(start))
    apart = length(flattened(start[others] - start[:, None], config.planner.downwash))
    if config.excess is not None:
        apart = apart - np.take_along_axis(config.excess, others, axis=1)
    closest.insert(0, apart.min())
    flight = Flight(
        config,
        np.array(state),
        np.array(plans),
        goal,
        np.array(requests),
        np.array(announced),
        np.array(other_requests),
        np.array(closest),
        np.array(inputs),
    )
    if changes:
        flight = replace(flight, goals=np.array(goals), at_goal=np.array(at_goal))
    if not obstacles:
        return flight
    beside.insert(0, (clearances(start, surroundings(obstacles)) - config.radii[:, None]).min())
    return replace(flight, obstacles=obstacles, obstacle_pos=np.array(centres), min_obstacle_distance=np.array(beside))
