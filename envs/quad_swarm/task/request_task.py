"""The Dec-POMDP of Sec. IV-B on top of the swarm, batched over E swarms: observation, reward and end of episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from quad_swarm.task.episode_statistics import EpisodeStatistics
from quad_swarm.task.observation import Observation, PaperObservation, make_observation
from quad_swarm.task.options import TaskOptions
from quad_swarm.validation import checked, replaced, with_fields
from quad_swarm.world.beliefs import other_indices, reverse_indices
from quad_swarm.world.doubts import too_short, warn
from quad_swarm.world.neighbours import Neighbours
from quad_swarm.world.obstacles import Obstacle
from quad_swarm.world.presets import for_scenario, make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import StepReport, Swarm


@checked
@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward R = w_g R_g + w_coll R_coll + w_c R_c, with the paper's values (Sec. V-A).

    :param goal: w_g r_g, reward for each step in which all robots are at their goals
    :param collision: w_coll r_coll, penalty for a collision
    :param request: w_c, penalty for each request
    :param near_miss: penalty for each step and each pair closer than ``near_miss_distance``. It increases linearly to
        its full value at ``near_miss_distance - near_miss_width``. Not in the paper; near misses are less rare than
        collisions.
    :param near_miss_exponent: exponent of the increase; above 1, slight near misses weigh less
    :param near_miss_distance: distance of near misses (m), by default the planner's separation
    :param near_miss_width: width of the increase (m)
    :param near_miss_ahead: number of future steps in which near misses of plans also count
    :param near_miss_narrowing: reduction of ``near_miss_distance`` for the last of these steps (m), proportionally less
        for earlier steps, because plans for the far future still change
    :raises ValueError: if a value is negative or not finite, or the distance or width of near misses is zero
    """

    goal: NonNegativeFloat = 1.3
    collision: NonNegativeFloat = 150.0
    request: NonNegativeFloat = 0.1
    near_miss: NonNegativeFloat = 0.0
    near_miss_distance: PositiveFloat | None = None
    near_miss_width: PositiveFloat = 0.01
    near_miss_exponent: Annotated[float, Field(ge=1, le=10)] = 1.0
    near_miss_ahead: Annotated[int, Field(ge=0, le=1000)] = 0
    near_miss_narrowing: NonNegativeFloat = 0.0


class Outcome(NamedTuple):
    """Result of one step of E swarms.

    :param reward: team rewards, (E,)
    :param pair_rewards: the part of a robot's reward that belongs to one of the others, (E, n, n - 1): its request,
        their collision or near miss, and equal shares of the goal reward and of the robot's collision with an obstacle
    :param reward_terms: the weighted terms "goal", "collision" and "requests", and "near_miss" if it has a weight, each
        (E,)
    :param terminated: whether a collision, or the arrival of all robots, ended the episode, (E,) bool
    :param truncated: whether the time limit ended the episode, (E,) bool
    :param n_requests: number of requests, (E,)
    :param report: report of the world
    """

    reward: np.ndarray
    pair_rewards: np.ndarray
    reward_terms: dict[str, np.ndarray]
    terminated: np.ndarray
    truncated: np.ndarray
    n_requests: np.ndarray
    report: StepReport


def requests_of(bits: np.ndarray, neighbours: Neighbours | None = None) -> np.ndarray:
    """Convert actions to requests. Announcements become requests of their receivers.

    :param bits: bits of each robot for each of the others, (..., n, n - 1, 1 or 2) bool: whether it requests the
        other's plan and, with announcements, whether it sends its own plan
    :param neighbours: whom the robots perceive, which requires exactly one leading axis, that of the swarms; by default
        all others
    :return: whose plan each robot gets, (..., n, n - 1) bool
    """
    if bits.shape[-1] == 1:
        return bits[..., 0]
    if neighbours is not None:
        return bits[..., 0] | neighbours.of_the_other(bits[..., 1])
    n = bits.shape[-3]
    return bits[..., 0] | bits[..., other_indices(n), reverse_indices(n), 1]


