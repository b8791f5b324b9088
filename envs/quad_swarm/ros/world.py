"""A simulated world and its robots over ROS 2: the world's end and the robots'.

============================= ============================ ====================================================
topic                         type                         content
============================= ============================ ====================================================
``/NAME/odom``                nav_msgs/Odometry            a robot's state, 50 times a second; the twist is in its
                                                           own frame
``/NAME/cmd``                 geometry_msgs/TwistStamped   its set-point, see `quad_swarm.ros.messages.to_command`
``/NAME/words``               std_msgs/String              when to fly, and when to stop (JSON)
``/world/words``              std_msgs/String              ready, done, and what it did in a period (JSON)
============================= ============================ ====================================================

All robots read the same odometry: errors of what they observe of each other are not simulated here.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.realtime.link import Handler, Sensed
from quad_swarm.realtime.process import Hears, Report
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.messages import SerialisedOdometry, from_command, msgs
from quad_swarm.ros.node import Mailbox, Nobody, make_node, quality
from quad_swarm.ros.vehicles import OdometryVehicle

# Each message wakes a thread of each robot: at 100 a second, eight robots keep two cores busy with that alone
_ODOMETRY = 20_000  # us between two messages of a robot
_EARLY = 2_000  # us by which clocks that are read one after the other may differ


def names_of(n_robots: int) -> list[str]:
    """Return the names of robots."""
    return [f"robot_{k}" for k in range(n_robots)]


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
        self._seen()  # of the last flight
        self._states.clear()

    def _see(self, number: int, stamp: int, state: np.ndarray) -> None:
        self.heard = self._link.now()
        super()._see(number, stamp, state)

    def _hear(self, message: Any, handler: Handler) -> None:
        self.heard = self._link.now()
        self.control.append(json.loads(message.data))


class VehicleTopics:
    """The end of simulated vehicles: ``/NAME/odom`` and ``/NAME/cmd`` of each.

    :param node: the world's node
    :param mailbox: receives for it
    :param names: names of all robots
    :param command: takes a robot's number and its set-point, (4,)
    """

    def __init__(self, node: Any, mailbox: Mailbox, names: Sequence[str], command: Callable[[int, np.ndarray], None]):
        self._states = [SerialisedOdometry(f"{one}/base_link") for one in names]
        self._told = [0] * len(names)
        self._odometry = [
            node.create_publisher(msgs().Odometry, f"/{one}/odom", quality(1, reliable=True)) for one in names
        ]
        for number, name in enumerate(names):

            def take(message: Any, handler: Handler, number: int = number) -> None:
                command(number, from_command(message))

            mailbox.subscribe(msgs().TwistStamped, f"/{name}/cmd", quality(2), take)

    def tell(self, robot: int, sensed: Sensed) -> None:
        """Publish a robot's state, stamped with the time of the day, if the last one is old enough."""
        if sensed.stamp - self._told[robot] < _ODOMETRY - _EARLY:
            return
        self._told[robot] = sensed.stamp
        self._odometry[robot].publish(self._states[robot].write(sensed.state, sensed.stamp))


class RosWorld:
    """The world's end, see `quad_swarm.realtime.arena.Exchange`.

    :param n_robots: number of robots
    """

    def __init__(self, n_robots: int):
        node = make_node("world")
        self._mailbox, self._names = Mailbox(node), names_of(n_robots)
        self._vehicles = VehicleTopics(node, self._mailbox, self._names, self._command)
        self._words = [node.create_publisher(msgs().String, f"/{one}/words", quality(10)) for one in self._names]
        self._hears: Hears | None = None
        self._mailbox.subscribe(msgs().String, "/world/words", quality(50 * n_robots), self._hear)

    def process(self, team: Path, robot: int) -> list[str]:
        """See `Exchange`."""
        return [sys.executable, "-m", "quad_swarm.ros.process", str(team), str(robot)]

    def tell(self, robot: int, sensed: Sensed) -> None:
        """See `Exchange`."""
        self._vehicles.tell(robot, sensed)

    def say(self, robot: int, **words: Any) -> None:
        """See `Exchange`."""
        self._words[robot].publish(msgs().String(data=json.dumps(words)))

    def receive(self, until: int, hears: Hears) -> None:
        """See `Exchange`."""
        self._hears = hears
        self._mailbox.wait(until, Nobody())

    def close(self) -> None:
        """See `Exchange`."""
        self._mailbox.close()

    def _command(self, robot: int, setpoint: np.ndarray) -> None:
        assert self._hears is not None
        self._hears.on_command(robot, setpoint)

    def _hear(self, message: Any, handler: Handler) -> None:
        assert self._hears is not None
        words = json.loads(message.data)
        if words["says"] == "report":
            mode, asked, told, arrived, plan = words["report"]
            self._hears.on_report(Report(words["robot"], mode, asked, told, arrived, np.array(plan)))
        else:
            self._hears.on_words(words)
