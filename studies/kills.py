"""Kill a training again and again, resume it each time, and compare what it ends with.

``python -m studies.kills [--kills 50] [--steps N] [--json F]``. Half of the kills come after a random time, half at the
points of a commit, one after the other: before and after each write, sync and rename. The uninterrupted run of the same
seed tells what the digest (`sb3_maddpg.checkpoints.digest`) has to be. JSON: one row for each kill, and one for the
end.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
from stable_baselines3.common.vec_env import VecMonitor
from tqdm import tqdm

import quad_swarm  # noqa: F401 - registers the environment
from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer, checkpoints
from sb3_maddpg.vec_env import GymnasiumVecEnv

SWARMS, EVERY = 8, 400
POINTS = (
    "opened rows",
    "begin",
    *(f"{done} {name}" for name in ("arrays.npz", "model.zip", "state.json") for done in ("written", "synced")),
    "opened manifest",
    "manifest",
    "folder synced",
    "renamed",
    "committed",
)
_FAULT = "STUDIES_KILLS_FAULT"  # the point at which a child kills itself


def train(folder: Path, steps: int) -> str:
    """Train, or go on where a checkpoint is, to the end.

    :return: digest of the model
    """
    envs = gymnasium.make_vec(
        "QuadSwarm-v0",
        num_envs=SWARMS,
        preset="flight",
        n_robots=4,
        max_steps=60,
        observation="state+approach+memory+plan+told+mask+critic",
    )
    env = VecMonitor(GymnasiumVecEnv(envs))
    with checkpoints.locked(folder):
        found = checkpoints.resume(folder, env)
        if found is not None:
            model, callback = found
        else:
            model = MADDPG(
                "PairPolicy",
                env,
                policy_kwargs={"pair_credit": True},
                learning_starts=800,
                batch_size=64,
                train_freq=1,
                n_steps=4,
                buffer_size=6000,
                replay_buffer_class=PrioritizedTeamReplayBuffer,
                seed=0,
            )
            callback = checkpoints.RunCheckpoint(folder, EVERY)
        model.learn(steps - model.num_timesteps, [callback], reset_num_timesteps=found is None)
    return checkpoints.digest(model)


def child(folder: Path, steps: int) -> None:
    """What is killed."""
    if point := os.environ.get(_FAULT):

        def fault(name: str) -> None:
            if name == point:
                os.kill(os.getpid(), signal.SIGKILL)

        checkpoints.fault = fault
    print(train(folder, steps), flush=True)


def start(folder: Path, steps: int, fault: str | None = None) -> subprocess.Popen[str]:
    """A child that trains.

    :param fault: point of a commit at which it kills itself
    """
    env = {**os.environ, "OMP_NUM_THREADS": "1", **({_FAULT: fault} if fault else {})}
    command = [sys.executable, "-m", "studies.kills", "--child", str(folder), "--steps", str(steps)]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def newest_step(folder: Path) -> int:
    """Step of the newest whole checkpoint, 0 without one."""
    path = checkpoints.newest(folder)
    return int(path.name.rpartition("-")[2]) if path else 0


def kill(folder: Path, steps: int, fault: str | None, seconds: float) -> dict[str, Any]:
    """Start a child, and kill it.

    :return: a row; `done` where it came to its end before
    """
    before = newest_step(folder)
    process = start(folder, steps, fault)
    if fault is None:
        end = time.monotonic() + 120
        # From a random time after the first new checkpoint on, so that runs get ahead
        while newest_step(folder) == before and process.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        time.sleep(seconds)
        process.kill()
    output = process.communicate()[0]
    row = {"kill": fault or "at any time", "from_step": before, "kept_step": newest_step(folder)}
    return row | {"done": output.strip() or None, "leftovers": len(list(folder.glob("*.unfinished")))}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--steps", type=int, default=40_000, help="of the training (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        return child(args.child, args.steps)
    rng, points = random.Random(args.seed), itertools.cycle(POINTS)
    with tempfile.TemporaryDirectory() as whole, tempfile.TemporaryDirectory() as parts:
        expected = start(Path(whole), args.steps).communicate()[0].strip()
        rows = []
        for number in tqdm(range(args.kills), disable=not sys.stderr.isatty()):
            rows.append(kill(Path(parts), args.steps, next(points) if number % 2 else None, rng.uniform(0, 1)))
            if rows[-1]["done"]:
                print(f"The training ended before kill {number + 1}: raise --steps.")
                break
        found = start(Path(parts), args.steps).communicate()[0].strip()
    killed = [row for row in rows if not row["done"]]
    lost = [row for row in killed if row["kept_step"] < row["from_step"]]
    same = bool(expected) and found == expected
    verdict = "the same" if same else "ANOTHER"
    print(f"{len(killed)} kills, {len(lost)} lost a checkpoint; the digest is {verdict}: {found}")
    if args.json:
        write_rows(args.json, [*rows, {"kills": len(killed), "lost": len(lost), "expected": expected, "found": found}])
    sys.exit(0 if same and not lost else 1)


if __name__ == "__main__":
    main()
