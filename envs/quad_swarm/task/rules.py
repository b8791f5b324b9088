"""Hand-made rules for requests: the baselines of Sec. V-C and stronger ones.

A rule maps the knowledge of the robots of E swarms to requests. To add a rule, write a function and add it to `RULES`.
Lengths are in m, or with the suffix "s" in units of the planner's separation: "cpa:1.1s:1.5" uses 1.1 times the
separation, within 1.5 seconds.
"&" requests if both rules do, "|" if at least one does; "&" binds tighter.
"""

from __future__ import annotations

import functools
import os
import traceback
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.geometry import length
from quad_swarm.task.view import View

Rule = Callable[[View], np.ndarray]


def none() -> Rule:
    """Never request (the paper's NC)."""
    return lambda view: np.zeros(view.pos.shape[:-1], dtype=bool)


def full() -> Rule:
    """Request all plans at every step (the paper's FC)."""
    return lambda view: np.ones(view.pos.shape[:-1], dtype=bool)


def distance(threshold: float) -> Rule:
    """Request from robots closer than ``threshold`` (m) (the paper's DBCP)."""
    return lambda view: view.distance < threshold


def cpa(threshold: float, look_ahead: float) -> Rule:
    """Request from robots that would come closer than ``threshold`` (m) within ``look_ahead`` (s) at constant
    velocities."""

    return lambda view: view.approach(look_ahead)[0] < threshold


def soon(time: float) -> Rule:
    """Request from robots whose closest approach at constant velocities is within ``time`` (s), or in the past."""
    return lambda view: view.approach(np.inf)[1] < time


def event(drift: float) -> Rule:
    """Event-triggered: request if the newest received plan is off by more than ``drift`` (m), has expired, or does not
    exist."""
    return lambda view: (view.drift > drift) | (view.age >= view.horizon)


def push(distance: float) -> Rule:
    """Event-triggered by the sender: a robot's plan is sent if it deviates, anywhere over the horizon, by more than
    ``distance`` (m) from what, as far as the sender knows, the receiver predicts."""
    tells = _deviates(distance)
    return lambda view: view.of_the_other(tells(view))


def _deviates(distance: float) -> Rule:
    """Tell those whose prediction of the robot's plan is off by more than ``distance`` (m): `push` for the sender."""

    def rule(view: View) -> np.ndarray:
        believed = view.seen_by_others(range(view.horizon)).believed
        off = length(view.plan[:, :, None] + view.own_pos[:, :, None, None] - believed).max(axis=-1)
        return off > distance

    return rule


def stage(distance: float, drift: float) -> Rule:
    """Event-triggered by the sender: a robot's plan is sent if at some stage it comes closer than ``distance`` (m) to
    the predicted motion of the receiver, or what the receiver predicts of the sender does, and the two differ there by
    more than ``drift`` (m)."""
    tells = _differs_nearby(distance, drift)
    return lambda view: view.of_the_other(tells(view))


def _differs_nearby(distance: float, drift: float) -> Rule:
    """Tell those who would meet the robot, or expect to, at a stage where they do not know its plan: `stage` for the
    sender."""

    def rule(view: View) -> np.ndarray:
        mine, theirs = view.plan[:, :, None], view.expected()
        believed = view.seen_by_others(range(view.horizon)).believed - view.own_pos[:, :, None, None]
        near = np.minimum(length(mine - theirs), length(believed - theirs)) < distance
        return (near & (length(mine - believed) > drift)).any(axis=-1)

    return rule


def stale(age: float) -> Rule:
    """Request if the newest received plan is at least ``age`` steps old or is no longer believed."""
    return lambda view: (view.age >= age) | ~view.prediction.remembers


def plan(distance: float) -> Rule:
    """Request from robots whose predicted motion comes closer to the robot's own plan than ``distance`` (m)."""
    return lambda view: view.plan_approach.least < distance


def blocked(distance: float) -> Rule:
    """Request from robots whose predicted motion leads closer to an obstacle than ``distance`` (m), between surfaces:
    they will not fly as predicted."""
    return lambda view: view.their_obstacle.gap < distance


def random(probability: float) -> Rule:
    """Request from each other robot with ``probability``, independently."""
    if not 0 <= probability <= 1:
        raise ValueError(f"random:{probability}: the probability must lie in [0, 1].")
    return lambda view: np.stack([rng.random(view.pos.shape[1:-1]) < probability for rng in view.rngs])


# Arguments that are lengths, in metres or, with the suffix "s", in separations
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
    "stage": (stage, ("DIST", "EPS")),
    "stale": (stale, ("STEPS",)),
    "plan": (plan, ("DIST",)),
    "blocked": (blocked, ("DIST",)),
    "random": (random, ("P",)),
}


