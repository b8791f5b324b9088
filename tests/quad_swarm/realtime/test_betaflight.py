"""Betaflight: sticks, messages, and a flight with the firmware itself, where it is installed."""

import importlib.util
import json
import shutil
import socket
import struct
import subprocess
import sys

import betaflight_sitl
import numpy as np
import pytest
from pydantic import ValidationError

from quad_swarm.realtime import Sensed
from quad_swarm.realtime.attitude import Attitude, AttitudeController, AttitudeGains
from quad_swarm.realtime.betaflight import (
    MSP_SET_RAW_RC,
    MSP_STATUS,
    BetaflightVehicle,
    Replies,
    Sticks,
    TcpPort,
    pack,
    to_channels,
)

LEVEL = Attitude(0.0, 0.0, 0.0, 0.5)


def reply(command, payload=b""):
    """What the flight controller sends: a message with the arrow the other way."""
    return pack(command, payload).replace(b"$M<", b"$M>")


def status(armed):
    """Cycle time, errors, sensors, modes, profile."""
    return reply(MSP_STATUS, struct.pack("<HHHIB", 125, 0, 33, 2 | armed, 0))


@pytest.mark.parametrize(
    ("attitude", "yaw_rate", "channels"),
    [
        (LEVEL, 0.0, [1500, 1500, 1525, 1500]),
        (LEVEL._replace(roll=np.radians(25)), 0.0, [1750, 1500, 1525, 1500]),
        (LEVEL._replace(pitch=np.radians(-10)), 0.0, [1500, 1400, 1525, 1500]),
        (LEVEL, np.radians(100), [1500, 1500, 1525, 1250]),
        (LEVEL._replace(thrust=0.0), 0.0, [1500, 1500, 1050, 1500]),
        (Attitude(9.0, -9.0, 2.0, 1.0), -9.0, [2000, 1000, 2000, 2000]),
    ],
)
def test_sticks(attitude, yaw_rate, channels):
    assert to_channels(attitude, yaw_rate, True, Sticks()) == [*channels, 2000, 2000]
    channels[2] = 1000
    assert to_channels(attitude, yaw_rate, False, Sticks()) == [*channels, 1000, 2000]


def test_settings_say_what_full_sticks_mean():
    lines = Sticks(angle_limit=30, yaw_rate=360, min_check=1100).settings()
    assert {"set angle_limit = 30", "set yaw_rc_rate = 36", "set yaw_srate = 36", "set min_check = 1100"} <= set(lines)


@pytest.mark.parametrize("wrong", [{"angle_limit": 90}, {"yaw_rate": 205}, {"yaw_rate": 0}, {"min_check": 900}])
def test_sticks_that_the_firmware_cannot_have(wrong):
    with pytest.raises((ValidationError, ValueError), match=next(iter(wrong))):
        Sticks(**wrong)


def test_messages():
    assert pack(MSP_STATUS) == b"$M<\x00\x65\x65"
    assert pack(MSP_SET_RAW_RC, b"\xdc\x05") == b"$M<\x02\xc8\xdc\x05\x13"


def test_replies_come_in_pieces_and_with_noise():
    replies = Replies()
    damaged = bytearray(reply(7, b"seven"))
    damaged[6] ^= 1
    stream = b"noise$M$" + reply(1, b"$M>") + bytes(damaged) + b"$M!\x00\x08\x08" + reply(2) + reply(3, bytes(255))
    found = [one for k in range(len(stream)) for one in replies.feed(stream[k : k + 1])]
    assert found == [(1, b"$M>"), (2, b""), (3, bytes(255))]
    assert Replies().feed(stream) == found


@pytest.mark.parametrize("seed", range(5))
def test_bytes_that_are_no_message_are_nothing(seed):
    replies, rng = Replies(), np.random.default_rng(seed)
    for _ in range(200):
        replies.feed(b"$M>" + rng.bytes(int(rng.integers(0, 400))))
    replies.feed(bytes(300))
    assert replies.feed(status(True))[0][0] == MSP_STATUS


class Controller:
    """A port whose other end is a flight controller."""

    def __init__(self):
        self.sent, self.arriving = [], b""

    def send(self, data):
        sticks, asks = data[:-6], data[-6:]
        assert asks == pack(MSP_STATUS)
        assert sticks == pack(MSP_SET_RAW_RC, sticks[5:-1])
        self.sent.append(struct.unpack("<6H", sticks[5:-1]))

    def receive(self):
        data, self.arriving = self.arriving, b""
        return data


