"""The command line: `sb3-maddpg`, rl_zoo3 with MADDPG, searches and the stopwatch."""
