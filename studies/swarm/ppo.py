"""A reference for docs/lab_notebook.md: PPO with one network for all robots.

``python -m studies.swarm.ppo [--recipe NAME] [--price P ...] [--steps N] [--seed S] [--models FOLDER] [--json F]``
trains Stable-Baselines3's PPO with each robot as its own environment: with the observations, the networks, the
scenarios, and the rewards of zoo_configs/quad_swarm_NAME.yml, the sum over a robot's pairs, and with a price per
request. The actor is saved as a model of MADDPG with a PairPolicy, so it flies with every threshold and any number of
robots. With ``--recipe paper``, it then flies with several thresholds on episodes of the validation set. JSON: one row
per price, scenario and threshold with the keys of `summarise`, and price, steps, seed, seconds, scenario, threshold.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import BernoulliDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch import nn

from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import without_obstacles
from sb3_maddpg import MADDPG
from sb3_maddpg.common.layout import NeighbourViews
from sb3_maddpg.relational.networks import PairActor, PairNet
from sb3_maddpg.relational.policy import PairPolicy
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from studies.swarm.experiment import Experiment, Job, Row, untrained
from studies.swarm.protocol import ROOT, VALIDATION

THRESHOLDS = (0.1, 0.2, 0.3, 0.5, 0.7)
# Teams that fly beside each other
TEAMS = 64


def recipe_of(name: str) -> dict[str, Any]:
    """Return a recipe of the swarm."""
    return yaml.safe_load((ROOT / "zoo_configs" / f"quad_swarm_{name}.yml").read_text())["QuadSwarm-v0"]


def env_kwargs(price: float, name: str = "paper", of_critic: bool = False) -> dict[str, Any]:
    """Return a recipe's arguments of the environment, with a request price.

    :param price: price of a request
    :param name: name of the recipe
    :param of_critic: whether observations have the columns that only critics read
    """
    kwargs = recipe_of(name)["env_kwargs"]
    if not of_critic:
        kwargs["observation"] = kwargs["observation"].removesuffix("+critic")
    kwargs["reward"]["request"] = price
    return kwargs


class Robots(VecEnvWrapper):
    """Wrapper that makes each robot of each team an environment, whose reward is the sum of its pairs' rewards."""

    def __init__(self, teams: GymnasiumVecEnv, n_bits: int):
        n, size = teams.observation_space.shape  # type: ignore[misc]
        space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        super().__init__(teams, space, spaces.MultiBinary(n_bits))
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


class PairActorCritic(ActorCriticPolicy):
    """Stable-Baselines3's policy with the actor of a `PairPolicy`, and a critic of the same kind of network.

    The critic reads what one robot observes and the columns that only critics read.

    :param model: a model whose actor acts, and is trained
    """

    def __init__(self, *args: Any, model: MADDPG, **kwargs: Any):
        self.model = [model]  # not a module of this policy
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Any) -> None:
        actor, policy = cast("PairActor", self.model[0].actor), cast("PairPolicy", self.model[0].policy)
        self.actor, self.n_bits = actor.single(0), actor.actions.width
        self.views = NeighbourViews(policy.observation_layout, policy.team, of_critic=True)
        own, of_one = self.views.own_dim, self.views.own_dim + self.views.neighbour_dim
        self.critic = PairNet(of_one, [own], 1, policy.net_arch, nn.ReLU)
        self.optimizer = th.optim.Adam([*actor.parameters(), *self.critic.parameters()], lr=lr_schedule(1), eps=1e-5)

    def get_distribution(self, obs: PyTorchObs) -> Distribution:
        """See Stable-Baselines3."""
        return BernoulliDistribution(self.n_bits).proba_distribution(self.actor(obs))

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """See Stable-Baselines3."""
        own, neighbours, present = self.views(cast("th.Tensor", obs).unsqueeze(1))
        each = own.unsqueeze(-2).expand(*neighbours.shape[:-1], -1)
        hidden, _ = self.critic.encode(th.cat([each, neighbours], dim=-1), present)
        values = self.critic.head(hidden.add_(self.critic.extra(0, own).unsqueeze(-2)))
        return (values if present is None else values * present).sum(dim=-2).flatten(0, 1)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """See Stable-Baselines3."""
        distribution = self.get_distribution(obs)
        actions = distribution.get_actions(deterministic=deterministic)
        return actions, self.predict_values(obs), distribution.log_prob(actions)

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """See Stable-Baselines3."""
        distribution = self.get_distribution(obs)
        return self.predict_values(obs), distribution.log_prob(actions), distribution.entropy()