def flown(yaw=0.0, climb=0.0):
    """A vehicle that has perceived something, and its flight controller."""
    port, state = Controller(), np.array([0, 0, 1.5, 0, 0, climb, 0, 0, yaw])
    sensed = Sensed(7, state, np.zeros((1, 3)), np.zeros((1, 3)))
    vehicle = BetaflightVehicle(
        port, lambda: sensed, AttitudeController(AttitudeGains(hover_thrust=0.4)), now=lambda: 7
    )
    assert vehicle.sense() is sensed
    return vehicle, port


def test_a_vehicle_holds_climb_rate_and_heading():
    vehicle, port = flown()
    vehicle.command(np.zeros(4), None)
    assert port.sent == [(1500, 1500, 1430, 1500, 2000, 2000)]
    for (yaw, climb), compare in {(0.2, 0.1): int.__lt__, (-0.2, -0.1): int.__gt__}.items():
        vehicle, port = flown(yaw, climb)
        vehicle.command(np.zeros(4), None)
        assert compare(port.sent[0][2], 1430), "less thrust where it climbs"
        assert compare(1500, port.sent[0][3]), "it turns back, clockwise from above with the stick to the right"


def test_the_shorter_way_around():
    vehicle, port = flown(yaw=3.0)
    vehicle.controller.yaw = -3.0
    vehicle.command(np.zeros(4), None)
    assert port.sent[0][3] == 1500 - round(500 * np.degrees(2 * (2 * np.pi - 6)) / 200)


def test_arming():
    vehicle, port = flown()
    vehicle.disarm()
    vehicle.arm()
    assert port.sent == [(1500, 1500, 1000, 1500, 1000, 2000), (1500, 1500, 1000, 1500, 2000, 2000)]
    for armed in (True, False):
        port.arriving = status(armed)
        vehicle.sense()
        assert vehicle.armed is armed
    port.arriving = reply(MSP_STATUS, b"short")
    vehicle.sense()


def test_where_nobody_sees_the_robot_nothing_is_perceived():
    vehicle, _ = flown()
    vehicle._sensed = lambda: None
    assert vehicle.sense() is None


def test_a_flight_controller_over_tcp():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = TcpPort(server.getsockname())
        line, _ = server.accept()
        with line:
            assert port.receive() == b""
            line.sendall(status(True))
            received = b""
            while received != status(True):
                received += port.receive()
            port.send(b"sticks")
            assert line.recv(100) == b"sticks"
            with pytest.raises(BlockingIOError):  # a loop does not wait for who does not read
                port.send(bytes(100_000_000))
        port.close()


@pytest.mark.slow
def test_the_firmware_flies_a_robot(tmp_path):
    """In namespaces of its own: the firmware listens on all interfaces, and ends with the script."""
    alone = ["unshare", "--map-root-user", "--net", "--pid", "--fork", "--kill-child"]
    alone += ["sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    if betaflight_sitl.executable() is None or importlib.util.find_spec("rotorpy") is None:
        pytest.skip("Betaflight's simulator or RotorPy is not installed")
    if shutil.which("cc") is None or shutil.which("ip") is None:
        pytest.skip("no C compiler, or no ip")
    if subprocess.run([*alone, "true"], capture_output=True).returncode:
        pytest.skip("no network namespaces here")
    done = subprocess.run(
        [*alone, sys.executable, betaflight_sitl.__file__], cwd=tmp_path, capture_output=True, text=True, timeout=590
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert max(told["armed_0"], told["armed_1"]) < 1.0
    assert told["up"] < 5.0
    assert told["roll"][0] == pytest.approx(10, abs=0.5)
    assert told["pitch"][1] == pytest.approx(-10, abs=0.5)
    assert told["yaw"][2] == pytest.approx(30, abs=5)
    distances = told["distances"]
    assert distances[0] > 2.0
    assert max(distances[len(distances) // 2 :]) < 0.1, "it arrives, and holds"
    assert told["heading"] == pytest.approx(0.525, abs=0.05), "what the robot had turned to"
    assert not [name for name in told["counts"] if name.startswith("errors")]
    assert told["flew"]
    assert told["falls"] < 1.0, "without sticks, the throttle is closed"
    assert 1.0 < told["off"] < 3.0, "and then the motors stop"
    assert told["motors"] == [0, 0, 0, 0]
