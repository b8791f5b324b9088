"""Figures of flights and evaluations: plots, animations, the replay page and TensorBoard's dashboard."""
