"""MATD3 of this repository with the settings of the other drivers, see ``common``.

Not like for like: twin critics, an actor that learns every second time, and noise on target actions.
"""

from benchmarks.peers import common
from benchmarks.peers.ours_bench import Ours
from sb3_maddpg import MATD3


class OursTwin(Ours):
    """``MATD3`` in place of ``MADDPG``."""

    algorithm = MATD3


if __name__ == "__main__":
    common.main("sb3-maddpg MATD3", "sb3-maddpg", OursTwin)
