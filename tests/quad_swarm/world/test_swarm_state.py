"""The state of swarms: everything that a flight changes is in the list, and the keys are those of files."""

import numpy as np
import pytest

from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm

KEYS = ["state", "goal", "input", "plans", "earlier", "beliefs", "presumed_beliefs", "chance"]
KEYS += ["neighbours", "obstacles", "commitment", "disturbance", "route", "heading"]
AMONG = {"obstacles": {"number": (1, 2), "speed": (0.5, 1.0)}}
LIMITED = {"neighbourhood": {"max_others": 2}}


def flown(config, steps: int) -> Swarm:
    swarm = Swarm(config, 3)
    sampler = ScenarioSampler("random", config.n_robots, config.space, config)
    for k in range(3):
        swarm.reset(k, *sampler.sample(np.random.default_rng(k))[1:], noise_seed=k)
    for _ in range(steps):
        swarm.step(np.ones((3, config.n_robots, config.n_others), dtype=bool))
    return swarm


@pytest.mark.parametrize(
    "config", [make_config("paper"), make_config("flight-hard", LIMITED, n_robots=4), make_config("flight", AMONG)]
)
def test_copies_parts_and_states_hold_what_changes(config):
    swarm = flown(config, 5)
    state = swarm.state_dict()
    assert list(state) == KEYS
    assert (state["presumed_beliefs"] is None) == (swarm.beliefs_seen_by_others is swarm.beliefs)
    other = Swarm(config, 3)
    other.load_state_dict(state)
    requests = np.zeros((3, config.n_robots, config.n_others), dtype=bool)
    part = swarm.fork()
    part.keep(np.array([False, True, False]))
    for one in (swarm.fork(), other, part):
        same = slice(None) if one is not part else slice(1, 2)
        for _ in range(3):
            one.step(requests[same])
        end = swarm.fork()
        for _ in range(3):
            end.step(requests)
        assert np.array_equal(one.state, end.state[same])
    assert np.array_equal(swarm.state, state["state"]), "copies fly on their own"
