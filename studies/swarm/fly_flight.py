"""Fly the sealed test set of `flight`: ``python -m studies.swarm.fly_flight [--n-robots ...] [--quick] [--json F]``.

Full and no communication, the best rule with one setting, and all models with theirs, each in every scenario, and with
four robots also the models that were trained with the paper's settings; what the file already holds is not flown again.
Who flies is read from ``flight_tuning.json``, which `studies.swarm.tune_flight`
writes: commit it first. JSON: one row for each condition with the keys of
`summarise`, its episodes' outcomes as text (1: a collision) for paired comparisons, and scenario, policy, n_robots.
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

# Episodes of each condition by the number of robots
EPISODES = {8: 12000, 4: 4000, 12: 4000, 16: 4000}
QUICK = 10
# The models of the paper's settings, which fly with the number of robots that they were trained with alone
PAPERS = "faithful_flight"


class Job(NamedTuple):
    """A condition."""

    n_robots: int
    scenario: str
    policy: str
    episodes: int


def tuned() -> Iterator[dict[str, Any]]:
    """The rows of all settings that are safe, but for full communication."""
    return (row for row in known_rows(DATA / "flight_tuning.json") if row["safe"] and row["family"] != FULL)


def best_rule() -> str:
    """The rule that is safe everywhere with the fewest requests in both swaps of eight robots."""
    return _cheapest("rule", lambda setting: not is_model(setting))


def best_model() -> str:
    """The model, with its threshold, of which the same is true: the one that is shipped."""
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
    """The models with their thresholds; those that have none that is safe fly with their own."""
    safe = {row["family"]: row["setting"] for row in tuned()}
    return [safe.get(path, path) for path in models("flight")]


def jobs(sizes: list[int], quick: bool) -> list[Job]:
    """All conditions, the most robots last."""
    everywhere = ["full", "none", best_rule(), *tuned_models()]
    return [
        Job(n, name, policy, QUICK if quick else EPISODES[n])
        for n in sorted(sizes)
        for policy in (*everywhere, *(models(PAPERS) if n == 4 else ()))
        for name in NAMES
    ]


def fly(job: Job) -> dict[str, Any]:
    """The row of a condition."""
    config = world(PRESET, job.n_robots)
    ((_, rows),) = fly_kept([condition(job.policy, job.scenario, config)], job.episodes, FLIGHT_TEST).items()
    outcomes = "".join("1" if row["collided"] else "0" for row in rows)
    return {"preset": PRESET, "set": FLIGHT_TEST, **job._asdict(), **summarise(rows, config), "outcomes": outcomes}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-robots", nargs="+", type=int, default=list(EPISODES), choices=list(EPISODES))
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} episodes of each condition")
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
