"""The Dec-POMDP of Sec. IV-B on top of the swarm: observation, reward, end of an episode. Batched over E swarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .beliefs import other_indices
from .presets import make_config, replace_fields
from .scenarios import ScenarioSampler
from .statistics import EpisodeStatistics
from .swarm import StepReport, Swarm


@dataclass(frozen=True)
class RewardConfig:
    """R = w_g R_g + w_coll R_coll + w_c R_c with the paper's values (Sec. V-A).

    :param goal: w_g r_g, paid in each step in which all robots are at their goals
    :param collision: w_coll r_coll, taken when two robots collide
    :param request: w_c, taken for each request
    """

    goal: float = 1.3
    collision: float = 150.0
    request: float = 0.1


class Outcome(NamedTuple):
    """Result of one step of E swarms.

    :param reward: team rewards, (E,)
    :param pair_rewards: the part of the reward that belongs to a robot and one of the others, (E, n, n - 1): its
        request, their collision, and an equal share of the goal's reward
    :param reward_terms: the weighted terms "goal", "collision" and "requests", each (E,)
    :param terminated: ended by a collision, (E,) bool
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


# About the largest speed (m/s) and the usual distance (m): divides observations to unit size.
_VELOCITY_SCALE = 4.0
_POSITION_SCALE = 4.0


class RequestTask:
    """Episodes of E swarms.

    :ivar statistics: figures of the running episodes

    :param swarm: the swarms
    :param sampler: draws episodes
    :param reward: weights of the reward
    :param max_steps: time limit (steps)
    :param scale_observation: divide distances by 4 m and velocities by 4 m/s
    :param continuous_collisions: end episodes at collisions between steps too; the paper looks at the steps alone
    """

    def __init__(
        self,
        swarm: Swarm,
        sampler: ScenarioSampler,
        reward: RewardConfig,
        max_steps: int = 100,
        scale_observation: bool = False,
        continuous_collisions: bool = False,
    ):
        if max_steps < 1:
            raise ValueError(f"max_steps={max_steps}: an episode needs at least one step.")
        self.swarm = swarm
        self.sampler = sampler
        self.reward = reward
        self.max_steps = max_steps
        self.continuous_collisions = continuous_collisions
        n = swarm.config.n_robots
        self.scenario = [""] * swarm.n_swarms
        self.statistics = EpisodeStatistics(swarm.n_swarms, n)
        self._others = other_indices(n)
        distance = _POSITION_SCALE if scale_observation else 1.0
        velocity = _VELOCITY_SCALE if scale_observation else 1.0
        self._scale = np.repeat([velocity, distance, distance, velocity], [3, 3, 3 * (n - 1), 3 * (n - 1)])

    @property
    def agent_names(self) -> tuple[str, ...]:
        """The robots' names."""
        return tuple(f"robot_{index}" for index in range(self.swarm.config.n_robots))

    @property
    def observation_layout(self) -> dict[str, Any]:
        """Which columns of an observation are about the robot itself and which about each of the others."""
        m = self.swarm.config.n_robots - 1
        others = [[6 + 3 * k + axis + part for part in (0, 3 * m) for axis in range(3)] for k in range(m)]
        return {"own": list(range(6)), "neighbours": others, "acts_on_neighbours": True}

    @property
    def action_cost(self) -> float:
        """What a request costs."""
        return self.reward.request

    @property
    def observation_size(self) -> int:
        """Length of one robot's observation, 6n."""
        return len(self._scale)

    def reset(self, swarm: int, rng: np.random.Generator) -> None:
        """Draw a new episode for one swarm; every random number of the episode comes from ``rng``."""
        self.place(swarm, *self.sampler.sample(rng), rng)

    def place(self, swarm: int, name: str, starts: np.ndarray, goals: np.ndarray, rng: np.random.Generator) -> None:
        """Begin a given episode in one swarm; ``rng`` seeds its disturbances. See `Swarm.reset`."""
        noise_seed = int(rng.integers(2**63)) if self.swarm.config.noise else 0
        self.swarm.reset(swarm, starts, goals, noise_seed)
        self.scenario[swarm] = name
        self.statistics.reset(swarm)

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.swarm.keep(swarms)
        self.statistics.keep(swarms)
        self.scenario = [name for name, kept in zip(self.scenario, swarms, strict=True) if kept]

    def observe(self) -> np.ndarray:
        """z_i = [v_i, p_ig, {p_ij}, {v_ij}] of every robot, (E, n, 6n) float32.

        Own velocity, goal relative to the robot, then all relative positions of the others, then all their relative
        velocities, others in ascending order.
        """
        pos, vel = self.swarm.pos, self.swarm.vel
        relative_pos = pos[:, self._others] - pos[:, :, None]
        relative_vel = vel[:, self._others] - vel[:, :, None]
        flat = (*pos.shape[:2], -1)
        parts = (vel, self.swarm.goal - pos, relative_pos.reshape(flat), relative_vel.reshape(flat))
        return (np.concatenate(parts, axis=-1) / self._scale).astype(np.float32)

    def step(self, requests: np.ndarray) -> Outcome:
        """One step of every swarm; ``requests`` as in `Swarm.step`."""
        report = self.swarm.step(requests)
        collided = report.collision_continuous if self.continuous_collisions else report.collision
        colliding = report.colliding_continuous if self.continuous_collisions else report.colliding
        n_requests = requests.sum(axis=(1, 2))
        self.statistics.add(report, n_requests, collided)
        terms = {
            "goal": self.reward.goal * report.at_goal.all(axis=1),
            "collision": -self.reward.collision * collided,
            "requests": -self.reward.request * n_requests,
        }
        share = terms["goal"] / max(requests.shape[2], 1)
        return Outcome(
            reward=terms["goal"] + terms["collision"] + terms["requests"],
            pair_rewards=(
                share[:, None, None] - self.reward.collision * colliding - self.reward.request * requests
            ).astype(np.float32),
            reward_terms=terms,
            terminated=collided,
            truncated=~collided & (self.statistics.steps >= self.max_steps),
            n_requests=n_requests,
            report=report,
        )

    def info(self, outcome: Outcome) -> dict[str, Any]:
        """The last step for `info`: arrays with a leading axis of swarms, some in dicts. See `QuadSwarmEnv`."""
        report = outcome.report
        return {
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


def make_task(
    n_swarms: int = 1,
    preset: str = "paper",
    scenario: str = "mixed",
    n_robots: int | None = None,
    max_steps: int = 100,
    scale_observation: bool = False,
    continuous_collisions: bool = False,
    memory: float | None = None,
    reward: Mapping[str, float] | None = None,
    planner: Mapping[str, Any] | None = None,
    noise: Mapping[str, float] | None = None,
    space: Mapping[str, Any] | None = None,
    solver: str = "auto",
) -> RequestTask:
    """The task of an environment; arguments as in `QuadSwarmEnv`.

    :param n_swarms: number of swarms E
    :raises ValueError: a wrong value; the message names it and the remedy
    """
    config = make_config(preset, n_robots=n_robots, memory=memory, planner=planner, noise=noise, space=space)
    sampler = ScenarioSampler(scenario, config.n_robots, config.space)
    weights = replace_fields(RewardConfig(), reward or {}, "reward")
    swarm = Swarm(config, n_swarms, solver)
    return RequestTask(swarm, sampler, weights, max_steps, scale_observation, continuous_collisions)
