"""The algorithm IDDPG."""

from sb3_maddpg.iddpg.iddpg import IDDPG

__all__ = ["IDDPG"]
