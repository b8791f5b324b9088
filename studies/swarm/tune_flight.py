"""Tune rules and models in the world of `flight` with one setting for everything, on the validation set.

``python -m studies.swarm.tune_flight rules|thresholds [MODEL.zip ...] [--quick] [--json F]``. A rule, or a threshold of
a model, is safe if it is as safe as full communication in every scenario (`STANDARD`). All rules fly a few episodes of
both swaps, which tell their requests there; then they are tried from the cheapest on, in stages of more and more
episodes, until one is safe. A model's thresholds are tried from the highest on. JSON: one row for each setting and
scenario with the keys of `summarise` over the episodes that it flew, and family, setting, safe (None: not tried, since
a cheaper one is safe).
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
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

Flown = dict[str, Rows]  # figures by scenario

PRESET = "flight"
SWAPS = ("symmetric_swap", "asymmetric_swap")
STAGES = (50, 100, 250, 500, 1000, 2000, 4000)
STANDARD = Standard(SAFETY_MARGIN, 4000)
THRESHOLDS = (0.98, 0.965, 0.95, 0.925, 0.9, 0.875, 0.85, 0.825, 0.8, 0.775, 0.75, 0.725, 0.7, 0.65, 0.6, 0.55, 0.5)


def families() -> dict[str, list[str]]:
    """The rules of each family."""
    product = itertools.product
    cpas = [f"cpa:{d}:{t}" for d, t in product((0.72, 0.75, 0.78, 0.8, 0.85, 0.9), (0.75, 1, 1.5, 2))]
    plans = [f"plan:0.{d}" for d in range(68, 82)]
    return {
        "plan and stale": [f"{plan}&stale:{k}" for plan, k in product(plans, range(5, 13))],
        "plan, soon and stale": [
            f"{plan}&soon:{t}&stale:{k}" for plan, t, k in product(plans[2::2], (0.5, 0.8, 1.2), (4, 6, 8, 10))
        ],
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


def fly(policy: str, scenario: str, episodes: int, known: Rows | None = None) -> Rows:
    """A policy's figures of the first episodes, of which some are known."""
    rows = list(known or [])
    if episodes > len(rows):
        rows += fly_validation([policy], PRESET, scenario, episodes, skip=len(rows))[policy]
    return rows


def try_out(policy: str, flown: Flown, full: Flown, stages: Sequence[int]) -> tuple[Flown, bool]:
    """Fly a policy in more and more episodes as long as it may be as safe as full communication in every scenario.

    :param flown: its figures by scenario, as far as they are known
    :param full: those of full communication, of as many episodes as the last stage has
    :return: the policy's figures, and whether it is as safe; so few episodes as in a quick run prove nothing
    """
    flown = dict(flown)
    for episodes in stages:
        for name in (*SWAPS, *(name for name in NAMES if name not in SWAPS)):
            flown[name] = fly(policy, name, episodes, flown.get(name))
            comparison = Comparison.of(flown[name][:episodes], full[name][:episodes])
            if hopeless(comparison, STANDARD.margin):
                return flown, False
            if episodes >= STANDARD.enough and not comparison.as_safe(STANDARD.margin):
                return flown, False
    return flown, True


def rows_of(family: str, setting: str, flown: Flown, safe: bool | None) -> list[dict[str, Any]]:
    """The rows of a setting."""
    keys = {"preset": PRESET, "family": family, "setting": setting, "safe": safe}
    return [keys | {"scenario": name} | summarise(rows, world(PRESET)) for name, rows in flown.items() if rows]


def share(flown: Flown) -> float:
    """Mean share of requests in both swaps."""
    return sum(summarise(flown[name], world(PRESET))["request_share"] for name in SWAPS) / len(SWAPS)


def tune_rules(pool: Executor, jobs: int, full: Flown, stages: Sequence[int], quick: bool) -> list[dict[str, Any]]:
    """The rows of all rules: as many as there are processes are tried at once, the cheapest first."""
    family_of = {rule: family for family, rules in families().items() for rule in rules[:: 12 if quick else 1]}
    screened: dict[str, Flown] = {rule: {} for rule in family_of}
    for name in SWAPS:
        work = pool.map(fly, screened, [name] * len(screened), [stages[0]] * len(screened))
        for rule, rows in zip(screened, progress(work, name, len(screened)), strict=True):
            screened[rule][name] = rows
    waiting = sorted(screened, key=lambda rule: share(screened[rule]))
    running: dict[Future[tuple[Flown, bool]], str] = {}
    safe: dict[str, bool] = {}
    while running or (waiting and True not in safe.values()):
        while waiting and len(running) < jobs and True not in safe.values():
            rule = waiting.pop(0)
            running[pool.submit(try_out, rule, screened[rule], full, stages)] = rule
        for done in wait(running, return_when=FIRST_COMPLETED).done:
            rule = running.pop(done)
            screened[rule], safe[rule] = done.result()
            print(f"{rule:45} {share(screened[rule]):.2%} {'safe' if safe[rule] else 'not safe'}", flush=True)
    return [row for rule in screened for row in rows_of(family_of[rule], rule, screened[rule], safe.get(rule))]


def tune_thresholds(path: str, full: Flown, stages: Sequence[int]) -> list[dict[str, Any]]:
    """The rows of a model."""
    table = []
    for threshold in THRESHOLDS:
        flown, safe = try_out(f"{path}@{threshold:g}", {}, full, stages)
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
    parser.add_argument("--quick", action="store_true", help="few episodes, to see that it runs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    if args.what == "thresholds" and not args.models:
        parser.error("name the models whose thresholds are to be tuned")
    stages = QUICK_STAGES if args.quick else STAGES
    with make_pool(args.jobs) as pool:
        work = pool.map(fly, ["full"] * len(NAMES), NAMES, [stages[-1]] * len(NAMES))
        full = {
            # All that is compared; each process gets a copy.
            name: [{"collided": row["collided"]} for row in rows]
            for name, rows in zip(NAMES, progress(work, "full", len(NAMES)), strict=True)
        }
        if args.what == "rules":
            table = tune_rules(pool, args.jobs, full, stages, args.quick)
        else:
            flown = pool.map(tune_thresholds, args.models, [full] * len(args.models), [stages] * len(args.models))
            table = [row for rows in progress(flown, "thresholds", len(args.models)) for row in rows]
    if args.json:
        replace_rows(args.json, table, ("preset", "family"))


if __name__ == "__main__":
    main()
