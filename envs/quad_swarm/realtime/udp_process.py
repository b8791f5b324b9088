"""A robot over UDP: ``python -m quad_swarm.realtime.udp_process TEAM.json INDEX HOST:PORT``."""

from __future__ import annotations

import sys

from quad_swarm.realtime.process import make_parser, run
from quad_swarm.realtime.team import Team
from quad_swarm.realtime.udp import UdpLink
from quad_swarm.realtime.udp_world import UdpVehicle


def main() -> int:
    """Run the process."""
    parser = make_parser(__doc__)
    parser.add_argument("world", help="address of the world, HOST:PORT")
    args = parser.parse_args()
    host, _, port = args.world.rpartition(":")

    def make(team: Team) -> tuple[UdpLink, UdpVehicle]:
        link = UdpLink(args.index, group=team.group, session=team.session, checked=team.checked)
        return link, UdpVehicle(link, (host, int(port)), team.config.n_others)

    return run(args, make)


if __name__ == "__main__":
    sys.exit(main())
