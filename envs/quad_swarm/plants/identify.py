"""Identify a vehicle: fit the planner's model to step responses of a plant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quad_swarm.errors import needs_extra
from quad_swarm.plants.base import make_plant
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorModel, QuadrotorParams

DT = 0.01  # s
SECONDS = 3.0
HELD = 2.0  # duration of an input before it returns to zero (s)
TILTS = (-0.3, -0.15, 0.15, 0.3)  # rad
CLIMBS = (-1.0, -0.5, 0.5, 1.0)  # m/s
# Scales that weight the errors: attitudes of 0.1 rad count as much as velocities of 1 m/s
_SCALE = np.array([1.0, 1.0, 1.0, 0.1, 0.1])


class Identification(NamedTuple):
    """Result of an identification.

    :param params: parameters of the model
    :param attitude_rms: root mean square error of roll and pitch (deg)
    :param attitude_max: largest error of roll and pitch (deg)
    :param velocity_rms: root mean square error of the velocities (m/s)
    :param velocity_max: largest error of the velocities (m/s)
    """

    params: QuadrotorParams
    attitude_rms: float
    attitude_max: float
    velocity_rms: float
    velocity_max: float

    @classmethod
    def of(cls, params: QuadrotorParams, attitude: np.ndarray, velocity: np.ndarray) -> Identification:
        """Return the result with these errors of roll and pitch (rad), and of the velocities (m/s)."""
        degrees = np.degrees(attitude)
        rms = (float(np.sqrt((one**2).mean())) for one in (degrees, velocity))
        most = (float(np.abs(one).max()) for one in (degrees, velocity))
        return cls(params, *(one for pair in zip(rms, most, strict=True) for one in pair))


def experiment() -> np.ndarray:
    """Return the inputs of the step responses in roll, pitch and climb rate, one robot each, (T, robots, 4)."""
    steps = [(axis, size) for axis, sizes in enumerate((TILTS, TILTS, CLIMBS)) for size in sizes]
    u = np.zeros((round(SECONDS / DT), len(steps), 4))
    for robot, (axis, size) in enumerate(steps):
        u[: round(HELD / DT), robot, axis] = size
    return u


def identify(plant: str) -> Identification:
    """Fit the planner's model to step responses of a plant in roll, pitch and climb rate.

    :param plant: see `parse_plant`
    :raises ValueError: if the plant is unknown
    :raises ImportError: if the extra ``plants`` is not installed
    """
    with needs_extra("identify", "plants"):
        from scipy.optimize import least_squares  # imported here, so that the help needs no extra
    u = experiment()
    count = u.shape[1]
    params = QuadrotorParams()
    flown = make_plant(plant, params, DT, 1, count)
    states = [np.zeros((1, count, 9))]
    states[0][0, :, 0] = 10.0 * np.arange(count)
    flown.place(0, states[0][0])
    still = np.zeros((1, count, 2))
    for inputs in u:
        states.append(flown.step(states[-1], inputs[None], still, None))
    measured = np.concatenate(states[1:])[..., 3:8]

    model = QuadrotorModel(params, DT)

    def predicted(factors: np.ndarray) -> np.ndarray:
        x, path = states[0][0], []
        for inputs in u:
            x = model.step(x, inputs, None, np.broadcast_to(factors, (count, len(factors))))
            path.append(x[:, 3:8])
        return np.array(path)

    fit = least_squares(
        lambda factors: ((predicted(factors) - measured) / _SCALE).ravel(),
        np.ones(len(VEHICLE_PARAMETERS)),
        bounds=(1e-2, 50.0),
    )
    error = predicted(fit.x) - measured
    values = {name: float(getattr(params, name) * f) for name, f in zip(VEHICLE_PARAMETERS, fit.x, strict=True)}
    return Identification.of(QuadrotorParams(**values), error[..., 3:], error[..., :3])
