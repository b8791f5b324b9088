"""A reference for docs/results.md: PPO with one network for all robots.

``python -m studies.swarm.ppo [--price P ...] [--steps N] [--episodes N] [--seed S] [--models FOLDER] [--json F]``
trains Stable-Baselines3's PPO with each robot as its own environment, with the observations, scenarios and rewards of
zoo_configs/quad_swarm_paper.yml, individual rewards and a price per request. Then each policy flies with several
thresholds of its request probability on episodes of the validation set. JSON: one row per price, scenario and threshold
with the keys of `summarise`, and price, steps, seed, seconds, scenario, threshold.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import without_obstacles
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from studies.swarm.experiment import Experiment, Job, Row
from studies.swarm.protocol import ROOT, VALIDATION

RECIPE = ROOT / "zoo_configs" / "quad_swarm_paper.yml"
THRESHOLDS = (0.1, 0.2, 0.3, 0.5, 0.7)


def env_kwargs(price: float) -> dict[str, Any]:
    """Return the recipe's arguments of the environment, without the critic's observations and with a request price."""
    kwargs = yaml.safe_load(RECIPE.read_text())["QuadSwarm-v0"]["env_kwargs"]
    kwargs["observation"] = kwargs["observation"].removesuffix("+critic")
    kwargs["reward"]["request"] = price
    return kwargs


class Robots(VecEnvWrapper):
    """Wrapper that makes each robot of each team an environment, whose reward is the sum of its pairs' rewards."""

    def __init__(self, teams: GymnasiumVecEnv):
        n, size = teams.observation_space.shape  # type: ignore[misc]
        space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        super().__init__(teams, space, spaces.MultiBinary(n - 1))
        self.teams, self.n = teams.num_envs, n
        self.num_envs = self.teams * n

    def reset(self) -> np.ndarray:
        """See Stable-Baselines3."""
        return np.asarray(self.venv.reset()).reshape(self.num_envs, -1)

    def step_async(self, actions: np.ndarray) -> None:
        """See Stable-Baselines3."""
        self.venv.step_async(actions.reshape(self.teams, -1).astype(np.int8))

    def step_wait(self) -> VecEnvStepReturn:
        """See Stable-Baselines3."""
        obs, _, dones, infos = self.venv.step_wait()
        rewards = np.stack([info["pair_rewards"].sum(axis=-1) for info in infos])
        mine: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(dones):
            for i, last in enumerate(infos[k]["terminal_observation"]):
                mine[k * self.n + i] = {
                    "TimeLimit.truncated": infos[k]["TimeLimit.truncated"],
                    "terminal_observation": last,
                }
        return np.asarray(obs).reshape(self.num_envs, -1), rewards.ravel(), np.repeat(dones, self.n), mine


class SharedPPO:
    """Adapter that lets a trained PPO model act for each robot of a team, for the evaluation.

    :param model: model trained with single robots' observations and requests
    """

    def __init__(self, model: PPO):
        self.policy, self.threshold = model.policy, 0.5
        n_robots = model.action_space.n + 1  # type: ignore[attr-defined]
        shape = (n_robots, *model.observation_space.shape)  # type: ignore[misc]
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float32)
        self.env_spec = {"kwargs": env_kwargs(0.0)}

    @classmethod
    def load(cls, path: str, device: str = "auto") -> SharedPPO:
        """See Stable-Baselines3."""
        return cls(PPO.load(path, device=device))

    def set_threshold(self, threshold: float) -> None:
        """
        Set the threshold of requests.

        :param threshold: threshold of the request probability
        """
        self.threshold = threshold

    def predict(self, observation: np.ndarray, deterministic: bool = True) -> tuple[np.ndarray, None]:
        """:return: bits of all robots, (E, n (n - 1)), and None for the state"""
        with th.no_grad():
            rows = th.as_tensor(observation.reshape(-1, observation.shape[-1]))
            probabilities = self.policy.get_distribution(rows).distribution.probs  # type: ignore[union-attr]
        return (probabilities > self.threshold).numpy().reshape(len(observation), -1), None


def train(price: float, steps: int, seed: int) -> PPO:
    """Train for a number of steps of the swarm."""
    env = Robots(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", 32, **env_kwargs(price))))
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=lambda left: 1e-3 * left,
        n_steps=64,
        batch_size=1024,
        n_epochs=6,
        gamma=0.95,
        policy_kwargs={"net_arch": [128, 128]},
        seed=seed,
        device="cpu",
    )
    return model.learn(steps * env.n)


def reference_arguments(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of a reference that is trained here.

    :param doc: docstring of the module
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=2000, help="episodes per scenario (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--models", type=Path, default=Path("logs"), help="folder for models (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser


def validate(
    policies: Mapping[float, str], what: str, episodes: int, keys: Row, algo: str = "sb3_maddpg:MADDPG"
) -> list[Row]:
    """Fly all scenarios of the validation set with several values of a parameter.

    :param policies: value -> policy
    :param what: name of the parameter
    :param episodes: number of episodes
    :param keys: common entries of all rows
    :param algo: see `Job`
    :return: a row per scenario and value
    """
    table = []
    for name in without_obstacles():
        job = Job({}, list(policies.values()), name, make_config("paper"), episodes, VALIDATION, algo)
        for value, rows in zip(policies, job.fly().values(), strict=True):
            row = {"scenario": name, what: value} | summarise(rows, job.config)
            table.append(keys | row)
            figures = f"{row['collisions']}/{row['episodes']} at {row['request_share']:.1%}"
            print(f"{name}, {what} {value:g}: {figures}", flush=True)
    return table


def main() -> None:
    """Run the command line."""
    parser = reference_arguments(__doc__)
    parser.add_argument(
        "--price", type=float, nargs="+", default=[0.02, 0.1], help="price of a request (default %(default)s)"
    )
    parser.add_argument("--steps", type=int, default=400_000, help="steps of the swarm (default %(default)s)")
    args = parser.parse_args()
    args.models.mkdir(parents=True, exist_ok=True)
    experiment = Experiment(args.json, "price", "scenario", "threshold", "seed")
    for price in args.price:
        started = time.perf_counter()
        model = train(price, args.steps, args.seed)
        keys = {"price": price, "steps": args.steps, "seed": args.seed, "seconds": time.perf_counter() - started}
        path = args.models / f"ppo_price{price:g}_seed{args.seed}.zip"
        model.save(path)
        print(f"price {price:g}", flush=True)
        policies = {threshold: f"{path}@{threshold}" for threshold in THRESHOLDS}
        experiment.keep(validate(policies, "threshold", args.episodes, keys, "studies.swarm.ppo:SharedPPO"))


if __name__ == "__main__":
    main()
