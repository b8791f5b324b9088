"""Short trainings that are killed and resumed."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from quad_swarm import QuadSwarmParallelEnv
from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer, SafeVecNormalize, TeamEnv
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.states import Replayable
from studies.commit_points import interrupt

SETTINGS = {"learning_starts": 60, "batch_size": 16, "seed": 0}


SWARM = {"preset": "flight", "n_robots": 3, "max_steps": 20}


PAIRS = {**SWARM, "observation": "state+memory+plan+told+mask+critic"}


MIXED = {"symmetric_swap": 2, "forest": 1, "crossing_traffic": 1}


def swarms():
    return VecMonitor(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=4, **PAIRS)))


def predicting():
    """Swarms that predict each other, with and without obstacles."""
    kwargs = {**SWARM, "preset": "flight-v3", "scenario": MIXED, "observation": "state+approach+memory+plan+obstacles"}
    return VecMonitor(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=3, **kwargs)))


def curriculum():
    return gymnasium.make("QuadSwarm-v0", n_robots=2, max_steps=60, scenario="curriculum", end_at_arrival=True)


def parallel():
    return TeamEnv(QuadSwarmParallelEnv(**SWARM))


def normalized():
    return SafeVecNormalize(DummyVecEnv([lambda: Monitor(Replayable(OwnBit()))] * 2))


RUNS = {
    "swarms": (
        swarms,
        "PairPolicy",
        {"replay_buffer_class": PrioritizedTeamReplayBuffer, "n_steps": 3, "train_freq": 1},
    ),
    "predicting": (predicting, "MlpPolicy", {"train_freq": 2}),
    "one swarm": (curriculum, "MlpPolicy", {"train_freq": 7}),
    "PettingZoo": (parallel, "MlpPolicy", {"train_freq": 5}),
    "replayed": (lambda: Replayable(OwnBit()), "MlpPolicy", {"train_freq": (1, "episode")}),
    "normalized": (normalized, "MlpPolicy", {"train_freq": 2}),
    "memory": (
        lambda: Replayable(OwnBit()),
        "MlpPolicy",
        {
            "train_freq": 3,
            "optimize_memory_usage": True,
            "replay_buffer_kwargs": {"handle_timeout_termination": False},
        },
    ),
}


STEPS, EVERY = 640, 100


class Killed(BaseException):
    """Nothing catches it, as nothing catches a kill."""


def make(name: str, **kwargs) -> MADDPG:
    env, policy, settings = RUNS[name]
    if policy == "PairPolicy":
        settings = {**settings, "policy_kwargs": {"pair_credit": True}}
    return MADDPG(policy, env(), **{**SETTINGS, "buffer_size": 300, **settings, **kwargs})


def go_on(name: str, folder: Path, others: list[BaseCallback] = []) -> MADDPG:  # noqa: B006 - never changed
    found = resume(folder, RUNS[name][0]())
    assert found is not None
    model, callback = found
    np.random.seed(5)  # noqa: NPY002 - whatever was drawn meanwhile
    th.manual_seed(5)
    return model.learn(STEPS - model.num_timesteps, callback=[callback, *others], reset_num_timesteps=False)


def kill_at(monkeypatch, point: str, times: int) -> None:
    """Kill when a point of writing is reached for so many times."""
    left = [times]

    def fault(name: str) -> None:
        left[0] -= name == point
        if not left[0]:
            left[0] = -1
            raise Killed

    interrupt(fault, monkeypatch.setattr)


def edit(folder: Path, change) -> None:
    """Change the state in the newest checkpoint, as somebody could who also knows its checksums."""
    (path,) = list(folder.glob("checkpoint-*"))[-1:]
    state = json.loads((path / "state.json").read_text())
    change(state)
    (path / "state.json").write_text(json.dumps(state))
    (path / "manifest.json").write_text("{}")
