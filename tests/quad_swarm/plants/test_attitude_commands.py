"""The thrust that makes a climb rate."""

import numpy as np
import pytest

from quad_swarm.plants.attitude_commands import GRAVITY, thrust, yaw


def test_hovers_climbs_makes_up_for_tilt_and_has_limits():
    state, u = np.zeros((5, 9)), np.zeros((5, 4))
    u[1, 2] = 0.5
    state[2, 6] = 0.4
    u[3, 2], u[4, 2] = 100, -100
    level = thrust(state, u)
    assert level[0] == GRAVITY < level[1]
    assert level[2] * np.cos(0.4) == pytest.approx(GRAVITY)
    assert level[3] == pytest.approx(1.8 * GRAVITY)
    assert level[4] == 0


def test_yaw_turns_with_its_rate():
    state, u = np.zeros((1, 9)), np.zeros((1, 4))
    state[0, 8], u[0, 3] = 1.0, 0.5
    assert yaw(state, u, 0.1) == pytest.approx(1.05)
