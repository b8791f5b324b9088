"""Checkpoints of a run, from which training resumes bit for bit, written atomically.

A checkpoint is a folder ``checkpoint-STEPS`` with the model, the state of everything around it, and the names of the
segments that hold the replay buffer. Segments are files beside the checkpoints that are written once: each checkpoint
adds a segment with the transitions since the previous one. The folder is first written under a temporary name. All
files are synced to disk, then a manifest with their checksums is written, and renaming the folder commits it.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import json
import math
import os
import platform
import random
import re
import secrets
import shutil
import signal
import stat
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch as th
from filelock import FileLock, Timeout, UnixFileLock
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EventCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError, InvalidFileError, NoStateError, TeamError
from sb3_maddpg.files.model_files import as_damage, check_not_compressed
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.utils import arguments_of, remedy_of, shown, sources_of, sync_folder
from sb3_maddpg.vec_env.states import (
    checked_bits,
    layers,
    load_vec_env_state,
    plain_entries,
    plain_values,
    set_plain_values,
    set_space_generators,
    space_generators,
    vec_env_state,
)

_FORMAT = 2
_PREFIX, _UNFINISHED, _MANIFEST = "checkpoint-", ".unfinished", "manifest.json"
_SEGMENTS = "segments"
_BLOCK = 2**25  # bytes of a replay buffer to write at once
# Minimum time between checkpoints (s), and maximum fraction of the time that they may take
_SECONDS, _SHARE = 30.0, 0.015
_BYTES_PER_SECOND = 5e8  # of a replay buffer, assumed before the first checkpoint
_LAST = ("_last_obs", "_last_original_obs", "_last_episode_starts")
_LOGGED = ("name_to_value", "name_to_count", "name_to_excluded")


class RunCheckpoint(BaseCallback):
    """
    Callback that takes checkpoints between rollouts during training. ``resume`` continues from the newest one.

    A thread writes the replay buffer and syncs all files to disk while the training continues. The state is that of
    the moment at which the checkpoint was taken. An error in the thread is raised at the beginning of a later rollout.

    On SIGTERM and SIGHUP, which clusters and closed terminals send to end a process, the callback writes another
    checkpoint and then ends the process with that signal. A second signal ends the process at once. A signal that the
    process ignores, as under ``nohup``, stays ignored.

    :param folder: folder for the checkpoints of this run only
    :param every: number of steps between checkpoints; None to take one every half minute, or less often if all
        checkpoints together would cost more than 1.5 % of the time
    :param keep: number of most recent checkpoints to keep
    :param verbose: 1 to print what is written
    :raises ValueError: if ``every`` or ``keep`` is less than 1
    """

    def __init__(self, folder: str | os.PathLike[str], every: int | None = None, keep: int = 2, verbose: int = 0):
        super().__init__(verbose)
        if not ((every is None or every >= 1) and keep >= 1):  # also NaN
            raise InvalidArgumentError(f"every={every}, keep={keep}: both must be at least 1.")
        self.folder, self.every, self.keep = Path(folder), every, keep
        self.saved_at = 0
        # Seconds that checkpoints have cost: time of the training, and processor time of the writing threads
        self.cost = 0.0
        self._started = self._ended = time.monotonic()  # of training, and of the last checkpoint
        self._bytes_per_second = _BYTES_PER_SECOND
        self._writer: _Writer | None = None
        self._signal: int | None = None
        self._handlers: dict[int, Any] = {}
        self.inexact: str | None = None
        self.logger_folder: str | None = None  # of the run that is resumed
        self._pending: dict[str, Any] | None = None
        self._segments: list[dict[str, Any]] = []
        # Callbacks with their values at the start of training
        self._at_start: list[tuple[BaseCallback, dict[str, Any]]] = []

    def state_dict(self) -> dict[str, Any]:
        """:return: nothing: what it counts begins anew in every process"""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """:param state: see ``state_dict``"""

    def _on_training_start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._remove_unfinished()
        callbacks, known = _callbacks(self._root()), [one for one, _ in self._at_start]
        self._at_start += [(one, deepcopy(_values(one))) for one in callbacks if one not in known]
        if self._pending is not None:
            try:
                _restore(cast(TeamAlgorithm, self.model), callbacks, self._pending)
            except (ValueError, OSError):
                raise
            except Exception as error:  # from environments, wrappers and callbacks of any kind
                raise InvalidFileError(
                    f"A checkpoint in {self.folder} is damaged, or belongs to another environment or other callbacks "
                    f"({type(error).__name__}: {shown(str(error))})."
                ) from error
            self._pending = None
        else:
            self.saved_at = self.model.num_timesteps
        self._started = self._ended = time.monotonic()
        self.cost = 0.0

        if threading.current_thread() is threading.main_thread():
            for name in ("SIGTERM", "SIGHUP"):
                number = getattr(signal, name, None)
                if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                    self._handlers[number] = signal.signal(number, self._on_signal)

    def _on_training_end(self) -> None:
        try:
            self._finish()
        finally:
            while self._handlers:
                signal.signal(*self._handlers.popitem())

    def _on_signal(self, number: int, frame: Any) -> None:
        if self._signal is not None:
            _end_by(number)
        self._signal = number
        _leave_closed_terminal(number)

    def _on_rollout_start(self) -> None:
        if self._signal is not None:
            self.save()
            with suppress(OSError):  # nobody may be able to read it any more
                print(f"Ended by {signal.Signals(self._signal).name} at step {self.model.num_timesteps}.", flush=True)
            _end_by(self._signal)
        if self._writer is not None and not self._writer.is_alive():
            self._finish()
        steps = self.model.num_timesteps - self.saved_at
        if steps >= self.every if self.every is not None else steps > 0 and self._is_time():
            self._begin()

    def _on_step(self) -> bool:
        if self._writer is not None:
            buffer = cast(TeamAlgorithm, self.model).replay_buffer
            assert isinstance(buffer, TeamReplayBuffer)
            # The transition of this step overwrites the oldest row, and without next_observations part of the next one
            overwritten = buffer.n_added - buffer.buffer_size + int(buffer.optimize_memory_usage)
            if not self._writer.has_copied(overwritten):
                started = time.monotonic()
                self._writer.wait_for(overwritten)
                self.cost += time.monotonic() - started
        return True

    def _is_time(self) -> bool:
        now = time.monotonic()
        if self._writer is not None or now - self._ended < _SECONDS:
            return False
        expected = self._bytes_to_write() / self._bytes_per_second
        return self.cost + expected <= _SHARE * (now - self._started + expected)

    def _bytes_to_write(self) -> int:
        buffer = cast(TeamAlgorithm, self.model).replay_buffer
        assert isinstance(buffer, TeamReplayBuffer)
        first, end = self._new_rows(buffer)
        return _size_of(buffer, first, end)

    def save(self) -> Path | None:
        """
        Write a checkpoint now. Call this between rollouts only, when all parts of the state are consistent.

        :return: folder of the checkpoint, None if the disk is full; the previous checkpoint stays then
        """
        self._begin()
        return self._finish()

    def _begin(self) -> None:
        """Take a checkpoint, which a thread then writes."""
        self._finish()
        model = cast(TeamAlgorithm, self.model)
        buffer = model.replay_buffer
        assert isinstance(buffer, TeamReplayBuffer)
        started = time.monotonic()
        self.saved_at = model.num_timesteps
        kept, (first, end) = self._kept_segments(buffer), self._new_rows(buffer)
        state = _state_of(model, _callbacks(self._root()), self._at_start, self.every)
        self.inexact = state["inexact"]
        self._writer = _Writer(self.folder, model, _Segment(buffer, first, end), kept, state, self.keep)
        self._writer.start()
        self.cost += time.monotonic() - started

    def _finish(self) -> Path | None:
        """
        Wait for the thread that writes a checkpoint.

        :return: folder of the checkpoint, None if there is no thread or the disk is full
        """
        if self._writer is None:
            return None
        started = time.monotonic()
        self._writer.join()
        self._ended = time.monotonic()
        writer, self._writer = self._writer, None
        self.cost += self._ended - started + writer.processor_time
        segment = writer.segment
        if writer.processor_time > 0.0:
            size = _size_of(segment.buffer, segment.first, segment.end)
            self._bytes_per_second = max(size, 1) / writer.processor_time
        error = writer.error
        if error is None:
            self._segments = writer.segments
            if self.verbose:
                print(f"Checkpoint at step {writer.steps}: {writer.target}")
            return writer.target
        remedy = remedy_of(error)
        if remedy is None:
            raise error
        warnings.warn(
            f"No space left for a checkpoint at step {writer.steps}: the previous one stays ({error})."
            if remedy == "free space"
            else f"No checkpoint at step {writer.steps}: the previous one stays. {self.folder}: {error}; {remedy}.",
            stacklevel=2,
        )
        self._remove_unfinished()
        writer.tidy()  # its segment would take up space, and the next one holds the same rows
        return None

    def _remove_unfinished(self) -> None:
        for path in self.folder.glob(f"*{_UNFINISHED}"):
            shutil.rmtree(path, ignore_errors=True)
        for path in (self.folder / _SEGMENTS).glob(f"*{_UNFINISHED}"):
            path.unlink(missing_ok=True)

    def _root(self) -> BaseCallback:
        root: BaseCallback = self
        while root.parent is not None:
            root = root.parent
        # A CallbackList is not the parent of its callbacks, but it is a local variable of learn()
        return self.locals.get("callback", root)

    def _kept_segments(self, buffer: TeamReplayBuffer) -> list[dict[str, Any]]:
        """:return: the segments written so far that still belong to the buffer, oldest first"""
        oldest = buffer.n_added - buffer.size()
        return [one for one in self._segments if oldest < one["end"] <= buffer.n_added]

    def _new_rows(self, buffer: TeamReplayBuffer) -> tuple[int, int]:
        """
        :return: the rows to write, from first to end: those since the last checkpoint, and the one before them, whose
            end may have changed
        """
        oldest, kept = buffer.n_added - buffer.size(), self._kept_segments(buffer)
        return max(kept[-1]["end"] - 1 if kept else oldest, oldest), buffer.n_added


class _Segment:
    """
    Rows of a replay buffer at the moment of construction. They may be read later, while the buffer is used, as long as
    nothing overwrites them: those that the next transition changes are copied at once.

    :param buffer: the replay buffer
    :param first: first row, counted since the buffer was empty
    :param end: row after the last one
    """

    def __init__(self, buffer: TeamReplayBuffer, first: int, end: int):
        self.buffer, self.first, self.end = buffer, first, end
        self.blocks = _blocks(buffer, first, end)
        self._last = list(_stored_block(buffer, self.blocks[-1], end))

    @property
    def name(self) -> str:
        return f"{self.first:012d}-{self.end:012d}.rows"

    def content(self) -> Iterator[tuple[int, list[bytes]]]:
        """Yield for each block the row after it and its content."""
        for rows in self.blocks[:-1]:
            yield rows[-1] + 1, list(_stored_block(self.buffer, rows, self.end))
        yield self.end + 1, self._last


class _Writer(threading.Thread):
    """
    Thread that writes a checkpoint.

    :param folder: folder of the checkpoints
    :param model: the model, which is read at once
    :param segment: new rows of its replay buffer
    :param kept: segments written before that still belong to the buffer
    :param state: everything else
    :param keep: number of most recent checkpoints to keep
    """

    def __init__(
        self,
        folder: Path,
        model: TeamAlgorithm,
        segment: _Segment,
        kept: list[dict[str, Any]],
        state: dict[str, Any],
        keep: int,
    ):
        super().__init__(name="checkpoint")
        self.folder, self.segment, self.keep = folder, segment, keep
        self.steps = model.num_timesteps
        self.segments = list(kept)
        self.target = folder / f"{_PREFIX}{self.steps:012d}"
        self.processor_time = 0.0
        self.error: BaseException | None = None
        self._copied = segment.first  # rows before this one may be overwritten
        self._progress = threading.Condition()
        file = io.BytesIO()
        model.save(file)
        arrays: dict[str, np.ndarray] = {}
        self._state = cast("dict[str, Any]", encode(state, "state", arrays))
        self._files = {"model.zip": file.getvalue(), "arrays.npz": _npz(arrays)}

    def has_copied(self, row: int) -> bool:
        """:return: whether a row may be overwritten"""
        return row < self._copied or not self.is_alive()

    def wait_for(self, row: int) -> None:
        """Wait until a row may be overwritten."""
        with self._progress:
            self._progress.wait_for(lambda: self.has_copied(row))

    def run(self) -> None:
        try:
            self._write_segment()
            _commit(self.target, self._write)
            self.tidy()
        except BaseException as error:  # raised in the training's thread
            self.error = error
        finally:
            with self._progress:
                self._copied = self.segment.end + 1
                self._progress.notify_all()
            self.processor_time = time.thread_time()

    def _write_segment(self) -> None:
        path = self.folder / _SEGMENTS / self.segment.name
        path.parent.mkdir(parents=True, exist_ok=True)
        found = hashlib.sha256()
        unfinished = _unfinished(path)
        try:
            with unfinished.open("xb") as file:
                for end, parts in self.segment.content():
                    with self._progress:
                        self._copied = end
                        self._progress.notify_all()
                    for part in parts:
                        found.update(part)
                        file.write(part)
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)
        sync_folder(path.parent)
        rows = {"first": self.segment.first, "end": self.segment.end}
        self.segments.append({"name": self.segment.name, **rows, "sha256": found.hexdigest()})

    def _write(self, path: Path) -> None:
        state = {**self._state, "segments": encode(self.segments, "segments")}
        for name, content in {**self._files, "state.json": json.dumps(state).encode()}.items():
            (path / name).write_bytes(content)

    def tidy(self) -> None:
        """Remove old checkpoints, and segments that no remaining checkpoint needs."""
        folders = _finished(self.folder)
        for path in folders[: -self.keep]:
            shutil.rmtree(path, ignore_errors=True)
        needed: set[str] = set()
        for path in folders[-self.keep :]:
            with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
                needed |= {one["name"] for one in json.loads((path / "state.json").read_text())["segments"]}
        for path in (self.folder / _SEGMENTS).glob("*.rows"):
            if path.name not in needed:
                path.unlink(missing_ok=True)


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
        arrays, state = _read_state(path)
        plain = decode(state, f"{path}: state", arrays)
        _check_values(plain)
        model = algorithm.load(path / "model.zip", env=env, device=device, force_reset=False)
        _compare_fingerprints(plain["fingerprint"], fingerprint(model.env))
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
        _read_segments(Path(folder), buffer, plain["segments"], plain["counters"])
        buffer.restore(plain["counters"], {**_columns(buffer), **plain["buffer_arrays"]})
        _check_random_state(plain["random"])
        model.action_noise = plain["action_noise"]
        model.action_noise = model._action_noise_for(n_envs)
        callback._segments = plain["segments"]
        callback._pending = plain
        callback.saved_at = model.num_timesteps
    return model, callback


def _check_values(state: dict[str, Any]) -> None:
    """
    :param state: state in a checkpoint
    :raises ValueError: if a value of its own, or of the logger, is not one that a checkpoint can hold
    """
    every, noise, logger, inexact = (state[name] for name in ("every", "action_noise", "logger", "inexact"))
    if every is not None and not (type(every) is int and every >= 1):
        raise InvalidFileError(f"A checkpoint is damaged: it was one of every={shown(every)} steps.")
    if not isinstance(noise, (ActionNoise, type(None))):
        raise InvalidFileError(f"A checkpoint is damaged: its action_noise is {shown(noise)}.")
    if not isinstance(state["logger_folder"], (str, type(None))) or not isinstance(inexact, (str, type(None))):
        raise InvalidFileError("A checkpoint is damaged: its logger_folder or inexact is not text.")
    written = state["fingerprint"]
    if not isinstance(written, dict) or not all(isinstance(one, str) for pair in written.items() for one in pair):
        raise InvalidFileError(f"A checkpoint is damaged: its fingerprint is {shown(written)}.")
    kinds = {
        "name_to_value": lambda value: isinstance(value, (str, int, float, np.number)),
        "name_to_count": lambda value: type(value) is int and 0 <= value < 2**53,
        "name_to_excluded": lambda value: isinstance(value, (str, tuple, list, type(None))),
    }
    for name in _LOGGED:
        wrong = [value for value in logger[name].values() if not kinds[name](value)]
        if wrong or not all(isinstance(key, str) for key in logger[name]):
            raise InvalidFileError(f"A checkpoint is damaged: the logger's {name} holds {shown(wrong)}.")


def newest(folder: str | os.PathLike[str]) -> Path | None:
    """
    Find the newest complete checkpoint. Damaged checkpoints are skipped with a warning.

    :param folder: folder of the checkpoints
    :return: path of the checkpoint, None if there is none
    """
    for path in reversed(_finished(Path(folder))):
        if problem := _damage(path):
            warnings.warn(f"{path} is skipped: {problem}.", stacklevel=2)
        else:
            return path
    return None


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """
    Lock a folder of checkpoints for this process. The lock ends with the process, however that ends.

    :param folder: folder of the checkpoints
    :raises ValueError: if another process holds the lock
    """
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    file, holder = path / "lock", ""
    with suppress(OSError):
        holder = file.read_text(errors="replace").strip()  # earlier versions of filelock truncate the file
    lock = FileLock(file, thread_local=False)
    try:
        held = lock.acquire(blocking=False)
    except Timeout:
        raise TeamError(f"{path} is in use by {holder or 'another process'}.") from None
    with held:
        if isinstance(lock, UnixFileLock):  # on Windows, nobody can write into a locked file
            file.write_text(f"process {os.getpid()} on {platform.node()}")
        yield


def digest(model: TeamAlgorithm) -> str:
    """
    :param model: a model with its replay buffer
    :return: SHA-256 of parameters, optimizers, replay buffer, counters and random number generators
    """
    found = hashlib.sha256()
    for leaf in th.utils._pytree.tree_leaves(model.get_parameters()):
        found.update(leaf.cpu().numpy().tobytes() if isinstance(leaf, th.Tensor) else repr(leaf).encode())
    assert isinstance(model.replay_buffer, TeamReplayBuffer)
    _, counters, arrays = model.replay_buffer.contents()
    for array in arrays.values():
        found.update(np.ascontiguousarray(array).tobytes())
    generators = _random_state()
    text = json.dumps(encode([counters, model.num_timesteps, model._n_updates, generators], "state"), sort_keys=True)
    found.update(text.encode())
    return found.hexdigest()


def _state_of(
    model: TeamAlgorithm,
    callbacks: list[BaseCallback],
    at_start: Sequence[tuple[BaseCallback, dict[str, Any]]],
    every: int | None,
) -> dict[str, Any]:
    """
    :param model: the model
    :param callbacks: all callbacks
    :param at_start: callbacks with their values at the start of training
    :param every: number of steps between checkpoints, None for checkpoints by time
    :return: the state of everything that is not in the model's file
    """
    buffer = model.replay_buffer
    assert isinstance(buffer, TeamReplayBuffer)
    _, counters, arrays = buffer.contents()
    in_segments = buffer.records.dtype.names or ()
    inexact, env = _env_state_or_reason(cast(VecEnv, model.env))
    states = []
    for one in callbacks:
        evaluation = None
        if isinstance(other := getattr(one, "eval_env", None), VecEnv):
            reason, evaluation = _env_state_or_reason(other)
            inexact = inexact or reason
        began = next((values for known, values in at_start if known is one), None)
        values = {"values": {**_values(one), **_told(one)}, "at_start": began}
        states.append({"class": type(one).__name__, **values, "eval_env": evaluation})
    return {
        "format": _FORMAT,
        "fingerprint": fingerprint(model.env),
        "inexact": inexact,
        "every": every,
        "counters": counters,
        "buffer_arrays": {name: one for name, one in arrays.items() if name not in in_segments},
        "last": {name: getattr(model, name) for name in _LAST},
        "action_noise": model.action_noise,
        "random": _random_state(),
        "spaces": space_generators(model.action_space),
        "env": env,
        "callbacks": states,
        "logger_folder": model.logger.get_dir(),
        "logger": {name: plain_entries(getattr(model.logger, name)) for name in _LOGGED},
    }


def _env_state_or_reason(env: VecEnv) -> tuple[str | None, dict[str, Any] | None]:
    try:
        return None, vec_env_state(env)
    except NoStateError as error:
        return str(error), None


def _restore(model: TeamAlgorithm, callbacks: list[BaseCallback], state: dict[str, Any]) -> None:
    """Restore everything but the networks and the replay buffer, after learn() has begun."""
    env = cast(VecEnv, model.env)
    if state["env"] is None:
        warnings.warn(
            f"{state['inexact']} The run continues with new episodes and will not be bit-identical.", stacklevel=2
        )
        model._last_obs = env.reset()  # type: ignore[assignment]
        model._last_episode_starts = np.ones((env.num_envs,), dtype=bool)
    else:
        load_vec_env_state(env, state["env"])
        for name in _LAST:
            setattr(model, name, _checked_last(model, name, state["last"][name]))
    model._seeds_of_reset = model._seeds_of_env()  # the episodes begin, or go on, with what was restored
    names = [type(one).__name__ for one in callbacks]
    states = [one for one in state["callbacks"] if one["class"] != CallbackList.__name__]
    if names != (written := [one["class"] for one in states]):
        raise InvalidArgumentError(
            f"The run had the callbacks {written}, but now they are {names}: resume with the same ones."
        )
    for one, saved in zip(callbacks, states, strict=True):
        _restore_callback(one, saved["values"], saved.get("at_start"))
        if saved["eval_env"] is not None:
            load_vec_env_state(one.eval_env, saved["eval_env"])  # type: ignore[attr-defined]
    for name in _LOGGED:
        getattr(model.logger, name).update(state["logger"][name])
    set_space_generators(model.action_space, state["spaces"])
    _set_random_state(state["random"])


# What training changes in callbacks whose arguments it does not change, beside the number of their calls
_KEPT: dict[type[BaseCallback], tuple[str, ...]] = {
    CheckpointCallback: (),
    ConvertCallback: (),
    CurriculumCallback: ("successes",),
    DashboardCallback: (),
    EvalCallback: (
        "best_mean_reward",
        "last_mean_reward",
        "evaluations_results",
        "evaluations_timesteps",
        "evaluations_length",
        "evaluations_successes",
    ),
    EventCallback: (),
    EveryNTimesteps: ("last_time_trigger",),
    LogEveryNTimesteps: ("last_time_trigger",),
    MetricsCallback: (),
    ProgressBarCallback: (),
    StopTrainingOnMaxEpisodes: ("n_episodes",),
    StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
    StopTrainingOnRewardThreshold: (),
}
_CALLS, _TOLD = "n_calls", "state_dict"


def _tells_state(callback: BaseCallback) -> bool:
    """:return: whether a callback decides itself what checkpoints hold of it"""
    return all(callable(getattr(type(callback), name, None)) for name in (_TOLD, "load_state_dict"))


def _values(callback: BaseCallback) -> dict[str, Any]:
    """:return: the values of a callback that checkpoints hold, except what it tells itself"""
    if _tells_state(callback):
        return {_CALLS: callback.n_calls}
    names = _KEPT.get(type(callback))
    if names is None:  # an own callback, or a subclass, of which nobody has said what to keep
        return plain_values(callback)
    return plain_entries({name: getattr(callback, name) for name in (_CALLS, *names)})


def _told(callback: BaseCallback) -> dict[str, Any]:
    """
    :param callback: a callback
    :return: what it tells of its state, under a name that no attribute has; nothing if that is empty
    :raises ValueError: if that cannot be written
    """
    told: Any = callback.state_dict() if _tells_state(callback) else {}  # type: ignore[attr-defined]
    name = f"{type(callback).__name__}.state_dict()"
    if not isinstance(told, dict):
        raise InvalidArgumentError(f"{name} returned {shown(told)}: it must return a dict of plain values and arrays.")
    encode(told, name, {})
    return {_TOLD: told} if told else {}


def _restore_callback(callback: BaseCallback, values: dict[str, Any], at_start: dict[str, Any] | None) -> None:
    """
    :param callback: a callback of the resumed run
    :param values: its values in the checkpoint
    :param at_start: its values at the start of the run, None if the checkpoint does not hold them
    :raises ValueError: if the values do not fit the callback
    """
    names = _KEPT.get(type(callback))
    if _TOLD in values:
        if not _tells_state(callback):
            raise InvalidArgumentError(
                f"The run's {type(callback).__name__} had state_dict() and load_state_dict(), but now it has not: "
                "resume with the same one."
            )
        set_plain_values(callback, {_CALLS: values[_CALLS]})
        callback.load_state_dict(values[_TOLD])  # type: ignore[attr-defined]
    elif names is not None:
        set_plain_values(callback, {name: values[name] for name in (_CALLS, *names) if name in values})
    else:
        set_plain_values(callback, _values_to_restore(callback, values, at_start))


def _values_to_restore(
    callback: BaseCallback, values: dict[str, Any], at_start: dict[str, Any] | None
) -> dict[str, Any]:
    """
    Leave out the arguments of a callback that were changed for the resumed run, and what follows from them.

    :param callback: the callback of the resumed run
    :param values: its values in the checkpoint
    :param at_start: its values at the start of the run, None if the checkpoint does not hold them
    :return: all values if its arguments are those of the run; otherwise those that had changed since the start
    """
    present, arguments = plain_values(callback), arguments_of(type(callback))
    differ = {
        name: value for name, value in present.items() if at_start and not _equal(value, at_start.get(name, value))
    }
    changed = [name for name in differ if name.lstrip("_") in arguments]
    if at_start is None or not changed:
        return values
    restored = {
        name: value for name, value in values.items() if name not in differ or not _equal(value, at_start[name])
    }
    for name in changed:
        if name in restored and not _equal(restored[name], present[name]):
            warnings.warn(
                f"{type(callback).__name__}: {name}={shown(present[name])} has no effect. The run began with "
                f"{shown(at_start[name])}, and what it became during training is restored: {shown(restored[name])}. "
                "Start a new run to begin with another value.",
                stacklevel=2,
            )
    return restored


def _equal(one: Any, other: Any) -> bool:
    return json.dumps(encode(one, "value")) == json.dumps(encode(other, "value"))


def _checked_last(model: TeamAlgorithm, name: str, value: Any) -> Any:
    """:return: an array of the last observations, or whether they begin episodes, if it fits the environment"""
    present: Any = model._last_episode_starts if name == "_last_episode_starts" else model._last_obs
    if value is None and name == "_last_original_obs" and model._vec_normalize_env is None:  # before the first step
        return value
    if not isinstance(value, np.ndarray) or value.shape != np.shape(present):
        raise InvalidFileError(f"A checkpoint is damaged: its {name} is {shown(value)}.")
    return value


def _leave_closed_terminal(number: int) -> None:
    """
    Write nothing more to a terminal that was closed, nor to a pipe whose reader, such as ``tee``, ended with it, since
    that would raise an error before the checkpoint.
    """
    for output in (1, 2):
        with suppress(OSError):
            mode = os.fstat(output).st_mode
            piped = stat.S_ISFIFO(mode) and number == getattr(signal, "SIGHUP", None)
            if piped or (stat.S_ISCHR(mode) and not os.isatty(output)):
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, output)
                os.close(null)


def _end_by(number: int) -> None:
    """End this process with a signal's default action."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _random_state() -> dict[str, Any]:
    version, numbers, gauss = random.getstate()
    cuda = [one.numpy() for one in th.cuda.get_rng_state_all()] if th.cuda.is_available() else []
    return {
        "python": [version, list(numbers), gauss],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - what SB3 draws from
        "torch": th.get_rng_state().numpy(),
        "cuda": cuda,
    }


