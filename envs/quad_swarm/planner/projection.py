"""Projection of points onto polyhedra in few dimensions, of many problems at once."""

from __future__ import annotations

import functools
from itertools import combinations

import numpy as np

_TOLERANCE = 1e-7  # violation of a half-space, and negative multiplier, that count as none
_RIDGE = 1e-13  # keeps the equations solvable where two half-spaces have the same normal
_MOST = 100  # iterations, of which random problems take less than 12


def project(points: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest point of each polyhedron, which must not be empty.

    Only up to d half-spaces bound the solution. The method begins with none and adds the one that is violated most; of
    it and those before, it keeps those that bound the nearest point of their intersection. This point moves away from
    the given one in every iteration, so no set of half-spaces comes twice (Sharir and Welzl, "A combinatorial bound for
    linear programming and related problems", STACS 1992).

    :param points: B points, (B, d)
    :param normals: normals of K half-spaces of each, about as long as 1, (B, K, d)
    :param offsets: the half-spaces are ``normals @ x >= offsets``, (B, K)
    :return: the nearest points, (B, d), NaN where a number of the problem is not finite, and the number of iterations
        of each, (B,) int
    """
    count, n_spaces, dimension = normals.shape
    nearest, iterations = points.copy(), np.zeros(count, dtype=np.int64)
    if not n_spaces:
        return nearest, iterations
    # The half-spaces that bound the solution so far, first those that do; the others have zeros
    bounding, bounds = np.zeros((count, dimension, dimension)), np.zeros((count, dimension))
    finite = np.isfinite(points.sum(axis=1) + offsets.sum(axis=1) + normals.sum(axis=(1, 2)))
    nearest[~finite] = np.nan
    rows, most = np.flatnonzero(finite), 0
    for _ in range(_MOST):
        gaps = (normals[rows] @ nearest[rows, :, None])[..., 0] - offsets[rows]
        worst = gaps.argmin(axis=1)
        wrong = gaps[np.arange(len(rows)), worst] < -_TOLERANCE
        rows, worst = rows[wrong], worst[wrong]
        if not len(rows):
            break
        iterations[rows] += 1
        chosen, both, alone = _subsets(dimension, most)
        some = np.concatenate([bounding[rows, :most], normals[rows, worst][:, None]], axis=1)
        limits = np.concatenate([bounds[rows, :most], offsets[rows, worst][:, None]], axis=1)
        # On the boundaries of every subset that contains the new one: x = point + some' m, with some x = limits there
        gram = some @ some.transpose(0, 2, 1) + _RIDGE * np.eye(most + 1)
        short = (limits - (some @ points[rows, :, None])[..., 0])[:, None] * chosen
        multipliers = np.linalg.solve(gram[:, None] * both + alone, short[..., None])[..., 0]
        found = points[rows, None] + multipliers @ some
        inside = (found @ some.transpose(0, 2, 1) - limits[:, None]).min(axis=2)
        scale = 1 + np.abs(multipliers).max(axis=2)
        best = np.minimum(inside, multipliers.min(axis=2) / scale).argmax(axis=1)
        each = np.arange(len(rows))
        nearest[rows] = found[each, best]
        # Of d + 1 half-spaces at most d are kept
        order = np.argsort(~chosen[best], axis=1, kind="stable")[:, :dimension]
        used = chosen[best][each[:, None], order]
        bounding[rows, : order.shape[1]] = some[each[:, None], order] * used[..., None]
        bounds[rows, : order.shape[1]] = limits[each[:, None], order] * used
        most = int(used.sum(axis=1).max())
    return nearest, iterations


@functools.cache
def _subsets(dimension: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the subsets of at most d out of some half-spaces and a new one that contain the new one, (S, count + 1)
    bool, and what makes of all scalar products, (count + 1, count + 1), the equations of a subset: factors and terms.
    """
    rest = [one for size in range(dimension) for one in combinations(range(count), size)]
    chosen = np.array([[k in one for k in range(count)] + [True] for one in rest])
    return chosen, chosen[:, :, None] & chosen[:, None], np.eye(count + 1) * ~chosen[:, None]
