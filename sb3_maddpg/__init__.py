"""MADDPG for Stable-Baselines3: decentralised actors, centralised critics, bits through a threshold."""

from importlib.metadata import version

from sb3_maddpg.buffers import TeamReplayBuffer
from sb3_maddpg.callbacks import CurriculumCallback, MetricsCallback
from sb3_maddpg.maddpg import MADDPG
from sb3_maddpg.policies import MADDPGPolicy

__version__ = version("sb3-maddpg")
__all__ = ["MADDPG", "CurriculumCallback", "MADDPGPolicy", "MetricsCallback", "TeamReplayBuffer"]
