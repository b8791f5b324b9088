"""The Dec-POMDP of Sec. IV-B on top of the swarm: observation, reward, end of an episode. Batched over E swarms."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from quad_swarm.task.episode_statistics import EpisodeStatistics
from quad_swarm.task.observation import Observation, PaperObservation, make_observation
from quad_swarm.validation import checked, checked_arguments, replaced
from quad_swarm.world.beliefs import other_indices, reverse_indices
from quad_swarm.world.neighbours import Neighbours
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import StepReport, Swarm


@checked
@dataclass(frozen=True)
class RewardConfig:
    """R = w_g R_g + w_coll R_coll + w_c R_c with the paper's values (Sec. V-A).

    :param goal: w_g r_g, paid in each step in which all robots are at their goals
    :param collision: w_coll r_coll, taken when two robots collide
    :param request: w_c, taken for each request
    :param near_miss: not in the paper: taken in each step for each pair closer than ``near_miss_distance``, in full at
        ``near_miss_width`` less than that and in proportion before; a signal that is less rare than collisions
    :param near_miss_exponent: of that proportion: above 1, a slight miss weighs less and one that almost touches more
    :param near_miss_distance: see there (m); None: what the planner keeps
    :param near_miss_width: see there (m)
    :param near_miss_ahead: count also how close the two come by their plans within so many further steps
    :param near_miss_narrowing: by how much ``near_miss_distance`` is less for the last of those steps, in proportion
        for those before: plans that are far ahead still change (m)
    :raises ValueError: a value is negative or not finite; the near misses' distance or width is zero
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
    :param pair_rewards: the part of the reward that belongs to a robot and one of the others, (E, n, n - 1): its
        request, their collision, and an equal share of the goal's reward
    :param reward_terms: the weighted terms "goal", "collision" and "requests", and "near_miss" where it has a
        weight, each (E,)
    :param terminated: ended by a collision, or by the arrival of all where that ends episodes, (E,) bool
    :param truncated: ended by the time limit, (E,) bool
    :param n_requests: requests made, (E,)
    :param report: what happened in the world
    """

    reward: np.ndarray
    pair_rewards: np.ndarray
    reward_terms: dict[str, np.ndarray]
    terminated: np.ndarray
    truncated: np.ndarray
    n_requests: np.ndarray
    report: StepReport


def requests_of(bits: np.ndarray, neighbours: Neighbours | None = None) -> np.ndarray:
    """Who gets whose plan.

    :param bits: of each robot for each of the others, (..., n, n - 1, 1 or 2) bool: whether it asks it for its plan
        and, with announcements, whether it sends it the own one
    :param neighbours: whom robots perceive; then there is one leading axis, of swarms; None: everybody
    :return: (..., n, n - 1) bool, as if all of these plans had been asked for
    """
    if bits.shape[-1] == 1:
        return bits[..., 0]
    if neighbours is not None:
        return bits[..., 0] | neighbours.of_the_other(bits[..., 1])
    n = bits.shape[-3]
    return bits[..., 0] | bits[..., other_indices(n), reverse_indices(n), 1]


class RequestTask:
    """Episodes of E swarms.

    :ivar statistics: figures of the running episodes

    :param swarm: the swarms
    :param sampler: draws episodes
    :param reward: weights of the reward
    :param max_steps: time limit (steps); None: the world's
    :param observation: what robots observe, the paper's without scaling if None
    :param continuous_collisions: whether a collision is contact at any time of a step, or at the steps alone; None: as
        the world says
    :param end_at_arrival: end episodes as soon as all robots are at their goals; the paper flies on to the time limit
    :param end_at_collision: end episodes at collisions; otherwise they fly on, to see how deep a collision gets
    :param announcements: robots may send their plans unasked too, see `act`
    :raises ValueError: near misses are looked for beyond the plans' end
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
    ):
        last = swarm.config.planner.horizon - 1
        if reward.near_miss_ahead > last:
            raise ValueError(
                f"reward.near_miss_ahead={reward.near_miss_ahead}: plans reach planner.horizon - 1 = {last} steps "
                "beyond the present one."
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
        self.scenario = [""] * swarm.n_swarms
        self.statistics = EpisodeStatistics(swarm.n_swarms, swarm.config)
        self.observation = observation or PaperObservation(swarm.config, scaled=False)

    @property
    def agent_names(self) -> tuple[str, ...]:
        """The robots' names."""
        return tuple(f"robot_{index}" for index in range(self.swarm.config.n_robots))

    @property
    def observation_layout(self) -> dict[str, Any]:
        """Which columns of an observation are about the robot itself and which about each of the others."""
        return self.observation.layout

    @property
    def action_cost(self) -> float:
        """What a request costs."""
        return self.reward.request

    @property
    def observation_size(self) -> int:
        """Length of one robot's observation."""
        return self.observation.size

    def reset(self, swarm: int, rng: np.random.Generator) -> None:
        """Draw a new episode for one swarm; every random number of the episode comes from ``rng``."""
        self.place(swarm, *self.sampler.sample(rng), rng)

    def place(self, swarm: int, name: str, starts: np.ndarray, goals: np.ndarray, rng: np.random.Generator) -> None:
        """Begin a given episode in one swarm; ``rng`` seeds its disturbances. See `Swarm.reset`."""
        noise_seed = int(rng.integers(2**63)) if self.swarm.config.is_random else 0
        self.swarm.reset(swarm, starts, goals, noise_seed)
        self.scenario[swarm] = name
        self.statistics.reset(swarm)

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.swarm.keep(swarms)
        self.statistics.keep(swarms)
        self.scenario = [name for name, kept in zip(self.scenario, swarms, strict=True) if kept]

    def fork(self) -> RequestTask:
        """A copy of all episodes as they are now, which flies on by itself: the same requests give the same states."""
        fork = copy(self)
        fork.swarm = self.swarm.fork()
        fork.statistics = deepcopy(self.statistics)
        fork.scenario = list(self.scenario)
        return fork

    def state_dict(self) -> dict[str, Any]:
        """All of the present state, see `Swarm.state_dict`."""
        return {
            "swarm": self.swarm.state_dict(),
            "statistics": self.statistics.state_dict(),
            "scenario": list(self.scenario),
            "level": self.sampler.level,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state_dict` of the same task gave, bit for bit.

        :raises ValueError: the state of another task
        """
        self.swarm.load_state_dict(state["swarm"])
        self.statistics.load_state_dict(state["statistics"])
        self.scenario = list(state["scenario"])
        self.sampler.set_level(state["level"])

    def observe(self, swarms: np.ndarray | None = None) -> np.ndarray:
        """What every robot observes, (E, n, observation_size) float32; of some swarms only if there is a mask."""
        return self.observation(self.swarm if swarms is None else self.swarm.part(swarms))

    def act(self, bits: np.ndarray) -> Outcome:
        """One step of every swarm. An announcement arrives as an answer would, and is counted as a request. To one that
        does not perceive the robot it is sent in vain.

        :param bits: (E, n, n - 1, n_bits) bool, see `requests_of`
        """
        bits, neighbours = self.sent(bits), self.swarm.neighbours
        requests = requests_of(bits, neighbours)
        unheard = bits[..., 1:] & (neighbours.reverse < 0)[..., None]
        return self.step(requests, bits.sum(axis=-1), requests.sum(axis=(1, 2)) + unheard.sum(axis=(1, 2, 3)))

    def sent(self, bits: np.ndarray) -> np.ndarray:
        """What is sent of an action: nothing to an empty place.

        :param bits: (E, n, n - 1, 1 or 2) bool, see `requests_of`
        """
        present = self.swarm.neighbours.present
        return bits if present is None else bits & present[..., None]

    def step(
        self, requests: np.ndarray, messages: np.ndarray | None = None, n_requests: np.ndarray | None = None
    ) -> Outcome:
        """One step of every swarm.

        :param requests: who gets whose plan, as in `Swarm.step`
        :param messages: how many messages each robot sends because of each of the others, (E, n, n - 1); None: it asks
            for all plans that it gets
        :param n_requests: how many requests to count, (E,); None: ``requests``
        """
        if messages is None:
            messages = requests
        report = self.swarm.step(requests)
        collided = report.collision_continuous if self.continuous_collisions else report.collision
        colliding = report.colliding_continuous if self.continuous_collisions else report.colliding
        if n_requests is None:
            n_requests = requests.sum(axis=(1, 2))
        self.statistics.add(report, n_requests, collided)
        terms = {
            "goal": self.reward.goal * report.at_goal.all(axis=1),
            "collision": -self.reward.collision * collided,
            "requests": -self.reward.request * messages.sum(axis=(1, 2)),
        }
        near_misses = np.zeros_like(report.separation)
        if self.reward.near_miss:
            near_misses = self.reward.near_miss * self._near_misses(report)
            terms["near_miss"] = -near_misses.sum(axis=(1, 2)) / 2
        terminated = collided if self.end_at_collision else np.zeros_like(collided)
        if self.end_at_arrival:
            terminated = terminated | self.statistics.arrived
        present = np.broadcast_to(report.others >= 0, requests.shape)
        share = present * (terms["goal"][:, None] / np.maximum(present.sum(axis=2), 1))[..., None]
        return Outcome(
            reward=sum(terms.values(), start=np.zeros(len(n_requests))),
            pair_rewards=(
                share - self.reward.collision * colliding - self.reward.request * messages - near_misses
            ).astype(np.float32),
            reward_terms=terms,
            terminated=terminated,
            truncated=~terminated & (self.statistics.steps >= self.max_steps),
            n_requests=n_requests,
            report=report,
        )

    def _near_misses(self, report: StepReport) -> np.ndarray:
        """How near each miss is, 0 to 1, (E, n, n - 1)."""
        reward, ahead, distance = self.reward, self.reward.near_miss_ahead, self.reward.near_miss_distance
        assert distance is not None  # filled in above
        shortfall = distance - report.separation
        if ahead:
            limits = distance - reward.near_miss_narrowing * np.arange(1, ahead + 1) / ahead
            planned = (limits - self.swarm.planned_separation(ahead, report.others)).max(axis=-1)
            shortfall = np.maximum(shortfall, planned)
        return np.clip(shortfall / reward.near_miss_width, 0.0, 1.0) ** reward.near_miss_exponent

    def info(self, outcome: Outcome) -> dict[str, Any]:
        """The last step for `info`: arrays with a leading axis of swarms, some in dicts. See `QuadSwarmEnv`."""
        report = outcome.report
        who = {} if report.changed is None else {"neighbours": report.others, "pair_terminated": report.changed}
        return who | {
            "scenario": np.array(self.scenario),
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

    def final_info(self) -> dict[str, Any]:
        """What `info` says at the end of an episode beside that: arrays with a leading axis of swarms."""
        return {"is_success": self.statistics.success, "metrics": self.statistics.metrics()}


@checked_arguments
def make_task(
    n_swarms: PositiveInt = 1,
    preset: str = "paper",
    scenario: str | Mapping[str, float] = "mixed",
    n_robots: int | None = None,
    max_steps: PositiveInt | None = None,
    observation: str = "paper",
    scale_observation: bool = False,
    continuous_collisions: bool | None = None,
    end_at_arrival: bool = False,
    memory: float | None = None,
    reward: Mapping[str, Any] | None = None,
    planner: Mapping[str, Any] | None = None,
    noise: Mapping[str, Any] | None = None,
    radio: Mapping[str, Any] | None = None,
    space: Mapping[str, Any] | None = None,
    world: Mapping[str, Any] | None = None,
    solver: str = "auto",
    announcements: bool = False,
) -> RequestTask:
    """The task of an environment; arguments as in `QuadSwarmEnv`.

    :param n_swarms: number of swarms E
    :raises ValueError: a wrong value; the message names it and the remedy
    """
    config = make_config(
        preset, world, n_robots=n_robots, memory=memory, planner=planner, noise=noise, radio=radio, space=space
    )
    sampler = ScenarioSampler(scenario, config.n_robots, config.space)
    weights = replaced(RewardConfig(), reward or {}, "reward")
    swarm = Swarm(config, n_swarms, solver)
    seen = make_observation(config, observation, scale_observation)
    return RequestTask(
        swarm, sampler, weights, max_steps, seen, continuous_collisions, end_at_arrival, announcements=announcements
    )
