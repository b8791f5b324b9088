"""Batched real-time iteration: CasADi-generated derivatives, a structured interior-point method, problems in lanes."""

from quad_swarm.planner.rti.solver import RtiSolver

__all__ = ["RtiSolver"]
