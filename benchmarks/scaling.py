"""Measure gradient updates per second for larger batches, larger teams and several threads, on any device.

``python benchmarks/scaling.py [--device cuda] [--threads 1 2] [--json F]``: networks of 2x64, observations of 18
numbers, five continuous actions per agent, random transitions. Updates are those of ``benchmarks/training.py``. Rates
are per second of wall time, the best of all rounds, in which the numbers of threads take turns. The ratio compares
transitions per second with those of the smallest batch with the first number of threads.
"""

import argparse
import json
import platform
import time
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from tqdm import tqdm

from sb3_maddpg import MADDPG

OBS_DIM, ACTION_DIM = 18, 5
TRANSITIONS = 100_000


class Noise(gym.Env):
    """
    Team environment whose observations and rewards are noise.

    :param n_agents: number of agents
    """

    def __init__(self, n_agents: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (n_agents, OBS_DIM), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (n_agents * ACTION_DIM,), np.float32)


def filled_model(n_agents: int, device: str, networks: str) -> MADDPG:
    """
    :param n_agents: number of agents
    :param device: device to train on
    :param networks: "separate" or "shared"
    :return: a model whose replay buffer is full of noise
    """
    rng = np.random.default_rng(0)
    shared = networks == "shared"
    model = MADDPG(
        "MlpPolicy",
        Noise(n_agents),
        buffer_size=min(TRANSITIONS, 3_200_000 // n_agents),
        device=device,
        seed=0,
        policy_kwargs={"share_actor": shared, "share_critic": shared},
    )
    model.set_logger(Logger(None, []))
    buffer = model.replay_buffer
    for name in ("observations", "next_observations", "actions", "agent_rewards"):
        array = getattr(buffer, name)
        array[...] = rng.normal(size=array.shape).astype(np.float32)
    buffer.full = True
    return model


def updates_per_second(model: MADDPG, batch_size: int, seconds: float) -> float:
    """
    :param model: a model with a full replay buffer
    :param batch_size: transitions per update
    :param seconds: approximate duration of the measurement
    :return: updates per second
    """

    def run(updates: int) -> float:
        if model.device.type == "cuda":
            th.cuda.synchronize()
        started = time.perf_counter()
        model.train(updates, batch_size)
        if model.device.type == "cuda":
            th.cuda.synchronize()
        return time.perf_counter() - started

    run(2)
    updates = max(3, int(seconds / max(run(1), 1e-6)))
    return updates / run(updates)


def main() -> None:
    """Measure all combinations, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda" if th.cuda.is_available() else "cpu")
    parser.add_argument("--agents", type=int, nargs="+", help="numbers of agents (default 3 8 16, on a GPU up to 64)")
    parser.add_argument("--batch-sizes", type=int, nargs="+", help="default 1024 4096, on a GPU up to 65536")
    parser.add_argument("--networks", choices=("separate", "shared"), default="separate")
    parser.add_argument("--seconds", type=float, default=2.0, help="seconds per measurement (default 2)")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--threads", type=int, nargs="+", default=[1], help="numbers of processor threads (default 1)")
    parser.add_argument("--json", help="write the rows to this file")
    arguments = parser.parse_args()
    on_gpu = arguments.device.startswith("cuda")
    sizes = arguments.agents or ([3, 8, 16, 32, 64] if on_gpu else [3, 8, 16])
    batch_sizes = arguments.batch_sizes or ([1024, 4096, 16384, 65536] if on_gpu else [1024, 4096])
    device = th.cuda.get_device_name(arguments.device) if on_gpu else platform.processor() or "cpu"
    print(f"{device}, torch {version('torch')}, {arguments.networks} networks")
    print(f"{'agents':>6}  {'batch':>6}  {'threads':>7}  {'updates/s':>10}  {'transitions/s':>14}  {'ratio':>6}")
    rows = []
    for n_agents in sizes:
        model = filled_model(n_agents, arguments.device, arguments.networks)
        first = None
        for batch_size in tqdm(batch_sizes, desc=f"{n_agents} agents", leave=False):
            rounds: dict[int, list[float]] = {threads: [] for threads in arguments.threads}
            for _ in range(arguments.rounds):
                for threads, rates in rounds.items():
                    th.set_num_threads(threads)
                    rates.append(updates_per_second(model, batch_size, arguments.seconds))
            for threads, rates in rounds.items():
                rate = max(rates)
                first = first or rate * batch_size
                ratio = rate * batch_size / first
                cells = f"{n_agents:6d}  {batch_size:6d}  {threads:7d}  {rate:10.2f}  {rate * batch_size:14,.0f}"
                tqdm.write(f"{cells}  {ratio:6.2f}")
                row = {"n_agents": n_agents, "batch_size": batch_size, "threads": threads}
                rows.append({**row, "updates_per_s": rate, "rounds": rates})
        del model
    if arguments.json:
        with open(arguments.json, "w") as file:
            result = {"device": device, "networks": arguments.networks, "torch": version("torch"), "rows": rows}
            json.dump(result, file, indent=1)


if __name__ == "__main__":
    main()
