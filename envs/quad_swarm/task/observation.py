"""Observations of robots, as arrays over E swarms, and the meaning of their columns.

The paper's observation is a flat list of relative states. The pair observation describes each pair (robot, other) by
groups of features in a frame that points to the other. Except for the critic's, it only uses what the robot knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.geometry import length
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.task.columns import (
    COLUMNS,
    ERROR_RANGE,
    ERROR_SCALE,
    GAPS,
    POSITION_SCALE,
    SPEED,
    STAGES,
    VELOCITY_SCALE,
    Column,
    of_numbers,
    of_pairs,
    of_paper,
    unnamed,
)
from quad_swarm.task.view import View
from quad_swarm.world.knowledge import Knowledge
from quad_swarm.world.presets import SwarmConfig


class Observation(Protocol):
    """Function that computes the observations of a swarm's robots.

    :ivar size: length of a robot's observation
    """

    size: int

    @property
    def columns(self) -> list[Column]:
        """Name, unit, frame and meaning of each column."""

    @property
    def layout(self) -> dict[str, Any]:
        """Meaning of the columns, see `sb3_maddpg.relational.ObservationLayout`."""

    def __call__(self, knowledge: Knowledge) -> np.ndarray:
        """Return the observations of all robots, (E, n, size) float32."""


class PaperObservation:
    """The paper's observation z_i = [v_i, p_ig, {p_ij}, {v_ij}] (Sec. IV-B): own velocity, goal relative to the robot,
    relative positions of all others, and relative velocities of all others, in ascending order; length 6n.

    If the neighbourhood is limited to m others, there are m positions and velocities, zero in an empty slot, and the
    numbers of the others follow as in `PairObservation`; length 7m + 6.

    :param config: the world
    :param scaled: whether to divide distances by 4 m and velocities by 4 m/s
    """

    def __init__(self, config: SwarmConfig, scaled: bool = False):
        self.config = config
        self.columns = of_paper(config.n_others, scaled)
        self._numbers = len(self.columns)  # first column of the others' numbers, if there are any
        self.columns += of_numbers(config.n_others) if config.is_limited else []
        self.size = len(self.columns)
        others = 3 * config.n_others
        units = [VELOCITY_SCALE, POSITION_SCALE, POSITION_SCALE, VELOCITY_SCALE]
        self._scale = np.repeat(units, [3, 3, others, others]) if scaled else None

    @property
    def layout(self) -> dict[str, Any]:
        m = self.config.n_others
        others = [[6 + 3 * k + axis + part for part in (0, 3 * m) for axis in range(3)] for k in range(m)]
        layout = {"own": list(range(6)), "neighbours": others, "acts_on_neighbours": True}
        return layout | (_numbered(self._numbers, self.size) if self.config.is_limited else {})

    def __call__(self, knowledge: Knowledge) -> np.ndarray:
        estimate, (others_pos, others_vel) = knowledge.estimate(), knowledge.observe()
        pos, vel = estimate[..., POSITION], estimate[..., VELOCITY]
        flat = (*pos.shape[:2], -1)
        relative_pos, relative_vel = others_pos - pos[:, :, None], others_vel - vel[:, :, None]
        present = knowledge.neighbours.present
        if present is not None:
            relative_pos[~present], relative_vel[~present] = 0.0, 0.0
        parts = (vel, knowledge.goal - pos, relative_pos.reshape(flat), relative_vel.reshape(flat))
        if self._scale is None:
            observed = np.concatenate(parts, axis=-1, dtype=np.float32)
        else:
            observed = (np.concatenate(parts, axis=-1) / self._scale).astype(np.float32)
        if present is None:
            return observed
        return np.concatenate([observed, knowledge.neighbours.numbers() + 1], axis=-1, dtype=np.float32)


def _numbered(first: int, end: int) -> dict[str, Any]:
    """Return the layout entries of the columns with the others' numbers, which also mask actions on empty slots."""
    return {"who_columns": list(range(first, end)), "action_mask": list(range(first, end))}


