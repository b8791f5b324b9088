"""The Dec-POMDP of Sec. IV-B on top of the swarm: observation, reward, end of an episode. Batched over E swarms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .beliefs import other_indices
from .scenarios import ScenarioSampler
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
    :param reward_terms: the weighted terms "goal", "collision" and "requests", each (E,)
    :param terminated: ended by a collision, (E,) bool
    :param truncated: ended by the time limit, (E,) bool
    :param n_requests: requests made, (E,)
    :param report: what happened in the world
    """

    reward: np.ndarray
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
        self.elapsed = np.zeros(swarm.n_swarms, dtype=np.int64)
        self._others = other_indices(n)
        distance = _POSITION_SCALE if scale_observation else 1.0
        velocity = _VELOCITY_SCALE if scale_observation else 1.0
        self._scale = np.repeat([velocity, distance, distance, velocity], [3, 3, 3 * (n - 1), 3 * (n - 1)])

    @property
    def observation_size(self) -> int:
        """Length of one robot's observation, 6n."""
        return len(self._scale)

    def reset(self, swarm: int, rng: np.random.Generator) -> None:
        """Draw a new episode for one swarm; every random number of the episode comes from ``rng``."""
        name, starts, goals = self.sampler.sample(rng)
        noise_seed = int(rng.integers(2**63)) if self.swarm.config.noise else 0
        self.place(swarm, name, starts, goals, noise_seed)

    def place(self, swarm: int, name: str, starts: np.ndarray, goals: np.ndarray, noise_seed: int = 0) -> None:
        """Begin a given episode in one swarm; see `Swarm.reset`."""
        self.swarm.reset(swarm, starts, goals, noise_seed)
        self.scenario[swarm] = name
        self.elapsed[swarm] = 0

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.swarm.keep(swarms)
        self.elapsed = self.elapsed[swarms]
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
        self.elapsed += 1
        collided = report.collision_continuous if self.continuous_collisions else report.collision
        n_requests = requests.sum(axis=(1, 2))
        terms = {
            "goal": self.reward.goal * report.at_goal.all(axis=1),
            "collision": -self.reward.collision * collided,
            "requests": -self.reward.request * n_requests,
        }
        return Outcome(
            reward=terms["goal"] + terms["collision"] + terms["requests"],
            reward_terms=terms,
            terminated=collided,
            truncated=~collided & (self.elapsed >= self.max_steps),
            n_requests=n_requests,
            report=report,
        )
