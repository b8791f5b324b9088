"""Lengths of vectors, and the closest approach of straight motion."""

import numpy as np
import pytest

from quad_swarm.geometry import closest_approach, length


@pytest.mark.parametrize("shape", [(3,), (0, 3), (5, 3), (2, 4, 3, 3)])
def test_lengths_are_numpy_s_to_the_bit(shape):
    vectors = np.random.default_rng(0).normal(size=shape) * 10.0 ** np.random.default_rng(1).integers(-9, 9, shape)
    assert np.array_equal(length(vectors), np.linalg.norm(vectors, axis=-1))


def test_lengths_of_views():
    line = np.zeros((4, 6))
    line[:, 1], line[:, 3] = 3.0, 4.0
    assert length(line[:, 1:4]).tolist() == [5.0] * 4


def test_the_closest_approach_of_straight_motion():
    position = np.array([[3.0, 0.4, 0], [3, 0.4, 0], [3, 0.4, 0], [3, 0.4, 0]])
    velocity = np.array([[-1.0, 0, 0], [1, 0, 0], [-0.5, 0, 0], [0, 0, 0]])
    nearest, time = closest_approach(position, velocity, 4.0)
    assert time.tolist() == [3, 0, 4, 0]
    assert nearest.tolist() == [[0, 0.4, 0], [3, 0.4, 0], [1, 0.4, 0], [3, 0.4, 0]]
    assert closest_approach(position, velocity)[1].tolist() == [3, 0, 6, 0]
    rng = np.random.default_rng(0)
    position, velocity = rng.normal(size=(2, 50, 3))
    times = np.linspace(0, 2, 401)
    distances = length(position[:, None] + times[:, None] * velocity[:, None])
    assert length(closest_approach(position, velocity, 2.0)[0]) == pytest.approx(distances.min(axis=1), abs=1e-3)
