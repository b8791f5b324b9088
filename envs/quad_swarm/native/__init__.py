"""Compiled code: the compiler and its cache, and the computations for every pair of robots in every step."""

from quad_swarm.native.build import BuildError

__all__ = ["BuildError"]
