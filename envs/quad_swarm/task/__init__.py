"""The decision task on top of the world: observations, rules, reward, the end and the figures of an episode."""
