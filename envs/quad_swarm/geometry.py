"""Lengths of vectors."""

from __future__ import annotations

import numpy as np


def length(vectors: np.ndarray) -> np.ndarray:
    """Euclidean lengths, (..., 3) -> (...).

    Equal to `numpy.linalg.norm`, whose sums over such a short axis take ten times as long.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.sqrt(x * x + y * y + z * z)
