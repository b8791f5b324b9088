"""Tune every family of hand-made rules as hard as a learner: the cheapest of each that is as safe as asking everybody.

``python benchmarks/swarm_rules.py [--quick] [--preset ...] [--n-robots ...] [--family ...] [--json F]``, on the
validation set. In each scenario all rules of a family fly a few episodes, which tell their requests. Then they are
tried from the cheapest on, in stages of more and more episodes, until one is as safe as full communication
(`Standard`). One that collides clearly more often in an earlier stage is out. JSON: one row for each rule and scenario
with the keys of `quad_swarm.evaluation.summarise` over the episodes that it flew, and preset, scenario, family, rule,
with ``--n-robots`` also n_robots, and safe: True or False, or None for those dearer than the one that was found.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

os.environ.setdefault("OMP_NUM_THREADS", "1")

from tqdm import tqdm

from quad_swarm.evaluate import write_json
from quad_swarm.evaluation import Cell, Comparison, fly_all, summarise
from quad_swarm.presets import PRESETS, SwarmConfig, make_config
from quad_swarm.scenarios import SCENARIOS

Item = TypeVar("Item")

# Sets of held-out episodes, see `first_episode`: rules and thresholds are tuned on one and reported on another. Other
# numbers of robots have a third, because how their thresholds are tuned was chosen after they had flown on the second.
VALIDATION, TEST, TEAM_TEST = 1, 2, 3
# Steps flown on after arrival.
LINGER = 10
STAGES, QUICK_STAGES = (30, 100, 250, 500, 1000, 2000, 4000, 12000), (10, 20)
# More than twelve robots do not fit on the circle of eight. On this one 16 that ask everybody collide in 22 of 2,000
# episodes, twelve on that in 17, 16 on one of 3 to 3.5 m in 14 of 500.
WIDER = {"circle_radius": (3.5, 4.0)}


class Standard(NamedTuple):
    """What is as safe as full communication when rules and thresholds are tuned.

    :param margin: upper bound of the 95 % interval of the paired difference of the collision rates
    :param enough: episodes from which on that is decided, as soon as the interval's half is shorter than the margin
    """

    margin: float
    enough: int


OF_PRESET, OF_TEAM = Standard(0.003, 12000), Standard(0.005, 2000)

DISTANCES = (0.62, 0.65, 0.7, 0.8, 0.9, 1.05, 1.2, 1.5)
LOOK_AHEADS = (1.0, 1.5, 2.0, 3.0, 4.0)


def families() -> dict[str, list[str]]:
    """The rules of each family."""
    cpa = [f"cpa:{d:g}:{t:g}" for d, t in itertools.product((0.6, *DISTANCES, 2.0), LOOK_AHEADS)]
    some = [f"cpa:{d:g}:{t:g}" for d, t in itertools.product(DISTANCES[:-1], (1.5, 2.0, 3.0))]
    return {
        "distance": [f"distance:{d:g}" for d in (1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5, 6)],
        "cpa": cpa,
        "random": [f"random:{p:g}" for p in (0.1, 0.25, 0.5, 0.75, 0.9)],
        "event": [f"event:{e:g}" for e in (0, 0.001, 0.003, 0.01, 0.02, 0.03)],
        "plan": [f"plan:{d:g}" for d in (*DISTANCES, 2.0)],
        "cpa and stale": [f"{rule}&stale:{k}" for rule in some for k in (3, 4, 5)],
        "cpa and event": [f"{rule}&event:{e:g}" for rule in some[::2] for e in (0.003, 0.01)],
        "cpa and plan": [f"{rule}&plan:{d:g}" for rule in some[::3] for d in (0.8, 1.0)],
        "plan and stale": [f"plan:{d:g}&stale:{k}" for d in (0.62, 0.65, 0.7, 0.8, 1.0, 1.5) for k in (2, 3, 4, 6)],
        "plan, or cpa and stale": [
            f"plan:{d:g}{soon}|cpa:{near}&stale:{k}"
            for d, soon in itertools.product((0.62, 0.7), ("", "&soon:0.3"))
            for near in ("0.62:1.5", "0.65:2", "0.8:2", "0.8:3", "1.05:3")
            for k in (2, 3, 4, 6)
        ],
        "cpa, soon or stale": [
            f"{rule}&soon:{t:g}|{rule}&stale:{k}" for rule in some for t in (0.15, 0.3) for k in (4, 6)
        ],
        "two cpa": [
            f"cpa:{near}|cpa:{far}&stale:{k}"
            for near in ("0.65:1", "0.7:1.5", "0.8:1")
            for far in ("0.8:3", "0.9:3", "1.05:3", "1.05:4", "1.2:3")
            for k in (3, 4, 6)
        ],
    }


def fly(
    policies: list[str], preset: str, scenario: str, episodes: int, n_robots: int | None = None, skip: int = 0
) -> dict[str, list[dict[str, float]]]:
    """:return: for each policy the figures of its validation episodes, without the first ``skip``"""
    config = world(preset, n_robots)
    cells = [cell(policy, scenario, config) for policy in policies]
    return {cell.policy: rows for cell, rows in fly_all(cells, episodes, VALIDATION, skip=skip).items()}


def world(preset: str, n_robots: int | None = None) -> SwarmConfig:
    """A preset, or a team of another size in it."""
    return make_config(preset, n_robots=n_robots, space=WIDER if n_robots is not None and n_robots > 12 else None)


def cell(policy: str, scenario: str, config: SwarmConfig, algo: str = "sb3_maddpg:MADDPG") -> Cell:
    """A policy in a scenario as all results here fly it."""
    return Cell(policy, scenario, config, 100, algo, "rti", LINGER)


def hopeless(comparison: Comparison, margin: float = OF_PRESET.margin) -> bool:
    """Whether a policy will hardly turn out as safe as full communication with more episodes."""
    excess = comparison.only_first - comparison.only_second
    return excess >= 4 and excess / comparison.episodes > margin


def in_stages(
    policy: str,
    preset: str,
    scenario: str,
    full: list[dict[str, float]],
    quick: bool,
    n_robots: int | None = None,
    flown: list[dict[str, float]] | None = None,
    standard: Standard | None = None,
) -> tuple[list[dict[str, float]], bool]:
    """Fly a policy in more and more episodes, as long as there is hope and it is not yet decided (`Standard`).

    :param full: figures of full communication in the same episodes; those that are missing are flown and appended
    :param flown: the policy's figures in the first of them
    :param standard: what is as safe; that of the preset or of teams unless given
    :return: the policy's figures, and whether it is as safe; so few episodes as in a quick run prove nothing
    """
    figures = list(flown or [])
    margin, enough = standard or (OF_PRESET if n_robots is None else OF_TEAM)
    for episodes in QUICK_STAGES if quick else STAGES:
        for name, known in ((policy, figures), ("full", full)):
            if episodes > len(known):
                known += fly([name], preset, scenario, episodes, n_robots, skip=len(known))[name]
        comparison = Comparison.of(figures, full[:episodes])
        if hopeless(comparison, margin):
            return figures, False
        low, high = comparison.interval
        if episodes >= enough and (high - low) / 2 < margin:
            return figures, high < margin
    return figures, quick


def tune(preset: str, n_robots: int | None, scenario: str, names: list[str], quick: bool) -> list[dict[str, Any]]:
    """The rows of some families in one scenario."""
    stages, thin = (QUICK_STAGES, 20) if quick else (STAGES, 1)
    n = world(preset, n_robots).n_robots
    full: list[dict[str, float]] = []
    table = []
    for family in names:
        rules = families()[family]
        flown = fly(rules[::thin], preset, scenario, stages[0], n_robots)
        safe: dict[str, bool] = {}
        for rule in sorted(flown, key=lambda rule: summarise(flown[rule], n)["request_share"]):
            flown[rule], safe[rule] = in_stages(rule, preset, scenario, full, quick, n_robots, flown[rule])
            if safe[rule]:
                break
        keys: dict[str, Any] = {"preset": preset, "scenario": scenario, "family": family}
        keys |= {} if n_robots is None else {"n_robots": n_robots}
        table += [keys | {"rule": rule, "safe": safe.get(rule)} | summarise(flown[rule], n) for rule in flown]
        best = [rule for rule in safe if safe[rule]]
        share = f"{summarise(flown[best[0]], n)['request_share']:.2%}" if best else "-"
        print(f"{preset:6} {n:2} {scenario:16} {family:24} {best[0] if best else 'none':45} {share:>8}", flush=True)
    return table


def progress(items: Iterable[Item], what: str, total: int) -> Iterable[Item]:
    """Show in a terminal how many of the items are done."""
    return tqdm(items, what, total, unit="cell", disable=not sys.stderr.isatty(), leave=False)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """What a script wrote; nothing if it has not run."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


