"""Measure the periods of one robot: time, memory and garbage collections.

``python benchmarks/robot.py [--json F]`` records what one of eight robots of `flight` perceives and receives in ten
swaps, flown in lock-step, and lets that robot fly them again, 100,000 periods for each policy: no communication, full
communication, a rule, and the learned policy that ships, in ONNX Runtime. As in the process of a robot, the garbage
collector is off after the first periods. The table has the median and what one period in a thousand exceeds (us of wall
time, and the median's ratio to that without communication), what the memory grew by, and collections; JSON: a row for
each policy. Other processes on the machine show in the second number.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from quad_swarm.evaluation.export import export
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.real_time import episodes
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.planner import make_planner
from quad_swarm.realtime.loop import freeze_garbage
from quad_swarm.realtime.statistics import Histogram
from quad_swarm.robot import Plan, Policy, Robot, RulePolicy, files
from quad_swarm.robot.lockstep import LockstepWorld
from quad_swarm.world.presets import SwarmConfig, make_config
from sb3_maddpg.hub.pretrained import pretrained_folder

RULE = "cpa:1.0s:3&soon:0.5|cpa:1.0s:3&stale:4"
STEPS = 80


class Recorder(Robot):
    """A robot that notes what it perceives and receives."""

    def reset(self, start: np.ndarray, goal: np.ndarray, *options: Any, **more: Any) -> None:
        super().reset(start, goal, *options, **more)
        self.begun = (np.array(start), np.array(goal), *options), more
        self.periods: list[tuple[tuple[Any, ...], list[tuple[int, Plan]]]] = []

    def decide(self, now: int, state: np.ndarray, pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
        self.periods.append(((now, state.copy(), pos.copy(), vel.copy()), []))
        return super().decide(now, state, pos, vel)

    def receive(self, sender: int, plan: Plan) -> None:
        self.periods[-1][1].append((sender, plan))
        super().receive(sender, plan)


def recorded(config: SwarmConfig, policies: list[Policy], count: int) -> Iterator[Recorder]:
    """Fly episodes in lock-step, and yield the first robot after each."""
    planner = make_planner(config.planner, config.quadrotor, config.n_robots)
    for scene, seed in episodes(config, "symmetric_swap", range(first_episode(0), first_episode(0) + count)):
        robots = [(Recorder if k == 0 else Robot)(config, k, one, planner) for k, one in enumerate(policies)]
        world = LockstepWorld(config, robots)
        world.reset(scene.starts, scene.goals, seed)
        for _ in range(STEPS):
            world.step()
        first = robots[0]
        assert isinstance(first, Recorder)
        yield first


def measure(config: SwarmConfig, policies: list[Policy], count: int, episodes_: int) -> dict[str, Any]:
    """Let the first robot fly again what it flew, and measure its periods."""
    flights = [(one.begun, one.periods) for one in recorded(config, policies, episodes_)]
    robot = Robot(config, 0, policies[0])
    durations, flown, collections, before = Histogram(), 0, 0, 0
    while flown < count:
        for begun, periods in flights:
            robot.reset(*begun[0], **begun[1])
            for perceived, received in periods:
                began = time.perf_counter()
                robot.decide(*perceived)
                for sender, plan in received:
                    robot.receive(sender, plan)
                robot.plan()
                durations.add((time.perf_counter() - began) * 1e6)
            flown += len(periods)
            if not before:  # after the first flight, everything is there
                freeze_garbage()
                collections, before = _collections(), _memory()
    grown, collected = _memory() - before, _collections() - collections
    gc.unfreeze()
    gc.enable()
    times = {"us": durations.quantile(0.5), "us_999": durations.quantile(0.999)}
    return {"periods": flown, **times, "grown_kb": grown, "collections": collected}


def _collections() -> int:
    return sum(int(one["collections"]) for one in gc.get_stats())


def _memory() -> int:
    """Return the largest memory of the process so far (kB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    """Measure all policies, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as a JSON list")
    parser.add_argument("--periods", type=int, default=100_000, help="periods of each policy (default 100000)")
    parser.add_argument("--n-robots", type=int, default=8, help="(default 8)")
    args = parser.parse_args()
    config, n, rows = make_config("flight", n_robots=args.n_robots), args.n_robots, []
    with tempfile.TemporaryDirectory() as folder:
        export(str(pretrained_folder("quad-swarm-flight") / "model.zip"), config, Path(folder))
        policies: dict[str, list[Policy]] = {
            name: [RulePolicy(name) for _ in range(n)] for name in ("none", "full", RULE)
        }
        policies["learned"] = [files.load(folder).actor() for _ in range(n)]
        for name, team in policies.items():
            rows.append({"policy": name, "n_robots": n, **measure(config, team, args.periods, 10)})
            rows[-1]["ratio"] = rows[-1]["us"] / rows[0]["us"]
            row = rows[-1]
            print(
                f"{name:40} {row['us']:6.0f} us ({row['ratio']:.2f}), 99.9 %: {row['us_999']:6.0f} us, "
                f"{row['grown_kb']:5} kB, {row['collections']} collections",
                flush=True,
            )
    if args.json is not None:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
