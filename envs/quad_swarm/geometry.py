"""Lengths of many vectors at once."""

from __future__ import annotations

import numpy as np


def length(vectors: np.ndarray) -> np.ndarray:
    """Euclidean lengths, (..., 3) -> (...).

    The same numbers as `numpy.linalg.norm`, whose sums over so short an axis take ten times as long.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.sqrt(x * x + y * y + z * z)
