"""The attitude-commanded quadrotor: one CasADi expression that both the planner and the simulator integrate.

State ``x`` (9): position ``p`` (m, world frame, z up), velocity ``v`` (m/s), roll ``phi``, pitch ``theta``, yaw ``psi``
(rad). A positive pitch accelerates along the heading, a positive roll to its right. Input ``u`` (4): commanded roll and
pitch (rad), commanded climb rate (m/s), commanded yaw rate (rad/s).

The model and its parameters come from the simulator that the paper's laboratory published (Parrot Bebop 2;
tud-amr/mrca-mav, dynamics/bebop_dynamics.m). Drag is linear in the velocity, attitude and climb rate follow their
commands with first-order lags.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Annotated, Any

import casadi as ca
import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from quad_swarm.native.build import BuildError
from quad_swarm.native.functions import RowFunction
from quad_swarm.validation import checked

N_STATES = 9
N_INPUTS = 4
POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
ATTITUDE = slice(6, 9)
_WORTH_COMPILING = 32  # robots, from which compiling (some tenths of a second, once per machine) pays off


# Larger values overflow within a step
_Moderate = Annotated[float, Field(gt=0, le=1e4)]


@checked
@dataclass(frozen=True)
class QuadrotorParams:
    """Physical parameters. All defaults except gravity are those of a Parrot Bebop 2, identified by tud-amr/mrca-mav.

    :param gravity: gravitational acceleration (m/s^2)
    :param drag_x: drag coefficient along x (1/s)
    :param drag_y: drag coefficient along y (1/s)
    :param roll_gain: steady-state gain of the roll command (-)
    :param roll_time_constant: time constant of the roll response (s)
    :param pitch_gain: steady-state gain of the pitch command (-)
    :param pitch_time_constant: time constant of the pitch response (s)
    :param climb_gain: steady-state gain of the climb-rate command (-)
    :param climb_time_constant: time constant of the climb-rate response (s)
    :raises ValueError: if a drag coefficient is negative, or another value is not positive
    """

    gravity: _Moderate = 9.81
    drag_x: NonNegativeFloat = 0.25
    drag_y: NonNegativeFloat = 0.33
    roll_gain: _Moderate = 1.1260
    roll_time_constant: PositiveFloat = 0.2368
    pitch_gain: _Moderate = 1.1075
    pitch_time_constant: PositiveFloat = 0.2318
    climb_gain: _Moderate = 1.2270
    climb_time_constant: PositiveFloat = 0.3367

    @property
    def longest_step(self) -> float:
        """Longest step (s) for which `rk4_step` is stable: its stability interval divided by the fastest decay rate."""
        lags = (1 / self.roll_time_constant, 1 / self.pitch_time_constant, 1 / self.climb_time_constant)
        return 2.785 / max(self.drag_x, self.drag_y, *lags)

    def deceleration(self, tilt: float) -> float:
        """Return with what acceleration a vehicle can brake at a commanded tilt (rad), without drag and along the axis
        that answers less (m/s^2)."""
        return self.gravity * math.tan(tilt * min(self.roll_gain, self.pitch_gain))

    def drift(self, time: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much an acceleration of 1 m/s^2 beside those of the model changes the position (m) and the
        velocity (m/s) after some time, along x, y and z, as `rk4_step` integrates it.

        :param time: times (s), (...)
        :return: changes, (..., 3) each
        """
        decay = np.array([self.drag_x, self.drag_y, 1 / self.climb_time_constant])
        t = np.asarray(time, float)[..., None]
        z = decay * t
        return t**2 / 2 * (1 - z / 3 + z**2 / 12), t * (1 - z / 2 + z**2 / 6 - z**3 / 24)

    def steady_input(self, disturbance: np.ndarray) -> np.ndarray:
        """Return the inputs with which a vehicle of heading 0 stays where it is in spite of constant accelerations.

        :param disturbance: accelerations, (..., 3), world frame (m/s^2)
        :return: inputs, (..., 4)
        """
        u = np.zeros((*disturbance.shape[:-1], N_INPUTS))
        u[..., 0] = np.arctan(disturbance[..., 1] / self.gravity) / self.roll_gain
        u[..., 1] = -np.arctan(disturbance[..., 0] / self.gravity) / self.pitch_gain
        u[..., 2] = -disturbance[..., 2] * self.climb_time_constant / self.climb_gain
        return u


