"""Teams of unlike vehicles: what each robot is, the planner of each, and how large robots are to each other.

Robots of a kind plan as in a world in which all robots are of this kind, see `SwarmConfig.kinds`. Another robot that is
larger by some length is kept away from by that much more, see `quad_swarm.planner.Problems`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quad_swarm.planner import MixedPlanner, base, make_planner
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.validation import PositiveLength, checked, replaced
from quad_swarm.vehicles import load_vehicle
from quad_swarm.world.beliefs import other_indices

if TYPE_CHECKING:
    from quad_swarm.world.presets import SwarmConfig

# The fields of a planner that vehicles may have of their own
LIMITS = (
    "max_tilt",
    "max_climb_rate",
    "max_descent_rate",
    "max_yaw_rate",
    "max_speed",
    "max_vertical_speed",
    "max_descent_speed",
)


@checked
@dataclass(frozen=True)
class VehicleConfig:
    """What is different about a robot. None is as in the world.

    :param quadrotor: physical parameters
    :param radius: radius of the sphere around the robot (m)
    :param max_tilt: limit of the commanded roll and pitch (rad)
    :param max_climb_rate: limit of the commanded climb rate (m/s)
    :param max_descent_rate: limit of the commanded rate of descent (m/s)
    :param max_yaw_rate: limit of the commanded yaw rate (rad/s), see `PlannerConfig`
    :param max_speed: soft limit of the velocity along x and along y (m/s)
    :param max_vertical_speed: soft limit of the velocity along z (m/s)
    :param max_descent_speed: soft limit of the velocity downwards (m/s)
    :raises ValueError: if a value is out of range
    """

    quadrotor: QuadrotorParams | None = None
    radius: PositiveLength | None = None
    max_tilt: float | None = None
    max_climb_rate: float | None = None
    max_descent_rate: float | None = None
    max_yaw_rate: float | None = None
    max_speed: float | None = None
    max_vertical_speed: float | None = None
    max_descent_speed: float | None = None


def read_vehicles(vehicles: Any, quadrotor: QuadrotorParams) -> Any:
    """Convert what users give as `SwarmConfig.vehicles`. What is no list of mappings is left to the check of the world.

    :param vehicles: vehicles, whose ``quadrotor`` may be a name of `VEHICLES`, the path of a vehicle file, or some of
        the parameters
    :param quadrotor: parameters of the world, which fill in the others
    :raises ValueError: if a vehicle is unknown, or a value is invalid
    """
    if not isinstance(vehicles, (list, tuple)):
        return vehicles
    return tuple(_read(one, quadrotor, f"vehicles.{k}") for k, one in enumerate(vehicles))


def _read(vehicle: Any, quadrotor: QuadrotorParams, path: str) -> Any:
    if not isinstance(vehicle, Mapping):
        return vehicle
    given = vehicle.get("quadrotor")
    if isinstance(given, (str, os.PathLike)):
        return {**vehicle, "quadrotor": load_vehicle(given)}
    if isinstance(given, Mapping):
        return {**vehicle, "quadrotor": replaced(quadrotor, given, f"{path}.quadrotor")}
    return vehicle


class Bodies(NamedTuple):
    """How large robots are, and the others that they perceive.

    :param radius: radii of the robots, (n,) (m)
    :param separation: distance between centres that each of them keeps from another of its own radius, (n,) (m)
    :param clear: distance that each of them keeps between its centre and the surfaces of obstacles, (n,) (m)
    :param deceleration: with what acceleration each of them can brake, (n,) (m/s^2)
    :param others: radii of the others, (n, n - 1) or (E, n, n - 1) (m)
    :param larger: how much larger than the robot each of the others is, in the shape of ``others`` (m); None if all
        robots of the team are equally large
    :param excess: see `SwarmConfig.excess`, in the shape of ``others`` (m); None if it is 0 for all
    """

    radius: np.ndarray
    separation: np.ndarray
    clear: np.ndarray
    deceleration: np.ndarray
    others: np.ndarray
    larger: np.ndarray | None = None
    excess: np.ndarray | None = None


def bodies_of(config: SwarmConfig, robot: int | None = None, others: np.ndarray | None = None) -> Bodies:
    """Return how large robots and others are.

    :param config: the world
    :param robot: number of a robot; by default all n
    :param others: indices of the others, a robot's own index for an empty slot, which counts as a robot like others;
        (n, n - 1) or (E, n, n - 1); by default all others
    """
    robots = np.arange(config.n_robots) if robot is None else np.array([robot])
    others = other_indices(config.n_robots)[robots] if others is None else others
    radii, rows = config.radii, robots[:, None]
    same = bool((radii == radii[0]).all())
    return Bodies(
        radii[robots],
        config.per_robot(lambda kind: kind.planner.separation)[robots],
        config.per_robot(lambda kind: kind.radius + kind.obstacle_margin)[robots],
        config.per_robot(lambda kind: kind.quadrotor.deceleration(kind.planner.max_tilt))[robots],
        np.broadcast_to(radii[0], others.shape) if same else radii[others],
        None if same else radii[others] - radii[robots][:, None],
        None if config.excess is None else config.excess[rows, others],
    )


def make_planner_of(config: SwarmConfig, robot: int, solver: str = "auto", costs: bool = False) -> base.Planner:
    """Create the planner of one robot.

    :param config: the world
    :param robot: number of the robot
    :param solver: see `make_planner`
    :param costs: see `make_planner`
    """
    kind, sizes = config.kinds[config.kind_of[robot]], bool((config.radii != config.radii[0]).any())
    return make_planner(kind.planner, kind.quadrotor, config.n_others + 1, solver, config.obstacles.slots, costs, sizes)


def make_planners(config: SwarmConfig, solver: str = "auto", costs: bool = False) -> list[base.Planner]:
    """Create the planners of a world: one for each robot, (n,), which robots of a kind share.

    :param config: the world
    :param solver: see `make_planner`
    :param costs: see `make_planner`
    """
    of_kinds = [make_planner_of(config, config.kind_of.index(kind), solver, costs) for kind in range(len(config.kinds))]
    return [of_kinds[kind] for kind in config.kind_of]


def make_team_planner(config: SwarmConfig, solver: str = "auto", costs: bool = False) -> base.Planner | MixedPlanner:
    """Create the planner of whole teams.

    :param config: the world
    :param solver: see `make_planner`
    :param costs: see `make_planner`
    """
    planners = make_planners(config, solver, costs)
    if len(config.kinds) == 1:
        return planners[0]
    return MixedPlanner([planners[config.kind_of.index(kind)] for kind in range(len(config.kinds))], config.kind_of)
