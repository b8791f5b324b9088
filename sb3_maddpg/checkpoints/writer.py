"""The thread that writes a checkpoint, and the segments that hold the replay buffer."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from sb3_maddpg.checkpoints.commit import PREFIX, SEGMENTS, commit, file_in, remove_old, unfinished_path
from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.files.archive import write_archive
from sb3_maddpg.files.typed_json import encode
from sb3_maddpg.utils import shown, sync_folder

_BLOCK = 2**25  # bytes of a replay buffer to write at once


class Segment:
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


class Writer(threading.Thread):
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
        segment: Segment,
        kept: list[dict[str, Any]],
        state: dict[str, Any],
        keep: int,
    ):
        super().__init__(name="checkpoint")
        self.folder, self.segment, self.keep = folder, segment, keep
        self.steps = model.num_timesteps
        self.segments = list(kept)
        self.target = folder / f"{PREFIX}{self.steps:012d}"
        self.processor_time = 0.0
        self.error: BaseException | None = None
        self._copied = segment.first  # rows before this one may be overwritten
        self._progress = threading.Condition()
        model_file, arrays_file = io.BytesIO(), io.BytesIO()
        model.save(model_file)
        arrays: dict[str, np.ndarray] = {}
        self._state = cast("dict[str, Any]", encode(state, "state", arrays))
        write_archive(arrays_file, {}, arrays)
        self._files = {"model.zip": model_file.getvalue(), "arrays.npz": arrays_file.getvalue()}

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
            commit(self.target, self._write)
            remove_old(self.folder, self.keep)
        except BaseException as error:  # raised in the training's thread
            self.error = error
        finally:
            with self._progress:
                self._copied = self.segment.end + 1
                self._progress.notify_all()
            self.processor_time = time.thread_time()

    def _write_segment(self) -> None:
        path = self.folder / SEGMENTS / self.segment.name
        path.parent.mkdir(parents=True, exist_ok=True)
        found = hashlib.sha256()
        unfinished = unfinished_path(path)
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


def columns(buffer: TeamReplayBuffer) -> dict[str, np.ndarray]:
    used = buffer.records[: buffer.size() + int(buffer.optimize_memory_usage)]
    return {name: used[name] for name in buffer.records.dtype.names or ()}


def size_of(buffer: TeamReplayBuffer, first: int, end: int) -> int:
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


def read_segments(
    folder: Path, buffer: TeamReplayBuffer, segments: list[dict[str, Any]], counters: dict[str, Any]
) -> None:
    size, stored = buffer.buffer_size, _stored(buffer)
    _check_segments(segments, counters, size)
    buffer.pos, buffer.full = counters["pos"], counters["full"]
    for one in segments:
        path, first, end = file_in(folder / SEGMENTS, one["name"]), one["first"], one["end"]
        if not 0 <= first < end <= counters["n_added"] or size_of(buffer, first, end) > path.stat().st_size:
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
