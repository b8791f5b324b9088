"""Fit the planner's model to logged states and set-points, as far as they determine it.

Each of roll, pitch and climb rate is a first-order lag of its set-point, and horizontal velocity integrates what the
attitude accelerates, less drag. The log is cut into windows, each with a state of its own to begin from, so that
neither noise nor gusts add up. Set-points may act later (or earlier) than their stamps say, by a delay for each robot,
and constant errors of attitude, and constant wind, are fitted with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quad_swarm.errors import needs_extra
from quad_swarm.quadrotor import QuadrotorParams

WINDOW = 2.0  # s
LEAST_WINDOWS, _MOST_WINDOWS = 12, 1000
LONGEST_STEP = 0.11  # s between samples
_DELAYS = (-0.1, 0.2)  # s
_LEAD = 0.3  # s before a window, for set-points that act late
_TIME_CONSTANTS = (0.01, 3.0)  # s
_DRAGS = (1e-4, 5.0)  # 1/s
_GAINS = (0.05, 20.0)
_ANY_DRAG, _MOST_MISSED = 0.3, 0.5  # 1/s, share of the changes of velocity
_LAGS = ("roll", "pitch", "climb")  # columns of set-points
_COLUMNS = (3, 4, 2)  # of states
_STEP = 1e-6  # of derivatives
_GROUPS = 8  # of windows, each left out once, for the errors
_HELD_OUT = 4  # every fourth window
# Standard errors from which on a parameter is not determined: a share of gains and time constants, drag in 1/s
_MOST_ERROR, _MOST_DRAG_ERROR = 0.1, 0.1
# Least standard deviations of the set-points (rad, m/s) and of horizontal velocities (m/s)
_LEAST_TILT, _LEAST_CLIMB, _LEAST_SPEED = 0.02, 0.1, 0.3


class Log(NamedTuple):
    """Logged states and set-points of n vehicles of a kind.

    :param time: times (s), ascending, (T,)
    :param state: position (m), velocity (m/s), roll, pitch and yaw (rad), (T, n, 9)
    :param setpoint: roll, pitch (rad), climb rate (m/s) and yaw rate (rad/s) from then on, (T, n, 4)
    """

    time: np.ndarray
    state: np.ndarray
    setpoint: np.ndarray


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    :param params: parameters
    :param errors: standard errors of the fitted parameters by name (jackknife over groups of windows)
    :param delay: how much later than their stamps set-points act, mean over the robots (s)
    :param attitude: errors of roll and pitch in windows that were held out (rad)
    :param velocity: errors of the velocities there (m/s)
    :param windows: number of windows that were fitted
    """

    params: QuadrotorParams
    errors: dict[str, float]
    delay: float
    attitude: np.ndarray
    velocity: np.ndarray
    windows: int


class _Windows(NamedTuple):
    """Windows of S samples after L samples that lead to them.

    :param robot: number of the robot of all logs, (W,)
    :param number: which of its robot's windows this is, (W,)
    :param time: times since the window began (s), (W, L + S)
    :param state: velocity, roll, pitch and yaw, (W, L + S, 6)
    :param setpoint: roll, pitch and climb rate, (W, L + S, 3)
    :param lead: number of samples L
    """

    robot: np.ndarray
    number: np.ndarray
    time: np.ndarray
    state: np.ndarray
    setpoint: np.ndarray
    lead: int

    def pick(self, which: np.ndarray) -> _Windows:
        robot, number, time, state, setpoint, lead = self
        return _Windows(robot[which], number[which], time[which], state[which], setpoint[which], lead)


def fit(logs: Sequence[Log], window: float = WINDOW) -> Fit:
    """Fit the model to logs of vehicles of a kind.

    :param logs: the logs, with the same rate
    :param window: length of the windows (s)
    :raises ValueError: if the logs are too short, too slow or hold too little motion to determine a parameter
    """
    for log in logs:
        if (steepest := float(np.abs(log.state[..., 6:8]).max())) >= np.pi / 2:
            raise ValueError(f"it has a roll or pitch of {steepest:.3g}: attitudes are in rad, below pi/2")
    windows = _cut(logs, window)
    turn = windows.number + windows.robot
    held_out = (windows.number > 0) & (turn % _HELD_OUT == _HELD_OUT - 1)
    fitted, tested = windows.pick(~held_out), windows.pick(held_out)
    _check_motion(fitted)
    _check_axes(fitted)
    best = _fit(fitted)
    _check_values(best.values)
    attitude, velocity = _residuals(tested, best)
    groups = np.unique(turn[~held_out], return_inverse=True)[1] % _GROUPS
    others = [_fit(fitted.pick(groups != k), best) for k in range(_GROUPS)]
    errors = {
        name: float(
            np.sqrt((_GROUPS - 1) / _GROUPS * sum((one.values[name] - best.values[name]) ** 2 for one in others))
        )
        for name in best.values
    }
    _check_errors(best.values, errors)
    params = QuadrotorParams(**best.values)
    return Fit(params, errors, float(best.delays.mean()), attitude, velocity, len(fitted.robot))


