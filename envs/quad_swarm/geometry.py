"""Lengths of vectors, attitudes and frames, and the closest approach of straight motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

_STILL = 1e-12  # squared speed below which nothing moves (m^2/s^2); pairs.cpp has the same


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products, (..., 3) and (..., 3) -> (...)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def length(vectors: np.ndarray) -> np.ndarray:
    """Euclidean lengths, (..., 3) -> (...).

    Equal to `numpy.linalg.norm`, whose sums over such a short axis take ten times as long.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.sqrt(x * x + y * y + z * z)


def closest_approach(
    position: np.ndarray,
    velocity: np.ndarray,
    until: float = np.inf,
    product: Callable[[np.ndarray, np.ndarray], np.ndarray] = dot,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the closest approach of two points that move in straight lines.

    :param position: relative position now, (..., 3) (m)
    :param velocity: relative velocity, (..., 3) (m/s)
    :param until: latest time to consider (s)
    :param product: dot products, for results that depend on the order of its operations
    :return: relative position at the closest approach, (..., 3) (m), and the time until then, 0 if it is over, (...)
        (s)
    """
    closing = -(product(position, velocity) + 0.0)  # at rest, the sign of zero is always the same
    time = np.clip(closing / np.maximum(product(velocity, velocity), _STILL), 0.0, until)
    return position + time[..., None] * velocity, time


def flattened(vectors: np.ndarray, height: float) -> np.ndarray:
    """Return vectors, (..., 3), in the metric of ellipsoids: vertical parts are divided by their height over width."""
    return vectors if height == 1 else np.array([1.0, 1.0, 1 / height]) * vectors


def wrapped(angle: Any) -> Any:
    """Return angles, (...) (rad), as those between half a turn clockwise and half a turn counter-clockwise."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def to_quaternion(attitude: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (rad), (3,), as a quaternion x, y, z, w, (4,)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(attitude / 2), np.cos(attitude / 2)
    return np.array([
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ])  # fmt: skip


def from_quaternion(q: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (rad), (3,), of a quaternion x, y, z, w, (4,).

    :raises ValueError: if it is no rotation
    """
    norm = np.linalg.norm(q)
    if not 0.9 < norm < 1.1:
        raise ValueError(f"the quaternion {np.asarray(q).tolist()} is no rotation")
    x, y, z, w = q / norm
    return np.array([
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    ])  # fmt: skip


def to_ned(vector: np.ndarray) -> np.ndarray:
    """Return a vector of the world, (3,), east, north, up, as north, east, down; it is its own inverse."""
    return np.array([vector[1], vector[0], -vector[2]])


def to_frd(attitude: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (rad), (3,), with y left and z up as those with y right and z down, with the yaw from
    north; it is its own inverse."""
    roll, pitch, yaw = attitude
    return np.array([roll, -pitch, wrapped(np.pi / 2 - yaw)])