def train(name: str, price: float, steps: int, seed: int, verbose: int = 0) -> MADDPG:
    """Train for a number of steps of the swarm.

    :param name: name of the recipe
    :param price: price of a request
    :param steps: number of steps
    :param seed: seed of episodes and networks
    :param verbose: see Stable-Baselines3
    :return: a model whose actor has been trained
    """
    kwargs = env_kwargs(price, name, of_critic=True)
    model = untrained(kwargs, recipe_of(name)["policy_kwargs"], seed)
    teams = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", TEAMS, **kwargs))
    env = Robots(teams, model.actor.actions.width)
    PPO(
        PairActorCritic,
        VecNormalize(env, norm_obs=False, gamma=0.95),
        learning_rate=lambda left: 1e-3 * max(left, 0.0),  # SB3 may take more steps than it should
        n_steps=64,
        batch_size=2048,
        n_epochs=6,
        gamma=0.95,
        policy_kwargs={"model": model},
        seed=seed,
        device="cpu",
        verbose=verbose,
    ).learn(steps * env.n)
    return model


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


def validate(policies: Mapping[float, str], what: str, episodes: int, keys: Row) -> list[Row]:
    """Fly all scenarios of the validation set with several values of a parameter.

    :param policies: value -> policy
    :param what: name of the parameter
    :param episodes: number of episodes
    :param keys: common entries of all rows
    :return: a row per scenario and value
    """
    table = []
    for name in without_obstacles():
        job = Job({}, list(policies.values()), name, make_config("paper"), episodes, VALIDATION)
        for value, rows in zip(policies, job.fly().values(), strict=True):
            row = {"scenario": name, what: value} | summarise(rows, job.config)
            table.append(keys | row)
            figures = f"{row['collisions']}/{row['episodes']} at {row['request_share']:.1%}"
            print(f"{name}, {what} {value:g}: {figures}", flush=True)
    return table


def main() -> None:
    """Run the command line."""
    parser = reference_arguments(__doc__)
    recipes = sorted(path.stem.removeprefix("quad_swarm_") for path in (ROOT / "zoo_configs").glob("quad_swarm_*.yml"))
    parser.add_argument("--recipe", default="paper", choices=recipes, help="the recipe (default %(default)s)")
    parser.add_argument(
        "--price", type=float, nargs="+", default=[0.02, 0.1], help="price of a request (default %(default)s)"
    )
    parser.add_argument("--steps", type=int, default=400_000, help="steps of the swarm (default %(default)s)")
    args = parser.parse_args()
    args.models.mkdir(parents=True, exist_ok=True)
    experiment = Experiment(args.json, "price", "scenario", "threshold", "seed")
    for price in args.price:
        started = time.perf_counter()
        model = train(args.recipe, price, args.steps, args.seed)
        keys = {"price": price, "steps": args.steps, "seed": args.seed, "seconds": time.perf_counter() - started}
        path = args.models / f"ppo_{args.recipe}_price{price:g}_seed{args.seed}.zip"
        model.save(path, lean="actor")
        print(f"{path}: {keys['seconds']:.0f} s", flush=True)
        if args.recipe == "paper":
            policies = {threshold: f"{path}@{threshold}" for threshold in THRESHOLDS}
            experiment.keep(validate(policies, "threshold", args.episodes, keys))


if __name__ == "__main__":
    main()
