"""Hand-made rules for whom to ask: the baselines of Sec. V-C and stronger ones.

A rule maps what the robots of E swarms observe to requests. To add one, write the function and name it in `RULES`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .beliefs import other_indices
from .errors import unknown_name


@dataclass(frozen=True)
class View:
    """What a rule may look at.

    :param pos: positions of the others relative to each robot, (E, n, n - 1, 3) (m)
    :param vel: velocities of the others relative to each robot, (E, n, n - 1, 3) (m/s)
    :param rngs: one generator for each swarm, so that an episode's draws do not depend on what else is in the batch
    """

    pos: np.ndarray
    vel: np.ndarray
    rngs: Sequence[np.random.Generator]

    @classmethod
    def of(cls, pos: np.ndarray, vel: np.ndarray, rngs: Sequence[np.random.Generator]) -> View:
        """The view of robots at positions and with velocities (E, n, 3), world frame."""
        others = other_indices(pos.shape[1])
        return cls(pos[:, others] - pos[:, :, None], vel[:, others] - vel[:, :, None], rngs)


Rule = Callable[[View], np.ndarray]


def none() -> Rule:
    """Nobody asks (the paper's NC)."""
    return lambda view: np.zeros(view.pos.shape[:-1], dtype=bool)


def full() -> Rule:
    """Everybody asks everybody (the paper's FC)."""
    return lambda view: np.ones(view.pos.shape[:-1], dtype=bool)


def distance(threshold: float) -> Rule:
    """Asks whoever is closer than ``threshold`` (m) (the paper's DBCP)."""
    return lambda view: np.linalg.norm(view.pos, axis=-1) < threshold


def cpa(threshold: float, look_ahead: float) -> Rule:
    """Asks whoever would come closer than ``threshold`` (m) within ``look_ahead`` (s) if both kept their velocity."""

    def rule(view: View) -> np.ndarray:
        closing = -(view.pos * view.vel).sum(axis=-1)
        speed2 = (view.vel**2).sum(axis=-1)
        time = np.clip(closing / np.maximum(speed2, 1e-12), 0.0, look_ahead)
        return np.linalg.norm(view.pos + time[..., None] * view.vel, axis=-1) < threshold

    return rule


def random(probability: float) -> Rule:
    """Asks each other robot with ``probability``, independently."""
    if not 0 <= probability <= 1:
        raise ValueError(f"random:{probability}: the probability must lie in [0, 1].")
    return lambda view: np.stack([rng.random(view.pos.shape[1:-1]) < probability for rng in view.rngs])


# Name -> (factory, names of its arguments).
RULES: dict[str, tuple[Callable[..., Rule], tuple[str, ...]]] = {
    "none": (none, ()),
    "full": (full, ()),
    "distance": (distance, ("EPS",)),
    "cpa": (cpa, ("DIST", "LOOKAHEAD")),
    "random": (random, ("P",)),
}


def parse_rule(text: str) -> Rule:
    """The rule that a text such as ``"cpa:0.7:1.5"`` names.

    :raises ValueError: unknown rule, or arguments that are missing, superfluous or no numbers
    """
    name, *values = text.split(":")
    if name not in RULES:
        raise unknown_name("rule", name, RULES)
    factory, arguments = RULES[name]
    usage = ":".join((name, *arguments))
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        raise ValueError(f"Rule {text!r}: its arguments must be numbers; write {usage}.") from None
    if len(numbers) != len(arguments) or not all(np.isfinite(number) and number >= 0 for number in numbers):
        raise ValueError(f"Rule {text!r} takes {len(arguments)} finite non-negative arguments; write {usage}.")
    return factory(*numbers)
