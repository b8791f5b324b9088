"""Worlds with a name, frozen together with `PRESET_VERSION`: results name both, and a change reruns every table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from quad_swarm.errors import unknown_name
from quad_swarm.planner import PlannerConfig
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.scenarios import ScenarioSpace

PRESET_VERSION = 1


@dataclass(frozen=True)
class ProcessNoise:
    """Disturbances of the simulated flight; the planner knows nothing of them. All off by default.

    :param pos: standard deviation added to each position component in each step (m)
    :param vel: standard deviation added to each velocity component in each step (m/s)
    :param attitude: standard deviation added to roll and pitch in each step (rad)
    :param wind: speed of a steady horizontal wind whose direction is drawn for each episode (m/s)
    """

    pos: float = 0.0
    vel: float = 0.0
    attitude: float = 0.0
    wind: float = 0.0

    def __bool__(self) -> bool:
        return any((self.pos, self.vel, self.attitude, self.wind))


@dataclass(frozen=True)
class Radio:
    """How plans travel. A request counts whether or not its answer arrives. Perfect by default.

    :param loss: share of the answers that get lost, each for itself
    :param delay: steps by which answers are late: with 0 a robot receives the plan that was made one step ago
    """

    loss: float = 0.0
    delay: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.loss <= 1 or self.delay < 0:
            raise ValueError(f"radio.loss={self.loss} lies in [0, 1], and radio.delay={self.delay} is not negative.")


@dataclass(frozen=True)
class SwarmConfig:
    """Everything that defines a world but the scenario.

    :param n_robots: number of robots n
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
    """

    n_robots: int = 4
    radius: float = 0.3
    collision_tolerance: float = 1e-3
    goal_radius: float = 0.3
    memory: float = 0.03
    quadrotor: QuadrotorParams = field(default_factory=QuadrotorParams)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    space: ScenarioSpace = field(default_factory=ScenarioSpace)
    noise: ProcessNoise = field(default_factory=ProcessNoise)
    radio: Radio = field(default_factory=Radio)

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


def make_config(preset: str, **overrides: Any) -> SwarmConfig:
    """A preset with some of its fields replaced.

    :param preset: a name of `PRESETS`
    :param overrides: fields of `SwarmConfig`; None keeps the preset's value; nested fields take a mapping of what to
        replace
    :raises ValueError: unknown preset or field
    """
    if preset not in PRESETS:
        raise unknown_name("preset", preset, PRESETS)
    return replace_fields(
        PRESETS[preset], {name: value for name, value in overrides.items() if value is not None}, "world"
    )


def replace_fields(config: Any, changes: Mapping[str, Any], where: str) -> Any:
    """A frozen dataclass with some fields replaced, nested ones by mappings.

    :param config: the dataclass
    :param changes: field name -> new value
    :param where: what the fields belong to, for messages
    :raises ValueError: unknown field
    """
    known = {f.name for f in dataclasses.fields(config)}
    values = {}
    for name, value in changes.items():
        if name not in known:
            raise unknown_name(f"{where} parameter", name, known)
        present = getattr(config, name)
        if isinstance(value, Mapping):
            if not dataclasses.is_dataclass(present):
                raise ValueError(f"{where} parameter {name!r} takes a plain value, not the mapping {dict(value)}.")
            value = replace_fields(present, value, name)
        else:
            value = _like(present, value, f"{where} parameter {name!r}")
        values[name] = value
    return dataclasses.replace(config, **values)


def _like(present: Any, value: Any, what: str) -> Any:
    """``value`` in the type of the present one; YAML, for one, reads 1e4 as a text."""
    if isinstance(present, tuple):
        if not isinstance(value, Sequence) or len(value) != len(present):
            raise ValueError(f"{what} takes {len(present)} numbers, not {value!r}.")
        return tuple(_like(p, v, what) for p, v in zip(present, value, strict=True))
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} takes a number, not {value!r}.") from None
    if not math.isfinite(number) or (isinstance(present, int) and number != int(number)):
        kind = "an integer" if isinstance(present, int) else "a finite number"
        raise ValueError(f"{what} takes {kind}, not {value!r}.")
    return type(present)(number)
