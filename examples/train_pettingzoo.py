"""Train a team in a PettingZoo environment: ``python examples/train_pettingzoo.py [--quick]``."""

import argparse

import torch
from mpe2 import simple_spread_v3
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_maddpg import MADDPG, DashboardCallback, TeamEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="only a few steps, as a test")
quick = parser.parse_args().quick

torch.set_num_threads(1)  # small networks are fastest with one thread
env = simple_spread_v3.parallel_env(continuous_actions=True)
# Stable-Baselines3's tools need a single environment for the whole team
eval_env = Monitor(TeamEnv(simple_spread_v3.parallel_env(continuous_actions=True)))

model = MADDPG(
    "MlpPolicy",
    env,
    gamma=0.95,
    learning_starts=200 if quick else 5000,
    exploration_noise=(0.6, 0.1),  # annealed from 0.6 to 0.1 over training
    tensorboard_log="logs/tensorboard",
    seed=0,
)
evaluation = EvalCallback(
    eval_env,
    callback_after_eval=DashboardCallback(),
    eval_freq=500 if quick else 10_000,
    n_eval_episodes=2 if quick else 50,
    best_model_save_path="logs/spread",
)
model.learn(1000 if quick else 150_000, callback=evaluation)

mean, std = evaluate_policy(model, eval_env, n_eval_episodes=2 if quick else 100)
print(f"return: {mean:.1f} +/- {std:.1f}")
model.save("logs/spread/final")
