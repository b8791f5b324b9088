"""Trained models, one folder each; see `sb3_maddpg.pretrained`."""
