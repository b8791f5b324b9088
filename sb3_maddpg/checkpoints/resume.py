"""Continuing a run from its newest checkpoint."""

from __future__ import annotations

import os
from pathlib import Path

import torch as th
from stable_baselines3.common.type_aliases import GymEnv

from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.commit import json_in, newest
from sb3_maddpg.checkpoints.fingerprints import compare_fingerprints, fingerprint
from sb3_maddpg.checkpoints.state import FORMAT, check_random_state, check_values
from sb3_maddpg.checkpoints.writer import columns, read_segments
from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidEnvironmentError, InvalidFileError
from sb3_maddpg.files.archive import Archive, as_damage, opened
from sb3_maddpg.files.typed_json import decode
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.utils import shown


def resume(
    folder: str | os.PathLike[str],
    env: GymEnv,
    algorithm: type[TeamAlgorithm] = MADDPG,
    every: int | None = None,
    keep: int = 2,
    device: th.device | str = "auto",
) -> tuple[TeamAlgorithm, RunCheckpoint] | None:
    """
    Load the newest checkpoint of a run. Continue training with ``model.learn(total_timesteps - model.num_timesteps,
    [callback, ...], reset_num_timesteps=False)``, with the same environment and callbacks as in the run. The callbacks'
    arguments may differ: those passed now apply, and what the training changed is restored.

    :param folder: folder of the checkpoints
    :param env: environment, created as for the run
    :param algorithm: algorithm of the run
    :param every: number of steps between checkpoints, by default as before
    :param keep: see ``RunCheckpoint``
    :param device: see ``MADDPG.load``
    :return: the model and the callback that continues its checkpoints, None if there is no complete checkpoint
    :raises ValueError: if the environment, or the number of its copies, differs from the run's
    """
    path = newest(folder)
    if path is None:
        return None
    with as_damage(path, "checkpoint"):
        state = json_in(path, "state.json")
        if state.get("format") != FORMAT:
            raise InvalidFileError(f"{path} has format {shown(state.get('format'))}, but this version reads {FORMAT}.")
        with opened(path / "arrays.npz", "checkpoint") as file:
            plain = decode(state, f"{path}: state", Archive(file, path / "arrays.npz").arrays())
        check_values(plain)
        model = algorithm.load(path / "model.zip", env=env, device=device, force_reset=False)
        compare_fingerprints(plain["fingerprint"], fingerprint(model.env))
        n_envs = len(plain["last"]["_last_episode_starts"])
        if model.n_envs != n_envs:
            raise InvalidEnvironmentError(
                f"{path} has n_envs={n_envs}, but the recipe or env has n_envs={model.n_envs} now: set it to {n_envs} "
                "to resume this run."
            )
        callback = RunCheckpoint(folder, every or plain["every"], keep)
        callback.logger_folder = plain["logger_folder"]
        buffer = model.replay_buffer
        assert isinstance(buffer, TeamReplayBuffer)
        read_segments(Path(folder), buffer, plain["segments"], plain["counters"])
        buffer.restore(plain["counters"], {**columns(buffer), **plain["buffer_arrays"]})
        check_random_state(plain["random"])
        model.action_noise = plain["action_noise"]
        model.action_noise = model._action_noise_for(n_envs)
        callback._segments = plain["segments"]
        callback._pending = plain
        callback.saved_at = model.num_timesteps
    return model, callback
