"""Simulated vehicles in real time as a node, ``python -m quad_swarm.ros.plant_node --ros-args -p NAME:=VALUE ...``, to
try the robots' nodes without any hardware.

====================== ===================================== ===============================================
topic                  type                                  content
====================== ===================================== ===============================================
``/NAME/odom``         nav_msgs/Odometry                     a robot's state, each sub-step
``/NAME/cmd``          geometry_msgs/TwistStamped            its set-point
``/world/status``      diagnostic_msgs/DiagnosticArray       once a second: collisions, who flies
====================== ===================================== ===============================================

Robots are held at the starts of a scenario until their first command. Without commands they level, and land.
"""

from __future__ import annotations

import signal
import sys
from typing import Any

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.plants.base import PlantError
from quad_swarm.realtime.arena import PAUSE
from quad_swarm.realtime.link import monotonic, of_day
from quad_swarm.realtime.vehicles import Vehicles
from quad_swarm.ros.messages import msgs, to_diagnostics
from quad_swarm.ros.node import (
    Mailbox,
    Nobody,
    checked_names,
    declare,
    make_context,
    make_node,
    quality,
    texts,
    values_of,
)
from quad_swarm.ros.world import VehicleTopics
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler

PARAMETERS: dict[str, Any] = {
    "preset": "flight",
    "world": [],
    "plant": "",
    "names": [],
    "scenario": "symmetric_swap",
    "seed": 0,
}
_STATUS = 1_000_000  # us


class PlantNode:
    """The node of the simulated vehicles.

    :ivar vehicles: the vehicles
    :ivar pauses: how often the machine, and the world with it, stood still for more than a tenth of a second

    :param node: its node of ROS
    :raises ValueError: if a parameter is wrong
    """

    def __init__(self, node: Any):
        self._mailbox = Mailbox(node)
        declare(node, PARAMETERS)
        values = values_of(node, PARAMETERS)
        self.names, seed = checked_names(values["names"]), values["seed"]
        if type(seed) is not int or seed < 0:
            raise ValueError(f"seed={shown(seed)}: give a whole number that is not negative")
        world = read_assignments("world", texts("world", values["world"]))
        config = make_config(values["preset"], world, n_robots=len(self.names), plant=values["plant"] or None)
        rng = np.random.default_rng(seed)
        sampler = ScenarioSampler(values["scenario"], config.n_robots, config.space, config)
        _, self._starts, self._goals, *_ = sampler.sample(rng)
        self._noise = int(rng.integers(2**63)) if config.is_random else 0
        self.vehicles, self.pauses = Vehicles(config), 0
        self.vehicles.warm_up()
        self._topics = VehicleTopics(node, self._mailbox, self.names, self.vehicles.command)
        self._status = node.create_publisher(msgs().DiagnosticArray, "/world/status", quality(5))
        self._ended = False

    def run(self) -> None:
        """Fly until `end`."""
        vehicles, slipped, told = self.vehicles, 0, 0
        vehicles.reset(self._starts, self._goals, self._noise, monotonic())
        vehicles.held[:] = True
        while not self._ended:
            for k in range(len(self.names)):
                self._topics.tell(k, vehicles.sensed(k)._replace(stamp=of_day(vehicles.now + slipped)))
            due = vehicles.now + vehicles.step_us + slipped
            self._mailbox.wait(due, Nobody())
            if monotonic() - due > PAUSE:
                slipped += monotonic() - due
                self.pauses += 1
            vehicles.advance()
            if vehicles.now - told >= _STATUS:
                told = vehicles.now
                self._tell()

    def end(self) -> None:
        """End `run`."""
        self._ended = True

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
            "pauses": self.pauses,
        }
        message = f"{len(pairs)} pairs of robots have collided"
        self._status.publish(to_diagnostics("world", 2 if pairs else 0, message, values, of_day(monotonic())))


def main() -> int:
    """Run the node.

    :return: exit status
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
