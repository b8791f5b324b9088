"""Kill the workers of evaluations and searches, or the commands themselves, and compare the results.

``python -m studies.killed_workers [--what evaluation cluster search] [--kills 20] [--json F]``. At random times, an
evaluation with two processes loses one of them, or is killed as a whole and restarted. Its table must equal that of an
undisturbed evaluation. The same happens to an evaluation in processes of Ray. The two workers of a hyperparameter
search are killed and restarted. No trial may be lost, and the search must end with the requested number of finished
trials. JSON: one row for each of the three.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.trial import TrialState

from quad_swarm.evaluation.rows import read_rows, write_rows
from sb3_maddpg.cli.search import open_storage

EVALUATE = ["evaluate", "--policy", "full", "cpa:0.7:1.5", "--episodes", "1000", "--jobs", "2"]
TRIALS = 12
RECIPE = {"n_timesteps": 1500, "policy": "MlpPolicy", "learning_starts": 20, "policy_kwargs": {"net_arch": [8]}}
SEARCH = ["train", "-optimize", "--env", "OwnBit-v0", "--conf-file", "recipe.yml", "--n-evaluations", "2"]
SEARCH += ["--n-eval-envs", "1", "--max-total-trials", str(TRIALS), "--storage", "search.log", "--study-name", "s"]


def start(words: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start a command of sb3-maddpg in a folder that also holds its cache of pieces."""
    env = {**os.environ, "OMP_NUM_THREADS": "1", "RAY_worker_niceness": "0"}
    env["QUAD_SWARM_CACHE"] = str(folder / "cache")
    command = [sys.executable, "-m", "sb3_maddpg", *words]
    return subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def workers_of(process: int, engine: str) -> list[int]:
    """Return the ids of the processes that fly for an evaluation."""
    parents: dict[int, list[tuple[int, str]]] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_text().rpartition(")")[2].split()[1])
            command = (status.parent / "cmdline").read_text()
        except OSError:
            continue
        parents.setdefault(parent, []).append((int(status.parent.name), command))
    if engine == "local":
        return [child for child, command in parents.get(process, []) if "spawn_main" in command]
    found, below = [], [process]
    while below:
        for child, command in parents.get(below.pop(), []):
            below.append(child)
            found += [child] if command.startswith("ray::_run") else []  # not its agents
    return found


def gone(process: int) -> bool:
    """Return whether a process ends within ten seconds."""
    for _ in range(100):
        try:
            state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":  # a zombie
            return True
        time.sleep(0.1)
    return False


def kill(process: int) -> bool:
    """Kill a process and return whether it existed."""
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def untimed(path: Path) -> list[dict[str, Any]]:
    """Read the rows of an evaluation without the timings, which differ between runs."""
    return [{key: value for key, value in row.items() if key != "solve_us"} for row in read_rows(path)]


def evaluation(folder: Path, count: int, rng: random.Random, engine: str = "local") -> dict[str, Any]:
    """Kill workers of an evaluation, and every fourth time the evaluation itself."""
    words = [*EVALUATE, "--engine", engine, "--json", str(folder / "table.json")]
    start([*EVALUATE, "--json", str(folder / "alone.json")], folder).wait()
    orphans = commands = workers = 0
    process = start(words, folder)
    while workers + commands < count:
        time.sleep(rng.uniform(0.5, 2.5))
        if process.poll() is not None:  # it finished before enough kills
            process = start(words, folder)
            continue
        found = workers_of(process.pid, engine)
        if not found:
            continue
        if (workers + commands) % 4 == 3:
            process.kill()
            process.wait()
            commands += 1
            orphans += sum(not gone(one) for one in found)
            process = start(words, folder)
        else:
            workers += kill(rng.choice(found))
    code = process.wait()
    same = code == 0 and untimed(folder / "table.json") == untimed(folder / "alone.json")
    row = {"what": f"evaluation, {engine}", "workers_killed": workers, "commands_killed": commands, "orphans": orphans}
    return row | {"same": same, "pieces_left": len(list((folder / "cache" / "pieces").glob("*")))}


def search(folder: Path, count: int, rng: random.Random) -> dict[str, Any]:
    """Kill the workers of a search."""
    (folder / "recipe.yml").write_text(yaml.safe_dump({"OwnBit-v0": RECIPE}))
    workers = [start(SEARCH, folder) for _ in range(2)]
    killed = 0
    while killed < count and not all(worker.poll() == 0 for worker in workers):
        time.sleep(rng.uniform(4.0, 9.0))
        k = rng.randrange(2)
        if workers[k].poll() is None:
            workers[k].kill()
            workers[k].wait()
            killed += 1
            workers[k] = start(SEARCH, folder)
    codes = [worker.wait() for worker in workers]
    codes.append(start(SEARCH, folder).wait())  # repeats trials that were killed last
    study = optuna.load_study(storage=open_storage(str(folder / "search.log")), study_name="s")
    states = [trial.state for trial in study.trials]
    counts = {state.name.lower(): states.count(state) for state in TrialState}
    finished = counts["complete"] + counts["pruned"]
    same = codes[-1] == 0 and finished >= TRIALS and not counts["running"] and counts["fail"] <= killed
    return {"what": "search", "workers_killed": killed, "trials": TRIALS, **counts, "same": same}


TRIED: dict[str, Callable[[Path, int, random.Random], dict[str, Any]]] = {
    "evaluation": evaluation,
    "cluster": partial(evaluation, engine="ray"),
    "search": search,
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=TRIED, default=list(TRIED), help="default: all")
    parser.add_argument("--kills", type=int, default=20, help="number of kills in each of them (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rows = []
    for what in args.what:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(TRIED[what](Path(folder), args.kills, random.Random(0)))
        print(rows[-1], flush=True)
    if args.json:
        write_rows(args.json, rows)
    sys.exit(0 if all(row["same"] and not row.get("orphans") for row in rows) else 1)


if __name__ == "__main__":
    main()
