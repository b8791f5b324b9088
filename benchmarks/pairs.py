"""Measure an update of `PairPolicy` in the swarm's recipe, and what its own operations save.

``python benchmarks/pairs.py [--agents 8 14] [--rounds 7] [--json F]``: batches of 96 transitions, the networks, the
observations and the action mask of ``zoo_configs/quad_swarm_flight_v2.yml``, one thread. An update is that of critic,
actor and targets, including sampling. With `sb3_maddpg.relational.operations` and with PyTorch's functions instead, it
takes turns; the ratio is the median over the rounds. JSON: one row per number of agents.
"""

import argparse
import time
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from unittest.mock import patch

import gymnasium as gym
import torch as th
import yaml
from stable_baselines3.common.logger import Logger
from torch.nn import functional as F

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from quad_swarm.evaluation.rows import aligned, write_rows
from sb3_maddpg import MADDPG
from sb3_maddpg.relational import networks, operations

RECIPE = Path(__file__).resolve().parent.parent / "zoo_configs" / "quad_swarm_flight_v2.yml"
ARGUMENTS = ("policy_kwargs", "threshold_price", "policy_regularization", "gamma", "n_steps", "tau", "max_grad_norm")
BATCH = 96
TRANSITIONS = 400
UPDATES = 10  # of each in a round


def filled_model(n_agents: int) -> MADDPG:
    """:return: a model of the recipe, with a few transitions"""
    recipe = yaml.safe_load(RECIPE.read_text())["QuadSwarm-v0"]
    env = gym.make("QuadSwarm-v0", **{**recipe["env_kwargs"], "n_robots": n_agents})
    arguments = {name: recipe[name] for name in ARGUMENTS} | {"buffer_size": TRANSITIONS, "batch_size": BATCH}
    model = MADDPG(recipe["policy"], env, learning_starts=2 * TRANSITIONS, seed=0, **arguments)
    model.learn(TRANSITIONS)
    model.set_logger(Logger(None, []))
    return model


def seconds(model: MADDPG, by_pytorch: bool) -> float:
    """:return: time of an update"""
    with ExitStack() as patches:
        if by_pytorch:
            for module in (networks, operations):
                patches.enter_context(patch.object(module, "linear", F.linear))
            patches.enter_context(patch.object(networks, "largest", lambda x: x.amax(dim=-2)))
        model.train(1, BATCH)
        started = time.process_time()
        model.train(UPDATES, BATCH)
        return (time.process_time() - started) / UPDATES


def main() -> None:
    """Measure, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, nargs="+", default=[8, 14])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as a JSON list")
    args = parser.parse_args()
    th.set_num_threads(1)
    rows = []
    for n_agents in args.agents:
        model = filled_model(n_agents)
        rounds = [(seconds(model, by_pytorch=False), seconds(model, by_pytorch=True)) for _ in range(args.rounds)]
        own, theirs = ([1e3 * one for one in each] for each in zip(*rounds, strict=True))
        ratio = median(b / a for a, b in rounds)
        rows.append({"n_agents": n_agents, "batch_size": BATCH, "ratio": ratio, "ms": own, "ms_by_pytorch": theirs})
    cells = [["agents", "update (ms)", "by PyTorch (ms)", "ratio"]]
    for row in rows:
        figures = (median(row["ms"]), median(row["ms_by_pytorch"]))
        cells.append([str(row["n_agents"]), *(f"{one:.1f}" for one in figures), f"{row['ratio']:.2f}"])
    print(aligned(cells, 4))
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
