"""Signatures of compiled functions: what each parameter is, declared once and checked once.

A signature lists the parameters of a C function in its order::

    Signature("smallest", "R M", limit="real", pos="*R M 3 f8", near="R M bool optional", least="*R f8 out")

First come the sizes that the function takes. A parameter is then "int", "real", or an array with its axes, its type and
its direction. An axis is a letter, a letter and a number as in "N+1", or a number. "*R" stands for any axes, whose
product is the size R. An array is read, or "changed" in place, or allocated and returned ("out").
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

_TYPES: dict[str, np.dtype[Any]] = {
    "f8": np.dtype(np.float64),
    "f4": np.dtype(np.float32),
    "i8": np.dtype(np.int64),
    "bool": np.dtype(np.bool_),
}
_SCALARS = {"int": ctypes.c_int64, "real": ctypes.c_double}
_MOST_CHECKED = 4096  # combinations of shapes that are kept per function


@dataclass(frozen=True)
class Array:
    """A parameter that is an array.

    :param name: its name
    :param axes: its axes: letters, letters with a number to add, or numbers
    :param dtype: its type
    :param direction: "in", "changed" or "out"
    :param optional: whether None may be passed, or False for one that is returned
    """

    name: str
    axes: tuple[tuple[str, int], ...]
    dtype: np.dtype
    direction: str
    optional: bool

    def shape(self, sizes: dict[str, Any]) -> tuple[int, ...]:
        """Return the shape.

        :param sizes: letter -> size, or the axes that a letter with an asterisk stands for
        """
        found: list[int] = []
        for letter, more in self.axes:
            if letter.startswith("*"):
                found += sizes[letter]
            else:
                found.append((sizes[letter] if letter else 0) + more)
        return tuple(found)

    def bind(self, shape: tuple[int, ...], sizes: dict[str, Any]) -> bool:
        """Bind the letters that are new, and return whether a shape fits."""
        axes, first = self.axes, self.axes[0][0]
        if first.startswith("*"):
            leading = len(shape) - len(axes) + 1
            if leading < 0 or sizes.setdefault(first, shape[:leading]) != shape[:leading]:
                return False
            axes, shape = axes[1:], shape[leading:]
        return len(shape) == len(axes) and all(
            (sizes.setdefault(letter, size - more) if letter else 0) + more == size
            for (letter, more), size in zip(axes, shape, strict=True)
        )


class Signature:
    """The signature of a compiled function, see above.

    :param name: name of the function
    :param sizes: letters of the sizes that it takes first, separated by spaces
    :param records: further types of arrays by name
    :param result: class of what a call returns, made of the arrays; None for the tuple of these, or the only one
    :param parameters: the other parameters in order: numbers on one or both sides of the arrays, in which those that
        are allocated come last
    """

    def __init__(
        self,
        name: str,
        sizes: str,
        /,
        *,
        records: dict[str, np.dtype] | None = None,
        result: Any = None,
        **parameters: str,
    ):
        self.name, self.sizes, self.result = name, tuple(sizes.split()), result
        self.parameters: dict[str, str | Array] = {
            key: text if text in _SCALARS else _array(key, text, {**_TYPES, **(records or {})})
            for key, text in parameters.items()
        }
        self.arrays = tuple(one for one in self.parameters.values() if isinstance(one, Array))

    def argtypes(self) -> list[Any]:
        """Return the types for ctypes."""
        others = [ctypes.c_void_p if isinstance(one, Array) else _SCALARS[one] for one in self.parameters.values()]
        return [ctypes.c_int64] * len(self.sizes) + others

    def of(self, library: ctypes.CDLL, **sizes: int) -> Callable[..., Any]:
        """Return the function of a library, see `Compiled`.

        :param library: the library
        :param sizes: letters whose sizes are constants of the library
        """
        return Compiled(self, library, sizes).call


def _array(name: str, text: str, types: dict[str, np.dtype]) -> Array:
    words = text.split()
    end = next(k for k, word in enumerate(words) if word in types)
    axes = []
    for axis in words[:end]:
        letter, _, more = axis.partition("+")
        axes.append(("", int(letter)) if letter.isdigit() else (letter, int(more or 0)))
    rest = words[end + 1 :]
    direction = next((word for word in rest if word in ("changed", "out")), "in")
    return Array(name, tuple(axes), types[words[end]], direction, "optional" in rest)


class Compiled:
    """A function of a library, called with the parameters of its signature by name. One that is returned is not passed,
    unless it is optional: True or False decide whether it is returned. Sizes that no array tells are passed as well.

    A call checks types and shapes. It copies arrays that are only read if they are not contiguous.

    :param signature: the signature
    :param library: the library
    :param constants: letters whose sizes are constants of the library
    """

    def __init__(self, signature: Signature, library: ctypes.CDLL, constants: Mapping[str, int]):
        self.signature, self._constants = signature, constants
        self._function = getattr(library, signature.name)
        self._function.restype = None
        self._function.argtypes = signature.argtypes()
        self._inputs = [one for one in signature.arrays if one.direction != "out"]
        self._outputs = [one for one in signature.arrays if one.direction == "out"]
        told = {letter.lstrip("*") for one in self._inputs if not one.optional for letter, _ in one.axes}
        self._sizes = [letter for letter in signature.sizes if letter not in told and letter not in constants]
        returned = {one.name for one in self._outputs if not one.optional}
        self._names = [*self._sizes, *(name for name in signature.parameters if name not in returned)]
        # Arrays of lengths that nothing else depends on, so that each new length is not a new shape
        inside = {axis[0] for one in signature.arrays for axis in one.axes[one.direction != "out" :]}
        fixed = {*signature.sizes, *constants, *inside, ""}
        self._any_length = [one for one in self._inputs if one.axes[0][0].lstrip("*") not in fixed]
        # What follows from shapes that have been checked: sizes, and the shapes of what is returned
        self._checked: dict[Any, tuple] = {}
        self.call = self._make_call()

    def _make_call(self) -> Callable[..., Any]:
        """Generate the call as code without loops, which takes half the time: a step of one swarm makes five calls.

        Whatever it does not know, shapes or arrays that are not contiguous, is left to `_call`.
        """
        shapes = [
            _unless_none(one, one.name, f"{one.name}.shape" + ("[1:]" if one in self._any_length else ""))
            for one in self._inputs
        ]
        fitting = [
            (f"{one.name} is None or " if one.optional else "") + f"{one.name}.dtype is {one.name}_type"
            for one in self._inputs
        ]
        fitting += [
            (f"{one.name} is None or " if one.optional else "") + f"len({one.name}) == len({first.name})"
            for first in self._any_length[:1]
            for one in self._any_length
        ]
        allocated = [
            f"{one.name}_ = empty({one.name}_, {one.name}_type)" + (f" if {one.name} else None" if one.optional else "")
            for one in self._outputs
        ]
        sizes, outputs = (
            [f"size_{k}" for k, _ in enumerate(self.signature.sizes)],
            [f"{one.name}_" for one in self._outputs],
        )
        passed = {one.name: one.name if one in self._inputs else f"{one.name}_" for one in self.signature.arrays}
        addresses = {
            one.name: _unless_none(one, passed[one.name], f"address(buffer({passed[one.name]}))")
            for one in self.signature.arrays
        }
        arguments = [*sizes, *(addresses.get(name, name) for name in self.signature.parameters)]
        if self.signature.result is not None:
            result = f"result({', '.join(outputs)})"
        else:
            result = outputs[0] if len(outputs) == 1 else f"({''.join(f'{one}, ' for one in outputs)})"
        source = f"""def call(*, {", ".join(self._names)}):
    try:
        {"".join(f"{one}, " for one in (*sizes, *outputs))} = checked[{", ".join((*self._sizes, *shapes))},]
        if not ({" and ".join(f"({one})" for one in fitting)}):
            raise KeyError
        {"; ".join(allocated) or "pass"}
        arguments = ({", ".join(arguments)},)
    except (KeyError, AttributeError, TypeError, ValueError):
        return slowly({", ".join(f"{name}={name}" for name in self._names)})
    function(*arguments)
    return {result}
