"""The study of the swarm: rules and thresholds tuned on one set of episodes, tested on another (docs/results.md)."""
