"""Fly robots in virtual time while something goes wrong: ``python -m studies.robots [--json F]``.

Eight robots of `flight` swap places (the symmetric swap), with a tenth of all messages lost. Each fault is flown with
the same episodes by full communication, the best rule of `flight` (docs/flight.md) and the learned policy that ships:

- ``nothing``,
- ``a process dies`` after 1.5 s; its vehicle levels, and lands a second after its last command,
- ``a process stands still`` for 0.3 s,
- ``a busy machine``: each process stands still for 20 to 100 ms about five times a second,
- ``two halves``: for a second, no message gets from one half of the robots to the other,
- ``clocks`` of the robots are up to 20 ms wrong,
- ``duplicates``: 30 % of the messages arrive twice, 30 % after the next one, and all take up to 30 ms,
- ``malformed``: a byte of 5 % of the messages is changed; without checksums, which the link does not need over UDP,
- ``malformed, checked``: the same with checksums,
- ``a frozen state``: a robot perceives the same for 0.3 s,
- ``a frozen state for good``: the same until the end; the robot lands.

Rows: fault, policy, flights, how many collided among the robots whose processes live, and among all, with Wilson's
95 % interval of the first; smallest distance of the living; share of plans sent; what the loops counted.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.evaluation.export import export
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.inference import wilson_interval
from quad_swarm.evaluation.real_time import episodes
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.realtime import Conditions
from quad_swarm.realtime.team import Team
from quad_swarm.realtime.virtual import Timing, VirtualFlight
from quad_swarm.world.presets import make_config
from sb3_maddpg.hub.pretrained import pretrained_folder

N_ROBOTS, SET, MOST = 8, 90, 8.0
RULE = "cpa:1.0s:3&soon:0.5|cpa:1.0s:3&stale:4"
POLICIES = ("full", RULE, "pretrained:quad-swarm-flight")
_S = 1_000_000
_LOST = Conditions(0.1)
Happens = Callable[[VirtualFlight], None]


def _nothing(flight: VirtualFlight) -> None:
    pass


def _dies(flight: VirtualFlight) -> None:
    flight.at(int(1.5 * _S), lambda: flight.kill(2))


def _stands(flight: VirtualFlight) -> None:
    flight.at(int(1.3 * _S), lambda: flight.halt(2, 0.3))


def _waits(flight: VirtualFlight) -> None:
    rng = np.random.default_rng(0)
    for robot in range(N_ROBOTS):
        for at in np.sort(rng.uniform(0, MOST, round(5 * MOST))):
            flight.at(int(at * _S), partial(flight.halt, robot, rng.uniform(0.02, 0.1)))


def _halves(flight: VirtualFlight) -> None:
    flight.at(_S, lambda: flight.part(range(N_ROBOTS // 2), 1.0))


def _freezes(flight: VirtualFlight) -> None:
    flight.at(int(1.3 * _S), lambda: flight.freeze(2, 0.3))


def _freezes_for_good(flight: VirtualFlight) -> None:
    flight.at(int(1.3 * _S), lambda: flight.freeze(2, MOST))


# What happens in a flight, how messages fare, delays and clocks, and whether messages carry checksums
FAULTS: dict[str, tuple[Happens, Conditions, Timing, bool]] = {
    "nothing": (_nothing, _LOST, Timing(), False),
    "a process dies": (_dies, _LOST, Timing(), False),
    "a process stands still": (_stands, _LOST, Timing(), False),
    "a busy machine": (_waits, _LOST, Timing(), False),
    "two halves": (_halves, _LOST, Timing(), False),
    "clocks": (_nothing, _LOST, Timing(clock=(-0.02, 0.02)), False),
    "duplicates": (_nothing, Conditions(0.1, 0.3, 0.0, 0.3), Timing(message=(0.0003, 0.03)), False),
    "malformed": (_nothing, Conditions(0.1, malformed=0.05), Timing(), False),
    "malformed, checked": (_nothing, Conditions(0.1, malformed=0.05), Timing(), True),
    "a frozen state": (_freezes, _LOST, Timing(), False),
    "a frozen state for good": (_freezes_for_good, _LOST, Timing(), False),
}


@cache
def _team(policy: str, folder: str) -> Team:
    """Return the team with a policy. Learned ones have been exported to the folder."""
    return Team(make_config("flight", n_robots=N_ROBOTS), folder if policy.startswith("pretrained:") else policy)


def fly(fault: str, policy: str, seeds: range, folder: str) -> list[dict[str, Any]]:
    """Fly episodes with a fault, and return a row for each."""
    happens, conditions, timing, checked = FAULTS[fault]
    team = _team(policy, folder)
    policies = [team.robot(k).policy for k in range(N_ROBOTS)]
    flight = VirtualFlight(team.config, policies, conditions, timing, checked=checked)
    rows = []
    for scene, seed in episodes(team.config, "symmetric_swap", seeds):
        flight.reset(scene.starts, scene.goals, seed)
        happens(flight)
        flight.fly(MOST)
        lives, vehicles = ~flight.dead, flight.vehicles
        distances = vehicles.closest[lives][:, lives]
        counts = flight.result().total.counts
        rows.append({
            "collided": bool(vehicles.collisions(lives)), "collided_any": bool(vehicles.collisions()),
            "closest": float(distances.min()), "counts": dict(counts),
        })  # fmt: skip
    return rows


def main() -> None:
    """Fly all faults, and write a row for each fault and policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows")
    parser.add_argument("--episodes", type=int, default=100, help="flights of each fault and policy (default 100)")
    parser.add_argument("--fault", nargs="+", choices=FAULTS, default=list(FAULTS), metavar="FAULT")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default 1)")
    args = parser.parse_args()
    first, rows = first_episode(SET), []
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(args.jobs) as pool:
        model = str(pretrained_folder("quad-swarm-flight") / "model.zip")
        export(model, make_config("flight", n_robots=N_ROBOTS), Path(folder))
        parts = [range(first + k, min(first + k + 10, first + args.episodes)) for k in range(0, args.episodes, 10)]
        cells = {
            (fault, policy): [pool.submit(fly, fault, policy, seeds, folder) for seeds in parts]
            for fault in args.fault
            for policy in POLICIES
        }
        for (fault, policy), futures in cells.items():
            flown = [row for future in futures for row in future.result()]
            counts = sum((Counter(row["counts"]) for row in flown), Counter[str]())
            collided = sum(row["collided"] for row in flown)
            low, high = wilson_interval(collided, len(flown))
            possible = (counts["periods"] + counts["missed"]) * (N_ROBOTS - 1)
            rows.append({
                "fault": fault, "policy": policy, "flights": len(flown), "collided": collided, "collision_low": low,
                "collision_high": high, "collided_any": sum(row["collided_any"] for row in flown),
                "closest": min(row["closest"] for row in flown),
                "plan_share": (counts["answers"] + counts["announcements"]) / possible,
                "counts": dict(sorted(counts.items())),
            })  # fmt: skip
            print(
                f"{fault:24} {policy:45} {collided:3}/{len(flown)}  up to {high:5.1%}  {rows[-1]['closest']:.2f} m",
                flush=True,
            )
    if args.json is not None:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
