"""Beliefs of each robot about the others' motion (Sec. III-C and IV-A).

A robot believes, in order of preference: the plan it requested (made one step ago), unless it is older than the horizon
or grossly contradicts what the robot observes; the plan it received earlier, as long as it fits what the robot
observes; and a constant velocity, or what `quad_swarm.world.anticipation` predicts.

Arrays have a leading axis of E swarms. Axes of length n - 1 list the others of a robot in ascending order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.native import pairs
from quad_swarm.states import like
from quad_swarm.world.anticipation import Anticipation, Outlook, Scene


class BeliefSource(IntEnum):
    """Origin of a believed trajectory."""

    CONSTANT_VELOCITY = 0  # or what `SwarmConfig.predictor` predicts
    REMEMBERED = 1
    REQUESTED = 2


@cache
def other_indices(n_robots: int) -> np.ndarray:
    """Return the indices of each robot's others in ascending order, (n, n - 1), read-only."""
    below = np.arange(n_robots - 1, dtype=np.int64)
    others = below + (below >= np.arange(n_robots)[:, None])
    others.setflags(write=False)
    return others


@cache
def reverse_indices(n_robots: int) -> np.ndarray:
    """Return the position of each robot in the rows of its others in `other_indices`, (n, n - 1), read-only."""
    numbers = np.arange(n_robots, dtype=np.int64)[:, None]
    reverse = numbers - (numbers > other_indices(n_robots))
    reverse.setflags(write=False)
    return reverse


