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
from quad_swarm.realtime import Loop, Mode, SafetyLimits, Sensed, Watchdog, session_of
from quad_swarm.realtime.link import monotonic
from quad_swarm.realtime.loop import freeze_garbage
from quad_swarm.realtime.udp import UdpLink
from quad_swarm.robot import Robot, RulePolicy, files
from quad_swarm.world.presets import make_config

# Where the robots hover before, and fly to, a row for each in the order of their numbers (m)
STARTS, GOALS = np.array([[-2.0, 0, 1.5], [2.0, 0.1, 1.5]]), np.array([[2.0, 0, 1.5], [-2.0, 0, 1.5]])
# Lowest and highest corner between walls, floor and ceiling (m)
ROOM = ((-9.0, -9.0, 0.0), (9.0, 9.0, 4.0))


class MyVehicle:
    """A simulated vehicle, which flies the last set-point until the next one.

    Your class is created with the same arguments: number of the robot, its world, and --shared, None without."""

    def __init__(self, index, config, shared):
        if shared is None:
            raise SystemExit("--shared: MyVehicle simulates, and needs the file; replace it by your vehicle's class")
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


def make_robot(index, n_robots, folder, rule):
    """Return a robot with an exported policy, or with a rule, in the exported world if there is one."""
    if rule is None:
        return files.load(folder).robot(index)
    config = files.load(folder).config if folder else make_config("flight-v2", n_robots=n_robots)
    return Robot(config, index, RulePolicy(rule))


def check_team(addresses, config):
    """Refuse addresses, starts and goals that are not one for each robot, in the workspace, and apart."""
    n = config.n_robots
    if not len(STARTS) == len(GOALS) == n:
        raise ValueError(f"{len(STARTS)} STARTS and {len(GOALS)} GOALS for {n} robots; edit them in {__file__}")
    if len(set(addresses)) != len(addresses) or len(addresses) != n:
        raise ValueError(f"--addresses: {len(set(addresses))} different ones for {n} robots; each needs its own")
    config.check_flight(STARTS, GOALS, config.obstacles.listed)


def time_for(config):
    """Return twice as long as the longest way takes at the speed limit, and some (s)."""
    return 4 + 2 * float(np.linalg.norm(GOALS - STARTS, axis=1).max()) / config.planner.max_speed


def open_link(index, addresses, session):
    """Return the link of a robot to the others, whose session all share."""
    (host, port), others = addresses[index], {k: a for k, a in enumerate(addresses) if k != index}
    try:
        return UdpLink(index, others, host, port, session=session)
    except OSError as error:
        why = f"cannot receive at {host}:{port} ({error.strerror}): --index or --addresses is wrong"
        raise SystemExit(f"robot {index}: {why}, or another process still runs") from None


def fly(index, addresses, begins, duration, folder, rule, shared, team):
    """Fly one robot to its goal from the time of the day at which all begin (us) on, and land after some time (s).

    Return why it landed before, None if it did not."""
    try:
        robot = make_robot(index, len(addresses), folder, rule)
        check_team(addresses, robot.config)
    except ValueError as error:
        raise SystemExit(f"robot {index}: {error}") from None
    config = robot.config
    duration = duration or time_for(config)
    if not 0 < (ahead := begins / 1e6 - time.time()) < 600:
        now = time.time_ns() // 1000
        raise SystemExit(
            f"robot {index}: --begins {begins} is {ahead:.1f} s from now, {now}: give microseconds, 1 to 600 s ahead"
        )
    link = open_link(index, addresses, session_of(config, team))
    vehicle = MyVehicle(index, config, shared)
    # For your room: fence, braking and radius must fit between workspace and walls. Below the separation, here halfway
    # between contact and what planners keep, robots hold their places. At the height `ground`, your vehicle stands.
    near = config.radius + config.planner.separation / 2
    limits = SafetyLimits(fence=0.3, room=ROOM, separation=near, ground=0.1)
    # `late=` is when set-points act, in periods: measure it, from the start of a period to the motion (0.25 is 12.5 ms)
    try:
        loop = Loop(robot, link, vehicle, limits)
        loop.warm_up()  # the first time on a machine, it compiles the planner
        freeze_garbage()
        begins = link.own(begins)
        if begins < monotonic():
            raise SystemExit(f"robot {index}: it was not ready when all begin; give it more time")
        state = loop.ready().state
    except ValueError as error:
        raise SystemExit(f"robot {index}: {error}") from None
    if (beside := np.linalg.norm(state[POSITION] - STARTS[index])) > 0.3:
        raise SystemExit(f"robot {index} is {beside:.1f} m beside its start, {STARTS[index].tolist()}")
    watchdog, supervisor, modes, reasons = Watchdog(vehicle, limits), loop.supervisor, [Mode.FLY], set()
    # Obstacles are given here, or listed in the exported world
    loop.start(STARTS[index], GOALS[index], link.now() + robot.period, heading=state[8], begins=begins)

    def land(*_):
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a second one ends the process in the air
        supervisor.land()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, land)

    def ended():
        if monotonic() > begins + round(duration * 1e6):
            supervisor.land()
        return loop.has_landed

    def after_period(loop):
        watchdog.beat(armed=supervisor.mode is not Mode.OFF)
        if supervisor.mode is not modes[-1]:
            modes.append(supervisor.mode)
            reasons.update(supervisor.why if supervisor.mode is Mode.LAND else ())
            print(f"robot {index}: {supervisor.mode.name.lower()} {', '.join(sorted(supervisor.why))}", flush=True)

    print(f"robot {index} holds its start for {(begins - monotonic()) / 1e6:.1f} s", flush=True)
    statistics = loop.run(ended, after_period)
    watchdog.close()
    link.close()
    counts, distance = statistics.counts, np.linalg.norm(vehicle.sense().state[:2] - GOALS[index, :2])
    refused = sum(count for name, count in counts.items() if name.startswith("refused"))
    print(
        f"robot {index}: {counts['periods']} periods, {counts['missed']} missed, {counts['late commands']} commands "
        f"late; {counts['requests']} requests, {counts['plans received']} plans believed, {refused} messages refused; "
        f"landed {distance:.2f} m beside its goal {statistics.last_error}"
    )
    return ", ".join(reasons - {"told to land"}) or None


