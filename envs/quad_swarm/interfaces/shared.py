"""Common parts of the three interfaces: attributes for learners, and checks of seeds, options and actions."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any

import casadi
import gymnasium as gym
import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.task.request_task import RequestTask
from quad_swarm.world.presets import SwarmConfig

# What `RequestTask.place` takes
RESET_OPTIONS = (
    "starts",
    "goals",
    "velocities",
    "waypoints",
    "headings",
    "initial_velocities",
    "initial_headings",
)


class TaskAttributes:
    """Mixin with the attributes of a team environment that learners and callbacks read."""

    task: RequestTask

    @property
    def config(self) -> SwarmConfig:
        """Configuration of the world."""
        return self.task.swarm.config

    @property
    def n_agents(self) -> int:
        """Number of robots n."""
        return self.config.n_robots

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the robots, "robot_0", "robot_1", ..."""
        return self.task.agent_names

    @property
    def observation_layout(self) -> dict[str, Any]:
        """Meaning of an observation's columns, see `sb3_maddpg.relational.ObservationLayout`."""
        return self.task.observation_layout

    @property
    def action_cost(self) -> float:
        """Cost of a request."""
        return self.task.action_cost

    @property
    def depends_on(self) -> dict[str, str]:
        """What exact results depend on besides the sources: the solver that flies, and the version of CasADi."""
        return {"solver": self.task.swarm.planner.solver.name, "casadi": casadi.__version__}

    # A callback sets the curriculum's level, the environment itself never does.
    @property
    def n_curriculum_levels(self) -> int:
        """Number of curriculum levels, 1 without a curriculum."""
        return self.task.sampler.n_levels

    @property
    def curriculum_level(self) -> int:
        """Current curriculum level, from 0."""
        return self.task.sampler.level

    def set_curriculum_level(self, level: int) -> None:
        """Draw the next episodes from the first ``level + 1`` scenarios.

        :raises ValueError: if there is no such level
        """
        self.task.sampler.set_level(level)


def checked_seed(seed: Any) -> int | None:
    """Convert a seed to the type that Gymnasium needs, which does not accept NumPy's integers.

    :raises ValueError: if the seed is not a non-negative integer
    """
    if seed is None:
        return None
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise ValueError(f"seed={shown(seed)}: a seed must be a non-negative integer or None.")
    return number


def checked_options(options: Any) -> dict[str, Any]:
    """Check the options of ``reset``; None becomes an empty dict.

    :raises ValueError: if the options are not a mapping with names as keys
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping) or not all(isinstance(name, str) for name in options):
        raise ValueError(
            f"options={shown(options)}: the options of reset() must be a mapping from names to values, or None."
        )
    return dict(options)


def checked_start(options: Any, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """Check the names of the options of an episode's start; their values are checked by the swarm.

    :param options: options of ``reset``, or None
    :param more: names of further options, for error messages
    :return: the options, none for an episode that is drawn
    :raises ValueError: if the options are no mapping, one is unknown, or starts or goals are missing
    """
    options = checked_options(options)
    if unknown := set(options).difference(RESET_OPTIONS):
        raise unknown_name("reset option", min(unknown), [*RESET_OPTIONS, *more])
    if options and not {"starts", "goals"} <= set(options):
        raise ValueError(f"reset options name only {', '.join(map(repr, options))}; pass both 'starts' and 'goals'.")
    return options


def need_reset(called: str = "step") -> gym.error.ResetNeeded:
    """Create the error for a step, or another call, before the first reset."""
    return gym.error.ResetNeeded(f"{called}() was called before reset(): reset the environment first.")


def checked_bits(
    actions: Any, shape: tuple[int, ...], n_others: int, n_bits: int = 1, whose: str = "The action"
) -> np.ndarray:
    """Check actions and reshape them to bits of each acting robot for each of the others.

    :param actions: bits
    :param shape: shape of the action space, whose last axis holds the bits of one or more robots
    :param n_others: number of others per robot
    :param n_bits: number of bits of each robot for each of the others
    :param whose: whose action it is, for error messages
    :return: the bits, (..., robots, n_others, n_bits) bool
    :raises ValueError: if the shape differs, or there are other entries than 0 and 1
    """
    bits = np.asarray(actions)
    if bits.shape != shape:
        raise ValueError(
            f"{whose} has shape {bits.shape}; the action space has {shape}: "
            f"{n_bits * n_others} bits per robot, {n_bits} for each of the others."
        )
    asked = bits == 1
    if np.count_nonzero(asked) + np.count_nonzero(bits == 0) < bits.size:
        wrong = bits[~(asked | (bits == 0))].ravel()[0]
        raise ValueError(
            f"{whose} contains {shown(wrong)}; every entry must be 0 or 1. Threshold scores before acting."
        )
    return asked.reshape(*shape[:-1], -1, n_others, n_bits)
