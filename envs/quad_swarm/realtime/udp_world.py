"""A simulated world and its robots over UDP on this machine: the world's end and the robots'."""

from __future__ import annotations

import contextlib
import json
import select
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.quadrotor import N_STATES
from quad_swarm.realtime.link import Handler, Sensed, monotonic
from quad_swarm.realtime.process import Hears, Report
from quad_swarm.realtime.udp import Address, UdpLink, open_socket
from quad_swarm.robot import Plan

# Kind and time of the day (us); the numbers of a state follow
SENSED = struct.Struct("<Bq")
# Kind, robot and set-point
COMMAND = struct.Struct("<BB4d")
# Kind, robot, mode, whom it asked, whom it told, whose plans arrived (bits by robots); the plan follows
REPORT = struct.Struct("<BBB3Q")
IS_SENSED, IS_COMMAND, IS_REPORT = 1, 2, 3
_MOST_BYTES = 65535
_US = 1_000_000


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
    _, robot, mode, asked, told, arrived = REPORT.unpack_from(message)
    return Report(robot, mode, asked, told, arrived, plan.astype(float))


class UdpVehicle:
    """A robot's vehicle in a simulated world, see `SimulatedVehicle`.

    :param link: the robot's link, which receives for the vehicle, too
    :param world: address of the world
    :param n_others: number of other robots
    """

    def __init__(self, link: UdpLink, world: Address, n_others: int):
        self._link, self._world, self._n_others = link, world, n_others
        self._socket = open_socket(link.address[0], 0)
        self.address: Address = self._socket.getsockname()
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

    def report(self, report: Report) -> None:
        """See `SimulatedVehicle`."""
        self._socket.sendto(pack_report(report), self._world)

    def say(self, **words: Any) -> None:
        """See `SimulatedVehicle`."""
        words |= {"robot": self._link.index, "port": self._link.address[1]}
        self._socket.sendto(json.dumps(words).encode(), self._world)

    def begin(self, words: dict[str, Any]) -> None:
        """See `SimulatedVehicle`."""
        self.sensed = None
        self._link.addresses = {k: ("127.0.0.1", port) for k, port in enumerate(words["ports"])}

    def _take(self, message: bytes, handler: Handler) -> None:
        with contextlib.suppress(ValueError, KeyError, struct.error):  # of strangers
            self._understand(message)

    def _understand(self, message: bytes) -> None:
        if message[:1] == b"{":
            words = json.loads(message)
            if isinstance(words.get("says"), str):
                self.heard = self._link.now()
                self.control.append(words)
        elif message[:1] == bytes([IS_SENSED]):
            sensed = unpack_sensed(message, self._n_others)
            self.heard = self._link.now()
            sensed = sensed._replace(stamp=self._link.own(sensed.stamp) + self._link.clock_error)
            if self.sensed is None or sensed.stamp > self.sensed.stamp:
                self.sensed = sensed


class UdpWorld:
    """The world's end, see `quad_swarm.realtime.arena.Exchange`."""

    def __init__(self) -> None:
        self._socket = open_socket("127.0.0.1", 0)
        self._addresses: dict[int, Address] = {}  # of the robots' vehicles
        self._ports: dict[int, int] = {}  # of their links

    def process(self, team: Path, robot: int) -> list[str]:
        """See `Exchange`."""
        host, port = self._socket.getsockname()
        return [sys.executable, "-m", "quad_swarm.realtime.udp_process", str(team), str(robot), f"{host}:{port}"]

    def tell(self, robot: int, sensed: Sensed) -> None:
        """See `Exchange`."""
        self._send(robot, pack_sensed(sensed))

    def say(self, robot: int, **words: Any) -> None:
        """See `Exchange`."""
        if words["says"] == "fly":
            words["ports"] = [self._ports[k] for k in sorted(self._ports)]
        self._send(robot, json.dumps(words).encode())

    def receive(self, until: int, hears: Hears) -> None:
        """See `Exchange`."""
        while True:
            left = max(until - monotonic(), 0)
            if select.select([self._socket], [], [], left / _US)[0]:
                with contextlib.suppress(OSError, ValueError, KeyError, TypeError, struct.error):  # of strangers
                    self._take(*self._socket.recvfrom(_MOST_BYTES), hears)
            elif left == 0:
                return

    def close(self) -> None:
        """See `Exchange`."""
        self._socket.close()

    def _take(self, message: bytes, sender: Address, hears: Hears) -> None:
        kind = message[:1]
        if kind == bytes([IS_COMMAND]) and len(message) == COMMAND.size:
            _, robot, *setpoint = COMMAND.unpack(message)
            hears.on_command(robot, np.array(setpoint))
        elif kind == bytes([IS_REPORT]):
            hears.on_report(unpack_report(message))
        elif kind == b"{":
            words = json.loads(message)
            self._addresses[words["robot"]], self._ports[words["robot"]] = sender, words["port"]
            hears.on_words(words)

    def _send(self, robot: int, message: bytes) -> None:
        with contextlib.suppress(OSError, KeyError):  # a robot whose process ended, or has not begun
            self._socket.sendto(message, self._addresses[robot])
