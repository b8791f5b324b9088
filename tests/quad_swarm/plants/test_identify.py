"""What is identified is what is flown."""

import numpy as np
import pytest

from quad_swarm.plants.identify import DT, experiment, identify
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorParams


def test_steps_in_every_direction_come_back_to_zero():
    u = experiment()
    assert u.shape == (round(3.0 / DT), 12, 4)
    assert (np.abs(u[0]).max(axis=1) > 0).all()
    assert not u[-1].any()
    np.testing.assert_allclose(u.sum(axis=1)[0], 0, atol=1e-12)  # as far one way as the other


def test_our_own_model_is_found_again():
    found = identify("model")
    for name in VEHICLE_PARAMETERS:
        assert getattr(found.params, name) == pytest.approx(getattr(QuadrotorParams(), name), rel=1e-3)
    assert max(found[1:]) < 1e-3
