"""Plants, which simulate the vehicles: our own model or another simulator. The planner only knows the model."""

from __future__ import annotations

from quad_swarm.plants.base import SIMULATORS, ModelPlant, Plant, PlantError, Simulator, make_plant, parse_plant

__all__ = ["SIMULATORS", "ModelPlant", "Plant", "PlantError", "Simulator", "make_plant", "parse_plant"]
