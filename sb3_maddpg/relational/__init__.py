"""Policies that see each neighbour with the same weights, for teams of any size."""

from sb3_maddpg.common.layout import ObservationLayout
from sb3_maddpg.relational.policy import PairPolicy

__all__ = ["ObservationLayout", "PairPolicy"]
