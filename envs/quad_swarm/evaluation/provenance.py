"""What was flown: everything that the results of an evaluation depend on, for its files and its footer."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from quad_swarm.evaluation.evaluation import user_modules
from quad_swarm.evaluation.flight import Condition
from quad_swarm.evaluation.policies import is_model
from quad_swarm.jobs.journal import sources_digest
from quad_swarm.plants.base import MODEL, parse_plant
from quad_swarm.world.presets import PRESET_VERSION, PRESETS, SwarmConfig


def provenance(condition: Condition, preset: str, seed: int, solver: str) -> dict[str, Any]:
    """Return what a condition's results depend on, beside its policy and scenario.

    :param condition: policy, scenario and world
    :param preset: name of the preset that the world started from
    :param seed: index of the set of held-out episodes
    :param solver: name of the solver that planned
    :return: ``preset``, ``preset_version``, ``world`` (all fields that differ from the preset, with their values),
        ``n_robots``, ``plant``, ``max_steps``, ``seed``, ``solver``, ``versions`` (package -> version),
        ``code_sha256`` (of this package's sources, which a version does not tell in a clone), and for a model
        ``model_sha256``; ``modules`` (module -> SHA-256 of its sources) are those of custom scenarios and rules
    """
    config = replace(condition.config, plant=plant_name(condition.config))
    row = {
        "preset": preset,
        "preset_version": PRESET_VERSION,
        "world": _changes(PRESETS[preset], config),
        "n_robots": config.n_robots,
        "plant": config.plant,
        "max_steps": condition.max_steps or config.max_steps,
        "seed": seed,
        "solver": solver,
        "versions": _versions(condition),
        "code_sha256": sources_digest("quad_swarm"),
    }
    if modules := user_modules():
        row["modules"] = {name: sources_digest(name) for name in modules}
    if is_model(condition.policy):
        row["model_sha256"] = hashlib.sha256(Path(condition.policy.partition("@")[0]).read_bytes()).hexdigest()
    return row


def plant_name(config: SwarmConfig) -> str:
    """Return the full name of a world's simulated vehicle: "crazyflow:cf21B_500" for "crazyflow"."""
    return ":".join(filter(None, parse_plant(config.plant)))


def _changes(preset: Any, config: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that differ from those of another, nested ones and entries of lists as
    dictionaries."""
    changes = {}
    for field in dataclasses.fields(config):
        old, new = getattr(preset, field.name), getattr(config, field.name)
        if old != new:
            changes[field.name] = _changes(old, new) if dataclasses.is_dataclass(new) else _plain(new)
    return changes


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value


def _versions(condition: Condition) -> dict[str, str]:
    names = ["sb3-maddpg", "numpy", "casadi"] + ["torch"] * is_model(condition.policy)
    simulator, _ = parse_plant(condition.config.plant)
    found = {}
    for name in names + [simulator] * (simulator != MODEL):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # its files are there, but no metadata
            found[name] = "unknown"
    return found
