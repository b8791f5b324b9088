"""Swarms that send no messages: ORCA and buffered Voronoi cells beside the planner without and with messages.

``python -m studies.rivals [--json F]`` flies 100 episodes of eight robots in each of two presets and three scenarios.
``python -m studies.rivals --choose orca voronoi [--json F]`` flies the grids from which the parameters of both were
chosen, on another set of episodes: most episodes in which all arrive without a collision before the preset's time
limit, and of those that are equal the shortest time to arrival. ``--crowds`` flies ORCA with the parameters that were
chosen in free rooms and with those of crowds, where they were chosen, on a set of their own.

Whoever has not arrived after `LIMIT` seconds without a collision is deadlocked. JSON: one row per preset, scenario and
swarm with what `quad_swarm.evaluation.summarise` returns, ``in_time`` (arrived before the preset's time limit) and
``deadlocks``; of the grids, one row per point with its parameters, ``in_time``, ``collisions`` and the mean
``seconds`` to arrival.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.evaluation import Condition
from quad_swarm.evaluation.evaluation import Rows, fly_all, summarise
from quad_swarm.evaluation.rows import aligned, write_rows
from quad_swarm.planner import PROBLEMS, SOLVERS, OrcaSolver, VoronoiCells
from quad_swarm.world.presets import PRESETS, SwarmConfig, make_config
from studies.swarm import protocol

CHOOSING, MEASURED, OF_CROWDS = 93, 94, 97  # sets of held-out episodes
N_ROBOTS = 8
SCENARIOS = ("symmetric_swap", "asymmetric_swap", "random")
WORLDS = ("paper", "flight")
LIMIT = 30.0  # s
Cells = list[tuple[SwarmConfig, str]]  # worlds and scenarios
# Swarm -> policy, planner's problem, horizon (s) or None for the preset's
SWARMS: dict[str, tuple[str, str, float | None]] = {
    "planner, no messages": ("none", "quadrotor", None),
    "planner, all plans": ("full", "quadrotor", None),
    "ORCA": ("none", "orca", None),
    "Voronoi cells": ("none", "voronoi", 0.7),
}
GRIDS: dict[str, list[dict[str, tuple[float, ...]]]] = {
    "orca": [
        {"horizon": (1.0, 1.5, 2.0), "margin": (0.05, 0.1, 0.15), "bandwidth": (6.0, 8.0, 10.0)},
        {"speed": (2.0, 3.0, 4.0), "settling": (0.4, 0.6)},
    ],
    "voronoi": [
        {"seconds": (0.6, 0.7), "buffer": (0.0, 0.05), "rest": (0.0, 0.05), "detour": (2.0,), "stuck": (0.6,)},
    ],
    "crowds": [
        {"horizon": (0.6, 1.0, 1.5), "margin": (0.05, 0.15, 0.25, 0.35)},
        {"speed": (2.0, 3.0, 4.0), "settling": (0.4, 0.6)},
    ],
}
# What a first grid holds fixed
FIRST: dict[str, dict[str, Any]] = {
    "orca": {"speed": 3.0, "settling": 0.6},
    "voronoi": {},
    "crowds": {"speed": 4.0, "settling": 0.4},
}
CROWDS = (("symmetric_swap", 16), ("forest", 8), ("doorway", 8))
# ORCA's parameters: its own, and those that `--choose crowds` chose
POINTS: dict[str, dict[str, Any]] = {"of free rooms": {}, "of crowds": {"margin": 0.05}}


def fly(
    policy: str, problem: str, seconds: float | None, episodes: int, seed: int, limit: float | None, cells: Cells
) -> dict[Condition, Rows]:
    """Fly worlds.

    :param policy: the policy
    :param problem: the planner's problem
    :param seconds: horizon (s), None for the preset's
    :param episodes: episodes of each
    :param seed: set of held-out episodes
    :param limit: time limit (s), None for the preset's
    :param cells: worlds and scenarios
    """
    conditions = []
    for config, scenario in cells:
        dt, planner = config.planner.dt, dict[str, Any](problem=problem)
        if seconds is not None:
            planner["horizon"] = round(seconds / dt)
        world = make_config(config, planner=planner)
        conditions.append(Condition(policy, scenario, world, None if limit is None else round(limit / dt)))
    return fly_all(conditions, episodes, seed)


def free_rooms() -> Cells:
    """Return both presets with eight robots, in all scenarios."""
    worlds = [make_config(preset, n_robots=N_ROBOTS) for preset in WORLDS]
    return [(world, scenario) for world in worlds for scenario in SCENARIOS]


def crowds() -> Cells:
    """Return the cells of `CROWDS`."""
    return [(protocol.world("flight-v2", n), scenario) for scenario, n in CROWDS]


def choose(kind: str, episodes: int) -> Iterator[dict[str, Any]]:
    """Fly the grids of a kind, each around the best point of those before. Yields a row for each point."""
    best: dict[str, Any] = dict(FIRST[kind])
    for grid in GRIDS[kind]:
        rows = []
        for values in itertools.product(*grid.values()):
            point = best | dict(zip(grid, values, strict=True))
            rows.append(_fly_point(kind, point, episodes))
            yield rows[-1]
        best = max(rows, key=merit)["parameters"]


def merit(row: dict[str, Any]) -> tuple[float, float]:
    """Return what is compared of two points: the larger one is better."""
    return row["in_time"], -row["seconds"]


def _fly_point(kind: str, parameters: dict[str, Any], episodes: int) -> dict[str, Any]:
    values = dict(parameters)
    seconds = values.pop("seconds", None)
    try:
        if kind != "voronoi":
            SOLVERS["orca"] = functools.partial(OrcaSolver, **values)
            cells = free_rooms() if kind == "orca" else crowds()
            flown = fly("none", "orca", None, episodes, CHOOSING, None, cells)
        else:
            PROBLEMS["voronoi"] = type("Varied", (VoronoiCells,), values)
            flown = fly("none", "voronoi", seconds, episodes, CHOOSING, None, free_rooms())
    finally:
        SOLVERS["orca"], PROBLEMS["voronoi"] = OrcaSolver, VoronoiCells
    times = [
        row["steps_counted"] * condition.config.planner.dt
        for condition, rows in flown.items()
        for row in rows
        if row["arrived"]
    ]
    return {
        "kind": kind,
        "parameters": parameters,
        "episodes": sum(map(len, flown.values())),
        "in_time": len(times),
        "collisions": int(sum(row["collided"] for rows in flown.values() for row in rows)),
        "seconds": round(float(np.mean(times)), 2) if times else float("inf"),
    }


def measure(swarms: list[str], episodes: int) -> Iterator[dict[str, Any]]:
    """Fly some of `SWARMS`. Yields a row for each preset, scenario and swarm."""
    for name in swarms:
        policy, problem, seconds = SWARMS[name]
        for condition, rows in fly(policy, problem, seconds, episodes, MEASURED, LIMIT, free_rooms()).items():
            config = condition.config
            preset = next(one for one in WORLDS if PRESETS[one].planner.dt == config.planner.dt)
            arrived = [row for row in rows if row["arrived"]]
            yield {
                "preset": preset,
                "scenario": condition.scenario,
                "swarm": name,
                **summarise(rows, config),
                "in_time": sum(row["steps_counted"] <= config.max_steps for row in arrived),
                "deadlocks": int(sum(not row["arrived"] and not row["collided"] for row in rows)),
                "dt": config.planner.dt,
            }


def measure_crowds(episodes: int) -> Iterator[dict[str, Any]]:
    """Fly ORCA with each of `POINTS`. Yields a row for each point and world."""
    for name, values in POINTS.items():
        try:
            SOLVERS["orca"] = functools.partial(OrcaSolver, **values)
            flown = fly("none", "orca", None, episodes, OF_CROWDS, None, crowds())
        finally:
            SOLVERS["orca"] = OrcaSolver
        for condition, rows in flown.items():
            keys = {"swarm": f"ORCA, parameters {name}", "scenario": condition.scenario}
            yield keys | {"n_robots": condition.config.n_robots} | summarise(rows, condition.config)


def table(rows: list[dict[str, Any]]) -> str:
    """Format the rows of `measure`."""
    texts = [["preset", "scenario", "swarm", "collided", "95 % interval", "in time", "deadlocked", "arrival (s)"]]
    for row in sorted(rows, key=lambda one: (WORLDS.index(one["preset"]), SCENARIOS.index(one["scenario"]))):
        steps, n = row["steps_to_arrival"], row["episodes"]
        texts.append([
            row["preset"],
            row["scenario"],
            row["swarm"],
            f"{row['collisions']}/{n}",
            f"{100 * row['collision_low']:.1f} - {100 * row['collision_high']:.1f} %",
            f"{row['in_time']}/{n}",
            str(row["deadlocks"]),
            "-" if steps is None else f"{steps * row['dt']:.1f}",
        ])  # fmt: skip
    return aligned(texts, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--choose", nargs="+", choices=GRIDS, default=[], help="fly the grids of these instead")
    parser.add_argument("--crowds", action="store_true", help="fly ORCA in crowds and among obstacles instead")
    parser.add_argument("--swarm", nargs="+", choices=SWARMS, default=list(SWARMS), help="fly these only")
    parser.add_argument("--episodes", type=int, help="per preset and scenario (default 100, of the grids 24)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows")
    args = parser.parse_args()
    rows = []
    for kind in args.choose:
        for row in choose(kind, args.episodes or 24):
            print(*(f"{name}={value}" for name, value in row["parameters"].items()), end=": ")
            print(
                f"{row['in_time']} of {row['episodes']} in time, {row['collisions']} collided, {row['seconds']:.2f} s",
                flush=True,
            )
            rows.append(row)
    if args.crowds:
        for row in measure_crowds(args.episodes or 300):
            low, high = 100 * row["collision_low"], 100 * row["collision_high"]
            print(
                f"{row['swarm']}, {row['n_robots']}, {row['scenario']}: {row['collisions']} of {row['episodes']} "
                f"collided [{low:.1f}, {high:.1f}] %, {row['arrived']} arrived, "
                f"{row['steps_to_arrival'] or math.nan:.1f} steps",
                flush=True,
            )
            rows.append(row)
    elif not args.choose:
        rows = list(measure(args.swarm, args.episodes or 100))
        print(table(rows))
    if args.json is not None:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
