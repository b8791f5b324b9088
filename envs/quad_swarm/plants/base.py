"""The interface of plants, which map states and commands to the next states of E swarms of n robots."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from quad_swarm.errors import unknown_name
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

MODEL = "model"
# Simulators and their vehicles, the first of which is the default
SIMULATORS: dict[str, tuple[str, ...]] = {
    "crazyflow": ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350", "hb_x500"),
    "rotorpy": ("crazyflie", "crazyfliebrushless", "hummingbird"),
}


def simulated_vehicles() -> list[str]:
    """Return all vehicles of `SIMULATORS` as values of ``plant``."""
    return [f"{simulator}:{vehicle}" for simulator, vehicles in SIMULATORS.items() for vehicle in vehicles]


class Plant(Protocol):
    """Simulation of robots. State (9) and input (4) are those of `quad_swarm.quadrotor`."""

    def place(self, swarm: int, state: np.ndarray) -> None:
        """Set the states of one swarm's robots, (n, 9), with everything else at rest."""

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""

    def fork(self) -> Plant:
        """Return an independent copy."""

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None) -> np.ndarray:
        """Compute the states after a sub-step.

        :param state: current states, (E, n, 9), which are those of the last call, possibly with added noise
        :param u: constant inputs, (E, n, 4)
        :param air: velocity of the air at each robot, (E, n, 2) (m/s)
        :param factors: factors of each vehicle's parameters, see `QuadrotorModel.step`; for our own model only
        """
        ...


class ModelPlant:
    """Plant that uses the planner's own model.

    :param model: the dynamics over a sub-step
    """

    def __init__(self, model: QuadrotorModel):
        self._model = model

    def place(self, swarm: int, state: np.ndarray) -> None:
        """See `Plant`. The model has no hidden state."""

    def keep(self, swarms: np.ndarray) -> None:
        """See `Plant`."""

    def fork(self) -> ModelPlant:
        """See `Plant`."""
        return self

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None) -> np.ndarray:
        """See `Plant`."""
        return self._model.step(state, u, air, factors)


def parse_plant(name: str) -> tuple[str, str]:
    """Parse the name of a plant, such as "model", "crazyflow" or "crazyflow:cf21B_500", into simulator and vehicle.

    :raises ValueError: if the simulator or the vehicle is unknown
    """
    simulator, _, vehicle = name.partition(":")
    if simulator == MODEL and not vehicle:
        return MODEL, ""
    if simulator not in SIMULATORS:
        raise unknown_name("plant", simulator, [MODEL, *SIMULATORS])
    if vehicle and vehicle not in SIMULATORS[simulator]:
        raise unknown_name(f"vehicle of {simulator}", vehicle, SIMULATORS[simulator])
    return simulator, vehicle or SIMULATORS[simulator][0]


def make_plant(name: str, params: QuadrotorParams, dt: float, n_swarms: int, n_robots: int) -> Plant:
    """Create a plant.

    :param name: see `parse_plant`
    :param params: parameters of our own model; other simulators only use the drag, for the force of the wind
    :param dt: length of a sub-step (s)
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    :raises ValueError: if the plant is unknown, or the simulator does not support sub-steps of this length
    :raises ImportError: if the simulator is not installed
    """
    simulator, vehicle = parse_plant(name)
    if simulator == MODEL:
        return ModelPlant(QuadrotorModel(params, dt))
    from quad_swarm.plants.remote import RemotePlant

    return RemotePlant(simulator, vehicle, params, dt, n_swarms, n_robots)
