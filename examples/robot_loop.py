"""The process of one robot, with a vehicle class of your own: what you write to fly your robots over UDP.

`MyVehicle` is what you replace, with `STARTS` and `GOALS`: it says what a robot perceives, and takes its set-points.
Here it simulates, and a file that all processes share (--shared) stands for motion capture. On robot 1 of two, which is
in the air, flies a policy that `sb3-maddpg export` wrote, and begins when all do:

    python robot_loop.py --index 1 --addresses 10.0.0.13:14650 10.0.0.15:14650 --files robots --begins 1764370800000000

It holds its start until then, and lands when its time is over, and at Ctrl-C; a second one ends it in the air. Without
`--index`, it starts two robots on this machine, which fly past each other.
"""

import argparse
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from quad_swarm.quadrotor import POSITION, VELOCITY, QuadrotorModel
from quad_swarm.realtime import Loop, Mode, SafetyLimits, Sensed, Watchdog
from quad_swarm.realtime.link import monotonic
from quad_swarm.realtime.loop import freeze_garbage
from quad_swarm.realtime.udp import UdpLink
from quad_swarm.robot import Robot, RulePolicy, files
from quad_swarm.world.presets import make_config

# Where the robots hover before, and fly to, a row for each in the order of their numbers (m)
STARTS, GOALS = np.array([[-2.0, 0, 1.5], [2.0, 0.1, 1.5]]), np.array([[2.0, 0, 1.5], [-2.0, 0, 1.5]])


class MyVehicle:
    """A simulated vehicle, which flies the last set-point until the next one."""

    def __init__(self, index, config, shared):
        self.index, self.model, self.setpoint = index, QuadrotorModel(config.quadrotor, 0.01), np.zeros(4)
        self.states = np.memmap(shared, float, "r+", shape=(config.n_robots, 9))
        self.stamp, self.flies = monotonic(), True
        threading.Thread(target=self.simulate, daemon=True).start()

    def simulate(self):
        while self.flies:
            while self.stamp + 10_000 < monotonic():
                self.states[self.index] = self.model.step(self.states[None, self.index], self.setpoint[None])[0]
                self.stamp += 10_000
            time.sleep(0.002)

    def sense(self):
        """Return when it was so (us, on this robot's clock), the own state, and where the others are and fly to."""
        stamp, states = self.stamp, np.array(self.states)
        others = np.delete(states, self.index, axis=0)
        return Sensed(stamp, states[self.index], others[:, POSITION], others[:, VELOCITY])

    def command(self, setpoint, plan):
        """Fly a set-point: roll, pitch (rad), climb rate (m/s), yaw rate (rad/s)."""
        self.setpoint = setpoint

    def disarm(self):
        """Stop the motors."""
        self.flies = False


def with_rule(index, n_robots):
    """Return a robot that asks those whom it would come close to."""
    return Robot(make_config("flight-v2", n_robots=n_robots), index, RulePolicy("cpa:1.1s:2"))


def fly(index, addresses, begins, duration, folder, shared):
    """Fly one robot to its goal from the time of the day at which all begin (us) on, and land after some time (s)."""
    robot = files.load(folder).robot(index) if folder else with_rule(index, len(addresses))
    if not len(addresses) == len(STARTS) == len(GOALS) == robot.config.n_robots:
        counts = f"{len(addresses)} addresses, {len(STARTS)} STARTS and {len(GOALS)} GOALS"
        raise SystemExit(f"{counts} for {robot.config.n_robots} robots")
    (host, port), others = addresses[index], {k: a for k, a in enumerate(addresses) if k != index}
    link = UdpLink(index, others, host, port, session=7)  # a session that all share
    vehicle = MyVehicle(index, robot.config, shared)
    limits = SafetyLimits(fence=0.5)  # m beyond the workspace, and some more to brake: all that before your walls
    loop = Loop(robot, link, vehicle, limits)
    loop.warm_up()  # the first time on a machine, it compiles the planner
    freeze_garbage()
    begins = link.own(begins)
    if begins < monotonic():
        raise SystemExit(f"robot {index}: it is too late to begin; the others must not start, either")
    try:
        state = loop.ready().state
    except ValueError as error:
        raise SystemExit(f"robot {index}: {error}") from None
    if (beside := np.linalg.norm(state[POSITION] - STARTS[index])) > 0.3:
        raise SystemExit(f"robot {index} is {beside:.1f} m beside its start, {STARTS[index].tolist()}")

    watchdog = Watchdog(vehicle, limits)
    # Obstacles are given here, or listed in the exported world
    loop.start(STARTS[index], GOALS[index], link.now() + robot.period, heading=state[8], begins=begins)

    def land(*_):
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a second one ends the process in the air
        loop.supervisor.land()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, land)

    def ended():
        if monotonic() > begins + round(duration * 1e6):
            loop.supervisor.land()
        return loop.has_landed

    def after_period(loop):
        watchdog.beat(armed=loop.supervisor.mode is not Mode.OFF)

    print(f"robot {index} holds its start for {(begins - monotonic()) / 1e6:.1f} s", flush=True)
    statistics = loop.run(ended, after_period)
    watchdog.close()
    link.close()
    counts, waits = statistics.counts, statistics.durations["round_trip"]
    distance = np.linalg.norm(vehicle.sense().state[:2] - GOALS[index, :2])
    print(
        f"robot {index}: {counts['periods']} periods, {counts['missed']} missed; {counts['requests']} requests, "
        f"answered after {waits.quantile(0.5) / 1000:.1f} ms; landed {distance:.2f} m beside its goal"
    )


def fly_all(duration):
    """Start a process for each robot on this machine."""
    link = UdpLink(0)
    Loop(with_rule(0, len(STARTS)), link, None).warm_up()  # compile once, not in each process
    link.close()
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in STARTS]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    addresses = ["{}:{}".format(*one.getsockname()) for one in sockets]
    for one in sockets:
        one.close()
    with tempfile.TemporaryDirectory() as folder:
        shared = Path(folder) / "states"
        np.hstack([STARTS, np.zeros((len(STARTS), 6))]).tofile(shared)
        words = ["--addresses", *addresses, "--begins", str(time.time_ns() // 1000 + 10_000_000)]
        words += ["--duration", str(duration), "--shared", str(shared)]
        command = [sys.executable, __file__]
        robots = [subprocess.Popen([*command, "--index", str(k), *words]) for k in range(len(STARTS))]
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the robots, which land
        if any([robot.wait() for robot in robots]):
            raise SystemExit("a robot ended with an error")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--index", type=int, help="number of this robot")
    parser.add_argument("--addresses", nargs="+", metavar="HOST:PORT", help="where robots receive, by their numbers")
    parser.add_argument("--begins", type=int, metavar="US", help="when all begin: microseconds of the time of the day")
    parser.add_argument("--duration", type=float, default=6.0, metavar="S", help="when to land")
    parser.add_argument("--files", metavar="FOLDER", help="an exported policy and its world; by default, a rule flies")
    parser.add_argument("--shared", metavar="FILE", help="states of the simulated vehicles")
    parser.add_argument("--quick", action="store_true", help="fly for a second only")
    args = parser.parse_args()
    if args.index is None:
        fly_all(1.0 if args.quick else args.duration)
    elif args.addresses is None or args.begins is None:
        parser.error("--index needs --addresses and --begins")
    elif args.shared is None:
        parser.error("--shared: MyVehicle simulates, and needs the file; replace it by the class of your vehicle")
    else:
        places = [(host, int(port)) for host, port in (one.rsplit(":", 1) for one in args.addresses)]
        fly(args.index, places, args.begins, args.duration, args.files, args.shared)
