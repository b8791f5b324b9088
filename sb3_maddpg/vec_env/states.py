"""States of environments as plain values, so that training can resume in the middle of an episode.

An environment returns its state, plain values and arrays, from ``state_dict()`` and restores it with
``load_state_dict()``. The wrapper ``Replayable`` adds both methods to Gymnasium environments that are deterministic
given the seed and the actions. This module also saves and restores the state of Gymnasium's and Stable-Baselines3's
wrappers.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_maddpg.errors import InvalidFileError, NoStateError
from sb3_maddpg.files.typed_json import encode
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.utils import arguments_of, shown
from sb3_maddpg.vec_env.border import Transparent
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.normalize import TeamVecNormalize

_BEFORE = ".before"
# Largest integers in the states of NumPy's generators, by name
_LARGEST = {"pos": 624, "buffer_pos": 4, "has_uint32": 1, "has_gauss": 1, "uinteger": 2**32 - 1}


class Replayable(gymnasium.Wrapper):
    """
    Wrapper that restores a state by replaying the seed and the actions of the episode. The environment must be
    deterministic given both. Each episode gets its own seed.

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
        """:return: the random number generator's state, and seed, options and actions of the episode"""
        return {
            "generator": self._rng.bit_generator.state,
            "seed": self._seed,
            "options": self._options,
            "actions": np.array(self._actions),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: see ``state_dict``
        :raises ValueError: if the state does not fit, or has more actions than its episode has steps
        """
        bits = np.random.default_rng().bit_generator
        bits.state = checked_bits(state["generator"], bits.state)
        seed, options, actions = state["seed"], state["options"], state["actions"]
        if not (seed is None or (type(seed) is int and 0 <= seed < 2**31)) or not isinstance(
            options, (dict, type(None))
        ):
            raise InvalidFileError(f"No episode begins with seed={shown(seed)}, options={shown(options)}.")
        shape = self.action_space.shape
        # Before the first step, the array of actions is empty and has no other axis
        if not isinstance(actions, np.ndarray) or not (actions.size == 0 or actions.shape[1:] == shape):
            raise InvalidFileError(f"{shown(actions)} are no actions of {shown(self.action_space)}.")
        self._rng, self._seed, self._options, self._actions = np.random.Generator(bits), seed, options, []
        if seed is not None:
            self.env.reset(seed=seed, options=options)
        ended = seed is None
        for action in actions:
            if ended:
                raise InvalidFileError(
                    f"The state has {len(actions)} actions, but its episode ends before the last of them."
                )
            *_, terminated, truncated, _ = self.step(action if action.ndim else action.item())
            ended = terminated or truncated


def vec_env_state(env: VecEnv) -> dict[str, Any]:
    """
    :param env: a vectorised environment, with its wrappers
    :return: the environment's state, see ``load_vec_env_state``
    :raises NoStateError: if a part of the environment does not provide its state
    """
    own = {"class": _class_name(env), "values": plain_values(env), **_written(env)}
    if isinstance(env, VecEnvWrapper):
        return {**own, "inner": vec_env_state(env.venv)}
    if isinstance(env, GymnasiumVecEnv):
        return {**own, "inner": _told(env.envs.unwrapped)}
    if isinstance(env, DummyVecEnv):
        return {**own, "inner": [_env_state(one) for one in env.envs]}
    raise NoStateError(
        f"{type(env).__name__} runs its environments in other processes, which do not provide their state."
    )


def load_vec_env_state(env: VecEnv, state: dict[str, Any]) -> None:
    """
    Restore the state of a vectorised environment.

    :param env: an environment created like the one whose state was saved
    :param state: see ``vec_env_state``
    :raises ValueError: if the state belongs to another environment
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
        raise NoStateError(
            f"{type(env).__name__} has no state_dict() and load_state_dict(): if it is deterministic, train with "
            "--checkpoint-every STEPS, or in Python in sb3_maddpg.vec_env.Replayable."
        )
    return env.state_dict()


def fingerprint(env: VecEnv) -> str:
    """
    :param env: a vectorised environment, with its wrappers
    :return: digest of the plain values and random number generators of all that it consists of in this process, from
        which one sees whether somebody has stepped or reset it
    """
    digest = hashlib.sha256()
    for one in layers(env):
        for name, value in vars(one).items():
            if isinstance(value, np.random.Generator):
                value = value.bit_generator.state
            if name in _NOT_STATE or name == "_seeds":  # which VecEnv.seed() sets for the next reset
                continue
            arrays: dict[str, np.ndarray] = {}
            with suppress(ValueError):
                digest.update(json.dumps([name, encode(value, name, arrays)]).encode())
                for array in arrays.values():
                    digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def shares_an_env(env: VecEnv, other: Any) -> bool:
    """:return: whether two environments step the same one"""
    stepped = {id(one) for one in layers(env) if hasattr(one, "step")}
    return any(id(one) in stepped for one in layers(other))


def _env_state(env: gymnasium.Env) -> dict[str, Any]:
    if isinstance(env, Transparent):  # has no state
        return _env_state(env.env)
    own = {"class": type(env).__name__}
    if isinstance(env, Replayable):  # replaying does not restore all attributes of inner wrappers
        return {**own, "told": env.state_dict(), "layers": [_layer(one) for one in _layers(env.env)]}
    if "state_dict" in dir(type(env)):
        return {**own, "told": _told(env)}
    if isinstance(env, gymnasium.Wrapper):
        return {**_layer(env), "inner": _env_state(env.env)}
    if isinstance(env, TeamEnv):
        return {**own, "values": plain_values(env), "told": _told(env.parallel_env.unwrapped)}
    return {**own, "told": _told(env)}


def _load_env_state(env: gymnasium.Env, state: dict[str, Any]) -> None:
    if isinstance(env, Transparent):
        return _load_env_state(env.env, state)
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
    """:return: the wrappers around an environment, outermost first"""
    if not isinstance(env, gymnasium.Wrapper):
        return []
    return [*([] if isinstance(env, Transparent) else [env]), *_layers(env.env)]


def _layer(env: gymnasium.Env) -> dict[str, Any]:
    return {"class": type(env).__name__, "values": plain_values(env), **_written(env)}


def _class_name(owner: Any) -> str:
    """:return: the name under which states are written; a plain ``VecNormalize`` changes its class in training"""
    return VecNormalize.__name__ if type(owner) is TeamVecNormalize else type(owner).__name__


def _take(owner: Any, state: dict[str, Any]) -> None:
    if state["class"] != _class_name(owner):
        raise InvalidFileError(f"The state belongs to a {state['class']}, but this is a {_class_name(owner)}.")
    set_plain_values(owner, _for_each_env(owner, state.get("values", {})))
    if "written" in state and (writer := getattr(owner, "results_writer", None)) is not None:
        _write_again(Path(writer.file_handler.name), writer.file_handler, state["written"])


def _written(monitor: Any) -> dict[str, int]:
    """:return: the size of a monitor's file, if there is one"""
    writer = getattr(monitor, "results_writer", None)
    if writer is None:
        return {}
    writer.file_handler.flush()
    return {"written": os.stat(writer.file_handler.fileno()).st_size}


def _write_again(path: Path, file: Any, size: int) -> None:
    """Restore the rows of a monitor's file, which a new monitor has begun to overwrite, see ``put_aside``."""
    before = Path(f"{path}{_BEFORE}")
    if before.is_file():
        file.seek(0)
        file.truncate()
        file.write(before.read_bytes()[:size].decode())
        file.flush()
        before.unlink()


def put_aside(folder: Path) -> None:
    """
    Rename the monitor files of an interrupted run, so that new monitors do not overwrite them before its state is
    loaded.

    :param folder: folder of the run
    """
    for path in folder.glob("*monitor.csv"):
        if not (before := Path(f"{path}{_BEFORE}")).exists():  # otherwise a previous attempt to resume was killed
            path.rename(before)


# Attributes that are not state, or are saved elsewhere
_NOT_STATE = {"metadata", "render_mode", "spec", "class_attributes", "t_start", "num_envs", "n_envs"}
_NOT_STATE |= {"model", "parent", "locals", "globals", "logger", "training_env", "eval_env", "callback", "callbacks"}
_NOT_STATE |= {"callback_on_new_best"}
# Where files are written follows from the command, since a run may be moved or copied
_NOT_STATE |= {"log_path", "best_model_save_path", "save_path", "name_prefix", "folder", "log_dir"}


def plain_values(owner: Any) -> dict[str, Any]:
    """
    :param owner: a wrapper or a callback
    :return: the attributes that are plain values, arrays, or lists of them, by name
    """
    kinds = (spaces.Space, type)
    return plain_entries(
        {name: value for name, value in vars(owner).items() if name not in _NOT_STATE and not isinstance(value, kinds)}
    )


def plain_entries(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param values: values by name
    :return: the values that can be written to a file
    """
    found = {}
    for name, value in values.items():
        try:
            encode(value, name, {})
        except ValueError:
            continue
        found[name] = value
    return found


# What SB3's vectorised environment overwrites in every step
_SCRATCH = {"keys", "buf_obs", "buf_dones", "buf_rews", "buf_infos", "actions"}


def _for_each_env(owner: Any, values: dict[str, Any]) -> dict[str, Any]:
    """
    :param owner: a vectorised environment, or anything else
    :param values: values that it should take on
    :return: those that it does not overwrite anyway
    :raises ValueError: if a list or an array does not have one entry for each environment, as it has now
    """
    if isinstance(owner, DummyVecEnv):
        values = {name: value for name, value in values.items() if name not in _SCRATCH}
    if not isinstance(owner, VecEnv):
        return values
    for name, value in values.items():
        present = vars(owner).get(name)
        kinds = {type(one) for one in present} if isinstance(present, list) and name != "_seeds" else set()
        fits = True
        if isinstance(present, np.ndarray) and len(np.atleast_1d(present)) == owner.num_envs:
            # Their precision may change with the first step
            fits = isinstance(value, np.ndarray) and value.shape == present.shape
            fits = fits and value.dtype.kind == present.dtype.kind
        elif isinstance(present, list) and len(present) == owner.num_envs:
            fits = isinstance(value, list) and len(value) == len(present)
            fits = fits and (len(kinds) != 1 or all(type(one) in kinds for one in value))
        if not fits:
            raise InvalidFileError(f"{shown(value)} cannot be the {name} of a {type(owner).__name__}.")
    return values


def set_plain_values(owner: Any, values: dict[str, Any]) -> None:
    """
    Set attributes.

    :param owner: a wrapper or a callback of the same class as the one that was saved
    :param values: see ``plain_values``
    :raises ValueError: if a value would replace a method, a property, or a value of another kind
    """
    of_class = type(owner)
    for name, value in values.items():
        if name in _NOT_STATE:
            continue
        present = vars(owner).get(name)  # may be set only later in training
        of_all = getattr(of_class, name, None)
        fits = _same_kind(present, value)
        if value is None and isinstance(present, (int, float)):  # arguments remain numbers
            fits = name.lstrip("_") not in arguments_of(of_class)
        if callable(of_all) or hasattr(of_all, "__set__") or not fits:
            raise InvalidFileError(f"{shown(value)} cannot be the {name} of a {of_class.__name__}.")
        if isinstance(present, deque) and isinstance(value, deque):  # the length follows from an argument
            value = deque(value, present.maxlen)
        setattr(owner, name, value)


def _same_kind(present: Any, value: Any) -> bool:
    if isinstance(value, int) and abs(value) >= 2**63:  # no counter of NumPy or C
        return False
    if present is None or value is None:
        return True
    if isinstance(value, bool) and not isinstance(present, (bool, np.bool_)):
        return False
    kinds = ((bool, np.bool_), (int, float, np.number), (list, tuple, deque, np.ndarray), dict, str)
    if isinstance(present, RunningMeanStd):
        return isinstance(value, RunningMeanStd) and _usable(value, present)
    return isinstance(value, next((kind for kind in kinds if isinstance(present, kind)), type(present)))


def _usable(given: RunningMeanStd, present: RunningMeanStd) -> bool:
    """:return: whether statistics can replace others: of the same shape, finite, and counted"""
    for name in ("mean", "var", "count"):
        one: Any = getattr(given, name, None)
        other = getattr(present, name)
        numbers = isinstance(one, (int, float, np.number, np.ndarray)) and not isinstance(one, bool)
        # The counts of agents may be one number before the first step
        if not numbers or (np.shape(one) != np.shape(other) and name != "count") or not np.isfinite(one).all():
            return False
    shapes = ((), np.shape(present.mean))
    return np.shape(given.count) in shapes and bool((np.asarray(given.var) >= 0).all() and np.all(given.count >= 0))


def tells_state(env: gymnasium.Env) -> bool:
    """
    :param env: an environment, with its wrappers
    :return: whether it provides its state
    """
    inner: Any = env.unwrapped
    inner = inner.parallel_env.unwrapped if isinstance(inner, TeamEnv) else inner
    return hasattr(inner, "state_dict") and hasattr(inner, "load_state_dict")


def layers(env: Any) -> Iterator[Any]:
    """
    Yield all that an environment in this process consists of: wrappers, copies, and what adapters hold.

    :param env: an environment of any kind
    """
    found: dict[int, Any] = {}
    waiting = [env]
    while waiting:
        one = waiting.pop()
        if id(one) in found or not hasattr(one, "__dict__"):
            continue
        found[id(one)] = one
        yield one
        for held in map(vars(one).get, ("venv", "env", "parallel_env", "envs")):
            waiting += held if isinstance(held, (list, tuple)) else [held]


def checked_bits(state: Any, own: Mapping[str, Any]) -> dict[str, Any]:
    """
    Check the state of a random number generator. NumPy does not: a position outside of a generator's memory would end
    the process.

    :param state: state of a bit generator, from a file
    :param own: the present state of the generator that it replaces
    :return: the state
    :raises ValueError: if it belongs to another class of generators, or a part has another type or is out of range
    """

    def fits(one: Any, own: Any, name: str) -> bool:
        if isinstance(own, dict):
            return (
                isinstance(one, Mapping) and set(one) == set(own) and all(fits(one[key], own[key], key) for key in own)
            )
        if isinstance(own, np.ndarray):
            return isinstance(one, np.ndarray) and (one.shape, one.dtype) == (own.shape, own.dtype)
        if isinstance(own, float):
            return isinstance(one, float) and math.isfinite(one)
        if isinstance(own, str):
            return isinstance(one, str) and one == own
        integer = isinstance(one, (int, np.integer)) and not isinstance(one, bool)
        return integer and 0 <= one <= _LARGEST.get(name, 2**128 - 1)

    if not fits(state, own, "state"):
        raise InvalidFileError(f"{shown(state)} is not a state of the random number generator {own['bit_generator']}.")
    return dict(state)


def space_generators(space: spaces.Space) -> list[dict[str, Any] | None]:
    """
    :param space: a space
    :return: states of the random number generators of the space and its parts, None for unused generators
    """
    return [None if one._np_random is None else dict(one._np_random.bit_generator.state) for one in _parts(space)]


def set_space_generators(space: spaces.Space, states: list[dict[str, Any] | None]) -> None:
    """
    Restore random number generators.

    :param space: a space like the one that was saved
    :param states: see ``space_generators``
    """
    for one, state in zip(_parts(space), states, strict=True):
        if state is not None:
            bits = one.np_random.bit_generator
            bits.state = checked_bits(state, bits.state)


def _parts(space: spaces.Space) -> Iterator[spaces.Space]:
    yield space
    inner: Any = getattr(space, "agent_spaces", None) or getattr(space, "spaces", ())
    for one in inner.values() if isinstance(inner, dict) else inner:
        yield from _parts(one)
