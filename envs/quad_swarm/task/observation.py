"""What robots observe, as arrays over E swarms, and what each column is about.

The paper's observation is a flat list of relative states. The other one describes every pair (robot, other) by groups
of features in a frame that is turned towards the other, and holds nothing that the robot does not know by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from quad_swarm.errors import unknown_name
from quad_swarm.geometry import length
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.task.view import View
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.swarm import Swarm

# About the largest speed (m/s) and the usual distance (m): divide observations to unit size.
_VELOCITY_SCALE = 4.0
_POSITION_SCALE = 4.0


class Observation(Protocol):
    """How a swarm looks to its robots.

    :ivar size: length of one robot's observation
    """

    size: int

    @property
    def layout(self) -> dict[str, Any]:
        """Which columns are about the robot itself and which about each of the others: `own`, `neighbours`,
        `acts_on_neighbours`, `critic`, those about each of the others that no robot knows when it decides, and
        `action_mask`, whom it may ask, `complete` unless neighbours may be absent, and `who_columns`, who the others
        are, where that changes."""

    def __call__(self, swarm: Swarm) -> np.ndarray:
        """What every robot observes, (E, n, size) float32."""


class PaperObservation:
    """z_i = [v_i, p_ig, {p_ij}, {v_ij}] (Sec. IV-B): own velocity, goal relative to the robot, then all relative
    positions of the others, then all their relative velocities, others in ascending order; length 6n.

    Where the neighbourhood is limited to m others there are m of them, an empty place is all zero, and their numbers
    follow as in `PairObservation`; length 7 m + 6.

    :param config: the world
    :param scaled: divide distances by 4 m and velocities by 4 m/s
    """

    def __init__(self, config: SwarmConfig, scaled: bool = False):
        self.config = config
        self._numbers = 6 * (config.n_others + 1)  # where the numbers of the others begin, if there are any
        self.size = self._numbers + (config.n_others if config.is_limited else 0)
        distance, velocity = (_POSITION_SCALE, _VELOCITY_SCALE) if scaled else (1.0, 1.0)
        others = 3 * config.n_others
        self._scale = np.repeat([velocity, distance, distance, velocity], [3, 3, others, others])

    @property
    def layout(self) -> dict[str, Any]:
        m = self.config.n_others
        others = [[6 + 3 * k + axis + part for part in (0, 3 * m) for axis in range(3)] for k in range(m)]
        layout = {"own": list(range(6)), "neighbours": others, "acts_on_neighbours": True}
        return layout | (_numbered(self._numbers, self.size) if self.config.is_limited else {})

    def __call__(self, swarm: Swarm) -> np.ndarray:
        estimate, (others_pos, others_vel) = swarm.estimate(), swarm.observe()
        pos, vel = estimate[..., POSITION], estimate[..., VELOCITY]
        flat = (*pos.shape[:2], -1)
        relative_pos, relative_vel = others_pos - pos[:, :, None], others_vel - vel[:, :, None]
        present = swarm.neighbours.present
        if present is not None:
            relative_pos[~present], relative_vel[~present] = 0.0, 0.0
        parts = (vel, swarm.goal - pos, relative_pos.reshape(flat), relative_vel.reshape(flat))
        observed = (np.concatenate(parts, axis=-1) / self._scale).astype(np.float32)
        if present is None:
            return observed
        return np.concatenate([observed, swarm.neighbours.numbers() + 1], axis=-1, dtype=np.float32)


def _numbered(first: int, end: int) -> dict[str, Any]:
    """What a layout says of the columns with the numbers of others: also that nobody acts on an empty place."""
    return {"who_columns": list(range(first, end)), "action_mask": list(range(first, end))}


class PairView:
    """A view with vectors turned so that x points horizontally to the other robot and z up, and mirrored so that the
    other moves to the left: what is to be learned about a pair does not depend on either.

    :param view: what the robots know
    :param swarm: everything, for what only critics see
    :param config: the world
    """

    def __init__(self, view: View, swarm: Swarm, config: SwarmConfig):
        self.view, self.swarm = view, swarm
        self.contact = 2 * config.radius
        self.horizon, self.dt = config.planner.horizon, config.planner.dt
        flat = np.hypot(view.pos[..., 0], view.pos[..., 1])
        above = flat < 1e-6
        self.cos = np.where(above, 1.0, view.pos[..., 0] / np.maximum(flat, 1e-6))
        self.sin = np.where(above, 0.0, view.pos[..., 1] / np.maximum(flat, 1e-6))
        self.side = np.where(self.cos * view.vel[..., 1] < self.sin * view.vel[..., 0], -1.0, 1.0)

    def turn(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors along the world's axes, (E, n, n - 1, ..., 3), seen from the pair's frame."""
        more = (1,) * (vectors.ndim - self.cos.ndim - 1)
        cos, sin, side = (a.reshape(a.shape + more) for a in (self.cos, self.sin, self.side))
        x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
        return np.stack([cos * x + sin * y, side * (cos * y - sin * x), z], axis=-1)

    def closeness(self, distance: np.ndarray) -> np.ndarray:
        """A distance at several magnifications around contact, (..., 3)."""
        return np.tanh((distance - self.contact)[..., None] / _MAGNIFICATIONS)


