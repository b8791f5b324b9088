"""Realisations of the disturbances in E swarms: the errors, gusts and losses that occur."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy, deepcopy
from typing import Any

import numpy as np

from quad_swarm.quadrotor import N_STATES, VEHICLE_PARAMETERS
from quad_swarm.states import generator_of, generator_state, like
from quad_swarm.world.beliefs import of_others
from quad_swarm.world.presets import SwarmConfig

OUTAGE_WITHIN = 5.0  # time from the start of an episode within which robots stop answering (s)
_NEVER = np.iinfo(np.int64).max


class Realisation:
    """Random disturbances of E swarms. Each swarm has its own random number generator, so that an episode does not
    depend on the batch it is in.

    :param config: the world
    :param n_swarms: number of swarms E
    :ivar air: velocity of the air at each robot, (E, n, 2) (m/s)
    :ivar factors: factors of each robot's vehicle parameters, (E, n, 8); None without mismatch
    :ivar start: sub-step at which each robot's new input takes effect, (E, n); None if it is always the first
    """

    _SIGHT = ("_lost", "_past")
    _ARRAYS = ("_wind", "_gust", "_own", "_observer", "_factors", "_start", "_down", "_silent_from", "_step", *_SIGHT)

    def __init__(self, config: SwarmConfig, n_swarms: int):
        n, dt = config.n_robots, config.planner.dt
        self.config = config
        self._rngs = [np.random.default_rng(0) for _ in range(n_swarms)]
        self._wind = np.zeros((n_swarms, n, 2))
        self._gust = np.zeros((n_swarms, n, 2))
        self._own = np.zeros((n_swarms, n, N_STATES))
        self._observer = np.zeros((n_swarms, n, config.n_others, 6))
        self._factors = np.ones((n_swarms, n, len(VEHICLE_PARAMETERS)))
        self._start = np.zeros((n_swarms, n), dtype=np.int64)
        self._down = np.zeros((n_swarms, n, config.n_others), dtype=bool)
        self._silent_from = np.full((n_swarms, n), _NEVER)
        self._step = np.zeros(n_swarms, dtype=np.int64)
        self._lost = np.zeros((n_swarms, n), dtype=bool)
        # Where the others would observe each robot without a delay, in the last steps, newest first
        self._past = np.zeros((n_swarms, config.sensing.others_delay + 1, n, 6))

        noise, sensing = config.noise, config.sensing
        # Scales of position, velocity and attitude; yaw has no noise
        self._kick = _by_state(noise.pos, noise.vel, noise.attitude)
        self._own_scale = _by_state(sensing.pos, sensing.vel, sensing.attitude)
        self._observer_scale = np.repeat([sensing.others_pos, sensing.others_vel], 3)
        self._gust_keeps = _keeps(dt, noise.gust_time)
        self._errors_keep = _keeps(dt, sensing.correlation_time)
        self._latest_start = int(config.clock_skew * config.substeps)

    @property
    def air(self) -> np.ndarray:
        return self._wind + self._gust if self.config.noise.gust else self._wind

    @property
    def factors(self) -> np.ndarray | None:
        return self._factors if self.config.mismatch else None

    @property
    def start(self) -> np.ndarray | None:
        return self._start if self._latest_start else None

    def reset(self, swarm: int, seed: int, states: np.ndarray) -> None:
        """Draw the constants of an episode of one swarm, and initialise its random processes.

        :param states: states at the start, (n, 9)
        """
        config, radio = self.config, self.config.radio
        rng = self._rngs[swarm] = np.random.default_rng(seed)
        direction = rng.uniform(0, 2 * np.pi)
        self._wind[swarm] = config.noise.wind * np.array([np.cos(direction), np.sin(direction)])
        self._step[swarm] = 0
        if config.mismatch:
            self._factors[swarm] = 1 + config.mismatch * rng.uniform(-1, 1, self._factors.shape[1:])
        if self._latest_start:
            self._start[swarm] = rng.integers(0, self._latest_start + 1, self._start.shape[1:])
        if radio.outage:
            fails = rng.random(self._silent_from.shape[1:]) < radio.outage
            when = rng.integers(0, max(round(OUTAGE_WITHIN / config.planner.dt), 1), fails.shape)
            self._silent_from[swarm] = np.where(fails, when, _NEVER)
        if radio.bursts:
            self._down[swarm] = rng.random(self._down.shape[1:]) < radio.bursts
        if config.noise.gust:
            self._gust[swarm] = config.noise.gust * rng.normal(size=self._gust.shape[1:])
        if config.sensing.own:
            self._own[swarm] = self._own_scale * rng.normal(size=self._own.shape[1:])
        if config.sensing.others:
            self._observer[swarm] = self._observer_scale * rng.normal(size=self._observer.shape[1:])
        self._lost[swarm] = False
        if config.sensing.tracks:
            seen, ages = (states + self._own[swarm])[..., :6], np.arange(self._past.shape[1])
            self._past[swarm] = _moved_on(seen, -config.planner.dt * ages[:, None, None])

    def draw_for_new_neighbours(self, slots: np.ndarray) -> None:
        """Draw new observation errors and link states for slots with new robots.

        :param slots: whether the slot has a new robot, (E, n, n - 1) bool
        """
        for swarm in np.flatnonzero(slots.any(axis=(1, 2))):
            where, rng = slots[swarm], self._rngs[swarm]
            count = int(where.sum())
            if self.config.radio.bursts:
                self._down[swarm, where] = rng.random(count) < self.config.radio.bursts
            if self.config.sensing.others:
                self._observer[swarm, where] = self._observer_scale * rng.normal(size=(count, 6))

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        for name in self._ARRAYS:
            setattr(self, name, getattr(self, name)[swarms])
        self._rngs = [rng for rng, kept in zip(self._rngs, swarms, strict=True) if kept]

    def fork(self) -> Realisation:
        """Return a copy that draws the same random numbers from here on."""
        fork = copy(self)
        for name in self._ARRAYS:
            setattr(fork, name, getattr(self, name).copy())
        fork._rngs = deepcopy(self._rngs)
        return fork

    def state_dict(self) -> dict[str, Any]:
        """Return all drawn values and the generators' states, see `load_state_dict`."""
        arrays = {name.lstrip("_"): getattr(self, name).copy() for name in self._ARRAYS}
        return {**arrays, "generators": [generator_state(rng) for rng in self._rngs]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`.

        :raises ValueError: if the state belongs to other swarms
        """
        limits: dict[str, tuple[float, float]] = {
            "_start": (0, self._latest_start),
            "_silent_from": (0, _NEVER),
            "_factors": (1e-6, 1e6),
        }
        for name in self._ARRAYS:
            if name in self._SIGHT and not self.config.sensing.tracks and name.lstrip("_") not in state:
                continue  # of a version that had no such disturbances
            array = like(getattr(self, name), state[name.lstrip("_")], name.lstrip("_"), *limits.get(name, ()))
            setattr(self, name, array)
        self._rngs = [generator_of(one) for one in state["generators"]]

    def estimate(self, state: np.ndarray) -> np.ndarray:
        """Return the robots' estimates of their own states, (E, n, 9)."""
        return state + self._own if self.config.sensing.own else state

    def shown(self, state: np.ndarray, since: float = 0.0) -> np.ndarray:
        """Return the positions and velocities at which others observe the robots, before `observe`.

        :param state: estimates of the robots' own states, (E, n, 9)
        :param since: time since the last step (s)
        :return: (E, n, 6), or (E, n, 9) if they are those of the estimates
        """
        sensing = self.config.sensing
        if not sensing.tracks:
            return state
        return _moved_on(self._past[:, -1], since + sensing.others_delay * self.config.planner.dt)

    def observe(self, pos: np.ndarray, vel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Add the observers' errors to positions and velocities of others, (E, n, n - 1, 3) each."""
        if not self.config.sensing.others:
            return pos, vel
        return pos + self._observer[..., :3], vel + self._observer[..., 3:]

    @property
    def observer_errors(self) -> np.ndarray | None:
        """The observers' errors about positions and velocities of others, (E, n, n - 1, 6); None without any."""
        return self._observer if self.config.sensing.others else None

    def carried(self, requests: np.ndarray, pos: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Draw which exchanges of this step are carried over their distance, see `Radio`.

        :param requests: whose plans each robot requests, (E, n, n - 1) bool
        :param pos: true positions, (E, n, 3) (m)
        :param others: see `other_indices` or `Neighbours.others`
        :return: which of the requests get through, (E, n, n - 1) bool
        """
        radio = self.config.radio
        if not radio.limits_distance:
            return requests
        between = of_others(pos, others) - pos[:, :, None]
        chance = radio.carries(np.sqrt((between * between).sum(axis=-1)))
        if radio.half_distance is None:
            return requests & (chance > 0)
        return requests & (np.stack([rng.random(requests.shape[1:]) for rng in self._rngs]) < chance)

    def arrivals(self, requests: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Draw which answers of this step arrive.

        :param requests: which requests get through, (E, n, n - 1) bool, see `carried`
        :param others: see `other_indices` or `Neighbours.others`
        :return: which requests are answered, (E, n, n - 1) bool, and the answers' additional delays beyond the radio's
            delay (steps), (E, n, n - 1), None without jitter
        """
        radio, lateness = self.config.radio, None
        shape = requests.shape[1:]
        if radio.loss:
            requests = requests & (np.stack([rng.random(shape) for rng in self._rngs]) >= radio.loss)
        if radio.bursts:
            chance = np.stack([rng.random(shape) for rng in self._rngs])
            self._down = _interrupted(self._down, chance, radio.bursts, radio.burst_length)
            requests = requests & ~self._down
        if radio.outage:
            silent = self._silent_from <= self._step[:, None]
            requests = requests & ~of_others(silent, others)
        if radio.jitter:
            lateness = np.stack([rng.integers(0, radio.jitter + 1, shape) for rng in self._rngs])
        return requests, lateness

    def advance(self, state: np.ndarray) -> np.ndarray:
        """Advance all random processes by a step.

        :param state: states at its end, (E, n, 9)
        :return: the states with process noise, (E, n, 9)
        """
        self._step += 1
        noise, sensing = self.config.noise, self.config.sensing
        if noise:
            state = state + self._kick * self._normal(self._own.shape)
        if noise.gust:
            self._gust = _continued(self._gust, self._gust_keeps, noise.gust, self._normal(self._gust.shape))
        if sensing.own:
            self._own = _continued(self._own, self._errors_keep, self._own_scale, self._normal(self._own.shape))
        if sensing.others:
            drawn = self._normal(self._observer.shape)
            self._observer = _continued(self._observer, self._errors_keep, self._observer_scale, drawn)
        if sensing.tracks:
            self._track(self.estimate(state))
        return state

    def _track(self, estimate: np.ndarray) -> None:
        sensing, newest = self.config.sensing, estimate[..., :6]
        if sensing.gaps:
            chance = np.stack([rng.random(self._lost.shape[1:]) for rng in self._rngs])
            self._lost = _interrupted(self._lost, chance, sensing.gaps, sensing.gap_length)
            presumed = _moved_on(self._past[:, 0], self.config.planner.dt)
            newest = np.where(self._lost[..., None], presumed, newest)
        self._past = np.concatenate([newest[:, None], self._past[:, :-1]], axis=1)

    def _normal(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.stack([rng.normal(size=shape[1:]) for rng in self._rngs]) if self._rngs else np.zeros(shape)


def _interrupted(interrupted: np.ndarray, chance: np.ndarray, share: float, length: float) -> np.ndarray:
    """Return what is interrupted in the next step: a share of the time, for some steps on average.

    :param interrupted: what is now
    :param chance: uniform random numbers
    """
    ends = 1 / length
    return np.where(interrupted, chance >= ends, chance < share * ends / (1 - share))


def _moved_on(seen: np.ndarray, time: float | np.ndarray) -> np.ndarray:
    """Return positions and velocities, (..., 6), after a time (s) of constant velocity."""
    moved = np.broadcast_to(seen, np.broadcast_shapes(seen.shape, np.shape(time))).copy()
    moved[..., :3] += time * seen[..., 3:]
    return moved


def _by_state(pos: float, vel: float, attitude: float) -> np.ndarray:
    scale = np.repeat([pos, vel, attitude], 3)
    scale[8] = 0.0
    return scale


def _keeps(dt: float, correlation_time: float) -> float:
    """Return the correlation of a Gauss-Markov process between consecutive steps."""
    return math.exp(-dt / correlation_time) if correlation_time else 0.0


def _continued(process: np.ndarray, keeps: float, scale: np.ndarray | float, drawn: np.ndarray) -> np.ndarray:
    """Advance a stationary Gauss-Markov process by a step."""
    return keeps * process + math.sqrt(1 - keeps**2) * scale * drawn
