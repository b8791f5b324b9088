"""From a robot's set-point to attitude and thrust, what autopilots fly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat

from quad_swarm.validation import checked

GRAVITY = 9.81  # m/s^2


class Attitude(NamedTuple):
    """What an autopilot is told.

    :param roll: roll (rad), x forward, y left, z up
    :param pitch: pitch (rad), positive with the nose down
    :param yaw: yaw (rad), from the x axis of the world towards its y axis
    :param thrust: share of the largest thrust, 0 to 1
    """

    roll: float
    pitch: float
    yaw: float
    thrust: float


@checked
@dataclass(frozen=True)
class AttitudeGains:
    """How a climb rate becomes a thrust.

    :param hover_thrust: share of the largest thrust with which the vehicle hovers, as far as it is known
    :param climb: acceleration for an error of the climb rate (1/s)
    :param integral: change of that acceleration with time (1/s^2), which makes up for a wrong ``hover_thrust``
    :param most: largest share of the weight that the integral makes up for
    :raises ValueError: if a value is out of range
    """

    hover_thrust: Annotated[float, Field(gt=0, lt=1)] = 0.5
    climb: PositiveFloat = 3.0
    integral: Annotated[float, Field(ge=0)] = 2.0
    most: Annotated[float, Field(ge=0, lt=1)] = 0.5


class AttitudeController:
    """Turns set-points into attitude and thrust, and holds the heading. Without the integral, a hover thrust that is
    wrong by 20 % is an error of the height of more than half a metre.

    :ivar yaw: heading that it holds (rad), which the set-points' yaw rate turns

    :param gains: see `AttitudeGains`
    :param yaw: heading at the start (rad)
    """

    def __init__(self, gains: AttitudeGains | None = None, yaw: float = 0.0):
        self.gains, self.yaw = gains or AttitudeGains(), yaw
        self._integral = 0.0

    def reset(self, yaw: float | None = None) -> None:
        """Forget what the integral has made up for, as before an autopilot begins to fly what it is told.

        :param yaw: heading to hold (rad), by default the one that it holds
        """
        self._integral = 0.0
        self.yaw = self.yaw if yaw is None else yaw

    def __call__(self, state: np.ndarray, setpoint: np.ndarray, elapsed: float) -> Attitude:
        """Return what the autopilot is told.

        :param state: the robot's state, (9,)
        :param setpoint: roll, pitch (rad), climb rate (m/s) and yaw rate (rad/s), (4,)
        :param elapsed: time since the last call (s)
        """
        gains, most = self.gains, self.gains.most * GRAVITY
        roll, pitch, climb, turn = map(float, setpoint)
        error, elapsed = climb - float(state[5]), float(np.clip(elapsed, 0.0, 0.2))
        self._integral = float(np.clip(self._integral + gains.integral * error * elapsed, -most, most))
        self.yaw = float(np.arctan2(np.sin(self.yaw + turn * elapsed), np.cos(self.yaw + turn * elapsed)))
        upwards = GRAVITY + gains.climb * error + self._integral
        tilt = max(float(np.cos(state[6]) * np.cos(state[7])), 0.5)
        thrust = float(np.clip(gains.hover_thrust * upwards / GRAVITY / tilt, 0.0, 1.0))
        return Attitude(roll, pitch, self.yaw, thrust)
