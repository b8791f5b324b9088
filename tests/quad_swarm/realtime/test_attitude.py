"""Attitude and thrust for set-points."""

import numpy as np
import pytest

from quad_swarm.realtime.attitude import GRAVITY, AttitudeController, AttitudeGains

LEVEL = np.zeros(9)


def test_a_vehicle_that_is_known_hovers_at_once():
    attitude = AttitudeController(AttitudeGains(hover_thrust=0.4))(LEVEL, np.zeros(4), 0.05)
    assert attitude == (0.0, 0.0, 0.0, pytest.approx(0.4))


def test_a_tilted_vehicle_needs_more_thrust():
    tilted = LEVEL.copy()
    tilted[6] = 0.4
    attitude = AttitudeController()(tilted, np.array([0.4, 0, 0, 0]), 0.05)
    assert attitude.thrust == pytest.approx(0.5 / np.cos(0.4))
    tilted[6] = 1.5
    assert AttitudeController()(tilted, np.zeros(4), 0.05).thrust == pytest.approx(1.0), "twice the weight at most"


@pytest.mark.parametrize("wrong", [0.8, 1.0, 1.2])
@pytest.mark.parametrize("integral", [0.0, 2.0])
def test_a_wrong_hover_thrust_is_made_up_for(wrong, integral):
    """A robot that holds its height, climbing at the error of the height."""
    controller = AttitudeController(AttitudeGains(integral=integral))
    state, goal = LEVEL.copy(), 1.5
    state[2] = goal
    for _ in range(20 * 20):
        climb = np.clip(goal - state[2], -1, 1)
        thrust = controller(state, np.array([0, 0, climb, 0]), 0.05).thrust
        state[5] += 0.05 * (thrust / (0.5 * wrong) - 1) * GRAVITY
        state[2] += 0.05 * state[5]
    error = abs(state[2] - goal)
    if integral or wrong == 1.0:
        assert error < 0.01
    else:
        assert error > 0.5, "which is what the integral is for"


def test_the_integral_is_bounded_on_the_ground():
    controller = AttitudeController(AttitudeGains(most=0.3))
    for _ in range(1000):  # it is told to climb, and cannot
        controller(LEVEL, np.array([0, 0, 1.0, 0]), 0.05)
    assert controller(LEVEL, np.zeros(4), 0.05).thrust == pytest.approx(0.5 * 1.3)


def test_what_the_integral_made_up_for_is_forgotten_before_a_flight():
    controller = AttitudeController(yaw=1.0)
    for _ in range(100):
        controller(LEVEL, np.array([0, 0, 1.0, 0.1]), 0.05)
    yaw = controller.yaw
    controller.reset()
    assert controller(LEVEL, np.zeros(4), 0.05) == pytest.approx((0, 0, yaw, 0.5))
    controller.reset(-2.0)
    assert controller.yaw == -2.0


def test_the_heading_is_held_and_turned():
    controller = AttitudeController(yaw=3.0)
    turned = LEVEL.copy()
    turned[8] = 2.0
    assert controller(turned, np.zeros(4), 0.05).yaw == pytest.approx(3.0)
    for _ in range(10):
        yaw = controller(turned, np.array([0, 0, 0, 1.0]), 0.05).yaw
    assert yaw == pytest.approx(3.5 - 2 * np.pi)


@pytest.mark.parametrize("gains", [{"hover_thrust": 0.0}, {"climb": 0.0}, {"integral": -1.0}, {"most": 1.0}])
def test_gains_that_cannot_be_are_refused(gains):
    with pytest.raises(ValueError, match=next(iter(gains))):
        AttitudeGains(**gains)
