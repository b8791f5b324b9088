"""Adapter of RotorPy (Folk, Paulos and Kumar, arXiv:2306.04485), which models motor lag, rotor drag and inflow in wind.

The vehicles are commanded by attitude and thrust, which RotorPy's own attitude controller tracks.
"""

from __future__ import annotations

import importlib
import math
from copy import copy

import numpy as np
import torch as th
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams
from scipy.spatial.transform import Rotation

from quad_swarm.plants.attitude_commands import GRAVITY, thrust, yaw
from quad_swarm.quadrotor import ATTITUDE, POSITION, VELOCITY

_PERIOD = 0.005  # maximum period of the attitude controller (s)
_CPU = th.device("cpu")


class RotorpyPlant:
    """`Plant` without the factors of vehicle parameters, which only our own model has. Wind acts on each rotor.

    :param vehicle: a vehicle whose parameters come with RotorPy
    :param drag: unused, since RotorPy has its own aerodynamics
    :param dt: length of a sub-step (s)
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    """

    def __init__(self, vehicle: str, drag: tuple[float, float], dt: float, n_swarms: int, n_robots: int):
        th.set_num_threads(1)  # more threads do not speed up small matrices
        params = importlib.import_module(f"rotorpy.vehicles.{vehicle}_params").quad_params
        self._n_steps = math.ceil(dt / _PERIOD - 1e-9)
        self._dt = dt
        self._mass = params["mass"]
        self._hover = math.sqrt(self._mass * GRAVITY / params["num_rotors"] / params["k_eta"])
        self._body_rates = np.zeros((n_swarms, n_robots, 3))
        self._rotor_speeds = np.full((n_swarms, n_robots, params["num_rotors"]), self._hover)
        count = n_swarms * n_robots
        self._vehicles = BatchedMultirotor(
            BatchedMultirotorParams([params] * count, count, _CPU),
            count,
            {"x": th.zeros(count, 3)},
            _CPU,
            control_abstraction="cmd_ctatt",
            integrator="rk4",
        )

    def place(self, swarm: int, state: np.ndarray) -> None:
        """See `Plant`."""
        self._body_rates[swarm] = 0.0
        self._rotor_speeds[swarm] = self._hover

    def keep(self, swarms: np.ndarray) -> None:
        """See `Plant`. RotorPy's vehicles are identical, so the first ones continue."""
        self._body_rates, self._rotor_speeds = self._body_rates[swarms], self._rotor_speeds[swarms]

    def fork(self) -> RotorpyPlant:
        """See `Plant`."""
        fork = copy(self)
        fork._body_rates, fork._rotor_speeds = self._body_rates.copy(), self._rotor_speeds.copy()
        return fork

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None = None) -> np.ndarray:
        """See `Plant`."""
        flat = state.reshape(-1, 9)
        count = len(flat)
        if not count:
            return state.copy()
        inputs = u.reshape(-1, 4)
        attitude = np.column_stack([inputs[:, :2], yaw(flat, inputs, self._dt)])
        control = {
            "cmd_thrust": self._all(self._mass * thrust(flat, inputs)[:, None]),
            "cmd_q": self._all(Rotation.from_euler("xyz", attitude).as_quat(), [0, 0, 0, 1]),
        }
        moving = {
            "x": self._all(flat[:, POSITION]),
            "v": self._all(flat[:, VELOCITY]),
            "q": self._all(Rotation.from_euler("xyz", flat[:, ATTITUDE]).as_quat(), [0, 0, 0, 1]),
            "w": self._all(self._body_rates.reshape(count, -1)),
            "wind": self._all(np.column_stack([air.reshape(-1, 2), np.zeros(count)])),
            "rotor_speeds": self._all(self._rotor_speeds.reshape(count, -1)),
        }
        kept = np.arange(count)
        for _ in range(self._n_steps):
            moving = self._vehicles.step(moving, control, self._dt / self._n_steps, kept)
        after = {name: values[:count].numpy() for name, values in moving.items()}
        self._body_rates[:] = after["w"].reshape(self._body_rates.shape)
        self._rotor_speeds[:] = after["rotor_speeds"].reshape(self._rotor_speeds.shape)
        angles = Rotation.from_quat(after["q"]).as_euler("xyz")
        return np.concatenate([after["x"], after["v"], angles], axis=-1).reshape(state.shape)

    def _all(self, values: np.ndarray, rest: list[float] | float = 0.0) -> th.Tensor:
        """Return values for all vehicles: those given for the first ones, and a default for the others."""
        everything = np.empty((self._vehicles.num_drones, values.shape[1]))
        everything[:] = rest
        everything[: len(values)] = values
        return th.from_numpy(everything)
