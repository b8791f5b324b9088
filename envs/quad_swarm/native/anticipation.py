"""A small network that predicts how robots will move, in compiled code if there is a compiler, otherwise in NumPy.

Both give bit-identical results, whatever the other rows of a batch are: a robot in a process of its own predicts what a
swarm does. The compiled function is one of pairs.cpp.

The network is a set encoder (Zaheer et al. 2017, Deep Sets): two layers for each body around a robot, their sum and
maximum, and three layers for these and the robot's own motion. Its outputs are mean velocities up to each stage,
relative to the current velocity. Everything is in a frame that is turned to the robot's horizontal velocity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quad_swarm.geometry import dot
from quad_swarm.native.table import compiled

OWN, OF_BODY = 8, 7  # numbers of features
LAGS = (2, 5)  # steps between velocities whose changes show accelerations
_REACH = 6.0  # distance at which bodies are out of sight (m)
_BODY = 0.3  # radius of robots (m), to which obstacles of other radii are moved
_SLOW = 1e-3  # speed below which a robot has no direction (m/s)


class Sight(NamedTuple):
    """What n robots of E swarms see.

    :param pos: positions of K bodies, (E, n, K, 3), world frame (m)
    :param vel: velocities, (E, n, K, 3), world frame (m/s)
    :param place: which T of the bodies to predict, (n, T) int64
    :param changes: changes of their velocities over the last two steps, and over the three before these, (E, n, T, 2,
        3) (m/s)
    :param skipped: which of them to predict at a constant velocity instead, (E, n, T) bool
    :param centres: centres of O obstacles, (E, O, 3), world frame (m)
    :param velocities: their velocities, (E, O, 3) (m/s)
    :param factors: see `quad_swarm.world.obstacles.Surroundings`, (E, O, 3)
    :param radius: their radii, (E, O) (m), 0 of those that are not there
    """

    pos: np.ndarray
    vel: np.ndarray
    place: np.ndarray
    changes: np.ndarray
    skipped: np.ndarray
    centres: np.ndarray
    velocities: np.ndarray
    factors: np.ndarray
    radius: np.ndarray


def count_weights(hidden: int, width: int, n_stages: int) -> int:
    """Return the number of weights of a network, see `anticipate`."""
    sizes = ((OF_BODY, hidden), (hidden, hidden), (OWN + 2 * hidden, width), (width, width), (width, 3 * n_stages))
    return sum((n_in + 1) * n_out for n_in, n_out in sizes)


def anticipate(sight: Sight, weights: np.ndarray, hidden: int, width: int, n_stages: int, dt: float) -> np.ndarray:
    """Predict where bodies will be.

    :param sight: what robots see
    :param weights: the layers one after the other, each its biases and then a row for each of its inputs, float32
    :param hidden: width of the layers for each body
    :param width: width of the layers after them
    :param n_stages: number of stages N
    :param dt: length of a stage (s)
    :return: positions now and at the next N steps, (E, n, T, N + 1, 3), world frame (m)
    """
    if (functions := compiled()) is not None:
        return functions.anticipate(N=n_stages, hidden=hidden, width=width, dt=dt, weights=weights, **sight._asdict())
    where, way = _targets(sight)
    times = dt * np.arange(0.0, n_stages + 1)
    expected = where[..., None, :] + times[:, None] * way[..., None, :]
    chosen = ~sight.skipped
    own, bodies, near = features(sight)
    layers = _Layers(weights)
    embedded = layers(layers(bodies[chosen], hidden), hidden) * near[chosen][..., None]
    total, largest = np.zeros((2, len(embedded), hidden), np.float32)
    for k in range(embedded.shape[1]):  # in this order
        total = total + embedded[:, k]
        largest = np.maximum(largest, embedded[:, k])
    head = np.concatenate([own[chosen], total, largest], axis=-1)
    out = layers(layers(layers(head, width), width), 3 * n_stages, rectified=False)
    out = out.astype(float).reshape(-1, n_stages, 3)
    c, s = (one[chosen][:, None] for one in _direction(way))
    x, y, z = out[..., 0], out[..., 1], out[..., 2]
    change = np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
    later = where[chosen][:, None] + times[1:, None] * (way[chosen][:, None] + change)
    expected[chosen] = np.concatenate([where[chosen][:, None], later], axis=1)
    return expected


class _Layers:
    """The layers of a network in turn."""

    def __init__(self, weights: np.ndarray):
        self._rest = weights

    def __call__(self, x: np.ndarray, n_out: int, rectified: bool = True) -> np.ndarray:
        size = (x.shape[-1] + 1) * n_out
        bias, *rows = self._rest[:size].reshape(-1, n_out)
        self._rest = self._rest[size:]
        sums = np.broadcast_to(bias, (*x.shape[:-1], n_out))
        for k, row in enumerate(rows):
            sums = sums + x[..., k, None] * row
        return np.maximum(sums, np.float32(0)) if rectified else sums


def features(sight: Sight) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inputs of the network.

    :return: features of the targets' own motion, (E, n, T, OWN); of the bodies around each, (E, n, T, K + O, OF_BODY);
        and how much each of these counts, (E, n, T, K + O), 0 for the target itself and what is out of sight; float32
    """
    where, way = _targets(sight)
    direction = _direction(way)
    recent, earlier = sight.changes[..., 0, :], sight.changes[..., 1, :]
    speed = np.sqrt(way[..., 0] * way[..., 0] + way[..., 1] * way[..., 1])
    own = np.concatenate(
        [
            np.stack([speed, way[..., 2]], axis=-1),
            5 * _turned(recent, *direction),
            3 * _turned(earlier, *direction),
        ],
        axis=-1,
    )
    here, moving = where[..., None, :], way[..., None, :]
    away = sight.pos[:, :, None] - here
    relative = sight.vel[:, :, None] - moving
    itself = np.arange(sight.pos.shape[2]) == sight.place[..., None]
    counted = np.broadcast_to(~itself, away.shape[:-1])
    factors = sight.factors[:, None, None]
    from_obstacles = factors * (sight.centres[:, None, None] - here)
    apart = np.sqrt(dot(from_obstacles, from_obstacles))
    radius = sight.radius[:, None, None]
    shrunk = np.maximum(1.0 - (radius - _BODY) / np.maximum(apart, 1e-6), 0.1)
    near = np.concatenate([np.sqrt(dot(away, away)), apart], axis=-1)
    near = np.clip(_REACH - near, 0.0, 1.0)
    near *= np.concatenate([counted, np.broadcast_to(radius > 0, apart.shape)], axis=-1)
    away = np.concatenate([away, shrunk[..., None] * from_obstacles], axis=-2)
    relative = np.concatenate([relative, factors * (sight.velocities[:, None, None] - moving)], axis=-2)
    c, s = (one[..., None] for one in direction)
    kind = np.zeros((*near.shape, 1))
    kind[..., sight.pos.shape[2] :, :] = 1.0
    bodies = np.concatenate([_turned(away, c, s) / 3, _turned(relative, c, s) / 4, kind], axis=-1)
    return own.astype(np.float32), bodies.astype(np.float32), near.astype(np.float32)


