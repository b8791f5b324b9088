"""Kill a training repeatedly, resume it each time, and compare its result with that of an uninterrupted run.

``python -m studies.kills [--kills 50] [--every SECONDS] [--steps N] [--json F]``. Half of the kills come after a random
time, half at successive points of a commit: before and after each write, sync and rename. Then the disk is full at each
of these points, the newest checkpoint is truncated or has a bit flipped, each `DAMAGED` times, and a second process
tries to use the same folder. With ``--every`` there are only kills, with this interval in seconds. The result must have
the same digest (`sb3_maddpg.checkpoints.digest`) as that of an uninterrupted run with the same seed, which trains at
the same time. JSON: one row for each kill and fault, and one for the result.
"""

from __future__ import annotations

import argparse
import errno
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
from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer
from sb3_maddpg.checkpoints import RunCheckpoint, digest, locked, newest, resume
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from studies.commit_points import POINTS, interrupt

SWARMS, EVERY = 8, 400
DAMAGED = 5
_FAULT = "STUDIES_KILLS_FAULT"  # the point at which a child kills itself
_FULL = "STUDIES_KILLS_FULL"  # the point at which its disk is full


def train(folder: Path, steps: int) -> str:
    """Train to the end, starting from a checkpoint if there is one.

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
    with locked(folder):
        found = resume(folder, env)
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
            callback = RunCheckpoint(folder, EVERY)
        model.learn(steps - model.num_timesteps, [callback], reset_num_timesteps=found is None)
    return digest(model)


def child(folder: Path, steps: int) -> None:
    """Train in the child process, which is killed."""
    full = os.environ.get(_FULL)

    def fault(name: str) -> None:
        nonlocal full
        if name == os.environ.get(_FAULT):
            os.kill(os.getpid(), signal.SIGKILL)
        if name == full:
            full = None  # the disk is full only once
            raise OSError(errno.ENOSPC, "No space left on device")

    interrupt(fault)
    print(train(folder, steps), flush=True)


def start(folder: Path, steps: int, fault: str = "", full: str = "") -> subprocess.Popen[str]:
    """Start a child process that trains.

    :param folder: folder of the checkpoints
    :param steps: number of steps of the training
    :param fault: point of a commit at which the child kills itself
    :param full: point of a commit at which the disk is full once
    """
    env = {**os.environ, "OMP_NUM_THREADS": "1", _FAULT: fault, _FULL: full}
    command = [sys.executable, "-m", "studies.kills", "--child", str(folder), "--steps", str(steps)]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def newest_step(folder: Path) -> int:
    """Return the step of the newest complete checkpoint, 0 without one."""
    path = newest(folder)
    return int(path.name.rpartition("-")[2]) if path else 0


def wait_for_checkpoints(folder: Path, process: subprocess.Popen[str], count: int) -> None:
    """Wait until a child has written ``count`` new checkpoints, or has ended."""
    step, end = newest_step(folder), time.monotonic() + 300
    while count and process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)
        if (found := newest_step(folder)) > step:
            step, count = found, count - 1


def row_of(kind: str, folder: Path, before: int, process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the row of a child that has ended, with its digest in ``done`` if it finished the training."""
    output = process.communicate()[0]
    row = {"kill": kind, "from_step": before, "kept_step": newest_step(folder)}
    return row | {"done": output.strip() or None, "leftovers": len(list(folder.glob("*.unfinished")))}


def kill(folder: Path, steps: int, fault: str = "", seconds: float = 0.0, full: str = "") -> dict[str, Any]:
    """Start a child and kill it.

    :param folder: folder of the checkpoints
    :param steps: number of steps of the training
    :param fault: point of a commit at which the child dies; by default it dies after its first new checkpoint
    :param seconds: time between that checkpoint and the kill (s)
    :param full: point of a commit at which the disk is full before the kill
    """
    before = newest_step(folder)
    process = start(folder, steps, fault, full)
    if not fault:
        wait_for_checkpoints(folder, process, 1)
        time.sleep(seconds)
        process.kill()
    return row_of(fault or (f"disk full: {full}" if full else "at any time"), folder, before, process)


