"""The command line `sb3-maddpg`: rl_zoo3 with MADDPG, hyperparameter searches and benchmarks."""