class RequestTask:
    """Episodes of E swarms.

    :ivar statistics: statistics of the running episodes

    :param swarm: the swarms
    :param sampler: sampler of episodes
    :param reward: weights of the reward
    :param max_steps: time limit (steps), by default the world's
    :param observation: observation of the robots, by default the paper's without scaling
    :param continuous_collisions: whether contact at any time of a step is a collision, or only contact at the steps; by
        default as in the world
    :param end_at_arrival: end episodes as soon as all robots are at their goals; the paper continues to the time limit
    :param end_at_collision: end episodes at collisions; otherwise they continue, which shows how deep collisions are
    :param announcements: whether robots may also send their plans without a request, see `act`
    :param plans_in_info: whether `info` holds the robots' plans, for which the swarm computes their costs
    :raises ValueError: if ``near_miss_ahead`` of the reward exceeds the plans' horizon
    """

    def __init__(
        self,
        swarm: Swarm,
        sampler: ScenarioSampler,
        reward: RewardConfig,
        max_steps: int | None = None,
        observation: Observation | None = None,
        continuous_collisions: bool | None = None,
        end_at_arrival: bool = False,
        end_at_collision: bool = True,
        announcements: bool = False,
        plans_in_info: bool = False,
    ):
        last = swarm.config.planner.horizon - 1
        if reward.near_miss_ahead > last:
            raise ValueError(
                f"reward.near_miss_ahead={reward.near_miss_ahead}: plans reach only planner.horizon - 1 = {last} steps "
                "beyond the current one."
            )
        self.swarm = swarm
        self.sampler = sampler
        if reward.near_miss_distance is None:
            reward = replace(reward, near_miss_distance=swarm.config.planner.separation)
        self.reward = reward
        self.max_steps = swarm.config.max_steps if max_steps is None else max_steps
        if continuous_collisions is None:
            continuous_collisions = swarm.config.continuous_collisions
        self.continuous_collisions = continuous_collisions
        self.end_at_arrival = end_at_arrival
        self.end_at_collision = end_at_collision
        self.n_bits = 2 if announcements else 1
        self.plans_in_info = plans_in_info
        self.scenario = [""] * swarm.n_swarms
        self.statistics = EpisodeStatistics(swarm.n_swarms, swarm.config)
        self.observation = observation or PaperObservation(swarm.config, scaled=False)

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the robots."""
        return tuple(f"robot_{index}" for index in range(self.swarm.config.n_robots))

    @property
    def observation_layout(self) -> dict[str, Any]:
        """Meaning of an observation's columns, see `sb3_maddpg.relational.ObservationLayout`."""
        return self.observation.layout

    @property
    def action_cost(self) -> float:
        """Cost of a request."""
        return self.reward.request

    @property
    def observation_size(self) -> int:
        """Length of a robot's observation."""
        return self.observation.size

    def reset(self, swarm: int, rng: np.random.Generator) -> None:
        """Draw a new episode for one swarm. All random numbers of the episode derive from ``rng``."""
        name, scene = self.sampler.draw(rng)
        fits = self.sampler.world is self.swarm.config
        self.place(
            swarm, name, scene.starts, scene.goals, rng, fits, scene.obstacles, scene.velocities, scene.waypoints
        )

    def place(
        self,
        swarm: int,
        name: str,
        starts: np.ndarray,
        goals: np.ndarray,
        rng: np.random.Generator,
        checked: bool = False,
        obstacles: Sequence[Obstacle] | None = None,
        velocities: Any = None,
        waypoints: Any = None,
        headings: Any = None,
        initial_velocities: Any = None,
        initial_headings: Any = None,
    ) -> None:
        """Start a given episode in one swarm; ``rng`` seeds its disturbances. See `Swarm.reset`."""
        noise_seed = int(rng.integers(2**63)) if self.swarm.config.is_random else 0
        changing = (velocities, waypoints, headings, initial_velocities, initial_headings)
        self.swarm.reset(swarm, starts, goals, obstacles, noise_seed, checked, *changing)
        self.scenario[swarm] = name
        self.statistics.reset(swarm)

    def set_goals(
        self,
        swarm: int,
        goals: Any,
        velocities: Any = None,
        waypoints: Any = None,
        robots: Sequence[int] | None = None,
        headings: Any = None,
    ) -> None:
        """Let robots of one swarm fly to other goals from now on, see `Swarm.set_goals`. The episode counts as arrived
        only when all robots are at the goals that they have now."""
        self.swarm.set_goals(swarm, goals, velocities, waypoints, robots, headings)
        self.statistics.change_goals(swarm)

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.swarm.keep(swarms)
        self.statistics.keep(swarms)
        self.scenario = [name for name, kept in zip(self.scenario, swarms, strict=True) if kept]

    def fork(self) -> RequestTask:
        """Return an independent copy of all episodes. The same requests give the same states as in the original."""
        fork = copy(self)
        fork.swarm = self.swarm.fork()
        fork.statistics = deepcopy(self.statistics)
        fork.scenario = list(self.scenario)
        return fork

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state, see `Swarm.state_dict`."""
        return {
            "swarm": self.swarm.state_dict(),
            "statistics": self.statistics.state_dict(),
            "scenario": list(self.scenario),
            "level": self.sampler.level,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict` of the same task, bit for bit.

        :raises ValueError: if the state belongs to another task
        """
        self.swarm.load_state_dict(state["swarm"])
        self.statistics.load_state_dict(state["statistics"])
        self.scenario = list(state["scenario"])
        self.sampler.set_level(state["level"])

    def observe(self, swarms: np.ndarray | None = None) -> np.ndarray:
        """Return the observations of all robots, (E, n, observation_size) float32, or only those of a mask's swarms."""
        return self.observation(self.swarm if swarms is None else self.swarm.part(swarms))

    def act(self, bits: np.ndarray) -> Outcome:
        """Take one step in every swarm. An announcement arrives like an answer and counts as a request. An announcement
        to a robot that does not perceive the sender is lost, but still counts.

        :param bits: actions, (E, n, n - 1, n_bits) bool, see `requests_of`
        """
        bits, neighbours = self.sent(bits), self.swarm.neighbours
        if bits.shape[-1] == 1:
            return self.step(bits[..., 0])
        requests = requests_of(bits, neighbours)
        announced = requests_of(bits & [False, True], neighbours)
        unheard = bits[..., 1:] & (neighbours.reverse < 0)[..., None]
        n_requests = requests.sum(axis=(1, 2)) + unheard.sum(axis=(1, 2, 3))
        return self.step(requests, bits.sum(axis=-1), n_requests, announced)

    def sent(self, bits: np.ndarray) -> np.ndarray:
        """Return the actions without the bits for empty slots.

        :param bits: actions, (E, n, n - 1, 1 or 2) bool, see `requests_of`
        """
        present = self.swarm.neighbours.present
        return bits if present is None else bits & present[..., None]

    def step(
        self,
        requests: np.ndarray,
        messages: np.ndarray | None = None,
        n_requests: np.ndarray | None = None,
        announced: np.ndarray | None = None,
    ) -> Outcome:
        """Take one step in every swarm.

        :param requests: whose plan each robot gets, as in `Swarm.step`
        :param messages: number of bits that each robot sets for each of the others, which the reward penalises,
            (E, n, n - 1); by default the requests
        :param n_requests: number of requests to report, (E,); by default that of ``requests``
        :param announced: which of the plans are sent unasked, as in `Swarm.step`
        """
        report = self.swarm.step(requests, announced)
        collided = report.collision_continuous if self.continuous_collisions else report.collision
        colliding = report.colliding_continuous if self.continuous_collisions else report.colliding
        if n_requests is None:
            n_requests = requests.sum(axis=(1, 2))
        if messages is None:
            messages, n_messages = requests, n_requests
        else:
            n_messages = messages.sum(axis=(1, 2))
        self.statistics.add(report, n_requests, collided)
        terms = {
            "goal": self.reward.goal * self.statistics.at_goals,
            "collision": -self.reward.collision * collided,
            "requests": -self.reward.request * n_messages,
        }
        reward = terms["goal"] + terms["collision"] + terms["requests"]
        near_misses = None
        if self.reward.near_miss:
            near_misses = self.reward.near_miss * self._near_misses(report)
            terms["near_miss"] = -np.sum(near_misses, axis=(1, 2)) / 2
            reward = reward + terms["near_miss"]
        terminated = collided if self.end_at_collision else np.zeros_like(collided)
        if self.end_at_arrival:
            terminated = terminated | self.statistics.arrived
        share = terms["goal"][:, None, None] / max(requests.shape[2], 1)
        if report.changed is not None:  # there may be empty slots
            present = report.others >= 0
            share = present * (terms["goal"][:, None] / np.maximum(present.sum(axis=2), 1))[..., None]
        pair_rewards = share - self.reward.collision * colliding - self.reward.request * messages
        if report.obstacles is not None:
            hits = report.obstacles.of(self.continuous_collisions)[1].any(axis=2, keepdims=True)
            pair_rewards = pair_rewards - self.reward.collision * hits / max(requests.shape[2], 1)
        if near_misses is not None:
            pair_rewards -= near_misses
        return Outcome(
            reward=reward,
            pair_rewards=pair_rewards.astype(np.float32),
            reward_terms=terms,
            terminated=terminated,
            truncated=~terminated & (self.statistics.steps >= self.max_steps),
            n_requests=n_requests,
            report=report,
        )

    def _near_misses(self, report: StepReport) -> np.ndarray:
        """Return the severity of each near miss, 0 to 1, (E, n, n - 1)."""
        reward, ahead, distance = self.reward, self.reward.near_miss_ahead, self.reward.near_miss_distance
        assert distance is not None  # set in __init__
        shortfall = distance - report.separation
        if ahead:
            limits = distance - reward.near_miss_narrowing * np.arange(1, ahead + 1) / ahead
            planned = (limits - self.swarm.planned_separation(ahead, report.others)).max(axis=-1)
            shortfall = np.maximum(shortfall, planned)
        return np.clip(shortfall / reward.near_miss_width, 0.0, 1.0) ** reward.near_miss_exponent

    def info(self, outcome: Outcome) -> dict[str, Any]:
        """Return the `info` of a step: arrays with a leading axis of swarms, some in dicts. See `QuadSwarmEnv`."""
        report = outcome.report
        more: dict[str, Any] = (
            {} if report.changed is None else {"neighbours": report.others, "pair_terminated": report.changed}
        )
        if report.obstacles is not None:
            more["min_obstacle_distance"] = report.obstacles.distance.min(axis=(1, 2))
            more["min_obstacle_distance_continuous"] = report.obstacles.distance_continuous.min(axis=(1, 2))
        if self.plans_in_info:
            more["plan"] = self._plan(report)
        return more | {
            "scenario": np.array(self.scenario),
            "team_reward": outcome.reward,
            "pair_rewards": outcome.pair_rewards,
            "reward_terms": outcome.reward_terms,
            "n_requests": outcome.n_requests,
            "min_separation": report.min_separation,
            "min_separation_continuous": report.min_separation_continuous,
            "collision": report.collision,
            "collision_continuous": report.collision_continuous,
            "at_goal": report.at_goal,
            "belief_source": report.belief_source,
            "planner": {"status": report.plan_status, "iterations": report.iterations},
            "metrics": {f"reward/{name}": term for name, term in outcome.reward_terms.items()},
        }

    def _plan(self, report: StepReport) -> dict[str, np.ndarray]:
        """Return what the robots planned in the last step: copies, since a reset writes into plans."""
        swarm, (n_swarms, n) = self.swarm, self.swarm.state.shape[:2]
        costs = swarm.planner.costs
        assert costs is not None
        return {
            "states": swarm.plans.copy(),
            "inputs": swarm.inputs.copy(),
            "cost": costs.reshape(n_swarms, n),
            "solve_seconds": np.full(n_swarms, report.solve_seconds),
        }

    def final_info(self) -> dict[str, Any]:
        """Return the additional `info` at the end of an episode: arrays with a leading axis of swarms."""
        return {"is_success": self.statistics.success, "metrics": self.statistics.metrics()}


