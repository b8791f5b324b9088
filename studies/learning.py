"""Compare how well MADDPG learns here and in other libraries, on the tasks of Lowe et al. (mpe2, continuous actions).

``python -m studies.learning [--json F]`` trains our MADDPG and the plain loop, with ``--peers`` also all libraries
that ``make bench-peers`` installs. All trainings use the settings of benchmarks/peers/common.py, one core and one
thread. Each finished training is a line of runs.jsonl in ``--folder``, beside its policies. The script skips finished
trainings, so it can be stopped and restarted. Rows, for each task, side and library:

- ``return``: mean return of an agent over 100 episodes without exploration, averaged over seeds, with a 95 %
  t-interval. In tag and adversary, where one side gains what the other loses, this is each side's return against its
  training partners, which is not informative: see `studies.crossplay`.
- ``ours_minus``: return of ours minus return of this library, with Welch's 95 % interval;
- ``cpu_s``: median processor time of a training.

``--no-train`` only prints existing results.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.training import OURS, REFERENCE, ROOT, drive, installed, machine
from quad_swarm.evaluation.rows import write_rows

TASKS = ("simple_speaker_listener_v4", "simple_tag_v3", "simple_adversary_v3", "simple_spread_v3")
TWIN = "matd3"
EVERYTHING = (OURS, REFERENCE, "xuance", "agilerl", "benchmarl", TWIN)
# Number of seeds per library, fewer for slow ones
SEEDS = {OURS: 5, REFERENCE: 5, "xuance": 5, "agilerl": 3, "benchmarl": 1, TWIN: 3}
FOLDER = ROOT / "logs" / "learning"

Row = dict[str, Any]


def sides(agents: Iterable[str]) -> dict[str, list[str]]:
    """:return: the agents of each side; there is only one side unless some agents are adversaries"""
    teams: dict[str, list[str]] = {}
    names = list(agents)
    against = any(name.startswith("adversary") for name in names)
    for name in names:
        side = name.rpartition("_")[0] if against else "all"
        teams.setdefault("good" if side == "agent" else side, []).append(name)
    return teams


def interval(values: Sequence[float]) -> tuple[float, float]:
    """
    :param values: independent values, such as one per seed
    :return: the mean and the half-width of its 95 % t-interval, NaN for a single value
    """
    if len(values) < 2:
        return float(np.mean(values)), float("nan")
    error = np.std(values, ddof=1) / len(values) ** 0.5
    return float(np.mean(values)), float(stats.t.ppf(0.975, len(values) - 1) * error)


def welch(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """
    :return: the difference of the means and the half-width of its 95 % interval, NaN if either has a single value
    """
    difference = float(np.mean(first) - np.mean(second))
    if min(len(first), len(second)) < 2:
        return difference, float("nan")
    a, b = (np.var(values, ddof=1) / len(values) for values in (first, second))
    freedom = (a + b) ** 2 / (a**2 / (len(first) - 1) + b**2 / (len(second) - 1))
    return difference, float(stats.t.ppf(0.975, freedom) * (a + b) ** 0.5)


def read(folder: Path) -> list[Row]:
    """:return: the finished trainings"""
    path = folder / "runs.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def write(path: Path, rows: Iterable[Row]) -> None:
    """Write rows as a JSON list, with null for missing intervals."""
    write_rows(path, [{key: None if value != value else value for key, value in row.items()} for row in rows])


def actors_of(folder: Path, name: str, env: str, seed: int, steps: int) -> Path:
    """:return: folder of a training's policies"""
    return folder / env / f"{name}_{seed}_{steps}"


def train(name: str, env: str, seed: int, steps: int, folder: Path, core: int | None) -> Row:
    """
    Run a driver once.

    :raises RuntimeError: if the driver failed
    """
    options = {
        "env": env,
        "steps": steps,
        "seed": seed,
        "export": actors_of(folder, name, env, seed, steps),
        "core": core,
    }
    return {"driver": name, **drive(name, "learn", options), "machine": machine()}


