"""Evaluate the disturbed worlds with untuned rules, and other physics with tuned policies.

``python -m studies.swarm.flight_world [PART ...]`` flies its parts.

- ``world``: no and full communication in `flight` and `flight-hard`.
- ``delays``: full communication with answers that are one, two and three steps late, with and without the right of way.
- ``delay_check``: the same with the baseline of `studies.swarm.delay_check`.
- ``paper``: four robots with the paper's settings, trained in `flight`, over whole episodes as in the paper.
- ``plants``: separations and models of the planner in other simulators, in symmetric swaps, with the tuned rule and
  the shipped model. Conditions that the file already contains are not flown again.

All parts use a set of episodes on which nothing was chosen. JSON: one row per condition with the keys of `summarise`,
and part, scenario, policy and the changes to the world.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from quad_swarm.evaluation.command import add_worker_arguments, workers
from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.rows import read_rows
from quad_swarm.world.presets import make_config
from studies.swarm import delay_check
from studies.swarm.fly_flight import PAPERS, best_rule, tuned_models
from studies.swarm.protocol import (
    DATA,
    DBCP,
    NAMES,
    WORLDS,
    absolute_path,
    condition,
    fly_kept,
    models,
    progress,
    replace_rows,
)
from studies.swarm.tune_flight import SWAPS

# Separations of the planner in the part `plants`; contact is at 0.6 m
SEPARATIONS = (0.8, 0.7, 0.6)
# Simulated vehicles, and the planner's model identified from each
IDENTIFIED = {"crazyflow:cf21B_500": "crazyflie21", "rotorpy:hummingbird": "hummingbird"}
SHIPPED = 2  # seed of the model quad-swarm-flight
PARTS = {"world": 1000, "delays": 4000, "delay_check": 1000, "paper": 1000, "plants": 1000}
# Clearance of the delay check: the one of 0.62, 0.66 and 0.7 m with the fewest collisions in validation episodes
CLEARANCE = 0.62
DELAY_CHECK = f"full, delay check at {CLEARANCE} m"
QUICK = 10


class Job(NamedTuple):
    """A condition.

    :param part: part of this study
    :param preset: name of the world
    :param changed: changes to the world
    :param scenario: name of the scenario
    :param policy: a rule or a model
    """

    part: str
    preset: str
    changed: dict[str, Any]
    scenario: str
    policy: str


def jobs(part: str) -> Iterator[Job]:
    """Yield the conditions of a part."""
    if part == "world":
        for preset, name, policy in itertools.product(("flight", "flight-hard"), NAMES, ("none", "full")):
            yield Job(part, preset, {}, name, policy)
    elif part in ("delays", "delay_check"):
        policy = "full" if part == "delays" else DELAY_CHECK
        for delay, right_of_way, name in itertools.product((1, 2, 3), (0.0, 0.3), SWAPS):
            changed = {"radio": {"delay": delay, "jitter": 0}, "planner": {"right_of_way": right_of_way}}
            yield Job(part, "flight", changed, name, policy)
    elif part == "paper":
        for policy, name in itertools.product(("full", DBCP, "none", *models(PAPERS)), NAMES):
            yield Job(part, "flight", {"n_robots": 4}, name, policy)
    else:
        policies = ("none", "full", best_rule(), tuned_models()[SHIPPED])
        for separation, plant, policy in itertools.product(SEPARATIONS, IDENTIFIED, policies):
            for vehicle in ("bebop2", IDENTIFIED[plant]):
                changed = {"plant": plant, "quadrotor": vehicle, "planner": {"separation": separation}}
                yield Job(part, "flight", changed, "symmetric_swap", policy)


def fly(job: Job, episodes: int) -> dict[str, Any]:
    """Fly a condition and return its row."""
    config = make_config(job.preset, job.changed)
    if job.policy == DELAY_CHECK:
        first = first_episode(WORLDS)
        rows = delay_check.fly(config, job.scenario, CLEARANCE, range(first, first + episodes))
    else:
        flown = condition(job.policy, job.scenario, config)
        if job.part == "paper":
            flown = replace(flown, linger=None)
        ((_, rows),) = fly_kept([flown], episodes, WORLDS).items()
    return {**job._asdict(), "condition": str(job), "set": WORLDS, **summarise(rows, config)}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="parts to fly (default: all)")
    parser.add_argument("--quick", action="store_true", help=f"fly only {QUICK} episodes per condition")
    add_worker_arguments(parser, jobs=os.cpu_count() or 1)
    parser.add_argument("--json", type=absolute_path, default=DATA / "flight_world.json.gz", metavar="FILE")
    args = parser.parse_args()
    with workers(args) as pool:
        for part in args.parts or PARTS:
            known = {row.get("condition") for row in read_rows(args.json)} if part == "plants" else set()
            work = [job for job in jobs(part) if str(job) not in known]
            episodes = [QUICK if args.quick else PARTS[part]] * len(work)
            for row in progress(pool.map(fly, work, episodes), part, len(work)):
                replace_rows(args.json, [row], ("part", "condition"))
                print(
                    f"{row['preset']:12} {row['changed'] or ''!s:60} {row['scenario']:16} {row['policy']:5} "
                    f"{row['collisions']:5}/{row['episodes']} at steps {row['collisions_at_steps']:5} "
                    f"arrived {row['arrived']:5} steps {row['steps_to_arrival'] or float('nan'):6.1f} "
                    f"closest {row['min_separation_continuous']:.3f} m",
                    flush=True,
                )


if __name__ == "__main__":
    main()
