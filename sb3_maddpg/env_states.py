"""States of environments as plain values, so that a training goes on from where it was.

An environment tells its state by ``state_dict()``, plain values and arrays, and takes it back by ``load_state_dict()``.
Those of Gymnasium that do not, but always do the same after the same seed and actions, do when they are wrapped in
``Replayable``. What wrappers keep, Gymnasium's and Stable-Baselines3's, is read and written here.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_maddpg.parallel import TeamEnv
from sb3_maddpg.typed_json import encode
from sb3_maddpg.vec_env import GymnasiumVecEnv

_BEFORE = ".before"


class NoStateError(ValueError):
    """An environment does not tell its state."""


class Replayable(gymnasium.Wrapper):
    """
    An environment that is brought back into a state by the seed and the actions of its episode. It has to do the same
    after the same seed and actions, and each episode gets a seed of its own.

    :param env: the environment
    """

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self._rng = np.random.default_rng()
        self._seed: int | None = None
        self._options: dict[str, Any] | None = None
        self._actions: list[Any] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self._seed, self._options, self._actions = int(self._rng.integers(2**31)), options, []
        return self.env.reset(seed=self._seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._actions.append(np.array(action))
        return self.env.step(action)

    def state_dict(self) -> dict[str, Any]:
        """:return: generator, seed and actions of the episode"""
        return {
            "generator": self._rng.bit_generator.state,
            "seed": self._seed,
            "options": self._options,
            "actions": np.array(self._actions),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """:param state: see ``state_dict``"""
        self._rng = np.random.default_rng()
        self._rng.bit_generator.state = state["generator"]
        self._seed, self._options = state["seed"], state["options"]
        self._actions = []
        if self._seed is not None:
            self.env.reset(seed=self._seed, options=self._options)
        for action in state["actions"]:
            self.step(action if action.ndim else action.item())


def vec_env_state(env: VecEnv) -> dict[str, Any]:
    """
    :param env: a vectorised environment, with its wrappers
    :return: its state, see ``load_vec_env_state``
    :raises NoStateError: part of it does not tell its state
    """
    own = {"class": type(env).__name__, "values": plain_values(env), **_written(env)}
    if isinstance(env, VecEnvWrapper):
        return {**own, "inner": vec_env_state(env.venv)}
    if isinstance(env, GymnasiumVecEnv):
        return {**own, "inner": _told(env.envs.unwrapped)}
    if isinstance(env, DummyVecEnv):
        return {**own, "inner": [_env_state(one) for one in env.envs]}
    raise NoStateError(f"{type(env).__name__} keeps its environments in other processes, which tell no state.")


def load_vec_env_state(env: VecEnv, state: dict[str, Any]) -> None:
    """
    :param env: an environment made as the one that told its state
    :param state: see ``vec_env_state``
    :raises ValueError: the state of another environment
    """
    _take(env, state)
    if isinstance(env, VecEnvWrapper):
        load_vec_env_state(env.venv, state["inner"])
    elif isinstance(env, GymnasiumVecEnv):
        env.envs.unwrapped.load_state_dict(state["inner"])  # type: ignore[attr-defined]
    else:
        assert isinstance(env, DummyVecEnv)
        for one, inner in zip(env.envs, state["inner"], strict=True):
            _load_env_state(one, inner)


def _told(env: Any) -> Any:
    if not hasattr(env, "state_dict") or not hasattr(env, "load_state_dict"):
        raise NoStateError(f"{type(env).__name__} has no state_dict() and load_state_dict().")
    return env.state_dict()


def _env_state(env: gymnasium.Env) -> dict[str, Any]:
    own = {"class": type(env).__name__}
    if isinstance(env, Replayable):  # what it replays goes through the wrappers inside, but not what they keep
        return {**own, "told": env.state_dict(), "layers": [_layer(one) for one in _layers(env.env)]}
    if "state_dict" in dir(type(env)):
        return {**own, "told": _told(env)}
    if isinstance(env, gymnasium.Wrapper):
        return {**_layer(env), "inner": _env_state(env.env)}
    if isinstance(env, TeamEnv):
        return {**own, "values": plain_values(env), "told": _told(env.parallel_env.unwrapped)}
    return {**own, "told": _told(env)}


def _load_env_state(env: gymnasium.Env, state: dict[str, Any]) -> None:
    _take(env, state)
    if "inner" in state:
        _load_env_state(env.env, state["inner"])  # type: ignore[attr-defined]
    else:
        told: Any = env.parallel_env.unwrapped if isinstance(env, TeamEnv) else env
        told.load_state_dict(state["told"])
    if isinstance(env, Replayable):
        for one, layer in zip(_layers(env.env), state["layers"], strict=True):
            _take(one, layer)


def _layers(env: gymnasium.Env) -> list[gymnasium.Env]:
    """The wrappers around an environment, the outermost first."""
    return [env, *_layers(env.env)] if isinstance(env, gymnasium.Wrapper) else []


def _layer(env: gymnasium.Env) -> dict[str, Any]:
    return {"class": type(env).__name__, "values": plain_values(env), **_written(env)}


def _take(owner: Any, state: dict[str, Any]) -> None:
    if state["class"] != type(owner).__name__:
        raise ValueError(f"The state is of a {state['class']}, this is a {type(owner).__name__}.")
    set_plain_values(owner, state.get("values", {}))
    if "written" in state and (writer := getattr(owner, "results_writer", None)) is not None:
        _write_again(Path(writer.file_handler.name), writer.file_handler, state["written"])


def _written(monitor: Any) -> dict[str, int]:
    """How far a monitor's file has come."""
    writer = getattr(monitor, "results_writer", None)
    if writer is None:
        return {}
    writer.file_handler.flush()
    return {"written": os.stat(writer.file_handler.fileno()).st_size}


