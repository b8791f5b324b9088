"""Measure the speedup of environments in other processes: ``python benchmarks/ray_env.py [--workers 2] [--json F]``.

Steps environments with given milliseconds per step, and the swarm, in this process and as shards of a `RayVecEnv` with
one worker each. Waiting takes no processor time, so more workers than cores simulate a larger machine. JSON: one row
per case with case, workers, local and remote steps/s, and efficiency: the remote rate divided by the local one and the
number of workers.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.ray import RayVecEnv


class Slow(OwnBit):
    """Environment that waits in each step."""

    def __init__(self, milliseconds: float):
        super().__init__()
        self.milliseconds = milliseconds

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        time.sleep(self.milliseconds / 1000)
        return super().step(action)


def slow(milliseconds: float) -> VecEnv:
    """Create a shard of one environment."""
    return DummyVecEnv([partial(Slow, milliseconds)])


def swarms() -> VecEnv:
    """Create a shard of 32 swarms."""
    import quad_swarm  # noqa: F401 - registers the environment in the worker

    return GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=32))


def rate(env: VecEnv, seconds: float) -> float:
    """Measure the steps per second of all environments."""
    env.reset()
    actions = np.array([env.action_space.sample() for _ in range(env.num_envs)])
    for _ in range(3):
        env.step(actions)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        env.step(actions)
        count += 1
    return count * env.num_envs / (time.perf_counter() - started)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    cases: dict[str, Callable[[], VecEnv]] = {
        **{f"{m:g} ms": partial(slow, m) for m in (1.0, 10.0, 100.0)},
        "32 swarms": swarms,
    }
    rows = []
    for name, make in cases.items():
        local = rate(make(), args.seconds)
        for workers in args.workers:
            env = RayVecEnv([make] * workers, snapshot_every=1000)
            remote = rate(env, args.seconds)
            env.close()
            row = {"case": name, "workers": workers, "local": local, "remote": remote}
            rows.append(row | {"efficiency": remote / (local * workers)})
            print(f"{name:10} {workers} workers: {local:8.1f} -> {remote:8.1f} steps/s, {rows[-1]['efficiency']:.0%}")
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