def _check_random_state(state: dict[str, Any]) -> None:
    """
    :param state: see ``_random_state``
    :raises ValueError: if a part does not fit the generator of this process
    """
    own = _random_state()
    version, numbers, gauss = state["python"]
    plain = version == own["python"][0] and isinstance(numbers, list) and len(numbers) == len(own["python"][1])
    if not (plain and all(type(one) is int and 0 <= one < 2**32 for one in numbers) and numbers[-1] < len(numbers)):
        raise InvalidFileError("A checkpoint is damaged: its state of Python's random number generator does not fit.")
    if gauss is not None and not (isinstance(gauss, float) and math.isfinite(gauss)):
        raise InvalidFileError(f"A checkpoint is damaged: Python's random number generator has gauss={shown(gauss)}.")
    checked_bits(state["numpy"], own["numpy"])
    for name in ("torch", "cuda"):
        given, present = ([one] if name == "torch" else one for one in (state[name], own[name]))
        for one, other in zip(given, present, strict=False):  # there may be no GPU here, or none before
            if not isinstance(one, np.ndarray) or (one.shape, one.dtype) != (other.shape, other.dtype):
                raise InvalidFileError(
                    f"A checkpoint is damaged: its state of PyTorch's random number generator is {shown(one)}."
                )
    try:
        th.Generator().set_state(th.from_numpy(state["torch"].copy()))
    except RuntimeError as error:
        raise InvalidFileError(
            f"A checkpoint is damaged: {shown(str(error))} as the state of PyTorch's generator."
        ) from error


