"""Train the swarm in Python: ``python examples/train_swarm.py [--quick]`` (7.5 minutes on one core)."""

import argparse

import gymnasium
import torch
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecMonitor

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from quad_swarm.evaluation.command import main as evaluate
from sb3_maddpg import MADDPG
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="only a few steps, as a test")
quick = parser.parse_args().quick

torch.set_num_threads(1)
reward = {"goal": 0, "request": 0, "collision": 10}
reward |= {"near_miss": 1, "near_miss_distance": 0.6, "near_miss_width": 0.06, "near_miss_ahead": 8}
envs = gymnasium.make_vec(
    "QuadSwarm-v0",
    64,
    preset="paper",
    observation="state+approach+memory+plan+critic",
    scenario={"symmetric_swap": 4, "asymmetric_swap": 3, "random_swap": 2, "random": 1},
    max_steps=60,
    end_at_arrival=True,
    reward=reward,
)
model = MADDPG(
    "PairPolicy",  # one network for all pairs of robots
    VecMonitor(GymnasiumVecEnv(envs)),
    policy_kwargs={"net_arch": [64, 64], "pair_credit": True},
    threshold_price=(0.001, 0.4),  # all prices at once; the threshold chooses one
    learning_rate=LinearSchedule(1e-3, 0.0, 1.0),
    gamma=0.95,
    n_steps=5,
    batch_size=64 if quick else 512,
    learning_starts=640 if quick else 6400,
    train_freq=1,
    policy_regularization=1e-6,
    verbose=1,
    seed=0,
)
model.learn(2560 if quick else 400_000, log_interval=None if quick else 100)
model.save("my_swarm.zip")

# The higher the threshold, the fewer the requests
policies = ["none", "full", "cpa:0.7:1.5", *(f"./my_swarm.zip@{threshold}" for threshold in (0.4, 0.6))]
evaluate(["--policy", *policies, "--scenario", "symmetric_swap", "--episodes", "10" if quick else "500"])
