"""Noise on continuous actions, which may be the user's own."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import shown


def fitted_noise(noise: ActionNoise | None, n_envs: int, length: int) -> ActionNoise | None:
    """
    Fit noise to a number of environments, and try it once.

    :param noise: the noise, None for none
    :param n_envs: number of parallel environments
    :param length: length of the joint action
    :return: the noise for them
    :raises InvalidArgumentError: if it cannot be added to their actions, which would show only after
        ``learning_starts``
    """
    if noise is None:
        return None
    state = np.random.get_state()  # noqa: NPY002 - what SB3's noise draws from
    try:
        vectorised = isinstance(noise, VectorizedActionNoise) or n_envs == 1  # or else learn() vectorises it
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != n_envs:
            noise = VectorizedActionNoise(noise.base_noise, n_envs)
        drawn(deepcopy(noise), (n_envs, length) if vectorised else (length,))
    finally:
        np.random.set_state(state)  # noqa: NPY002
    return noise


def drawn(noise: ActionNoise, shape: tuple[int, ...]) -> np.ndarray:
    """
    :param noise: the noise
    :param shape: whose last axis is the joint action
    :return: its next numbers
    :raises InvalidArgumentError: if it fails, or returns other things than finite numbers of this shape
    """
    length = shape[-1]
    try:
        numbers = np.broadcast_to(noise(), shape)
        if not np.isfinite(numbers).all():
            raise InvalidArgumentError("it returned NaN or infinity")
    except Exception as error:  # from foreign code
        raise InvalidArgumentError(
            f"action_noise={shown(noise)} cannot be added to the {length} numbers of a joint action "
            f"({' '.join(str(error).split())[:200]}): it must return finite numbers, as "
            f"NormalActionNoise(np.zeros({length}), np.full({length}, 0.1)) does."
        ) from error
    return numbers
