"""The state of a training that is not in its model's file: captured, checked, restored."""

from __future__ import annotations

import hashlib
import json
import math
import random
import warnings
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch as th
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
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.checkpoints.fingerprints import fingerprint
from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
from sb3_maddpg.common.evaluation import TeamEvalCallback
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError, NoStateError
from sb3_maddpg.files.typed_json import encode
from sb3_maddpg.utils import arguments_of, shown
from sb3_maddpg.vec_env.states import (
    checked_bits,
    load_vec_env_state,
    plain_entries,
    plain_values,
    set_plain_values,
    set_space_generators,
    space_generators,
    vec_env_state,
)

FORMAT = 2
_LAST = ("_last_obs", "_last_original_obs", "_last_episode_starts")
_LOGGED = ("name_to_value", "name_to_count", "name_to_excluded")
# What training changes in callbacks whose arguments it does not change, beside the number of their calls
KEPT: dict[type[BaseCallback], tuple[str, ...]] = {
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
KEPT[TeamEvalCallback] = (*KEPT[EvalCallback], "best_value", "agent_results", "agent_lengths")
_CALLS, _TOLD = "n_calls", "state_dict"


def state_of(
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
        values = {"values": {**values_of(one), **_told(one)}, "at_start": began}
        states.append({"class": type(one).__name__, **values, "eval_env": evaluation})
    return {
        "format": FORMAT,
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


def restore(model: TeamAlgorithm, callbacks: list[BaseCallback], state: dict[str, Any]) -> None:
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


def _checked_last(model: TeamAlgorithm, name: str, value: Any) -> Any:
    """:return: an array of the last observations, or whether they begin episodes, if it fits the environment"""
    present: Any = model._last_episode_starts if name == "_last_episode_starts" else model._last_obs
    if value is None and name == "_last_original_obs" and model._vec_normalize_env is None:  # before the first step
        return value
    if not isinstance(value, np.ndarray) or value.shape != np.shape(present):
        raise InvalidFileError(f"A checkpoint is damaged: its {name} is {shown(value)}.")
    return value


def check_values(state: dict[str, Any]) -> None:
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


def callbacks_in(root: BaseCallback) -> list[BaseCallback]:
    """:return: a callback and all callbacks inside it, without lists, which have no state of their own"""
    inner: list[BaseCallback | None] = []
    if isinstance(root, CallbackList):
        inner = [*root.callbacks]
    elif isinstance(root, EventCallback):
        inner = [root.callback, getattr(root, "callback_on_new_best", None)]
    own = [] if type(root) is CallbackList else [root]
    return [*own, *(one for callback in inner if callback is not None for one in callbacks_in(callback))]


def _tells_state(callback: BaseCallback) -> bool:
    """:return: whether a callback decides itself what checkpoints hold of it"""
    return all(callable(getattr(type(callback), name, None)) for name in (_TOLD, "load_state_dict"))


def values_of(callback: BaseCallback) -> dict[str, Any]:
    """:return: the values of a callback that checkpoints hold, except what it tells itself"""
    if _tells_state(callback):
        return {_CALLS: callback.n_calls}
    names = KEPT.get(type(callback))
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
    names = KEPT.get(type(callback))
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


def _random_state() -> dict[str, Any]:
    version, numbers, gauss = random.getstate()
    cuda = [one.numpy() for one in th.cuda.get_rng_state_all()] if th.cuda.is_available() else []
    return {
        "python": [version, list(numbers), gauss],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - what SB3 draws from
        "torch": th.get_rng_state().numpy(),
        "cuda": cuda,
    }


def check_random_state(state: dict[str, Any]) -> None:
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
