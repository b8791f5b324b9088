"""What is doubtful about a world: fields that are valid, but do not fit each other.

The horizontal motion is analysed with the planner's problem linearised about hovering, for one axis: state (position,
velocity, tilt), input (commanded tilt). Far from a goal, the terminal cost has the constant slope ``2 w / d`` at the
distance d, so the first input is ``w S_0 / (q d)``, where S_0 is the effect of the first input on the last position and
q the weight of the squared input. Near the goal, it is linear in the offset and in the tilt, which gives the offset at
which a robot stands in a steady wind that the planner does not know.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.geometry import length
from quad_swarm.planner import PlannerConfig
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.anticipation import load_predictor

if TYPE_CHECKING:
    from quad_swarm.world.presets import SwarmConfig

_SLOW_START = 5.0  # a planner that takes longer to half of the speed is slow (s)
_TINIEST = 1e-30  # avoids division by zero
_LIGHT_AIR = 0.01  # wind in which offsets are linear (m/s)
_SETTLING = 2.5  # time for which a disturbed velocity moves a robot (s)
_UNITS = {"vel": "m/s", "attitude": "rad"}
_FASTEST_TURN = 4 * math.pi  # of the yaw (rad/s)
_LEAST_MARGIN = 0.05  # between robots beyond contact; in `flight`, with 0.04 some touch (m)
_HIGH = 120.0  # as high as drones usually may fly (m)
_HASTY, _GENTLE = 3.0, 4.0  # time to the speed limit, in time constants of the attitude
_CRUISE = 1.5  # how far robots at full speed aim, in distances that they fly within the horizon


class DoubtfulWorld(UserWarning):
    """Warning of a world that is valid, but in which flights hardly mean what they should."""


class _Axis(NamedTuple):
    """Linearised horizontal motion along one axis.

    :param gravity: gravitational acceleration (m/s^2)
    :param drag: drag coefficient (1/s)
    :param gain: steady-state gain of the tilt command (-)
    :param max_tilt: limit of the commanded tilt (rad)
    :param effects: effect of each of the N inputs on the last position, (N,) (m/rad)
    :param of_tilt: effect of the current tilt on the last position (m/rad)
    :param input_weight: weight of the squared input (1/rad^2)
    :param goal_weight: weight of the squared distance to the goal at the end of the horizon (1/m^2)
    """

    gravity: float
    drag: float
    gain: float
    max_tilt: float
    effects: np.ndarray
    of_tilt: float
    input_weight: float
    goal_weight: float

    @property
    def fastest(self) -> float:
        """Speed through the air at the maximum tilt (m/s)."""
        thrust = self.gravity * math.tan(min(self.gain * self.max_tilt, 0.5 * math.pi - 1e-6))
        return max(thrust / max(self.drag, 1e-9), _TINIEST)

    def farthest(self, speed: float) -> float:
        """Return the distance to the goal (m) from which on robots are slower than ``speed`` (m/s), or take too long to
        reach it."""
        thrust = max(self.drag * speed, speed / _SLOW_START)
        needed = self.input_weight * math.atan(thrust / self.gravity) / self.gain
        return self.goal_weight * max(float(self.effects[0]), 0.0) / needed if needed > 1e-12 else math.inf

    def offset(self, wind: float) -> float:
        """Return the distance to the goal (m) at which a robot stands in a steady wind (m/s)."""
        tilt = math.atan(self.drag * wind / self.gravity) / self.gain
        curvature = self.input_weight + self.goal_weight * float(self.effects @ self.effects)
        pull = self.goal_weight * float(self.effects[0]) / curvature
        if tilt > self.max_tilt or (tilt and pull <= 0):
            return math.inf
        return tilt * (1 / pull + self.of_tilt * self.gain) if tilt else 0.0


@functools.lru_cache(maxsize=64)
def axes(planner: PlannerConfig, quadrotor: QuadrotorParams) -> tuple[_Axis, ...]:
    """Return the motion along x and y."""
    found = []
    for drag, gain, lag in (
        (quadrotor.drag_x, quadrotor.pitch_gain, quadrotor.pitch_time_constant),
        (quadrotor.drag_y, quadrotor.roll_gain, quadrotor.roll_time_constant),
    ):
        rates = planner.dt * np.array([[0, 1, 0], [0, -drag, quadrotor.gravity], [0, 0, -1 / lag]])
        one = np.eye(3)
        integral = one + rates @ (one / 2 + rates @ (one / 6 + rates / 24))  # as the Runge-Kutta step
        step, command = one + rates @ integral, planner.dt * integral @ [0, 0, gain / lag]
        effects, last = np.empty(planner.horizon), np.array([1.0, 0.0, 0.0])
        for k in range(planner.horizon):
            effects[-1 - k] = last @ command
            last = last @ step
        weight = planner.input_weight / planner.max_tilt**2
        found.append(
            _Axis(quadrotor.gravity, drag, gain, planner.max_tilt, effects, float(last[2]), weight, planner.goal_weight)
        )
    return tuple(found)


def farthest(config: SwarmConfig) -> float:
    """Return the distance (m) from which on goals as they are would be approached at less than half of the possible
    speed."""
    planner = config.planner
    both = axes(planner, config.quadrotor)
    return min(axis.farthest(min(planner.max_speed, axis.fastest) / 2) for axis in both)


def far_goals(config: SwarmConfig) -> tuple[float, str]:
    """Return the distance (m) from which on goals are approached at less than half of the possible speed, infinity with
    a cruise distance up to there, and the warning about it."""
    if not config.flies_quadrotors:
        return math.inf, ""
    planner, distance = config.planner, farthest(config)
    fastest = min(min(planner.max_speed, axis.fastest) for axis in axes(planner, config.quadrotor))
    # Where robots aim beyond the end of the horizon, only their limits keep them from flying faster
    cruise = min(_CRUISE * fastest * planner.horizon * planner.dt, distance)
    warning = (
        f"planner.goal_weight={planner.goal_weight:g} is divided by the squared distance to the goal, so robots whose "
        f"goals are more than {distance:.0f} m away fly at less than half of {fastest:.2g} m/s, the slower the "
        f"farther: with planner.cruise_distance={cruise:.2g}, they fly equally fast at any distance"
    )
    within = planner.cruise_distance is not None and planner.cruise_distance <= distance
    return (math.inf if within else distance), warning


def fast_goals(config: SwarmConfig, velocities: np.ndarray) -> Iterator[str]:
    """Yield a sentence if goals move faster than robots fly.

    :param config: the world
    :param velocities: velocities of goals, (n, 3) (m/s)
    """
    yield from _too_fast(config, velocities, "velocities", "the goal moves", "which fall behind")


def fast_starts(config: SwarmConfig, velocities: np.ndarray) -> Iterator[str]:
    """Yield a sentence if robots start faster than they fly.

    :param config: the world
    :param velocities: velocities of robots, (n, 3) (m/s)
    """
    yield from _too_fast(config, velocities, "initial_velocities", "it starts", "which brake first")


def _too_fast(config: SwarmConfig, velocities: np.ndarray, name: str, does: str, what: str) -> Iterator[str]:
    if not config.flies_quadrotors:
        return
    of_kinds = np.array([_speeds(kind) for kind in config.kinds])[list(config.kind_of)]
    fastest = of_kinds[:, :3]
    fastest[:, 2] = np.where(velocities[:, 2] < 0, of_kinds[:, 3], of_kinds[:, 2])
    beyond = np.abs(velocities) / fastest
    if beyond.max(initial=0.0) > 1:
        robot, axis = np.unravel_index(beyond.argmax(), beyond.shape)
        yield (
            f"{name}[{robot}]={velocities[robot].tolist()}: {does} faster than the {fastest[robot, axis]:.2g} m/s of "
            f"robots along {'xyz'[axis]}, {what}"
        )


def large_angles(name: str, headings: np.ndarray) -> Iterator[str]:
    """Yield a sentence if headings are more than a turn, (k,) (rad), as degrees would be."""
    if np.abs(headings).max(initial=0.0) > 2.01 * math.pi:
        robot = int(np.abs(headings).argmax())
        yield (
            f"{name}[{robot}]={headings[robot]:g} is in rad and more than a turn: as degrees, it would be "
            f"{math.radians(headings[robot]):.3g}"
        )


def _speeds(config: SwarmConfig) -> list[float]:
    """Return how fast robots fly along x and y, climb and descend (m/s)."""
    planner, gain = config.planner, config.quadrotor.climb_gain
    sideways = [min(planner.max_speed, axis.fastest) for axis in axes(planner, config.quadrotor)]
    up = min(planner.max_vertical_speed, planner.max_climb_rate * gain)
    return [*sideways, up, min(planner.descent_speed, planner.descent_rate * gain)]


def standing_offset(config: SwarmConfig, wind: float | None = None) -> float:
    """Return the distance to the goal (m) at which robots stand in a steady wind, 0 if they estimate it; infinity if
    the wind blows them away.

    :param config: the world
    :param wind: speed of the wind (m/s), by default the world's
    """
    wind = config.noise.wind if wind is None else wind
    offset = max(axis.offset(wind) for axis in axes(config.planner, config.quadrotor))
    return 0.0 if config.planner.disturbance_time is not None and math.isfinite(offset) else offset


def arrival_radius(config: SwarmConfig) -> float:
    """Return the goal radius (m) below which robots hardly arrive together."""
    return math.hypot(*_unsteadiness(config).values())


def _unsteadiness(config: SwarmConfig) -> dict[str, float]:
    """Return how far each disturbance moves robots from their goals (m), by its field. The factors were measured in
    `flight` (docs/flight.md) and `paper`; what is added in each step adds up as a random walk."""
    noise, sensing = config.noise, config.sensing
    per_step = 1 / math.sqrt(config.planner.dt)
    of_gusts = max(axis.offset(_LIGHT_AIR) for axis in axes(config.planner, config.quadrotor)) / _LIGHT_AIR
    return {
        "noise.wind": 1.1 * standing_offset(config),
        "noise.gust": 1.1 * noise.gust * of_gusts,
        "noise.vel": _SETTLING * noise.vel,
        "noise.attitude": 0.6 * per_step * noise.attitude,
        "sensing.vel": 0.6 * sensing.vel,
        "sensing.attitude": 1.25 * sensing.attitude,
    }


def _up(number: float) -> float:
    """Round a number up for a message."""
    return math.ceil(number) if number < 1e9 else float(f"{number:.1e}")


def doubts(config: SwarmConfig) -> Iterator[str]:
    """Yield a sentence about everything that is doubtful about a world, with a field and what to do. How vehicles with
    dynamics from outside move is not known here."""
    yield from _doubts_about_obstacles(config)
    yield from _doubts_about_predictions(config)
    if not config.flies_quadrotors:
        yield from _doubts_about_the_others(config)
        return
    short = short_horizon(config)
    if short is None:
        yield from _doubts_about_arriving(config)
        yield from _doubts_about_hasty_tilts(config)
    else:
        yield short
    yield from _doubts_about_the_vehicle(config)
    yield from _doubts_about_the_others(config)


def short_horizon(config: SwarmConfig) -> str | None:
    """Return a sentence if the planner's horizon is too short for the vehicle's lags."""
    planner, vehicle = config.planner, config.quadrotor
    ahead = planner.horizon * planner.dt
    for name, factor in (("roll_time_constant", 1.5), ("pitch_time_constant", 1.5), ("climb_time_constant", 0.75)):
        needed = factor * getattr(vehicle, name)
        if ahead < 0.999 * needed:
            longer = math.ceil(2 * needed / planner.dt) if needed < 400 * planner.dt else None
            return (
                f"planner.horizon={planner.horizon} steps of planner.dt={planner.dt:g} s look {ahead:.2g} s ahead, too "
                f"little for quadrotor.{name}={getattr(vehicle, name):g} s: robots hardly move or collide; "
                + (f"use planner.horizon={longer}" if longer else "time constants are in seconds")
            )
    return None


def _doubts_about_the_vehicle(config: SwarmConfig) -> Iterator[str]:
    planner, vehicle = config.planner, config.quadrotor
    fastest = min(axis.fastest for axis in axes(planner, vehicle))
    if planner.max_speed > 2 * fastest:
        yield (
            f"planner.max_speed={planner.max_speed:g} is in m/s: with planner.max_tilt={planner.max_tilt:.3g} rad, the "
            f"vehicle reaches {fastest:.2g} m/s; use at most twice that, or tilt more"
        )
    fall = vehicle.climb_gain * planner.descent_rate / vehicle.climb_time_constant
    if fall > vehicle.gravity:
        slower = vehicle.gravity * vehicle.climb_time_constant / vehicle.climb_gain
        name = "max_climb_rate" if planner.max_descent_rate is None else "max_descent_rate"
        yield (
            f"planner.{name}={planner.descent_rate:g}: with quadrotor.climb_time_constant="
            f"{vehicle.climb_time_constant:g}, robots descend with {fall:.0f} m/s^2, faster than they would fall; at "
            f"most {slower:.2g} m/s is plausible"
        )
    if planner.max_yaw_rate > _FASTEST_TURN:
        yield (
            f"planner.max_yaw_rate={planner.max_yaw_rate:g} is in rad/s and more than two turns per second: "
            f"{math.radians(planner.max_yaw_rate):.3g} would be the same number in degrees"
        )


def _doubts_about_hasty_tilts(config: SwarmConfig) -> Iterator[str]:
    """Yield a sentence if robots reach their speed limit before their attitude follows: the planner then tilts them
    back and forth, and vehicles whose attitude overshoots tumble (a Crazyflie with brushed motors in Crazyflow, at 1
    m/s)."""
    planner, vehicle = config.planner, config.quadrotor
    lag = max(vehicle.roll_time_constant, vehicle.pitch_time_constant)
    for axis in axes(planner, vehicle):
        thrust = axis.gravity * math.tan(min(axis.gain * axis.max_tilt, 1.5))
        gentle = math.floor(100 * math.atan(planner.max_speed / (_GENTLE * lag * axis.gravity)) / axis.gain) / 100
        if planner.max_speed < _HASTY * lag * thrust and gentle > 0:
            yield (
                f"planner.max_speed={planner.max_speed:g}: with planner.max_tilt={planner.max_tilt:.3g}, robots reach "
                f"it in {planner.max_speed / thrust:.2g} s, hardly more than their attitude takes ({lag:.2g} s): they "
                f"tilt back and forth, and some vehicles tumble; use planner.max_tilt={gentle:g}"
            )
            return


def _doubts_about_arriving(config: SwarmConfig) -> Iterator[str]:
    planner, space = config.planner, config.space
    offset = standing_offset(config)
    needed = arrival_radius(config)
    if math.isinf(offset):
        yield (
            f"noise.wind={config.noise.wind:g}: with planner.max_tilt={planner.max_tilt:.3g} rad, robots hold their "
            f"place in at most {min(axis.fastest for axis in axes(planner, config.quadrotor)):.2g} m/s"
        )
    elif config.goal_radius < needed:
        yield _too_unsteady(config, needed)
    distance, warning = far_goals(config)
    if not planner.goal_weight:
        yield "planner.goal_weight=0: robots do not fly to their goals; use a positive weight"
    elif _usual_flight(config) > distance:
        yield warning
    yield from too_short(config, config.max_steps)
    if config.goal_radius > max(space.spacing, 2 * config.radius):
        yield (
            f"goal_radius={config.goal_radius:g} exceeds the distance of the goals, space.spacing={space.spacing:g}: "
            "robots are at their goals before they fly there; use at most half of that distance"
        )
    least = config.least_spacing
    if space.spacing < least:
        yield (
            f"space.spacing={space.spacing:g}: with planner.separation={planner.separation:g}, robots push each other "
            f"away from goals that close; use at least {least:g}, or leave it out of make_config to follow"
        )


def _too_unsteady(config: SwarmConfig, needed: float) -> str:
    """Return the sentence about a goal radius that is smaller than needed."""
    found = _unsteadiness(config)
    name = max(found, key=lambda one: found[one])
    if name in ("noise.wind", "noise.gust"):
        return (
            f"goal_radius={config.goal_radius:g}: in noise.wind={config.noise.wind:g} and "
            f"noise.gust={config.noise.gust:g}, which planners do not know, robots stand "
            f"{standing_offset(config):.2f} m beside their goals, or are moved away, and hardly arrive; use at least "
            f"goal_radius={_up(125 * needed) / 100:g}"
        )
    part, field = name.split(".")
    value = getattr(getattr(config, part), field)
    most = 0.5 * value * config.goal_radius / found[name]
    return (
        f"{name}={value:g} is in {_UNITS[field]}: robots are moved about {found[name]:.2g} m away from their goals "
        f"and hardly arrive within goal_radius={config.goal_radius:g}; use at most {most:.1g}"
    )


def _usual_flight(config: SwarmConfig) -> float:
    """Return about the mean distance of starts and goals in the scenario where it is largest (m)."""
    space = config.space
    return max(space.half_width, 2 * space.circle_radius[0], 2 * space.sector_radius[0])


def too_short(config: SwarmConfig, max_steps: int) -> Iterator[str]:
    """Yield a sentence if robots cannot fly a usual distance, with detours, or climb two thirds of the room's height in
    time."""
    if not config.flies_quadrotors:
        return
    planner, space = config.planner, config.space
    speeds = np.array([_speeds(kind) for kind in config.kinds])
    speed, climb = (max(float(found.min()), _TINIEST) for found in (speeds[:, :2], speeds[:, 2:]))
    needed = max(
        1.5 * (_usual_flight(config) - config.goal_radius) / speed,
        (2 / 3 * (space.heights[1] - space.heights[0]) - config.goal_radius) / climb,
    )
    if needed / planner.dt > max_steps:
        seconds = max_steps * planner.dt
        yield (
            f"max_steps={max_steps}: episodes of {seconds:.2g} s are too short to reach goals at {speed:.2g} m/s, and "
            f"{climb:.2g} m/s vertically, in this room; use at least max_steps={_up(2 * needed / planner.dt)}"
        )


def _doubts_about_the_others(config: SwarmConfig) -> Iterator[str]:
    planner, radio = config.planner, config.radio
    delay = "delay" if radio.round_trip is None else "round_trip"
    steps = getattr(radio, delay)
    oldest = 1 + steps + radio.jitter
    if oldest >= planner.horizon:
        yield (
            f"radio.{delay}={steps} and radio.jitter={radio.jitter} are in steps of {planner.dt:g} s: answers that "
            f"are {oldest} steps old have no future left in a plan of planner.horizon={planner.horizon}; use at most "
            f"{max(planner.horizon - 2, 0)} together"
        )
    for name, error, most in (
        ("sensing.pos", config.sensing.pos, 0.5 * config.radius),
        ("sensing.others_pos", config.sensing.others_pos, config.radius),
        ("noise.pos", config.noise.pos, 0.125 * min(config.radius, config.goal_radius)),  # in each step
    ):
        if error > most:
            yield (
                f"{name}={error:g} is in metres and too much for radius={config.radius:g}: robots cannot keep clear of "
                f"each other, or stay at a goal; use at most {0.5 * most:.1g}"
            )
    yield from _doubts_about_speed(config) if config.flies_quadrotors else ()
    margin = planner.separation - 2 * config.radius
    if config.flies_quadrotors and config.continuous_collisions and margin < _LEAST_MARGIN:
        yield (
            f"planner.separation={planner.separation:g} leaves {margin:.2g} m between robots before they touch, which "
            "they do between the planner's steps; use at least "
            f"{2 * config.radius + _LEAST_MARGIN:g}, or leave it out of make_config to follow the radius"
        )
    if (highest := max(config.space.heights)) > _HIGH:
        yield f"space.heights={list(config.space.heights)}: robots fly {highest:g} m high; lengths are in metres"
    if planner.right_of_way > planner.separation:
        yield (
            f"planner.right_of_way={planner.right_of_way:g} is in metres and exceeds planner.separation="
            f"{planner.separation:g}: robots make detours around others that are far away; use less than it"
        )
    if config.memory > 2 * config.radius:
        yield (
            f"memory={config.memory:g}: plans count as right that are off by more than the distance at which robots "
            f"touch, {2 * config.radius:g} m; use a few centimetres, as in the presets"
        )


def moving_alike(config: SwarmConfig) -> dict[str, Any]:
    """Return the fields of a world on which it depends how its robots move, and when they are seen, by the names that
    ``--world`` has, as JSON has them. They hardly fly along the walls of the workspace."""
    nested = {name: dataclasses.asdict(getattr(config, name)) for name in ("planner", "quadrotor")}
    named = {f"{name}.{field}": value for name, fields in nested.items() for field, value in fields.items()}
    walls = {"planner.workspace_low", "planner.workspace_high"}
    known = {name: value for name, value in named.items() if name not in walls}
    seen = {f"sensing.{name}": getattr(config.sensing, name) for name in ("others_delay", "gaps")}
    return json.loads(json.dumps({"radius": config.radius, **known, **seen}))


def _doubts_about_predictions(config: SwarmConfig) -> Iterator[str]:
    if config.predictor is None:
        return
    trained, here = load_predictor(config.predictor).trained_in, moving_alike(config)
    if trained:  # older files do not say that nothing was late or lost
        trained = {"sensing.others_delay": 0, "sensing.gaps": 0.0, **trained}
    others = [name for name, value in here.items() if trained.get(name, value) != value]
    if others:
        name = others[0]
        yield (
            f"predictor={config.predictor!r} learned how robots move with {name}={shown(trained[name])} instead of "
            f"{shown(here[name])}{f' and {len(others) - 1} other fields' if len(others) > 1 else ''}: whether "
            "it helps here is to be seen; fly with and without (predictor=null), or train one for this world "
            "(`python -m studies.swarm.anticipation`)"
        )


def _doubts_about_obstacles(config: SwarmConfig) -> Iterator[str]:
    low, high = np.array(config.planner.workspace_low), np.array(config.planner.workspace_high)
    reach = max([config.radius, *(one.radius or 0.0 for one in config.vehicles)]) + config.obstacle_margin
    for number, one in enumerate(config.obstacles.listed):
        last = min(config.max_steps, 100_000) * config.planner.dt
        times = np.linspace(0.0, last, 1000) if one.moves else np.zeros(1)
        centres = np.array(one.position) + times[:, None] * np.array(one.velocity)
        shape = (1.0, 1.0, 0.0) if one.shape == "cylinder" else 1.0
        outside = length(np.maximum(np.maximum(low - centres, centres - high), 0.0) * shape).min() - one.radius
        if outside > reach:
            yield (
                f"obstacles.listed.{number} with position={list(one.position)} stays {outside:.3g} m or more outside "
                "the workspace, where it keeps no robot from anything; lengths are in metres"
            )


def _doubts_about_speed(config: SwarmConfig) -> Iterator[str]:
    planner = config.planner
    stride = planner.dt * min(planner.max_speed, *(axis.fastest for axis in axes(planner, config.quadrotor)))
    if not config.continuous_collisions and stride > 4 * config.radius:
        yield (
            f"radius={config.radius:g}: robots fly up to {stride:.2g} m in a step and through "
            "each other between steps, where collisions are not counted; use continuous_collisions=true"
        )
    reach = config.neighbourhood.range
    if reach is not None and config.is_limited:
        both = axes(planner, config.quadrotor)
        braking = min(axis.gravity * math.tan(axis.gain * axis.max_tilt) for axis in both)
        speed = min(planner.max_speed, *(axis.fastest for axis in both)) / 2
        needed = planner.separation + speed * speed / max(braking, _TINIEST)
        if reach < needed:
            yield (
                f"neighbourhood.range={reach:g}: two robots that meet at half of planner.max_speed="
                f"{planner.max_speed:g} cannot stop within it; use at least {_up(10 * needed) / 10:g}"
            )


_warned: set[str] = set()


def warn(sentence: str) -> None:
    """Warn of something doubtful, in one line. Each sentence is shown once in a process, unless Python's filters say
    "always", as in tests, or "error"."""
    usual = ("default", "module", "once")
    actions = (
        action
        for action, message, category, module, _ in warnings.filters
        if issubclass(DoubtfulWorld, category) and message is None and module is None
    )
    if next(actions, "default") in usual:
        if sentence in _warned:
            return
        _warned.add(sentence)
    warnings.warn_explicit(f"{sentence}.", DoubtfulWorld, "quad_swarm", 0)