# The parameters that may vary between robots, in the order of the factors of `QuadrotorModel.step`.
VEHICLE_PARAMETERS = tuple(field.name for field in fields(QuadrotorParams) if field.name != "gravity")


def scaled(params: QuadrotorParams, factors: ca.SX) -> Any:
    """Return the parameters of a vehicle as expressions: each of `VEHICLE_PARAMETERS` times its factor."""
    values = {name: getattr(params, name) * factors[k] for k, name in enumerate(VEHICLE_PARAMETERS)}
    return SimpleNamespace(gravity=params.gravity, **values)


def state_derivative(x: ca.SX, u: ca.SX, wind: ca.SX, params: QuadrotorParams, heading: bool = True) -> ca.SX:
    """Compute the time derivative of the state.

    :param x: state, (9,)
    :param u: input, (4,)
    :param wind: horizontal velocity of the air, (2,), world frame (m/s); drag acts on the velocity relative to the air
    :param params: physical parameters
    :param heading: whether roll and pitch are about the axes of the heading, otherwise about the world's, as where
        the yaw is 0
    :return: dx/dt, (9,)
    """
    vx, vy, vz = x[3], x[4], x[5]
    right, forward = ca.tan(x[6]), ca.tan(x[7])
    if heading:
        cos, sin = ca.cos(x[8]), ca.sin(x[8])
        right, forward = cos * right - sin * forward, cos * forward + sin * right
    phi, theta = x[6], x[7]
    return ca.vertcat(
        vx,
        vy,
        vz,
        params.gravity * forward - params.drag_x * (vx - wind[0]),
        -params.gravity * right - params.drag_y * (vy - wind[1]),
        (params.climb_gain * u[2] - vz) / params.climb_time_constant,
        (params.roll_gain * u[0] - phi) / params.roll_time_constant,
        (params.pitch_gain * u[1] - theta) / params.pitch_time_constant,
        u[3],
    )


def rk4_step(
    x: ca.SX, u: ca.SX, wind: ca.SX, params: QuadrotorParams, dt: float | ca.SX, heading: bool = True
) -> ca.SX:
    """Take one classical Runge-Kutta step of length ``dt`` (s) with constant input (eq. 1), see `state_derivative`."""
    return rk4(lambda state: state_derivative(state, u, wind, params, heading), x, dt)


