"""Train MAPPO or IPPO of BenchMARL in a PettingZoo environment: ``make mappo ENV=mpe2/simple_spread_v3``.

``python -m benchmarks.peers.mappo --env MODULE/NAME [--algo ippo] [--env-kwargs '{...}'] [--steps N] [--seed S]
[--json F]`` in the environment of ``benchmarl.txt``. The policy is evaluated without noise every 10,000 steps; JSON has
the mean return over the agents each time. Agents whose names differ by a number only are a group with one network, as
in the library. BenchMARL needs one kind of actions, continuous or discrete, for the whole team: teams that mix them are
refused.
"""

import argparse
import importlib
import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarl.algorithms import IppoConfig, MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from gymnasium import spaces
from torchrl.envs import PettingZooWrapper

EVALUATE, EPISODES, BATCH = 10_000, 100, 2_000
ALGORITHMS = {"mappo": MappoConfig, "ippo": IppoConfig}


class AnyTask(PettingZooClass):
    """A PettingZoo environment that BenchMARL does not list."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Any:
        module, kwargs = importlib.import_module(self.config["module"]), self.config["kwargs"]
        return lambda: PettingZooWrapper(
            module.parallel_env(**kwargs), categorical_actions=True, device=device, seed=seed, return_state=False
        )

    def supports_continuous_actions(self) -> bool:
        return bool(self.config["continuous"])

    def supports_discrete_actions(self) -> bool:
        return not self.config["continuous"]

    def has_state(self) -> bool:
        return False

    def has_render(self, env: Any) -> bool:
        return False

    def max_steps(self, env: Any) -> int:
        return int(self.config["longest"])


class Evaluations(Callback):
    """Keep the mean return over the agents of each evaluation."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, float]] = []

    def on_evaluation_end(self, rollouts: list[Any]) -> None:
        groups = self.experiment.group_map
        agents = sum(map(len, groups.values()))
        total = sum(float(one["next", group, "reward"].sum()) for one in rollouts for group in groups)
        self.rows.append({"steps": self.experiment.total_frames, "return": total / len(rollouts) / agents})
        print(f"{self.rows[-1]['steps']:,} steps: {self.rows[-1]['return']:.2f}", flush=True)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="such as mpe2/simple_spread_v3")
    parser.add_argument("--algo", choices=ALGORITHMS, default="mappo")
    parser.add_argument("--env-kwargs", type=json.loads, default={}, metavar="JSON")
    parser.add_argument("--longest", type=int, default=25, help="longest episode of an evaluation (default 25)")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    module = args.env.replace("/", ".")
    env = importlib.import_module(module).parallel_env(**args.env_kwargs)
    kinds = {isinstance(env.action_space(agent), spaces.Box) for agent in env.possible_agents}
    if len(kinds) > 1:
        parser.error(
            f"--env {args.env}: BenchMARL trains no team in which some actions are continuous and some discrete"
        )
    content = {"module": module, "kwargs": args.env_kwargs, "continuous": kinds.pop(), "longest": args.longest}
    config, evaluations = ExperimentConfig.get_from_yaml(), Evaluations()
    settings = {
        "max_n_frames": args.steps,
        "on_policy_collected_frames_per_batch": BATCH,
        "on_policy_n_envs_per_worker": 8,
        "on_policy_n_minibatch_iters": 10,
        "prefer_continuous_actions": content["continuous"],
        "evaluation_interval": EVALUATE,
        "evaluation_episodes": EPISODES,
        "render": False,
        "loggers": [],
        "create_json": True,  # or nothing is evaluated
    }
    for name, value in settings.items():
        assert hasattr(config, name), name
        setattr(config, name, value)
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        task = AnyTask(name=args.env.replace("/", "-"), config=content)
        algorithm = ALGORITHMS[args.algo].get_from_yaml()
        model, critic = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
        Experiment(task, algorithm, model, args.seed, config, critic_model_config=critic, callbacks=[evaluations]).run()
    if args.json:
        about = {"env": args.env, "env_kwargs": args.env_kwargs, "algo": args.algo, "seed": args.seed}
        args.json.write_text(json.dumps(about | {"evaluations": evaluations.rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
