"""The dynamics: against an independent integrator, their steady states, and batches against single calls."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest

from quad_swarm.quadrotor import VEHICLE_PARAMETERS, MixedModel, QuadrotorModel, QuadrotorParams, state_derivative

PARAMS = QuadrotorParams()


def random_states(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    x = rng.uniform(-1, 1, (count, 9)) * [4, 4, 2, 3, 3, 1, 0.3, 0.3, 3]
    u = rng.uniform(-1, 1, (count, 4)) * [0.3, 0.3, 1, 1]
    return x, u


@pytest.mark.parametrize(("dt", "tolerance"), [(0.1, 3e-4), (0.05, 3e-5)])  # fourth order: a sixteenth
def test_agrees_with_an_adaptive_integrator(dt, tolerance):
    rng = np.random.default_rng(0)
    model = QuadrotorModel(PARAMS, dt)
    x, u, wind = ca.SX.sym("x", 9), ca.SX.sym("u", 4), ca.SX.sym("w", 2)
    ode = {"x": x, "p": ca.vertcat(u, wind), "ode": state_derivative(x, u, wind, PARAMS)}
    exact = ca.integrator("exact", "cvodes", ode, 0.0, dt, {"abstol": 1e-12, "reltol": 1e-12})
    for _ in range(20):
        states, _ = random_states(1, rng)
        expected = states[0]
        for _ in range(round(0.5 / dt)):  # half a second of changing inputs
            _, inputs = random_states(1, rng)
            blow = rng.uniform(-2, 2, 2)
            expected = exact(x0=expected, p=np.concatenate([inputs[0], blow]))["xf"].full().ravel()
            states = model.step(states, inputs, blow[None])
        np.testing.assert_allclose(states[0], expected, atol=tolerance)


@pytest.mark.parametrize(
    ("command", "index", "steady"),
    [
        ([0, 0, 0.5, 0], 5, 0.5 * PARAMS.climb_gain),
        ([0, 0.1, 0, 0], 7, 0.1 * PARAMS.pitch_gain),
        ([0.1, 0, 0, 0], 6, 0.1 * PARAMS.roll_gain),
        ([0, 0.1, 0, 0], 3, PARAMS.gravity * np.tan(0.1 * PARAMS.pitch_gain) / PARAMS.drag_x),
        ([0.1, 0, 0, 0], 4, -PARAMS.gravity * np.tan(0.1 * PARAMS.roll_gain) / PARAMS.drag_y),
    ],
)
def test_steady_states(command, index, steady):
    model = QuadrotorModel(PARAMS, dt=0.1)
    x = np.zeros((1, 9))
    for _ in range(600):
        x = model.step(x, np.array([command], float))
    assert x[0, index] == pytest.approx(steady, rel=1e-6)


def test_drifts_with_the_wind():
    model = QuadrotorModel(PARAMS, dt=0.1)
    x = np.zeros((1, 9))
    for _ in range(600):
        x = model.step(x, np.zeros((1, 4)), np.array([[1.5, -0.5]]))
    np.testing.assert_allclose(x[0, 3:6], [1.5, -0.5, 0], atol=1e-6)


def test_batch_equals_single_calls_to_the_last_bit():
    rng = np.random.default_rng(1)
    model = QuadrotorModel(PARAMS, dt=0.1)
    x, u = random_states(7, rng)
    batch = model.step(x, u)
    for k in range(7):
        assert np.array_equal(model.step(x[k : k + 1], u[k : k + 1])[0], batch[k])
    assert np.array_equal(model.step(x.reshape(1, 7, 9), u.reshape(1, 7, 4))[0], batch)
    assert model.step(x[:0], u[:0]).shape == (0, 9)


def test_rollout_repeats_steps():
    rng = np.random.default_rng(2)
    model = QuadrotorModel(PARAMS, dt=0.1)
    x, _ = random_states(3, rng)
    u = rng.uniform(-0.2, 0.2, (3, 5, 4))
    states = model.rollout(x, u)
    for k in range(5):
        assert np.array_equal(states[:, k + 1], model.step(states[:, k], u[:, k]))


def test_survives_pickling():
    model = QuadrotorModel(PARAMS, dt=0.1)
    x, u = random_states(2, np.random.default_rng(3))
    expected = model.step(x, u)
    assert np.array_equal(pickle.loads(pickle.dumps(model)).step(x, u), expected)


def test_threads_may_share_a_model():
    model = QuadrotorModel(PARAMS, dt=0.1)
    batches = [random_states(50, np.random.default_rng(k)) for k in range(4)]
    expected = [model.step(x, u) for x, u in batches]

    def often(k: int) -> bool:
        return all(np.array_equal(model.step(*batches[k]), expected[k]) for _ in range(300))

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(often, range(4)))


def test_refuses_senseless_parameters():
    with pytest.raises(ValueError, match="drag_x=-1: it must be greater than or equal to 0"):
        QuadrotorParams(drag_x=-1)


def test_states_after_times_of_their_own():
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(5, 9)) * 0.3, rng.normal(size=(5, 4)) * 0.2
    model = QuadrotorModel(QuadrotorParams(), 0.1)
    assert np.array_equal(model.ahead(x, u, np.zeros(5)), x)
    np.testing.assert_allclose(model.ahead(x, u, np.full(5, 0.1)), model.step(x, u), atol=1e-12)
    half = QuadrotorModel(QuadrotorParams(), 0.05).step(x, u)
    times = np.array([0.1, 0.05, 0.1, 0.05, 0.0])
    expected = np.where(times[:, None] == 0.1, model.step(x, u), np.where(times[:, None] == 0.05, half, x))
    np.testing.assert_allclose(model.ahead(x, u, times), expected, atol=1e-12)


def test_a_vehicle_with_other_parameters_flies_as_the_model_of_those():
    rng = np.random.default_rng(1)
    x, u, wind = rng.normal(size=(3, 9)) * 0.3, rng.normal(size=(3, 4)) * 0.2, rng.normal(size=(3, 2))
    factors = rng.uniform(0.8, 1.2, (3, len(VEHICLE_PARAMETERS)))
    model = QuadrotorModel(QuadrotorParams(), 0.02)
    flown = model.step(x, u, wind, factors)
    for k in range(3):
        params = {name: getattr(model.params, name) * f for name, f in zip(VEHICLE_PARAMETERS, factors[k], strict=True)}
        alone = QuadrotorModel(QuadrotorParams(**params), 0.02).step(x[k], u[k], wind[k])
        np.testing.assert_allclose(flown[k], alone, atol=1e-12)
    np.testing.assert_allclose(model.step(x, u, wind, np.ones_like(factors)), model.step(x, u, wind), atol=1e-12)


@pytest.mark.parametrize("count", [4, 40])  # by the interpreter, and compiled
def test_a_heading_in_the_batch_leaves_the_other_rows_as_they_are(count):
    rng = np.random.default_rng(0)
    model = QuadrotorModel(PARAMS, 0.05)
    states, inputs = random_states(count, rng)
    states[:, 8] = inputs[:, 3] = 0.0
    level = model.step(states, inputs)
    turned, turning = states.copy(), inputs.copy()
    turned[1, 8], turning[2, 3] = 1.0, 0.5
    mixed = model.step(turned, turning)
    rest = np.setdiff1d(np.arange(count), [1, 2])
    assert np.array_equal(mixed[rest], level[rest])
    assert not np.array_equal(mixed[1, 3:5], level[1, 3:5])


def test_unlike_quadrotors_of_a_team_move_as_alone():
    rng = np.random.default_rng(0)
    models = [QuadrotorModel(PARAMS, 0.1), QuadrotorModel(QuadrotorParams(drag_x=1.0, climb_gain=0.9), 0.1)]
    mixed, kind_of = MixedModel(models, [1, 0, 1, 1]), [1, 0, 1, 1]
    for n_teams in (1, 30):
        x, u = (one.reshape(n_teams, 4, -1) for one in random_states(4 * n_teams, rng))
        time = rng.uniform(0, 0.1, (n_teams, 4))
        step, ahead = mixed.step(x, u), mixed.ahead(x, u, time)
        for robot, kind in enumerate(kind_of):
            one = slice(robot, robot + 1)
            assert np.array_equal(step[:, one], models[kind].step(x[:, one], u[:, one]))
            assert np.array_equal(ahead[:, one], models[kind].ahead(x[:, one], u[:, one], time[:, one]))
