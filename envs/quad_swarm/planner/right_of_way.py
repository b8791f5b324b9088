"""Right of way: a convention about the side on which robots pass each other when plans arrive late.

Two robots that approach head-on and only know each other's outdated plans may repeatedly evade to the same side. The
rules of the air resolve this: both alter their heading to the right (ICAO Annex 2, 3.2.2.2).
"""

from __future__ import annotations

from quad_swarm.native import pairs
from quad_swarm.planner.problem import Problems

_FADE = 1.0  # time before the closest approach from which the effect fades, since the sides are settled then (s)
_SLOW = 0.5  # closing speed below which the effect is reduced, since the approach is not head-on then (m/s)


def keep_right(problems: Problems, distance: float, dt: float) -> Problems:
    """Enlarge all other robots with known plans by ``distance`` on the side on which they should not be passed.

    Their believed positions move by this distance to the left, as seen along the relative motion, and the clearance
    grows by the same amount. Nothing changes on the right.

    :param problems: a batch of B problems
    :param distance: distance by which to enlarge the others (m)
    :param dt: length of a stage (s)
    :return: the changed problems
    """
    known = problems.announced
    if known is None or not known.any():
        return problems
    others, clearance = pairs.keep_right(problems.x, problems.others, known, distance, dt, _FADE, _SLOW)
    if problems.clearance is not None:
        clearance += problems.clearance
    return problems._replace(others=others, clearance=clearance)
