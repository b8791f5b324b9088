"""Vectorised environments of teams: adapters, checks of what arrives, normalisation, states."""

from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.normalize import SafeVecNormalize
from sb3_maddpg.vec_env.states import Replayable

__all__ = ["GymnasiumVecEnv", "Replayable", "SafeVecNormalize"]
