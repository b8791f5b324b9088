"""The process of one robot in a simulated world, on any link.

The world tells it when to fly and what it perceives, and takes its commands; plans travel between the robots alone.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from quad_swarm.realtime.link import Channel, Link, Traffic, Vehicle
from quad_swarm.realtime.loop import Loop, freeze_garbage
from quad_swarm.realtime.supervisor import Mode, Watchdog
from quad_swarm.realtime.team import Team, load
from quad_swarm.world.obstacles import Obstacle

_SAYS_HELLO = 0.2  # s
_GIVES_UP = 15.0  # s without any word of the world
_US = 1_000_000


class Report(NamedTuple):
    """What a robot did in a period.

    :param robot: its number
    :param mode: `quad_swarm.realtime.Mode`
    :param asked: whom it asked, bits by robots
    :param told: whom it sent its plan unasked
    :param arrived: whose plans arrived
    :param plan: positions of its plan, (N + 1, 3), world frame (m)
    """

    robot: int
    mode: int
    asked: int
    told: int
    arrived: int
    plan: np.ndarray


@dataclass(frozen=True)
class Sample:
    """The world after a period.

    :param time: time since the start of the flight (s)
    :param state: true states, (n, 9)
    :param setpoint: last commands, (n, 4)
    :param reports: what the robots reported since the last sample
    """

    time: float
    state: np.ndarray
    setpoint: np.ndarray
    reports: list[Report]


class Hears(Protocol):
    """What the world does with what robots send."""

    def on_command(self, robot: int, setpoint: np.ndarray) -> None:
        """Take a robot's set-point."""

    def on_report(self, report: Report) -> None:
        """Take what a robot did in a period."""

    def on_words(self, words: dict[str, Any]) -> None:
        """Take what a robot said: "hello", or "done"."""


class SimulatedLink(Link, Protocol):
    """A link that trials can disturb, see `quad_swarm.realtime.link.BaseLink`."""

    index: int
    traffic: Traffic
    clock_error: int
    deaf_to: frozenset[int]
    channel: Channel | None

    def own(self, at: int) -> int:
        """Return a time of the clock that all robots share on the robot's own (us)."""


class SimulatedVehicle(Vehicle, Protocol):
    """A vehicle whose world also says when to fly.

    :ivar control: what the world said and nobody has done yet
    :ivar heard: when the world was heard last (us)
    """

    control: list[dict[str, Any]]
    heard: int

    def say(self, **words: Any) -> None:
        """Say something to the world. It may get lost."""

    def report(self, report: Report) -> None:
        """Tell the world what the robot did in a period, for pictures and recordings."""

    def begin(self, words: dict[str, Any]) -> None:
        """Forget the last flight.

        :param words: what the world said of the next
        """


