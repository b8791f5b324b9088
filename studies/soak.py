"""Fly many episodes in one process and check that it does not grow.

``python -m studies.soak [--episodes N] [--json F]``. Four robots of `flight` fly in batches as in an evaluation, and
environments are created, flown and closed one after the other as in a script. Memory, open files, threads and objects
are measured after the first tenth and at the end. JSON: one row with the measurements and their growth.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium
from tqdm import tqdm

import quad_swarm  # noqa: F401 - registers the environment
from quad_swarm.evaluation.flight import first_episode, run_episodes
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.world.presets import make_config
from studies.swarm.experiment import condition

BATCH = 500
GROWTH = 32.0  # maximum growth of the process (MB): allocator noise, less than half a kilobyte per episode
POLICIES = ("full", "plan:1.1s&stale:4")


def counts() -> dict[str, float]:
    """Measure the resources of the process."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc, which keeps what was freed
    if trim is not None:
        trim(0)
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    # What the process allocated, also where it was swapped out: pages of files come and go as the system likes
    kilobytes = sum(int(status[name].split()[0]) for name in ("RssAnon", "VmSwap"))
    return {
        "megabytes": kilobytes / 1024,
        "files": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "objects": len(gc.get_objects()),
    }


def fly(batch: int) -> int:
    """Fly a batch.

    :return: number of episodes
    """
    config = make_config("flight", n_robots=4)
    one = condition(POLICIES[batch % len(POLICIES)], "asymmetric_swap", config)
    begin = first_episode(0) + batch * BATCH
    rows = run_episodes(one, range(begin, begin + BATCH))
    env = gymnasium.make("QuadSwarm-v0", preset="flight", n_robots=3, max_steps=10)
    env.reset(seed=batch)
    env.action_space.seed(batch)
    over = False
    while not over:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        over = terminated or truncated
    env.close()
    return len(rows) + 1


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100_000, help="default %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    started, episodes, before = time.monotonic(), 0, None
    batches = max(-(-args.episodes // BATCH), 2)
    for batch in tqdm(range(batches), disable=not sys.stderr.isatty()):
        episodes += fly(batch)
        if batch == max(batches // 10, 1) - 1:
            before = counts()
    after = counts()
    assert before is not None
    grown = {f"{name}_grown": after[name] - before[name] for name in after}
    row: dict[str, Any] = {"episodes": episodes, "seconds": time.monotonic() - started, **after, **grown}
    print(row)
    if args.json:
        write_rows(args.json, [row])
    leaks = grown["files_grown"] > 0 or grown["threads_grown"] > 0
    sys.exit(1 if leaks or grown["megabytes_grown"] > GROWTH else 0)


if __name__ == "__main__":
    main()
