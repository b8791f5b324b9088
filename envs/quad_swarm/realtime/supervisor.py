"""Supervision of one robot: what makes it hold its place, level or land instead of flying to its goal."""

from __future__ import annotations

import contextlib
import threading
from collections import Counter
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat, PositiveFloat

from quad_swarm.geometry import flattened, length
from quad_swarm.quadrotor import N_INPUTS, POSITION, VELOCITY
from quad_swarm.realtime.link import Sensed, Vehicle, monotonic
from quad_swarm.validation import checked
from quad_swarm.world.doubts import warn
from quad_swarm.world.presets import SwarmConfig

HOVERING = np.zeros(N_INPUTS)
_US = 1e6
_AT_REST = 0.01  # m/s, rad
_GROUND, _DEEPEST = 0.3, 5.0  # heights of the ground in a workspace, and depth below it (m)
_FAR = 50.0  # distance of a wall from which on it may be meant in other units (m)
_Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Mode(IntEnum):
    """What a robot does, in the order of precedence. In `HOVER`, one that sees holds its place; another one levels."""

    FLY = 0
    HOVER = 1
    LAND = 2
    OFF = 3


@checked
@dataclass(frozen=True)
class SafetyLimits:
    """When a robot holds its place, levels, and lands. Times are in seconds, lengths in metres.

    :param stale: age of the perceived state from which on it levels
    :param lost: age of the perceived state from which on it lands; also for a state that is frozen or was never there,
        and for a planner that fails
    :param frozen: time after which a state that stays the same to the last bit is none, unless the robot is at rest
    :param unanswered: time without any message, or any plan that could be believed, in spite of requests, after which
        the robot holds its place and asks everybody
    :param silence: the same, after which it lands
    :param separation: distance to another robot below which it holds its place, in the metric of collisions (see
        `SwarmConfig` for robots of unlike radii and for downwash); None for that of a collision
    :param fence: how far it may leave the workspace to the sides and upwards, before it lands; nothing guards downwards
    :param room: lowest and highest corner between walls, floor and ceiling, in the world's frame; `Supervisor` then
        checks that the workspace is inside, not on the floor, and that a robot which is noticed at the fence stops
        before the walls and the ceiling. None if there are none
    :param hung: time without a sign of life of the loop after which the watchdog levels
    :param landing: climb rate of a landing (m/s), negative. Where the planner's limit of descents is lower, robots land
        with that, and may take longer in proportion
    :param ground: height at which it has landed; a robot that sees itself above it does not disarm
    :param settled: time at that height, or below, after which it disarms
    :param landing_time: duration of a landing without a state, if its last height does not take longer
    :raises ValueError: if a value is out of range, or a state would be lost before it is stale
    """

    stale: Annotated[float, Field(gt=0, le=60)] = 0.2
    lost: Annotated[float, Field(gt=0, le=60)] = 1.0
    frozen: Annotated[float, Field(gt=0, le=60)] = 0.2
    unanswered: Annotated[float, Field(gt=0, le=60)] = 1.0
    silence: Annotated[float, Field(gt=0, le=600)] = 10.0
    separation: Annotated[float, Field(ge=0)] | None = None
    fence: Annotated[float, Field(ge=0, le=10)] = 1.0
    room: tuple[_Corner, _Corner] | None = None
    hung: Annotated[float, Field(gt=0, le=60)] = 0.3
    landing: Annotated[float, Field(lt=0, ge=-2)] = -0.5
    ground: float = 0.1
    settled: PositiveFloat = 0.3
    landing_time: PositiveFloat = 20.0

    def __post_init__(self) -> None:
        if not self.stale <= self.lost or not self.unanswered <= self.silence:
            raise ValueError(
                f"stale={self.stale}, lost={self.lost}, unanswered={self.unanswered}, silence={self.silence}: a robot "
                "hovers before it lands, so the first of each two must not be the larger one"
            )


