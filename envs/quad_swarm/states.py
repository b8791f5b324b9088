"""Arrays and random number generators of environment states, as plain values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from quad_swarm.errors import shown

# Largest integers in the states of NumPy's generators, by name
_LARGEST = {"pos": 624, "buffer_pos": 4, "has_uint32": 1, "has_gauss": 1, "uinteger": 2**32 - 1}
MOST_STEPS = 2**53  # largest magnitude of a number: steps and metres are far below it


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """Return the state of a random number generator, see `generator_of`."""
    return dict(rng.bit_generator.state)


def generator_of(state: dict[str, Any]) -> np.random.Generator:
    """Create the random number generator of a state.

    :raises ValueError: if NumPy has no such generator, or the state does not fit it
    """
    bits = getattr(np.random, str(state.get("bit_generator")), None)
    if not (isinstance(bits, type) and issubclass(bits, np.random.BitGenerator)):
        raise ValueError(f"bit_generator={state.get('bit_generator')!r} is not one of NumPy's.")
    generator = np.random.Generator(bits())
    _check_bits(state, dict(generator.bit_generator.state))
    generator.bit_generator.state = state
    return generator


def _check_bits(state: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Check what NumPy does not: a position outside of a generator's memory would end the process.

    :param state: state of a bit generator
    :param own: any state of a generator of the same class
    :raises ValueError: if a part is missing, has another type, or lies outside of its range
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

    if wrong := [name for name in {**own, **state} if name not in own or not fits(state.get(name), own[name], name)]:
        raise ValueError(f"This is not a state of NumPy's {own['bit_generator']}: its {shown(wrong[0])} does not fit.")


def like(
    present: np.ndarray, given: Any, name: str, least: float = -MOST_STEPS, most: float = MOST_STEPS
) -> np.ndarray:
    """Copy an array that replaces another one.

    :param present: the array to replace
    :param given: its replacement
    :param name: name of the array, for error messages
    :param least: smallest valid number
    :param most: largest valid number
    :raises ValueError: if shape or data type differ, or a number is NaN or out of range
    """
    array = np.array(given)
    if array.shape != present.shape or array.dtype != present.dtype:
        raise ValueError(
            f"{name}: the state has {array.dtype} of shape {array.shape}, but this environment has {present.dtype} of "
            f"shape {present.shape}. A state fits only an environment with the same arguments."
        )
    if array.dtype != bool and not ((array >= least) & (array <= most)).all():  # false for NaN too
        raise ValueError(f"{name}: the state has numbers outside of {least:g} to {most:g}, or NaN.")
    return array


@contextmanager
def as_other_state() -> Iterator[None]:
    """Replace errors about missing or misshapen parts of a state by one about the state.

    :raises ValueError: instead of the original error
    """
    try:
        yield
    except (TypeError, LookupError, AttributeError) as error:
        raise ValueError(
            f"This is not a state of this environment ({type(error).__name__}: {error}): pass what `state_dict` of an "
            "environment with the same arguments returned."
        ) from error
