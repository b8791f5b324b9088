"""A delay check like RMADER's (Kondo et al. 2023), as a baseline for late plans.

A robot flies a committed plan, which ends at rest. Meanwhile it plans from its future position, announces the candidate
together with its committed plan, and commits to the candidate only if no plan that arrives until then comes close to
it. Plans must avoid everything that others announced, so that two robots cannot both rely on plans that the other has
abandoned. Differences from RMADER: plans come from the same solver as elsewhere instead of splines and are compared at
the planner's stages, linear feedback keeps the vehicle on its plan, and robots and steps share a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_swarm.evaluation.evaluation import Rows
from quad_swarm.geometry import length
from quad_swarm.native.pairs import advance
from quad_swarm.planner import Planner, Plans, Problems, make_planner
from quad_swarm.quadrotor import N_INPUTS, POSITION, QuadrotorModel
from quad_swarm.world.beliefs import BeliefSource, resampled
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.swarm import StepReport, Swarm
from studies.swarm.experiment import fly_swarm

COMMITTED, CANDIDATE = 0, 1
_CHUNK = 100  # episodes per batch


class DelayCheckedSwarm(Swarm):
    """Swarm whose robots broadcast committed and candidate plans and check the candidates.

    :param config: the world; answers are late by ``radio.delay`` steps, without jitter
    :param n_swarms: number of swarms E
    :param clearance: minimum distance between a candidate and the plans that others announced (m)
    :param solver: see `make_planner`
    :raises ValueError: if there is jitter, or robots would keep to plans that they sent
    """

    def __init__(self, config: SwarmConfig, n_swarms: int, clearance: float, solver: str = "rti"):
        if config.radio.jitter:
            raise ValueError(f"radio.jitter={config.radio.jitter}: the check assumes a constant delay, set it to 0.")
        if config.planner.commitment:
            raise ValueError(f"planner.commitment={config.planner.commitment:g}: set it to 0.")
        super().__init__(config, n_swarms, solver)
        n, horizon = config.n_robots, config.planner.horizon
        # Each of the others counts twice, with its committed and its candidate plan
        self.planner: Planner = make_planner(config.planner, config.quadrotor, 2 * n - 1, solver)
        self.clearance = clearance
        self.wait = 1 + config.radio.delay  # steps until all robots know each other's candidates
        self._stages = 2 * horizon + self.wait  # number of stages of a plan that ends at rest, from now on
        assert isinstance(self.planner.model, QuadrotorModel)
        self._feedback = _feedback(self.planner.model)
        # Plans and braking to rest, from now on, (E, n, committed or candidate, ...)
        self._x = np.zeros((n_swarms, n, 2, self._stages + 1, 9))
        self._inputs = np.zeros((n_swarms, n, 2, self._stages, N_INPUTS))
        self._pending = np.zeros((n_swarms, n), dtype=np.int64)  # steps until a candidate is flown, 0 for none
        self._known = np.zeros((n_swarms, n, n - 1, 2, self._stages + 1, 3))
        self._sent: list[np.ndarray] = []

    def keep(self, swarms: np.ndarray) -> None:
        super().keep(swarms)
        for name in ("_x", "_inputs", "_pending", "_known"):
            setattr(self, name, getattr(self, name)[swarms])
        self._sent = [sent[swarms] for sent in self._sent]

    def reset(self, swarm: int, *episode: Any, **options: Any) -> None:
        super().reset(swarm, *episode, **options)
        self._x[swarm] = self.state[swarm][:, None, None]
        self._inputs[swarm] = 0.0
        self._pending[swarm] = 0
        self._known[swarm] = self.pos[swarm][self.neighbours.others][:, :, None, None]
        self._sent = [self._announced() for _ in range(self.wait)]

    def _announced(self) -> np.ndarray:
        """Return the positions that robots broadcast, from now on, by the steps' clock, (E, n, 2, stages + 1, 3)."""
        pos = self._x[..., POSITION]
        start = self.disturbances.start
        return pos if start is None else resampled(pos, -np.repeat(start[..., None], 2, 2) / self.config.substeps)

    def _receive(self, requests: np.ndarray) -> np.ndarray:
        """Receive broadcasts.

        :return: each robot's knowledge of the others, from the time at which its input takes effect,
            (E, n, n - 1, 2, stages + 1, 3)
        """
        self._sent = [advance(sent) for sent in self._sent]
        others = self.neighbours.others
        arriving, _ = self.disturbances.arrivals(self.disturbances.carried(requests, self.pos, others), others)
        newest = self._sent[0][:, others]
        self._known = np.where(arriving[..., None, None, None], newest, advance(self._known))
        start = self.disturbances.start
        if start is None:
            return self._known
        return resampled(
            self._known, np.broadcast_to((start / self.config.substeps)[..., None, None], self._known.shape[:4])
        )

    def _comes_near(self, known: np.ndarray) -> np.ndarray:
        """Return whether each candidate comes close to a known plan of another robot, (E, n) bool."""
        own = self._x[:, :, None, None, CANDIDATE, :, POSITION]
        return length(own - known)[..., 1:].min(axis=(2, 3, 4)) < self.clearance

    def step(self, requests: np.ndarray, announced: np.ndarray | None = None) -> StepReport:
        for field in (self._x, self._inputs):
            field[..., :-1, :] = field[..., 1:, :].copy()
        self._inputs[..., -1, :] = 0.0
        known = self._receive(requests)
        pushed = None
        if self.disturbance is not None:
            self.disturbance.update(self.estimate())
            pushed = self.disturbance.acceleration

        waiting = self._pending > 0
        dropped = waiting & self._comes_near(known)
        self._pending[waiting] -= 1
        accepted = waiting & ~dropped & (self._pending == 0)
        self._take(accepted, COMMITTED, CANDIDATE)
        self._pending[dropped] = 0
        self._take(dropped, CANDIDATE, COMMITTED)
        self._plan(self._pending == 0, known)

        self._sent = [*self._sent[1:], self._announced()]
        x, start = self.estimate(), self.disturbances.start
        if start is not None:
            x = self.planner.model.ahead(x, self._u, start / self.config.substeps * self.config.planner.dt, pushed)
        inputs = self._inputs[:, :, COMMITTED].copy()
        inputs[:, :, 0] += (self._x[:, :, COMMITTED, 0] - x) @ self._feedback.T
        planner = self.config.planner
        most = np.array([planner.max_tilt, planner.max_tilt, planner.max_climb_rate, 0.0])
        least = np.array([-planner.max_tilt, -planner.max_tilt, -planner.descent_rate, 0.0])
        inputs[:, :, 0] = np.clip(inputs[:, :, 0], least, most)
        horizon, count = self.config.planner.horizon, self._pending.size
        flown, none = self._x[:, :, COMMITTED, : horizon + 1], np.zeros(count, dtype=np.int64)
        self._plans = Plans(
            flown.reshape(count, horizon + 1, 9).copy(),
            inputs.reshape(count, -1, N_INPUTS)[:, :horizon],
            none,
            none,
            none,
        )
        if self.disturbance is not None:
            self.disturbance.expect(x, self.inputs, self._late)
        source = np.full(requests.shape, BeliefSource.REQUESTED)
        return self._report(self._fly(), source, 0.0)

    def _take(self, who: np.ndarray, to: int, what: int) -> None:
        self._x[who, to], self._inputs[who, to] = self._x[who, what], self._inputs[who, what]

    def _plan(self, who: np.ndarray, known: np.ndarray) -> None:
        """Plan candidates of some robots from their positions after the wait, and keep those that pass the check."""
        if not who.any():
            return
        horizon, wait = self.config.planner.horizon, self.wait
        x = self._x[who, COMMITTED]
        others = known[who][..., wait + 1 : wait + 1 + horizon, :].reshape(len(x), -1, horizon, 3)
        problems = Problems(x[:, wait], self.goal[who], others, announced=np.ones(others.shape[:2], dtype=bool))
        if self.disturbance is not None:
            problems = problems._replace(disturbance=self.disturbance.acceleration[who])
        last = slice(wait - 1, wait + horizon)
        none = np.zeros(len(x), dtype=np.int64)
        inputs = self._inputs[who, COMMITTED]
        plans = self.planner.plan(problems, Plans(x[:, last], inputs[:, last][:, :horizon], none, none, none))
        tail = self.planner.braking_inputs(plans.x[:, -1], problems.disturbance)
        rest = self.planner.model.rollout(plans.x[:, -1], tail, problems.disturbance)
        self._x[who, CANDIDATE] = np.concatenate([x[:, :wait], plans.x, rest[:, 1:]], axis=1)
        self._inputs[who, CANDIDATE] = np.concatenate([inputs[:, :wait], plans.u, tail], axis=1)
        refused = who & self._comes_near(known)
        self._take(refused, CANDIDATE, COMMITTED)
        self._pending[who & ~refused] = wait


