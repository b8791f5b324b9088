"""Fly a sealed test set of `flight`.

``python -m studies.swarm.fly_flight [--up-to 12] [--n-robots ...] [--quick] [--json F]``. Full and no communication,
the best rule and all models, each with a single setting, fly in all scenarios. With four robots, the models that were
trained with the paper's settings also fly. Conditions that the file already contains are not flown again. The settings
are those that `studies.swarm.tune_flight` has written with the same ``--up-to``: commit them first. Those for up to
sixteen robots fly another set, without the policies that have no setting. JSON: one row per condition with the keys of
`summarise`, the outcomes of its episodes as text (1: a collision) for paired comparisons, and scenario, policy,
n_robots.
"""

from __future__ import annotations

import argparse
import os
from typing import Any, NamedTuple

from quad_swarm.evaluation.command import add_worker_arguments, workers
from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.evaluation.rows import read_rows
from studies.swarm.protocol import (
    DATA,
    FLIGHT_TESTS,
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
from studies.swarm.tune_flight import AIMS, FILES, PRESET, SWAPS, UP_TO, cheapest_rule

# Number of episodes per condition by the number of robots
EPISODES = {8: 12000, 4: 4000, 12: 4000, 16: 4000}
QUICK = 10
# Recipe of the models with the paper's settings, which only fly with the number of robots of their training
PAPERS = "faithful_flight"


FLOWN = {12: "flight.json.gz", 16: "flight_sixteen_sealed.json.gz"}  # by the number of robots of the largest team


class Job(NamedTuple):
    """A condition, and the sealed set that it flies."""

    set: int
    n_robots: int
    scenario: str
    policy: str
    episodes: int


def best_rule(up_to: int = UP_TO) -> str:
    """Return the rule that is safe everywhere and makes the fewest requests in both swaps of eight robots.

    :param up_to: number of robots of the largest team that it was tuned for
    :raises ValueError: if no rule is safe
    """
    if (rule := cheapest_rule(known_rows(DATA / FILES[up_to]))) is None:
        raise ValueError(f"{DATA / FILES[up_to]} holds no safe rule: run `studies.swarm.tune_flight` first.")
    return rule


def tuned_models(up_to: int = UP_TO) -> list[str]:
    """Return the models with their tuned thresholds. Models without one keep their own."""
    rows = known_rows(DATA / FILES[up_to])
    tuned = {row["family"]: row["setting"] for row in rows if row.get("chosen", row["safe"])}
    return [tuned.get(path, path) for path in models("flight")]


def jobs(sizes: list[int], quick: bool, up_to: int = UP_TO) -> list[Job]:
    """Return all conditions: first the swaps, in which most collisions occur, and the largest teams."""
    first = up_to == UP_TO  # the policies without a setting have flown with this one
    everywhere = ["full", *(["none"] if first else []), best_rule(up_to), *tuned_models(up_to)]
    work = [
        Job(FLIGHT_TESTS[up_to], n, name, policy, QUICK if quick else EPISODES[n])
        for n in sizes
        for policy in (*everywhere, *(models(PAPERS) if n == 4 and first else ()))
        for name in NAMES
    ]
    return sorted(work, key=lambda job: (job.scenario not in SWAPS, -job.n_robots))


def fly(job: Job) -> dict[str, Any]:
    """Fly a condition and return its row."""
    config = world(PRESET, job.n_robots)
    ((_, rows),) = fly_kept([condition(job.policy, job.scenario, config)], job.episodes, job.set).items()
    outcomes = "".join("1" if row["collided"] else "0" for row in rows)
    return {"preset": PRESET, **job._asdict(), **summarise(rows, config), "outcomes": outcomes}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--up-to", type=int, choices=AIMS, default=UP_TO, help="as in tune_flight")
    parser.add_argument("--n-robots", nargs="+", type=int, default=list(EPISODES), choices=list(EPISODES))
    parser.add_argument("--quick", action="store_true", help=f"fly only {QUICK} episodes per condition")
    add_worker_arguments(parser, jobs=os.cpu_count() or 1)
    parser.add_argument(
        "--json", type=absolute_path, metavar="FILE", help=f"default: {', '.join(FLOWN.values())} in {DATA}"
    )
    args = parser.parse_args()
    os.chdir(ROOT)
    path = args.json or DATA / FLOWN[args.up_to]
    keys = ("n_robots", "scenario", "policy")
    flown = {tuple(row[key] for key in keys) for row in read_rows(path)}
    work = [
        job
        for job in jobs(args.n_robots, args.quick, args.up_to)
        if (job.n_robots, job.scenario, job.policy) not in flown
    ]
    with workers(args) as pool:
        for row in progress(pool.map(fly, work), "flight", len(work)):
            replace_rows(path, [row], keys)


if __name__ == "__main__":
    main()