class PairView:
    """View in the frame of each pair: x points horizontally to the other robot, z points up, and the frame is mirrored
    so that the other robot moves to the left. Features of a pair thus do not depend on rotations and reflections.

    :param view: the knowledge of the robots
    :param swarm: the swarms, for features that only critics see, or a robot of its own
    :param config: the world
    """

    def __init__(self, view: View, swarm: Knowledge, config: SwarmConfig):
        self.view, self.swarm = view, swarm
        self.contact = 2 * config.radius
        self.horizon, self.dt = config.planner.horizon, config.planner.dt
        flat = np.hypot(view.pos[..., 0], view.pos[..., 1])
        above = flat < 1e-6
        self.cos = np.where(above, 1.0, view.pos[..., 0] / np.maximum(flat, 1e-6))
        self.sin = np.where(above, 0.0, view.pos[..., 1] / np.maximum(flat, 1e-6))
        self.side = np.where(self.cos * view.vel[..., 1] < self.sin * view.vel[..., 0], -1.0, 1.0)

    def turn(self, vectors: np.ndarray) -> np.ndarray:
        """Transform vectors along the world's axes, (E, n, n - 1, ..., 3), to the pair's frame."""
        more = (1,) * (vectors.ndim - self.cos.ndim - 1)
        cos, sin, side = (a.reshape(a.shape + more) for a in (self.cos, self.sin, self.side))
        x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
        return np.stack([cos * x + sin * y, side * (cos * y - sin * x), z], axis=-1)

    def closeness(self, distance: np.ndarray) -> np.ndarray:
        """Return a distance at several scales around contact, (..., 3)."""
        return np.tanh((distance - self.contact)[..., None] / _GAPS)


_GAPS = np.array(GAPS)
# Distance of plans in separations, beyond which they hardly affect each other. 1.1 is enough for eight robots, but
# leaves twice as many collisions among sixteen.
_CONFLICT = 1.8
# An encounter comes closer than this many separations within this many seconds
_ENCOUNTER, _LOOK_AHEAD = 1.2, 3.0


def _stages(horizon: int) -> list[int]:
    return [max(round(fraction * horizon), 1) - 1 for fraction in STAGES]


def _flat(array: np.ndarray, keep: int) -> np.ndarray:
    return array.reshape(*array.shape[:keep], -1)


def _own(view: View) -> np.ndarray:
    """Return own velocity and goal in a frame whose x axis points horizontally to the goal, (E, n, 6)."""
    goal, vel = view.goal, view.own_vel
    flat = np.hypot(goal[..., 0], goal[..., 1])
    cos, sin = (goal[..., k] / np.maximum(flat, 1e-6) for k in (0, 1))
    along, across = cos * vel[..., 0] + sin * vel[..., 1], cos * vel[..., 1] - sin * vel[..., 0]
    columns = (
        along / SPEED,
        across / SPEED,
        vel[..., 2],
        flat / POSITION_SCALE,
        np.minimum(flat, 1.0),
        goal[..., 2],
    )
    return np.stack(columns, axis=-1)


def _state(pair: PairView) -> np.ndarray:
    """Return features of positions, velocities and the robot's own goal."""
    view = pair.view
    distance = length(view.pos)
    own_vel, goal = (np.broadcast_to(a[:, :, None], view.pos.shape) for a in (view.own_vel, view.goal))
    to_goal = goal / np.maximum(length(goal)[..., None], 1.0)
    parts = (
        np.stack([distance / POSITION_SCALE, view.pos[..., 2]], axis=-1),
        pair.closeness(view.distance)[..., 1:],
        pair.turn(view.vel) / SPEED,
        pair.turn(own_vel) / SPEED,
        pair.turn(to_goal),
    )
    return np.concatenate(parts, axis=-1)


def _approach(pair: PairView) -> np.ndarray:
    """Return features of the time and distance of closest approach at constant velocities."""
    distance, time = pair.view.approach(4.0)
    times = np.stack([time / 4.0, np.exp(-time / 0.3), np.exp(-time)], axis=-1)
    return np.concatenate([pair.closeness(distance), times], axis=-1)


def _side(pair: PairView) -> np.ndarray:
    """Return features of the side on which the other would pass at constant velocities, which the mirrored frame hides.
    The side matters if the planner has a right of way."""
    pos, vel = pair.view.pos, pair.view.vel
    speed = np.hypot(vel[..., 0], vel[..., 1])
    # Positive if the other passes on the left of the robot's relative path, as the right of way requires
    miss = (vel[..., 1] * pos[..., 0] - vel[..., 0] * pos[..., 1]) / np.maximum(speed, 1e-6)
    return np.stack([pair.side, np.tanh(miss / 0.2), np.tanh(miss)], axis=-1)


def _memory(pair: PairView) -> np.ndarray:
    """Return features of the newest received plan: its age, its error, and its deviation from a constant velocity."""
    view = pair.view
    remembers = view.prediction.remembers.astype(float)
    age = np.minimum(view.age / pair.horizon, 1.0)
    drift = np.minimum(view.drift / max(view.memory, 1e-6), 2.0) * (age < 1.0)
    stages = _stages(pair.horizon)[1:]
    times = pair.dt * (np.array(stages) + 1)
    steady = view.pos[..., None, :] + times[:, None] * (view.vel + view.own_vel[:, :, None])[..., None, :]
    bend = pair.turn(view.expected(stages) - steady)
    return np.concatenate([np.stack([remembers, age, np.exp(2 - view.age), drift], axis=-1), _flat(bend, 3)], axis=-1)