class _Fitted(NamedTuple):
    """Parameters by name, and the delays of the set-points of each robot, (robots,) (s)."""

    values: dict[str, float]
    delays: np.ndarray


def _cut(logs: Sequence[Log], window: float) -> _Windows:
    parts: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
    first, steps = 0, [float(np.median(np.diff(log.time))) for log in logs]
    step = max(steps)
    if step > LONGEST_STEP:
        raise ValueError(
            f"it has a sample each {step:.2g} s: the fit needs one each {LONGEST_STEP:.2g} s or more often"
        )
    if step > 1.5 * min(steps):
        raise ValueError(
            f"the logs have samples each {min(steps):.2g} and {step:.2g} s: fit those of one rate together"
        )
    size, lead = max(round(window / step), 8), int(np.ceil(_LEAD / step)) + 1
    for log in logs:
        gaps = np.flatnonzero(np.diff(log.time) > 3 * step) + 1
        for begin, end in zip([0, *gaps], [*gaps, len(log.time)], strict=True):
            for at in range(begin + lead, end - size + 1, size):
                rows = slice(at - lead, at + size)
                known = np.isfinite(log.setpoint[rows, :, :3]).all(axis=(0, 2))
                for robot in np.flatnonzero(known):
                    state, setpoint = log.state[rows, robot, 3:].copy(), log.setpoint[rows, robot, :3]
                    state[:, 3:] = np.unwrap(state[:, 3:], axis=0)
                    parts.append((first + int(robot), log.time[rows] - log.time[at], state, setpoint))
        first += log.state.shape[1]
    if len(parts) < LEAST_WINDOWS:
        raise ValueError(
            f"it has {len(parts)} windows of {window:g} s with set-points and without gaps: the fit needs "
            f"{LEAST_WINDOWS}, which are {LEAST_WINDOWS * window:g} s of flight, of all robots together"
        )
    robots = np.unique([part[0] for part in parts], return_inverse=True)[1]
    time, state, setpoint = (np.array([part[k] for part in parts]) for k in (1, 2, 3))
    number = np.empty_like(robots)
    for one in range(robots.max() + 1):
        number[robots == one] = np.arange((robots == one).sum())
    windows = _Windows(robots, number, time, state, setpoint, lead)
    return windows.pick(np.unique(np.linspace(0, len(robots) - 1, _MOST_WINDOWS).astype(int)))


def _check_motion(windows: _Windows) -> None:
    moved = windows.setpoint[:, windows.lead :].std(axis=(0, 1))
    speed = windows.state[:, windows.lead :, :2].std(axis=(0, 1))
    for name, column, amount, least, unit, advice in (
        ("roll", "roll_set", moved[0], _LEAST_TILT, "rad", "steps of 0.1 rad"),
        ("pitch", "pitch_set", moved[1], _LEAST_TILT, "rad", "steps of 0.1 rad"),
        ("climb", "climb_set", moved[2], _LEAST_CLIMB, "m/s", "climbs and descents of 0.5 m/s"),
    ):
        if amount < least:
            raise ValueError(
                f"it cannot determine {name}_gain and {name}_time_constant: {column} varies by {amount:.2g} {unit} "
                f"only (standard deviation), and {least:g} {unit} are needed; fly {advice}"
            )
    for axis, amount in zip("xy", speed, strict=True):
        if amount < _LEAST_SPEED:
            raise ValueError(
                f"it cannot determine drag_{axis}: the velocity along {axis} varies by {amount:.2g} m/s only (standard "
                f"deviation), and {_LEAST_SPEED:g} m/s are needed; fly back and forth along {axis}"
            )


def _check_axes(windows: _Windows) -> None:
    """Check that velocities change as attitudes accelerate, which noise and drag hardly matter to."""
    state, time = windows.state[:, windows.lead :], windows.time[:, windows.lead :]
    tilt, decay = _tilt(state[..., 3:]), np.exp(-_ANY_DRAG * time)
    for axis, name in enumerate("xy"):
        both = state[..., axis], _accelerated(windows, tilt[..., axis], _ANY_DRAG)
        vel, gained = (_without_freedom(one, decay, time, windows.robot) for one in both)
        share = (vel * gained).sum() / max((gained**2).sum(), 1e-12)
        if not abs(share - 1) < _MOST_MISSED:
            raise ValueError(
                f"its velocity along {name} changes {share:.2g} times as much as its attitude accelerates: x is "
                "forward, y left and z up in m/s, attitudes are in rad, positive pitch flies forward and positive roll "
                "to the right"
            )


