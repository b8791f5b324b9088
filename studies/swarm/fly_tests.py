"""Fly all results of docs/results.md with the models and rules in studies/swarm/data.

``python -m studies.swarm.fly_tests [PART ...] [--quick] [--out FOLDER]`` flies episodes that neither training nor
tuning have seen, and writes a file of rows per part. Parts, presets, scenarios and teams can be selected; all other
rows stay. ``--quick`` flies few episodes, only to check that everything runs. `studies.swarm.report` fills the pages.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from quad_swarm.evaluation.command import add_worker_arguments, workers
from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly, fly_steps
from quad_swarm.evaluation.inference import Comparison
from quad_swarm.evaluation.rows import read_rows
from quad_swarm.task.request_task import RequestTask
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.scenarios import SCENARIOS, Scenario, ScenarioSpace
from studies.swarm.protocol import (
    DATA,
    DBCP,
    EARLIER,
    NAMES,
    PRESETS_TESTED,
    ROOT,
    TEST,
    absolute_path,
    best_rules,
    condition,
    fly_kept,
    models,
    progress,
    replace_rows,
    tuned,
    world,
)

# Number of episodes per condition, and their set
EPISODES = {"test": 12000, "teams": 4000, "counts": 1000, "quadrants": 4000}
EPISODES |= {"sweep": 1000, "robustness": 1000, "unseen": 4000, "asking": 200, "interventions": 12000}
SETS = {"test": TEST, "teams": TEST, "counts": TEST, "quadrants": TEST}
QUICK = 20
# A threshold with enough collisions to analyse
RECKLESS = 0.6
# The simplest rule that is better than the paper's
CPA = "cpa:0.7:1.5"
# Keys that identify the conditions of a part; a condition that is flown again replaces its rows
CONDITION = ("preset", "scenario", "condition", "n_robots")
# Numbers of robots other than in training
TEAMS = (6, 12, 16)
CONDITIONS: dict[str, dict[str, Any]] = {
    "as trained": {},
    "state noise": {"noise": {"pos": 0.004, "vel": 0.02, "attitude": 0.006}},
    "wind 1 m/s": {"noise": {"wind": 1.0}},
    "10 % of plans lost": {"radio": {"loss": 0.1}},
    "30 % of plans lost": {"radio": {"loss": 0.3}},
    "50 % of plans lost": {"radio": {"loss": 0.5}},
    "plans 1 step late": {"radio": {"delay": 1}},
    "plans 2 steps late": {"radio": {"delay": 2}},
    "plans 3 steps late": {"radio": {"delay": 3}},
    "faster robots": {"planner": {"max_tilt": 0.44}},
}


Intervention = Callable[[np.ndarray, int, int], np.ndarray]


class Job(NamedTuple):
    """Policies in a scenario that fly the same episodes.

    :param keys: common entries of all rows
    :param policies: the policies; for `compare` the first is full communication, the second the rule to beat
    :param scenario: a name of `SCENARIOS` or `UNSEEN`
    :param config: the world
    :param episodes: number of episodes
    :param seed: index of the set of episodes
    """

    keys: dict[str, Any]
    policies: list[str]
    scenario: str
    config: SwarmConfig
    episodes: int
    seed: int


def compare(job: Job) -> list[dict[str, Any]]:
    """Fly policies over the same episodes.

    :return: a row per policy, with its paired differences from full communication and from the rule
    """
    policies = list(dict.fromkeys(job.policies))
    flown = fly_kept([condition(policy, job.scenario, job.config) for policy in policies], job.episodes, job.seed)
    by_name = {one.policy: rows for one, rows in flown.items()}
    table = []
    for policy in policies:
        row = job.keys | {"scenario": job.scenario, "policy": policy, "set": job.seed}
        row |= summarise(by_name[policy], job.config)
        for name, rival in (("full", job.policies[0]), ("rule", job.policies[1])):
            comparison = Comparison.of(by_name[policy], by_name[rival])
            low, high = comparison.interval
            row[f"against_{name}"] = {
                "rival": rival,
                "only_policy": comparison.only_first,
                "only_rival": comparison.only_second,
                "low": low,
                "high": high,
                "p_value": comparison.p_value,
                "as_safe": comparison.as_safe(),
            }
        table.append(row)
    return table


def _jobs(
    part: str, episodes: int, presets: Sequence[str], policies: Callable[[str, str], list[str]], names: Sequence[str]
) -> list[Job]:
    """Create a job per preset and scenario; ``policies`` is a function of both."""
    return [
        Job({"preset": preset}, policies(preset, name), name, make_config(preset), episodes, SETS.get(part, EARLIER))
        for preset in presets
        for name in names
    ]


def test(episodes: int) -> list[Job]:
    """Create the jobs of the main tables."""

    def policies(preset: str, name: str) -> list[str]:
        others = ["none", DBCP, CPA, *models(preset)]
        if preset == "paper":
            others += [*models("faithful"), *models("ablation*")]
        return ["full", best_rules(preset)[name], *others, *tuned(preset, name)]

    return _jobs("test", episodes, PRESETS_TESTED, policies, NAMES)


def counts(episodes: int) -> list[Job]:
    """Create jobs that count requests over whole episodes of 100 steps, as in the paper."""

    def policies(preset: str, name: str) -> list[str]:
        return ["full", DBCP, "none", *models("faithful"), *models(preset)]

    return _jobs("counts", episodes, ["paper"], policies, NAMES)


def compare_whole_episodes(job: Job) -> list[dict[str, Any]]:
    """Do the same as `compare`, but fly all episodes to their time limit."""
    conditions = [replace(condition(policy, job.scenario, job.config), linger=None) for policy in job.policies]
    flown = fly_kept(conditions, job.episodes, job.seed)
    return [
        job.keys | {"scenario": job.scenario, "policy": one.policy, "set": job.seed} | summarise(rows, job.config)
        for one, rows in flown.items()
    ]


def quadrants(episodes: int) -> list[Job]:
    """Create jobs of the asymmetric swap as in the paper, with one robot anywhere in each quadrant."""

    def policies(preset: str, name: str) -> list[str]:
        return ["full", best_rules(preset)[name], "none", DBCP, *models(preset), *models("faithful")]

    config = make_config("paper", space={"whole_sectors": True})
    jobs = _jobs("quadrants", episodes, ["paper"], policies, ["asymmetric_swap"])
    return [job._replace(config=config) for job in jobs]


def sweep(episodes: int) -> list[Job]:
    """Create jobs that sweep the threshold of the first seeds."""
    deltas = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)

    def policies(preset: str, name: str) -> list[str]:
        return ["full", best_rules(preset)[name], *(f"{path}@{d}" for path in models(preset)[:1] for d in deltas)]

    return _jobs("sweep", episodes, PRESETS_TESTED, policies, NAMES)


def robustness(episodes: int) -> list[Job]:
    """Create jobs in disturbed worlds with the first seeds."""
    return [
        Job(
            {"preset": preset, "condition": name_of_world},
            ["full", best_rules(preset)[name], *models(preset)[:1]],
            name,
            make_config(preset, **changes),
            episodes,
            EARLIER,
        )
        for preset in PRESETS_TESTED
        for name_of_world, changes in CONDITIONS.items()
        for name in NAMES
    ]


def half_swap(n_robots: int, space: ScenarioSpace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mixture of scenarios in an episode: half of the robots fly `symmetric_swap`, the others `random`."""
    half = n_robots // 2
    while True:
        swapping, own = (
            SCENARIOS[name](n, space, rng) for name, n in (("symmetric_swap", half), ("random", n_robots - half))
        )
        starts, goals = (np.concatenate(both) for both in zip(swapping, own, strict=True))
        if min(apart(starts), apart(goals)) >= space.spacing:
            return starts, goals


