"""A reference for docs/results.md: an actor trained by regression on forked simulations.

``python -m studies.swarm.counterfactual [--forks N] [--episodes N] [--seed S] [--models FOLDER] [--json F]``. Every few
steps, swarms are copied once for each possible request, which is toggled in the copy. The copies fly for a second and a
half, and the actor of zoo_configs/quad_swarm_paper.yml learns by regression how much a request reduces its pair's cost.
There is no critic, so the comparison shows how good critics' estimates are. Then the actor flies with several prices of
a request on episodes of the validation set. JSON: one row per scenario and price with the keys of
`quad_swarm.evaluation.evaluation.summarise`, and forks, steps (of a swarm), labels, seed, seconds, scenario, price.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import torch as th
from torch.nn import functional as F

from quad_swarm.task.request_task import RequestTask, make_task
from quad_swarm.world.presets import make_config
from sb3_maddpg import MADDPG
from studies.swarm.experiment import Experiment, Row, untrained
from studies.swarm.ppo import env_kwargs, reference_arguments, validate

PRICES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
# Range of the prices of the behaviour policy, drawn for each pair and step
LOWEST, HIGHEST = 0.002, 0.4
# Number of swarms, and numbers of steps: between forks, with the toggled request, and of the copies' flights
SWARMS, APART, HELD, AHEAD = 32, 3, 3, 14
DISCOUNT = 0.95
# Ratio of an actor's logit to the gain, and maximum gain, so that collisions do not dominate
SCALE, LARGEST = 4.0, 3.0


class Labels(NamedTuple):
    """Labels from forks.

    :param obs: observations of single robots, (B, size)
    :param gain: reduction of the pair's cost by a request, for each of the others, (B, n - 1)
    """

    obs: np.ndarray
    gain: np.ndarray


class Forks:
    """Swarms that are copied and flown with one request toggled.

    :param model: model whose actor estimates the gain of each request
    :param seed: seed of starts, goals and prices
    """

    def __init__(self, model: MADDPG, seed: int):
        self.model = model
        self.rng = np.random.default_rng(seed)
        kwargs = env_kwargs(0.0)
        n = make_config(kwargs["preset"]).n_robots
        self.pairs = (n, n - 1)
        self.copies = 1 + n * (n - 1)
        self.task = make_task(SWARMS * self.copies, **kwargs)
        self.steps = 0
        self._begin(np.ones(SWARMS, dtype=bool))

    def _begin(self, over: np.ndarray) -> None:
        for k in np.flatnonzero(over):
            seed = int(self.rng.integers(2**31))
            for c in range(self.copies):
                self.task.reset(c * SWARMS + k, np.random.default_rng(seed))

    def _act(self, task: RequestTask) -> np.ndarray:
        """Return the actor's requests, with the same prices in all copies, (copies, SWARMS, n, n - 1)."""
        prices = np.exp(self.rng.uniform(np.log(LOWEST), np.log(HIGHEST), (SWARMS, *self.pairs)))
        with th.no_grad():
            gain = self.model.actor.logits(th.as_tensor(task.observe())).numpy() / SCALE
        return gain.reshape(self.copies, SWARMS, *self.pairs) > prices

    def _step(self, task: RequestTask, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take a step and return the pairs' rewards and which episodes are over, both with a leading axis of copies."""
        self.steps += bits.shape[0] * SWARMS
        outcome = task.step(bits.reshape(-1, *self.pairs))
        over = (outcome.terminated | outcome.truncated).reshape(self.copies, SWARMS)
        return outcome.pair_rewards.reshape(self.copies, SWARMS, *self.pairs), over

    def fork(self) -> Labels:
        """Fly for a few steps, then fork."""
        for _ in range(APART):
            over = self._step(self.task, self._act(self.task))[1][0]
            self._begin(over)
        obs = self.task.observe()[:SWARMS]
        branch = self.task.fork()
        total, flying = np.zeros((self.copies, SWARMS, *self.pairs)), np.ones((self.copies, SWARMS), dtype=bool)
        turned = np.arange(1, self.copies)
        i, m = np.unravel_index(turned - 1, self.pairs)
        first = np.empty(0, dtype=bool)
        for t in range(AHEAD):
            bits = self._act(branch)
            if t == 0:
                first = bits[0, :, i, m].copy()  # (copies - 1, SWARMS)
            if t < HELD:
                bits[turned, :, i, m] = ~first
            rewards, over = self._step(branch, bits)
            total += DISCOUNT**t * rewards * flying[..., None, None]
            flying &= ~over
        more = total[turned, :, i, m] - total[0, :, i, m]
        gain = np.where(first, -more, more).T.reshape(-1, self.pairs[1])
        return Labels(obs.reshape(-1, obs.shape[-1]), np.clip(gain, -LARGEST, LARGEST).astype(np.float32))


def train(forks: int, seed: int) -> tuple[MADDPG, Forks]:
    """Train the actor by regression on forks, whose states come from its own flights."""
    model = untrained(env_kwargs(0.0), {"net_arch": [64, 64], "pair_credit": True}, seed)
    source, n_robots = Forks(model, seed), make_config("paper").n_robots
    known: list[Labels] = []
    optimizer = th.optim.Adam(model.actor.parameters(), lr=1e-3)
    for k in range(forks):
        known.append(source.fork())
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * (1 - k / forks)
        for _ in range(10):
            drawn = [known[source.rng.integers(len(known))] for _ in range(8)]
            obs, gain = (th.as_tensor(np.concatenate(both)) for both in zip(*drawn, strict=True))
            # The actor expects observations of whole teams, although it treats each robot separately
            logits = model.actor.logits(obs.unflatten(0, (-1, n_robots))).flatten(0, 1)
            loss = F.mse_loss(logits, SCALE * gain)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        if (k + 1) % 50 == 0:
            print(f"fork {k + 1}: loss {loss:.3f}", flush=True)
    return model, source


def main() -> None:
    """Run the command line."""
    parser = reference_arguments(__doc__)
    parser.add_argument(
        "--forks", type=int, default=600, help=f"number of forks of {SWARMS} swarms each (default %(default)s)"
    )
    args = parser.parse_args()
    args.models.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    model, source = train(args.forks, args.seed)
    keys: Row = {"forks": args.forks, "steps": source.steps, "seed": args.seed}
    keys |= {"labels": args.forks * SWARMS * (source.copies - 1), "seconds": time.perf_counter() - started}
    path = args.models / f"counterfactual_seed{args.seed}.zip"
    model.save(path)
    policies = {price: f"{path}@{1 / (1 + np.exp(-SCALE * price)):.6f}" for price in PRICES}
    Experiment(args.json, "scenario", "price", "seed").keep(validate(policies, "price", args.episodes, keys))


if __name__ == "__main__":
    main()