def summarise(runs: Iterable[Row]) -> list[Row]:
    """:return: one row per task, side and library, averaged over seeds"""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for run in runs:
        for side in sides(run["returns"]):
            groups.setdefault((run["env"], side, run["driver"]), []).append(run)
    scores = {
        (env, side, name): [
            float(np.mean([run["returns"][agent] for agent in sides(run["returns"])[side]])) for run in group
        ]
        for (env, side, name), group in groups.items()
    }
    rows = []
    for (env, side, name), group in groups.items():
        mean, half = interval(scores[env, side, name])
        row = {
            "env": env,
            "side": side,
            "driver": name,
            **{key: group[0][key] for key in ("library", "version", "steps", "train_freq", "machine")},
            "seeds": len(group),
            "return": mean,
            "interval": half,
            "returns": scores[env, side, name],
            "cpu_s": float(np.median([run["training_cpu_s"] for run in group])),
        }
        if name != OURS and (env, side, OURS) in scores:
            row["ours_minus"], row["ours_minus_interval"] = welch(scores[env, side, OURS], scores[env, side, name])
        rows.append(row)
    return sorted(rows, key=lambda row: (TASKS.index(row["env"]), row["side"], EVERYTHING.index(row["driver"])))


def report(rows: Iterable[Row]) -> None:
    """Print the table."""
    labels = f"{'task':27} {'side':10} {'library':17} seeds"
    print(f"{labels} {'return':>8} {'+-':>6} {'ours_minus':>11} {'+-':>6} {'cpu_s':>6}")
    for row in rows:
        labels = f"{row['env']:27} {row['side']:10} {row['library']:17} {row['seeds']:5d}"
        difference = f"{row['ours_minus']:11.2f} {row['ours_minus_interval']:6.2f}" if "ours_minus" in row else 18 * " "
        print(f"{labels} {row['return']:8.2f} {row['interval']:6.2f} {difference} {row['cpu_s']:6.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as a JSON list")
    parser.add_argument("--peers", action="store_true", help="also the other libraries, and MATD3")
    parser.add_argument("--only", nargs="+", choices=EVERYTHING, help="only these libraries")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS[:3])
    parser.add_argument("--seeds", type=int, help="seeds per library (default: more for fast ones)")
    parser.add_argument("--steps", type=int, default=50_000, help="environment steps per training")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="folder of the trainings (default logs/learning)")
    parser.add_argument("--no-train", action="store_true", help="only print existing results")
    parser.add_argument("--core", type=int, help="core to pin to (default: the last allowed one)")
    args = parser.parse_args()

    names = args.only or (EVERYTHING if args.peers else (OURS, REFERENCE))
    available = [] if args.no_train else installed(names)
    wanted = {name: args.seeds or SEEDS[name] for name in available}
    failures = 0
    # Seed by seed, so that intermediate results compare the same seeds
    for seed in range(max(wanted.values(), default=0)):
        for name, env in [(name, env) for name in available for env in args.tasks if seed < wanted[name]]:
            key = (name, env, seed, args.steps)
            if key in {(run["driver"], run["env"], run["seed"], run["steps"]) for run in read(args.folder)}:
                continue
            started = time.perf_counter()
            try:
                run = train(name, env, seed, args.steps, args.folder, args.core)
            except RuntimeError as error:
                failures += 1
                print(f"FAILED {error}", file=sys.stderr, flush=True)
                continue
            args.folder.mkdir(parents=True, exist_ok=True)
            with (args.folder / "runs.jsonl").open("a") as file:
                file.write(json.dumps(run) + "\n")
            returns = "  ".join(f"{agent} {value:.2f}" for agent, value in run["returns"].items())
            print(f"{time.perf_counter() - started:4.0f} s {name} {env} {seed}: {returns}", file=sys.stderr, flush=True)
    rows = summarise(
        run
        for run in read(args.folder)
        if run["steps"] == args.steps and run["driver"] in names and run["env"] in args.tasks
    )
    report(rows)
    if args.json:
        write(args.json, rows)
    if failures:
        sys.exit(f"{failures} failed, see above.")


if __name__ == "__main__":
    main()