@with_fields(TaskOptions)
def make_task(n_swarms: PositiveInt = 1, *, options: TaskOptions) -> RequestTask:
    """Create the task of an environment. The other arguments are those of `QuadSwarmEnv`.

    :param n_swarms: number of swarms E
    :raises ValueError: if a value is invalid; the message names it and the remedy
    """
    return task_of(options, n_swarms)


def task_of(options: TaskOptions, n_swarms: int = 1) -> RequestTask:
    """Create the task of an environment.

    :param options: its arguments, of the right types
    :param n_swarms: number of swarms E
    :raises ValueError: if a value is invalid; the message names it and the remedy
    """
    config = make_config(
        options.preset,
        options.world,
        **{name: getattr(options, name) for name in ("n_robots", "memory", "planner", "noise", "radio", "space")},
    )
    config = for_scenario(config, options.scenario)
    sampler = ScenarioSampler(options.scenario, config.n_robots, config.space, config)
    for sentence in too_short(config, options.max_steps) if options.max_steps is not None else ():
        warn(sentence)
    weights = replaced(RewardConfig(), options.reward or {}, "reward")
    return RequestTask(
        Swarm(config, n_swarms, options.solver, options.plans_in_info),
        sampler,
        weights,
        options.max_steps,
        make_observation(config, options.observation, options.scale_observation),
        options.continuous_collisions,
        options.end_at_arrival,
        announcements=options.announcements,
        plans_in_info=options.plans_in_info,
    )
