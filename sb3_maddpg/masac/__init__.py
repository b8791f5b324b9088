"""The algorithm MASAC."""

from sb3_maddpg.masac.masac import MASAC

__all__ = ["MASAC"]
