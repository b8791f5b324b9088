"""The interface of a plant: states in, commands in, states out, for E swarms of n robots at once."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from quad_swarm.errors import unknown_name
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams

MODEL = "model"
# Simulators and the vehicles that each of them knows, the first one by default
SIMULATORS: dict[str, tuple[str, ...]] = {
    "crazyflow": ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350", "hb_x500"),
    "rotorpy": ("crazyflie", "crazyfliebrushless", "hummingbird"),
}


def simulated_vehicles() -> list[str]:
    """All vehicles of `SIMULATORS`, as ``plant`` takes them."""
    return [f"{simulator}:{vehicle}" for simulator, vehicles in SIMULATORS.items() for vehicle in vehicles]


class Plant(Protocol):
    """Robots that fly. State (9) and input (4) are those of `quad_swarm.quadrotor`."""

    def place(self, swarm: int, state: np.ndarray) -> None:
        """Put one swarm's robots into states, (n, 9), with everything else at rest."""

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""

    def fork(self) -> Plant:
        """A copy that flies on by itself."""

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None) -> np.ndarray:
        """States after a sub-step.

        :param state: present states, (E, n, 9): those that the last call returned, moved by noise at most
        :param u: inputs that are held, (E, n, 4)
        :param air: velocity of the air at each robot, (E, n, 2) (m/s)
        :param factors: of each vehicle's parameters, see `QuadrotorModel.step`; only our own model has them
        """
        ...


class ModelPlant:
    """The planner's model itself.

    :param model: the dynamics over a sub-step
    """

    def __init__(self, model: QuadrotorModel):
        self._model = model

    def place(self, swarm: int, state: np.ndarray) -> None:
        """See `Plant`; the state is all there is."""

    def keep(self, swarms: np.ndarray) -> None:
        """See `Plant`."""

    def fork(self) -> ModelPlant:
        """See `Plant`."""
        return self

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None) -> np.ndarray:
        """See `Plant`."""
        return self._model.step(state, u, air, factors)


def parse_plant(name: str) -> tuple[str, str]:
    """Simulator and vehicle of a plant's name, such as "model", "crazyflow" or "crazyflow:cf21B_500".

    :raises ValueError: unknown simulator or vehicle
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
    """What is flown.

    :param name: see `parse_plant`
    :param params: of our own model; of a simulator's vehicle only the drag, by which wind pushes it
    :param dt: length of a sub-step (s)
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    :raises ValueError: unknown plant, or a simulator that cannot take sub-steps of this length
    :raises ImportError: the simulator is not installed
    """
    simulator, vehicle = parse_plant(name)
    if simulator == MODEL:
        return ModelPlant(QuadrotorModel(params, dt))
    from quad_swarm.plants.remote import RemotePlant

    return RemotePlant(simulator, vehicle, params, dt, n_swarms, n_robots)
