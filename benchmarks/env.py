"""Measure environment steps per second, and where the time goes.

``python benchmarks/env.py [--json F]`` steps the swarm through Gymnasium (one swarm) and through Stable-Baselines3's
VecEnv (many swarms) with random requests, including rewards, infos and automatic resets. The face "render" also renders
an image of 640 x 480 in each step. The world `flight` is also stepped without its disturbances, and without the right
of way. Each cell runs one process per core, pinned to it if possible; rates of two cores
are sums. The shares are measured afterwards, since timers take time themselves. JSON: one row per cell with the keys
face, world, n_robots, n_envs, cores, steps_per_s, and the share of each part.

``python benchmarks/env.py --pair flight flight-v2 [--rounds 20] [--json F]`` steps 64 swarms of two worlds in turns, on
one core, and prints how many times as long the second takes for a step (processor time), and for planning in it: median
and quartiles of the rounds. JSON: one row with the keys worlds, rounds, ``step`` and ``solve``, each the quartiles.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np

import quad_swarm
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.task.request_task import RequestTask
from sb3_maddpg.cli.bench import timed
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

EXACT = {
    "sensing": dict.fromkeys(("pos", "vel", "attitude", "others_pos", "others_vel"), 0.0),
    "noise": dict.fromkeys(("vel", "attitude", "wind", "gust"), 0.0),
    "radio": {"loss": 0.0, "delay": 0, "jitter": 0},
    "mismatch": 0.0,
    "clock_skew": 0.0,
}
# Arguments of the environment by the names of the worlds
WORLDS: dict[str, dict[str, Any]] = {
    "paper": {"preset": "paper"},
    "dense": {"preset": "dense"},
    "flight": {"preset": "flight"},
    "flight, no disturbances": {"preset": "flight", "world": EXACT},
    "flight, no right of way": {"preset": "flight", "planner": {"right_of_way": 0.0}},
    "flight-v2": {"preset": "flight-v2"},
    "flight-v3": {"preset": "flight-v3"},
}
CELLS = [
    *((face, world, 1) for face in ("gym", "render") for world in ("paper", "dense")),
    *(("vecenv", world, n_envs) for world in ("paper", "dense") for n_envs in (1, 16, 64, 256)),
    *(("vecenv", world, 64) for world in WORLDS if world.startswith("flight")),
]


def measure(face: str, world: str, n_envs: int, core: int, seconds: float, solver: str) -> dict[str, Any]:
    """Measure the steps per second of one process, and the share of each part."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core % (os.cpu_count() or 1)})
    kwargs: dict[str, Any] = {**WORLDS[world], "scenario": "mixed", "solver": solver}
    step: Callable[[np.ndarray], Any]
    if face in ("gym", "render"):
        env = gymnasium.make("QuadSwarm-v0", **kwargs, render_mode="rgb_array" if face == "render" else None)
        env.reset(seed=core)

        def step(action: np.ndarray) -> None:
            *_, terminated, truncated, _ = env.step(action[0])
            if terminated or truncated:
                env.reset()
            if face == "render":
                env.render()

        task = env.unwrapped.task  # type: ignore[attr-defined]
    else:
        vec_env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=n_envs, **kwargs))
        vec_env.seed(core)
        vec_env.reset()
        step, task = vec_env.step, vec_env.envs.unwrapped.task  # type: ignore[attr-defined]
    n = task.swarm.config.n_robots
    actions = np.random.default_rng(0).integers(0, 2, (64, n_envs, n * (n - 1)), dtype=np.int8)
    for k in range(5):
        step(actions[k])
    count = 0

    def fly(seconds: float) -> tuple[int, float]:
        """Return the steps taken and the time that they took."""
        nonlocal count
        first, started = count, time.perf_counter()
        while time.perf_counter() - started < seconds:
            step(actions[count % len(actions)])
            count += 1
        return count - first, time.perf_counter() - started

    flown, elapsed = fly(seconds)
    timers = attach_timers(task)
    _, timed_for = fly(seconds / 2)
    shares = {name: timer[0] / timed_for for name, timer in timers.items()}
    return {"steps_per_s": flown * n_envs / elapsed, **shares, "rest": 1 - sum(shares.values())}