def _set_random_state(state: dict[str, Any]) -> None:
    """:param state: see ``_random_state``, checked"""
    version, numbers, gauss = state["python"]
    random.setstate((version, tuple(numbers), gauss))
    np.random.set_state(state["numpy"])  # noqa: NPY002
    th.set_rng_state(th.from_numpy(state["torch"].copy()))
    if state["cuda"] and th.cuda.is_available():
        th.cuda.set_rng_state_all([th.from_numpy(one.copy()) for one in state["cuda"]])


def _callbacks(root: BaseCallback) -> list[BaseCallback]:
    """:return: a callback and all callbacks inside it, without lists, which have no state of their own"""
    inner: list[BaseCallback | None] = []
    if isinstance(root, CallbackList):
        inner = [*root.callbacks]
    elif isinstance(root, EventCallback):
        inner = [root.callback, getattr(root, "callback_on_new_best", None)]
    own = [] if type(root) is CallbackList else [root]
    return [*own, *(one for callback in inner if callback is not None for one in _callbacks(callback))]


# Distributions whose versions exact results depend on
_DISTRIBUTIONS = ("sb3-maddpg", "stable-baselines3", "gymnasium", "pettingzoo")
# Packages of environments that are named by their versions
_BY_VERSION = {name.replace("-", "_") for name in _DISTRIBUTIONS}


