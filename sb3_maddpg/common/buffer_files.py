"""Files of replay buffers: JSON and arrays, which run no code when they are loaded."""

from __future__ import annotations

import io
import json
import math
import os
import pathlib
import zipfile
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError, UntrustedFileError
from sb3_maddpg.files.model_files import as_damage, check_not_compressed, check_path, trusted
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.utils import atomic_write, shown

_FORMAT = 1
_STATE = "buffer.json"
_MOST_JSON = 2**24  # bytes


def write_buffer(buffer: TeamReplayBuffer, file: io.BufferedIOBase) -> None:
    """
    Write a replay buffer to a file.

    :param buffer: a team's replay buffer
    :param file: binary file to write to
    :raises ValueError: if files may not name the buffer's class, see ``allow_in_files``
    """
    arguments, counters, arrays = buffer.contents()
    state = {"format": _FORMAT, "class": type(buffer), "arguments": arguments, "counters": counters}
    with zipfile.ZipFile(cast(Any, file), "w") as archive:
        archive.writestr(_STATE, json.dumps({key: encode(value, key) for key, value in state.items()}))
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def is_buffer_file(path: Any) -> bool:
    """
    :param path: path of a file, or an open file
    :return: whether ``write_buffer`` may have written the file, rather than pickle
    """
    found = zipfile.is_zipfile(path)
    if not isinstance(path, (str, os.PathLike)):
        path.seek(0)
    return found


def read_buffer(path: str | pathlib.Path | io.BufferedIOBase, device: th.device | str) -> TeamReplayBuffer:
    """
    Read a replay buffer from a file of ``write_buffer``.

    :param path: path of the file, or the open file
    :param device: device of the samples
    :return: the buffer
    :raises ValueError: if the file holds no valid replay buffer
    """
    with zipfile.ZipFile(cast(Any, path)) as archive:
        members = {member.filename: member for member in archive.infolist()}
        if _STATE not in members or len(members) < len(archive.infolist()) or members[_STATE].file_size > _MOST_JSON:
            raise InvalidFileError(f"{path} holds no replay buffer of sb3-maddpg.")
        check_not_compressed(path, archive)
        state = json.loads(archive.read(_STATE))
        if not isinstance(state, dict) or state.get("format") != _FORMAT:
            raise InvalidFileError(f"{path} holds no replay buffer of format {_FORMAT}.")
        cls, arguments, counters = (
            decode(state.get(key), f"{path}: {key}") for key in ("class", "arguments", "counters")
        )
        if not (isinstance(cls, type) and issubclass(cls, TeamReplayBuffer)):
            raise InvalidFileError(f"{path} holds a {shown(cls)}, but the model needs a TeamReplayBuffer.")
        if not isinstance(arguments, dict) or not isinstance(counters, dict):
            raise InvalidFileError(f"{path} is damaged: its arguments or counters have no names.")
        buffer = cls(**arguments, device=device)
        arrays = {name: _read_array(archive, member) for name, member in members.items() if name != _STATE}
        buffer.restore(counters, {name.removesuffix(".npy"): array for name, array in arrays.items()})
    return buffer


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read an array after checking that its header fits the file's size."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize + file.tell() != member.file_size:
            raise InvalidFileError(
                f"{member.filename} has {member.file_size} bytes, not an array of {dtype} and shape {shape}."
            )
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


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
        check_path(path)
        if isinstance(path, (str, os.PathLike)) and not pathlib.Path(path).suffix:
            path = f"{path}.pkl"  # as SB3 does
        present = self.replay_buffer
        try:
            with as_damage(path, "replay buffer"):
                if is_buffer_file(path):
                    self.replay_buffer = read_buffer(path, self.device)
                elif trusted(trust):
                    super().load_replay_buffer(path, truncate_last_traj)
                else:
                    raise UntrustedFileError(
                        f"{path} is not a replay buffer that this version writes. If it is pickled, it may run any "
                        "code when it is loaded: if you trust its author, load it with `trust=True` (on the "
                        "command line `--trust`)."
                    )
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
