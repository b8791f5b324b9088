"""Fly everything that docs/results.md says again, from the models and rules in studies/swarm/data.

``python -m studies.swarm.fly [--quick] [--out DATA]`` flies test sets, which neither training nor tuning
have seen, and writes test.json, sweep.json, robustness.json, unseen.json, teams.json, asking.json and
interventions.json; parts can be chosen by name, also presets, scenarios and teams, and the other rows stay.
``--quick`` flies few episodes and checks only that everything runs. `studies/swarm/report.py` makes the page of them.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from quad_swarm.evaluation.evaluation import Cell, Comparison, begin, first_episode, fly, fly_all, summarise
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.scenarios import SCENARIOS, Scenario, ScenarioSpace
from studies.swarm.protocol import (
    DATA,
    NAMES,
    ROOT,
    TEAM_TEST,
    TEST,
    absolute_path,
    best_rules,
    cell,
    models,
    progress,
    read_rows,
    replace_rows,
    tuned,
    world,
)

EPISODES = {"test": 12000, "sweep": 1000, "robustness": 1000, "unseen": 4000, "teams": 4000}
EPISODES |= {"asking": 200, "interventions": 12000}
QUICK = 20
# A threshold with which there are collisions to look at
RECKLESS = 0.6
# The rule that the paper compares with
DBCP = "distance:4"
# Those with trained models
PRESETS_TESTED = tuple(preset for preset in ("paper", "dense") if any(DATA.glob(f"{preset}_seed*.zip")))
# What tells the cells of a part from each other; a cell that is flown again replaces its rows
CELL = ("preset", "scenario", "condition", "n_robots")
# Other sizes than those it was trained with
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


def compare(job: tuple[dict[str, Any], list[str], str, SwarmConfig, int], seed: int = TEST) -> list[dict[str, Any]]:
    """Fly policies over the same test episodes; the first is full communication, the second the rule to beat.

    :param job: keys of every row, policies, scenario, world, number of episodes
    :param seed: set of held-out episodes
    :return: a row for each policy
    """
    keys, policies, scenario, config, episodes = job
    unique = list(dict.fromkeys(policies))
    flown = fly_all([cell(policy, scenario, config) for policy in unique], episodes, seed)
    by_name = {c.policy: rows for c, rows in flown.items()}
    table = []
    for policy in unique:
        row = keys | {"scenario": scenario, "policy": policy, **summarise(by_name[policy], config.n_robots)}
        for name, rival in (("full", policies[0]), ("rule", policies[1])):
            comparison = Comparison.of(by_name[policy], by_name[rival])
            low, high = comparison.interval
            row[f"against_{name}"] = {
                "rival": rival,
                "only_policy": comparison.only_first,
                "only_rival": comparison.only_second,
                "low": low,
                "high": high,
                "p_value": comparison.p_value,
                "as_safe": comparison.as_safe,
            }
        table.append(row)
    return table


def test(episodes: int) -> list[Any]:
    """Jobs of the main table."""
    jobs = []
    for preset in PRESETS_TESTED:
        rules, config = best_rules(preset), make_config(preset)
        others = ["none", DBCP, *models(preset)]
        if preset == "paper":
            others += [*models("faithful"), *models("ablation*")]
        jobs += [
            ({"preset": preset}, ["full", rules[name], *others, *tuned(preset, name)], name, config, episodes)
            for name in NAMES
        ]
    return jobs


def sweep(episodes: int) -> list[Any]:
    """Jobs of the sweep of the threshold, first seeds only."""
    deltas = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
    return [
        (
            {"preset": preset},
            ["full", best_rules(preset)[name], *(f"{path}@{delta}" for path in models(preset)[:1] for delta in deltas)],
            name,
            make_config(preset),
            episodes,
        )
        for preset in PRESETS_TESTED
        for name in NAMES
    ]


def robustness(episodes: int) -> list[Any]:
    """Jobs of the disturbed worlds, first seeds only."""
    return [
        (
            {"preset": preset, "condition": condition},
            ["full", best_rules(preset)[name], *models(preset)[:1]],
            name,
            make_config(preset, **changes),
            episodes,
        )
        for preset in PRESETS_TESTED
        for condition, changes in CONDITIONS.items()
        for name in NAMES
    ]


def half_swap(n_robots: int, space: ScenarioSpace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A mixture within one episode: half of the robots as in `symmetric_swap`, the others on ways of their own."""
    half = n_robots // 2
    while True:
        swapping, own = (
            SCENARIOS[name](n, space, rng) for name, n in (("symmetric_swap", half), ("random", n_robots - half))
        )
        starts, goals = (np.concatenate(both) for both in zip(swapping, own, strict=True))
        if min(apart(starts), apart(goals)) >= space.spacing:
            return starts, goals