def _plan(pair: PairView) -> np.ndarray:
    """Return features of the robot's own plan relative to the predicted motion of the other."""
    view = pair.view
    approach, stages = view.plan_approach, _stages(pair.horizon)
    times = pair.dt * (np.array(stages[1:]) + 1)
    bend = view.plan[:, :, stages[1:]] - times[:, None] * view.own_vel[:, :, None]
    bend = np.broadcast_to(bend[:, :, None], (*view.pos.shape[:3], *bend.shape[2:]))
    parts = (
        pair.closeness(approach.least),
        (approach.stage / pair.horizon)[..., None],
        pair.closeness(approach.last)[..., 1:],
        _flat(pair.turn(bend), 3),
    )
    return np.concatenate(parts, axis=-1)


def _known_by_other(pair: PairView) -> np.ndarray:
    """Return features of the other's knowledge of this robot: whether it believes a plan, and that plan's error."""
    view, stages = pair.view, _stages(pair.horizon)
    theirs = view.seen_by_others(stages)
    off = view.plan[:, :, None, stages] - (theirs.believed - view.own_pos[:, :, None, None])
    parts = (
        np.stack(
            [theirs.remembers.astype(float), np.minimum(theirs.age / pair.horizon, 1.0), np.exp(2 - theirs.age)],
            axis=-1,
        ),
        np.tanh(length(off) / ERROR_SCALE),
        np.clip(_flat(pair.turn(off[..., 1:, :]), 3) / ERROR_RANGE, -2, 2),
    )
    return np.concatenate(parts, axis=-1)


def _obstacles(pair: PairView) -> np.ndarray:
    """Return features of the obstacles that are nearest to the robot's plan and to the other's predicted motion."""
    view, shape, parts = pair.view, pair.view.pos.shape, []
    own = view.own_obstacle
    of_pairs = [np.broadcast_to(array[:, :, None], shape[: array.ndim + 1]) for array in own[:2]]
    towards = np.broadcast_to(own.towards[:, :, None], shape)
    for gap, stage, way in ((*of_pairs, towards), view.their_obstacle):
        near = np.isfinite(gap)
        parts += [
            np.tanh(gap[..., None] / _GAPS),
            np.where(near, (stage + 1) / pair.horizon, 0.0)[..., None],
            pair.turn(way),
        ]
    return np.concatenate(parts, axis=-1)


def _radius(pair: PairView) -> np.ndarray:
    """Return the radii of the robot and of the other."""
    bodies, shape = pair.view.bodies, pair.view.pos.shape[:3]
    return np.stack([np.broadcast_to(one, shape) for one in (bodies.radius[:, None], bodies.others)], axis=-1)


def _mask(pair: PairView) -> np.ndarray:
    """Return the action mask: whether the other's predicted motion comes close to the robot's own plan, or the two
    would soon meet at constant velocities. Otherwise, communication is of no use."""
    view = pair.view
    in_the_way = view.plan_approach.least < _CONFLICT * view.separation
    ahead = view.approach(_LOOK_AHEAD)[0] < _ENCOUNTER * view.separation
    return (in_the_way | ahead)[..., None]


def _critic(pair: PairView) -> np.ndarray:
    """Return features that no robot knows: the prediction errors of both robots, and the distance of their plans."""
    view, stages = pair.view, _stages(pair.horizon)
    prediction, plans = view.prediction, view.of_others(view.absolute_plans)
    certain = replace(prediction, remembered=plans, remembers=np.ones(view.age.shape, bool))
    surprise = certain.believed(stages) - view.own_pos[:, :, None, None] - view.expected(stages)
    size = length(surprise)
    parts = (
        np.clip(_flat(pair.turn(surprise), 3) / ERROR_RANGE, -2, 2),
        np.tanh(size / ERROR_SCALE),
        np.tanh(view.of_the_other(size) / ERROR_SCALE),  # swaps the two robots of a pair
        pair.closeness(view.approach_of(certain).least),
        pair.closeness(view.plan_approach.least),
        view.of_the_other(prediction.remembers)[..., None],
    )
    return np.concatenate(parts, axis=-1)


# Name -> features of all pairs, (E, n, n - 1, any length)
GROUPS: dict[str, Callable[[PairView], np.ndarray]] = {
    "state": _state,
    "approach": _approach,
    "side": _side,
    "memory": _memory,
    "plan": _plan,
    "told": _known_by_other,
    "obstacles": _obstacles,
    "radius": _radius,
    "mask": _mask,
    "critic": _critic,
}


_OWN_GROUPS = frozenset(GROUPS.values())