def _write_again(path: Path, file: Any, size: int) -> None:
    """The rows that a monitor had written, which a new one has begun to overwrite, see ``put_aside``."""
    before = Path(f"{path}{_BEFORE}")
    if before.is_file():
        file.seek(0)
        file.truncate()
        file.write(before.read_bytes()[:size].decode())
        file.flush()
        before.unlink()


def put_aside(folder: Path) -> None:
    """
    Keep the monitors' files of an earlier part of a run from being overwritten, until its state is loaded.

    :param folder: of the run
    """
    for path in folder.glob("*monitor.csv"):
        if not (before := Path(f"{path}{_BEFORE}")).exists():  # else this part was killed too before it went on
            path.rename(before)


# What is no state, or is told elsewhere
_NOT_STATE = {"metadata", "render_mode", "spec", "class_attributes", "t_start", "num_envs", "n_envs"}
_NOT_STATE |= {"model", "parent", "locals", "globals", "logger", "training_env", "eval_env", "callback", "callbacks"}


def plain_values(owner: Any) -> dict[str, Any]:
    """
    :param owner: a wrapper, a callback
    :return: those of its attributes that are plain values, arrays or lists of them, by name
    """
    kinds = (spaces.Space, type)
    return plain_entries(
        {name: value for name, value in vars(owner).items() if name not in _NOT_STATE and not isinstance(value, kinds)}
    )


def plain_entries(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param values: by name
    :return: those that can be written to a file
    """
    found = {}
    for name, value in values.items():
        try:
            encode(value, name, {})
        except ValueError:
            continue
        found[name] = value
    return found


def set_plain_values(owner: Any, values: dict[str, Any]) -> None:
    """
    :param owner: of the same class as the one that had them
    :param values: see ``plain_values``
    """
    for name, value in values.items():
        setattr(owner, name, value)


def tells_state(env: gymnasium.Env) -> bool:
    """
    :param env: an environment, with its wrappers
    :return: whether it tells its state
    """
    inner: Any = env.unwrapped
    inner = inner.parallel_env.unwrapped if isinstance(inner, TeamEnv) else inner
    return hasattr(inner, "state_dict") and hasattr(inner, "load_state_dict")


def space_generators(space: spaces.Space) -> list[dict[str, Any] | None]:
    """
    :param space: a space
    :return: the states of its random generators and its parts', None for one that was not used yet
    """
    return [None if one._np_random is None else dict(one._np_random.bit_generator.state) for one in _parts(space)]


def set_space_generators(space: spaces.Space, states: list[dict[str, Any] | None]) -> None:
    """
    :param space: a space like the one that had them
    :param states: see ``space_generators``
    """
    for one, state in zip(_parts(space), states, strict=True):
        if state is not None:
            one.np_random.bit_generator.state = state


def _parts(space: spaces.Space) -> Iterator[spaces.Space]:
    yield space
    inner: Any = getattr(space, "agent_spaces", None) or getattr(space, "spaces", ())
    for one in inner.values() if isinstance(inner, dict) else inner:
        yield from _parts(one)
