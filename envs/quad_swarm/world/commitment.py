"""Robots keep to the plans that they sent, so that others may rely on them.

A compatibility constraint of distributed receding-horizon control (Dunbar and Murray 2006, Automatica), here as a soft
cost: the squared distance at each stage k to the plan that was sent last, to anybody, as far as that plan reaches, with
the weight ``W exp(-fade k / N)``. Without a plan sent in the last N steps, there is no cost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quad_swarm.native.pairs import advance
from quad_swarm.planner import PlannerConfig
from quad_swarm.states import MOST_STEPS, like
from quad_swarm.world.beliefs import resampled


class Commitment:
    """The plans that n robots in E swarms sent last.

    :ivar plan: their positions now and at the next N steps, (E, n, N + 1, 3), world frame (m)
    :ivar age: steps since each was made, (E, n); N if a robot sent none in the last N steps

    :param config: the planner
    :param n_swarms: number of swarms E
    :param n_robots: number of robots
    """

    def __init__(self, config: PlannerConfig, n_swarms: int, n_robots: int):
        self.config = config
        self.plan = np.zeros((n_swarms, n_robots, config.horizon + 1, 3))
        self.age = np.full((n_swarms, n_robots), config.horizon)

    @classmethod
    def of(cls, config: PlannerConfig, n_swarms: int, n_robots: int) -> Commitment | None:
        """Return what robots have sent at first, nothing; None if it does not matter to their planner."""
        return cls(config, n_swarms, n_robots) if config.commitment else None

    def sent(self, who: np.ndarray, plans: np.ndarray, age: int | np.ndarray) -> None:
        """Note that robots sent plans.

        :param who: which robots did, (E, n) bool
        :param plans: plans that each of them would have sent, now and at the next N steps, (E, n, N + 1, 3) (m)
        :param age: steps since they were made
        """
        newer = who & (np.asarray(age) <= self.age)
        self.plan[newer] = plans[newer]
        self.age[newer] = np.minimum(age, self.config.horizon)

    def advance(self) -> None:
        """Let a step pass."""
        self.plan = advance(self.plan)
        self.age = np.minimum(self.age + 1, self.config.horizon)

    def reference(self, late: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return what plans keep to, see `Problems`.

        :param late: when inputs take effect, as a fraction of a step, (E, n); None if all do so at once
        :return: positions at stages 1..N, (E n, N, 3) (m), and weights of the squared distances, (E n, N) (1/m^2)
        """
        config, horizon = self.config, self.config.horizon
        plan = self.plan[..., 1:, :] if late is None else resampled(self.plan[..., 1:, :], late)
        stages = np.arange(horizon)
        covered = stages < horizon - self.age[..., None]
        weight = config.commitment * np.exp(-config.commitment_fade * stages / horizon) * covered
        return plan.reshape(-1, horizon, 3).copy(), weight.reshape(-1, horizon)

    def forget(self, swarm: int | slice) -> None:
        """Forget what the robots of a swarm sent."""
        self.age[swarm] = self.config.horizon

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.plan, self.age = self.plan[swarms], self.age[swarms]

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state, see `load_state_dict`."""
        return {"plan": self.plan.copy(), "age": self.age.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`.

        :raises ValueError: if it belongs to other swarms
        """
        self.plan = like(self.plan, state["plan"], "plans sent")
        self.age = like(self.age, state["age"], "ages of plans sent", 0, MOST_STEPS)

    def __copy__(self) -> Commitment:
        other = object.__new__(type(self))
        other.config, other.plan, other.age = self.config, self.plan.copy(), self.age.copy()
        return other
