"""What changes when swarms fly, listed once: copies, parts and files of it follow from the list."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from quad_swarm.planner import Plans, PlanStatus
from quad_swarm.states import MOST_STEPS, like
from quad_swarm.validation import LARGEST_ANGLE
from quad_swarm.world.beliefs import Beliefs
from quad_swarm.world.commitment import Commitment
from quad_swarm.world.disturbance_estimate import DisturbanceEstimate
from quad_swarm.world.neighbours import Neighbours
from quad_swarm.world.obstacles import Obstacles
from quad_swarm.world.radio import RadioChannel
from quad_swarm.world.realisation import Realisation
from quad_swarm.world.route import Route

S = TypeVar("S", bound="SwarmState")

_LIMITS = {"age": (0, MOST_STEPS), "iterations": (0, MOST_STEPS), "status": (min(PlanStatus), max(PlanStatus))}

# Field -> its name in states, which are in files, where the two differ
_KEYS = {
    "_u": "input",
    "_plans": "plans",
    "_radio": "earlier",
    "_other_beliefs": "presumed_beliefs",
    "disturbances": "chance",
}


@dataclass(eq=False, repr=False)
class SwarmState:
    """The state of E swarms: arrays, and parts with a state of their own, all of which `Swarm` explains."""

    state: np.ndarray
    goal: np.ndarray
    _u: np.ndarray
    _plans: Plans
    _radio: RadioChannel
    beliefs: Beliefs
    _other_beliefs: Beliefs | None
    disturbances: Realisation
    neighbours: Neighbours
    obstacles: Obstacles | None
    commitment: Commitment | None
    disturbance: DisturbanceEstimate | None
    # These come and go in flight, and are not in states of before they existed
    route: Route | None = None
    heading: np.ndarray | None = None

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        robots = np.repeat(swarms, self.state.shape[1])
        for name, _, value in self._fields():
            if isinstance(value, np.ndarray):
                setattr(self, name, value[swarms])
            elif isinstance(value, Plans):
                setattr(self, name, Plans(*(array[robots] for array in value)))
            elif value is not None:
                value.keep(swarms)

    def copied(self: S) -> S:
        """Return a copy, which shares arrays that are written into, until `keep`, and the random number generators."""
        other = copy(self)
        for name, _, value in self._fields():
            setattr(other, name, value if isinstance(value, np.ndarray) else copy(value))
        return other

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state as plain values and arrays, see `load_state_dict`."""
        return {key: _plain(value) for _, key, value in self._fields()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict` of swarms in the same world, bit for bit.

        :raises ValueError: if the state belongs to other swarms
        """
        for name, key, value in self._fields():
            if name == "route":
                route = state.get(key)
                self.route = None if route is None else Route.of_state(route, self.goal)
            elif name == "heading":
                heading, none = state.get(key), np.zeros(self.state.shape[:2])
                self.heading = None if heading is None else like(none, heading, key, -LARGEST_ANGLE, LARGEST_ANGLE)
            elif isinstance(value, np.ndarray):
                setattr(self, name, like(value, state[key], key))
            elif isinstance(value, Plans):
                arrays = {
                    one: like(array, state[key][one], f"{key}.{one}", *_LIMITS.get(one, ()))
                    for one, array in value._asdict().items()
                }
                setattr(self, name, Plans(**arrays))
            elif value is not None:
                value.load_state_dict(state[key])

    def _fields(self) -> list[tuple[str, str, Any]]:
        """Return the name of each field, its key in states, and its value."""
        return [(one.name, _KEYS.get(one.name, one.name), getattr(self, one.name)) for one in fields(SwarmState)]


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, Plans):
        return {name: array.copy() for name, array in value._asdict().items()}
    return None if value is None else value.state_dict()
