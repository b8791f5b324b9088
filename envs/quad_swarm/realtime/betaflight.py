"""A flight controller with Betaflight, flown in angle mode over MSP. **Not tested on hardware.**

Sticks go over Betaflight's serial protocol (``MSP_SET_RAW_RC``). When they end, the firmware's failsafe takes over.
Betaflight has no estimate of its position: what a robot perceives comes from outside, such as motion capture.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from quad_swarm.quadrotor import N_STATES
from quad_swarm.realtime.attitude import Attitude, AttitudeController
from quad_swarm.realtime.link import Sensed, monotonic
from quad_swarm.realtime.mavlink import Port
from quad_swarm.robot import Plan
from quad_swarm.validation import checked

MSP_STATUS = 101
MSP_SET_RAW_RC = 200
_LOW, _MIDDLE, _HIGH = 1000, 1500, 2000  # us
_LARGEST = 255  # bytes of a message
_US = 1e-6


@checked
@dataclass(frozen=True)
class Sticks:
    """What full sticks mean. `settings` are the firmware's settings that make it so.

    :param angle_limit: roll or pitch of a full stick (degrees), Betaflight's ``angle_limit``
    :param yaw_rate: yaw rate of a full stick (degrees per second, in tens)
    :param min_check: throttle channel below which motors idle (us), Betaflight's ``min_check``
    :raises ValueError: if a value is out of range
    """

    angle_limit: Annotated[int, Field(ge=10, le=80)] = 50
    yaw_rate: Annotated[int, Field(ge=10, le=1000, multiple_of=10)] = 200
    min_check: Annotated[int, Field(ge=1000, le=1500)] = 1050

    def settings(self) -> list[str]:
        """Return the lines to paste into Betaflight's command line before ``save``. AUX1 arms, AUX2 is angle mode."""
        linear = [f"set {axis}_expo = 0" for axis in ("roll", "pitch", "yaw")]
        for axis in ("roll", "pitch", "yaw"):
            linear += [f"set {axis}_rc_rate = {self.yaw_rate // 10}", f"set {axis}_srate = {self.yaw_rate // 10}"]
        return [
            "map AETR1234",
            "aux 0 0 0 1700 2100 0 0",
            "aux 1 1 1 1700 2100 0 0",
            f"set min_check = {self.min_check}",
            f"set angle_limit = {self.angle_limit}",
            "set rates_type = ACTUAL",
            *linear,
            "set thr_expo = 0",
            "set deadband = 0",
            "set yaw_deadband = 0",
        ]


def to_channels(attitude: Attitude, yaw_rate: float, armed: bool, sticks: Sticks) -> list[int]:
    """Return the channels roll, pitch, throttle, yaw, AUX1 and AUX2, each 1000 to 2000 us.

    :param attitude: roll and pitch (rad), which follow the sticks' directions, and thrust, 0 to 1; the yaw is not used
    :param yaw_rate: yaw rate (rad/s), counter-clockwise from above, against the stick's direction
    :param armed: whether the motors may run
    :param sticks: what full sticks mean
    """
    tilt = np.degrees([attitude.roll, attitude.pitch]) / sticks.angle_limit
    deflections = np.clip([*tilt, -np.degrees(yaw_rate) / sticks.yaw_rate], -1.0, 1.0)
    roll, pitch, yaw = (round(_MIDDLE + 500 * float(one)) for one in deflections)
    throttle = round(sticks.min_check + (_HIGH - sticks.min_check) * float(np.clip(attitude.thrust, 0.0, 1.0)))
    return [roll, pitch, throttle if armed else _LOW, yaw, _HIGH if armed else _LOW, _HIGH]


def pack(command: int, payload: bytes = b"") -> bytes:
    """Return a message of MSP's first version to a flight controller.

    :param command: number of the command
    :param payload: its content, at most 255 bytes
    """
    body = bytes([len(payload), command]) + payload
    return b"$M<" + body + bytes([_checksum(body)])


def _checksum(body: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))


