"""CasADi functions of many rows: the interpreter's numbers to the last bit."""

import casadi as ca
import numpy as np
import pytest

from quad_swarm import quadrotor
from quad_swarm.native import BuildError
from quad_swarm.native.functions import RowFunction
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams, step_function


@pytest.mark.parametrize("varied", [False, True])
@pytest.mark.parametrize("dt", [0.01, None])
@pytest.mark.parametrize("count", [0, 1, 33])
def test_rows_are_those_of_the_interpreter(count, dt, varied):
    function = step_function(QuadrotorParams(drag_x=0.3), dt, varied)
    rng = np.random.default_rng(0)
    values = [0.3 * rng.normal(size=(count, function.numel_in(k))) for k in range(function.n_in())]
    found = RowFunction(function)(count, values)
    assert found.shape == (count, 9)
    for row in range(count):
        assert np.array_equal(found[row], np.ravel(function(*[value[row] for value in values])))
    values[2] = None
    still = RowFunction(function)(count, values)
    zeros = [np.zeros((count, 2)) if value is None else value for value in values]
    assert np.array_equal(still, RowFunction(function)(count, zeros))


def test_arguments_may_lie_anyhow_but_must_be_whole():
    x = ca.SX.sym("x", 3)
    function = RowFunction(ca.Function("twice", [x], [2 * x]))
    rows = np.arange(24.0).reshape(4, 6)
    assert np.array_equal(function(4, [rows[:, ::2]]), 2 * rows[:, ::2])
    assert np.array_equal(function(2, [rows[:, 0].reshape(2, 2)[:, :1].repeat(3, axis=1)]).shape, (2, 3))
    with pytest.raises(ValueError, match="12 numbers for 3 rows of 3"):
        function(3, [rows[:, ::2]])


def test_a_model_gives_the_same_numbers_with_and_without_a_compiler(monkeypatch):
    rng = np.random.default_rng(1)
    x, u, wind = 0.3 * rng.normal(size=(40, 9)), 0.2 * rng.normal(size=(40, 4)), rng.normal(size=(40, 2))
    factors, time = rng.uniform(0.8, 1.2, (40, 8)), rng.uniform(0, 0.05, 40)

    def flown() -> list[np.ndarray]:
        model = QuadrotorModel(QuadrotorParams(), 0.02)
        return [model.step(x, u, wind), model.step(x, u, wind, factors), model.step(x, u), model.ahead(x, u, time)]

    compiled = flown()
    quadrotor._compiled_step.cache_clear()

    def refuse(function: ca.Function) -> None:
        raise BuildError("no compiler")

    monkeypatch.setattr(quadrotor, "RowFunction", refuse)
    for one, other in zip(compiled, flown(), strict=True):
        assert np.array_equal(one, other)
    quadrotor._compiled_step.cache_clear()