def outputs(sight: Sight, plans: np.ndarray, dt: float) -> np.ndarray:
    """Return the outputs that a network should have.

    :param plans: positions of the targets at the next N steps, (E, n, T, N, 3), world frame (m)
    :param dt: length of a step (s)
    :return: (E, n, T, N, 3), float32
    """
    where, way = _targets(sight)
    times = dt * np.arange(1.0, plans.shape[-2] + 1)
    change = (plans - where[..., None, :]) / times[:, None] - way[..., None, :]
    c, s = (one[..., None] for one in _direction(way))
    return _turned(change, c, s).astype(np.float32)


def _targets(sight: Sight) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of the bodies to predict, (E, n, T, 3) each."""
    rows = np.arange(len(sight.place))[:, None]
    return sight.pos[:, rows, sight.place], sight.vel[:, rows, sight.place]


def _direction(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine of the directions of horizontal velocities, those of 0 without a direction."""
    speed = np.sqrt(way[..., 0] * way[..., 0] + way[..., 1] * way[..., 1])
    moves = speed > _SLOW
    safe = np.where(moves, speed, 1.0)
    return np.where(moves, way[..., 0] / safe, 1.0), np.where(moves, way[..., 1] / safe, 0.0)


def _turned(vectors: np.ndarray, c: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return vectors, (..., 3), in frames that are turned by angles of which these are cosine and sine."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.stack([c * x + s * y, c * y - s * x, z], axis=-1)
