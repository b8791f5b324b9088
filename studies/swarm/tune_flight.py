"""Tune rules and models in the world of `flight` with one setting for everything, on the validation set.

``python -m studies.swarm.tune_flight rules|thresholds [MODEL.zip ...] [--quick] [--json F]``. A rule, or a threshold of
a model, is safe if it is as safe as full communication in every scenario (`STANDARD`). All rules fly a few episodes of
both swaps, which tell their requests there; then they are tried from the cheapest on, in stages of more and more
episodes, until one is safe. A model's thresholds are tried from the highest on. JSON: one row for each setting and
scenario with the keys of `summarise` over the episodes that it flew, and family, setting, safe (None: not tried).
"""

from __future__ import annotations

import argparse
import itertools
import os
from pathlib import Path
from typing import Any

from quad_swarm.evaluation.evaluation import Rows, make_pool, summarise
from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison
from studies.swarm.protocol import (
    NAMES,
    QUICK_STAGES,
    Standard,
    fly_validation,
    hopeless,
    progress,
    replace_rows,
    world,
)

PRESET = "flight"
SWAPS = ("symmetric_swap", "asymmetric_swap")
STAGES = (100, 250, 500, 1000, 2000, 4000)
STANDARD = Standard(SAFETY_MARGIN, 4000)
THRESHOLDS = (0.98, 0.965, 0.95, 0.925, 0.9, 0.875, 0.85, 0.825, 0.8, 0.775, 0.75, 0.725, 0.7, 0.65, 0.6, 0.55, 0.5)


def families() -> dict[str, list[str]]:
    """The rules of each family."""
    product = itertools.product
    cpas = [f"cpa:{d}:{t}" for d, t in product((0.72, 0.75, 0.78, 0.8, 0.85, 0.9), (0.75, 1, 1.5, 2))]
    return {
        "plan and stale": [f"plan:{d}&stale:{k}" for d, k in product((0.72, 0.74, 0.76, 0.78, 0.8), (4, 6, 8, 10, 12))],
        "cpa and stale": [f"{cpa}&stale:{k}" for cpa, k in product(cpas, (6, 8, 10))],
        "cpa and event": [f"{cpa}&event:{e}" for cpa, e in product(cpas[::2], (0.03, 0.05, 0.1))],
        "cpa and push": [f"{cpa}&push:{e}" for cpa, e in product(cpas[::2], (0.15, 0.3))],
        "plan and push": [f"plan:{d}&push:{e}" for d, e in product((0.72, 0.76, 0.8), (0.1, 0.2, 0.3))],
        "push": [f"push:{e}" for e in (0.2, 0.4, 0.6, 0.8, 1.0)],
        "cpa, soon or stale": [
            f"{cpa}&soon:{t}|{cpa}&stale:{k}" for cpa, t, k in product(cpas[8:16:2], (0.2, 0.3), (8, 10))
        ],
        "plan, soon or stale": [
            f"plan:{d}&soon:{t}|plan:{d}&stale:{k}" for d, t, k in product((0.74, 0.76, 0.78), (0.2, 0.4), (6, 8, 10))
        ],
        "plan or cpa, stale": [
            f"plan:{d}&stale:{k}|cpa:{c}&stale:{k}"
            for d, c, k in product((0.72, 0.76), ("0.72:0.75", "0.75:1"), (6, 8, 10))
        ],
    }


class Trial:
    """Full communication in the episodes flown so far, and who is compared with it.

    :param quick: few episodes, to see that it runs
    """

    def __init__(self, quick: bool):
        self.stages = QUICK_STAGES if quick else STAGES
        self.quick = quick
        self._full: dict[str, Rows] = {name: [] for name in NAMES}

    def fly(self, policy: str, scenario: str, known: Rows, episodes: int) -> Rows:
        """A policy's figures of the first episodes, of which some are known."""
        if episodes > len(known):
            known = known + fly_validation([policy], PRESET, scenario, episodes, skip=len(known))[policy]
        return known

    def safe(self, policy: str, flown: dict[str, Rows]) -> bool:
        """Whether a policy is as safe as full communication in every scenario; adds what it flies to ``flown``."""
        for episodes in self.stages:
            for name in (*SWAPS, *(name for name in NAMES if name not in SWAPS)):
                flown[name] = self.fly(policy, name, flown.get(name, []), episodes)
                self._full[name] = self.fly("full", name, self._full[name], episodes)
                comparison = Comparison.of(flown[name][:episodes], self._full[name][:episodes])
                if hopeless(comparison, STANDARD.margin):
                    return False
                if episodes == self.stages[-1] and not (self.quick or comparison.as_safe(STANDARD.margin)):
                    return False
        return True


def rows_of(family: str, setting: str, flown: dict[str, Rows], safe: bool | None) -> list[dict[str, Any]]:
    """The rows of a setting."""
    keys = {"preset": PRESET, "family": family, "setting": setting, "safe": safe}
    return [keys | {"scenario": name} | summarise(rows, world(PRESET)) for name, rows in flown.items() if rows]


def share(flown: dict[str, Rows]) -> float:
    """Mean share of requests in both swaps."""
    return sum(summarise(flown[name], world(PRESET))["request_share"] for name in SWAPS) / len(SWAPS)


def tune_rules(family: str, quick: bool) -> list[dict[str, Any]]:
    """The rows of a family."""
    trial, rules = Trial(quick), families()[family][:: 12 if quick else 1]
    flown = {rule: {name: trial.fly(rule, name, [], trial.stages[0]) for name in SWAPS} for rule in rules}
    table, found = [], ""
    for rule in sorted(rules, key=lambda rule: share(flown[rule])):
        safe = None if found else trial.safe(rule, flown[rule])
        found = rule if safe else found
        table += rows_of(family, rule, flown[rule], safe)
    print(f"{family:24} {found or 'none':45} {share(flown[found]) if found else 1:.2%}", flush=True)
    return table


def tune_thresholds(path: str, quick: bool) -> list[dict[str, Any]]:
    """The rows of a model."""
    trial = Trial(quick)
    table = []
    for threshold in THRESHOLDS:
        flown: dict[str, Rows] = {}
        safe = trial.safe(f"{path}@{threshold:g}", flown)
        table += rows_of(path, f"{path}@{threshold:g}", flown, safe)
        if safe:
            print(f"{path} {threshold:g} {share(flown):.2%}", flush=True)
            return table
    print(f"{path}: no threshold is as safe as full communication", flush=True)
    return table


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("rules", "thresholds"))
    parser.add_argument("models", nargs="*", metavar="MODEL.zip")
    parser.add_argument("--family", nargs="+", default=list(families()), choices=list(families()))
    parser.add_argument("--quick", action="store_true", help="few episodes, to see that it runs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    if args.what == "thresholds" and not args.models:
        parser.error("name the models whose thresholds are to be tuned")
    run, items = (tune_rules, args.family) if args.what == "rules" else (tune_thresholds, args.models)
    with make_pool(args.jobs) as pool:
        work = pool.map(run, items, [args.quick] * len(items))
        for table in progress(work, args.what, len(items)):
            if args.json:
                replace_rows(args.json, table, ("preset", "family"))


if __name__ == "__main__":
    main()
