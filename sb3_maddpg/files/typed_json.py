"""Typed JSON for the values of models. Reading it runs no code and imports nothing that a file names."""

from __future__ import annotations

import base64
import binascii
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import buffers, utils
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.files.archive import DEEPEST, LARGEST_ARRAY, MOST_AGENTS, MOST_REPEATED
from sb3_maddpg.files.registry import class_in_files, name_in_files
from sb3_maddpg.utils import shown, suggest

Json = Any
_TYPE = "$"
_SMALL = 64  # arrays with more numbers may be stored outside the JSON

_Item = TypeVar("_Item")


def encode(value: Any, name: str, arrays: dict[str, np.ndarray] | None = None) -> Json:
    """
    Convert a value to typed JSON.

    :param value: value of a model
    :param name: name of the value, for error messages
    :param arrays: receives larger arrays, which the JSON then only refers to; by default the JSON holds them
    :return: the value as JSON
    :raises ValueError: if the value cannot be written
    """
    return _encode(value, name, 0, arrays)


def decode(value: Json, name: str, arrays: Mapping[str, np.ndarray] | None = None) -> Any:
    """
    Convert typed JSON back to a value.

    :param value: JSON from ``encode``, or from an untrusted file
    :param name: name of the value, for error messages
    :param arrays: arrays that ``encode`` stored outside the JSON
    :return: the value
    :raises ValueError: if the JSON names an unknown type or class, does not fit its type, or would be much larger in
        memory
    """
    check_size(value, name)
    try:
        return _decode(value, 0, arrays or {})
    except (
        TypeError,
        KeyError,
        AttributeError,
        AssertionError,
        OverflowError,
        binascii.Error,
        RecursionError,
    ) as error:
        raise InvalidFileError(f"{name} is damaged ({type(error).__name__}: {shown(str(error))}).") from error
    except ValueError as error:  # Gymnasium's have several lines
        raise InvalidFileError(f"{name} is damaged: {' '.join(str(error).split())}") from error


def check_size(value: Json, name: str) -> None:
    """
    Check the size in memory of arrays of which only one value is written.

    :param value: JSON, or a collection of JSON
    :param name: name of the value, for error messages
    :raises ValueError: if these arrays are larger than those of any model
    """
    repeated, parts = 0, [value]
    while parts:
        part = parts.pop()
        if isinstance(part, dict):
            shape = part.get("shape")
            if part.get("repeated") and isinstance(shape, list) and all(isinstance(one, int) for one in shape):
                repeated += abs(math.prod(shape))
            parts.extend(part.values())
        elif isinstance(part, list):
            parts.extend(part)
    if repeated > MOST_REPEATED:
        raise InvalidFileError(f"{name} is damaged: it has arrays of {repeated} repeated numbers.")


class _Codec(NamedTuple):
    """Functions that write and read values of a type. Both take a function for the value's parts."""

    type: type
    write: Callable[[Any, Callable[[Any], Json]], dict[str, Json]]
    read: Callable[[Mapping[str, Json], Callable[[Json], Any]], Any]


def _write_array(array: np.ndarray, part: Callable[[Any], Json]) -> dict[str, Json]:
    if array.dtype.kind not in "biuf":
        raise InvalidArgumentError(f"has an array of {array.dtype}, which is not a numeric type")
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    header = {"dtype": array.dtype.str.lstrip("<>=|"), "shape": list(array.shape)}
    first = little.ravel()[:1]
    if array.size > 1 and little.tobytes() == first.tobytes() * array.size:
        little = first
        header["repeated"] = True
    return header | {"base64": base64.b64encode(little.tobytes()).decode()}