class RobotProcess:
    """Flies one robot as often as the world says so.

    :param team: the team
    :param link: the robot's link
    :param vehicle: the robot's vehicle
    """

    def __init__(self, team: Team, link: SimulatedLink, vehicle: SimulatedVehicle):
        self.link, self.vehicle = link, vehicle
        link.channel = Channel(team.conditions, [team.session, link.index])
        link.clock_error = round(team.clock_errors[link.index] * _US) if team.clock_errors else 0
        self.loop, self.watchdog = prepare(team, link, vehicle)

    def run(self) -> None:
        """Fly until the world says goodbye, or nothing any more."""
        freeze_garbage()
        while not self._is_forsaken():
            self.vehicle.say(says="hello")
            self.link.wait(self.link.now() + round(_SAYS_HELLO * _US), self.loop, lambda: bool(self.vehicle.control))
            while self.vehicle.control:
                words = self.vehicle.control.pop(0)
                if words["says"] == "bye":
                    return
                if words["says"] == "fly":
                    self._fly(words)

    def _fly(self, words: dict[str, Any]) -> None:
        link, loop, vehicle = self.link, self.loop, self.vehicle
        before = replace(link.traffic)
        vehicle.begin(words)
        obstacles = tuple(Obstacle(**one) for one in words["obstacles"])
        first = link.own(words["first"]) + link.clock_error
        loop.start(np.array(words["start"]), np.array(words["goal"]), first, obstacles)
        statistics = loop.run(self._is_ended, self._after_period)
        self.watchdog.beat(armed=False)
        statistics.counts["watchdog"] += self.watchdog.barks
        self.watchdog.barks = 0
        traffic = {name: value - getattr(before, name) for name, value in vars(link.traffic).items()}
        done = {"says": "done", "flight": words["flight"], "statistics": statistics.to_json(), "traffic": traffic}
        # Datagrams may be lost: the world asks again by saying "stop"
        while not self._is_forsaken():
            vehicle.say(**done)
            link.wait(link.now() + round(_SAYS_HELLO * _US), loop, lambda: bool(vehicle.control))
            vehicle.control = [one for one in vehicle.control if one["says"] != "stop"]
            if vehicle.control:
                return

    def _is_ended(self) -> bool:
        control = self.vehicle.control
        while control and control[0]["says"] == "part":
            self.link.deaf_to = frozenset(control.pop(0)["from"])
        return bool(control) or self._is_forsaken()

    def _after_period(self, loop: Loop) -> None:
        self.watchdog.beat(loop.supervisor.mode is not Mode.OFF)
        self.vehicle.report(report_of(loop))

    def _is_forsaken(self) -> bool:
        return self.link.now() - self.vehicle.heard > _GIVES_UP * _US


def prepare(team: Team, link: SimulatedLink, vehicle: Vehicle) -> tuple[Loop, Watchdog]:
    """Return a robot's loop and its watchdog, ready for the first period: everything is compiled and loaded, and the
    process has the team's priority.

    :param team: the team
    :param link: the robot's link
    :param vehicle: the robot's vehicle
    """
    loop = Loop(team.robot(link.index), link, vehicle, team.limits, team.wait, team.late)
    loop.warm_up()
    if not set_priority(team.priority):
        print("no real-time priority: the system does not allow it", file=sys.stderr)
    return loop, Watchdog(vehicle, loop.supervisor.limits)


def report_of(loop: Loop) -> Report:
    """Return what a robot did in its last period."""
    robots = (_bits(loop.asked), _bits(loop.told), _bits(loop.arrived))
    return Report(loop.robot.index, loop.supervisor.mode, *robots, loop.robot.newest.positions)


def set_priority(priority: int) -> bool:
    """Run this process before all others (SCHED_FIFO), also those of its threads that receive for it.

    :param priority: 1 to 99; 0 changes nothing
    :return: whether the system allows it
    """
    if not priority:
        return True
    try:
        for thread in _threads():
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def _threads() -> list[int]:
    """Return the threads of this process, as the system counts them; 0 is this one."""
    try:
        return [int(one) for one in os.listdir("/proc/self/task")]
    except FileNotFoundError:  # not on Linux
        return [0]


@contextlib.contextmanager
def without_priority() -> Iterator[None]:
    """Start processes in the block that do not inherit the real-time priority of this one. While robots import and
    compile, which takes seconds, those with a priority would let nobody else run."""
    policy = os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else None
    if policy is None or policy not in (os.SCHED_FIFO, os.SCHED_RR):
        yield
        return
    parameters = os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Return the parser of a robot's process, see `quad_swarm.realtime.arena.Exchange.process`.

    :param description: description of the process
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("team", type=Path, help="file of the team")
    parser.add_argument("index", type=int, help="number of the robot")
    parser.add_argument("--import", nargs="+", default=[], dest="modules", metavar="MODULE", help="modules to import")
    return parser


def run(args: argparse.Namespace, make: Callable[[Team], tuple[SimulatedLink, SimulatedVehicle]]) -> int:
    """Run the process of a robot.

    :param args: what `make_parser` parsed
    :param make: creates link and vehicle
    :return: exit status
    """
    try:
        for name in args.modules:
            importlib.import_module(name)
        team = load(args.team)
        process = RobotProcess(team, *make(team))
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the world, which ends the robots
    process.run()
    return 0


def _bits(robots: Iterable[int]) -> int:
    return sum(1 << robot for robot in robots)
