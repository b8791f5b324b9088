"""The process of one robot in a simulated world: ``python -m quad_swarm.realtime.process TEAM.json INDEX HOST:PORT``.

The world tells it when to fly and what it perceives, and takes its commands; plans travel between the robots alone.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.quadrotor import N_STATES
from quad_swarm.realtime import team
from quad_swarm.realtime.link import Channel, Handler, Sensed
from quad_swarm.realtime.loop import Loop, freeze_garbage
from quad_swarm.realtime.supervisor import Watchdog
from quad_swarm.realtime.udp import Address, UdpLink, open_socket
from quad_swarm.robot import Plan

# Kind and time of the day (us); the numbers of a state follow
SENSED = struct.Struct("<Bq")
# Kind, robot and set-point
COMMAND = struct.Struct("<BB4d")
# Kind, robot, mode, whom it asked, whom it told, whose plans arrived (bits by robots); the plan follows
REPORT = struct.Struct("<BBB3Q")
IS_SENSED, IS_COMMAND, IS_REPORT = 1, 2, 3
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


def pack_sensed(sensed: Sensed) -> bytes:
    """Pack what a robot perceives, with a time of the day."""
    return SENSED.pack(IS_SENSED, sensed.stamp) + np.concatenate([one.ravel() for one in sensed[1:]]).tobytes()


def unpack_sensed(message: bytes, n_others: int) -> Sensed:
    """Unpack `pack_sensed`.

    :raises ValueError: if it is another message
    """
    numbers = np.frombuffer(message, float, offset=SENSED.size)
    if len(numbers) != N_STATES + 6 * n_others:
        raise ValueError(f"{len(numbers)} numbers are no state with {n_others} others")
    own, pos, vel = np.split(numbers, (N_STATES, N_STATES + 3 * n_others))
    return Sensed(SENSED.unpack_from(message)[1], own, pos.reshape(-1, 3), vel.reshape(-1, 3))


def pack_report(report: Report) -> bytes:
    """Pack what a robot did."""
    return REPORT.pack(IS_REPORT, *report[:5]) + report.plan.astype(np.float32).tobytes()


def unpack_report(message: bytes) -> Report:
    """Unpack `pack_report`.

    :raises ValueError: if it is another message
    """
    if len(message) < REPORT.size or (len(message) - REPORT.size) % 12:
        raise ValueError(f"{len(message)} bytes are no report")
    plan = np.frombuffer(message, np.float32, offset=REPORT.size).reshape(-1, 3)
    return Report(*REPORT.unpack_from(message)[1:], plan.astype(float))


class SimulatedVehicle:
    """A robot's vehicle in a simulated world.

    :ivar control: what the world said and nobody has done yet
    :ivar heard: when the world was heard last (us)

    :param link: the robot's link, which receives for the vehicle, too
    :param world: address of the world
    :param n_others: number of other robots
    """

    def __init__(self, link: UdpLink, world: Address, n_others: int):
        self._link, self._world, self._n_others = link, world, n_others
        self._socket = open_socket(link.address[0], 0)
        link.watch(self._socket, self._take)
        self.control: list[dict[str, Any]] = []
        self.heard = link.now()
        self.sensed: Sensed | None = None

    def sense(self) -> Sensed | None:
        """See `quad_swarm.realtime.Vehicle`."""
        return self.sensed

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        self._socket.sendto(COMMAND.pack(IS_COMMAND, self._link.index, *setpoint), self._world)

    def disarm(self) -> None:
        """See `quad_swarm.realtime.Vehicle`. The world stops the motors of what lies on the ground."""

    def report(self, loop: Loop) -> None:
        """Tell the world what the robot did in a period, for pictures and recordings."""
        words = (_bits(loop.asked), _bits(loop.told), _bits(loop.arrived))
        report = Report(self._link.index, loop.supervisor.mode, *words, loop.robot.newest.positions)
        self._socket.sendto(pack_report(report), self._world)

    def say(self, **words: Any) -> None:
        """Say something to the world."""
        self._socket.sendto(json.dumps({**words, "robot": self._link.index}).encode(), self._world)

    def _take(self, message: bytes, handler: Handler) -> None:
        self.heard = self._link.now()
        if message[:1] == b"{":
            self.control.append(json.loads(message))
        elif message[:1] == bytes([IS_SENSED]):
            sensed = unpack_sensed(message, self._n_others)
            sensed = sensed._replace(stamp=self._link.own(sensed.stamp) + self._link.clock_error)
            if self.sensed is None or sensed.stamp > self.sensed.stamp:
                self.sensed = sensed


def _bits(robots: Iterable[int]) -> int:
    return sum(1 << robot for robot in robots)


class RobotProcess:
    """Flies one robot as often as the world says so.

    :param flown: the team
    :param index: number of the robot
    :param world: address of the world
    """

    def __init__(self, flown: team.Team, index: int, world: Address):
        robot = flown.robot(index)
        channel = Channel(flown.conditions, [flown.session, index])
        self.link = UdpLink(index, group=flown.group, session=flown.session, checked=flown.checked, channel=channel)
        self.link.clock_error = round(flown.clock_errors[index] * _US) if flown.clock_errors else 0
        self.vehicle = SimulatedVehicle(self.link, world, robot.config.n_others)
        self.loop = Loop(robot, self.link, self.vehicle, flown.limits, flown.wait, flown.late)
        self.watchdog = Watchdog(self.vehicle, flown.limits)
        self.loop.warm_up()

    def run(self) -> None:
        """Fly until the world says goodbye, or nothing any more."""
        freeze_garbage()
        while not self._is_forsaken():
            self.vehicle.say(says="hello", port=self.link.address[1])
            self.link.wait(self.link.now() + round(_SAYS_HELLO * _US), self.loop, lambda: bool(self.vehicle.control))
            while self.vehicle.control:
                words = self.vehicle.control.pop(0)
                if words["says"] == "bye":
                    return
                if words["says"] == "fly":
                    self._fly(words)

    def _fly(self, words: dict[str, Any]) -> None:
        index, link, loop, vehicle = self.link.index, self.link, self.loop, self.vehicle
        link.addresses = {k: ("127.0.0.1", port) for k, port in enumerate(words["ports"]) if k != index}
        before = replace(link.traffic)
        vehicle.sensed = None
        loop.start(np.array(words["start"]), np.array(words["goal"]), link.own(words["first"]) + link.clock_error)
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
        self.watchdog.beat()
        self.vehicle.report(loop)

    def _is_forsaken(self) -> bool:
        return self.link.now() - self.vehicle.heard > _GIVES_UP * _US


def set_priority(priority: int) -> bool:
    """Run this process before all others (SCHED_FIFO).

    :param priority: 1 to 99; 0 changes nothing
    :return: whether the system allows it
    """
    if not priority:
        return True
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def main() -> int:
    """Run the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("team", help="file of the team")
    parser.add_argument("index", type=int, help="number of the robot")
    parser.add_argument("world", help="address of the world, HOST:PORT")
    args = parser.parse_args()
    host, _, port = args.world.rpartition(":")
    try:
        flown = team.load(args.team)
        process = RobotProcess(flown, args.index, (host, int(port)))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not set_priority(flown.priority):
        print(f"robot {args.index}: no real-time priority, since the system does not allow it", file=sys.stderr)
    process.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
