"""Compare how fast MADDPG trains here and in other libraries.

``python benchmarks/training.py [--json F]`` after ``make bench-peers``, which installs the other libraries. All use one
core, one thread, three agents of simple_spread (mpe2, continuous actions), networks with two hidden layers of 64, and
batches of 1024:

- ``updates_per_s``: updates of all critics, all actors and the target networks, including sampling,
- ``steps_per_s_100``, ``steps_per_s_1``: environment steps of the library's own training loop, with an update every
  100 steps (as in Lowe et al.) and every step.

Rates are per second of processor time, with ``_wall`` per second of wall time. They are medians over several rounds, in
which the libraries take turns in separate processes. Ratios are medians of the ratios within rounds. The drivers in
benchmarks/peers describe what their libraries do differently, especially with shared networks. JSON: one row per
library and kind of networks.
"""

import argparse
import importlib.util
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from quad_swarm.evaluation.rows import write_rows

ROOT = Path(__file__).resolve().parent.parent
OURS, REFERENCE, PEERS = "ours", "plain", ("agilerl", "benchmarl", "xuance")
# Who has which kind of networks, see `benchmarks.peers.common.Task`
HAVE = {
    "separate": (OURS, REFERENCE, *PEERS),
    "shared": (OURS, "agilerl", "xuance"),
    "team": (OURS, "benchmarl"),
}
RATES = ("updates_per_s", "steps_per_s_100", "steps_per_s_1")
AMOUNTS = {"updates": 300, "steps-100": 5_000, "steps-1": 400}
QUICK = {"updates": 60, "steps-100": 1_000, "steps-1": 60}

Row = dict[str, Any]
Rounds = Mapping[tuple[str, str], Sequence[Row]]


def python_of(name: str) -> Path:
    """:return: the Python interpreter with the library of a driver"""
    return ROOT / ".bench" / name / "bin" / "python" if name in PEERS else Path(sys.executable)


def missing(name: str) -> str | None:
    """:return: the command that installs the dependencies of a driver, None if they are installed"""
    if name in PEERS:
        return None if (ROOT / ".bench" / name / ".installed").exists() else f"make .bench/{name}/.installed"
    return None if importlib.util.find_spec("mpe2") else f"{sys.executable} -m pip install -c constraints.txt mpe2"


def installed(names: Sequence[str]) -> list[str]:
    """:return: the drivers whose dependencies are installed; the others are named"""
    commands = {name: missing(name) for name in names}
    for name, command in commands.items():
        if command:
            print(f"{name} is skipped, since it is not installed: {command}", file=sys.stderr, flush=True)
    return [name for name in names if not commands[name]]


def drive(name: str, mode: str, options: Mapping[str, Any]) -> Row:
    """
    Run a driver once.

    :param name: name of the driver
    :param mode: speed or learn
    :param options: the driver's options; those that are None are left out
    :raises RuntimeError: if the driver failed
    """
    command = [str(python_of(name)), "-m", f"benchmarks.peers.{name}_bench", mode]
    command += [f"--{option}={value}" for option, value in options.items() if value is not None]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    run = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, check=False)
    if run.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])


def machine() -> str:
    """:return: name of the processor"""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def summarise(rounds: Rounds) -> list[Row]:
    """:return: one row per library and kind of networks with medians, and all values under ``rounds``"""
    rows = []
    for runs in rounds.values():
        rates = {key: [run[key] for run in runs] for key in runs[0] if key.startswith(RATES)}
        labels = {key: runs[0][key] for key in ("library", "version", "networks")}
        medians = {key: median(values) for key, values in rates.items()}
        rows.append({**labels, **medians, "rounds": {key: rates[key] for key in RATES}, "machine": machine()})
    return rows


def ratios(rounds: Rounds, networks: str, rate: str) -> dict[str, float]:
    """:return: our speedup over each other library, as the median over rounds"""
    ours = rounds.get((OURS, networks), ())
    return {
        name: median(our[rate] / other[rate] for our, other in zip(ours, runs, strict=True))
        for (name, kind), runs in rounds.items()
        if ours and kind == networks and name != OURS
    }


def report(rounds: Rounds) -> list[Row]:
    """
    Print the table and the ratios.

    :return: the rows
    """
    rows = summarise(rounds)
    print(f"\nPer second of one core of {machine()}; medians of {max(map(len, rounds.values()))} rounds.")
    print(f"{'library':14} {'version':12} {'networks':9}" + "".join(f"{rate:>17}" for rate in RATES))
    for row in rows:
        labels = f"{row['library']:14} {row['version']:12} {row['networks']:9}"
        print(labels + "".join(f"{row[rate]:17.{0 if row[rate] >= 100 else 1}f}" for rate in RATES))
    for networks in HAVE:
        for rate in RATES:
            times = ratios(rounds, networks, rate)
            if peers := {name: times[name] for name in PEERS if name in times}:
                nearest = min(peers, key=lambda name: peers[name])
                plain = f", {times[REFERENCE]:.2f} of the plain loop" if REFERENCE in times else ""
                print(f"{networks} {rate}: {peers[nearest]:.2f} times the best peer, {nearest}{plain}")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    everything = (OURS, REFERENCE, *PEERS)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as a JSON list")
    parser.add_argument("--only", nargs="+", choices=everything, default=everything, help="only these libraries")
    parser.add_argument("--networks", nargs="+", choices=HAVE, default=list(HAVE))
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds (default 3)")
    parser.add_argument("--quick", action="store_true", help="a fifth of the work, as a test")
    parser.add_argument("--core", type=int, help="core to pin to (default: the last allowed one)")
    args = parser.parse_args()

    names = installed(args.only)
    rounds: dict[tuple[str, str], list[Row]] = {
        (name, networks): [] for networks in args.networks for name in names if name in HAVE[networks]
    }
    amounts = QUICK if args.quick else AMOUNTS
    failures = []
    for number in range(args.rounds):
        for name, networks in list(rounds):
            try:
                row = drive(name, "speed", {"networks": networks, **amounts, "core": args.core})
            except RuntimeError as error:
                failures.append(str(error))
                print(f"FAILED {error}", flush=True)
                del rounds[name, networks]
                continue
            rounds[name, networks].append(row)
            cells = "  ".join(f"{rate} {row[rate]:.1f}" for rate in RATES)
            print(f"round {number + 1}: {row['library']:14} {networks:9} {cells}", flush=True)
    if not rounds:
        sys.exit("Nothing was measured.")
    rows = report(rounds)
    if args.json:
        write_rows(args.json, rows)
    if failures:
        sys.exit(f"{len(failures)} of {len(rounds) + len(failures)} failed, see above.")


if __name__ == "__main__":
    main()
