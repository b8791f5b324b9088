"""Pretrained models of the swarm, one folder each; `sb3_maddpg.pretrained` finds them through an entry point."""
