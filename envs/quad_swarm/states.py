"""Arrays and random number generators of environment states, as plain values."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


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
    generator.bit_generator.state = state
    return generator


def like(present: np.ndarray, given: Any, name: str) -> np.ndarray:
    """Copy an array that replaces another one.

    :param present: the array to replace
    :param given: its replacement
    :param name: name of the array, for error messages
    :raises ValueError: if shape or data type differ
    """
    array = np.array(given)
    if array.shape != present.shape or array.dtype != present.dtype:
        raise ValueError(
            f"{name}: the state has {array.dtype} of shape {array.shape}, but this environment has {present.dtype} of "
            f"shape {present.shape}. A state fits only an environment with the same arguments."
        )
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
