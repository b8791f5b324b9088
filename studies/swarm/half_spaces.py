"""Half-spaces as a fallback: does it help to stay on one's own side of those whose plans are old?

``python -m studies.swarm.half_spaces [--kind voronoi orca] [--age 0 3] [--distance 1.2] [--policy ...]
[--n-robots 16] [--plant ...] [--episodes 1000] [--seed 31] [--json F]`` flies symmetric swaps of `flight-v2`. Each
robot replaces what it believes about another one by a half-space if the plan that it knows is at least ``--age`` steps
old and the other is closer than ``--distance`` (m):

- ``voronoi``: the buffered Voronoi cell of `quad_swarm.planner.voronoi`, half of the separation from the plane midway
  between both;
- ``orca``: the same plane, which moves as the half-space of allowed velocities of `quad_swarm.planner.orca` says: as
  long as its velocity is allowed, a robot is on the allowed side of it.

JSON: one row per policy and fallback with the keys of `quad_swarm.evaluation.summarise`, ``kind``, ``age``,
``distance``, and ``replaced``, the share of the beliefs that were replaced.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.evaluation.evaluation import Rows, make_pool, summarise
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.rows import aligned, write_rows
from quad_swarm.geometry import dot, length
from quad_swarm.planner import Problems
from quad_swarm.planner.orca import avoid
from quad_swarm.plants.base import MODEL
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.swarm import Swarm
from studies.swarm import protocol
from studies.swarm.commitment import BEST_RULE
from studies.swarm.experiment import fly_swarm
from studies.swarm.version2 import OUTCOME, outcome

_RADIUS = 20.0  # of the spheres that stand for half-spaces (m): within 1 m of the touching point, they differ by 2.5 cm
_MARGIN = 0.15  # of ORCA, as `quad_swarm.planner.OrcaSolver` has it (m)
_CHUNK = 100  # episodes per batch


class Fallback(NamedTuple):
    """When which half-space replaces what a robot believes.

    :param kind: "voronoi", "orca", or "none"
    :param age: least age of the plan that it knows (steps)
    :param distance: distance within which it does (m)
    """

    kind: str = "none"
    age: int = 0
    distance: float = 0.0


class CautiousSwarm(Swarm):
    """Swarm with a fallback to half-spaces.

    :param config: the world
    :param n_swarms: number of swarms E
    :param fallback: when which half-space is used
    """

    def __init__(self, config: SwarmConfig, n_swarms: int, fallback: Fallback):
        super().__init__(config, n_swarms)
        self.fallback = fallback
        self.replaced, self.beliefs_held = 0, 0

    def _problems(self, believed: np.ndarray, source: np.ndarray) -> Problems:
        problems = super()._problems(believed, source)
        kind, age, distance = self.fallback
        self.beliefs_held += believed.shape[0] * believed.shape[1] * believed.shape[2]
        if kind == "none":
            return problems
        config, x = self.config.planner, problems.x
        # Where the others are is observed; their plans are at stages from the time at which inputs take effect
        pos, vel = self.observe()
        if self._late is not None:
            pos = pos + (config.dt * self._late)[..., None, None] * vel
        pos, vel = pos.reshape(len(x), -1, 3), vel.reshape(len(x), -1, 3)
        between = pos - x[:, None, POSITION]
        apart = length(between)
        chosen = (self.beliefs.age.reshape(apart.shape) >= age) & (apart < distance)
        self.replaced += int(chosen.sum())
        if not chosen.any():
            return problems
        normals = -between / np.maximum(apart, 1e-9)[..., None]
        times = config.dt * np.arange(1, config.horizon + 1)
        if kind == "voronoi":
            touched = pos + ((apart - config.separation) / 2)[..., None] * normals
            touched = np.repeat(touched[:, :, None], config.horizon, axis=2)
        else:
            own = x[:, None, VELOCITY]
            kept = np.full(apart.shape, config.separation + _MARGIN)
            normals, change = avoid(between, own - vel, kept, 1.0, 0.4)
            # The plane through the robot's own place, which moves with the slowest velocity that is allowed
            slowest = (dot(normals, own) + change / 2)[..., None] * normals
            touched = x[:, None, None, POSITION] + times[:, None] * slowest[:, :, None]
            touched = touched - config.separation * normals[:, :, None]
        others = np.where(chosen[..., None, None], touched - _RADIUS * normals[:, :, None], problems.others)
        clearance = np.zeros(others.shape[:3]) if problems.clearance is None else problems.clearance
        clearance = np.where(chosen[..., None], _RADIUS, clearance)
        announced = None if problems.announced is None else problems.announced & ~chosen
        return problems._replace(others=others, clearance=clearance, announced=announced)


def fly(
    config: SwarmConfig, scenario: str, policy: str, fallback: Fallback, episodes: Sequence[int]
) -> tuple[Rows, float]:
    """Fly episodes.

    :param config: the world
    :param scenario: name of the scenario
    :param policy: see `quad_swarm.evaluation.policies.make_policy`
    :param fallback: see `CautiousSwarm`
    :param episodes: seeds
    :return: their statistics, and the share of beliefs that were replaced
    """
    swarm = CautiousSwarm(config, len(episodes), fallback)
    rows = fly_swarm(swarm, scenario, policy, episodes)
    return rows, swarm.replaced / swarm.beliefs_held


def table(rows: list[dict[str, Any]]) -> str:
    """Format rows."""
    texts = [["robots", "policy", "fallback", "replaced", *OUTCOME]]
    for row in rows:
        texts.append([
            str(row["n_robots"]),
            row["policy"],
            "none" if row["kind"] == "none" else f"{row['kind']}, {row['age']} steps, {row['distance']:g} m",
            f"{row['replaced']:.2%}",
            *outcome(row),
        ])  # fmt: skip
    return aligned(texts, 3)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", nargs="+", default=["voronoi", "orca"], choices=["voronoi", "orca"])
    parser.add_argument("--age", nargs="+", type=int, default=[0, 3])
    parser.add_argument("--distance", nargs="+", type=float, default=[1.2])
    parser.add_argument("--policy", nargs="+", default=["none", BEST_RULE, "stage:1.0:0.2"])
    parser.add_argument("--n-robots", nargs="+", type=int, default=[16])
    parser.add_argument("--scenario", default="symmetric_swap")
    parser.add_argument("--plant", default=MODEL)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    fallbacks = [Fallback(), *itertools.starmap(Fallback, itertools.product(args.kind, args.age, args.distance))]
    first = first_episode(args.seed)
    chunks = [range(first + k, first + min(k + _CHUNK, args.episodes)) for k in range(0, args.episodes, _CHUNK)]
    found: list[dict[str, Any]] = []
    with make_pool(args.jobs) as pool:
        for n, policy in itertools.product(args.n_robots, args.policy):
            config = make_config(protocol.world("flight-v2", n), plant=args.plant)
            for fallback in fallbacks:
                futures = [pool.submit(fly, config, args.scenario, policy, fallback, chunk) for chunk in chunks]
                flown = [future.result() for future in futures]
                rows = [row for rows, _ in flown for row in rows]
                keys = {"n_robots": n, "scenario": args.scenario, "policy": policy, "set": args.seed}
                keys |= {"plant": config.plant, **fallback._asdict()}
                found.append({**keys, **summarise(rows, config), "replaced": float(np.mean([one for _, one in flown]))})
                print(table(found[-1:]), flush=True)
                if args.json:
                    write_rows(args.json, found)


if __name__ == "__main__":
    main()
