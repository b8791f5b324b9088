"""Passing on the right: a convention that settles who passes whom on which side, where plans arrive late.

Two robots that approach each other head-on and know only each other's old plans may both dodge to the same side, again
and again. The rules of the air have an answer: each alters its heading to the right (ICAO Annex 2, 3.2.2.2).
"""

from __future__ import annotations

from quad_swarm.native import pairs
from quad_swarm.planner.problem import Problems

_FADE = 1.0  # s before the closest approach, from which on less and less is asked for: then the sides are settled
_SLOW = 0.5  # m/s of closing speed, below which less is asked for: then there is no head-on


def keep_right(problems: Problems, distance: float, dt: float) -> Problems:
    """The same problems with every other robot whose plan is known grown by ``distance`` on the side on which it should
    not be passed.

    Its believed positions move by that distance to the left, as seen along the relative motion, and the clearance grows
    as much: on the right everything stays as it was.

    :param problems: a batch of B problems
    :param distance: how much to grow the others (m)
    :param dt: length of a stage (s)
    """
    known = problems.announced
    if known is None or not known.any():
        return problems
    others, clearance = pairs.keep_right(problems.x, problems.others, known, distance, dt, _FADE, _SLOW)
    if problems.clearance is not None:
        clearance += problems.clearance
    return problems._replace(others=others, clearance=clearance)
