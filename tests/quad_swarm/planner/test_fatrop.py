"""The reference solver ends, whatever it is given. Its optimum is tested in test_planner.py."""

import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from quad_swarm.planner import FatropSolver, OptimalControlProblem, PlannerConfig, Problems
from quad_swarm.planner.fatrop import transcribe
from quad_swarm.quadrotor import QuadrotorParams

CONFIG = PlannerConfig()
PROBLEM = OptimalControlProblem(CONFIG, QuadrotorParams(), 1)


@pytest.mark.parametrize("distance", [1.0, 18.0, 30.0, 45.0, 1e3, 1e5])
def test_derivatives_are_finite_however_far_the_others_are(distance):
    nlp = transcribe(PROBLEM).nlp
    hessian, gradient = ca.hessian(nlp["f"], nlp["x"])
    derivatives = ca.Function("derivatives", [nlp["x"], nlp["p"]], [hessian, gradient])
    parameters = np.zeros(nlp["p"].numel())
    parameters[-3 * CONFIG.horizon :: 3] = distance
    for values in derivatives(np.zeros(nlp["x"].numel()), parameters):
        assert np.isfinite(values.full()).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6, 1e200])
def test_what_is_no_state_fails_without_a_solve(value):
    x = np.zeros((1, 9))
    x[0, 3] = value
    problems = Problems(x, np.zeros((1, 3)), np.ones((1, 1, CONFIG.horizon, 3)))
    guess = np.zeros((1, CONFIG.horizon + 1, 9)), np.zeros((1, CONFIG.horizon, 4))
    solution = FatropSolver(PROBLEM).solve(problems, *guess)
    assert (solution.success[0], solution.iterations[0]) == (False, 0)


@pytest.mark.parametrize("noise", ["attitude=1.5", "pos=1e3", "vel=1e3"])
def test_every_solve_ends(noise):
    name, value = noise.split("=")
    code = f"""
import numpy as np
from quad_swarm import QuadSwarmEnv
env = QuadSwarmEnv(solver="fatrop", noise={{"{name}": {value}}})
env.reset(seed=0)
for _ in range(6):
    assert np.isfinite(env.step(np.zeros(12))[0]).all()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, capture_output=True)
