"""Fly the sealed test of `flight-v2`: full communication, none, rules and a model of version 1.

``python -m studies.swarm.version2 [--part full ...] [--episodes ...] [--jobs 2] [--json F]`` flies set 700, on which
nothing was chosen, in parts: ``obstacles``, ``full`` (all scenarios with eight robots), ``sixteen``, ``rules``,
``teams`` (four and twelve) and ``none``. JSON: one row per policy, scenario and number of robots with the keys of
`summarise`; written after each part, so that a run that is ended keeps what it has.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from quad_swarm.evaluation.evaluation import fly_all, make_pool, summarise
from quad_swarm.evaluation.rows import aligned, write_rows
from quad_swarm.world.scenarios import MOST_OBSTACLES, without_obstacles
from studies.swarm.commitment import BEST_RULE
from studies.swarm.experiment import condition
from studies.swarm.protocol import world

SEALED = 700
SWAPS = ("asymmetric_swap", "symmetric_swap")


class Part(NamedTuple):
    """Policies that fly scenarios with some number of robots."""

    policies: tuple[str, ...]
    scenarios: tuple[str, ...]
    n_robots: tuple[int, ...]
    episodes: int


PARTS = {
    "obstacles": Part(("full",), tuple(MOST_OBSTACLES), (8,), 2000),
    "full": Part(("full",), tuple(without_obstacles()), (8,), 2000),
    "sixteen": Part(("full", "stage:1.0:0.2", "stage:1.2:0.3"), ("symmetric_swap",), (16,), 2000),
    "rules": Part((BEST_RULE, "stage:0.9:0.3", "stage:1.0:0.2"), SWAPS, (8,), 2000),
    "teams": Part(("full", "stage:1.0:0.2"), ("symmetric_swap",), (4, 12), 2000),
    "none": Part(("none",), SWAPS, (8,), 1000),
}


def fly(part: Part, episodes: int | None, executor: Any) -> Iterator[dict[str, Any]]:
    """Fly a part. Yields its rows.

    :param episodes: number of episodes, None for the part's
    """
    for n in part.n_robots:
        config = world("flight-v2", n)
        conditions = [condition(policy, name, config) for name in part.scenarios for policy in part.policies]
        for one, rows in fly_all(conditions, episodes or part.episodes, SEALED, executor=executor).items():
            yield {"policy": one.policy, "scenario": one.scenario, "n_robots": n, **summarise(rows, config)}


def table(rows: list[dict[str, Any]]) -> str:
    """Format rows."""
    texts = [
        ["robots", "scenario", "policy", "collided", "95 % interval", "1 % closer than", "plans", "arrived", "steps"]
    ]
    for row in rows:
        texts.append([
            str(row["n_robots"]),
            row["scenario"],
            row["policy"],
            f"{row['collisions']}/{row['episodes']}",
            f"{100 * row['collision_low']:.2f} - {100 * row['collision_high']:.2f} %",
            f"{row['min_separation_quantiles']['0.01']:.3f} m",
            f"{row['request_share']:.2%}",
            str(row["arrived"]),
            "-" if row["steps_to_arrival"] is None else f"{row['steps_to_arrival']:.1f}",
        ])  # fmt: skip
    return aligned(texts, 3)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--episodes", type=int, help="default: those of each part")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with make_pool(args.jobs) as pool:
        for name in args.part:
            found = list(fly(PARTS[name], args.episodes, pool))
            rows += found
            print(table(found), flush=True)
            if args.json:
                write_rows(args.json, rows)


if __name__ == "__main__":
    main()
