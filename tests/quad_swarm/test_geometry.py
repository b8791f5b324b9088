"""Lengths of vectors."""

import numpy as np
import pytest

from quad_swarm.geometry import length


@pytest.mark.parametrize("shape", [(3,), (0, 3), (5, 3), (2, 4, 3, 3)])
def test_lengths_are_numpy_s_to_the_bit(shape):
    vectors = np.random.default_rng(0).normal(size=shape) * 10.0 ** np.random.default_rng(1).integers(-9, 9, shape)
    assert np.array_equal(length(vectors), np.linalg.norm(vectors, axis=-1))


def test_lengths_of_views():
    line = np.zeros((4, 6))
    line[:, 1], line[:, 3] = 3.0, 4.0
    assert length(line[:, 1:4]).tolist() == [5.0] * 4
