"""How far beside their goals a steady wind leaves robots, with and without an estimate of it.

``python -m studies.wind [--wind 1 4 6] [--estimate none 0.3 1 2] [--json F]``: two robots hover at their goals for 12 s
in the wind along x, in the preset `paper` without any other disturbance, and for 15 s in `flight` with all of its
disturbances. JSON: one row per preset, wind and time constant (s) with the mean distance from the goals in the last
2 s (m).
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np

from quad_swarm.evaluation.rows import aligned, write_rows
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm
from studies.swarm.commitment import time_constant

PLACES = np.array([[-1.5, 0.0, 1.5], [1.5, 0.0, 1.5]])
SECONDS = {"paper": 12.0, "flight": 15.0}
LAST = 2.0  # s


def distance(preset: str, wind: float, estimate: float | None, seed: int = 1) -> float:
    """Return the mean distance of robots that hover from their goals (m)."""
    config = make_config(preset, {"noise": {"wind": 1.0}, "planner": {"disturbance_time": estimate}}, n_robots=2)
    swarm, nobody = Swarm(config), np.zeros((1, 2, 1), dtype=bool)
    swarm.reset(0, PLACES, PLACES, noise_seed=seed)
    swarm.disturbances._wind[0] = wind, 0.0
    steps, last = (round(seconds / config.planner.dt) for seconds in (SECONDS[preset], LAST))
    found = []
    for _ in range(steps):
        swarm.step(nobody)
        found.append(np.linalg.norm(swarm.pos[0] - PLACES, axis=1))
    return float(np.mean(found[-last:]))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wind", nargs="+", type=float, default=[1.0, 4.0, 6.0], help="m/s")
    parser.add_argument("--estimate", nargs="+", type=time_constant, default=[None, 0.3, 1.0, 2.0], help="s, or none")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rows = [
        {"preset": preset, "wind": wind, "estimate": estimate, "distance": distance(preset, wind, estimate)}
        for preset, wind, estimate in itertools.product(SECONDS, args.wind, args.estimate)
    ]
    texts = [["preset", "wind (m/s)", *("without" if one is None else f"{one:g} s" for one in args.estimate)]]
    for preset, wind in itertools.product(SECONDS, args.wind):
        found = [f"{row['distance']:.3f}" for row in rows if (row["preset"], row["wind"]) == (preset, wind)]
        texts.append([preset, f"{wind:g}", *found])
    print(aligned(texts, 1))
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
