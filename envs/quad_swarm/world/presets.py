"""Worlds with a name, frozen together with `PRESET_VERSION`: results name both, and a change reruns every table."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import Field

from quad_swarm.errors import shown, unknown_name
from quad_swarm.planner import PlannerConfig
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.validation import Length, PositiveLength, checked, replaced
from quad_swarm.world.scenarios import ScenarioSpace

PRESET_VERSION = 1

# Beyond these nothing flies, and numbers lose their meaning before they overflow.
Disturbance = Annotated[float, Field(ge=0, le=1e3)]


@checked
@dataclass(frozen=True)
class ProcessNoise:
    """Disturbances of the simulated flight; the planner knows nothing of them. All off by default.

    :param pos: standard deviation added to each position component in each step (m)
    :param vel: standard deviation added to each velocity component in each step (m/s)
    :param attitude: standard deviation added to roll and pitch in each step (rad)
    :param wind: speed of a steady horizontal wind whose direction is drawn for each episode (m/s)
    :raises ValueError: a value is negative, not finite, or beyond 1000 (pi for the attitude)
    """

    pos: Disturbance = 0.0
    vel: Disturbance = 0.0
    attitude: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    wind: Disturbance = 0.0

    def __bool__(self) -> bool:
        return any((self.pos, self.vel, self.attitude, self.wind))


@checked
@dataclass(frozen=True)
class Radio:
    """How plans travel. A request counts whether or not its answer arrives. Perfect by default.

    :param loss: share of the answers that get lost, each for itself
    :param delay: steps by which answers are late: with 0 a robot receives the plan that was made one step ago
    :raises ValueError: the loss lies outside [0, 1], or the delay outside 0 to 1000
    """

    loss: Annotated[float, Field(ge=0, le=1)] = 0.0
    delay: Annotated[int, Field(ge=0, le=1000)] = 0


@checked
@dataclass(frozen=True)
class SwarmConfig:
    """Everything that defines a world but the scenario.

    :param n_robots: number of robots n, 2 to 1000
    :param radius: radius r of the sphere around a robot (m)
    :param collision_tolerance: two robots collide when their centres are closer than 2r by more than this (m); the
        planner's soft constraint sits exactly at 2r in the paper's world
    :param goal_radius: a robot is at its goal within this distance (m); the paper takes r
    :param memory: see `Beliefs` (m)
    :param quadrotor: physical parameters
    :param planner: horizon, limits and weights
    :param space: room of the scenarios
    :param noise: disturbances
    :param radio: how plans travel
    :raises ValueError: a value out of its range, a planner that keeps less than 2r, a tolerance that hides every
        collision, or a step too long for the vehicle's dynamics
    """

    n_robots: Annotated[int, Field(ge=2, le=1000)] = 4
    radius: PositiveLength = 0.3
    collision_tolerance: Length = 1e-3
    goal_radius: PositiveLength = 0.3
    memory: Length = 0.03
    quadrotor: QuadrotorParams = field(default_factory=QuadrotorParams)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    space: ScenarioSpace = field(default_factory=ScenarioSpace)
    noise: ProcessNoise = field(default_factory=ProcessNoise)
    radio: Radio = field(default_factory=Radio)

    def __post_init__(self) -> None:
        contact, planner = 2 * self.radius, self.planner
        if planner.separation < contact:
            raise ValueError(
                f"planner.separation={planner.separation}: it must be at least 2 radius = {contact}, "
                "or left out of `make_config` to follow the radius"
            )
        if not self.collision_tolerance < contact:
            raise ValueError(
                f"collision_tolerance={self.collision_tolerance}: it must be less than 2 radius = {contact}, "
                "else nothing is a collision"
            )
        longest = self.quadrotor.longest_step
        if planner.dt > longest:
            raise ValueError(
                f"planner.dt={planner.dt}: steps must not exceed {longest:.2g} s, "
                "the stability limit of the integration of the quadrotor's fastest response"
            )

    @property
    def is_random(self) -> bool:
        """Whether the world itself draws random numbers during an episode."""
        return bool(self.noise) or self.radio.loss > 0


PRESETS: dict[str, SwarmConfig] = {
    # The paper's four robots. The planner keeps exactly 2r, which is what makes communication matter here.
    "paper": SwarmConfig(),
    # Eight robots in a 6 m square with a margin of 4 cm: communication matters although the planner leaves room for
    # error.
    "dense": SwarmConfig(
        n_robots=8,
        planner=PlannerConfig(separation=0.64, max_tilt=math.radians(20.0)),
        space=ScenarioSpace(half_width=3.0, circle_radius=(2.5, 3.0), sector_radius=(1.5, 3.0)),
    ),
}


def make_config(preset: str = "paper", world: Mapping[str, Any] | None = None, **overrides: Any) -> SwarmConfig:
    """A preset with some of its fields replaced.

    The planner's separation follows the radius: where only the radius is given, the planner keeps as much beyond twice
    the radius as the preset does.

    :param preset: a name of `PRESETS`
    :param world: fields of `SwarmConfig`; nested ones take a mapping of what to replace in them
    :param overrides: the same by name; None keeps the preset's value
    :raises ValueError: unknown preset or field, a value out of its range, or a field that is given twice
    """
    if not isinstance(preset, str) or preset not in PRESETS:
        raise unknown_name("preset", preset, PRESETS)
    changes = _joined(world or {}, {name: value for name, value in overrides.items() if value is not None})
    base = PRESETS[preset]
    planner = changes.get("planner", {})
    if "radius" in changes and isinstance(planner, Mapping) and "separation" not in planner:
        with contextlib.suppress(TypeError, ValueError, OverflowError):  # no number: the check of the fields says so
            separation = 2 * float(changes["radius"]) + (base.planner.separation - 2 * base.radius)
            changes = {**changes, "planner": {**planner, "separation": separation}}
    return replaced(base, changes)


def _joined(first: Mapping[str, Any], second: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Two nested mappings as one.

    :raises ValueError: both name the same field
    """
    joined = dict(first)
    for name, value in second.items():
        if name not in joined:
            joined[name] = value
        elif isinstance(joined[name], Mapping) and isinstance(value, Mapping):
            joined[name] = _joined(joined[name], value, f"{path}{name}.")
        else:
            raise ValueError(
                f"{path}{name} is given twice, {shown(joined[name])} in `world` and {shown(value)} beside it: leave "
                "one out."
            )
    return joined
