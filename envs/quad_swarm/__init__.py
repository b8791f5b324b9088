"""quad_swarm."""
