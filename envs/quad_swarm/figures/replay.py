"""``sb3-maddpg replay``: a page that replays an episode.

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

from quad_swarm.evaluation.command import add_policy_arguments, make_conditions, run
from quad_swarm.evaluation.flight import Condition, Flight, fly
from quad_swarm.evaluation.policies import short_name
from quad_swarm.evaluation.rows import check_writable
from quad_swarm.figures.colours import COLOURS
from quad_swarm.quadrotor import POSITION
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.scenarios import SCENARIOS

# Steps shown after all robots have arrived
_LINGER = 10
# Digits behind the point of a metre: finer than a pixel
_DIGITS = 3

# Shown by `sb3-maddpg --help`
EXAMPLES = "  sb3-maddpg replay --policy full pretrained:quad-swarm-paper --scenario symmetric_swap --out replay.html"


def replay_page(conditions: Sequence[Condition], seed: int = 0, episode: int = 0, preset: str = "") -> str:
    """Fly an episode with some policies and make its page.

    :param conditions: policies in one scenario and world
    :param seed: which set of held-out episodes
    :param episode: which episode of it
    :param preset: what the page calls the world
    :return: HTML
    """
    config = conditions[0].config
    data = {
        "scenario": conditions[0].scenario,
        "preset": preset,
        "seed": seed,
        "episode": episode,
        "dt": config.planner.dt,
        "radius": config.radius,
        "goal_radius": config.goal_radius,
        "collision_distance": 2 * config.radius,
        "room": [config.planner.workspace_low, config.planner.workspace_high],
        "colours": COLOURS,
        "flights": [_describe(one.policy, fly(one, seed, episode)) for one in conditions],
    }
    # "</script>" in the name of a policy would end the data
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return files("quad_swarm.figures").joinpath("replay.html").read_text(encoding="utf-8").replace("__DATA__", text)


def _describe(policy: str, flight: Flight) -> dict[str, Any]:
    """What the page needs of a flight, until shortly after the arrival of all robots."""
    end = len(flight.requests) if flight.arrival is None else flight.arrival + _LINGER
    others = other_indices(flight.n_robots)
    return {
        "policy": short_name(policy),
        "positions": flight.pos[: end + 1].round(_DIGITS).tolist(),
        "plans": flight.plans[: end + 1, ..., POSITION].round(_DIGITS).tolist(),
        "goals": flight.goal.round(_DIGITS).tolist(),
        "requests": [[[int(a), int(others[a, k])] for a, k in np.argwhere(step)] for step in flight.requests[:end]],
        "separation": flight.min_separation[: end + 1].round(_DIGITS).tolist(),
        "collision": flight.collision is not None and flight.collision <= end,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="sb3-maddpg replay",
        description="Fly one held-out episode with some policies and write a page that replays it.",
        epilog=f"example:\n{EXAMPLES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_policy_arguments(parser)
    parser.add_argument("--scenario", default="symmetric_swap", help=f"one of {', '.join(SCENARIOS)} (%(default)s)")
    parser.add_argument("--episode", type=int, default=0, help="which episode of the set (default 0)")
    parser.add_argument("--out", type=Path, default=Path("replay.html"), help="the page (default %(default)s)")
    return run(_write, parser.parse_args(argv))


def _write(args: argparse.Namespace) -> None:
    if args.episode < 0:
        raise ValueError(f"--episode {args.episode}: episodes are counted from 0.")
    check_writable(args.out, "--out")
    conditions = make_conditions(args, [args.scenario])
    page = replay_page(conditions, args.seed, args.episode, args.preset)
    args.out.write_text(page, encoding="utf-8")
    print(f"wrote {args.out}, {len(page) / 1e6:.1f} MB: open it in a browser")


if __name__ == "__main__":
    sys.exit(main())