def two_streams(n_robots: int, space: ScenarioSpace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two rows of robots cross at a right angle, abreast and at one height, starts and goals slightly moved."""
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
    """Distance of the closest two of some points (m)."""
    return float((np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(len(points), np.inf))).min())


UNSEEN: dict[str, Scenario] = {"half_swap": half_swap, "two_streams": two_streams}


def unseen(episodes: int) -> list[Any]:
    """Jobs of scenarios that nothing was trained or tuned in: the rules of both swaps, and the first seeds."""
    return [
        (
            {"preset": preset},
            [
                "full",
                *(best_rules(preset)[swap] for swap in ("symmetric_swap", "asymmetric_swap")),
                "none",
                *models(preset)[:1],
            ],
            name,
            make_config(preset),
            episodes,
        )
        for preset in PRESETS_TESTED
        for name in UNSEEN
    ]


def compare_unseen(job: tuple[dict[str, Any], list[str], str, SwarmConfig, int]) -> list[dict[str, Any]]:
    """`compare` in a scenario of `UNSEEN`."""
    SCENARIOS.update(UNSEEN)
    try:
        return compare(job)
    finally:
        for name in UNSEEN:
            del SCENARIOS[name]


def teams(episodes: int) -> list[Any]:
    """Jobs of other sizes of the team: all models with the thresholds tuned for it."""
    return [
        (
            {"preset": "dense", "n_robots": n},
            ["full", best_rules("dense", n)[name], *tuned("any", name, n)],
            name,
            world("dense", n),
            episodes,
        )
        for n in TEAMS
        for name in NAMES
        if models("any")
    ]


def asking(episodes: int) -> list[Any]:
    """Jobs of the look at whom policies ask: pairs and steps counted by what the robots saw."""
    return [
        ({"preset": preset}, [best_rules(preset)[name], *models(preset)[:1]], name, episodes)
        for preset in PRESETS_TESTED
        for name in NAMES
    ]


def ask(job: tuple[dict[str, Any], list[str], str, int]) -> list[dict[str, Any]]:
    """For some quantities how often policies ask at each of their values."""
    keys, policies, scenario, episodes = job
    return [row for policy in policies for row in requests_by_quantity(keys, policy, scenario, episodes)]


def requests_by_quantity(keys: dict[str, Any], policy: str, scenario: str, episodes: int) -> list[dict[str, Any]]:
    """The rows of one policy."""
    config = make_config(keys["preset"])
    others = other_indices(config.n_robots)
    seen: dict[str, list[np.ndarray]] = {}
    asked = []
    for number in range(episodes):
        flight = fly(cell(policy, scenario, config), TEST, number)
        arrived = (np.linalg.norm(flight.state[1:, :, :3] - flight.goal, axis=-1) <= config.goal_radius).all(axis=1)
        steps = int(arrived.argmax()) + 1 if arrived.any() else len(flight.requests)
        pos, vel = flight.state[:steps, :, :3], flight.state[:steps, :, 3:6]
        relative, moving = pos[:, others] - pos[:, :, None], vel[:, others] - vel[:, :, None]
        time = np.clip(-(relative * moving).sum(-1) / np.maximum((moving**2).sum(-1), 1e-12), 0, 4.0)
        distance = np.linalg.norm(relative, axis=-1)
        to_goal = np.broadcast_to(np.linalg.norm(flight.goal - pos, axis=-1)[..., None], distance.shape)
        crowd = np.broadcast_to((distance < 2.0).sum(-1, keepdims=True), distance.shape)
        for name, values in {
            "distance (m)": distance,
            "closest approach (m)": np.linalg.norm(relative + time[..., None] * moving, axis=-1),
            "time to closest approach (s)": time,
            "distance to the goal (m)": to_goal,
            "others within 2 m": crowd,
        }.items():
            seen.setdefault(name, []).append(values.ravel())
        asked.append(flight.requests[:steps].ravel())
    requests = np.concatenate(asked)
    rows = []
    for name, parts in seen.items():
        values = np.concatenate(parts)
        edges = np.arange(-0.5, config.n_robots) if "others" in name else np.linspace(0, 4 if "(s)" in name else 5, 21)
        for low, high in pairwise(edges):
            inside = (values >= low) & (values < high)
            row = keys | {"policy": policy, "scenario": scenario, "quantity": name}
            rows.append(row | {"low": low, "high": high, "n": int(inside.sum()), "asked": int(requests[inside].sum())})
    return rows


def interventions(episodes: int) -> list[Any]:
    """Jobs of what would have helped: first seeds with a threshold that is too high."""
    return [
        ({"preset": preset}, f"{path}@{RECKLESS}", "symmetric_swap", episodes)
        for preset in PRESETS_TESTED
        for path in models(preset)[:1]
    ]


def intervene(job: tuple[dict[str, Any], str, str, int]) -> list[dict[str, Any]]:
    """Fly again what ended in a collision, and let more be asked in the last steps before it."""
    keys, policy, scenario, episodes = job
    one = cell(policy, scenario, make_config(keys["preset"]))
    rows = fly_all([one], episodes, TEST)[one]
    crashes = [(number, *replay(one, number)[1:]) for number, row in enumerate(rows) if row["collided"]]
    table = []
    for (who, more), steps in itertools.product(INTERVENTIONS.items(), (1, 2, 3, 4, 6, 8, 12)):
        again = [replay(one, number, more, pair, range(end - steps, end)) for number, end, pair in crashes]
        keys_of_row = {"scenario": scenario, "policy": policy, "who": who, "last_steps": steps}
        table.append(keys | keys_of_row | {"n": len(again), "avoided": sum(not collided for collided, *_ in again)})
    return table


def replay(
    one: Cell, number: int, more: Intervention | None = None, pair: tuple[int, int] = (0, 0), when: range = range(0)
) -> tuple[bool, int, tuple[int, int]]:
    """Fly an episode, in some steps with more requests.

    :param more: from who asks whom, (n, n) bool, and the pair to who is to ask whom
    :return: whether it ended in a collision, after how many steps, and between which two
    """
    policy, task, rngs = begin(one, [first_episode(TEST) + number])
    n = one.config.n_robots
    rows, others = np.arange(n)[:, None], other_indices(n)
    for step in range(one.max_steps):
        requests = policy(task, rngs)
        if step in when and more is not None:
            asked = np.zeros((n, n), dtype=bool)
            asked[rows, others] = requests[0]
            requests = more(asked, *pair)[rows, others][None]
        if task.step(requests).terminated[0]:
            break
    pos = task.swarm.pos[0]
    distance = np.linalg.norm(pos[:, None] - pos, axis=-1) + np.diag(np.full(n, np.inf))
    i, j = np.unravel_index(distance.argmin(), distance.shape)
    return bool(task.statistics.collided[0]), step + 1, (int(i), int(j))


def each_other(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """The two that are about to collide ask each other."""
    asked[[i, j], [j, i]] = True
    return asked


def everybody(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """The two ask everybody."""
    asked[[i, j]] = True
    return asked


def both(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """All others ask the two."""
    third = np.setdiff1d(np.arange(len(asked)), (i, j))
    asked[third[:, None], [i, j]] = True
    return asked


INTERVENTIONS: dict[str, Intervention] = {
    "the two ask each other": each_other,
    "the two ask everybody": everybody,
    "all others ask the two": both,
    "everybody asks everybody": lambda asked, i, j: np.ones_like(asked),
}

PARTS: dict[str, tuple[Callable[[int], list[Any]], Callable[[Any], list[dict[str, Any]]]]] = {
    "test": (test, compare),
    "sweep": (sweep, compare),
    "robustness": (robustness, compare),
    "unseen": (unseen, compare_unseen),
    "teams": (teams, functools.partial(compare, seed=TEAM_TEST)),
    "asking": (asking, ask),
    "interventions": (interventions, intervene),
}


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="what to fly; everything unless given")
    parser.add_argument("--preset", nargs="+", default=PRESETS_TESTED, choices=PRESETS_TESTED)
    parser.add_argument("--scenario", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--n-robots", nargs="+", type=int, default=TEAMS, choices=TEAMS, help="of the part teams")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} episodes of each cell")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=absolute_path, default=DATA, help="folder of the JSON files (%(default)s)")
    args = parser.parse_args(argv)
    os.chdir(ROOT)
    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        for part in args.parts or PARTS:
            make_jobs, run = PARTS[part]
            path = args.out / f"{part}.json"
            jobs = [
                job
                for job in make_jobs(QUICK if args.quick else EPISODES[part])
                if job[0]["preset"] in args.preset
                and job[2] in (*args.scenario, *UNSEEN)
                and job[0].get("n_robots", args.n_robots[0]) in args.n_robots
            ]
            for table in progress(pool.map(run, jobs), part, len(jobs)):
                replace_rows(path, table, tuple(key for key in CELL if key in table[0]))
            print(f"wrote {path}, {len(read_rows(path))} rows", flush=True)


if __name__ == "__main__":
    main()
