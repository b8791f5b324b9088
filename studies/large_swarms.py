"""Measure the steps per second and the memory of large swarms, with and without a limited neighbourhood.

``python -m studies.large_swarms [--json F]`` flies the preset `flight` with 4 to 128 robots, the preset's number of
robots per area, the observation of its recipe, and random actions:

- ``all``: robots perceive all others,
- ``planned``: the planner considers only the nearest others,
- ``limited``: robots also perceive only the nearest others within a range.

The critic's time is that of a forward and a backward pass of `PairPolicy` with the recipe's batch size.

Each cell runs in its own process, one after the other, pinned to a core if the system supports this. Memory is the
increase of the process's peak. JSON: one row per cell with the keys perceived, n_robots, n_others, n_envs, steps_per_s,
memory_mb (of the environments), critic_ms, critic_mb, and the ratios to ``all`` with the same number of robots,
steps_ratio and critic_ratio.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from quad_swarm.evaluation.rows import write_rows
from quad_swarm.task.request_task import RequestTask, make_task
from sb3_maddpg.relational.policy import PairPolicy

SIZES = (4, 8, 16, 32, 64, 128)
PERCEIVED = ("all", "planned", "limited")
NEIGHBOURHOOD = {"max_others": 16, "range": 8.0, "look_ahead": 1.0}
PLANNED = 8
BATCH = 96
OBSERVATION = "state+approach+side+memory+plan+told+mask+critic"
_WARM_UP = 3  # number of steps that are not measured


def world(n_robots: int, perceived: str) -> dict[str, Any]:
    """Return the arguments of a world with the number of robots per area of `flight`.

    :param n_robots: number of robots
    :param perceived: one of `PERCEIVED`
    """
    half_width = 3.0 * math.sqrt(n_robots / 8)
    reach = half_width + 2.0
    planner: dict[str, Any] = {"workspace_low": (-reach, -reach, 0.48), "workspace_high": (reach, reach, 2.4)}
    fields: dict[str, Any] = {"planner": planner, "space": {"half_width": half_width}}
    if perceived != "all":
        planner["max_neighbours"] = PLANNED
    if perceived == "limited":
        fields["neighbourhood"] = NEIGHBOURHOOD
    return fields


def measure(n_robots: int, perceived: str, n_envs: int, seconds: float, core: int) -> dict[str, Any]:
    """Measure a cell.

    :param n_robots: number of robots
    :param perceived: one of `PERCEIVED`
    :param n_envs: number of swarms
    :param seconds: duration of each measurement (s)
    :param core: core to use
    :return: row of the cell without its ratios
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core % (os.cpu_count() or 1)})
    th.set_num_threads(1)
    before = _peak_mb()
    task = make_task(
        n_envs,
        "flight",
        "random_swap",
        n_robots=n_robots,
        observation=OBSERVATION,
        announcements=True,
        world=world(n_robots, perceived),
    )
    steps_per_s = _fly(task, seconds)
    flown = _peak_mb()
    critic_ms = _think(task, seconds)
    return {
        "perceived": perceived,
        "n_robots": n_robots,
        "n_others": task.swarm.config.n_others,
        "n_envs": n_envs,
        "steps_per_s": steps_per_s,
        "memory_mb": flown - before,
        "critic_ms": critic_ms,
        "critic_mb": _peak_mb() - flown,
    }


def _fly(task: RequestTask, seconds: float) -> float:
    """Return the steps per second, summed over all environments."""
    n_envs, config, rng = task.swarm.n_swarms, task.swarm.config, np.random.default_rng(0)
    for k in range(n_envs):
        task.reset(k, np.random.default_rng(k))
    # About as many requests and announcements per robot as a trained policy makes, for any number of robots
    share = 0.15 / config.n_others
    bits = [rng.random((n_envs, config.n_robots, config.n_others, 2)) < share for _ in range(8)]
    count, started = -_WARM_UP, time.perf_counter()
    while count < 1 or time.perf_counter() - started < seconds:
        if count == 0:
            started = time.perf_counter()
        task.act(bits[count % len(bits)])
        task.observe()
        count += 1
    return count * n_envs / (time.perf_counter() - started)


def _think(task: RequestTask, seconds: float) -> float:
    """Return the shortest of several times of a critic's passes (ms)."""
    n, m = task.swarm.config.n_robots, task.swarm.config.n_others
    seen = task.observe()
    policy = PairPolicy(
        spaces.Box(-np.inf, np.inf, seen.shape[1:], np.float32),
        spaces.MultiBinary(n * m * 2),
        lambda _: 1e-3,
        net_arch=[64, 64],
        observation_layout=task.observation_layout,  # type: ignore[arg-type]
        pair_credit=True,
    )
    observations = th.as_tensor(np.resize(seen, (BATCH, *seen.shape[1:])))
    actions = policy.actor.act(observations).detach()
    times: list[float] = []
    while not times or sum(times) < seconds:
        started = time.perf_counter()
        policy.critic(observations, actions).square().mean().backward()
        times.append(time.perf_counter() - started)
    return 1e3 * min(times)


def _peak_mb() -> float:
    """Return the peak memory of the process (MB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the cells as a JSON list")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of robots (default 4 to 128)")
    parser.add_argument("--envs", type=int, default=16, help="number of swarms per process (default 16)")
    parser.add_argument(
        "--seconds", type=float, default=4.0, help="duration of each measurement in seconds (default 4)"
    )
    parser.add_argument("--core", type=int, default=0, help="core to use (default 0)")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print(f"{'robots':>6} {'perceived':>9} {'others':>6} {'steps/s':>9} {'MB':>7} {'critic ms':>9} {'MB':>7}   ratios")
    for n_robots in args.sizes:
        for perceived in PERCEIVED:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                row = pool.apply(measure, (n_robots, perceived, args.envs, args.seconds, args.core))
            rival = next((r for r in rows if r["n_robots"] == n_robots), row)
            row["steps_ratio"] = row["steps_per_s"] / rival["steps_per_s"]
            row["critic_ratio"] = rival["critic_ms"] / row["critic_ms"]
            rows.append(row)
            print(
                f"{n_robots:6} {perceived:>9} {row['n_others']:6} {row['steps_per_s']:9.0f} {row['memory_mb']:7.0f} "
                f"{row['critic_ms']:9.1f} {row['critic_mb']:7.0f}   {row['steps_ratio']:.1f} {row['critic_ratio']:.1f}",
                flush=True,
            )
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