class Replies:
    """Finds a flight controller's messages in bytes."""

    def __init__(self) -> None:
        self._bytes = b""

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the command and the payload of each message that is complete. What is none is skipped.

        :param data: bytes that arrived
        """
        self._bytes += data
        found = []
        while (start := self._bytes.find(b"$M>")) >= 0:
            self._bytes = self._bytes[start:]
            if len(self._bytes) < 5 or len(self._bytes) < (end := 6 + self._bytes[3]):
                break
            body, checksum = self._bytes[3 : end - 1], self._bytes[end - 1]
            if _checksum(body) == checksum:
                found.append((body[1], body[2:]))
                self._bytes = self._bytes[end:]
            else:
                self._bytes = self._bytes[3:]
        self._bytes = self._bytes[-_LARGEST - 6 :]
        return found


class TcpPort:
    """A port over TCP: Betaflight's simulator, or a serial line that another program serves.

    :param address: where to connect, such as ("127.0.0.1", 5761)
    :param timeout: longest time to wait for that (s)
    :raises OSError: if nobody is there
    """

    def __init__(self, address: tuple[str, int], timeout: float = 5.0):
        self._socket = socket.create_connection(address, timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        """See `Port`. It raises an error rather than wait for somebody who does not read."""
        self._socket.sendall(data)

    def receive(self) -> bytes:
        """See `Port`."""
        with contextlib.suppress(BlockingIOError):
            return self._socket.recv(65535)
        return b""

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class BetaflightVehicle:
    """A robot's vehicle, see `quad_swarm.realtime.Vehicle`.

    :ivar armed: whether the firmware says that the motors run

    :param port: the way to the flight controller; for a serial line, an object that sends and receives bytes
    :param sensed: what is perceived, such as by motion capture; None where nobody sees the robot
    :param controller: attitude and thrust for set-points
    :param sticks: what full sticks mean
    :param heading: yaw rate for an error of the heading (1/s): the firmware knows yaw rates only
    :param now: the robot's clock (us)
    """

    def __init__(
        self,
        port: Port,
        sensed: Callable[[], Sensed | None],
        controller: AttitudeController | None = None,
        sticks: Sticks | None = None,
        heading: float = 2.0,
        now: Callable[[], int] = monotonic,
    ):
        self._port, self._sensed, self._now = port, sensed, now
        self.controller, self.sticks, self._heading = controller or AttitudeController(), sticks or Sticks(), heading
        self._replies, self._lock = Replies(), threading.RLock()
        self._state = np.zeros(N_STATES)
        self._commanded = now()
        self.armed = False

    def sense(self) -> Sensed | None:
        """See `Vehicle`."""
        with self._lock:
            for command, payload in self._replies.feed(self._port.receive()):
                if command == MSP_STATUS and len(payload) >= 10:
                    self.armed = bool(struct.unpack_from("<I", payload, 6)[0] & 1)  # flags of modes, the first is ARM
            sensed = self._sensed()
            if sensed is not None:
                self._state = np.array(sensed.state, float)
            return sensed

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `Vehicle`."""
        with self._lock:
            now = self._now()
            attitude = self.controller(self._state, setpoint, (now - self._commanded) * _US)
            self._commanded = now
            error = attitude.yaw - float(self._state[8])
            error = float(np.arctan2(np.sin(error), np.cos(error)))
            yaw_rate = float(setpoint[3]) + self._heading * error
            self._send(to_channels(attitude, yaw_rate, True, self.sticks))

    def arm(self) -> None:
        """Hold the sticks as the firmware wants them to start the motors. Call it every period until `armed`, and
        `disarm` for a second before, since the firmware wants to have seen the switch off."""
        self._send([_MIDDLE, _MIDDLE, _LOW, _MIDDLE, _HIGH, _HIGH])

    def disarm(self) -> None:
        """See `Vehicle`. Without more commands, the firmware's failsafe does the same later."""
        self._send([_MIDDLE, _MIDDLE, _LOW, _MIDDLE, _LOW, _HIGH])

    def _send(self, channels: Sequence[int]) -> None:
        with self._lock:
            sticks = pack(MSP_SET_RAW_RC, struct.pack(f"<{len(channels)}H", *channels))
            self._port.send(sticks + pack(MSP_STATUS))