def _check_values(values: dict[str, float]) -> None:
    for name in _LAGS:
        for what, (low, high) in (("gain", _GAINS), ("time_constant", _TIME_CONSTANTS)):
            value = values[f"{name}_{what}"]
            if not 1.05 * low < value < 0.95 * high:
                raise ValueError(
                    f"it cannot determine {name}_{what}, which lies at the limit {value:.2g}: {name} does not follow "
                    f"{name}_set; look at signs, units (rad, m/s) and times of both"
                )


def _check_errors(values: dict[str, float], errors: dict[str, float]) -> None:
    for name, value in values.items():
        drag = name.startswith("drag")
        most = _MOST_DRAG_ERROR if drag else _MOST_ERROR * abs(value)
        if not errors[name] <= most:
            raise ValueError(
                f"it cannot determine {name}: {value:.3g} has a standard error of {errors[name]:.2g}, and "
                f"{most:.2g} is the most; fly longer, with larger steps, or log at a higher rate"
            )


def _lagged(windows: _Windows, column: int, tau: float, delays: np.ndarray) -> np.ndarray:
    """Return a set-point that acts late, through a lag that is at the set-point where the lead begins, (W, S)."""
    u, time = windows.setpoint[..., column], windows.time
    decay = np.exp(-np.diff(time, axis=1) / tau)
    filtered = np.empty_like(u)
    filtered[:, 0] = u[:, 0]
    for k in range(u.shape[1] - 1):
        filtered[:, k + 1] = u[:, k] + (filtered[:, k] - u[:, k]) * decay[:, k]
    # The set-point is constant between stamps, so the lag is known exactly at any time
    at = time[:, windows.lead :] - delays[windows.robot][:, None]
    rows = (2 * (time[0, -1] - time[0, 0]) + 10) * np.arange(len(time))[:, None]  # one row after the other is ascending
    index = np.searchsorted((time + rows).ravel(), (at + rows).ravel(), side="right").reshape(at.shape) - 1
    index = np.clip(index - u.shape[1] * np.arange(len(time))[:, None], 0, u.shape[1] - 1)
    held = np.take_along_axis(u, index, axis=1)
    since = at - np.take_along_axis(time, index, axis=1)
    return held + (np.take_along_axis(filtered, index, axis=1) - held) * np.exp(-np.maximum(since, 0.0) / tau)


def _accelerated(windows: _Windows, tilt: np.ndarray, drag: float) -> np.ndarray:
    """Return velocities along an axis from rest under accelerations, (W, S) -> (W, S)."""
    time = windows.time[:, windows.lead :]
    steps = np.diff(time, axis=1)
    vel = np.zeros_like(tilt)
    for k, step in enumerate(steps.T):
        decay = np.exp(-drag * step)
        mean = (tilt[:, k] + tilt[:, k + 1]) / 2
        vel[:, k + 1] = vel[:, k] * decay - mean * np.expm1(-drag * step) / drag
    return vel


def _tilt(state: np.ndarray) -> np.ndarray:
    """Return accelerations of attitudes (roll, pitch, yaw), (..., 3) -> (..., 2)."""
    right, forward = np.tan(state[..., 0]), np.tan(state[..., 1])
    cos, sin = np.cos(state[..., 2]), np.sin(state[..., 2])
    return QuadrotorParams().gravity * np.stack([cos * forward + sin * right, sin * forward - cos * right], axis=-1)


