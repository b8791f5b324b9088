"""Files of replay buffers: JSON and arrays, which run no code when they are loaded."""

from __future__ import annotations

import io
import os
import pathlib
import zipfile
from typing import Any, cast

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.files.archive import Archive, check_path, opened, write_archive
from sb3_maddpg.files.model_files import not_ours, trusted
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.utils import atomic_write, shown

_FORMAT = 1
_STATE = "buffer.json"


def write_buffer(buffer: TeamReplayBuffer, file: io.BufferedIOBase) -> None:
    """
    Write a replay buffer to a file.

    :param buffer: a team's replay buffer
    :param file: binary file to write to
    :raises ValueError: if files may not name the buffer's class, see ``allow_in_files``
    """
    arguments, counters, arrays = buffer.contents()
    state = {"format": _FORMAT, "class": type(buffer), "arguments": arguments, "counters": counters}
    write_archive(file, {_STATE: {key: encode(value, key) for key, value in state.items()}}, arrays)


def read_buffer(archive: Archive, device: th.device | str) -> TeamReplayBuffer:
    """
    Read a replay buffer from a file of ``write_buffer``.

    :param archive: the file
    :param device: device of the samples
    :return: the buffer
    :raises InvalidFileError: if the file holds no valid replay buffer
    """
    state, path = archive.json(_STATE), archive.name
    if state.get("format") != _FORMAT:
        raise InvalidFileError(
            f"{path} holds no replay buffer of format {_FORMAT}.{archive.content() if not state else ''}"
        )
    cls, arguments, counters = (decode(state.get(key), f"{path}: {key}") for key in ("class", "arguments", "counters"))
    if not (isinstance(cls, type) and issubclass(cls, TeamReplayBuffer)):
        raise InvalidFileError(f"{path} holds a {shown(cls)}, but the model needs a TeamReplayBuffer.")
    if not isinstance(arguments, dict) or not isinstance(counters, dict):
        raise InvalidFileError(f"{path} is damaged: its arguments or counters have no names.")
    buffer = cls(**arguments, device=device)
    buffer.restore(counters, archive.arrays())
    return buffer


class SavesReplayBuffer(OffPolicyAlgorithm):
    """An algorithm whose replay buffer is a team's, and is saved and loaded without running code."""

    replay_buffer: TeamReplayBuffer

    def load_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        truncate_last_traj: bool = True,
        trust: bool | None = None,
    ) -> None:
        """
        Load a replay buffer from a file, like SB3's ``load_replay_buffer``, without running code from the file unless
        ``trust`` is set. The model's ``gamma`` and ``handle_timeout_termination`` apply from now on, whereas the
        buffer keeps its size.

        :param trust: also load a pickled buffer, which can run code; older versions write such files, see ``load``
        :raises ValueError: if the buffer is of another class, team, ``n_steps``, layout or number of environments, or
            is pickled and not trusted; the model keeps its buffer then
        """
        if isinstance(path, (str, os.PathLike)) and not pathlib.Path(path).suffix:
            path = f"{path}.pkl"  # as SB3 does
        present = self.replay_buffer
        try:
            with opened(path, "replay buffer") as file:
                if zipfile.is_zipfile(file):
                    self.replay_buffer = read_buffer(Archive(file, path), self.device)
                elif trusted(trust):
                    file.seek(0)
                    super().load_replay_buffer(file, truncate_last_traj)
                else:
                    raise not_ours(path, "is not a replay buffer")
            self._check_replay_buffer(self.replay_buffer, path)
            self.replay_buffer.gamma = self.gamma
            self.replay_buffer.handle_timeout_termination = present.handle_timeout_termination
        except BaseException:
            self.replay_buffer = present
            raise

    def _check_replay_buffer(self, buffer: ReplayBuffer, path: Any) -> None:
        if not isinstance(buffer, TeamReplayBuffer):
            raise InvalidFileError(f"{path} holds a {type(buffer).__name__}, but the model needs a TeamReplayBuffer.")
        n_pairs = self.replay_buffer_kwargs.get("n_pairs", 0)
        names = [cls.__name__ for cls in (type(buffer), cast(type, self.replay_buffer_class))]
        for what, loaded, needed in (
            ("transitions in a {}", *names),
            ("windows of n_steps={}", buffer.n_steps, self.n_steps),
            ("transitions with optimize_memory_usage={}", buffer.optimize_memory_usage, self.optimize_memory_usage),
            ("transitions of {} parallel environment(s)", buffer.n_envs, self.n_envs),
            ("observations of {}", buffer.observation_space, self.observation_space),
            ("actions of {}", buffer.action_space, self.action_space),
            ("rewards of {} neighbours of each agent", buffer.n_pairs, n_pairs),
            ("neighbours that change: {}", buffer.pairs_end, self.replay_buffer_kwargs.get("pairs_end", False)),
        ):
            if loaded != needed:
                raise InvalidFileError(
                    f"{path} holds {what.format(loaded)}, but the model needs {what.format(needed)}: resume with the "
                    "environment and arguments of the training that saved it, or without its replay buffer."
                )

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer as JSON and arrays. The file's suffix defaults to ``.pkl``, because rl_zoo3 looks for
        that, but nothing in it is pickled.

        :raises ValueError: if there is no replay buffer, or files may not name its class, see ``allow_in_files``
        """
        check_path(path)
        if not isinstance(self.replay_buffer, TeamReplayBuffer):
            raise InvalidArgumentError("There is no replay buffer to save.")
        if not isinstance(path, (str, os.PathLike)):
            return write_buffer(self.replay_buffer, path)
        with atomic_write(path, suffix="pkl") as file:
            write_buffer(self.replay_buffer, file)  # type: ignore[arg-type]
