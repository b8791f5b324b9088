"""The algorithm MADDPG."""

from sb3_maddpg.maddpg.maddpg import MADDPG

__all__ = ["MADDPG"]