def braking_room(config: SwarmConfig, fence: float) -> np.ndarray:
    """Return how far walls and ceiling must be from the workspace of robots that land when they leave it, (3,) (m).

    To the sides, it is the distance in which robots brake from their speed limit, as `python -m studies.stopping`
    measures it for the Crazyflie and the Bebop; upwards, that of a climb of 1.5 m/s.

    :param fence: how far outside of the workspace they are noticed (m)
    """
    speed = config.planner.max_speed
    sideways = 0.5 * speed + 0.1 * speed * speed
    return fence + config.radius + np.array([sideways, sideways, 0.5])


def _check_heights_and_distances(kind: SwarmConfig, config: SwarmConfig, limits: SafetyLimits) -> None:
    lowest, planner = kind.planner.workspace_low[2], config.planner
    deepest, highest = min(lowest, 0.0) - _DEEPEST, max(lowest, _GROUND)
    if not deepest <= limits.ground <= highest:
        raise ValueError(
            f"limits.ground={limits.ground:g} m: a robot that lands stops its motors there; with "
            f"planner.workspace_low[2]={lowest:g}, it must be {deepest:g} to {highest:g} m"
        )
    contact = 2 * config.radius - config.collision_tolerance  # of all pairs, whatever their radii, see `SwarmConfig`
    if limits.separation is not None and not contact <= limits.separation <= planner.separation:
        raise ValueError(
            f"limits.separation={limits.separation:g} m: robots hold their places below it, so it must be at least "
            f"that of contact ({contact:g}) and at most planner.separation={planner.separation:g}"
        )


def room_of(config: SwarmConfig, limits: SafetyLimits) -> str:
    """Describe how much space the room leaves beside the workspace."""
    assert limits.room is not None
    (*sides, floor), (*opposite, ceiling) = _gaps(config, limits.room)
    needed = braking_room(config, limits.fence)
    return (
        f"walls {min(*sides, *opposite):.2f} m from the workspace ({needed[0]:.2f} m needed), ceiling {ceiling:.2f} m "
        f"({needed[2]:.2f} m), floor {floor:.2f} m (nothing guards it)"
    )


def _gaps(config: SwarmConfig, room: tuple[_Corner, _Corner]) -> np.ndarray:
    """Return the distances of the workspace to the lower and the upper walls, (2, 3) (m)."""
    planner = config.planner
    return np.array([np.subtract(planner.workspace_low, room[0]), np.subtract(room[1], planner.workspace_high)])


def _check_room(config: SwarmConfig, limits: SafetyLimits) -> None:
    if limits.room is None:
        return
    needed, planner = braking_room(config, limits.fence), config.planner
    gaps = _gaps(config, limits.room)
    if gaps.min() < 0:
        raise ValueError(
            f"limits.room={[list(corner) for corner in limits.room]}: the workspace, {list(planner.workspace_low)} to "
            f"{list(planner.workspace_high)}, is not inside; give the lower corner first, in metres, in the frame of "
            "the world, whose scenarios are drawn around x = y = 0"
        )
    if gaps[0, 2] < config.radius:
        raise ValueError(
            f"limits.room: {gaps[0, 2]:.3g} m between the floor and planner.workspace_low[2]="
            f"{planner.workspace_low[2]:g}: nothing guards the floor, and a robot has a radius of {config.radius:g} m"
        )
    if gaps.max() > _FAR:
        warn(f"limits.room is {gaps.max():.3g} m beside the workspace: lengths are in metres")
    least = np.array([needed, needed])
    least[0, 2] = 0.0
    if (gaps < least - 1e-9).any():
        corner, axis = np.unravel_index((gaps - least).argmin(), gaps.shape)
        gap, name = gaps[corner, axis], ("workspace_low", "workspace_high")[corner]
        low = np.maximum(planner.workspace_low, np.add(limits.room[0], least[0])).round(3).tolist()
        high = np.minimum(planner.workspace_high, np.subtract(limits.room[1], least[1])).round(3).tolist()
        slower_stops = axis < 2 and gap > limits.fence + config.radius
        raise ValueError(
            f"limits.room: {gap:.3g} m between planner.{name}[{axis}]={getattr(planner, name)[axis]:g} and the "
            f"{'ceiling' if axis == 2 else 'wall'} at {limits.room[corner][axis]:g}, but a robot that is noticed at "
            f"the fence ({limits.fence:g} m) needs {needed[axis]:.3g} m to stop: give planner.workspace_low={low} and "
            f"planner.workspace_high={high}"
            + (f", or planner.max_speed below {planner.max_speed:g}" if slower_stops else "")
            + (", or a lower limits.fence" if needed[axis] - limits.fence < gap else "")
        )