_MAGNIFICATIONS = np.array([0.05, 0.2, 1.0])
# Usual speed (m/s), which brings velocities in pairs' features to unit size.
_SPEED = 1.5
# Stages of a trajectory that are looked at, out of 1..N, as fractions of N.
_STAGES = (0.2, 0.5, 1.0)
# Of what the planner keeps: plans that come no nearer than this are hardly changed by each other. 1.1 is enough for
# eight robots; in a crowd of sixteen it leaves twice as many collisions.
_CONFLICT = 1.8
# Who would come nearer than this many separations within so many seconds
_ENCOUNTER, _LOOK_AHEAD = 1.2, 3.0


def _stages(horizon: int) -> list[int]:
    return [max(round(fraction * horizon), 1) - 1 for fraction in _STAGES]


def _flat(array: np.ndarray, keep: int) -> np.ndarray:
    return array.reshape(*array.shape[:keep], -1)


def _own(view: View) -> np.ndarray:
    """Own velocity and goal, in a frame whose x points horizontally to the goal: (E, n, 6)."""
    goal, vel = view.goal, view.own_vel
    flat = np.hypot(goal[..., 0], goal[..., 1])
    cos, sin = (goal[..., k] / np.maximum(flat, 1e-6) for k in (0, 1))
    along, across = cos * vel[..., 0] + sin * vel[..., 1], cos * vel[..., 1] - sin * vel[..., 0]
    columns = (
        along / _SPEED,
        across / _SPEED,
        vel[..., 2],
        flat / _POSITION_SCALE,
        np.minimum(flat, 1.0),
        goal[..., 2],
    )
    return np.stack(columns, axis=-1)


def _state(pair: PairView) -> np.ndarray:
    """Positions, velocities and the own goal."""
    view = pair.view
    distance = length(view.pos)
    own_vel, goal = (np.broadcast_to(a[:, :, None], view.pos.shape) for a in (view.own_vel, view.goal))
    to_goal = goal / np.maximum(length(goal)[..., None], 1.0)
    parts = (
        np.stack([distance / _POSITION_SCALE, view.pos[..., 2]], axis=-1),
        pair.closeness(distance)[..., 1:],
        pair.turn(view.vel) / _SPEED,
        pair.turn(own_vel) / _SPEED,
        pair.turn(to_goal),
    )
    return np.concatenate(parts, axis=-1)


def _approach(pair: PairView) -> np.ndarray:
    """When and how close the two would come with constant velocities."""
    distance, time = pair.view.approach(4.0)
    times = np.stack([time / 4.0, np.exp(-time / 0.3), np.exp(-time)], axis=-1)
    return np.concatenate([pair.closeness(distance), times], axis=-1)


def _side(pair: PairView) -> np.ndarray:
    """On which side the other would pass with constant velocities, which the mirrored frame hides: it matters where the
    planner keeps to a right of way."""
    pos, vel = pair.view.pos, pair.view.vel
    speed = np.hypot(vel[..., 0], vel[..., 1])
    # Positive: the other is to the left of where the robot goes relative to it, as it should be.
    miss = (vel[..., 1] * pos[..., 0] - vel[..., 0] * pos[..., 1]) / np.maximum(speed, 1e-6)
    return np.stack([pair.side, np.tanh(miss / 0.2), np.tanh(miss)], axis=-1)


def _memory(pair: PairView) -> np.ndarray:
    """The plan received last: its age, how far off it is, and where it departs from a constant velocity."""
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
    """The own plan against what is expected of the other."""
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


def _told(pair: PairView) -> np.ndarray:
    """What the other knows of this robot: whether it still believes a plan that it was told, and how far it is off."""
    view, stages = pair.view, _stages(pair.horizon)
    told = view.presumed(stages)
    off = view.plan[:, :, None, stages] - (told.believed - view.own_pos[:, :, None, None])
    parts = (
        np.stack(
            [told.remembers.astype(float), np.minimum(told.age / pair.horizon, 1.0), np.exp(2 - told.age)], axis=-1
        ),
        np.tanh(length(off) / 0.1),
        np.clip(2 * _flat(pair.turn(off[..., 1:, :]), 3), -2, 2),
    )
    return np.concatenate(parts, axis=-1)


def _mask(pair: PairView) -> np.ndarray:
    """Whom there is any use in telling or asking: who comes near the own plan as far as is known, or would soon come
    near if both kept their velocities."""
    view = pair.view
    in_the_way = view.plan_approach.least < _CONFLICT * view.separation
    ahead = view.approach(_LOOK_AHEAD)[0] < _ENCOUNTER * view.separation
    return (in_the_way | ahead)[..., None]