def _fit(windows: _Windows, start: _Fitted | None = None) -> _Fitted:
    """Fit the lags, and then drag to the measured attitudes."""
    with needs_extra("identify", "plants"):
        from scipy.optimize import least_squares  # imported here, so that the help needs no extra
    # Some of the windows may be of fewer robots than all of them
    robots = int(windows.robot.max()) + 1 if start is None else len(start.delays)
    lead = windows.lead
    time = windows.time[:, lead:]
    measured = np.moveaxis(windows.state[:, lead:][..., list(_COLUMNS)], -1, 0)
    scale = np.array([0.1, 0.1, 1.0])  # rad, rad, m/s: corrected below

    def residuals(x: np.ndarray) -> np.ndarray:
        taus, gains, delays = x[:3], x[3:6], x[6:]
        parts = []
        for k in range(3):
            error = measured[k] - gains[k] * _lagged(windows, k, taus[k], delays)
            parts.append(_without_freedom(error, np.exp(-time / taus[k]), np.ones_like(time), windows.robot) / scale[k])
        return np.array(parts)

    def jacobian(x: np.ndarray) -> np.ndarray:
        found, base = np.zeros((3, *time.shape, len(x))), residuals(x)
        for k in (*range(6), 6):
            moved = x.copy()
            moved[k if k < 6 else slice(6, None)] += _STEP
            slope = (residuals(moved) - base) / _STEP
            if k < 6:
                found[..., k] = slope
            else:  # each robot's delay matters to its own windows only
                for robot in range(robots):
                    own = windows.robot == robot
                    found[..., 6 + robot][:, own] = slope[:, own]
        return found.reshape(-1, len(x))

    low = np.repeat([_TIME_CONSTANTS[0], _GAINS[0], _DELAYS[0]], [3, 3, robots])
    high = np.repeat([_TIME_CONSTANTS[1], _GAINS[1], _DELAYS[1]], [3, 3, robots])
    if start is None:
        x, tol = np.repeat([0.2, 1.0, 0.0], [3, 3, robots]), 1e-8
    else:  # for standard errors
        tol = 1e-5
        names = [f"{name}_time_constant" for name in _LAGS] + [f"{name}_gain" for name in _LAGS]
        x = np.concatenate([[start.values[name] for name in names], start.delays])
    for _ in range(2):
        x = np.clip(x, low + 1e-6, high - 1e-6)
        x = least_squares(lambda x: residuals(x).ravel(), x, jacobian, (low, high), ftol=tol, xtol=tol, x_scale="jac").x
        scale = scale * np.maximum(residuals(x).std(axis=(1, 2)), 1e-9)
    values = {f"{name}_gain": float(x[3 + k]) for k, name in enumerate(_LAGS)}
    values |= {f"{name}_time_constant": float(x[k]) for k, name in enumerate(_LAGS)}
    tilt = _tilt(windows.state[:, lead:, 3:])
    for axis, name in enumerate(("drag_x", "drag_y")):

        def off(x: np.ndarray, axis: int = axis) -> np.ndarray:
            error = windows.state[:, lead:, axis] - _accelerated(windows, tilt[..., axis], float(x[0]))
            decay = np.exp(-x[0] * time)
            return _without_freedom(error, decay, (1 - decay) / x[0], windows.robot).ravel()

        begin = start.values[name] if start else 0.3
        values[name] = float(least_squares(off, [np.clip(begin, 1e-3, 4.0)], bounds=_DRAGS).x[0])
    return _Fitted(values, x[6:])


def _without_freedom(error: np.ndarray, decay: np.ndarray, constant: np.ndarray, robot: np.ndarray) -> np.ndarray:
    """Return errors, (W, S), less what a state to begin from explains in each window, and a constant for each robot.

    :param decay: how the state to begin from decays, (W, S)
    :param constant: what a constant does from rest, (W, S)
    :param robot: number of the robot, (W,)
    """

    def less(values: np.ndarray) -> np.ndarray:
        return values - decay * ((decay * values).sum(axis=1) / (decay**2).sum(axis=1))[:, None]

    error, constant = less(error), less(constant)
    squares = np.bincount(robot, (constant**2).sum(axis=1))
    shares = np.bincount(robot, (constant * error).sum(axis=1)) / np.maximum(squares, 1e-12)
    return error - constant * shares[robot][:, None]


def _residuals(windows: _Windows, found: _Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of roll and pitch (rad), and of velocities (m/s), where velocities follow from the set-points.
    Each window begins where it fits best."""
    values, lead, robot = found.values, windows.lead, windows.robot
    time, state = windows.time[:, lead:], windows.state[:, lead:]
    errors = []
    for k, name in enumerate(_LAGS):
        tau = values[f"{name}_time_constant"]
        error = state[..., _COLUMNS[k]] - values[f"{name}_gain"] * _lagged(windows, k, tau, found.delays)
        errors.append(_without_freedom(error, np.exp(-time / tau), np.ones_like(time), robot))
    attitude = state[..., 3:].copy()
    for k in range(2):
        attitude[..., k] -= errors[k]
    tilt, velocity = _tilt(attitude), []
    for axis in range(2):
        drag = values[f"drag_{'xy'[axis]}"]
        error = state[..., axis] - _accelerated(windows, tilt[..., axis], drag)
        decay = np.exp(-drag * time)
        velocity.append(_without_freedom(error, decay, (1 - decay) / drag, robot))
    return np.stack(errors[:2], axis=-1), np.stack([*velocity, errors[2]], axis=-1)