def fingerprint(env: VecEnv | None = None) -> dict[str, str]:
    """
    :param env: the environment of a training
    :return: the hardware, the versions and the sources that the exact results of training depend on: those of the
        libraries, of this package, of the environment and its wrappers, and what the environment ``depends_on``
    """
    parts = [] if env is None else list(layers(env))
    modules = {type(one).__module__ for one in parts}
    sources = {module.partition(".")[0]: sources_of(module) for module in sorted(modules)}
    told = next((one for part in parts if isinstance(one := getattr(part, "depends_on", None), Mapping)), {})
    return {
        "processor": f"{platform.machine()} {platform.processor()} {th.backends.cpu.get_cpu_capability()}",
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "torch": str(th.__version__),
        "numpy": np.__version__,
        **{name: version for name in _DISTRIBUTIONS if (version := _version(name))},
        "threads": str(th.get_num_threads()),
        "sources of sb3_maddpg": sources_of("sb3_maddpg"),
        **{f"sources of {name}": digest for name, digest in sources.items() if digest and name not in _BY_VERSION},
        **{f"environment's {name}": str(value) for name, value in told.items()},
    }


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _compare_fingerprints(written: dict[str, str], here: dict[str, str]) -> None:
    """Say in one line what differs from the fingerprint in a checkpoint, which earlier versions wrote shorter."""
    differ = [
        f"{name}: {written.get(name, 'unknown')} before, {here.get(name, 'none')} now"
        for name in {**here, **written}
        if written.get(name) != here.get(name)
    ]
    if differ:
        warnings.warn(f"The run continues, but may not be bit-identical: {'; '.join(differ)}.", stacklevel=3)


