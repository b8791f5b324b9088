"""The callback that takes checkpoints: when to write, and what signals and closed terminals do."""

from __future__ import annotations

import os
import signal
import stat
import threading
import time
import warnings
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

from stable_baselines3.common.callbacks import BaseCallback

from sb3_maddpg.checkpoints.commit import remove_old, remove_unfinished
from sb3_maddpg.checkpoints.state import callbacks_in, restore, state_of, values_of
from sb3_maddpg.checkpoints.writer import Segment, Writer, size_of
from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.utils import remedy_of, shown

# Minimum time between checkpoints (s), and maximum fraction of the time that they may take
_SECONDS, _SHARE = 30.0, 0.015
_BYTES_PER_SECOND = 5e8  # of a replay buffer, assumed before the first checkpoint


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
        self._writer: Writer | None = None
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
        remove_unfinished(self.folder)
        callbacks, known = callbacks_in(self._root()), [one for one, _ in self._at_start]
        self._at_start += [(one, deepcopy(values_of(one))) for one in callbacks if one not in known]
        if self._pending is not None:
            try:
                restore(cast(TeamAlgorithm, self.model), callbacks, self._pending)
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
        return size_of(buffer, first, end)

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
        state = state_of(model, callbacks_in(self._root()), self._at_start, self.every)
        self.inexact = state["inexact"]
        self._writer = Writer(self.folder, model, Segment(buffer, first, end), kept, state, self.keep)
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
            size = size_of(segment.buffer, segment.first, segment.end)
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
        remove_unfinished(self.folder)
        remove_old(self.folder, self.keep)  # its segment would take up space, and the next one holds the same rows
        return None

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
