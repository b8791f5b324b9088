"""Conversion of our robots' commands, with a climb rate, to those of other simulators: an attitude and a thrust."""

from __future__ import annotations

import numpy as np

GRAVITY = 9.81  # m/s^2
_CLIMB_GAIN = 3.0  # 1/s
_MOST = 1.8  # maximum thrust as a multiple of the weight


def thrust(state: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Compute the thrust per mass of a proportional controller of the climb rate, (...) (m/s^2).

    :param state: states, (..., 9)
    :param u: inputs, (..., 4)
    """
    cos_tilt = np.cos(state[..., 6]) * np.cos(state[..., 7])
    climb = GRAVITY + _CLIMB_GAIN * (u[..., 2] - state[..., 5])
    return np.clip(climb / np.maximum(cos_tilt, 0.5), 0.0, _MOST * GRAVITY)


def yaw(state: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """Compute the commanded yaw: the current yaw plus its change in a sub-step, (...) (rad).

    :param state: states, (..., 9)
    :param u: inputs, (..., 4)
    :param dt: length of the sub-step (s)
    """
    return state[..., 8] + u[..., 3] * dt
