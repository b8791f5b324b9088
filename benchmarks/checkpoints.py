"""Measure the cost of checkpoints during training: ``python benchmarks/checkpoints.py [--seconds 120] [--json F]``.

Trains four robots with flat observations, and fourteen with the recipe ``quad_swarm_flight.yml``. Checkpoints are
written by time, as in ``sb3-maddpg train``, or every 10,000 steps, and synced to disk. ``--whole`` trains the recipe to
its end instead. JSON: one row per training with recipe, every, whole, steps, seconds, checkpoints, megabytes on disk at
the end, and share: the time for which the training stood still and the processor time of the threads that write, as a
fraction of the whole time.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import quad_swarm  # noqa: F401 - registers the environment
from quad_swarm.evaluation.rows import read_rows, write_rows
from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer
from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

FILE = Path(__file__).parents[1] / "zoo_configs" / "quad_swarm_flight.yml"
FOUR, FOURTEEN = "four robots, flat observations", FILE.name


def arguments_of(recipe: str) -> tuple[dict[str, Any], dict[str, Any], int]:
    """Return the arguments of the environments and of the algorithm, and the number of steps of a whole training."""
    if recipe == FOUR:
        arguments = {"policy": "MlpPolicy", "batch_size": 512, "buffer_size": 100_000, "train_freq": 2}
        return {"num_envs": 8, "preset": "paper"}, arguments | {"learning_starts": 1000}, 1_000_000
    arguments = yaml.safe_load(FILE.read_text())["QuadSwarm-v0"]
    env = {"num_envs": arguments.pop("n_envs"), **arguments.pop("env_kwargs")}
    steps = arguments.pop("n_timesteps")
    for name in ("vec_env", "eval_env_kwargs"):
        del arguments[name]
    arguments["learning_rate"] = float(arguments["learning_rate"].removeprefix("lin_"))
    arguments["replay_buffer_class"] = PrioritizedTeamReplayBuffer
    return env, arguments, steps


class Counting(RunCheckpoint):
    """Checkpoint callback that counts its checkpoints."""

    count = 0

    def _begin(self) -> None:
        super()._begin()
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
    """Train for a time, or to the end of the recipe if this is infinite, and return the row of the training."""
    env_kwargs, arguments, steps = arguments_of(recipe)
    env = VecMonitor(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", **env_kwargs)))
    model = MADDPG(env=env, seed=0, **arguments)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        checkpoint, end = Counting(folder, every), EndAfter(seconds)
        model.learn(steps, [checkpoint, end])
        elapsed = time.perf_counter() - end.started
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    return {
        "recipe": recipe,
        "every": every,
        "whole": math.isinf(seconds),
        "steps": model.num_timesteps,
        "seconds": elapsed,
        "checkpoints": checkpoint.count,
        "share": checkpoint.cost / elapsed,
        "megabytes": size / 1e6,
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0, help="seconds per training (default %(default)s)")
    parser.add_argument("--whole", action="store_true", help="train the recipe to its end")
    parser.add_argument("--json", type=Path, metavar="FILE", help="add the rows to this file")
    args = parser.parse_args()
    work = (
        [(FOURTEEN, None)] if args.whole else [(name, every) for name in (FOUR, FOURTEEN) for every in (None, 10_000)]
    )
    rows = []
    for recipe, every in work:
        row = measure(recipe, every, math.inf if args.whole else args.seconds)
        rows.append(row)
        print(
            f"{recipe:32} {'by time' if every is None else f'each {every} steps':18} {row['checkpoints']:3} in "
            f"{row['seconds']:.0f} s, {row['steps']} steps: {row['share']:.2%} of the time, "
            f"{row['megabytes']:.0f} MB",
            flush=True,
        )
    if args.json:
        write_rows(args.json, [*read_rows(args.json), *rows])


if __name__ == "__main__":
    main()