def damage(folder: Path, kind: str, rng: random.Random) -> dict[str, Any]:
    """Truncate a file of the newest checkpoint, or flip one of its bits."""
    last = newest(folder)
    assert last is not None
    path = rng.choice(sorted(last.iterdir()))
    content = bytearray(path.read_bytes())
    if kind == "truncated":
        content = content[: rng.randrange(len(content))]
    else:
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    before, kept = int(last.name.rpartition("-")[2]), newest_step(folder)
    return {"kill": f"{kind}: {path.name}", "from_step": before, "kept_step": kept, "done": None, "leftovers": 0}


def second_process(folder: Path, steps: int) -> dict[str, Any]:
    """Start a second child in the same folder, which must refuse to use it."""
    before = newest_step(folder)
    first = start(folder, steps)
    wait_for_checkpoints(folder, first, 1)
    second = start(folder, steps)
    refused = second.wait(timeout=300) != 0 and not second.communicate()[0]
    first.kill()
    return row_of("a second process", folder, before, first) | {"refused": refused}


def kills(args: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Run the kills and return a row for each."""
    rng, points = random.Random(args.seed), itertools.cycle(POINTS)
    rows: list[dict[str, Any]] = []
    for number in tqdm(range(args.kills), disable=not sys.stderr.isatty()):
        if args.every:
            rows.append(kill(folder, args.steps, seconds=args.every))
        elif number % 2:
            rows.append(kill(folder, args.steps, fault=next(points)))
        else:
            rows.append(kill(folder, args.steps, seconds=rng.uniform(0, 1)))
        if rows[-1]["done"]:
            print(f"The training ended before kill {number + 1}: raise --steps.")
            break
    return rows


def faults(args: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Run the faults (full disks, damaged checkpoints, a second process) and return a row for each."""
    rng = random.Random(args.seed)
    rows = [kill(folder, args.steps, full=point, seconds=rng.uniform(0, 1)) for point in POINTS]
    for kind in ("truncated", "flipped"):
        for _ in range(DAMAGED):
            rows += [damage(folder, kind, rng), kill(folder, args.steps)]
    return [*rows, second_process(folder, args.steps)]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--every", type=float, metavar="SECONDS", help="only kill, this long after each checkpoint")
    parser.add_argument(
        "--faults", action=argparse.BooleanOptionalAction, default=True, help="also inject faults after the kills"
    )
    parser.add_argument("--steps", type=int, default=40_000, help="steps of the training (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the times (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        return child(args.child, args.steps)
    with tempfile.TemporaryDirectory() as whole, tempfile.TemporaryDirectory() as parts:
        uninterrupted = start(Path(whole), args.steps)
        try:
            rows = kills(args, Path(parts))
            killed = sum(not row["done"] for row in rows)
            if args.faults and not args.every:
                rows += faults(args, Path(parts))
            found = start(Path(parts), args.steps).communicate()[0].strip()
            expected = uninterrupted.communicate()[0].strip()
        finally:
            uninterrupted.kill()
    early = [row for row in rows if row["done"]]
    # Damaged checkpoints are skipped; all other checkpoints must survive
    lost = [row for row in rows if row["kept_step"] < row["from_step"] and ":" not in row["kill"]]
    intruded = [row for row in rows if not row.get("refused", True)]
    same = bool(expected) and found == expected
    verdict = "the same" if same else "DIFFERENT"
    print(
        f"{killed} kills, {len(rows) - killed} faults and kills after them, {len(lost)} lost checkpoints, "
        f"{len(early)} kills after the end; the digest is {verdict}: {found}"
    )
    if args.json:
        write_rows(args.json, [*rows, {"kills": killed, "lost": len(lost), "expected": expected, "found": found}])
    sys.exit(0 if same and not lost and not intruded and not early else 1)


if __name__ == "__main__":
    main()
