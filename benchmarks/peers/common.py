"""Common parts of the libraries' drivers: settings, clock, evaluation and command line.

A driver runs in its library's Python and prints one line of JSON::

    python -m benchmarks.peers.xuance_bench speed --networks separate
    python -m benchmarks.peers.xuance_bench learn --env simple_tag_v3 --steps 100000 --seed 0 --export actors

``--export`` writes each agent's policy as a TorchScript program, so that it can play with other libraries' agents. A
driver uses one core and one thread, works in a scratch directory, and redirects all output of the library to stderr.
"""

import argparse
import gc
import importlib
import json
import os
import random
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch as th
from torch import nn

# Settings of Lowe et al. (2017) and https://github.com/openai/maddpg, where training starts after 25,600 steps
LEARNING_RATE = 1e-2
GAMMA = 0.95
TAU = 0.01
MAX_GRAD_NORM = 0.5
BATCH_SIZE = 1024
BUFFER_SIZE = 1_000_000
HIDDEN = (64, 64)
LEARNING_STARTS = BATCH_SIZE
# Gaussian exploration at the first and the last step, in units of the actions, which are in [0, 1]
SIGMA_START, SIGMA_END = 0.3, 0.05

EVALUATION_SEEDS = range(10_000, 10_100)


@dataclass(frozen=True)
class Task:
    """
    Settings of a training.

    :param env: name of a module of mpe2
    :param steps: environment steps of the whole training, over which exploration is annealed
    :param train_freq: environment steps per update
    :param networks: "separate" for an actor and a critic per agent, "shared" for one of each for all agents, "team" for
        the shared actor and a critic with one value for the whole team
    :param seed: seed of environment, networks and exploration
    """

    env: str
    steps: int
    train_freq: int
    networks: str
    seed: int

    @property
    def shared(self) -> bool:
        """Whether agents share networks."""
        return self.networks != "separate"


class Clock:
    """Clock of processor and wall time."""

    def start(self) -> None:
        """Start the clock."""
        gc.collect()
        self.cpu, self.wall = time.process_time(), time.perf_counter()

    def stop(self) -> None:
        """Stop the clock."""
        self.cpu, self.wall = time.process_time() - self.cpu, time.perf_counter() - self.wall


