"""What the states of environments are made of: arrays and random generators, as plain numbers."""

from __future__ import annotations

from typing import Any

import numpy as np


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """What makes the same generator again, see `generator_of`."""
    return dict(rng.bit_generator.state)


def generator_of(state: dict[str, Any]) -> np.random.Generator:
    """The generator of a state.

    :raises ValueError: a generator that NumPy does not have by this name, or another one's state
    """
    bits = getattr(np.random, str(state.get("bit_generator")), None)
    if not (isinstance(bits, type) and issubclass(bits, np.random.BitGenerator)):
        raise ValueError(f"bit_generator={state.get('bit_generator')!r} is none of NumPy's.")
    generator = np.random.Generator(bits())
    generator.bit_generator.state = state
    return generator


def like(present: np.ndarray, given: Any, name: str) -> np.ndarray:
    """A copy of an array that is to take another one's place.

    :param present: the array that is there
    :param given: the other one
    :param name: what it is, for messages
    :raises ValueError: another shape or type
    """
    array = np.array(given)
    if array.shape != present.shape or array.dtype != present.dtype:
        raise ValueError(
            f"{name}: the state has {array.dtype} of shape {array.shape}, this environment {present.dtype} of shape "
            f"{present.shape}. A state fits only an environment with the same arguments."
        )
    return array
