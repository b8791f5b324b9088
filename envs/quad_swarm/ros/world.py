"""A simulated world and its robots over ROS 2: the world's end and the robots'.

============================= ============================ ====================================================
topic                         type                         content
============================= ============================ ====================================================
``/NAME/odom``                nav_msgs/Odometry            a robot's state; the twist is in its own frame
``/NAME/cmd``                 geometry_msgs/TwistStamped   its set-point, see `quad_swarm.ros.messages.to_command`
``/NAME/words``               std_msgs/String              when to fly, and when to stop (JSON)
``/world/words``              std_msgs/String              ready, done, and what it did in a period (JSON)
============================= ============================ ====================================================

All robots read the same odometry: errors of what they observe of each other are not simulated here.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.realtime.link import Handler, Sensed
from quad_swarm.realtime.process import Hears, Report
from quad_swarm.robot import Plan
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.messages import from_command, from_odometry, msgs, to_command, to_odometry
from quad_swarm.ros.node import Mailbox, make_node, quality

_STALE = 200_000  # us between two robots' odometry from which on the older one counts as everybody's
_US = 1e-6


def names_of(n_robots: int) -> list[str]:
    """Return the names of robots."""
    return [f"robot_{k}" for k in range(n_robots)]


class OdometryVehicle:
    """Perceives by odometry, and is commanded by ``/NAME/cmd``.

    :param node: the robot's node
    :param mailbox: receives for it
    :param link: the robot's link, whose clock it uses
    :param names: names of all robots
    """

    def __init__(self, node: Any, mailbox: Mailbox, link: RosLink, names: Sequence[str]):
        self._link, own = link, names[link.index]
        self._states: dict[int, tuple[int, np.ndarray]] = {}
        self._commands = node.create_publisher(msgs().TwistStamped, f"/{own}/cmd", quality(1))
        for number, name in enumerate(names):

            def take(message: Any, handler: Handler, number: int = number) -> None:
                self._see(number, message)

            mailbox.subscribe(msgs().Odometry, f"/{name}/odom", quality(1), take)
        self._others = [number for number in range(len(names)) if number != link.index]

    def sense(self) -> Sensed | None:
        """See `quad_swarm.realtime.Vehicle`. The others are moved to the time of the robot's own state."""
        states = self._states
        if len(states) < len(self._others) + 1:
            return None
        stamp, own = states[self._link.index]
        oldest = min(one for one, _ in states.values())
        pos, vel = np.empty((len(self._others), 3)), np.empty((len(self._others), 3))
        for place, other in enumerate(self._others):
            then, state = states[other]
            vel[place] = state[VELOCITY]
            pos[place] = state[POSITION] + (stamp - then) * _US * vel[place]
        return Sensed(stamp if stamp - oldest < _STALE else oldest, own, pos, vel)

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        """See `quad_swarm.realtime.Vehicle`."""
        self._commands.publish(to_command(setpoint, self._link.shared(self._link.now())))

    def disarm(self) -> None:
        """See `quad_swarm.realtime.Vehicle`. The world stops the motors of what lies on the ground."""

    def _see(self, number: int, message: Any) -> None:
        try:
            stamp, state = from_odometry(message)
        except ValueError:
            self._link.traffic.refused += 1
            return
        stamp = self._link.own(stamp) + self._link.clock_error
        if number not in self._states or stamp > self._states[number][0]:
            self._states[number] = stamp, state


class RosVehicle(OdometryVehicle):
    """A vehicle in a simulated world, see `quad_swarm.realtime.process.SimulatedVehicle`."""

    def __init__(self, node: Any, mailbox: Mailbox, link: RosLink, names: Sequence[str]):
        super().__init__(node, mailbox, link, names)
        self.control: list[dict[str, Any]] = []
        self.heard = link.now()
        self._words = node.create_publisher(msgs().String, "/world/words", quality(50))
        mailbox.subscribe(msgs().String, f"/{names[link.index]}/words", quality(10), self._hear)

    def say(self, **words: Any) -> None:
        """See `SimulatedVehicle`."""
        self._words.publish(msgs().String(data=json.dumps({**words, "robot": self._link.index})))

    def report(self, report: Report) -> None:
        """See `SimulatedVehicle`."""
        self.say(says="report", report=[*report[1:5], np.round(report.plan, 4).tolist()])

    def begin(self, words: dict[str, Any]) -> None:
        """See `SimulatedVehicle`."""
        self._states.clear()

    def _see(self, number: int, message: Any) -> None:
        self.heard = self._link.now()
        super()._see(number, message)

    def _hear(self, message: Any, handler: Handler) -> None:
        self.heard = self._link.now()
        self.control.append(json.loads(message.data))


class RosWorld:
    """The world's end, see `quad_swarm.realtime.arena.Exchange`.

    :param n_robots: number of robots
    """

    def __init__(self, n_robots: int):
        node = make_node("world")
        self._mailbox, self._names = Mailbox(node), names_of(n_robots)
        self._odometry = [node.create_publisher(msgs().Odometry, f"/{one}/odom", quality(1)) for one in self._names]
        self._words = [node.create_publisher(msgs().String, f"/{one}/words", quality(10)) for one in self._names]
        self._hears: Hears | None = None
        self._mailbox.subscribe(msgs().String, "/world/words", quality(50 * n_robots), self._hear)
        for number, name in enumerate(self._names):

            def take(message: Any, handler: Handler, number: int = number) -> None:
                assert self._hears is not None
                self._hears.on_command(number, from_command(message))

            self._mailbox.subscribe(msgs().TwistStamped, f"/{name}/cmd", quality(2), take)

    def process(self, team: Path, robot: int) -> list[str]:
        """See `Exchange`."""
        return [sys.executable, "-m", "quad_swarm.ros.process", str(team), str(robot)]

    def tell(self, robot: int, sensed: Sensed) -> None:
        """See `Exchange`."""
        self._odometry[robot].publish(to_odometry(sensed.state, sensed.stamp, f"{self._names[robot]}/base_link"))

    def say(self, robot: int, **words: Any) -> None:
        """See `Exchange`."""
        self._words[robot].publish(msgs().String(data=json.dumps(words)))

    def receive(self, until: int, hears: Hears) -> None:
        """See `Exchange`."""
        self._hears = hears
        self._mailbox.wait(until, _Nobody())

    def close(self) -> None:
        """See `Exchange`."""
        self._mailbox.close()

    def _hear(self, message: Any, handler: Handler) -> None:
        assert self._hears is not None
        words = json.loads(message.data)
        if words["says"] == "report":
            mode, asked, told, arrived, plan = words["report"]
            self._hears.on_report(Report(words["robot"], mode, asked, told, arrived, np.array(plan)))
        else:
            self._hears.on_words(words)


class _Nobody:
    """The world itself is asked for no plans."""

    def on_request(self, sender: int) -> None:
        """See `Handler`."""

    def on_plan(self, sender: int, plan: Plan, sent: int | None, period: int) -> None:
        """See `Handler`."""