def _columns(buffer: TeamReplayBuffer) -> dict[str, np.ndarray]:
    used = buffer.records[: buffer.size() + int(buffer.optimize_memory_usage)]
    return {name: used[name] for name in buffer.records.dtype.names or ()}


def _size_of(buffer: TeamReplayBuffer, first: int, end: int) -> int:
    """:return: approximate number of bytes of a segment"""
    return (end - first) * buffer.n_envs * _stored(buffer).itemsize


def _stored(buffer: TeamReplayBuffer) -> np.dtype:
    """:return: type of the transitions in segments, without next observations"""
    fields = buffer.records.dtype
    return np.dtype([(name, fields[name]) for name in fields.names or () if name != "next_observations"])


def _blocks(buffer: TeamReplayBuffer, first: int, end: int) -> list[np.ndarray]:
    """
    :return: the rows of a segment, counted since the buffer was empty, in blocks of about `_BLOCK` bytes; the last
        block has the rows that the next transition changes
    """
    rows_at_once = max(_BLOCK // buffer.records[0].nbytes, 1)
    begins = range(first, end - 1, rows_at_once)
    blocks = [np.arange(begin, min(begin + rows_at_once, end - 1)) for begin in begins]
    return [*blocks, np.arange(max(end - 1, first), end + int(buffer.optimize_memory_usage))]


def _stored_block(buffer: TeamReplayBuffer, rows: np.ndarray, end: int) -> Iterator[bytes]:
    """
    Yield the content of a block: transitions, which of them have a next observation other than the next row's
    observation, and those next observations.
    """
    places = rows % buffer.buffer_size
    block = np.empty((len(rows), buffer.n_envs), _stored(buffer))
    for name in block.dtype.names or ():
        block[name] = buffer.records[name][places]
    yield block.tobytes()
    if not buffer.optimize_memory_usage:
        after = buffer.next_observations[places]
        differs = _differs(after, buffer.observations[(places + 1) % buffer.buffer_size])
        differs[rows == end - 1] = True
        yield differs.tobytes()
        yield after[differs].tobytes()


def _differs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """:return: for each row and environment, whether two arrays differ in any bit, as 0.0 and -0.0 do"""
    shape = (*first.shape[:2], math.prod(first.shape[2:]) * first.itemsize)
    return (first.view(np.uint8).reshape(shape) != second.view(np.uint8).reshape(shape)).any(axis=-1)


def _read_segments(
    folder: Path, buffer: TeamReplayBuffer, segments: list[dict[str, Any]], counters: dict[str, Any]
) -> None:
    size, stored = buffer.buffer_size, _stored(buffer)
    _check_segments(segments, counters, size)
    buffer.pos, buffer.full = counters["pos"], counters["full"]
    for one in segments:
        path, first, end = _file_in(folder / _SEGMENTS, one["name"]), one["first"], one["end"]
        if not 0 <= first < end <= counters["n_added"] or _size_of(buffer, first, end) > path.stat().st_size:
            raise InvalidFileError(f"{path} does not hold the rows {shown(first)} to {shown(end)}.")
        same = []  # rows and environments whose next observation is the next row's observation
        with path.open("rb") as file:
            for rows in _blocks(buffer, first, end):
                shape = (len(rows), buffer.n_envs)
                places = rows % size
                block = np.fromfile(file, stored, math.prod(shape)).reshape(shape)
                for name in stored.names or ():
                    buffer.records[name][places] = block[name]
                if not buffer.optimize_memory_usage:
                    differs = np.fromfile(file, bool, math.prod(shape)).reshape(shape)
                    row, env = np.nonzero(differs)
                    after = buffer.next_observations
                    found = np.fromfile(file, after.dtype, len(row) * math.prod(after.shape[2:]))
                    after[places[row], env] = found.reshape(len(row), *after.shape[2:])
                    row, env = np.nonzero(~differs)
                    same.append((places[row], env))
        for place, env in same:
            buffer.next_observations[place, env] = buffer.observations[(place + 1) % size, env]


def _check_segments(segments: list[dict[str, Any]], counters: dict[str, Any], size: int) -> None:
    """
    :param segments: segments of a checkpoint, oldest first
    :param counters: counters of the replay buffer
    :param size: number of its rows
    :raises ValueError: if the counters contradict each other, or the segments are not all of its rows
    """
    n_added = counters["n_added"]
    if type(n_added) is not int or not 0 <= n_added < 2**53:
        raise InvalidFileError(f"A checkpoint is damaged: its replay buffer has n_added={shown(n_added)}.")
    if (counters["pos"], counters["full"]) != (n_added % size, n_added >= size):
        raise InvalidFileError(
            f"A checkpoint is damaged: pos={shown(counters['pos'])} and full={shown(counters['full'])} of a replay "
            f"buffer of {size} rows do not fit n_added={n_added}."
        )
    end = max(n_added - size, 0)
    for one in segments:
        if not all(type(one[name]) is int for name in ("first", "end")) or not one["first"] <= end < one["end"]:
            raise InvalidFileError(
                f"A checkpoint is damaged: {shown(one['name'])} holds the rows {shown(one['first'])} to "
                f"{shown(one['end'])}, but rows from {end} on are missing."
            )
        end = one["end"]
    if end != n_added:
        raise InvalidFileError(f"A checkpoint is damaged: its segments end at row {end}, but it has {n_added} rows.")


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return file.getvalue()


def _read_state(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    state = json.loads((path / "state.json").read_text())
    if not isinstance(state, dict) or state.get("format") != _FORMAT:
        raise InvalidFileError(f"{path} has format {shown(state.get('format'))}, but this version reads {_FORMAT}.")
    with zipfile.ZipFile(path / "arrays.npz") as members:
        check_not_compressed(path / "arrays.npz", members)
    with np.load(path / "arrays.npz", allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}, state


def _unfinished(target: Path) -> Path:
    """:return: path to write something under first, which no other thread, process or container uses"""
    return target.with_name(f"{target.name}.{secrets.token_hex(8)}{_UNFINISHED}")


def _commit(target: Path, write: Callable[[Path], None]) -> Path:
    """Write a folder atomically."""
    unfinished = _unfinished(target)
    unfinished.mkdir(parents=True)
    write(unfinished)
    sums = {}
    for path in sorted(unfinished.iterdir()):
        _sync(path)
        sums[path.name] = _sha256(path)
    _write_synced(unfinished / _MANIFEST, json.dumps(sums).encode())
    sync_folder(unfinished)
    shutil.rmtree(target, ignore_errors=True)
    os.rename(unfinished, target)
    sync_folder(target.parent)
    return target


def _damage(path: Path) -> str | None:
    """:return: what is wrong with a checkpoint, None if it is complete"""
    try:
        for name in ("model.zip", "arrays.npz"):
            _file_in(path, name)
        for name, expected in json.loads(_file_in(path, _MANIFEST).read_text()).items():
            if _sha256(_file_in(path, name)) != expected:
                return f"{name} is damaged"
        segments = json.loads(_file_in(path, "state.json").read_text())["segments"]
        if len({one["name"] for one in segments}) < len(segments):
            return "it names a segment twice"
        for one in segments:
            if _sha256(_file_in(path.parent / _SEGMENTS, one["name"])) != one["sha256"]:
                return f"segment {one['name']} is damaged"
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def _file_in(folder: Path, name: str) -> Path:
    """:return: path of a file in a folder, which is not a device, and not in another folder"""
    path = folder / name
    if path.name != name or not path.is_file():
        raise InvalidFileError(f"there is no file {shown(name)} in {folder}")
    return path


def _finished(folder: Path) -> list[Path]:
    found = (path for path in folder.glob(f"{_PREFIX}*") if re.fullmatch(r"[0-9]+", path.name.removeprefix(_PREFIX)))
    return sorted(found, key=lambda path: int(path.name.removeprefix(_PREFIX)))


def _sha256(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(2**20):
            found.update(block)
    return found.hexdigest()


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