def watch(index, n_robots, folder, rule, shared):
    """Print what one robot senses, twice a second until Ctrl-C, and command nothing."""
    vehicle = MyVehicle(index, make_robot(index, n_robots, folder, rule).config, shared)
    while True:
        sensed = vehicle.sense()
        pos, vel, angles = np.split(np.round(sensed.state, 2), 3)
        print(
            f"{(monotonic() - sensed.stamp) / 1000:.0f} ms ago: at {pos} m, {vel} m/s, roll, pitch, yaw {angles} rad; "
            f"others at {np.round(sensed.pos, 2).tolist()} m",
            flush=True,
        )
        time.sleep(0.5)


def fly_all(duration, folder, rule):
    """Start a process for each robot on this machine."""
    link = UdpLink(0)
    Loop(make_robot(0, len(STARTS), folder, rule), link, None).warm_up()  # compile once, not in each process
    link.close()
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in STARTS]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    addresses = ["{}:{}".format(*one.getsockname()) for one in sockets]
    for one in sockets:
        one.close()
    with tempfile.TemporaryDirectory() as motion_capture:
        shared = Path(motion_capture) / "states"
        np.hstack([STARTS, np.zeros((len(STARTS), 6))]).tofile(shared)
        words = ["--addresses", *addresses, "--begins", str(time.time_ns() // 1000 + 20_000_000)]
        words += ["--shared", str(shared)]
        given = (("--files", folder), ("--rule", rule), ("--duration", duration))
        words += [str(word) for name, value in given if value for word in (name, value)]
        command = [sys.executable, __file__]
        robots = [subprocess.Popen([*command, "--index", str(k), *words]) for k in range(len(STARTS))]
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the robots, which land
        if any([robot.wait() for robot in robots]):
            raise SystemExit("a robot ended with an error")


def address(text):
    """Parse HOST:PORT."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT, with a port up to 65535")
    return host, int(port)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--index", type=int, help="number of this robot")
    parser.add_argument(
        "--addresses", nargs="+", type=address, metavar="HOST:PORT", help="where robots receive, by their numbers"
    )
    parser.add_argument("--begins", type=int, metavar="US", help="when all begin: microseconds of the time of the day")
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="when to land, after that (default: 4 s, and twice what the longest way takes at the speed limit)",
    )
    parser.add_argument("--files", metavar="FOLDER", help="an exported policy and its world")
    parser.add_argument("--rule", help="a rule instead of the exported policy, such as none")
    parser.add_argument("--team", type=int, default=0, help="number of the team, if several share a network")
    parser.add_argument("--shared", metavar="FILE", help="states of the simulated vehicles")
    parser.add_argument("--sense", action="store_true", help="print what this robot senses, and command nothing")
    parser.add_argument("--quick", action="store_true", help="fly for a second only")
    args = parser.parse_args()
    if args.duration is not None and not 0 < args.duration < np.inf:
        parser.error(f"--duration {args.duration:g}: it must be a number above 0")
    if args.index is None:
        if args.addresses or args.begins or args.shared or args.sense:
            parser.error("--addresses, --begins, --shared and --sense need --index: which robot is this one?")
        rule = args.rule if args.files else args.rule or "cpa:1.1s:2"  # asks those whom it would come close to
        sys.exit(fly_all(1.0 if args.quick else args.duration, args.files, rule))
    if args.addresses is None or (args.begins is None and not args.sense):
        parser.error("--index needs --addresses and --begins")
    if not args.files and not (args.rule and args.shared):
        parser.error("--index needs --files, which holds the world of your robots, also with --rule")
    if not 0 <= args.index < len(args.addresses):
        parser.error(f"--index {args.index}: there are {len(args.addresses)} addresses, from 0")
    if args.sense:
        try:
            watch(args.index, len(args.addresses), args.files, args.rule, args.shared)
        except KeyboardInterrupt:
            sys.exit(0)
        except ValueError as error:
            sys.exit(f"robot {args.index}: {error}")
    sys.exit(fly(args.index, args.addresses, args.begins, args.duration, args.files, args.rule, args.shared, args.team))
