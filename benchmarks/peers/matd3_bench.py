"""MATD3 of this repository with the settings of the other drivers, see ``common``.

Not directly comparable: twin critics, delayed actor updates, and noise on target actions.
"""

from benchmarks.peers import common
from benchmarks.peers.ours_bench import Ours
from sb3_maddpg import MATD3


class OursTwin(Ours):
    """``MATD3`` in place of ``MADDPG``."""

    algorithm = MATD3


if __name__ == "__main__":
    common.main("sb3-maddpg MATD3", "sb3-maddpg", OursTwin)
