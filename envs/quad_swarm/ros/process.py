"""A robot in a simulated world over ROS 2: ``python -m quad_swarm.ros.process TEAM.json INDEX``."""

from __future__ import annotations

import contextlib
import sys

from quad_swarm.realtime.process import make_parser, run
from quad_swarm.realtime.team import Team
from quad_swarm.ros.link import RosLink
from quad_swarm.ros.node import Mailbox, make_node
from quad_swarm.ros.world import RosVehicle, names_of


def main() -> int:
    """Run the process."""
    args = make_parser(__doc__).parse_args()

    def make(team: Team) -> tuple[RosLink, RosVehicle]:
        names = names_of(team.config.n_robots)
        node = make_node("robot", names[args.index])
        mailbox = stack.enter_context(contextlib.closing(Mailbox(node)))
        link = RosLink(node, mailbox, args.index, names)
        vehicle = RosVehicle(node, mailbox, link, names)
        return link, vehicle

    with contextlib.ExitStack() as stack:  # otherwise the middleware leaves its shared memory behind
        return run(args, make)


if __name__ == "__main__":
    sys.exit(main())
