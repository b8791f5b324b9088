"""The study of the swarm: rules and thresholds tuned on one set of episodes, tested on others; makes docs/results.md."""