def _critic(pair: PairView) -> np.ndarray:
    """What no robot knows: how wrong the two are about each other, and how close their plans are."""
    view, stages = pair.view, _stages(pair.horizon)
    prediction, plans = view.prediction, view.of_others(view.absolute_plans)
    certain = replace(prediction, remembered=plans, remembers=np.ones(view.age.shape, bool))
    surprise = certain.believed(stages) - view.own_pos[:, :, None, None] - view.expected(stages)
    size = length(surprise)
    parts = (
        np.clip(2 * _flat(pair.turn(surprise), 3), -2, 2),
        np.tanh(size / 0.1),
        np.tanh(view.of_the_other(size) / 0.1),  # the other's view of this robot
        pair.closeness(certain.approach(view.own_pos, view.plan).least),
        pair.closeness(view.plan_approach.least),
        view.of_the_other(prediction.remembers)[..., None],
    )
    return np.concatenate(parts, axis=-1)


# Name -> features of every pair, (E, n, n - 1, any number).
GROUPS: dict[str, Callable[[PairView], np.ndarray]] = {
    "state": _state,
    "approach": _approach,
    "side": _side,
    "memory": _memory,
    "plan": _plan,
    "told": _told,
    "mask": _mask,
    "critic": _critic,
}


class PairObservation:
    """A row of a robot: six numbers of its own, then for each of the others the features of some groups.

    Where the neighbourhood is limited, an empty place is all zero, and at the end stand the numbers of the others, from
    1 on, 0: nobody. Critics need them to find the other's own part; robots only act on those that are there.

    :param config: the world
    :param groups: names of `GROUPS`; "critic" holds what only critics may read
    :param critics: whether there are any; otherwise their columns are zeros
    :raises ValueError: unknown group
    """

    def __init__(self, config: SwarmConfig, groups: list[str], critics: bool = True):
        for name in groups:
            if name not in GROUPS:
                raise unknown_name("observation", name, ["paper", *GROUPS])
        self.config = config
        self.groups = [name for name in GROUPS if name in groups]
        sizes = [GROUPS[name](self._pair(Swarm(config, 1))).shape[-1] for name in self.groups]
        self._seen = sum(sizes) - (sizes[-1] if self.groups[-1] == "critic" else 0)
        self._numbers = 6 + config.n_others * sum(sizes)  # where the numbers of the others begin, if there are any
        self.size = self._numbers + (config.n_others if config.is_limited else 0)
        self._blank = 0 if critics else sum(sizes) - self._seen

    def _pair(self, swarm: Swarm) -> PairView:
        return PairView(View(swarm), swarm, self.config)

    @property
    def layout(self) -> dict[str, Any]:
        blocks = np.arange(6, self._numbers).reshape(self.config.n_others, -1)
        seen, hidden = blocks[:, : self._seen], blocks[:, self._seen :]
        layout = {"own": list(range(6)), "neighbours": seen.tolist(), "acts_on_neighbours": True}
        layout |= _numbered(self._numbers, self.size) if self.config.is_limited else {"complete": True}
        if "mask" in self.groups:
            layout["action_mask"] = seen[:, -1].tolist()  # the last group that robots see
        return layout | ({"critic": hidden.tolist()} if hidden.size else {})

    def __call__(self, swarm: Swarm) -> np.ndarray:
        pair = self._pair(swarm)
        teams = pair.view.pos.shape[:2]
        observed = np.zeros((*teams, self.size), dtype=np.float32)
        observed[..., :6] = _own(pair.view)
        blocks = observed[..., 6 : self._numbers].reshape(*teams, self.config.n_others, -1)  # a view
        column = 0
        for name in self.groups:
            if name != "critic" or not self._blank:
                features = GROUPS[name](pair)
                blocks[..., column : column + features.shape[-1]] = features
                column += features.shape[-1]
        if pair.view.present is not None:
            blocks[~pair.view.present] = 0.0
            observed[..., self._numbers :] = swarm.neighbours.numbers() + 1
        return observed


def make_observation(
    config: SwarmConfig, observation: str = "paper", scale_observation: bool = False, critics: bool = True
) -> Observation:
    """What robots observe.

    :param config: the world
    :param observation: "paper", or names of `GROUPS` joined by "+"
    :param scale_observation: of the paper's, see there
    :param critics: see `PairObservation`
    :raises ValueError: unknown name, or scaling of what is scaled
    """
    if observation == "paper":
        return PaperObservation(config, scale_observation)
    pairs = PairObservation(config, observation.split("+"), critics)
    if scale_observation:
        raise ValueError(
            f"scale_observation=True is for observation='paper' alone; observation={observation!r} is scaled already."
        )
    return pairs