def _feedback(model: QuadrotorModel) -> np.ndarray:
    """Return the gain, (4, 9), of a linear-quadratic regulator at hover."""
    eye, zero = np.eye(9), np.zeros((9, 9))
    a = (model.step(1e-4 * eye, zero[:, :4]) / 1e-4).T
    b = (model.step(zero[:4], 1e-4 * np.eye(4)) / 1e-4).T
    cost, weight = np.diag([10.0] * 3 + [1.0] * 3 + [0.1] * 3), np.diag([1.0] * 4)
    value = cost
    for _ in range(500):
        gain = np.linalg.solve(weight + b.T @ value @ b, b.T @ value @ a)
        value = cost + a.T @ value @ (a - b @ gain)
    return gain


def fly(config: SwarmConfig, scenario: str, clearance: float, episodes: Sequence[int]) -> Rows:
    """Fly episodes with the check and return their statistics, see `run_episodes`.

    :param config: the world
    :param scenario: name of the scenario
    :param clearance: see `DelayCheckedSwarm`
    :param episodes: seeds
    """
    chunks = [episodes[k : k + _CHUNK] for k in range(0, len(episodes), _CHUNK)]
    return [
        row
        for chunk in chunks
        for row in fly_swarm(DelayCheckedSwarm(config, len(chunk), clearance), scenario, "full", chunk)
    ]
