"""Scan how much robots keep to the plans that they sent, how fast they estimate what pushes them, and when they tell.

``python -m studies.swarm.commitment [--commitment 0 3] [--fade 2] [--estimate none 1] [--round-trip 0] [--rule ...]
[--n-robots 8] [--scenario ...] [--episodes 200] [--seed 11] [--jobs 2] [--json F]`` flies every combination in the
disturbances of `flight` with a causal radio: answers take ``--round-trip`` steps, and half of them one more. All fly
the same episodes. Nothing that is chosen here may be tested on the same set. JSON: one row per combination, rule,
scenario and number of robots with `KEPT` of `summarise`, and the closest approach that 1 % of the episodes fall below
(m).
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import Any

from tqdm import tqdm

from quad_swarm.evaluation.evaluation import fly_all, make_pool, summarise
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.scenarios import SCENARIOS
from studies.swarm import protocol
from studies.swarm.experiment import condition

BEST_RULE = "cpa:1.0s:3&soon:0.5|cpa:1.0s:3&stale:4"
KEPT = ("episodes", "collisions", "collision_low", "collision_high", "request_share", "arrived", "steps_to_arrival")
RULES = ("full", BEST_RULE, "stage:0.9:0.3", "stage:0.9:0.2", "stage:1.0:0.2", "stage:1.2:0.3")


def world(n_robots: int, commitment: float, fade: float, estimate: float | None, round_trip: int) -> SwarmConfig:
    """Return `flight` with a causal radio, a commitment and an estimate of disturbances."""
    planner = {"commitment": commitment, "commitment_fade": fade, "disturbance_time": estimate}
    changes: dict[str, Any] = {"planner": planner, "radio": {"delay": 0, "round_trip": round_trip}}
    return make_config(protocol.world("flight", n_robots), changes)


def time_constant(text: str) -> float | None:
    """Read a time constant (s) or "none"."""
    return None if text == "none" else float(text)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commitment", nargs="+", type=float, default=[0.0, 3.0])
    parser.add_argument("--fade", nargs="+", type=float, default=[2.0])
    parser.add_argument(
        "--estimate", nargs="+", type=time_constant, default=[None, 1.0], help="time constants (s), or none"
    )
    parser.add_argument("--round-trip", nargs="+", type=int, default=[0])
    parser.add_argument("--rule", nargs="+", default=RULES)
    parser.add_argument("--n-robots", nargs="+", type=int, default=[8])
    parser.add_argument("--scenario", nargs="+", default=["symmetric_swap"], choices=list(SCENARIOS))
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rows, worlds = [], itertools.product(args.n_robots, args.estimate, args.round_trip, args.commitment, args.fade)
    with make_pool(args.jobs) as pool:
        for n, estimate, round_trip, commitment, fade in tqdm([*worlds], disable=None):
            if not commitment and fade != args.fade[0]:
                continue
            config = world(n, commitment, fade, estimate, round_trip)
            flown = fly_all(
                [condition(rule, scenario, config) for scenario in args.scenario for rule in args.rule],
                args.episodes,
                args.seed,
                executor=pool,
            )
            for one, episodes in flown.items():
                found = summarise(episodes, config)
                near = found["min_separation_quantiles"]["0.01"]
                keys = {"n_robots": n, "estimate": estimate, "round_trip": round_trip, "commitment": commitment}
                keys |= {"fade": fade, "scenario": one.scenario, "rule": one.policy, "seed": args.seed}
                rows.append({**keys, **{name: found[name] for name in KEPT}, "closer_in_one_percent": near})
                print(
                    f"{n:2} T={estimate} trip={round_trip} W={commitment:g}/{fade:g} {one.scenario:16} {one.policy:42} "
                    f"{found['collisions']:3} of {found['episodes']}, 1 % closer than {near:.3f} m, "
                    f"{found['request_share']:6.2%}, {found['steps_to_arrival'] or 0:6.1f} steps, "
                    f"{found['arrived']} arrived",
                    flush=True,
                )
            if args.json:
                write_rows(args.json, rows)


if __name__ == "__main__":
    main()