def rk4(derivative: Callable[[ca.SX], ca.SX], x: ca.SX, dt: float | ca.SX) -> ca.SX:
    """Take one classical Runge-Kutta step of length ``dt`` (s) of any ordinary differential equation."""
    k1 = derivative(x)
    k2 = derivative(x + dt / 2 * k1)
    k3 = derivative(x + dt / 2 * k2)
    k4 = derivative(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def step_function(params: QuadrotorParams, dt: float | None, varied: bool = False, heading: bool = True) -> ca.Function:
    """Create the discrete dynamics as a CasADi function ``(x, u, wind) -> x_next``, (9,), (4,), (2,) -> (9,).

    :param params: physical parameters
    :param dt: length of the step (s); None makes it an additional argument
    :param varied: whether the factors of `VEHICLE_PARAMETERS`, (8,), are an additional argument
    :param heading: see `state_derivative`
    """
    x, u, wind = ca.SX.sym("x", N_STATES), ca.SX.sym("u", N_INPUTS), ca.SX.sym("wind", 2)
    inputs = {"x": x, "u": u, "wind": wind}
    if varied:
        inputs["factors"] = ca.SX.sym("factors", len(VEHICLE_PARAMETERS))
        params = scaled(params, inputs["factors"])
    if dt is None:
        inputs["dt"] = ca.SX.sym("dt")
    x_next = ca.cse(rk4_step(x, u, wind, params, inputs.get("dt", dt), heading))
    return ca.Function("quadrotor_step", list(inputs.values()), [x_next], list(inputs), ["x_next"])


@functools.lru_cache(maxsize=256)
def _compiled_step(params: QuadrotorParams, dt: float | None, varied: bool, heading: bool) -> RowFunction | None:
    """Compile `step_function` for many rows. Returns None if that fails, of which the planner warns."""
    try:
        return RowFunction(step_function(params, dt, varied, heading))
    except BuildError:
        return None


class VehicleModel:
    """Discrete dynamics of a batch of vehicles, on NumPy arrays. Thread-safe.

    :param dt: length of a step (s)
    """

    def __init__(self, dt: float):
        self.dt = dt
        self._local = threading.local()  # calls write into buffers, so each thread has its own

    def step(
        self, x: np.ndarray, u: np.ndarray, wind: np.ndarray | None = None, factors: np.ndarray | None = None
    ) -> np.ndarray:
        """Compute the next states.

        :param x: states, (..., 9)
        :param u: inputs, (..., 4)
        :param wind: velocity of the air, (..., 2) (m/s); None for still air
        :param factors: factors of each vehicle's `VEHICLE_PARAMETERS`, (..., 8); None for the nominal parameters
        :return: states one step later, (..., 9)
        """
        if factors is None:
            return self._call(x, [x, u, wind], self.dt, False)
        return self._call(x, [x, u, wind, factors], self.dt, True)

    def ahead(
        self, x: np.ndarray, u: np.ndarray, time: np.ndarray, disturbance: np.ndarray | None = None
    ) -> np.ndarray:
        """Compute states after individual times, in still air: (..., 9), (..., 4), (...) (s) -> (..., 9).

        :param disturbance: constant accelerations, (..., 3), world frame (m/s^2); None for none
        """
        return self._drifted(self._call(x, [x, u, None, time], None, False), time, disturbance)

    def _drifted(self, x: np.ndarray, time: np.ndarray | float, disturbance: np.ndarray | None) -> np.ndarray:
        """Add what constant accelerations do in some time to states, in place."""
        if disturbance is not None:
            position, velocity = self.drift(time)
            x[..., POSITION] += position * disturbance
            x[..., VELOCITY] += velocity * disturbance
        return x

    def drift(self, time: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return what an acceleration of 1 m/s^2 beside the model does in some time, see `QuadrotorParams.drift`."""
        raise NotImplementedError

    def _heading(self, x: np.ndarray, u: np.ndarray) -> bool:
        """Return whether a function with headings is needed."""
        return False

    def _function(self, dt: float | None, varied: bool, heading: bool) -> ca.Function:
        """Create the function of a step, see `step_function`."""
        raise NotImplementedError

    def _compiled(self, dt: float | None, varied: bool, heading: bool) -> RowFunction | None:
        """Return the same, compiled for many rows, from a cache; None if it cannot be compiled."""
        raise NotImplementedError

    def _call(self, x: np.ndarray, arguments: list[np.ndarray | None], dt: float | None, varied: bool) -> np.ndarray:
        count = x.size // N_STATES
        if count == 0:
            return x.copy()
        u = arguments[1]
        assert u is not None
        heading = self._heading(x, u)
        if count >= _WORTH_COMPILING and (compiled := self._compiled(dt, varied, heading)) is not None:
            return compiled(count, arguments).reshape(x.shape)
        capacity = 1 << (count - 1).bit_length()  # powers of two, so that shrinking batches need few functions
        calls: dict[Any, _BufferedCall] = self._local.__dict__
        key = (dt, varied, heading, capacity)
        if key not in calls:
            calls[key] = _BufferedCall(self._function(dt, varied, heading), capacity)
        return calls[key](count, arguments).reshape(x.shape)

    def rollout(self, x: np.ndarray, u: np.ndarray, disturbance: np.ndarray | None = None) -> np.ndarray:
        """Roll out states from ``x`` (B, 9) under the inputs ``u`` (B, N, 4), in still air: (B, N + 1, 9).

        :param disturbance: constant accelerations, (B, 3), world frame (m/s^2); None for none
        """
        states = np.empty((x.shape[0], u.shape[1] + 1, N_STATES))
        states[:, 0] = x
        for k in range(u.shape[1]):
            states[:, k + 1] = self._drifted(self.step(states[:, k], u[:, k]), self.dt, disturbance)
        return states


class QuadrotorModel(VehicleModel):
    """Discrete dynamics of a batch of quadrotors, on NumPy arrays. Thread-safe.

    :param params: physical parameters
    :param dt: length of a step (s)
    """

    def __init__(self, params: QuadrotorParams, dt: float):
        super().__init__(dt)
        self.params = params

    def drift(self, time: Any) -> tuple[np.ndarray, np.ndarray]:
        return self.params.drift(time)

    def _heading(self, x: np.ndarray, u: np.ndarray) -> bool:
        return bool(np.count_nonzero(x[..., 8]) or np.count_nonzero(u[..., 3]))

    def _function(self, dt: float | None, varied: bool, heading: bool) -> ca.Function:
        return step_function(self.params, dt, varied, heading)

    def _compiled(self, dt: float | None, varied: bool, heading: bool) -> RowFunction | None:
        return _compiled_step(self.params, dt, varied, heading)

    def __reduce__(self) -> tuple:
        return QuadrotorModel, (self.params, self.dt)  # call buffers hold raw memory: rebuilt on demand


class MixedModel(VehicleModel):
    """Discrete dynamics of teams of n unlike vehicles, each bit for bit as its own model computes it. In all arrays,
    the axis before the last is that of the n robots.

    :param models: the kinds
    :param kind_of: which of them each robot is, (n,)
    """

    def __init__(self, models: Sequence[VehicleModel], kind_of: Sequence[int]):
        super().__init__(models[0].dt)
        self._robots = [(model, np.flatnonzero(np.equal(kind_of, kind))) for kind, model in enumerate(models)]

    def step(
        self, x: np.ndarray, u: np.ndarray, wind: np.ndarray | None = None, factors: np.ndarray | None = None
    ) -> np.ndarray:
        return self._each(lambda model, *some: model.step(*some), x, u, wind, factors)

    def ahead(
        self, x: np.ndarray, u: np.ndarray, time: np.ndarray, disturbance: np.ndarray | None = None
    ) -> np.ndarray:
        def one(model: VehicleModel, x: Any, u: Any, time: Any, disturbance: Any) -> np.ndarray:
            return model.ahead(x, u, time[..., 0], disturbance)

        return self._each(one, x, u, time[..., None], disturbance)

    def drift(self, time: Any) -> tuple[np.ndarray, np.ndarray]:
        """See `VehicleModel.drift`: () (s) -> (n, 3) each."""
        drifts = {int(robot): model.drift(time) for model, robots in self._robots for robot in robots}
        position, velocity = zip(*(drifts[robot] for robot in range(len(drifts))), strict=True)
        return np.stack(position), np.stack(velocity)

    def _each(self, call: Callable[..., np.ndarray], x: np.ndarray, *others: np.ndarray | None) -> np.ndarray:
        result = np.empty_like(x)
        for model, robots in self._robots:
            some = (None if array is None else array.take(robots, axis=-2) for array in (x, *others))
            result[..., robots, :] = call(model, *some)
        return result


class _BufferedCall:
    """Calls a CasADi function on preallocated memory. A plain call would convert all arrays to CasADi matrices."""

    def __init__(self, function: ca.Function, capacity: int):
        self._arguments = [np.ones((capacity, function.numel_in(k))) for k in range(function.n_in())]
        self._result = np.zeros((capacity, N_STATES))
        mapped = function if capacity == 1 else function.map(capacity)
        self._buffer, self._evaluate = mapped.buffer()
        for k, argument in enumerate(self._arguments):
            self._buffer.set_arg(k, argument.data)
        self._buffer.set_res(0, self._result.data)

    def __call__(self, count: int, values: Sequence[np.ndarray | None]) -> np.ndarray:
        for argument, value in zip(self._arguments, values, strict=True):
            argument[:count] = 0.0 if value is None else value.reshape(count, -1)
        self._evaluate()
        return self._result[:count].copy()
