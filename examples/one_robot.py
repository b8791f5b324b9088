"""One robot of a team, run by hand: what it perceives goes in, a set-point comes out, plans are asked for by message.

Here the other robots fly in the same process and the radio is a function call; on a vehicle, `sense` is your state
estimator and motion capture, `command` your autopilot, and the messages travel as `quad_swarm.robot.wire` packs them.
"""

import argparse

import numpy as np

from quad_swarm.planner import make_planner
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.robot import Plan, Robot, RulePolicy, wire
from quad_swarm.world.presets import make_config

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="fly for a second only")
args = parser.parse_args()

config = make_config("flight-v2", n_robots=2)
planner = make_planner(config.planner, config.quadrotor, config.n_robots)
starts, goals = np.array([[-2.0, 0, 1], [2.0, 0.1, 1]]), np.array([[2.0, 0, 1], [-2.0, 0, 1]])
robots = [Robot(config, index, RulePolicy("cpa:1.1s:2"), planner) for index in range(2)]
states = np.zeros((2, 9))
states[:, POSITION] = starts
for robot, start, goal in zip(robots, starts, goals, strict=True):
    robot.reset(start, goal)

session, now, closest, n_bytes = 7, 0, np.inf, 0
for _ in range(10 if args.quick else 80):
    for robot, other in zip(robots, reversed(robots), strict=True):
        seen = states[robot.others]
        asks = robot.decide(now, states[robot.index], seen[:, POSITION], seen[:, VELOCITY])[:, 0]
        for asked in robot.others[asks]:
            request = wire.pack_request(session, robot.index, int(asked), now)
            # The other robot answers with the plan of its last period
            stamp, positions = other.newest
            sent = (session, int(asked), robot.index, now, stamp, robot.period, positions)
            answer = wire.pack_plan(*sent)
            other.sent(robot.index)
            n_bytes += len(request) + len(answer)
            # It arrives: times are those nearest to now
            message = wire.unpack(answer, session)
            robot.receive(message.sender, Plan(wire.nearest(message.stamp, now), message.positions))
    commands = np.array([robot.plan() for robot in robots])
    states = planner.model.step(states, commands)
    now += robots[0].period
    closest = min(closest, float(np.linalg.norm(np.subtract(*states[:, POSITION]))))

distances = np.linalg.norm(states[:, POSITION] - goals, axis=1)
print(f"after {now * 1e-6:.1f} s: {distances.round(2)} m from their goals")
print(f"never closer than {closest:.2f} m, {n_bytes} bytes of messages")
