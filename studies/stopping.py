"""Measure how far robots fly on that shall land, in virtual time: ``python -m studies.stopping [--json F]``.

A robot flies straight on in the world of `flight-v2`, 1.5 m high, for 4 s. Then it is either told to land, or it
perceives the same state for ever. Rows, of each vehicle, speed limit (`planner.max_speed`, m/s) and wind (m/s, with
gusts half as strong): flights; the largest speed then (m/s); how far it flies on at most (m), and how far beside it
comes down, median and maximum (m).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.evaluation.rows import write_rows
from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime.virtual import VirtualFlight
from quad_swarm.robot import RulePolicy
from quad_swarm.world.presets import make_config

VEHICLES = ("crazyflie21", "bebop2")
SPEEDS, WINDS = (1.0, 2.0, 4.0), (0.0, 1.0)
STARTS = np.array([[-20.0, -20.0, 1.5], [-20.0, 20.0, 1.5]])
GROUND, MOST = 0.1, 60.0  # m, s


def measure(vehicle: str, speed: float, wind: float, told: int, lost: int) -> list[dict[str, Any]]:
    """Return a row for as many landings that are told, and one for as many states that are lost."""
    limits = {"max_speed": speed, "workspace_low": [-40, -40, 0.5], "workspace_high": [40, 40, 4]}
    world = {"quadrotor": vehicle, "planner": limits, "noise": {"wind": wind, "gust": wind / 2}}
    config = make_config("flight-v2", world, n_robots=2)
    flight, rows = VirtualFlight(config, [RulePolicy("none")] * 2), []
    for what, flights in (("told", told), ("lost", lost)):
        found = np.array([_fly_on(flight, what == "lost", seed) for seed in range(flights)])
        speeds, farthest, beside = found.T
        rows.append({
            "vehicle": vehicle, "max_speed": speed, "wind": wind, "what": what,
            "flights": flights, "speed": speeds.max(), "on": farthest.max(), "beside": np.median(beside),
            "beside_most": beside.max(),
        })  # fmt: skip
    return rows


def _fly_on(flight: VirtualFlight, lost: bool, seed: int) -> tuple[float, float, float]:
    """Return speed (m/s), how far the robot flies on along its way, and how far beside it comes down (m)."""
    flight.reset(STARTS, STARTS * [-1, 1, 1], seed)
    flight.run(4.0)
    state = flight.vehicles.state[0].copy()
    if lost:
        flight.frozen[0] = True
    else:
        flight.loops[0].supervisor.land()
    time, farthest = 4.0, 0.0
    while flight.vehicles.state[0, 2] > GROUND and time < MOST:
        time += 0.05
        flight.run(time)
        farthest = max(farthest, float(flight.vehicles.state[0, 0] - state[0]))
    beside = flight.vehicles.state[0, POSITION][:2] - state[:2]
    return float(np.linalg.norm(state[3:5])), farthest, float(np.linalg.norm(beside))


def main() -> None:
    """Measure all vehicles, speeds and winds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows")
    parser.add_argument("--told", type=int, default=500, help="landings of each that are told (default 500)")
    parser.add_argument("--lost", type=int, default=20, help="states of each that are lost (default 20)")
    args = parser.parse_args()
    rows = []
    print("vehicle      limit  wind  what  speed     on  beside (most)")
    for vehicle in VEHICLES:
        for speed in SPEEDS:
            for wind in WINDS:
                for row in measure(vehicle, speed, wind, args.told, args.lost):
                    rows.append(row)
                    print(
                        f"{vehicle:12} {speed:5.1f} {wind:5.1f}  {row['what']:4}  {row['speed']:5.2f}  {row['on']:5.2f}"
                        f"  {row['beside']:5.2f} ({row['beside_most']:.2f})",
                        flush=True,
                    )
    if args.json is not None:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