def _features(name: str, pair: PairView, columns: int | None = None) -> np.ndarray:
    """Return the features of a group.

    :param columns: number of columns that the group returned at first
    :raises ValueError: if a registered group returns something else than finite numbers for every pair
    """
    group = GROUPS[name]
    features = group(pair)
    if group in _OWN_GROUPS:
        return features
    try:
        array = np.asarray(features)
    except (TypeError, ValueError):  # of lists that differ in length
        array = np.array(None)
    pairs = pair.view.pos.shape[:3]
    right = array.ndim == 4 and array.shape[:3] == pairs and array.dtype.kind in "biuf"
    with np.errstate(over="ignore"):
        right = right and bool(np.isfinite(array.astype(np.float32)).all()) and not np.ma.is_masked(features)
    if not right or (columns is not None and array.shape[3] != columns):
        raise ValueError(
            f"The observation {name!r} returned {shown(features)}: it must return finite numbers for every pair, shape "
            f"({', '.join(map(str, pairs))}, {columns or 'any length'}), the same length each time."
        )
    return array


class PairObservation:
    """Pair observation: six numbers about the robot itself, then groups of features about each of the others.

    If the neighbourhood is limited, the features of an empty slot are zero, and the last columns are the numbers of the
    others, counted from 1, with 0 for an empty slot. Critics use these numbers to look up the others' own columns. For
    robots, they are only the action mask.

    :param config: the world
    :param groups: names of `GROUPS`; only critics may read the group "critic"
    :param critics: whether to fill the critic's columns, which are zeros otherwise
    :raises ValueError: if a group is unknown
    """

    def __init__(self, config: SwarmConfig, groups: list[str], critics: bool = True):
        for name in groups:
            if name not in GROUPS:
                raise unknown_name("observation", name, ["paper", *GROUPS])
        self.config = config
        self.groups = [name for name in GROUPS if name in groups]
        columns = {name: self._columns_of(name) for name in self.groups}
        self._sizes = {name: len(about) for name, about in columns.items()}
        self._seen = sum(size for name, size in self._sizes.items() if name != "critic")
        self.columns = of_pairs(columns, config.n_others)
        self._numbers = len(self.columns)  # first column of the others' numbers, if there are any
        self.columns += of_numbers(config.n_others) if config.is_limited else []
        self.size = len(self.columns)
        self._blank = not critics

    def _columns_of(self, name: str) -> list[Column]:
        if GROUPS[name] in _OWN_GROUPS:
            return COLUMNS[name]
        from quad_swarm.world.swarm import Swarm  # which alone tells how many columns a registered group has

        return unnamed(_features(name, self._pair(Swarm(self.config, 1))).shape[-1])

    def _pair(self, knowledge: Knowledge) -> PairView:
        return PairView(View(knowledge), knowledge, self.config)

    @property
    def layout(self) -> dict[str, Any]:
        blocks = np.arange(6, self._numbers).reshape(self.config.n_others, -1)
        seen, hidden = blocks[:, : self._seen], blocks[:, self._seen :]
        layout = {"own": list(range(6)), "neighbours": seen.tolist(), "acts_on_neighbours": True}
        layout |= _numbered(self._numbers, self.size) if self.config.is_limited else {"complete": True}
        if "mask" in self.groups:
            layout["action_mask"] = seen[:, -1].tolist()  # the mask is the last group that robots see
        return layout | ({"critic": hidden.tolist()} if hidden.size else {})

    def __call__(self, knowledge: Knowledge) -> np.ndarray:
        pair = self._pair(knowledge)
        teams = pair.view.pos.shape[:2]
        observed = np.zeros((*teams, self.size), dtype=np.float32)
        observed[..., :6] = _own(pair.view)
        blocks = observed[..., 6 : self._numbers].reshape(*teams, self.config.n_others, -1)  # a view
        column = 0
        for name in self.groups:
            if name != "critic" or not self._blank:
                features = _features(name, pair, self._sizes[name])
                blocks[..., column : column + features.shape[-1]] = features
                column += features.shape[-1]
        if pair.view.present is not None:
            blocks[~pair.view.present] = 0.0
            observed[..., self._numbers :] = knowledge.neighbours.numbers() + 1
        return observed


def make_observation(
    config: SwarmConfig, observation: str = "paper", scale_observation: bool = False, critics: bool = True
) -> Observation:
    """Create an observation.

    :param config: the world
    :param observation: "paper", or names of `GROUPS` joined by "+"
    :param scale_observation: see ``scaled`` of `PaperObservation`
    :param critics: see `PairObservation`
    :raises ValueError: if a name is unknown, or the pair observation should be scaled
    """
    if observation == "paper":
        return PaperObservation(config, scale_observation)
    pairs = PairObservation(config, observation.split("+"), critics)
    if scale_observation:
        raise ValueError(
            f"scale_observation=True is for observation='paper' only; observation={observation!r} is already scaled."
        )
    return pairs
