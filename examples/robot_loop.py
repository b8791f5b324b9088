"""Two robots in real time over UDP, with a vehicle class of your own: what you write to fly your robots.

`MyVehicle` is what you replace: it says what a robot perceives, and takes its set-points. Here it simulates, so that
the example runs; on a robot, `sense` reads your state estimator and motion capture, and `command` talks to your
autopilot. Everything else is what the process of each robot does. Here two of them are threads.
"""

import argparse
import threading

import numpy as np

from quad_swarm.quadrotor import POSITION, VELOCITY, QuadrotorModel
from quad_swarm.realtime import Loop, SafetyLimits, Sensed, Watchdog
from quad_swarm.realtime.link import monotonic
from quad_swarm.realtime.udp import UdpLink
from quad_swarm.robot import Robot, RulePolicy
from quad_swarm.world.presets import make_config

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="fly for a second only")
args = parser.parse_args()

config = make_config("flight", n_robots=2)
starts, goals = np.array([[-2.0, 0, 1.5], [2.0, 0.1, 1.5]]), np.array([[2.0, 0, 1.5], [-2.0, 0, 1.5]])
states = np.zeros((2, 9))
states[:, POSITION] = starts


class MyVehicle:
    """A simulated vehicle, which flies for as long as it took until the next command."""

    def __init__(self, index):
        self.index, self.model, self.then = index, QuadrotorModel(config.quadrotor, 0.01), monotonic()
        self.setpoint = np.zeros(4)

    def sense(self):
        """Return the newest state of the robot and of the others, and when it was so."""
        while self.then + 10_000 < monotonic():
            states[self.index] = self.model.step(states[None, self.index], self.setpoint[None])[0]
            self.then += 10_000
        other = states[1 - self.index : 2 - self.index]
        return Sensed(self.then, states[self.index].copy(), other[:, POSITION].copy(), other[:, VELOCITY].copy())

    def command(self, setpoint, plan):
        """Fly a set-point: roll, pitch (rad), climb rate (m/s), yaw rate (rad/s)."""
        self.setpoint = setpoint

    def disarm(self):
        """Stop the motors."""


def fly(index, link, begins, ends, results):
    """Fly one robot until some time (us)."""
    vehicle, limits = MyVehicle(index), SafetyLimits(fence=0.5)  # m beyond the workspace: less than to your walls
    loop = Loop(Robot(config, index, RulePolicy("cpa:1.1s:2")), link, vehicle, limits)
    loop.warm_up()
    watchdog = Watchdog(vehicle, limits)
    loop.start(starts[index], goals[index], begins)
    results[index] = loop.run(lambda: monotonic() > ends, lambda loop: watchdog.beat())
    watchdog.close()


links = [UdpLink(index) for index in range(2)]
for link in links:  # on a network: the addresses of the robots, such as ("192.168.1.12", 14650)
    link.addresses = {other.index: other.address for other in links}
results = {}
begins = monotonic() + 1_000_000
ends = begins + (1_000_000 if args.quick else 6_000_000)
threads = [threading.Thread(target=fly, args=(link.index, link, begins, ends, results)) for link in links]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
for index, statistics in sorted(results.items()):
    counts, waits = statistics.counts, statistics.durations["round_trip"]
    distance = np.linalg.norm(states[index, POSITION] - goals[index])
    print(f"robot {index}: {counts['periods']} periods, {counts['missed']} missed, {distance:.2f} m from its goal")
    print(f"         {counts['requests']} requests, answered after {waits.quantile(0.5) / 1000:.1f} ms")
