"""Who asks whom decides what a planner knows: nothing of a robot reaches those that did not ask it."""

import numpy as np
import pytest

from quad_swarm.quadrotor import ATTITUDE
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm


def flown(solver: str, steps: int, seed: int) -> Swarm:
    """A swarm in mid-flight, some of whose robots have asked; the same for the same arguments."""
    config = make_config("paper")
    swarm, rng = Swarm(config, 1, solver), np.random.default_rng(seed)
    swarm.reset(0, *ScenarioSampler("symmetric_swap", 4, config.space).sample(rng)[1:])
    for _ in range(steps):
        swarm.step(rng.random((1, 4, 3)) < 0.4)
    return swarm


def change_what_is_private(swarm: Swarm, robot: int, rng: np.random.Generator) -> None:
    """Another plan, other inputs, attitude and goal of one robot; its position and velocity can be seen by all."""
    swarm._plans.x[robot] += rng.normal(size=swarm._plans.x[robot].shape) * 0.1
    swarm._plans.u[robot] += rng.normal(size=swarm._plans.u[robot].shape) * 0.05
    swarm.state[0, robot, ATTITUDE] += rng.normal(size=3) * 0.05
    swarm.goal[0, robot] += rng.normal(size=3)


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "n_seeds"), [("rti", 12), ("fatrop", 2)])
def test_plans_depend_on_those_that_were_asked_alone(solver, n_seeds):
    told = unasked = 0
    for seed in range(n_seeds):
        for robot in range(4):
            rng = np.random.default_rng(seed)
            plain, changed = flown(solver, 3 + seed, seed), flown(solver, 3 + seed, seed)
            change_what_is_private(changed, robot, rng)
            requests = rng.random((1, 4, 3)) < 0.5
            plain.step(requests)
            changed.step(requests)
            for other in range(4):
                if other == robot:
                    continue
                place = plain.neighbours.others[other].tolist().index(robot)
                same = all(
                    np.array_equal(getattr(plain._plans, name)[other], getattr(changed._plans, name)[other])
                    for name in ("x", "u", "status", "iterations")
                )
                assert same != requests[0, other, place], "as far as it has asked"
                told, unasked = told + (not same), unasked + same
    assert min(told, unasked) > n_seeds
