"""Measure how long training with the swarm's recipes takes, and where the time goes.

``python -m studies.swarm.training_time [--recipe RECIPE.yml ...] [--steps N] [--threads N] [--json F]``. Planner: batch
calls on one core. Learner: updates. Acting: the policy during exploration. Rest: the swarm except its planner,
observations, infos, the replay buffer and logging. JSON: one row per recipe with recipe, threads, steps, updates,
episodes, seconds, and the share of each part.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from pydoc import locate
from typing import Any

import gymnasium
import torch as th
import yaml
from stable_baselines3.common.vec_env import VecMonitor

from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg import MADDPG
from sb3_maddpg.cli.bench import timed
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv


def measure(recipe: str, steps: int | None) -> dict[str, Any]:
    """Train once and measure the times."""
    hyperparams = yaml.safe_load(Path(recipe).read_text())["QuadSwarm-v0"]
    for key in ("vec_env", "eval_env_kwargs", "callback"):
        hyperparams.pop(key, None)
    steps = steps or hyperparams["n_timesteps"]
    del hyperparams["n_timesteps"]
    if "replay_buffer_class" in hyperparams:
        hyperparams["replay_buffer_class"] = locate(hyperparams["replay_buffer_class"])
    rate = float(str(hyperparams.pop("learning_rate")).removeprefix("lin_"))
    envs = gymnasium.make_vec("QuadSwarm-v0", hyperparams.pop("n_envs"), **hyperparams.pop("env_kwargs"))
    env = VecMonitor(GymnasiumVecEnv(envs))
    model = MADDPG(hyperparams.pop("policy"), env, learning_rate=rate, seed=0, **hyperparams)
    planner, learner, acting = [0.0], [0.0], [0.0]
    solver = envs.unwrapped.task.swarm.planner  # type: ignore[attr-defined]
    solver.plan = timed(solver.plan, planner)
    model.train = timed(model.train, learner)  # type: ignore[method-assign]
    model._sample_action = timed(model._sample_action, acting)  # type: ignore[method-assign]
    started = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - started
    parts = {"planner": planner[0], "learner": learner[0], "acting": acting[0]}
    parts["rest"] = seconds - sum(parts.values())
    row: dict[str, Any] = {"recipe": recipe, "threads": th.get_num_threads(), "steps": model.num_timesteps}
    row |= {"updates": model._n_updates, "episodes": model._episode_num, "seconds": seconds}
    return row | {f"share_{name}": part / seconds for name, part in parts.items()}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = ["zoo_configs/quad_swarm_paper.yml", "zoo_configs/quad_swarm_dense.yml", "zoo_configs/maddpg.yml"]
    parser.add_argument("--recipe", nargs="+", default=default)
    parser.add_argument("--steps", type=int, help="steps (default: the recipe's)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    rows = []
    for recipe in args.recipe:
        rows.append(measure(recipe, args.steps))
        row = rows[-1]
        shares = ", ".join(f"{key.removeprefix('share_')} {row[key]:.0%}" for key in row if key.startswith("share_"))
        print(f"{recipe}: {row['steps']} steps, {row['updates']} updates, {row['episodes']} episodes in", end=" ")
        print(f"{row['seconds']:.0f} s; {shares}", flush=True)
    if args.json:
        write_rows(args.json, rows)


if __name__ == "__main__":
    main()
