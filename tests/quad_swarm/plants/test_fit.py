"""What flew is found again in its log, or the log is refused."""

import numpy as np
import pytest

from quad_swarm.plants.fit import LEAST_WINDOWS, Log, fit
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorModel
from quad_swarm.vehicles import VEHICLES

NOISE = np.array([0.002] * 3 + [0.02] * 3 + [0.005] * 3)  # m, m/s, rad
FINE = 0.005  # s


def flown(vehicle="bebop2", seconds=40.0, rate=50, noise=0.0, late=(0.0, 0.0), sizes=(0.2, 0.2, 1.0, 0.3), n=1):
    """Return the log of vehicles that get a random set-point every half second.

    :param late: how much older than their stamps states are, from and to (s)
    :param sizes: largest set-points
    """
    rng, model = np.random.default_rng(0), QuadrotorModel(VEHICLES[vehicle], FINE)
    steps, held = round(seconds / FINE), round(0.5 / FINE)
    u = np.repeat(rng.uniform(-1, 1, (steps // held + 1, n, 4)) * sizes, held, axis=0)[:steps]
    states = [np.zeros((n, 9))]
    for one in u:
        states.append(model.step(states[-1], one))
    at = np.arange(100, steps, round(1 / rate / FINE))
    back = np.round(rng.uniform(*late, len(at)) / FINE).astype(int)
    state = np.array(states)[at - back]
    return Log(at * FINE, state + noise * NOISE * rng.normal(size=state.shape), u[at])


def check(found, vehicle, tolerance):
    for name in VEHICLE_PARAMETERS:
        assert getattr(found.params, name) == pytest.approx(getattr(VEHICLES[vehicle], name), rel=tolerance), name


@pytest.mark.parametrize(("vehicle", "rate"), [("bebop2", 20), ("bebop2", 100), ("hummingbird", 50), ("x500", 50)])
def test_the_parameters_of_a_vehicle_are_found_again(vehicle, rate):
    found = fit([flown(vehicle, rate=rate)])
    check(found, vehicle, 5e-3 if vehicle != "x500" else 0.05)
    assert found.delay == pytest.approx(0, abs=1e-4)
    assert np.degrees(found.attitude).std() < 1e-3
    assert found.velocity.std() < 1e-3


@pytest.mark.parametrize("vehicle", ["bebop2", "hummingbird"])
def test_with_noise_and_stamps_that_are_late(vehicle):
    found = fit([flown(vehicle, noise=1.0, late=(0.005, 0.010))])
    check(found, vehicle, 0.03)  # measured: 0.8 %
    assert found.delay == pytest.approx(0.0075, abs=0.0015)
    for name, error in found.errors.items():
        assert error < 0.03 * getattr(found.params, name)
        assert abs(getattr(found.params, name) - getattr(VEHICLES[vehicle], name)) < 5 * error
    assert np.degrees(found.attitude).std() == pytest.approx(np.degrees(NOISE[6]), rel=0.1), "what is left is noise"
    assert found.velocity.std() == pytest.approx(NOISE[3], rel=0.1)


def test_constant_errors_and_wind_are_no_parameters():
    log = flown(noise=0.3)
    state = log.state.copy()
    state[..., 6] += 0.02
    check(fit([log._replace(state=state)]), "bebop2", 0.03)


@pytest.mark.slow
def test_logs_are_fitted_together_across_gaps():
    whole = flown(n=2, seconds=30.0, noise=0.3)
    keep = (whole.time < 12.0) | (whole.time > 15.0)
    parts = [Log(*(one[keep] for one in whole)), Log(whole.time, whole.state[:, :1], whole.setpoint[:, :1])]
    check(fit(parts), "bebop2", 0.03)


def test_a_robot_with_a_single_window_is_no_trouble():
    """Its delay is known before the errors of the parameters are estimated without it."""
    found = fit([flown(seconds=40.0, n=1)] + [flown(seconds=3.0, n=1)] * 7)
    check(found, "bebop2", 0.02)


def broken(**changes):
    log = flown(**changes.pop("flown", {}))
    state, setpoint = log.state.copy(), log.setpoint.copy()
    for name, factor in changes.items():
        target, column = (setpoint, int(name[1])) if name[0] == "u" else (state, int(name[1]))
        target[..., column] *= factor
    return log._replace(state=state, setpoint=setpoint)


@pytest.mark.parametrize(
    ("log", "told"),
    [
        (lambda: broken(flown={"sizes": (0.2, 0.2, 0.0, 0.3)}), "climb_gain and climb_time_constant: climb_set varies"),
        (lambda: broken(flown={"sizes": (0.01, 0.2, 1.0, 0.0)}), "roll_gain and roll_time_constant: roll_set varies"),
        (lambda: broken(flown={"sizes": (0.2, 0.01, 1.0, 0.0)}), "pitch_gain and pitch_time_constant: pitch_set"),
        (lambda: broken(flown={"seconds": 20.0}), "windows of 2 s with set-points and without gaps"),
        (lambda: broken(flown={"rate": 5}), "a sample each 0.2 s"),
        (lambda: broken(u0=np.nan), f"the fit needs {LEAST_WINDOWS}"),
        (lambda: broken(u1=-1.0), "pitch_gain, which lies at the limit"),
        (lambda: broken(s6=180 / np.pi, u0=180 / np.pi), "attitudes are in rad"),
        (lambda: broken(s7=-1.0, u1=-1.0), "velocity along x changes -"),
        (lambda: broken(s3=0.0), "cannot determine drag_x: the velocity along x varies by 0 m/s"),
        (lambda: broken(flown={"noise": 40.0}), "cannot determine"),
    ],
)
def test_logs_that_cannot_determine_the_model_are_refused(log, told):
    with pytest.raises(ValueError, match=r"it has|it cannot|its velocity") as error:
        fit([log()])
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_logs_of_different_rates_are_refused():
    with pytest.raises(ValueError, match="of one rate together"):
        fit([flown(rate=20), flown(rate=100)])