class Driver(Protocol):
    """
    A library's MADDPG with its environment, networks and buffer.

    ``first_update``: steps before the first update.
    """

    first_update: int

    def __init__(self, task: Task) -> None: ...

    def train(self, warm_up: int, clock: Clock) -> None:
        """
        Train for ``Task.steps`` with the library's own loop; ``clock`` measures the time after the warm-up.

        :param warm_up: steps before the clock starts
        """

    def update(self) -> None:
        """Sample from the replay buffer and update all critics, all actors and the target networks."""

    def act(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        :param observations: observation of each agent
        :return: action of each agent without exploration
        """

    def network(self, agent: str) -> nn.Module:
        """
        :param agent: an agent with its own network
        :return: the agent's part of ``act``, which maps observations, (batch, obs_dim), to actions in the environment's
            units
        """


def parallel_env(name: str) -> Any:
    """
    :param name: name of a module of mpe2
    :return: its environment with continuous actions and the default episode length of 25 steps
    """
    return importlib.import_module(f"mpe2.{name}").parallel_env(continuous_actions=True)


def restore_pettingzoo_mpe() -> None:
    """Make mpe2 importable as ``pettingzoo.mpe``, from which the library still imports it."""
    mpe = importlib.import_module("mpe2")
    sys.modules["pettingzoo.mpe"] = mpe
    importlib.import_module("pettingzoo").mpe = mpe  # type: ignore[attr-defined]
    for name in ("all_modules", "simple_adversary_v3", "simple_speaker_listener_v4", "simple_spread_v3",
                 "simple_tag_v3"):  # fmt: skip
        sys.modules[f"pettingzoo.mpe.{name}"] = importlib.import_module(f"mpe2.{name}")


def sigma_at(progress: float) -> float:
    """
    :param progress: fraction of the training that is finished
    :return: standard deviation of the exploration noise
    """
    return SIGMA_START + min(progress, 1.0) * (SIGMA_END - SIGMA_START)


def evaluate(driver: Driver, name: str) -> dict[str, float]:
    """
    :param driver: a trained driver
    :param name: name of the environment
    :return: mean return of each agent over the episodes of ``EVALUATION_SEEDS``
    """
    env = parallel_env(name)
    returns = dict.fromkeys(env.possible_agents, 0.0)
    for seed in EVALUATION_SEEDS:
        observations, _ = env.reset(seed=seed)
        while env.agents:
            actions = {}
            for agent, action in driver.act(observations).items():
                space = env.action_space(agent)
                actions[agent] = np.clip(np.asarray(action, space.dtype).reshape(space.shape), space.low, space.high)
            observations, rewards, *_ = env.step(actions)
            for agent, reward in rewards.items():
                returns[agent] += float(reward) / len(EVALUATION_SEEDS)
    return returns


class Clipped(nn.Module):
    """Policy that clips its actions to their bounds, as ``evaluate`` does."""

    low: th.Tensor
    high: th.Tensor

    def __init__(self, network: nn.Module, low: np.ndarray, high: np.ndarray):
        super().__init__()
        self.network = network
        self.register_buffer("low", th.from_numpy(low))
        self.register_buffer("high", th.from_numpy(high))

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.network(obs).clamp(self.low, self.high)


def export(driver: Driver, name: str, folder: Path) -> None:
    """
    Write the policy of each agent as ``agent.pt``: TorchScript, observations (batch, obs_dim) to actions.

    :param driver: a trained driver
    :param name: name of the environment
    :param folder: folder for the files
    :raises AssertionError: if a program and the driver act differently
    """
    folder.mkdir(parents=True, exist_ok=True)
    env = parallel_env(name)
    programs = {}
    for agent in env.possible_agents:
        space, obs_dim = env.action_space(agent), env.observation_space(agent).shape[0]
        policy = Clipped(driver.network(agent), space.low, space.high).eval().requires_grad_(False)
        example, other = th.zeros(2, obs_dim), th.linspace(-2.0, 2.0, 5 * obs_dim).view(5, -1)
        th.jit.save(th.jit.trace(policy, example, check_inputs=[(other,)]), str(folder / f"{agent}.pt"))
        programs[agent] = th.jit.load(str(folder / f"{agent}.pt"))
    for seed in range(4):
        observations, _ = env.reset(seed=seed)
        while env.agents:
            actions = {}
            for agent, action in driver.act(observations).items():
                space = env.action_space(agent)
                actions[agent] = programs[agent](th.from_numpy(observations[agent])[None]).numpy()[0]
                np.testing.assert_allclose(actions[agent], np.clip(action, space.low, space.high), atol=1e-5)
            observations, *_ = env.step(actions)


def rates(name: str, count: int, clock: Clock) -> dict[str, float]:
    """
    :param name: name of the rate
    :param count: number of events while the clock ran
    :param clock: the stopped clock
    :return: the rates per second of processor time and of wall time
    """
    return {name: count / clock.cpu, f"{name}_wall": count / clock.wall}


def speed(make: type[Driver], arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure updates per second, and steps per second of the library's loop with an update every 100 steps and every
    step."""
    result: dict[str, Any] = {"networks": arguments.networks}
    clock = Clock()
    for train_freq, steps in ((100, arguments.steps_100), (1, arguments.steps_1)):
        warm_up = make.first_update + 100
        driver = make(Task("simple_spread_v3", warm_up + steps, train_freq, arguments.networks, arguments.seed))
        driver.train(warm_up, clock)
        result |= rates(f"steps_per_s_{train_freq}", steps, clock)
        if train_freq == 100:
            for _ in range(10):
                driver.update()
            clock.start()
            for _ in range(arguments.updates):
                driver.update()
            clock.stop()
            result |= rates("updates_per_s", arguments.updates, clock)
        del driver
        gc.collect()
    return result


def learn(make: type[Driver], arguments: argparse.Namespace) -> dict[str, Any]:
    """Train with an update every ``--train-freq`` steps, then measure the return of each agent without exploration."""
    clock = Clock()
    driver = make(Task(arguments.env, arguments.steps, arguments.train_freq, arguments.networks, arguments.seed))
    driver.train(0, clock)
    returns = evaluate(driver, arguments.env)
    if arguments.export:
        export(driver, arguments.env, arguments.export)
    return {
        "env": arguments.env,
        "seed": arguments.seed,
        "steps": arguments.steps,
        "train_freq": arguments.train_freq,
        "networks": arguments.networks,
        "episodes": len(EVALUATION_SEEDS),
        "returns": returns,
        "mean_return": sum(returns.values()) / len(returns),
        "training_cpu_s": clock.cpu,
    }


def main(library: str, distribution: str, make: type[Driver]) -> None:
    """
    Run the command line of a driver.

    :param library: name of the library in tables
    :param distribution: package whose version is reported
    :param make: function that prepares a training
    """
    parser = argparse.ArgumentParser(description=f"{library}: speed or learning of MADDPG, one line of JSON")
    modes = parser.add_subparsers(dest="mode", required=True)
    measure = modes.add_parser("speed", help="updates and steps per second on simple_spread_v3")
    measure.add_argument("--updates", type=int, default=300)
    measure.add_argument("--steps-100", type=int, default=5_000, help="steps with an update every 100")
    measure.add_argument("--steps-1", type=int, default=400, help="steps with an update every step")
    training = modes.add_parser("learn", help="train, then measure each agent's return")
    training.add_argument("--env", default="simple_spread_v3", help="module of mpe2")
    training.add_argument("--steps", type=int, default=100_000)
    training.add_argument("--train-freq", type=int, default=100, help="environment steps per update (default 100)")
    training.add_argument("--export", type=lambda path: Path(path).resolve(), metavar="FOLDER",
                          help="folder for the agents' policies, for separate networks only")  # fmt: skip
    for mode in (measure, training):
        mode.add_argument("--networks", choices=("separate", "shared", "team"), default="separate")
        mode.add_argument("--seed", type=int, default=0)
        mode.add_argument("--core", type=int, help="core to pin to (default: the last allowed one)")
    arguments = parser.parse_args()
    if arguments.mode == "learn" and arguments.export and arguments.networks != "separate":
        parser.error("--export is for separate networks")

    if hasattr(os, "sched_setaffinity"):
        core = max(os.sched_getaffinity(0)) if arguments.core is None else arguments.core
        os.sched_setaffinity(0, {core})
    th.set_num_threads(1)
    random.seed(arguments.seed)
    np.random.seed(arguments.seed)  # noqa: NPY002
    th.manual_seed(arguments.seed)
    warnings.filterwarnings("ignore")
    # Below sys.stdout, which loggers may hold
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        os.chdir(scratch)
        result = (speed if arguments.mode == "speed" else learn)(make, arguments)
        os.chdir("/")
    print(json.dumps({"library": library, "version": version(distribution), **result}), file=answer, flush=True)