def replace_rows(path: Path, rows: list[dict[str, Any]], keys: tuple[str, ...]) -> None:
    """Write rows instead of those with the same keys; the file's other rows stay."""
    new = {tuple(row[key] for key in keys) for row in rows}
    kept = [row for row in read_rows(path) if tuple(row[key] for key in keys) not in new]
    write_json(path, [*kept, *rows])


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", nargs="+", default=list(PRESETS), choices=list(PRESETS))
    parser.add_argument("--scenario", nargs="+", default=list(SCENARIOS), choices=list(SCENARIOS))
    parser.add_argument("--n-robots", nargs="+", type=int, default=[None], help="the preset's unless given")
    parser.add_argument("--family", nargs="+", default=list(families()), choices=list(families()))
    parser.add_argument("--quick", action="store_true", help="few episodes and rules, to see that it runs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    work = [
        (preset, n, scenario, args.family, args.quick)
        for preset in args.preset
        for n in args.n_robots
        for scenario in args.scenario
    ]
    keys = ("preset", "scenario", "family", "n_robots")
    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        for table in progress(pool.map(tune, *zip(*work, strict=True)), "rules", len(work)):
            if args.json:
                replace_rows(args.json, table, keys if "n_robots" in table[0] else keys[:-1])


if __name__ == "__main__":
    main()
