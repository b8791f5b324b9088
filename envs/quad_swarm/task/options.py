"""The arguments that all environments have in common, written once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import PositiveInt


@dataclass(frozen=True)
class TaskOptions:
    """Arguments of the environments; `QuadSwarmEnv` explains them. `with_fields` makes them arguments of functions."""

    preset: str = "paper"
    scenario: str | Mapping[str, float] = "mixed"
    n_robots: int | None = None
    max_steps: PositiveInt | None = None
    observation: str = "paper"
    scale_observation: bool = False
    continuous_collisions: bool | None = None
    end_at_arrival: bool = False
    memory: float | None = None
    reward: Mapping[str, Any] | None = None
    planner: Mapping[str, Any] | None = None
    noise: Mapping[str, Any] | None = None
    radio: Mapping[str, Any] | None = None
    space: Mapping[str, Any] | None = None
    world: Mapping[str, Any] | None = None
    solver: str = "auto"
    announcements: bool = False
    plans_in_info: bool = False
