"""Measure the cost of checkpoints during training: ``python benchmarks/checkpoints.py [--seconds 120] [--json F]``.

Trains with `RunCheckpoint`, by time as in ``sb3-maddpg train`` and with a checkpoint every 10,000 steps, and measures
the time of writing checkpoints, synced to disk. JSON: one row per training with recipe, every, steps, seconds,
checkpoints, share of the time, and megabytes on disk at the end.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import quad_swarm  # noqa: F401 - registers the environment
from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg import MADDPG
from sb3_maddpg.checkpoints import RunCheckpoint
from sb3_maddpg.vec_env import GymnasiumVecEnv

# Arguments of the environments and of the algorithm, as in recipes that fill their replay buffers
RECIPES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "four robots, flat observations": (
        {"num_envs": 8, "preset": "paper"},
        {"policy": "MlpPolicy", "batch_size": 512, "buffer_size": 100_000, "train_freq": 2},
    ),
    "fourteen robots, pairs": (
        {
            "num_envs": 16,
            "preset": "flight",
            "n_robots": 14,
            "observation": "state+approach+memory+plan+told+mask+critic",
            "world": {"space": {"circle_radius": [3.0, 4.0]}},
        },
        {"policy": "PairPolicy", "policy_kwargs": {"pair_credit": True}, "batch_size": 96, "buffer_size": 24_000},
    ),
}


class Stopwatch(RunCheckpoint):
    """Checkpoint callback that measures the time of its checkpoints."""

    taken = 0.0
    count = 0

    def save(self) -> Path | None:
        started = time.perf_counter()
        try:
            return super().save()
        finally:
            self.taken += time.perf_counter() - started
            self.count += 1


class EndAfter(BaseCallback):
    """Callback that ends training after a number of seconds."""

    def __init__(self, seconds: float):
        super().__init__()
        self.seconds, self.started = seconds, 0.0

    def _on_training_start(self) -> None:
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        return time.perf_counter() - self.started < self.seconds


def measure(recipe: str, every: int | None, seconds: float) -> dict[str, Any]:
    """Train and return the row of the training."""
    env_kwargs, arguments = RECIPES[recipe]
    env = VecMonitor(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", **env_kwargs)))
    model = MADDPG(env=env, learning_starts=1000, seed=0, **{"train_freq": 1, **arguments})
    with tempfile.TemporaryDirectory(dir=".") as folder:
        checkpoint, end = Stopwatch(folder, every), EndAfter(seconds)
        model.learn(10**9, [checkpoint, end])
        elapsed = time.perf_counter() - end.started
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    return {
        "recipe": recipe,
        "every": every,
        "steps": model.num_timesteps,
        "seconds": elapsed,
        "checkpoints": checkpoint.count,
        "share": checkpoint.taken / elapsed,
        "megabytes": size / 1e6,
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0, help="seconds per training (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rows = []
    for recipe in RECIPES:
        for every in (None, 10_000):
            row = measure(recipe, every, args.seconds)
            rows.append(row)
            print(
                f"{recipe:32} {'by time' if every is None else f'each {every} steps':18} {row['checkpoints']:3} in "
                f"{row['seconds']:.0f} s, {row['steps']} steps: {row['share']:.2%} of the time, "
                f"{row['megabytes']:.0f} MB"
            )
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
