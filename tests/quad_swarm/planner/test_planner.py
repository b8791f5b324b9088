"""Making planners: by the name of their solver, and for other processes."""

import pickle

import numpy as np
import pytest
from planning import QUADROTOR, crossing, hover

from quad_swarm.planner import PlannerConfig, make_planner


def test_survives_pickling():
    config = PlannerConfig()
    problems = crossing(2, config)
    planner = make_planner(config, QUADROTOR, 3, "fatrop")
    expected = planner.plan(problems, hover(problems, config))
    copy = pickle.loads(pickle.dumps(planner))
    assert np.array_equal(copy.plan(problems, hover(problems, config)).x, expected.x)


def test_suggests_the_solver_that_was_meant():
    with pytest.raises(ValueError, match="Did you mean 'fatrop'"):
        make_planner(PlannerConfig(), QUADROTOR, 2, solver="fatrob")
