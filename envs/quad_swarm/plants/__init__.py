"""What is flown: our own model, or a simulator of other people. The planner knows the model alone."""

from __future__ import annotations

from quad_swarm.plants.base import ModelPlant, Plant, make_plant, parse_plant

__all__ = ["ModelPlant", "Plant", "make_plant", "parse_plant"]
