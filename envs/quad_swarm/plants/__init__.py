"""Plants, which simulate the vehicles: our own model or another simulator. The planner only knows the model."""

from __future__ import annotations

from quad_swarm.plants.base import ModelPlant, Plant, make_plant, parse_plant

__all__ = ["ModelPlant", "Plant", "make_plant", "parse_plant"]
