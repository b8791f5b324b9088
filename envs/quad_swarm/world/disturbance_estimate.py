"""Robots estimate a constant acceleration that their model does not know: wind, payload, trim.

An observer of first order, as of a disturbance state in offset-free model predictive control (Pannocchia and Rawlings
2003, AIChE Journal): whatever the velocity differs from the model's prediction at the end of a step moves the estimate
by dt / T of the acceleration that explains it. Robots use nothing but the states that they estimate anyway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quad_swarm.planner import MixedPlanner, base
from quad_swarm.quadrotor import VELOCITY, QuadrotorModel, VehicleModel
from quad_swarm.states import like


class DisturbanceEstimate:
    """The accelerations that n robots in E swarms estimate.

    :ivar acceleration: the estimates, (E, n, 3), world frame (m/s^2)

    :param planners: the planners of the robots' kinds
    :param kind_of: which of them each robot has, (n,)
    :param model: discrete dynamics of the robots
    :param n_swarms: number of swarms E
    """

    def __init__(self, planners: Sequence[base.Planner], kind_of: Sequence[int], model: VehicleModel, n_swarms: int):
        config = planners[0].config
        assert config.disturbance_time is not None
        self._model, self._dt = model, config.dt
        self._gain = 1 - np.exp(-config.dt / config.disturbance_time)
        self._largest = np.array([_largest(planner) for planner in planners])[list(kind_of)]
        self.acceleration = np.zeros((n_swarms, len(kind_of), 3))
        self._expected = np.full(self.acceleration.shape, np.nan)  # velocities now

    @classmethod
    def of(cls, planner: base.Planner | MixedPlanner, n_swarms: int, n_robots: int) -> DisturbanceEstimate | None:
        """Return the estimates at first, which are 0; None if robots estimate nothing.

        :param planner: the planner of the n robots
        :param n_swarms: number of swarms E
        :param n_robots: number of robots
        """
        planners: tuple[base.Planner, ...]
        if isinstance(planner, MixedPlanner):
            planners, kind_of = planner.planners, planner.kind_of
        else:
            planners, kind_of = (planner,), (0,) * n_robots
        if planners[0].config.disturbance_time is None:
            return None
        return cls(planners, kind_of, planner.model, n_swarms)

    def update(self, estimate: np.ndarray) -> None:
        """Compare states with those that were expected.

        :param estimate: estimated states now, (E, n, 9)
        """
        _, velocity = self._model.drift(self._dt)
        change = (estimate[..., VELOCITY] - self._expected) / velocity
        change = np.where(np.isfinite(change), change, 0.0)
        self.acceleration = np.clip(self.acceleration + self._gain * change, -self._largest, self._largest)

    def expect(self, x: np.ndarray, u: np.ndarray, late: np.ndarray | None) -> None:
        """Note what is expected of a step.

        :param x: states when the inputs take effect, (E, n, 9)
        :param u: the inputs, (E, n, 4)
        :param late: when that is, as a fraction of a step, (E, n); None if at the start of the step
        """
        left = np.full(x.shape[:2], self._dt) if late is None else (1 - late) * self._dt
        self._expected = self._model.ahead(x, u, left, self.acceleration)[..., VELOCITY].copy()

    def miss(self) -> None:
        """Note that nothing is expected of a step, since nobody computed it."""
        self._expected = np.full_like(self._expected, np.nan)

    def forget(self, swarm: int | slice) -> None:
        """Forget what the robots of a swarm estimated."""
        self.acceleration[swarm] = 0.0
        self._expected[swarm] = np.nan

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        self.acceleration, self._expected = self.acceleration[swarms], self._expected[swarms]

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state, see `load_state_dict`."""
        known = np.isfinite(self._expected)
        return {
            "acceleration": self.acceleration.copy(),
            "expected": np.where(known, self._expected, 0.0),
            "known": known,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`.

        :raises ValueError: if it belongs to other swarms
        """
        self.acceleration = like(self.acceleration, state["acceleration"], "estimated accelerations")
        known = like(np.zeros(self._expected.shape, dtype=bool), state["known"], "known velocities")
        expected = like(np.zeros(self._expected.shape), state["expected"], "expected velocities")
        self._expected = np.where(known, expected, np.nan)

    def __copy__(self) -> DisturbanceEstimate:
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.acceleration, other._expected = self.acceleration.copy(), self._expected.copy()
        return other


def _largest(planner: base.Planner) -> np.ndarray:
    """Return the accelerations against which nine tenths of tilt and climb rate hold robots, (3,) (m/s^2)."""
    assert isinstance(planner.model, QuadrotorModel)  # problems of other vehicles refuse to estimate any
    config, params = planner.config, planner.model.params
    sideways = params.gravity * np.tan(0.9 * config.max_tilt * np.array([params.pitch_gain, params.roll_gain]))
    climb = min(config.max_climb_rate, config.descent_rate)
    return np.array([*sideways, 0.9 * climb * params.climb_gain / params.climb_time_constant])
