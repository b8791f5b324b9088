"""Simulated vehicles in real time as a node, ``python -m quad_swarm.ros.plant_node --ros-args -p NAME:=VALUE ...``, to
try the robots' nodes without any hardware.

====================== ===================================== ===============================================
topic                  type                                  content
====================== ===================================== ===============================================
``/NAME/odom``         nav_msgs/Odometry                     a robot's state, 50 times a second
``/NAME/cmd``          geometry_msgs/TwistStamped            its set-point
``/world/status``      diagnostic_msgs/DiagnosticArray       once a second: collisions, who flies
``/world/reset``       std_srvs/Trigger (a service)          puts everybody back to their starts
====================== ===================================== ===============================================

Robots are held at ``starts``, by default those of a scenario, until their first command. Without
commands they level, and land.
"""

from __future__ import annotations

import signal
import sys
from typing import Any

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.plants.base import PlantError
from quad_swarm.realtime.arena import Pace
from quad_swarm.realtime.link import monotonic, of_day
from quad_swarm.realtime.vehicles import Vehicles
from quad_swarm.ros.messages import msgs, to_diagnostics
from quad_swarm.ros.node import (
    Mailbox,
    Nobody,
    checked_names,
    declare,
    leave,
    make_context,
    make_node,
    numbers,
    quality,
    standing,
    texts,
    values_of,
)
from quad_swarm.ros.world import VehicleTopics
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import REAL_TIME, for_scenario, make_config, points
from quad_swarm.world.scenarios import ScenarioSampler

PARAMETERS: dict[str, Any] = {
    "preset": REAL_TIME,
    "world": [],
    "plant": "",
    "names": [],
    "scenario": "symmetric_swap",
    "seed": 0,
    "starts": [],
}
_STATUS = 1_000_000  # us
_LANDINGS = 10_000_000  # us that robots have to land when the node ends


class PlantNode:
    """The node of the simulated vehicles.

    :ivar vehicles: the vehicles

    :param node: its node of ROS
    :raises ValueError: if a parameter is wrong
    """

    def __init__(self, node: Any):
        from std_srvs.srv import Trigger

        self._mailbox = Mailbox(node)
        declare(node, PARAMETERS)
        values = values_of(node, PARAMETERS)
        self.names, seed = checked_names(values["names"]), values["seed"]
        if type(seed) is not int or seed < 0:
            raise ValueError(f"seed={shown(seed)}: give a whole number that is not negative")
        world = read_assignments("world", texts("world", values["world"]))
        config = make_config(values["preset"], world, n_robots=len(self.names), plant=values["plant"] or None)
        rng = np.random.default_rng(seed)
        if for_scenario(config, values["scenario"]).obstacles.slots > len(config.obstacles.listed):
            raise ValueError(
                f"scenario={values['scenario']!r}: robots cannot know obstacles that are drawn here; list them in the "
                "world of all nodes, as in world:=['obstacles.listed=[{position: [0, 0, 0], radius: 0.3}]']"
            )
        standing(config)
        sampler = ScenarioSampler(values["scenario"], config.n_robots, config.space, config)
        starts, drawn = numbers("starts", values["starts"], 3), sampler.sample(rng)[1]
        self._starts = points("starts", starts, config.n_robots) if len(starts) else drawn
        self._noise = int(rng.integers(2**63)) if config.is_random else 0
        self.vehicles, self._node = Vehicles(config), node
        self.vehicles.warm_up()
        self._topics = VehicleTopics(node, self._mailbox, self.names, self.vehicles.command)
        self._status = node.create_publisher(msgs().DiagnosticArray, "/world/status", quality(5, reliable=True))
        node.create_service(Trigger, "/world/reset", self._reset)
        self._ends: int | None = None
        self.reset()

    def reset(self) -> None:
        """Put everybody back to their starts, where they are held."""
        self.vehicles.reset(self._starts, self._starts, self._noise, monotonic())
        self.vehicles.held[:] = True
        self._pace, self._told = Pace(), 0
        self._met, self._struck = set[tuple[int, int]](), set[tuple[int, int]]()

    def run(self) -> None:
        """Fly until `end`, and until everybody has landed then, for ten seconds at most."""
        vehicles = self.vehicles
        while self._ends is None or ((vehicles.flying & ~vehicles.held).any() and monotonic() < self._ends):
            pace = self._pace
            for k in range(len(self.names)):
                self._topics.tell(k, vehicles.sensed(k)._replace(stamp=pace.stamp(vehicles.now)))
            due = pace.due(vehicles.now + vehicles.step_us)
            self._mailbox.wait(due, Nobody())
            pace.notice(due)
            vehicles.advance()
            for i, k in set(vehicles.struck()) - self._struck:
                self._struck.add((i, k))
                self._node.get_logger().warning(f"{self.names[i]} touched obstacle {k}")
            for i, j in set(vehicles.collisions()) - self._met:
                self._met.add((i, j))
                self._node.get_logger().warning(f"{self.names[i]} and {self.names[j]} collided")
            if vehicles.now - self._told >= _STATUS:
                self._told = vehicles.now
                self._tell()

    def end(self) -> None:
        """End `run` soon.

        :raises SystemExit: if that has been called before
        """
        if self._ends is not None:
            raise SystemExit(1)
        self._ends = monotonic() + _LANDINGS

    def close(self) -> None:
        """Release everything."""
        self._mailbox.close()

    def _tell(self) -> None:
        vehicles = self.vehicles
        pairs = [" ".join(self.names[k] for k in pair) for pair in vehicles.collisions()]
        flying = vehicles.flying & ~vehicles.held
        values = {
            "collisions": ", ".join(pairs),
            "closest": f"{vehicles.closest.min():.3f}",
            "flying": " ".join(name for name, one in zip(self.names, flying, strict=True) if one),
            "on the ground": " ".join(name for name, one in zip(self.names, vehicles.flying, strict=True) if not one),
            "pauses": self._pace.pauses,
        }
        message = f"{len(pairs)} pairs of robots have collided"
        self._status.publish(to_diagnostics("world", 2 if pairs else 0, message, values, of_day(monotonic())))

    def _reset(self, request: Any, response: Any) -> Any:
        self.reset()
        response.success, response.message = True, "everybody is at their start"
        return response


def main() -> int:
    """Run the node.

    :return: exit status, if it cannot start
    """
    try:
        plant = PlantNode(make_node("world", context=make_context(sys.argv)))
    except (ValueError, ImportError, PlantError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: plant.end())
    plant.run()
    plant.close()
    leave()


if __name__ == "__main__":
    sys.exit(main())
