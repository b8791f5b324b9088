"""The algorithm MATD3."""

from sb3_maddpg.matd3.matd3 import MATD3

__all__ = ["MATD3"]
