"""An autopilot that speaks MAVLink and flies attitudes offboard, as PX4 does. **Not tested on hardware.**

Frames: robots have x forward, y left, z up, and a world with z up, whose x axis is taken for east and y for north;
MAVLink has x forward, y right, z down, and north, east, down.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from quad_swarm.geometry import to_frd, to_ned, to_quaternion
from quad_swarm.quadrotor import N_STATES, POSITION, VELOCITY
from quad_swarm.realtime.attitude import Attitude, AttitudeController
from quad_swarm.realtime.link import Sensed, monotonic, sensed_together
from quad_swarm.robot import Plan

# When positions and velocities of the others were so (us), and these, (n - 1, 3) each
Others = Callable[[], tuple[int, np.ndarray, np.ndarray] | None]
_OFFBOARD = 6  # PX4's custom main mode
_CUSTOM = 1  # flag of the base mode
_IGNORE_RATES = 0b111
_US = 1e-6
OFFBOARD_AFTER = 1_500_000  # us of set-points before PX4 is told to fly them: it wants to have had some for a second
_REBOOTED = 1000  # ms by which the autopilot's time goes back if it was switched on again
_DRIFT = 2e-4  # by which its clock may be slower


class Port(Protocol):
    """The way to an autopilot."""

    def send(self, data: bytes) -> None:
        """Send bytes."""

    def receive(self) -> bytes:
        """Return the bytes that arrived, none if there are none."""


class UdpPort:
    """A port over UDP.

    :param local: address to receive at, such as ("127.0.0.1", 14540)
    """

    def __init__(self, local: tuple[str, int]):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(local)
        self._socket.setblocking(False)
        self._autopilot: Any = None

    def send(self, data: bytes) -> None:
        """See `Port`. Nothing is sent before the autopilot has been heard."""
        if self._autopilot is not None:
            self._socket.sendto(data, self._autopilot)

    def receive(self) -> bytes:
        """See `Port`."""
        received = []
        with contextlib.suppress(BlockingIOError):
            while True:
                data, self._autopilot = self._socket.recvfrom(65535)
                received.append(data)
        return b"".join(received)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class MavlinkVehicle:
    """A robot's vehicle, see `quad_swarm.realtime.Vehicle`. It needs ``LOCAL_POSITION_NED`` and ``ATTITUDE`` of the
    autopilot, at the rate of the periods or faster. The stamps are those of the autopilot's clock, whose offset is
    taken from the messages that arrived soonest.

    `arm`, `engage`, and send set-points: it goes offboard after 1.5 s of them. Until it does, the controller forgets
    what its integral would make up for, and holds the heading that the vehicle has.

    :ivar armed: whether the autopilot says that the motors run
    :ivar offboard: whether it says that it flies our set-points

    :param port: the way to the autopilot
    :param others: where the other robots are, such as from motion capture
    :param controller: attitude and thrust for set-points
    :param now: the robot's clock (us)
    :param system: number of the autopilot
    :param latency: time that a state takes at least from its measurement until it is here (s)
    :raises ImportError: if pymavlink is not installed
    """

    def __init__(
        self,
        port: Port,
        others: Others,
        controller: AttitudeController | None = None,
        now: Callable[[], int] = monotonic,
        system: int = 1,
        latency: float = 0.0,
    ):
        try:
            from pymavlink.dialects.v20 import common
        except ImportError:
            raise ImportError("MAVLink needs pymavlink: pip install 'sb3-maddpg[mavlink]'.") from None
        self._common, self._port, self._others, self._now = common, port, others, now
        self.controller = controller or AttitudeController()
        self._mav = common.MAVLink(None, srcSystem=system, srcComponent=common.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._mav.robust_parsing = True  # bytes that are no message are skipped
        self._system, self._lock = system, threading.RLock()
        self._state = np.zeros(N_STATES)
        self._moved = self._turned = -1  # when position and attitude were so
        self._latency, self._offset, self._booted = round(latency / _US), 0.0, -1  # of its clock, and its newest time
        self._offset_at = 0
        self._offboard_at: int | None = None
        self._commanded = now()
        self.armed = self.offboard = False

    def sense(self) -> Sensed | None:
        """See `Vehicle`. The older of position and attitude counts, or the others' time if they are 0.2 s older."""
        with self._lock:
            for message in self._mav.parse_buffer(self._port.receive()) or ():
                self._take(message)
            others = self._others()
            if min(self._moved, self._turned) < 0 or others is None:
                return None
            pos, vel = np.asarray(others[1], float), np.asarray(others[2], float)
            stamps = np.full(len(pos), others[0])
            return sensed_together(min(self._moved, self._turned), self._state.copy(), stamps, pos, vel)

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `Vehicle`."""
        with self._lock:
            now = self._now()
            if self._offboard_at is not None and now >= self._offboard_at:
                self._offboard_at = None
                self.begin_offboard()
            if not self.offboard:
                self.controller.reset(float(self._state[8]))
            attitude = self.controller(self._state, setpoint, (now - self._commanded) * _US)
            self._commanded = now
            self._send_attitude(attitude)

    def disarm(self) -> None:
        """See `Vehicle`."""
        self._command(self._common.MAV_CMD_COMPONENT_ARM_DISARM, 0)

    def arm(self) -> None:
        """Ask the autopilot to start the motors."""
        self._command(self._common.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def engage(self) -> None:
        """Go offboard after 1.5 s of set-points."""
        self._offboard_at = self._now() + OFFBOARD_AFTER

    def begin_offboard(self) -> None:
        """Ask the autopilot to fly our set-points. PX4 wants to have had some for a second before."""
        self._command(self._common.MAV_CMD_DO_SET_MODE, _CUSTOM, _OFFBOARD)

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        if kind != "BAD_DATA" and message.get_srcSystem() != self._system:
            return
        if kind == "LOCAL_POSITION_NED":
            values = np.array([message.x, message.y, message.z, message.vx, message.vy, message.vz])
            if np.isfinite(values).all():
                self._state[POSITION], self._state[VELOCITY] = to_ned(values[:3]), to_ned(values[3:])
                self._moved = self._own(message.time_boot_ms)
        elif kind == "ATTITUDE":
            values = np.array([message.roll, message.pitch, message.yaw])
            if np.isfinite(values).all():
                self._state[6:9] = to_frd(values)
                self._turned = self._own(message.time_boot_ms)
        elif kind == "HEARTBEAT":
            self.armed = bool(message.base_mode & self._common.MAV_MODE_FLAG_SAFETY_ARMED)
            self.offboard = message.custom_mode >> 16 & 0xFF == _OFFBOARD

    def _own(self, booted: int) -> int:
        """Return a time of the autopilot's clock (ms) on the robot's (us)."""
        now = self._now()
        offset, before = now - 1000 * booted, self._offset + _DRIFT * (now - self._offset_at)
        is_new = self._booted < 0 or booted < self._booted - _REBOOTED
        self._offset = offset if is_new else min(offset, before)
        self._booted, self._offset_at = booted if is_new else max(booted, self._booted), now
        return round(1000 * booted + self._offset) - self._latency

    def _send_attitude(self, attitude: Attitude) -> None:
        q = np.roll(to_quaternion(to_frd(np.array(attitude[:3]))), 1).tolist()  # w comes first
        milliseconds = self._now() // 1000 % 2**32
        target = (self._system, self._common.MAV_COMP_ID_AUTOPILOT1)
        message = self._mav.set_attitude_target_encode(
            milliseconds, *target, _IGNORE_RATES, q, 0.0, 0.0, 0.0, attitude.thrust
        )
        self._port.send(message.pack(self._mav))

    def _command(self, command: int, *parameters: float) -> None:
        with self._lock:
            values = [*map(float, parameters), *[0.0] * (7 - len(parameters))]
            target = (self._system, self._common.MAV_COMP_ID_AUTOPILOT1)
            message = self._mav.command_long_encode(*target, command, 0, *values)
            self._port.send(message.pack(self._mav))
