"""Tune rules and models in the world of `flight` with one setting for all scenarios and sizes, on the validation set.

``python -m studies.swarm.tune_flight rules|thresholds [MODEL.zip ...] [--quick] [--json F]``. A rule, or a threshold of
a model, is safe if it is as safe as full communication, to within `SAFETY_MARGIN`, in every scenario and with every
number of robots. All rules fly a few episodes of both swaps with eight robots, which tell their requests there; then
they are tried from the cheapest on, in stages of more and more episodes, until one is safe. A model's thresholds are
tried from the highest on. JSON: one row for each setting, number of robots and scenario with the keys of `summarise`
over the episodes that it flew, and family, setting, safe (None: not tried, since a cheaper one is safe).
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
    fly_validation,
    hopeless,
    progress,
    replace_rows,
    world,
)

Cell = tuple[int, str]  # number of robots, scenario
Flown = dict[Cell, Rows]

PRESET = "flight"
SWAPS = ("symmetric_swap", "asymmetric_swap")
# Cells in which all are tuned, those first where most goes wrong; and the episodes that decide
SIZES = {8: 4000, 16: 2000, 12: 2000, 4: 2000}
CELLS: list[Cell] = [
    *itertools.product(SIZES, SWAPS),
    *itertools.product(SIZES, [name for name in NAMES if name not in SWAPS]),
]
OWN_SWAPS = [cell for cell in CELLS if cell[0] == 8 and cell[1] in SWAPS]
STAGES = (50, 100, 250, 500, 1000, 2000, 4000)
THRESHOLDS = (0.99, 0.98, 0.965, *(round(0.95 - 0.025 * k, 3) for k in range(11)), 0.65, 0.6, 0.55, 0.5, 0.4, 0.3)


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


def fly(policy: str, cell: Cell, episodes: int, known: Rows | None = None) -> Rows:
    """A policy's figures of the first episodes, of which some are known."""
    rows, (n_robots, name) = list(known or []), cell
    if episodes > len(rows):
        rows += fly_validation([policy], PRESET, name, episodes, n_robots, skip=len(rows))[policy]
    return rows


def last(cell: Cell, stages: Sequence[int]) -> int:
    """Episodes that decide in a cell."""
    return min(SIZES[cell[0]], stages[-1])


def try_out(policy: str, flown: Flown, full: Flown, stages: Sequence[int]) -> tuple[Flown, bool]:
    """Fly a policy in more and more episodes as long as it may be as safe as full communication in every cell.

    :param flown: its figures, as far as they are known
    :param full: those of full communication, of as many episodes as decide
    :return: the policy's figures, and whether it is as safe; so few episodes as in a quick run prove nothing
    """
    flown = dict(flown)
    for stage, cell in itertools.product(stages, CELLS):
        episodes = min(stage, last(cell, stages))
        flown[cell] = fly(policy, cell, episodes, flown.get(cell))
        comparison = Comparison.of(flown[cell][:episodes], full[cell][:episodes])
        if hopeless(comparison, SAFETY_MARGIN):
            return flown, False
        if episodes >= SIZES[cell[0]] and not comparison.as_safe(SAFETY_MARGIN):
            return flown, False
    return flown, True


def rows_of(family: str, setting: str, flown: Flown, safe: bool | None) -> list[dict[str, Any]]:
    """The rows of a setting."""
    keys = {"preset": PRESET, "family": family, "setting": setting, "safe": safe}
    return [
        keys | {"n_robots": n_robots, "scenario": name} | summarise(rows, world(PRESET, n_robots))
        for (n_robots, name), rows in flown.items()
        if rows
    ]


def share(flown: Flown) -> float:
    """Mean share of requests in both swaps of eight robots."""
    return sum(summarise(flown[cell], world(PRESET))["request_share"] for cell in OWN_SWAPS) / len(OWN_SWAPS)


def tune_rules(pool: Executor, jobs: int, full: Flown, stages: Sequence[int], quick: bool) -> list[dict[str, Any]]:
    """The rows of all rules: as many as there are processes are tried at once, the cheapest first."""
    family_of = {rule: family for family, rules in families().items() for rule in rules[:: 12 if quick else 1]}
    screened: dict[str, Flown] = {rule: {} for rule in family_of}
    for cell in OWN_SWAPS:
        work = pool.map(fly, screened, [cell] * len(screened), [stages[0]] * len(screened))
        for rule, rows in zip(screened, progress(work, cell[1], len(screened)), strict=True):
            screened[rule][cell] = rows
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
            print(f"{rule:45} {share(screened[rule]):.2%} {verdict(screened[rule], full, safe[rule])}", flush=True)
    return [row for rule in screened for row in rows_of(family_of[rule], rule, screened[rule], safe.get(rule))]


def verdict(flown: Flown, full: Flown, safe: bool) -> str:
    """Where a setting turned out not to be safe."""
    if safe:
        return "safe"
    excess = {c: sum(a["collided"] - b["collided"] for a, b in zip(flown[c], full[c], strict=False)) for c in flown}
    cell = max(excess, key=lambda cell: excess[cell])
    collisions = sum(bool(row["collided"]) for row in flown[cell])
    return f"{collisions} of {len(flown[cell])} in {cell[1]} of {cell[0]}"


def tune_thresholds(path: str, full: Flown, stages: Sequence[int]) -> list[dict[str, Any]]:
    """The rows of a model."""
    table = []
    for threshold in THRESHOLDS:
        flown, safe = try_out(f"{path}@{threshold:g}", {}, full, stages)
        table += rows_of(path, f"{path}@{threshold:g}", flown, safe)
        print(f"{path} {threshold:g} {share(flown):.2%} {verdict(flown, full, safe)}", flush=True)
        if safe:
            break
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
        work = pool.map(fly, ["full"] * len(CELLS), CELLS, [last(cell, stages) for cell in CELLS])
        full = {
            # All that is compared; each process gets a copy.
            cell: [{"collided": row["collided"]} for row in rows]
            for cell, rows in zip(CELLS, progress(work, "full", len(CELLS)), strict=True)
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
