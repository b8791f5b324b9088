"""The interface of plants, which map states and commands to the next states of E swarms of n robots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams, VehicleModel
from quad_swarm.registry import Registry

MODEL = "model"


class PlantError(ChildProcessError):
    """Raised if a simulator fails: its process died, or it raised an error or returned something else than states."""


class PlantDied(PlantError):
    """Raised if a simulator's process died."""


@dataclass(frozen=True)
class Simulator:
    """A simulator, which runs in a process of its own.

    :param adapter: ``module:Class`` of its `Plant`, or the class itself. The process imports the module and calls
        ``Class(vehicle, drag, dt, n_swarms, n_robots)``: a name of ``vehicles``, the drag coefficients along x and y
        (1/s), the length of a sub-step (s), and the numbers E and n
    :param vehicles: names of its vehicles, the first of which is the default
    :raises ValueError: if the adapter is nothing that another process can import, or there is no vehicle
    """

    adapter: str | type
    vehicles: tuple[str, ...]

    def __post_init__(self) -> None:
        if isinstance(self.adapter, type):
            object.__setattr__(self, "adapter", f"{self.adapter.__module__}:{self.adapter.__qualname__}")
        module, colon, name = self.adapter.partition(":") if isinstance(self.adapter, str) else ("", "", "")
        if not (module and colon and name) or module == "__main__" or "<locals>" in name:
            raise ValueError(
                f"adapter={shown(self.adapter)}: the simulator's process imports it, so it must be a class of a module "
                "or its name, module:Class."
            )
        if isinstance(self.vehicles, str) or not self.vehicles or not all(isinstance(v, str) for v in self.vehicles):
            raise ValueError(f"vehicles={shown(self.vehicles)}: they must be one or more names, as in ('iris',).")
        object.__setattr__(self, "vehicles", tuple(self.vehicles))

    @property
    def module(self) -> str:
        """Name of the adapter's module."""
        return str(self.adapter).partition(":")[0]


SIMULATORS: Registry[Simulator] = Registry(
    "plant",
    "quad_swarm.plants",
    {
        "crazyflow": Simulator(
            "quad_swarm.plants.crazyflow:CrazyflowPlant",
            ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350", "hb_x500"),
        ),
        "rotorpy": Simulator(
            "quad_swarm.plants.rotorpy:RotorpyPlant", ("crazyflie", "crazyfliebrushless", "hummingbird")
        ),
    },
)


def simulated_vehicles() -> list[str]:
    """Return all vehicles of `SIMULATORS` as values of ``plant``."""
    return [f"{name}:{vehicle}" for name in SIMULATORS for vehicle in simulator_of(name).vehicles]


def simulator_of(name: str) -> Simulator:
    """Return the entry of `SIMULATORS` for a name.

    :raises ValueError: if there is none, or it is no `Simulator`
    :raises ImportError: if an installed package offers it, and it cannot be loaded
    """
    if isinstance(known := SIMULATORS.find(name, (MODEL,)), Simulator):
        return known
    raise ValueError(
        f"SIMULATORS[{name!r}]={shown(known)}: it must be a quad_swarm.plants.Simulator, which names the adapter and "
        "its vehicles, as in Simulator('my_module:MyPlant', ('iris',))."
    )


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
        :param factors: factors of each vehicle's parameters, see `QuadrotorModel.step`; for our own model only, the
            plants of simulators are called without
        """
        ...


class ModelPlant:
    """Plant that uses the planner's own model.

    :param model: the dynamics over a sub-step
    """

    def __init__(self, model: VehicleModel):
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
    known = simulator_of(simulator)
    if vehicle and vehicle not in known.vehicles:
        raise unknown_name(f"vehicle of {simulator}", vehicle, known.vehicles)
    return simulator, vehicle or known.vehicles[0]


def make_plant(
    name: str, params: QuadrotorParams, dt: float, n_swarms: int, n_robots: int, model: VehicleModel | None = None
) -> Plant:
    """Create a plant.

    :param name: see `parse_plant`
    :param params: parameters of our own model; other simulators only use the drag, for the force of the wind
    :param dt: length of a sub-step (s)
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    :param model: our own model over a sub-step, by default that of quadrotors
    :raises ValueError: if the plant is unknown, or the simulator does not support sub-steps of this length
    :raises ImportError: if the simulator is not installed
    :raises PlantError: if the simulator's process dies, or its adapter raises another error
    """
    simulator, vehicle = parse_plant(name)
    if simulator == MODEL:
        return ModelPlant(model or QuadrotorModel(params, dt))
    from quad_swarm.plants.remote import RemotePlant

    return RemotePlant(simulator, vehicle, params, dt, n_swarms, n_robots)
