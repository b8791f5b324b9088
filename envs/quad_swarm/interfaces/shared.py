"""What the three interfaces have in common: what learners read of them, and how seeds and actions are checked."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from quad_swarm.errors import shown
from quad_swarm.task.request_task import RequestTask
from quad_swarm.world.presets import SwarmConfig


class TaskAttributes:
    """The attributes of a team environment that learners and callbacks read, taken from ``task``."""

    task: RequestTask

    @property
    def config(self) -> SwarmConfig:
        """The world."""
        return self.task.swarm.config

    @property
    def n_agents(self) -> int:
        """Number of robots n."""
        return self.config.n_robots

    @property
    def agent_names(self) -> tuple[str, ...]:
        """The robots' names, "robot_0", "robot_1", ..."""
        return self.task.agent_names

    @property
    def observation_layout(self) -> dict[str, Any]:
        """Which columns of an observation are about the robot itself and which about each of the others."""
        return self.task.observation_layout

    @property
    def action_cost(self) -> float:
        """What a request costs."""
        return self.task.action_cost

    # The curriculum: a training callback sets the level, the environment itself never does.
    @property
    def n_curriculum_levels(self) -> int:
        """Number of curriculum levels; 1 where the scenario has none."""
        return self.task.sampler.n_levels

    @property
    def curriculum_level(self) -> int:
        """The present level, from 0."""
        return self.task.sampler.level

    def set_curriculum_level(self, level: int) -> None:
        """Draw later episodes from the first ``level + 1`` scenarios.

        :raises ValueError: no such level
        """
        self.task.sampler.set_level(level)


def checked_seed(seed: Any) -> int | None:
    """A seed as Gymnasium takes it, which refuses NumPy's integers.

    :raises ValueError: it is no integer of at least 0
    """
    if seed is None:
        return None
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise ValueError(f"seed={shown(seed)}: a seed is an integer of at least 0, or None.")
    return number


def checked_options(options: Any) -> dict[str, Any]:
    """Options of ``reset``; none are an empty mapping.

    :raises ValueError: it is no mapping of names
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping) or not all(isinstance(name, str) for name in options):
        raise ValueError(f"options={shown(options)}: the options of reset() are a mapping by their names, or None.")
    return dict(options)


def need_reset() -> gym.error.ResetNeeded:
    """The error of a step before the first reset."""
    return gym.error.ResetNeeded("step() was called before reset(): reset the environment first.")


def checked_bits(
    actions: Any, shape: tuple[int, ...], n_others: int, n_bits: int = 1, whose: str = "The action"
) -> np.ndarray:
    """Actions as bits of each robot for each of the others, (..., n_others, n_bits) bool with one row for each robot
    that acts.

    :param actions: bits
    :param shape: of the action space, whose last axis holds whole robots' bits
    :param n_others: number of others of a robot
    :param n_bits: of each robot for each of the others
    :param whose: whose action it is, for messages
    :raises ValueError: another shape, or anything but zeros and ones
    """
    bits = np.asarray(actions)
    if bits.shape != shape:
        raise ValueError(
            f"{whose} has shape {bits.shape}; the action space has {shape}: "
            f"{n_bits * n_others} bits for each robot, {n_bits} for each of the others."
        )
    asked = bits == 1
    if not (asked | (bits == 0)).all():
        wrong = bits[~(asked | (bits == 0))].ravel()[0]
        raise ValueError(
            f"{whose} contains {shown(wrong)}; every entry must be 0 or 1. Threshold scores before acting."
        )
    return asked.reshape(*shape[:-1], -1, n_others, n_bits)
