"""sb3-maddpg."""
