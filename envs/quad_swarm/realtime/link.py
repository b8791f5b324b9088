"""What connects one robot with the others and with its vehicle."""

from __future__ import annotations

import dataclasses
import json
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, Protocol, TypeVar, cast

import numpy as np
from pydantic import Field

from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.robot import Plan, wire
from quad_swarm.validation import checked
from quad_swarm.world.presets import SwarmConfig

T = TypeVar("T")


class Sensed(NamedTuple):
    """What a robot perceives.

    :param stamp: when it was so (us, on the robot's clock)
    :param state: estimate of the own state, (9,)
    :param pos: positions of the others in ascending order, (n - 1, 3), world frame (m)
    :param vel: velocities of the others, (n - 1, 3), world frame (m/s)
    """

    stamp: int
    state: np.ndarray
    pos: np.ndarray
    vel: np.ndarray


_APART = 200_000  # us between two states from which on the oldest one counts as everybody's
_S = 1e6


def sensed_together(stamp: int, state: np.ndarray, stamps: np.ndarray, pos: np.ndarray, vel: np.ndarray) -> Sensed:
    """Return what a robot perceives from states of different times, all at the time of its own.

    If one of them is 0.2 s older, all are of that time: guards shall notice that somebody is not seen any more.

    :param stamp: time of the own state (us)
    :param state: the own state, (9,)
    :param stamps: times of the others' states (us), (n - 1,)
    :param pos: positions of the others, (n - 1, 3), world frame (m)
    :param vel: velocities of the others, (n - 1, 3), world frame (m/s)
    """
    oldest = min(stamp, int(np.min(stamps, initial=stamp)))
    at = stamp if stamp - oldest < _APART else oldest
    if at != stamp:
        state = state.copy()
        state[POSITION] += (at - stamp) / _S * state[VELOCITY]
    return Sensed(at, state, pos + (at - np.asarray(stamps))[:, None] / _S * vel, vel)


class Handler(Protocol):
    """What is done with messages that arrive. It raises nothing."""

    def on_request(self, sender: int) -> None:
        """Answer a request."""

    def on_plan(self, sender: int, plan: Plan, sent: int | None, period: int) -> None:
        """Take a plan.

        :param sender: robot whose plan it is
        :param plan: the plan
        :param sent: when it was sent (us), None if the link does not tell
        :param period: length of its stages (us)
        """


class Link(Protocol):
    """The way to the other robots. Times are those of the robot's own clock (us)."""

    def now(self) -> int:
        """Return the time."""

    def request(self, other: int) -> None:
        """Ask another robot for its plan."""

    def send(self, other: int, plan: Plan, period: int, asked: bool) -> None:
        """Send a plan to another robot.

        :param other: number of the other robot
        :param plan: the plan
        :param period: length of its stages (us)
        :param asked: whether the other robot asked for it
        """

    def wait(self, until: int, handler: Handler, done: Callable[[], bool] = lambda: False) -> None:
        """Handle messages until some time, at least those that are there already.

        :param until: the time
        :param handler: what to do with messages
        :param done: tells that it need not wait any longer
        """


class Vehicle(Protocol):
    """What a robot's loop flies: an autopilot, or a simulated vehicle. Other threads may call it, too."""

    def sense(self) -> Sensed | None:
        """Return the newest that is perceived, None before there is any."""

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """Fly a set-point from now on.

        :param setpoint: roll, pitch (rad), climb rate (m/s) and yaw rate (rad/s), (4,)
        :param plan: the plan that it begins, for autopilots that follow trajectories; None if there is none
        """

    def disarm(self) -> None:
        """Stop the motors, on the ground."""


def monotonic() -> int:
    """Return the time of a clock that nobody sets (us)."""
    return time.monotonic_ns() // 1000


def of_day(at: int) -> int:
    """Return a time of `monotonic` on the clock of the day (us)."""
    return at + time.time_ns() // 1000 - monotonic()


@dataclass
class Traffic:
    """What a robot sent and received.

    :param requests: requests that it sent
    :param answers: plans that it sent because they were asked for
    :param announcements: plans that it sent unasked
    :param bytes: size of all that, without the headers of the network
    :param received: messages that arrived for it
    :param refused: messages that were none: damaged, of another version or session
    """

    requests: int = 0
    answers: int = 0
    announcements: int = 0
    bytes: int = 0
    received: int = 0
    refused: int = 0