def _read_array(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> np.ndarray:
    dtype, shape = np.dtype(f"<{entry['dtype']}"), entry["shape"]
    if dtype.kind not in "biuf":
        raise InvalidFileError(f"it has an array of {shown(entry['dtype'])}")
    if not all(isinstance(length, int) and length >= 0 for length in shape) or math.prod(shape) > LARGEST_ARRAY:
        raise InvalidFileError(
            f"it has an array of shape {shown(shape)}, which is invalid or has more than {LARGEST_ARRAY} numbers"
        )
    values = np.frombuffer(base64.b64decode(entry["base64"], validate=True), dtype)
    if entry.get("repeated", False):
        (value,) = values
        return np.full(shape, value, dtype.newbyteorder("="))
    return values.reshape(shape).astype(dtype.newbyteorder("="))


def write_box(space: spaces.Box, part: Callable[[Any], Json]) -> dict[str, Json]:
    """:return: bounds of a space as JSON, see ``add_codec``"""
    return {"low": part(space.low), "high": part(space.high)}


def read_box(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> spaces.Box:
    """:return: a space of these bounds, see ``add_codec``"""
    low, high = part(entry["low"]), part(entry["high"])
    return spaces.Box(low, high, dtype=low.dtype.type)


def _read_discrete(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> spaces.Discrete:
    dtype = {} if entry.get("dtype", "int64") == "int64" else {"dtype": entry["dtype"]}  # older files have none
    return spaces.Discrete(entry["n"], start=entry["start"], **dtype)


def _read_multi_discrete(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> spaces.MultiDiscrete:
    nvec = part(entry["nvec"])
    return spaces.MultiDiscrete(nvec, nvec.dtype, start=part(entry["start"]))


def few(agents: Sequence[_Item]) -> Sequence[_Item]:
    """
    :param agents: what a file holds for each agent, or each part of a space
    :return: the same
    :raises ValueError: if there are more than any team has
    """
    if len(agents) > MOST_AGENTS:
        raise InvalidFileError(f"it has {len(agents)} agents or parts of a space, more than {MOST_AGENTS}")
    return agents


def _object_of(entry: Mapping[str, Json], part: Callable[[Json], Any]) -> Any:
    cls = class_in_files(entry["class"])
    if issubclass(cls, (th.nn.Module, th.optim.Optimizer, buffers.BaseBuffer)):
        raise InvalidFileError(f"it has an instance of {cls.__name__}")
    made = cls.__new__(cls)
    vars(made).update({str(key): part(one) for key, one in entry["attributes"].items()})
    return made


_CODECS: dict[str, _Codec] = {
    "tuple": _Codec(tuple, lambda v, part: {"items": [*map(part, v)]}, lambda e, part: tuple(map(part, e["items"]))),
    "deque": _Codec(
        deque,
        lambda v, part: {"items": [*map(part, v)], "maxlen": v.maxlen},
        lambda e, part: deque(map(part, e["items"]), e["maxlen"]),
    ),
    "dict": _Codec(
        dict,
        lambda v, part: {"items": [[part(key), part(one)] for key, one in v.items()]},
        lambda e, part: {part(key): part(one) for key, one in e["items"]},
    ),
    "array": _Codec(np.ndarray, _write_array, _read_array),
    "number": _Codec(
        np.generic, lambda v, part: _write_array(np.asarray(v), part), lambda e, part: _read_array(e, part)[()]
    ),
    "float": _Codec(float, lambda v, part: {"value": str(v)}, lambda e, part: float(e["value"])),
    "Box": _Codec(spaces.Box, write_box, read_box),
    "Discrete": _Codec(
        spaces.Discrete,
        lambda v, part: {"n": int(v.n), "start": int(v.start), "dtype": str(v.dtype)},
        _read_discrete,
    ),
    "MultiDiscrete": _Codec(
        spaces.MultiDiscrete,
        lambda v, part: {"nvec": part(v.nvec), "start": part(v.start)},
        _read_multi_discrete,
    ),
    "MultiBinary": _Codec(
        spaces.MultiBinary,
        lambda v, part: {"n": part(v.n if isinstance(v.n, int) else list(map(int, v.shape)))},
        lambda e, part: spaces.MultiBinary(_sizes(e["n"])),
    ),
    "Dict": _Codec(
        spaces.Dict,
        lambda v, part: {"spaces": [[key, part(one)] for key, one in v.spaces.items()]},
        lambda e, part: spaces.Dict([(key, part(one)) for key, one in few(e["spaces"])]),
    ),
    "Tuple": _Codec(
        spaces.Tuple,
        lambda v, part: {"spaces": [*map(part, v.spaces)]},
        lambda e, part: spaces.Tuple([*map(part, few(e["spaces"]))]),
    ),
    "dtype": _Codec(th.dtype, lambda v, part: {"name": str(v)}, lambda e, part: _torch_dtype(e["name"])),
}


_KINDS = {codec.type: kind for kind, codec in _CODECS.items()}


def add_codec(
    kind: str,
    cls: type,
    write: Callable[[Any, Callable[[Any], Json]], dict[str, Json]],
    read: Callable[[Mapping[str, Json], Callable[[Json], Any]], Any],
) -> None:
    """
    Define how files hold instances of a class and of its subclasses.

    :param kind: how files name the type
    :param cls: the class
    :param write: returns an instance as JSON, by means of a function for its parts
    :param read: returns an instance from this JSON, which may be of an untrusted file, likewise
    """
    _CODECS[kind] = _Codec(cls, write, read)
    _KINDS[cls] = kind


def _sizes(n: Any) -> Any:
    if math.prod(n if isinstance(n, list) else [n]) > LARGEST_ARRAY:
        raise InvalidFileError(f"it has a space of {shown(n)} bits")
    return n


def _torch_dtype(name: str) -> th.dtype:
    dtype = getattr(th, name.removeprefix("torch."), None)
    if not isinstance(dtype, th.dtype):
        raise InvalidFileError(f"{shown(name)} is not a PyTorch dtype")
    return dtype


def _encode_special(value: Any, arrays: dict[str, np.ndarray] | None) -> Json:
    """:return: the JSON of arrays stored outside, of classes and of ``TrainFreq``, None for other values"""
    if arrays is not None and isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size > _SMALL:
        arrays[key := str(len(arrays))] = value
        return {_TYPE: "outside", "key": key}
    if isinstance(value, TrainFreq):
        return {_TYPE: "TrainFreq", "frequency": value.frequency, "unit": value.unit.value}
    if isinstance(value, type) and (name := name_in_files(value)) is not None:
        return {_TYPE: "class", "name": name}
    return None


def _is_json(value: Any) -> bool:
    return value is None or type(value) in (bool, int, str) or (type(value) is float and math.isfinite(value))


def _encode(value: Any, name: str, depth: int, arrays: dict[str, np.ndarray] | None = None) -> Json:
    def part(one: Any) -> Json:
        return _encode(one, name, depth + 1, arrays)

    if depth > DEEPEST:
        raise InvalidArgumentError(f"{name} cannot be saved: it is nested more than {DEEPEST} levels deep.")
    if _is_json(value):
        return value
    if type(value) is list:
        return [part(one) for one in value]
    if type(value) is dict and all(isinstance(key, str) for key in value) and _TYPE not in value:
        return {key: part(one) for key, one in value.items()}
    if (special := _encode_special(value, arrays)) is not None:
        return special
    cls = type(value)
    if (cls.__module__, cls.__name__) == (
        "rl_zoo3.utils",
        "SimpleLinearSchedule",
    ):  # in older files; reading it would need rl_zoo3
        value, cls = utils.LinearSchedule(value.initial_value, 0.0, 1.0), utils.LinearSchedule
    for base in cls.__mro__:
        if base in _KINDS:
            kind = _KINDS[base]
            return {_TYPE: kind} | _CODECS[kind].write(value, part)
    if (class_name := name_in_files(cls)) is not None and not isinstance(value, (th.nn.Module, th.optim.Optimizer)):
        return {
            _TYPE: "object",
            "class": class_name,
            "attributes": {key: part(one) for key, one in vars(value).items()},
        }
    raise InvalidArgumentError(
        f"{name}={shown(value)} cannot be saved: a {type(value).__name__} is neither a number, an array, a space nor "
        "an instance of a class that files may name. Register its class with `sb3_maddpg.allow_in_files`, leave it out "
        f"with `save(path, exclude=[{name!r}])`, or pickle it with `save(path, pickle=True)`."
    )


def _decode(value: Json, depth: int, arrays: Mapping[str, np.ndarray]) -> Any:
    def part(one: Json) -> Any:
        return _decode(one, depth + 1, arrays)

    if depth > DEEPEST:
        raise InvalidFileError(f"it is nested more than {DEEPEST} levels deep")
    if isinstance(value, list):
        return [part(one) for one in value]
    if not isinstance(value, dict):
        return value
    if _TYPE not in value:
        return {key: part(one) for key, one in value.items()}
    kind = value[_TYPE]
    if kind == "outside":
        return arrays[value["key"]]
    if kind == "TrainFreq":
        return TrainFreq(value["frequency"], TrainFrequencyUnit(value["unit"]))
    if kind == "class":
        return class_in_files(value["name"])
    if kind == "object":
        return _object_of(value, part)
    if not isinstance(kind, str) or kind not in _CODECS:
        raise InvalidFileError(suggest("type", kind, [*_CODECS, "TrainFreq", "class", "object", "outside"]))
    return _CODECS[kind].read(value, part)
