"""What simulators of other people take: an attitude and a thrust. Our robots command a climb rate."""

from __future__ import annotations

import numpy as np

GRAVITY = 9.81  # m/s^2
_CLIMB_GAIN = 3.0  # 1/s
_MOST = 1.8  # of the weight


def thrust(state: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Thrust by mass of a proportional loop on the climb rate, (...) (m/s^2).

    :param state: states, (..., 9)
    :param u: inputs, (..., 4)
    """
    cos_tilt = np.cos(state[..., 6]) * np.cos(state[..., 7])
    climb = GRAVITY + _CLIMB_GAIN * (u[..., 2] - state[..., 5])
    return np.clip(climb / np.maximum(cos_tilt, 0.5), 0.0, _MOST * GRAVITY)


def yaw(state: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """Yaw to be held: the robot's own, turned by what its rate makes of it in a sub-step, (...) (rad).

    :param dt: length of the sub-step (s)
    """
    return state[..., 8] + u[..., 3] * dt