def two_streams(n_robots: int, space: ScenarioSpace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two rows of robots that fly abreast at one height and cross at a right angle, with slight displacements."""
    half, along = n_robots // 2, space.sector_radius[1]
    abreast = [
        (k - (m - 1) / 2) * (space.spacing + 2 * space.circle_jitter) for m in (half, n_robots - half) for k in range(m)
    ]
    starts = np.column_stack([np.full(n_robots, -along), abreast, np.full(n_robots, rng.uniform(*space.heights))])
    goals = starts * (-1, 1, 1)
    for points in (starts, goals):
        points[half:, :2] = points[half:, 1::-1]
        points += rng.uniform(-space.circle_jitter, space.circle_jitter, size=points.shape)
    return starts, goals


def apart(points: np.ndarray) -> float:
    """Return the distance of the two closest points (m)."""
    return float((np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(len(points), np.inf))).min())


UNSEEN: dict[str, Scenario] = {"half_swap": half_swap, "two_streams": two_streams}


def unseen(episodes: int) -> list[Job]:
    """Create jobs in scenarios without any training or tuning, with the rules of both swaps and the first seeds."""

    def policies(preset: str, name: str) -> list[str]:
        rules = [best_rules(preset)[swap] for swap in ("symmetric_swap", "asymmetric_swap")]
        return ["full", *rules, "none", *models(preset)[:1]]

    return _jobs("unseen", episodes, PRESETS_TESTED, policies, list(UNSEEN))


def compare_unseen(job: Job) -> list[dict[str, Any]]:
    """Do the same as `compare`, while the scenarios of `UNSEEN` are registered in this process."""
    with patch.dict(SCENARIOS, UNSEEN):
        return compare(job)


def teams(episodes: int) -> list[Job]:
    """Create jobs with other numbers of robots, in which all models have thresholds tuned for that number."""
    return [
        Job(
            {"preset": "dense", "n_robots": n},
            ["full", best_rules("dense", n)[name], *tuned("any", name, n)],
            name,
            world("dense", n),
            episodes,
            TEST,
        )
        for n in TEAMS
        for name in NAMES
        if models("any")
    ]


def asking(episodes: int) -> list[Job]:
    """Create jobs that count requests by what the robots observe."""

    def policies(preset: str, name: str) -> list[str]:
        return [best_rules(preset)[name], *models(preset)[:1]]

    return _jobs("asking", episodes, PRESETS_TESTED, policies, NAMES)


def ask(job: Job) -> list[dict[str, Any]]:
    """Count how often policies make requests at each value of several quantities."""
    return [row for policy in job.policies for row in requests_by_quantity(job, policy)]


def requests_by_quantity(job: Job, policy: str) -> list[dict[str, Any]]:
    """Return the rows of one policy."""
    seen: dict[str, list[np.ndarray]] = {}
    asked = []
    for number in range(job.episodes):
        flight = fly(condition(policy, job.scenario, job.config), job.seed, number)
        steps = min(filter(None, (flight.arrival, flight.collision, len(flight.requests))))
        distance = flight.separation[:steps]
        approach, time = (values[:steps] for values in flight.closest_approach)
        to_goal = np.linalg.norm(flight.goal - flight.pos[:steps], axis=-1)[..., None]
        crowd = (distance < 2.0).sum(-1, keepdims=True)
        for name, values in {
            "distance (m)": distance,
            "closest approach (m)": approach,
            "time to closest approach (s)": time,
            "distance to the goal (m)": to_goal,
            "others within 2 m": crowd,
        }.items():
            seen.setdefault(name, []).append(np.broadcast_to(values, distance.shape).ravel())
        asked.append(flight.requests[:steps].ravel())
    requests = np.concatenate(asked)
    rows = []
    for name, parts in seen.items():
        values = np.concatenate(parts)
        last = 4 if "(s)" in name else 5
        edges = np.arange(-0.5, job.config.n_robots) if "others" in name else np.linspace(0, last, 21)
        for low, high in pairwise(edges):
            inside = (values >= low) & (values < high)
            row = job.keys | {"policy": policy, "scenario": job.scenario, "quantity": name}
            rows.append(row | {"low": low, "high": high, "n": int(inside.sum()), "asked": int(requests[inside].sum())})
    return rows


def interventions(episodes: int) -> list[Job]:
    """Create jobs that test which requests avoid collisions, with first seeds and too high a threshold."""

    def policies(preset: str, name: str) -> list[str]:
        return [f"{path}@{RECKLESS}" for path in models(preset)[:1]]

    return _jobs("interventions", episodes, PRESETS_TESTED, policies, ["symmetric_swap"])


def intervene(job: Job) -> list[dict[str, Any]]:
    """Repeat episodes that ended in a collision with additional requests in the last steps before it."""
    (policy,) = job.policies
    one = condition(policy, job.scenario, job.config)
    rows = fly_kept([one], job.episodes, job.seed)[one]
    crashes = [(number, *replay(one, job.seed, number)) for number, row in enumerate(rows) if row["collided"]]
    table = []
    for (who, more), steps in itertools.product(INTERVENTIONS.items(), (1, 2, 3, 4, 6, 8, 12)):
        again = [replay(one, job.seed, number, more, pair, range(end - steps, end)) for number, _, end, pair in crashes]
        keys = {"scenario": job.scenario, "policy": policy, "who": who, "last_steps": steps}
        table.append(job.keys | keys | {"n": len(again), "avoided": sum(not collided for collided, *_ in again)})
    return table


def replay(
    one: Condition,
    seed: int,
    number: int,
    more: Intervention | None = None,
    pair: tuple[int, int] = (0, 0),
    when: range = range(0),
) -> tuple[bool, int, tuple[int, int]]:
    """Fly an episode to a collision or the time limit, with additional requests in some steps.

    :param one: policy, scenario and world
    :param seed: index of the set of episodes
    :param number: index of the episode in the set
    :param more: function of the requests, (n, n) bool, and of the pair that returns the requests to make
    :param pair: the two robots that collide
    :param when: steps with additional requests
    :return: whether the episode ended in a collision, the number of steps, and the two closest robots at the end
    """
    n = one.config.n_robots
    rows, others = np.arange(n)[:, None], other_indices(n)
    policy, task, rngs = begin(one, [first_episode(seed) + number])

    def with_more(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        requests = policy(task, rngs)[..., 0]
        if int(task.statistics.steps[0]) in when and more is not None:
            asked = np.zeros((n, n), dtype=bool)
            asked[rows, others] = requests[0]
            requests = more(asked, *pair)[rows, others][None]
        return requests[..., None]

    for step in fly_steps(with_more, task, rngs):
        separation = step.outcome.report.separation[0]
        collided, end = bool(task.statistics.collided[0]), int(task.statistics.steps[0])
        if collided:
            break
    i, m = np.unravel_index(separation.argmin(), separation.shape)
    return collided, end, (int(i), int(others[i, m]))


def each_other(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """Let the two robots that are about to collide request each other's plans."""
    asked[[i, j], [j, i]] = True
    return asked


def everybody(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """Let the two robots request all plans."""
    asked[[i, j]] = True
    return asked


def both(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """Let all other robots request the plans of the two."""
    third = np.setdiff1d(np.arange(len(asked)), (i, j))
    asked[third[:, None], [i, j]] = True
    return asked


INTERVENTIONS: dict[str, Intervention] = {
    "the two ask each other": each_other,
    "the two ask everybody": everybody,
    "all others ask the two": both,
    "everybody asks everybody": lambda asked, i, j: np.ones_like(asked),
}

PARTS: dict[str, tuple[Callable[[int], list[Job]], Callable[[Job], list[dict[str, Any]]]]] = {
    "test": (test, compare),
    "teams": (teams, compare),
    "counts": (counts, compare_whole_episodes),
    "quadrants": (quadrants, compare),
    "sweep": (sweep, compare),
    "robustness": (robustness, compare),
    "unseen": (unseen, compare_unseen),
    "asking": (asking, ask),
    "interventions": (interventions, intervene),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="parts to fly (default: all)")
    parser.add_argument("--preset", nargs="+", default=PRESETS_TESTED, choices=PRESETS_TESTED)
    parser.add_argument("--scenario", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument(
        "--n-robots", nargs="+", type=int, default=TEAMS, choices=TEAMS, help="numbers of robots in the part teams"
    )
    parser.add_argument("--quick", action="store_true", help=f"fly only {QUICK} episodes per condition")
    add_worker_arguments(parser, jobs=os.cpu_count() or 1)
    parser.add_argument("--out", type=absolute_path, default=DATA, help="folder of the rows (default %(default)s)")
    args = parser.parse_args(argv)
    os.chdir(ROOT)
    with workers(args) as pool:
        for part in args.parts or PARTS:
            make_jobs, run = PARTS[part]
            path = args.out / f"{part}.json.gz"
            jobs = [
                job
                for job in make_jobs(QUICK if args.quick else EPISODES[part])
                if job.keys["preset"] in args.preset
                and job.scenario in (*args.scenario, *UNSEEN)
                and job.keys.get("n_robots", args.n_robots[0]) in args.n_robots
            ]
            for table in progress(pool.map(run, jobs), part, len(jobs)):
                replace_rows(path, table, tuple(key for key in CONDITION if key in table[0]))
            print(f"wrote {path}, {len(read_rows(path))} rows", flush=True)


if __name__ == "__main__":
    main()
