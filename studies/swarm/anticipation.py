"""Train the network by which robots predict others whose plan they do not know (`SwarmConfig.predictor`).

``python -m studies.swarm.anticipation --out FILE.npz [--preset flight-v2] [--world NAME=VALUE ...] [--n-robots N ...]
[--scenarios NAME ...] [--rounds R] [--episodes E] [--jobs 2]`` lets robots fly, notes what each of them sees and what
the others then plan, and learns to predict these plans. Predictions change how robots fly, so they fly with the last
network in each round (dataset aggregation, Ross et al. 2011), at first with constant velocities. Then the world
``predictor=FILE.npz`` has the network. Robots fly seeds of training, not those of any test.

Printed for each round: root mean square errors of predicted positions in flights that were not learned from.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from quad_swarm.evaluation.evaluation import make_pool
from quad_swarm.evaluation.rows import aligned
from quad_swarm.native import anticipation
from quad_swarm.validation import read_assignments
from quad_swarm.world.anticipation import SUFFIX, Predictor
from quad_swarm.world.beliefs import of_others
from quad_swarm.world.doubts import moving_alike
from quad_swarm.world.presets import PRESETS, SwarmConfig, for_scenario, make_config
from quad_swarm.world.scenarios import SCENARIOS
from quad_swarm.world.swarm import StepReport, Swarm
from studies.swarm.experiment import fly_swarm
from studies.swarm.protocol import world

# Nobody talks, and some do: robots whose plan is known fly differently
POLICIES = ("none", "stage:0.9:0.3")
HIDDEN, WIDTH = 32, 128
_SHOWN = (0.25, 0.5, 1.0)  # s
_ROWS = 4000  # of a batch of flights, at most
_TOLERANCE = 0.1  # errors beyond it count linearly (m)


class Seen(NamedTuple):
    """What robots saw of others, and what these then planned, see `quad_swarm.native.anticipation.features`.

    :param own: (rows, OWN) float32
    :param bodies: (rows, bodies, OF_BODY) float32
    :param near: (rows, bodies) float32
    :param wanted: (rows, N, 3) float32
    """

    own: np.ndarray
    bodies: np.ndarray
    near: np.ndarray
    wanted: np.ndarray


class WatchedSwarm(Swarm):
    """Swarm that notes what its robots see and plan.

    :param config: the world, with a network
    :param n_swarms: number of swarms E
    :param share: share of what robots see that is noted
    :param seed: seed of the choice
    """

    def __init__(self, config: SwarmConfig, n_swarms: int, share: float, seed: int):
        super().__init__(config, n_swarms, "rti")
        self.seen: list[Seen] = []
        self._share, self._rng = share, np.random.default_rng(seed)

    def step(self, requests: np.ndarray, announced: np.ndarray | None = None) -> StepReport:
        outlook = self.beliefs.predict(*self.observe(), self.scene()).outlook
        assert outlook is not None
        # Of few swarms, since features take longer than flying
        swarms = self._rng.permutation(self.n_swarms)[: max(1, round(8 * self._share * self.n_swarms))]
        whole = outlook.of_others
        sight = whole._replace(**{name: one[swarms] for name, one in whole._asdict().items() if name != "place"})
        others, present = self.neighbours.others, self.neighbours.present
        report = super().step(requests, announced)
        theirs = of_others(self.planned_positions()[swarms, :, 1:], others if others.ndim == 2 else others[swarms])
        chosen = self._rng.random(sight.skipped.shape) < self._share * self.n_swarms / len(swarms)
        if present is not None:
            chosen &= present[swarms]
        own, bodies, near = anticipation.features(sight)
        wanted = anticipation.outputs(sight, theirs, self.config.planner.dt)
        self.seen.append(Seen(*(array[chosen] for array in (own, bodies, near, wanted))))
        return report


def watch(config: SwarmConfig, scenario: str, policy: str, seeds: Sequence[int]) -> Seen:
    """Fly episodes and return what robots saw.

    :param config: the world, with a network
    :param scenario: name of the scenario
    :param policy: a rule
    :param seeds: seeds of the episodes
    """
    config = for_scenario(config, scenario)
    steps = 0.5 * config.max_steps  # roughly what an episode takes
    share = min(1.0, _ROWS * len(POLICIES) / (steps * len(seeds) * config.n_robots * config.n_others))
    swarm = WatchedSwarm(config, len(seeds), share, seeds[0])
    fly_swarm(swarm, scenario, policy, seeds)
    return Seen(*(np.concatenate(arrays) for arrays in zip(*swarm.seen, strict=True)))


def _layers(*sizes: int) -> nn.ModuleList:
    return nn.ModuleList(nn.Linear(*size) for size in pairwise(sizes))


class Network(nn.Module):
    """The network of `quad_swarm.native.anticipation`.

    :param n_stages: number of stages N
    """

    def __init__(self, n_stages: int):
        super().__init__()
        self.of_body = _layers(anticipation.OF_BODY, HIDDEN, HIDDEN)
        self.head = _layers(anticipation.OWN + 2 * HIDDEN, WIDTH, WIDTH, 3 * n_stages)
        self.n_stages = n_stages

    def forward(self, own: th.Tensor, bodies: th.Tensor, near: th.Tensor) -> th.Tensor:
        """Return mean velocities up to each stage, relative to the current one, (rows, N, 3), see `Seen`."""
        for layer in self.of_body:
            bodies = layer(bodies).relu()
        bodies = bodies * near[..., None]
        x = th.cat([own, bodies.sum(-2), bodies.amax(-2)], -1)
        for layer in self.head[:-1]:
            x = layer(x).relu()
        return self.head[-1](x).reshape(-1, self.n_stages, 3)

    def weights(self) -> np.ndarray:
        """Return all weights, see `quad_swarm.native.anticipation.anticipate`."""
        layers = (*self.of_body, *self.head)
        parts = [part for layer in layers for part in (layer.bias, layer.weight.T.flatten())]
        return th.cat(parts).detach().numpy().astype(np.float32)


def fit(seen: Sequence[Seen], n_stages: int, dt: float, steps: int, seed: int) -> Network:
    """Train a network.

    :param seen: what robots saw; batches are drawn from one of these at a time
    :param n_stages: number of stages N
    :param dt: length of a stage (s)
    :param steps: number of batches
    :param seed: seed
    """
    th.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = Network(n_stages)
    optimizer = th.optim.Adam(network.parameters(), 2e-3)
    schedule = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, steps)
    by_size: dict[int, list[Seen]] = {}
    for one in seen:
        by_size.setdefault(one.near.shape[1], []).append(one)
    sets = [tuple(th.from_numpy(np.concatenate(x)) for x in zip(*ones, strict=True)) for ones in by_size.values()]
    share = np.array([len(one[0]) for one in sets], float)
    times = dt * th.arange(1, n_stages + 1)[:, None]
    for _ in range(steps):
        chosen = sets[rng.choice(len(sets), p=share / share.sum())]
        rows = th.from_numpy(rng.integers(0, len(chosen[0]), 1024))
        *inputs, wanted = (one[rows] for one in chosen)
        error = times * (network(*inputs) - wanted)
        loss = nn.functional.smooth_l1_loss(error, th.zeros_like(error), beta=_TOLERANCE)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


@th.no_grad()
def errors(network: Network | None, seen: Sequence[Seen], dt: float) -> list[float]:
    """Return root mean square errors of predicted positions at the times that are shown (m).

    :param network: the network, None for constant velocities
    """
    squares = []
    for own, bodies, near, wanted in seen:
        predicted = 0.0 if network is None else network(*map(th.from_numpy, (own, bodies, near))).numpy()
        times = dt * np.arange(1, wanted.shape[1] + 1)
        squares.append((times * np.linalg.norm(predicted - wanted, axis=-1)) ** 2)
    mean = np.concatenate(squares).mean(axis=0)
    return [float(np.sqrt(mean[min(round(time / dt), len(mean)) - 1])) for time in _SHOWN]


def train(
    configs: Sequence[SwarmConfig], scenarios: Sequence[str], rounds: int, episodes: int, pool: Executor, out: Path
) -> None:
    """Train a network and write it.

    :param configs: the worlds, which differ in their numbers of robots
    :param scenarios: names of the scenarios
    :param rounds: number of rounds
    :param episodes: number of episodes of eight robots of each scenario and policy in a round; larger teams fly fewer
    :param pool: processes
    :param out: file to write
    """
    horizon, dt = configs[0].planner.horizon, configs[0].planner.dt
    about = json.dumps(
        {"n_robots": [one.n_robots for one in configs], "scenarios": list(scenarios), "world": common(configs)}
    )
    weights = np.zeros(anticipation.count_weights(HIDDEN, WIDTH, horizon), np.float32)  # constant velocities
    learned: list[Seen] = []
    table = [["round", "rows", *(f"{time:g} s" for time in _SHOWN), "at constant velocity", "minutes"]]
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(rounds + 1):
            last = number == rounds
            file = out if last else Path(folder) / f"{number}.npz"
            Predictor(weights, HIDDEN, WIDTH, horizon, dt, about).save(file)
            if last:
                break
            work = [
                (replace(config, predictor=str(file)), scenario, policy, range(first, first + count))
                for config in configs
                for scenario in scenarios
                for policy in POLICIES
                for count in [max(2, round(episodes * 8 / config.n_robots))]
                for first in [number * 10_000]
            ]
            # One in eight flights is not learned from
            parts = [(*one[:3], seeds) for one in work for seeds in _split(one[3])]
            found = list(pool.map(watch, *zip(*parts, strict=True)))
            learned += found[::2]
            steps = round(4 * sum(len(one.own) for one in learned) / 1024)
            network = fit(learned, horizon, dt, steps, number)
            weights = network.weights()
            texts = [" / ".join(f"{e:.2f}" for e in errors(one, found[1::2], dt)) for one in (network, None)]
            rows = sum(len(one.own) for one in learned)
            minutes = (time.monotonic() - started) / 60
            table.append([str(number + 1), str(rows), *texts[0].split(" / "), texts[1], f"{minutes:.1f}"])
            print(aligned(table, 0), flush=True)


def common(configs: Sequence[SwarmConfig]) -> dict[str, Any]:
    """Return the fields on which it depends how robots move, and that worlds have in common."""
    first, *rest = map(moving_alike, configs)
    return {name: value for name, value in first.items() if all(one[name] == value for one in rest)}


def _split(seeds: range) -> tuple[range, range]:
    held = max(1, len(seeds) // 8)
    return seeds[held:], seeds[:held]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--preset", default="flight-v2", choices=list(PRESETS))
    parser.add_argument("--world", nargs="+", action="extend", default=[], metavar="NAME=VALUE")
    parser.add_argument("--n-robots", nargs="+", type=int, default=[4, 8, 12, 16])
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=list(SCENARIOS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    if args.out.suffix != SUFFIX or not args.out.absolute().parent.is_dir():
        parser.error(f"--out {args.out}: name a file that ends with {SUFFIX}, in a folder that exists")
    if min(args.rounds, args.episodes, args.jobs) < 1:
        parser.error("--rounds, --episodes and --jobs must be at least 1")
    changes: dict[str, Any] = read_assignments("--world", args.world)
    configs = [make_config(world(args.preset, n), changes) for n in args.n_robots]
    with make_pool(args.jobs) as pool:
        train(configs, args.scenarios, args.rounds, args.episodes, pool, args.out)


if __name__ == "__main__":
    main()
