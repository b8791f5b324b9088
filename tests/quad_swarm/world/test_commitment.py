"""Robots keep to the plans that they sent."""

import numpy as np
import pytest

from quad_swarm.evaluation.evaluation import run_episodes
from quad_swarm.evaluation.flight import Condition, first_episode
from quad_swarm.planner import PlannerConfig
from quad_swarm.world.commitment import Commitment
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm

CONFIG = PlannerConfig(horizon=4, commitment=3.0, commitment_fade=2.0)
LINE = np.arange(5.0)[:, None] * [1.0, 0.0, 0.0]  # a plan at constant velocity


def test_what_was_sent_last_is_kept_to_as_far_as_it_reaches():
    commitment = Commitment(CONFIG, 1, 2)
    assert not commitment.reference(None)[1].any(), "nothing was sent"
    commitment.sent(np.array([[True, False]]), np.stack([LINE, LINE])[None], 1)
    reference, weight = commitment.reference(None)
    np.testing.assert_allclose(reference[0], LINE[1:])
    np.testing.assert_allclose(weight, [[3, 3 * np.exp(-0.5), 3 * np.exp(-1), 0], [0] * 4])
    commitment.advance()
    reference, weight = commitment.reference(np.full((1, 2), 0.25))
    np.testing.assert_allclose(reference[0], LINE[1:] + 1.25 * LINE[1], err_msg="a step and a quarter later")
    np.testing.assert_allclose(weight[0], [3, 3 * np.exp(-0.5), 0, 0])
    commitment.sent(np.array([[True, True]]), -np.stack([LINE, LINE])[None], 3)
    assert commitment.age.tolist() == [[2, 3]], "an older plan does not replace a newer one"
    for _ in range(9):
        commitment.advance()
    assert not commitment.reference(None)[1].any()
    assert commitment.age.max() == 4


def test_a_robot_that_told_its_plan_changes_it_less():
    """Robot 0 sets off, tells its plan, and is then given another goal."""
    deviations = {}
    for weight in (0.0, 10.0):
        swarm = Swarm(make_config("paper", {"planner": {"commitment": weight}}, n_robots=2))
        swarm.reset(0, np.array([[-2.0, 0, 1], [3.0, 3, 1]]), np.array([[2.0, 0, 1], [3.0, 3, 1]]))
        for _ in range(8):
            swarm.step(np.zeros((1, 2, 1), bool))
        told = swarm.planned_positions()[0, 0]
        swarm.set_goals(0, [[-2.0, 3.0, 1]], robots=[0])
        swarm.step(np.array([[[False], [True]]]))
        off = np.linalg.norm(swarm.planned_positions()[0, 0, :-1] - told[1:], axis=1)
        deviations[weight] = off[1:8].max()
    assert deviations[10.0] < 0.5 * deviations[0.0]


@pytest.mark.parametrize("preset", ["paper", "flight"])
def test_swarms_save_copy_and_split_what_was_sent(preset):
    config = make_config(preset, {"planner": {"commitment": 1.0}}, n_robots=3)
    swarm, rng = Swarm(config, 2), np.random.default_rng(0)
    starts = np.array([[-1.5, 0, 1], [1.5, 0, 1], [0, 1.5, 1]])
    for k in range(2):
        swarm.reset(k, starts, -starts + [0, 0, 2 * 1], noise_seed=k)
    requests = rng.random((9, 2, 3, 2)) < 0.3
    for one in requests[:4]:
        swarm.step(one)
    other = Swarm(config, 2)
    for k in range(2):
        other.reset(k, starts, -starts + [0, 0, 2 * 1], noise_seed=k + 7)
    other.load_state_dict(swarm.state_dict())
    second, fork = swarm.part(np.array([False, True])), swarm.fork()
    second.disturbances = fork.disturbances.fork()
    second.disturbances.keep(np.array([False, True]))
    for one in requests[4:]:
        for copied in (swarm, other, fork):
            copied.step(one)
        second.step(one[1:])
    for copied in (other, fork):
        assert copied.state.tobytes() == swarm.state.tobytes()
        assert copied.commitment.plan.tobytes() == swarm.commitment.plan.tobytes()
        assert np.array_equal(copied.commitment.age, swarm.commitment.age)
    assert second.state.tobytes() == swarm.state[1:].tobytes(), "alone as in a batch"
    assert (swarm.commitment.age < config.planner.horizon).any()


def test_keeping_to_what_was_told_makes_plans_last():
    """The rule by which senders tell sends fewer plans if robots keep to them."""
    shares = []
    for weight in (0.0, 3.0):
        config = make_config("flight", {"planner": {"commitment": weight}}, n_robots=4)
        rows = run_episodes(
            Condition("stage:0.9:0.3", "symmetric_swap", config), [first_episode(3) + k for k in range(6)]
        )
        assert not any(row["collided"] for row in rows)
        shares.append(sum(row["requests"] for row in rows) / sum(row["possible_requests"] for row in rows))
    assert shares[1] < 0.85 * shares[0]
