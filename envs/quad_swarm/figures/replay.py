"""A page that replays an episode: ``python -m quad_swarm.figures.replay --policy full MODEL.zip --scenario symmetric_swap``.

One HTML file that needs no other: a view in three dimensions, a time slider, and for each policy who asked whom, how
close the robots came and how often they asked. All policies fly the same held-out episode.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.evaluation.command import add_policy_arguments, make_cells, run
from quad_swarm.evaluation.evaluation import Cell, Flight, fly, short_name
from quad_swarm.figures.colours import OKABE_ITO
from quad_swarm.geometry import length
from quad_swarm.quadrotor import POSITION
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.scenarios import SCENARIOS

# Steps shown after all robots have arrived
_LINGER = 10
# Digits behind the point of a metre: finer than a pixel
_DIGITS = 3


def replay_page(cells: Sequence[Cell], seed: int = 0, episode: int = 0, preset: str = "") -> str:
    """Fly an episode with some policies and make its page.

    :param cells: policies in one scenario and world
    :param seed: which set of held-out episodes
    :param episode: which episode of it
    :param preset: what the page calls the world
    :return: HTML
    """
    config = cells[0].config
    data = {
        "scenario": cells[0].scenario,
        "preset": preset,
        "seed": seed,
        "episode": episode,
        "dt": config.planner.dt,
        "radius": config.radius,
        "goal_radius": config.goal_radius,
        "collision_distance": 2 * config.radius,
        "room": [config.planner.workspace_low, config.planner.workspace_high],
        "colours": OKABE_ITO,
        "flights": [_describe(cell, fly(cell, seed, episode)) for cell in cells],
    }
    # "</script>" in the name of a policy would end the data
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return files("quad_swarm.figures").joinpath("replay.html").read_text(encoding="utf-8").replace("__DATA__", text)


def _describe(cell: Cell, flight: Flight) -> dict[str, Any]:
    """What the page needs of a flight, until shortly after the arrival of all robots."""
    n = len(flight.goal)
    arrived = length(flight.state[..., POSITION] - flight.goal) <= cell.config.goal_radius
    end = int(arrived.all(axis=1).argmax()) + _LINGER if arrived.all(axis=1).any() else len(flight.requests)
    pos, plans = flight.state[: end + 1, :, POSITION], flight.plans[: end + 1, ..., POSITION]
    others = other_indices(n)
    i, j = np.triu_indices(n, k=1)
    separation = length(pos[:, i] - pos[:, j]).min(axis=-1)
    return {
        "policy": short_name(cell.policy),
        "positions": pos.round(_DIGITS).tolist(),
        "plans": plans.round(_DIGITS).tolist(),
        "goals": flight.goal.round(_DIGITS).tolist(),
        "requests": [[[int(a), int(others[a, k])] for a, k in np.argwhere(step)] for step in flight.requests[:end]],
        "separation": separation.round(_DIGITS).tolist(),
        "collision": bool(separation.min() < 2 * cell.config.radius - cell.config.collision_tolerance),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m quad_swarm.figures.replay",
        description="Fly one held-out episode with some policies and write a page that replays it.",
        epilog="Example: python -m quad_swarm.figures.replay --policy full cpa:0.7:1.5 --scenario symmetric_swap --out a.html",
    )
    add_policy_arguments(parser)
    parser.add_argument("--scenario", default="symmetric_swap", help=f"one of {', '.join(SCENARIOS)} (%(default)s)")
    parser.add_argument("--episode", type=int, default=0, help="which episode of the set (default 0)")
    parser.add_argument("--out", type=Path, default=Path("replay.html"), help="the page (default %(default)s)")
    return run(_write, parser.parse_args(argv))


def _write(args: argparse.Namespace) -> None:
    if args.episode < 0:
        raise ValueError(f"--episode {args.episode}: episodes are counted from 0.")
    page = replay_page(make_cells(args, [args.scenario]), args.seed, args.episode, args.preset)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(page, encoding="utf-8")
    print(f"wrote {args.out}, {len(page) / 1e6:.1f} MB: open it in a browser")


if __name__ == "__main__":
    sys.exit(main())