class BaseLink:
    """What all links have: a clock, counts, and what trials change.

    :ivar traffic: what has been sent and received
    :ivar clock_error: error of the clock that all robots share (us), for trials
    :ivar deaf_to: robots whose messages do not arrive, for trials
    :ivar channel: what becomes of messages that arrive, for trials

    :param index: number of the robot
    """

    def __init__(self, index: int):
        self.index, self.traffic, self.clock_error = index, Traffic(), 0
        self.deaf_to: frozenset[int] = frozenset()
        self.channel: Channel | None = None

    def now(self) -> int:
        """See `Link`."""
        return monotonic()

    def shared(self, at: int) -> int:
        """Return a time of the robot's clock on the clock that all robots share (us). Clocks that only count up differ
        between machines; those of the day are kept together by PTP or NTP."""
        return at + self._offset()

    def own(self, at: int) -> int:
        """Return a time of the clock that all robots share on the robot's own (us)."""
        return at - self._offset()

    def _offset(self) -> int:
        return of_day(0) + self.clock_error


def session_of(config: SwarmConfig, team: int = 0) -> int:
    """Return a session that robots of the same world share: messages of a robot that flies in another one, with other
    lengths, limits or obstacles, are refused, but for one world in 256.

    :param config: the world
    :param team: tells apart teams in the same world on one channel
    """
    world = json.dumps(dataclasses.asdict(config), sort_keys=True)
    return (zlib.crc32(world.encode()) + team) % 256


class WireLink(BaseLink):
    """A link whose messages are those of `quad_swarm.robot.wire`.

    :param index: number of the robot
    :param session: tells apart teams and flights on one channel, 0 to 255, see `session_of`
    :param checked: whether messages carry a checksum, for radios that have none
    """

    def __init__(self, index: int, session: int = 0, checked: bool = False):
        super().__init__(index)
        self.session, self.checked = session, checked

    def request(self, other: int) -> None:
        """See `Link`."""
        self.traffic.requests += 1
        self._transmit(other, wire.pack_request(self.session, self.index, other, self.shared(self.now()), self.checked))

    def send(self, other: int, plan: Plan, period: int, asked: bool) -> None:
        """See `Link`."""
        now, stamp = self.shared(self.now()), self.shared(plan.stamp)
        head = (self.session, self.index, other, now, stamp, period)
        message = wire.pack_plan(*head, plan.positions, asked, self.checked)
        if asked:
            self.traffic.answers += 1
        else:
            self.traffic.announcements += 1
        self._transmit(other, message)

    def deliver(self, data: bytes, handler: Handler) -> None:
        """Take bytes that arrived."""
        try:
            message = wire.unpack(data, self.session)
        except wire.WireError:
            self.traffic.refused += 1
            return
        if message.receiver not in (self.index, wire.EVERYBODY) or message.sender == self.index:
            return
        self.traffic.received += 1
        if message.positions is None:
            handler.on_request(message.sender)
            return
        now = self.now()
        sent, stamp = (self.own(wire.nearest(one, self.shared(now))) for one in (message.sent, message.stamp))
        handler.on_plan(message.sender, Plan(stamp, message.positions), sent, message.period)

    def _transmit(self, other: int, message: bytes) -> None:
        self.traffic.bytes += len(message)
        self.transmit(other, message)

    def transmit(self, other: int, message: bytes) -> None:
        """Send bytes to another robot."""
        raise NotImplementedError


Share = Annotated[float, Field(ge=0, le=1)]


@checked
@dataclass(frozen=True)
class Conditions:
    """How messages fare that a robot receives, for trials.

    :param loss: share of messages that are lost
    :param duplicates: share of messages that arrive twice
    :param malformed: share of messages of which a byte is changed
    :param reordered: share of messages that arrive after the next one
    :raises ValueError: if a value is no share
    """

    loss: Share = 0.0
    duplicates: Share = 0.0
    malformed: Share = 0.0
    reordered: Share = 0.0


class Channel:
    """Draws what becomes of messages.

    :param conditions: how they fare
    :param seed: seed of the draws
    """

    def __init__(self, conditions: Conditions, seed: int | Sequence[int] = 0):
        self._conditions, self._rng, self._held = conditions, np.random.default_rng(seed), list[Any]()

    def arriving(self, message: T) -> list[T]:
        """Return what arrives when a message does, in this order. Only bytes can be malformed."""
        shares = self._conditions
        lost, twice, changed, late = self._rng.random(4) < (
            shares.loss,
            shares.duplicates,
            shares.malformed,
            shares.reordered,
        )
        if lost:
            return []
        if changed and isinstance(message, bytes):
            damaged = bytearray(message)
            damaged[self._rng.integers(len(message))] ^= int(self._rng.integers(1, 256))
            message = cast(T, bytes(damaged))
        arrived = [message] * (1 + twice)
        if late and not self._held:
            self._held = arrived
            return []
        arrived, self._held = arrived + self._held, []
        return arrived
