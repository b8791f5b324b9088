"""The projection onto polyhedra, beside another method for the same problem."""

import numpy as np
import pytest
from scipy.optimize import nnls

from quad_swarm.planner.projection import project


def polyhedra(count: int, n_spaces: int, dimension: int, seed: int = 0):
    """Points, and half-spaces around other points."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, n_spaces, dimension))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    inside = rng.normal(size=(count, 1, dimension))
    offsets = (normals * inside).sum(axis=2) - 0.3 * np.abs(rng.normal(size=(count, n_spaces)))
    return 2 * rng.normal(size=(count, dimension)), normals, offsets


def nearest(point, normals, offsets):
    """Lawson and Hanson's least distance programming, "Solving least squares problems" (1974), chapter 23."""
    short = offsets - normals @ point
    equations = np.vstack([normals.T, short])
    target = np.eye(len(equations))[-1]
    residual = equations @ nnls(equations, target)[0] - target
    return point - residual[:-1] / residual[-1]


@pytest.mark.parametrize(("n_spaces", "dimension"), [(1, 2), (4, 3), (13, 4), (33, 4), (60, 3)])
def test_the_nearest_points_are_those_of_another_method(n_spaces, dimension):
    points, normals, offsets = polyhedra(60, n_spaces, dimension)
    found, iterations = project(points, normals, offsets)
    expected = [nearest(*one) for one in zip(points, normals, offsets, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert iterations.max() < 20


def test_a_point_inside_stays_and_others_do_not_matter_to_it():
    points, normals, offsets = polyhedra(40, 13, 4)
    found, _ = project(points, normals, offsets)
    again, iterations = project(found, normals, offsets - 1e-6)
    assert np.array_equal(again, found)
    assert not iterations.any()
    for k in range(0, 40, 7):
        alone, _ = project(points[k : k + 1], normals[k : k + 1], offsets[k : k + 1])
        np.testing.assert_allclose(alone[0], found[k], atol=1e-9)


def test_half_spaces_may_be_the_same_or_none():
    points, normals, offsets = polyhedra(20, 4, 3)
    found, _ = project(points, normals, offsets)
    twice, _ = project(points, np.repeat(normals, 2, axis=1), np.repeat(offsets, 2, axis=1))
    np.testing.assert_allclose(twice, found, atol=1e-6)
    assert np.array_equal(project(points, normals[:, :0], offsets[:, :0])[0], points)


def test_numbers_that_are_not_finite_end():
    points, normals, offsets = polyhedra(3, 7, 3)
    expected, _ = project(points, normals, offsets)
    offsets[1, 2] = np.nan
    found, iterations = project(points, normals, offsets)
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], atol=1e-9)
    assert iterations.max() < 20
