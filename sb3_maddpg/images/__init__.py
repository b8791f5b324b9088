"""Policies for agents that observe images."""

from sb3_maddpg.images.cnn_policy import CnnPolicy

__all__ = ["CnnPolicy"]
