"""The decision task on top of the world: what robots observe, rules for whom to ask, reward, end and figures of an episode."""