class Supervisor:
    """The guards of one robot.

    :ivar limits: the limits, with the climb rate of landings within the planner's limit
    :ivar mode: what the robot does; landing is final until `reset`
    :ivar sees: whether what is perceived can be planned with
    :ivar reasons: how often each guard stepped in
    :ivar why: the guards that step in now
    :ivar shall_land: whether `land` was called

    :param config: the world
    :param limits: when to hover and when to land
    :param robot: number of the robot
    :raises ValueError: if the limits do not fit the world: robots would land in the air, hold their places at the
        distance that they keep or touch before they do, or the room is too small for workspace, fence and braking
    """

    def __init__(self, config: SwarmConfig, limits: SafetyLimits, robot: int = 0):
        kind = config.kinds[config.kind_of[robot]]
        _check_heights_and_distances(kind, config, limits)
        _check_room(kind, limits)
        fastest = kind.planner.descent_rate
        if (slower := limits.landing / -fastest) > 1:
            limits = replace(limits, landing=-fastest, landing_time=slower * limits.landing_time)
        self.limits = limits
        self._excess = 0.0 if config.excess is None else np.delete(config.excess[robot], robot)
        contact = 2 * config.radius - config.collision_tolerance
        self._downwash = config.planner.downwash
        self._apart = contact if limits.separation is None else limits.separation
        low, high = np.array(config.planner.workspace_low), np.array(config.planner.workspace_high)
        self._low, self._high = low - limits.fence, high + limits.fence
        self._low[2], self._highest = -np.inf, high[2]
        self.reasons: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Begin to fly."""
        self.mode, self.why, self.sees = Mode.FLY, frozenset[str](), False
        self._state: np.ndarray | None = None
        self._changed = self._landing_since = 0
        self._began: int | None = None  # when it was checked first
        self._height = self._highest  # where it was seen last
        self._low_since: int | None = None  # since when it has been seen on the ground (us)
        self._low_for = 0.0  # and for how long (s)
        self._is_frozen = self.shall_land = False

    def land(self) -> None:
        """Land from the next check on, since somebody outside wishes so. This is final, as every landing is."""
        self.shall_land = True

    def check(
        self,
        now: int,
        sensed: Sensed | None,
        setpoint: np.ndarray,
        unanswered: float = 0.0,
        unplanned: float = 0.0,
    ) -> Mode:
        """Check everything once a period.

        :param now: the time (us)
        :param sensed: what is perceived; None before there is anything
        :param setpoint: the last set-point, (4,)
        :param unanswered: time without any message in spite of requests (s)
        :param unplanned: time since which the planner has failed (s)
        """
        if self.mode is Mode.OFF:
            return self.mode
        limits, why = self.limits, dict[str, Mode]()
        if self.shall_land:
            why["told to land"] = Mode.LAND
        self._began = now if self._began is None else self._began
        if sensed is None:
            why["no state yet"] = Mode.LAND if now - self._began > limits.lost * _US else Mode.HOVER
        else:
            why |= self._objections(now, sensed, setpoint)
        if unanswered > limits.unanswered:
            why["no answers"] = Mode.LAND if unanswered > limits.silence else Mode.HOVER
        if unplanned > limits.lost:
            why["planner fails"] = Mode.LAND
        self.sees = why.keys().isdisjoint(("no state yet", "state is stale", "state is frozen"))
        self.reasons.update(why.keys() - self.why)
        self.why = frozenset(why)
        mode = max(why.values(), default=Mode.FLY)
        if self.sees and sensed is not None:
            self._look_down(sensed)
        if self.mode is Mode.LAND or mode is Mode.LAND:
            mode = self._land(now)
        self.mode = mode
        return mode

    def _objections(self, now: int, sensed: Sensed, setpoint: np.ndarray) -> dict[str, Mode]:
        """Return the guards that object to a state."""
        limits, why, own = self.limits, dict[str, Mode](), sensed.state[POSITION]
        if (age := (now - sensed.stamp) / _US) > limits.stale:
            why["state is stale"] = Mode.LAND if age > limits.lost else Mode.HOVER
        same = self._unchanged(sensed, setpoint)
        if self._is_frozen:
            why["state is frozen"] = Mode.LAND if same > limits.lost else Mode.HOVER
        if (own < self._low).any() or (own > self._high).any():
            why["outside the fence"] = Mode.LAND
        distances = length(flattened(sensed.pos - own, self._downwash)) - self._excess
        if (distances < self._apart).any():
            why["too close"] = Mode.HOVER
        return why

    def _unchanged(self, sensed: Sensed, setpoint: np.ndarray) -> float:
        """Return how long the state has been the same (s)."""
        if self._state is None or not np.array_equal(sensed.state, self._state):
            self._state, self._changed, self._is_frozen = sensed.state.copy(), sensed.stamp, False
            return 0.0
        same = (sensed.stamp - self._changed) / _US
        at_rest = np.abs(sensed.state[VELOCITY]).max() < _AT_REST and np.abs(setpoint).max() < _AT_REST
        self._is_frozen |= same > self.limits.frozen and not at_rest
        return same

    def _look_down(self, sensed: Sensed) -> None:
        """Note the height, and how long the robot has been on the ground: a single low state may be an error."""
        self._height = float(sensed.state[2])
        if self._height > self.limits.ground:
            self._low_since = None
        elif self._low_since is None:
            self._low_since = sensed.stamp
        self._low_for = 0.0 if self._low_since is None else (sensed.stamp - self._low_since) / _US

    def _land(self, now: int) -> Mode:
        limits = self.limits
        if self.mode is not Mode.LAND:
            self._landing_since = now
        if self.sees:
            is_down = self._low_for >= limits.settled
        else:
            descent = 2 * (self._height - limits.ground) / -limits.landing
            is_down = now - self._landing_since > max(limits.landing_time, descent) * _US
        return Mode.OFF if is_down else Mode.LAND

    def setpoint(self, mode: Mode) -> np.ndarray:
        """Return the set-point of a robot that does not plan, (4,).

        :param mode: `Mode.HOVER` or `Mode.LAND`
        """
        return HOVERING if mode is Mode.HOVER else np.array([0.0, 0.0, self.limits.landing, 0.0])


class Watchdog:
    """A thread that levels, and later lands, if the loop hangs: an autopilot's link may repeat the last set-point for
    ever. It ends after `SafetyLimits.landing_time`; then, the autopilot's failsafe has to act.

    :ivar barks: how often it stepped in

    :param vehicle: the vehicle
    :param limits: when to hover and when to land
    """

    def __init__(self, vehicle: Vehicle, limits: SafetyLimits):
        self._vehicle, self._limits, self.barks = vehicle, limits, 0
        self._beaten, self._ended = monotonic(), threading.Event()
        self._armed = False
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def beat(self, armed: bool = True) -> None:
        """Show that the loop is alive.

        :param armed: whether to step in if this is the last sign of life
        """
        self._beaten, self._armed = monotonic(), armed

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        barking = False
        while not self._ended.wait(self._limits.hung / 4):
            silent = (monotonic() - self._beaten) / _US
            if not self._armed or silent < self._limits.hung:
                barking = False
                continue
            if silent > self._limits.hung + self._limits.lost + self._limits.landing_time:
                continue
            self.barks += not barking
            barking = True
            lands = silent > self._limits.hung + self._limits.lost
            with contextlib.suppress(Exception):  # of a vehicle from outside, which must not end this thread
                self._vehicle.command(np.array([0.0, 0.0, self._limits.landing, 0.0]) if lands else HOVERING, None)
