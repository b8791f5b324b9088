"""Batched real-time iteration: CasADi-generated derivatives, a structured interior-point method, problems in lanes."""

from .build import BuildError
from .solver import RtiSolver

__all__ = ["BuildError", "RtiSolver"]