"""
        known: dict[str, Any] = {f"{one.name}_type": one.dtype for one in self.signature.arrays}
        known |= {"checked": self._checked, "function": self._function, "slowly": self._call, "empty": np.empty}
        known |= {"address": ctypes.addressof, "buffer": ctypes.c_char.from_buffer, "result": self.signature.result}
        exec(source, known)
        return known["call"]

    def _call(self, **given: Any) -> Any:
        """Check a call, make it, and keep what follows from its shapes.

        :raises ValueError: if a type or a shape is wrong, or an array cannot be written in place; the message names it
        """
        sizes: dict[str, Any] = {**self._constants, **{name: given[name] for name in self._sizes}}
        key: list[Any] = [given[name] for name in self._sizes]
        arrays: dict[str, np.ndarray | None] = {}
        for parameter in self._inputs:
            array = given[parameter.name]
            if array is not None or not parameter.optional:
                array = _fitting(parameter, array, sizes)
            arrays[parameter.name] = array
            key.append(None if array is None else array.shape[parameter in self._any_length :])
        sizes |= {letter[1:]: math.prod(axes) for letter, axes in sizes.items() if letter.startswith("*")}
        shapes = [parameter.shape(sizes) for parameter in self._outputs]
        passed = [sizes[letter] for letter in self.signature.sizes]
        if len(self._checked) >= _MOST_CHECKED:
            self._checked.clear()
        self._checked[tuple(key)] = (*passed, *shapes)
        outputs = [
            np.empty(shape, parameter.dtype) if given.get(parameter.name, True) else None
            for parameter, shape in zip(self._outputs, shapes, strict=True)
        ]
        arrays |= {parameter.name: array for parameter, array in zip(self._outputs, outputs, strict=True)}
        values = [arrays.get(name, given.get(name)) for name in self.signature.parameters]
        self._function(*passed, *(one.ctypes.data if isinstance(one, np.ndarray) else one for one in values))
        if self.signature.result is not None:
            return self.signature.result(*outputs)
        return outputs[0] if len(outputs) == 1 else tuple(outputs)


def _unless_none(array: Array, name: str, value: str) -> str:
    return f"None if {name} is None else {value}" if array.optional else value


def _fitting(parameter: Array, array: Any, sizes: dict[str, Any]) -> np.ndarray:
    """Return a contiguous array, and bind the sizes that it tells.

    :raises ValueError: if its type or shape is wrong, or it cannot be written in place
    """
    if not isinstance(array, np.ndarray) or array.dtype != parameter.dtype:
        kind = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{parameter.name} has type {kind}; it must be an array of {parameter.dtype}.")
    known = dict(sizes)
    if not parameter.bind(array.shape, sizes):
        raise ValueError(f"{parameter.name} has shape {array.shape}; it must be {_text(parameter, known)}.")
    if parameter.direction == "in":
        return np.ascontiguousarray(array)
    if not array.flags.c_contiguous or not array.flags.writeable:
        raise ValueError(f"{parameter.name} is changed in place: it must be contiguous and writable.")
    return array


def _text(parameter: Array, sizes: dict[str, Any]) -> str:
    """Return a shape for an error message, with the letters that are not bound."""
    parts = []
    for letter, more in parameter.axes:
        if letter.startswith("*"):
            parts += [str(size) for size in sizes[letter]] if letter in sizes else ["..."]
        elif letter in sizes or not letter:
            parts.append(str((sizes[letter] if letter else 0) + more))
        else:
            parts.append(f"{letter} + {more}" if more else letter)
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"