def of_others(field: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the values of each robot's others, (E, n, n - 1, ...).

    :param field: values of all robots, (E, n, ...)
    :param others: see `other_indices` or `Neighbours.others`
    """
    return field.take(others, axis=1) if others.ndim == 2 else field[np.arange(len(others))[:, None, None], others]


def resampled(trajectory: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Resample trajectories, (..., K, 3), at times that are later by fractions of a step, (...). The fractions must all
    lie in [0, 1) or all in (-1, 0]. Interpolation is linear, as is extrapolation of the first and last segments."""
    flat = trajectory.reshape(*trajectory.shape[:-2], -1)
    pieces = flat[..., 3:] - flat[..., :-3]
    pieces *= later[..., None]
    moved = flat.copy()
    if (later >= 0).all():
        moved[..., :-3] += pieces
        moved[..., -3:] += pieces[..., -3:]
    else:
        moved[..., 3:] += pieces
        moved[..., :3] += pieces[..., :3]
    return moved.reshape(trajectory.shape)


def answered(arriving: np.ndarray, trajectories: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Select the trajectories that robots receive.

    :param arriving: whose trajectory each robot receives, (E, n, n - 1) bool
    :param trajectories: trajectories of all robots, (E, n, K, 3)
    :param others: see `other_indices` or `Neighbours.others`
    :return: received trajectories in the order of the true entries of ``arriving``, (number of answers, K, 3)
    """
    swarms, robots, slots = np.nonzero(arriving)
    senders = others[robots, slots] if others.ndim == 2 else others[swarms, robots, slots]
    return trajectories[swarms, senders]


class PlanApproach(NamedTuple):
    """Distances between a plan and the believed trajectories of the others.

    :param least: smallest distance over the next N steps, (E, n, n - 1) (m)
    :param stage: first step at which it is reached, counting from 0, (E, n, n - 1)
    :param last: distance at the last step, (E, n, n - 1) (m)
    """

    least: np.ndarray
    stage: np.ndarray
    last: np.ndarray


@dataclass(frozen=True)
class Prediction:
    """Predictions of the others without requests.

    :param pos: positions of the others, (E, n, n - 1, 3), world frame (m)
    :param vel: velocities of the others, (E, n, n - 1, 3), world frame (m/s)
    :param remembered: newest received plans, from now on, (E, n, n - 1, N + 1, 3), world frame (m)
    :param remembers: whether the plan is believed, otherwise a constant velocity or the outlook, (E, n, n - 1) bool
    :param age: steps since the newest received plan was made, N or more without one, (E, n, n - 1)
    :param error: current error of that plan, (E, n, n - 1) (m)
    :param dt: length of a stage (s)
    :param outlook: what a network predicts, None for constant velocities
    """

    pos: np.ndarray
    vel: np.ndarray
    remembered: np.ndarray
    remembers: np.ndarray
    age: np.ndarray
    error: np.ndarray
    dt: float
    outlook: Outlook | None = None

    @cached_property
    def _settled(self) -> Prediction:
        """The same with predicted trajectories in place of plans that are not believed."""
        if self.outlook is None or self.remembers.all():
            return self
        expected = self.outlook.others(self.remembers)
        expected[self.remembers] = self.remembered[self.remembers]
        return replace(self, remembered=expected, remembers=np.ones_like(self.remembers), outlook=None)

    def believed(self, stages: Sequence[int] | None = None) -> np.ndarray:
        """Return predicted positions, (E, n, n - 1, stages, 3), world frame (m).

        :param stages: indices among the next N steps, counting from 0; None for all
        """
        now = self._settled
        return pairs.believe(now.pos, now.vel, now.remembered, now.remembers, now.dt, stages)

    def flattened(self, factor: float) -> Prediction:
        """Return the prediction with heights and vertical velocities multiplied by a factor, itself for 1."""
        if factor == 1:
            return self
        flat, now = np.array([1.0, 1.0, factor]), self._settled
        return replace(now, pos=flat * now.pos, vel=flat * now.vel, remembered=flat * now.remembered)

    def approach(self, own: np.ndarray, plan: np.ndarray) -> PlanApproach:
        """Compute the distances between plans and predictions.

        :param own: positions of the robots, (E, n, 3), world frame (m)
        :param plan: planned positions at the next N steps relative to ``own``, (E, n, N, 3) (m)
        """
        now = self._settled
        return PlanApproach(*pairs.approach(own, plan, now.pos, now.vel, now.remembered, now.remembers, now.dt))


class Beliefs:
    """The believed trajectories of E swarms, and the memory of received plans.

    :param n_swarms: number of swarms E
    :param n_robots: number of robots n per swarm
    :param horizon: number of stages N of a plan
    :param dt: length of a stage (s)
    :param memory: an earlier plan is believed as long as it predicts the observed position to within this distance (m)
        and is younger than N steps; 0 disables the memory
    :param n_others: number of others that a robot has beliefs about, by default all n - 1
    :param misfit: a plan that arrives is believed if it is younger than N steps and predicts the observed position to
        within this distance (m)
    :param anticipation: how robots predict others whose plan they do not believe, None for constant velocities
    :raises ValueError: if ``memory`` is negative or NaN
    """

    def __init__(
        self,
        n_swarms: int,
        n_robots: int,
        horizon: int,
        dt: float,
        memory: float,
        n_others: int | None = None,
        misfit: float = math.inf,
        anticipation: Anticipation | None = None,
    ):
        if not memory >= 0:
            raise ValueError(f"memory={memory}: it must be a distance in metres, or 0 to disable the memory.")
        self.horizon = horizon
        self.dt = dt
        self.memory = memory
        self.misfit = max(misfit, memory)
        self._anticipation = anticipation
        shape = (n_swarms, n_robots, n_robots - 1 if n_others is None else n_others)
        # Remembered positions now and at the next N steps, and steps since they were planned, N or more without a plan
        self._remembered = np.zeros((*shape, horizon + 1, 3))
        self._age = np.full(shape, horizon, dtype=np.int64)
        # Cache of the last prediction, which policies and the step both need
        self._known: Prediction | None = None

    @property
    def age(self) -> np.ndarray:
        """Steps since each believed plan was made, as of the last `update`, (E, n, n - 1)."""
        return self._age

    def forget(self, swarms: np.ndarray) -> None:
        """Forget every received plan in the given swarms (indices or mask)."""
        self._age[swarms] = self.horizon
        if self._anticipation is not None:
            self._anticipation.forget(swarms)
        self._known = None

    def forget_others(self, slots: np.ndarray) -> None:
        """Forget the plans received from some of the others, (E, n, n - 1) bool."""
        self._age[slots] = self.horizon
        self._remembered[slots] = 0.0
        if self._anticipation is not None:
            self._anticipation.forget_others(slots)
        self._known = None

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (indices or mask)."""
        self._remembered, self._age = self._remembered[swarms], self._age[swarms]
        if self._anticipation is not None:
            self._anticipation = self._anticipation.kept(swarms)
        self._known = None

    def state_dict(self) -> dict[str, Any]:
        """Return the memory, see `load_state_dict`."""
        state: dict[str, Any] = {"remembered": self._remembered.copy(), "age": self._age.copy()}
        if self._anticipation is not None:
            state["anticipation"] = self._anticipation.state_dict()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a memory from `state_dict`.

        :raises ValueError: if the state belongs to other swarms
        """
        self._remembered = like(self._remembered, state["remembered"], "remembered plans")
        self._age = like(self._age, state["age"], "ages of plans", 0)
        if self._anticipation is not None:
            self._anticipation.load_state_dict(state["anticipation"])
        self._known = None

    def predict(self, pos: np.ndarray, vel: np.ndarray, scene: Scene | None = None) -> Prediction:
        """Predict the others without requests. Call this before `update` of the same step.

        :param pos: current positions of the others, (E, n, n - 1, 3), world frame (m)
        :param vel: current velocities of the others, (E, n, n - 1, 3), world frame (m/s)
        :param scene: what robots see beside them, which `Anticipation` needs
        """
        known = self._known
        if known is None or np.count_nonzero(known.pos != pos) or np.count_nonzero(known.vel != vel):
            known = self._known = self._predict(pos.copy(), vel.copy(), scene)
        return known

    def _predict(self, pos: np.ndarray, vel: np.ndarray, scene: Scene | None) -> Prediction:
        if self.memory:
            remembered, age, error, remembers = pairs.remember(self._remembered, self._age, pos, self.memory)
        else:
            remembered, age = self._remembered, np.full(self._age.shape, self.horizon)
            error, remembers = np.zeros(age.shape), np.zeros(age.shape, dtype=bool)
        outlook = None
        if self._anticipation is not None:
            assert scene is not None
            outlook = self._anticipation.look(pos, vel, scene)
        return Prediction(pos, vel, remembered, remembers, age, error, self.dt, outlook)

    def update(
        self,
        arriving: np.ndarray,
        pos: np.ndarray,
        vel: np.ndarray,
        received: np.ndarray,
        age: np.ndarray | int = 1,
        scene: Scene | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the believed trajectories after this step's requests. The arguments are those of `receive`.

        :return: believed positions at the next N steps, (E, n, n - 1, N, 3) (m), and their `BeliefSource`,
            (E, n, n - 1)
        """
        believed, source = self._receive(arriving, pos, vel, received, age, scene, predicts=True)
        assert believed is not None
        assert source is not None
        return believed, source

    def receive(
        self,
        arriving: np.ndarray,
        pos: np.ndarray,
        vel: np.ndarray,
        received: np.ndarray,
        age: np.ndarray | int = 1,
        scene: Scene | None = None,
    ) -> None:
        """Remember received plans and advance the memory by a step.

        :param arriving: whose plans each robot receives, (E, n, n - 1) bool
        :param pos: current positions of the others, (E, n, n - 1, 3), world frame (m)
        :param vel: current velocities of the others, (E, n, n - 1, 3), world frame (m/s)
        :param received: received plans as positions now and at the next N steps, (number of answers, N + 1, 3) (m),
            see `answered`
        :param age: steps since each of these plans was made, (number of answers,), of which those that are older than
            the known plan are ignored; or one number for all
        :param scene: see `predict`
        """
        self._receive(arriving, pos, vel, received, age, scene, predicts=False)

    def _receive(
        self,
        arriving: np.ndarray,
        pos: np.ndarray,
        vel: np.ndarray,
        received: np.ndarray,
        age: np.ndarray | int,
        scene: Scene | None,
        predicts: bool,
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        now = self.predict(pos, vel, scene)
        # Before received plans overwrite remembered ones
        expected = now.believed() if now.outlook is not None and predicts else None
        known = pairs.Known(now.pos, now.vel, now.remembers, now.age, now.remembered)
        arguments = (arriving, received, age, self.dt, bool(self.memory), predicts, self.misfit)
        self._age, believed, source = pairs.receive(known, *arguments)
        if expected is not None:
            assert believed is not None
            unknown = source == int(BeliefSource.CONSTANT_VELOCITY)
            believed[unknown] = expected[unknown]
        if self._anticipation is not None:
            self._anticipation.advance()
        self._remembered = now.remembered  # no one else uses it any more
        self._known = None
        return believed, source
