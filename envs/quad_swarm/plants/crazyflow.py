"""Adapter of Crazyflow (Schuck, Rath et al., arXiv:2606.01478): identified Crazyflie and Holybro vehicles at 500 Hz,
vectorised.

The vehicles are commanded by attitude and thrust.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from copy import copy
from functools import lru_cache

import numpy as np

with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    warnings.simplefilter("ignore")  # they concern optional parts that are not needed
    logging.getLogger("jax").setLevel(logging.ERROR)
    # Crazyflow first: it has to be imported before SciPy
    from crazyflow.control import Control
    from crazyflow.drones import Drone
    from crazyflow.dynamics import Dynamics
    from crazyflow.sim import Sim
import jax.numpy as jnp
import mujoco
from scipy.spatial.transform import Rotation

from quad_swarm.plants.attitude_commands import GRAVITY, thrust, yaw
from quad_swarm.quadrotor import ATTITUDE, POSITION, VELOCITY

_FREQUENCY = 500  # Hz
# High above the simulator's floor, since our workspace has no floor
_ALTITUDE = 100.0


class CrazyflowPlant:
    """`Plant` without the factors of vehicle parameters, which only our own model has.

    Dropped swarms stay in the simulation to avoid a recompilation, and plants of the same size share a compiled
    simulation.

    :param vehicle: a drone of Crazyflow; Holybro's has second-order attitude dynamics, the others use first principles
    :param drag: drag coefficients along x and y, for the force of the wind (1/s)
    :param dt: length of a sub-step (s), a multiple of 2 ms
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    :raises ValueError: if the sub-step is not a multiple of 2 ms
    """

    def __init__(self, vehicle: str, drag: tuple[float, float], dt: float, n_swarms: int, n_robots: int):
        self._n_steps = round(dt * _FREQUENCY)
        if self._n_steps < 1 or abs(self._n_steps / _FREQUENCY - dt) > 1e-9:
            raise ValueError(f"crazyflow needs sub-steps that are multiples of {1000 / _FREQUENCY:.0f} ms, not {dt} s.")
        self._sim = _simulation(vehicle, n_swarms, n_robots)
        drone = self._sim.data.params
        self._mass = _number(drone.mass)
        # Offset (N) and slope of the rotors' force as a function of the commanded thrust
        self._thrust = (0.0, 1.0)
        if self._sim.dynamics == Dynamics.so_rpy:
            self._thrust = (_number(drone.acc_coef), _number(drone.cmd_f_coef))
        self._drag = np.array(drag)
        self._kept = np.arange(n_swarms)
        self._data = self._sim.default_data
        self._placed: dict[int, np.ndarray] = {}  # attitudes of the swarms placed since the last step

    def place(self, swarm: int, state: np.ndarray) -> None:
        """See `Plant`."""
        self._placed = {**self._placed, int(self._kept[swarm]): state[:, ATTITUDE]}

    def _put(self) -> None:
        """Move the placed swarms to the simulation, except for what every step sets."""
        if not self._placed:
            return
        swarms, states = list(self._placed), self._data.states
        quat, ang_vel, rotor_vel = np.array(states.quat), np.array(states.ang_vel), np.array(states.rotor_vel)
        angles = np.stack(list(self._placed.values()))
        quat[swarms] = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat().reshape(*angles.shape[:2], 4)
        ang_vel[swarms] = np.asarray(self._sim.default_data.states.ang_vel)[swarms]
        rotor_vel[swarms] = self._hover_rotors()
        moved = states.replace(quat=jnp.asarray(quat), ang_vel=jnp.asarray(ang_vel), rotor_vel=jnp.asarray(rotor_vel))
        self._data, self._placed = self._data.replace(states=moved), {}

    def _hover_rotors(self) -> float:
        """Return the speed of a rotor at hover, 0 if the dynamics do not model rotors."""
        coefficients = getattr(self._sim.data.params, "rpm2thrust", None)
        if coefficients is None:
            return 0.0
        a, b, c = (float(value) for value in np.asarray(coefficients).reshape(-1, 3)[0])
        return float((-b + np.sqrt(b * b - 4 * c * (a - self._mass * GRAVITY / 4))) / (2 * c))

    def keep(self, swarms: np.ndarray) -> None:
        """See `Plant`."""
        self._kept = self._kept[swarms]

    def fork(self) -> CrazyflowPlant:
        """See `Plant`. A shallow copy suffices, because JAX's arrays are immutable."""
        return copy(self)

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None = None) -> np.ndarray:
        """See `Plant`."""
        if not len(self._kept):
            return state.copy()
        self._put()
        states = self._data.states
        shape = states.pos.shape[:2]
        force_up = self._mass * thrust(state, u)
        offset, slope = self._thrust
        controls = np.zeros((*shape, 4), dtype=np.float32)
        controls[..., 3] = (self._mass * GRAVITY - offset) / slope
        heading = yaw(state, u, self._n_steps / _FREQUENCY)
        controls[self._kept] = np.stack([u[..., 0], u[..., 1], heading, (force_up - offset) / slope], axis=-1)
        force = np.zeros((*shape, 3), dtype=np.float32)
        force[self._kept, :, :2] = self._mass * self._drag * air
        pos, vel = np.array(states.pos), np.array(states.vel)
        pos[self._kept], vel[self._kept] = state[..., POSITION] + [0, 0, _ALTITUDE], state[..., VELOCITY]
        self._sim.data = self._data.replace(
            states=states.replace(pos=jnp.asarray(pos), vel=jnp.asarray(vel), force=jnp.asarray(force))
        )
        self._sim.attitude_control(jnp.asarray(controls))
        self._sim.step(self._n_steps)
        self._data = self._sim.data
        states = self._data.states
        after = np.zeros_like(state)
        after[..., POSITION] = np.asarray(states.pos)[self._kept] - [0, 0, _ALTITUDE]
        after[..., VELOCITY] = np.asarray(states.vel)[self._kept]
        quaternions = np.asarray(states.quat)[self._kept].reshape(-1, 4)
        after[..., ATTITUDE] = Rotation.from_quat(quaternions).as_euler("xyz").reshape(*state.shape[:2], 3)
        return after


@lru_cache(maxsize=4)
def _simulation(vehicle: str, n_swarms: int, n_robots: int) -> Sim:
    """Return a simulation, which takes long to make. Only its functions are used, plants keep their own data."""
    mujoco.set_mju_user_warning(lambda message: None)  # they concern the copying of drones
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Sim(
            n_worlds=n_swarms,
            n_drones=n_robots,
            drone=Drone(vehicle),
            dynamics=Dynamics.so_rpy if vehicle == "hb_x500" else Dynamics.first_principles,
            control=Control.attitude,
            freq=_FREQUENCY,
            attitude_freq=_FREQUENCY,
        )


def _number(value: object) -> float:
    return float(np.asarray(value).ravel()[0])
