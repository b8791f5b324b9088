"""Hand-made rules for whom to ask: the baselines of Sec. V-C and stronger ones.

A rule maps what the robots of E swarms know to requests. To add one, write the function and name it in `RULES`.
A length may be given in separations: "cpa:1.1s:1.5" asks at 1.1 times what the planner keeps.
"&" joins rules of which both must want to ask, "|" rules of which one is enough; "&" binds tighter.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quad_swarm.errors import unknown_name
from quad_swarm.geometry import length
from quad_swarm.task.view import View

Rule = Callable[[View], np.ndarray]


def none() -> Rule:
    """Nobody asks (the paper's NC)."""
    return lambda view: np.zeros(view.pos.shape[:-1], dtype=bool)


def full() -> Rule:
    """Everybody asks everybody (the paper's FC)."""
    return lambda view: np.ones(view.pos.shape[:-1], dtype=bool)


def distance(threshold: float) -> Rule:
    """Asks whoever is closer than ``threshold`` (m) (the paper's DBCP)."""
    return lambda view: length(view.pos) < threshold


def cpa(threshold: float, look_ahead: float) -> Rule:
    """Asks whoever would come closer than ``threshold`` (m) within ``look_ahead`` (s) if both kept their velocity."""

    return lambda view: view.approach(look_ahead)[0] < threshold


def soon(time: float) -> Rule:
    """Asks whoever comes closest, with constant velocities, within ``time`` (s); those who draw apart too."""
    return lambda view: view.approach(np.inf)[1] < time


def event(drift: float) -> Rule:
    """Event-triggered: asks again when the newest plan is off by more than ``drift`` (m) or has run out, and whoever
    never was asked."""
    return lambda view: (view.drift > drift) | (view.age >= view.horizon)


def push(distance: float) -> Rule:
    """Event-triggered, and decided by who is asked: gets the plan of whoever's plan, anywhere over the horizon, is more
    than ``distance`` (m) away from what that robot takes the other to predict of it."""

    def rule(view: View) -> np.ndarray:
        presumed = view.presumed(range(view.horizon)).believed
        off = length(view.plan[:, :, None] + view.own_pos[:, :, None, None] - presumed).max(axis=-1)
        return view.of_the_other(off > distance)

    return rule


def stale(age: float) -> Rule:
    """Asks again when the newest plan was made at least ``age`` steps ago or is no longer believed."""
    return lambda view: (view.age >= age) | ~view.prediction.remembers


def plan(distance: float) -> Rule:
    """Asks whoever, as far as is known without asking, comes closer to the own plan than ``distance`` (m)."""
    return lambda view: view.plan_approach.least < distance


def random(probability: float) -> Rule:
    """Asks each other robot with ``probability``, independently."""
    if not 0 <= probability <= 1:
        raise ValueError(f"random:{probability}: the probability must lie in [0, 1].")
    return lambda view: np.stack([rng.random(view.pos.shape[1:-1]) < probability for rng in view.rngs])


# Arguments in metres, or, with an "s", in the distances that the planner keeps.
_LENGTHS = ("EPS", "DIST")

# Name -> (factory, names of its arguments).
RULES: dict[str, tuple[Callable[..., Rule], tuple[str, ...]]] = {
    "none": (none, ()),
    "full": (full, ()),
    "distance": (distance, ("EPS",)),
    "cpa": (cpa, ("DIST", "LOOKAHEAD")),
    "soon": (soon, ("TIME",)),
    "event": (event, ("EPS",)),
    "push": (push, ("EPS",)),
    "stale": (stale, ("STEPS",)),
    "plan": (plan, ("DIST",)),
    "random": (random, ("P",)),
}


def parse_rule(text: str) -> Rule:
    """The rule that a text such as ``"cpa:0.7:1.5"`` or ``"cpa:0.7:1.5&stale:3|distance:1"`` names.

    :raises ValueError: unknown rule, or arguments that are missing, superfluous or no numbers
    """
    either = [[_parse_one(part.strip()) for part in joined.split("&")] for joined in text.split("|")]
    if len(either) == len(either[0]) == 1:
        return either[0][0]

    def rule(view: View) -> np.ndarray:
        return np.logical_or.reduce([np.logical_and.reduce([part(view) for part in joined]) for joined in either])

    return rule


def _parse_one(text: str) -> Rule:
    name, *values = text.split(":")
    if name not in RULES:
        raise unknown_name("rule", name, RULES)
    factory, arguments = RULES[name]
    usage = ":".join((name, *arguments))
    relative = [value.endswith("s") for value in values]
    try:
        numbers = [float(value.removesuffix("s")) for value in values]
    except ValueError:
        raise ValueError(f"Rule {text!r}: its arguments must be numbers; write {usage}.") from None
    if len(numbers) != len(arguments) or not all(np.isfinite(number) and number >= 0 for number in numbers):
        raise ValueError(f"Rule {text!r} takes {len(arguments)} finite non-negative arguments; write {usage}.")
    lengths = [argument in _LENGTHS for argument in arguments]
    if any(scaled and not length for scaled, length in zip(relative, lengths, strict=True)):
        raise ValueError(f"Rule {text!r}: only lengths ({', '.join(_LENGTHS)}) can be given in separations, as 1.2s.")
    if not any(relative):
        return factory(*numbers)

    def rule(view: View) -> np.ndarray:
        return factory(*(n * view.separation if r else n for n, r in zip(numbers, relative, strict=True)))(view)

    return rule