def compare(worlds: Sequence[str], rounds: int, solver: str) -> dict[str, Any]:
    """Step two worlds in turns. Return the quartiles of the ratios of their processor times, the second's to the
    first's."""
    steppers = [_Stepper(WORLDS[world], solver) for world in worlds]
    times = np.array([[stepper.round() for stepper in steppers] for _ in range(rounds)])  # (rounds, worlds, parts)
    quartiles = np.quantile(times[:, 1] / times[:, 0], (0.25, 0.5, 0.75), axis=0).T
    return {"worlds": list(worlds), "rounds": rounds, "step": quartiles[0].tolist(), "solve": quartiles[1].tolist()}


class _Stepper:
    """Steps 64 swarms, and measures processor times of the step and of planning in it."""

    def __init__(self, kwargs: dict[str, Any], solver: str):
        made = gymnasium.make_vec("QuadSwarm-v0", num_envs=64, **kwargs, scenario="mixed", solver=solver)
        self._env, self._count = GymnasiumVecEnv(made), 0
        self._env.seed(0)
        self._env.reset()
        swarm = made.unwrapped.task.swarm  # type: ignore[attr-defined]
        n, planner = swarm.config.n_robots, swarm.planner
        self._actions = np.random.default_rng(0).integers(0, 2, (64, 64, n * (n - 1)), dtype=np.int8)
        self._planned = [0.0]
        planner.plan = timed(planner.plan, self._planned)
        self.round()

    def round(self) -> tuple[float, float]:
        """Return the processor time of a hundred steps, and how much of it went into planning (s)."""
        self._planned[0], started = 0.0, time.process_time()
        for _ in range(100):
            self._env.step(self._actions[self._count % 64])
            self._count += 1
        return time.process_time() - started, self._planned[0]


def attach_timers(task: RequestTask) -> dict[str, list[float]]:
    """Measure the time of each part of a step."""
    timers: dict[str, list[float]] = {}
    for name, owner, method in [
        ("solve", task.swarm.planner, "plan"),
        ("beliefs", task.swarm.beliefs, "update"),
        ("dynamics", task.swarm._plant, "step"),
        ("observation", task, "observe"),
        ("info", task, "info"),
        ("reset", task, "reset"),
    ]:
        timers[name] = [0.0]
        setattr(owner, method, timed(getattr(owner, method), timers[name]))
    return timers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the cells as a JSON list")
    parser.add_argument("--seconds", type=float, default=4.0, help="seconds per cell (default 4)")
    parser.add_argument("--solver", default="auto", help="planner's solver (default auto)")
    parser.add_argument("--pair", nargs=2, choices=WORLDS, help="compare two worlds instead")
    parser.add_argument("--rounds", type=int, default=20, help="rounds of a hundred steps of a pair (default 20)")
    args = parser.parse_args()
    if args.pair:
        row = compare(args.pair, args.rounds, args.solver)
        for part in ("step", "solve"):
            low, median, high = row[part]
            print(
                f"{part}: {args.pair[1]} takes {median:.2f} times as long as {args.pair[0]} ({low:.2f} to {high:.2f})"
            )
        if args.json:
            write_rows(args.json, [row])
        return
    rows = []
    print(f"{'face':7} {'world':23} {'envs':>5} {'cores':>5} {'steps/s':>9}   shares of the time")
    for face, world, n_envs in CELLS:
        for cores in (1, 2):
            work = [(face, world, n_envs, core, args.seconds, args.solver) for core in range(cores)]
            with multiprocessing.get_context("spawn").Pool(cores) as pool:
                parts = pool.starmap(measure, work)
            total = sum(part.pop("steps_per_s") for part in parts)
            n_robots = quad_swarm.PRESETS[WORLDS[world]["preset"]].n_robots
            row = {"face": face, "world": world, "n_robots": n_robots, "n_envs": n_envs, "cores": cores}
            rows.append({**row, "steps_per_s": total, **parts[0]})
            shares = "  ".join(f"{name} {share:.0%}" for name, share in parts[0].items())
            print(f"{face:7} {world:23} {n_envs:5} {cores:5} {total:9.0f}   {shares}", flush=True)
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
