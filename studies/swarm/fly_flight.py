"""Fly the sealed test set of `flight`: ``python -m studies.swarm.fly_flight [--n-robots ...] [--quick] [--json F]``.

Full and no communication, the best rule and all models, each with a single setting, fly in all scenarios. With four
robots, the models that were trained with the paper's settings also fly. Conditions that the file already contains are
not flown again. The policies come from ``flight_tuning.json``, which `studies.swarm.tune_flight` writes: commit it
first. JSON: one row per condition with the keys of `summarise`, the outcomes of its episodes as text (1: a collision)
for paired comparisons, and scenario, policy, n_robots.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from quad_swarm.evaluation.command import add_worker_arguments, workers
from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.evaluation.policies import is_model
from quad_swarm.evaluation.rows import read_rows
from studies.swarm.protocol import (
    DATA,
    FLIGHT_TEST,
    NAMES,
    ROOT,
    absolute_path,
    condition,
    fly_kept,
    known_rows,
    models,
    progress,
    replace_rows,
    world,
)
from studies.swarm.tune_flight import FULL, OWN_SWAPS, PRESET

# Number of episodes per condition by the number of robots
EPISODES = {8: 12000, 4: 4000, 12: 4000, 16: 4000}
QUICK = 10
# Recipe of the models with the paper's settings, which only fly with the number of robots of their training
PAPERS = "faithful_flight"


class Job(NamedTuple):
    """A condition."""

    n_robots: int
    scenario: str
    policy: str
    episodes: int


def tuned() -> Iterator[dict[str, Any]]:
    """Return the rows of all safe settings except full communication."""
    return (row for row in known_rows(DATA / "flight_tuning.json") if row["safe"] and row["family"] != FULL)


def best_rule() -> str:
    """Return the rule that is safe everywhere and makes the fewest requests in both swaps of eight robots."""
    return _cheapest("rule", lambda setting: not is_model(setting))


def best_model() -> str:
    """Return the model with its threshold that is safe everywhere and makes the fewest requests in both swaps of eight
    robots. This model is shipped."""
    return _cheapest("model", is_model)


def _cheapest(what: str, is_one: Callable[[str], bool]) -> str:
    shares: dict[str, list[float]] = {}
    for row in tuned():
        if is_one(row["setting"]) and (row["n_robots"], row["scenario"]) in OWN_SWAPS:
            shares.setdefault(row["setting"], []).append(row["request_share"])
    if not shares:
        raise ValueError(f"{DATA / 'flight_tuning.json'} holds no safe {what}: run `studies.swarm.tune_flight` first.")
    return min(shares, key=lambda setting: sum(shares[setting]))


def tuned_models() -> list[str]:
    """Return the models with their tuned thresholds. Models without a safe threshold keep their own."""
    safe = {row["family"]: row["setting"] for row in tuned()}
    return [safe.get(path, path) for path in models("flight")]


def jobs(sizes: list[int], quick: bool) -> list[Job]:
    """Return all conditions, by increasing number of robots."""
    everywhere = ["full", "none", best_rule(), *tuned_models()]
    return [
        Job(n, name, policy, QUICK if quick else EPISODES[n])
        for n in sorted(sizes)
        for policy in (*everywhere, *(models(PAPERS) if n == 4 else ()))
        for name in NAMES
    ]


def fly(job: Job) -> dict[str, Any]:
    """Fly a condition and return its row."""
    config = world(PRESET, job.n_robots)
    ((_, rows),) = fly_kept([condition(job.policy, job.scenario, config)], job.episodes, FLIGHT_TEST).items()
    outcomes = "".join("1" if row["collided"] else "0" for row in rows)
    return {"preset": PRESET, "set": FLIGHT_TEST, **job._asdict(), **summarise(rows, config), "outcomes": outcomes}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-robots", nargs="+", type=int, default=list(EPISODES), choices=list(EPISODES))
    parser.add_argument("--quick", action="store_true", help=f"fly only {QUICK} episodes per condition")
    add_worker_arguments(parser, jobs=os.cpu_count() or 1)
    parser.add_argument("--json", type=absolute_path, default=DATA / "flight.json", metavar="FILE")
    args = parser.parse_args()
    os.chdir(ROOT)
    keys = ("n_robots", "scenario", "policy")
    flown = {tuple(row[key] for key in keys) for row in read_rows(args.json)}
    work = [job for job in jobs(args.n_robots, args.quick) if (job.n_robots, job.scenario, job.policy) not in flown]
    with workers(args) as pool:
        for row in progress(pool.map(fly, work), "flight", len(work)):
            replace_rows(args.json, [row], keys)


if __name__ == "__main__":
    main()