# Those of them by which the sender decides, as the sender sees it
_SENDERS: dict[str, Callable[..., Rule]] = {"push": _deviates, "stage": _differs_nearby}


def parse_rule(text: str) -> Rule:
    """Parse a rule such as ``"cpa:0.7:1.5"`` or ``"cpa:0.7:1.5&stale:3|distance:1"``.

    :raises ValueError: if the rule is unknown, or arguments are missing, superfluous or not numbers
    """
    if not isinstance(text, str):
        raise ValueError(f"rule={shown(text)}: it must be the text of a rule, such as 'cpa:0.7:1.5'.")
    return _either([[_parse_one(part) for part in joined] for joined in _split(text)])


def parse_decisions(text: str) -> tuple[Rule, Rule | None]:
    """Parse a rule into what a robot of its own decides: whom it asks, and whom it tells without being asked.

    :return: whom to ask, and whom to tell, None if the rule tells nobody
    :raises ValueError: if the rule is invalid, see `parse_rule`, or "&" joins what the receiver and the sender know
    """
    parse_rule(text)
    asks: list[list[Rule]] = []
    tells: list[list[Rule]] = []
    for joined in _split(text):
        by_sender = {part.partition(":")[0] in _SENDERS for part in joined}
        if len(by_sender) > 1:
            raise ValueError(
                f"Rule {text!r}: {'&'.join(joined)!r} joins what the receiver and the sender know, so no robot can "
                "decide it; join them with '|'."
            )
        parsed = [_parse_one(part, _SENDERS) for part in joined]
        (tells if by_sender == {True} else asks).append(parsed)
    return _either(asks or [[none()]]), _either(tells) if tells else None


def _split(text: str) -> list[list[str]]:
    return [[part.strip() for part in joined.split("&")] for joined in text.split("|")]


def _either(alternatives: list[list[Rule]]) -> Rule:
    if len(alternatives) == len(alternatives[0]) == 1:
        return alternatives[0][0]

    def rule(view: View) -> np.ndarray:
        return np.logical_or.reduce([np.logical_and.reduce([part(view) for part in joined]) for joined in alternatives])

    return rule


# Whoever sends, in the words of tables
_MEANT = {"nobody": "none", "everybody": "full"}


def _parse_one(text: str, instead: Mapping[str, Callable[..., Rule]] = MappingProxyType({})) -> Rule:
    """Parse a rule without operators.

    :param instead: factories of rules that take the place of those in `RULES`
    """
    name, *values = text.split(":")
    if name not in RULES:
        raise unknown_name("rule", name, RULES, _MEANT.get(name))
    factory, arguments = RULES[name]
    factory = instead.get(name, factory)
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
        raise ValueError(f"Rule {text!r}: only lengths ({', '.join(_LENGTHS)}) can be in separations, as in 1.2s.")
    if not any(relative):
        return checked_rule(text, factory(*numbers))

    @functools.cache  # rules may have a state
    def scaled(separation: float) -> Rule:
        return factory(*(n * separation if r else n for n, r in zip(numbers, relative, strict=True)))

    return checked_rule(text, lambda view: scaled(view.separation)(view))


def checked_rule(text: str, rule: Rule) -> Rule:
    """Return a rule that fails in one sentence, and refuses what are no requests.

    :param text: name of the rule, for the error message
    :param rule: the rule

    :raises ValueError: in the rule, if it failed, or returned something else than True or False for each of the others
    """

    def checked(view: View) -> np.ndarray:
        try:
            answer: Any = rule(view)
        except Exception as error:  # whatever a foreign function raises
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = "" if place.filename == __file__ else f" in {os.path.basename(place.filename)}, line {place.lineno}"
            raise ValueError(f"Rule {text!r} failed{where} ({type(error).__name__}: {error}).") from error
        shape, bits = view.pos.shape[:-1], answer
        if type(answer) is not np.ndarray or answer.dtype != bool:
            try:
                bits = as_bits(answer)
            except (TypeError, ValueError):
                bits = None
        if bits is None or bits.shape != shape:
            raise ValueError(
                f"Rule {text!r} returned {shown(answer)}: it must return True or False for each of the others of each "
                f"robot, shape {shape}."
            )
        return bits

    return checked


def as_bits(answer: Any) -> np.ndarray | None:
    """Return what a rule or policy answered as booleans, None if it holds anything but True and False, 1 and 0.

    :raises ValueError, TypeError: if it is no array of numbers
    """
    array = np.asarray(answer)
    if array.dtype.kind not in "biufO" or np.ma.is_masked(answer):
        return None
    bits = array.astype(float)
    return bits == 1 if ((bits == 0) | (bits == 1)).all() else None
