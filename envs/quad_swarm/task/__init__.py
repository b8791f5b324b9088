"""The decision task on top of the world: observations, rules, reward, termination and statistics of episodes."""
