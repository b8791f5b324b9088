"""What robots observe of each other, and what they must not."""

import numpy as np
import pytest

from quad_swarm import QuadSwarmEnv
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.task.observation import GROUPS, PairObservation, PaperObservation, make_observation
from quad_swarm.task.view import View
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm

CONFIG = make_config("paper")
EVERYTHING = "state+approach+memory+plan+told+critic"


def flown(steps: int = 8, n_swarms: int = 3) -> Swarm:
    """Swarms in mid-flight, some of whose robots have asked."""
    swarm, rng = Swarm(CONFIG, n_swarms), np.random.default_rng(0)
    for k in range(n_swarms):
        swarm.reset(k, *ScenarioSampler("symmetric_swap", 4, CONFIG.space).sample(rng)[1:])
    for _ in range(steps):
        swarm.step(rng.random((n_swarms, 4, 3)) < 0.4)
    return swarm


def columns_of_actor(observation: PairObservation, rows: np.ndarray) -> np.ndarray:
    layout = observation.layout
    return rows[..., [*layout["own"], *np.ravel(layout["neighbours"])]]


@pytest.mark.parametrize("groups", [*GROUPS, EVERYTHING, "state+plan"])
def test_rows_have_the_columns_that_the_layout_names(groups):
    observation = make_observation(CONFIG, groups)
    rows = observation(flown())
    layout = observation.layout
    assert rows.shape == (3, 4, observation.size)
    assert rows.dtype == np.float32
    assert np.isfinite(rows).all()
    named = [*layout["own"], *np.ravel(layout["neighbours"]), *np.ravel(layout.get("critic", []))]
    assert sorted(named) == list(range(observation.size))


def test_a_robot_does_not_see_the_plans_and_goals_of_others():
    observation, swarm = PairObservation(CONFIG, EVERYTHING.split("+")), flown()
    before = observation(swarm)
    swarm._plans.x[1::4, :, POSITION] += 0.3  # robot 1 of every swarm
    swarm.goal[:, 1] += 1.0
    after = observation(swarm)
    others = [0, 2, 3]
    assert np.array_equal(
        columns_of_actor(observation, before)[:, others], columns_of_actor(observation, after)[:, others]
    )
    assert not np.array_equal(before[:, others], after[:, others]), "critics see the plans"


def test_without_critics_only_their_columns_are_empty():
    groups, swarm = EVERYTHING.split("+"), flown()
    seen, blind = PairObservation(CONFIG, groups), PairObservation(CONFIG, groups, critics=False)
    assert (seen.size, seen.layout) == (blind.size, blind.layout)
    rows = blind(swarm)
    assert np.array_equal(columns_of_actor(seen, seen(swarm)), columns_of_actor(blind, rows))
    assert not rows[..., np.ravel(blind.layout["critic"])].any()


def test_the_order_of_groups_does_not_matter_and_a_group_can_be_left_out():
    swarm = flown()
    assert np.array_equal(make_observation(CONFIG, "plan+state")(swarm), make_observation(CONFIG, "state+plan")(swarm))
    assert make_observation(CONFIG, "state").size < make_observation(CONFIG, "state+approach").size


@pytest.mark.parametrize("groups", ["state+approach+memory+plan"])
def test_turned_and_mirrored_swarms_look_the_same(groups):
    swarm, turned = flown(), flown()
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    for change in (turn, np.diag([1.0, -1.0, 1.0])):
        for part in (POSITION, VELOCITY):
            turned.state[..., part] = turned.state[..., part] @ change.T
        turned._plans.x[..., POSITION] = turned._plans.x[..., POSITION] @ change.T
        turned.goal = turned.goal @ change.T
        turned.beliefs._remembered = turned.beliefs._remembered @ change.T
    observation = PairObservation(CONFIG, groups.split("+"))
    pairs = np.ravel(observation.layout["neighbours"])
    np.testing.assert_allclose(observation(turned)[..., pairs], observation(swarm)[..., pairs], atol=1e-5)


def test_the_paper_s_observation_is_the_default():
    assert isinstance(make_observation(CONFIG), PaperObservation)
    assert QuadSwarmEnv().observation_space.shape == (4, 24)
    env = QuadSwarmEnv(observation="state+memory")
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert "critic" not in env.observation_layout


def test_an_unknown_group_is_refused():
    with pytest.raises(ValueError, match="Did you mean 'memory'"):
        QuadSwarmEnv(observation="state+memmory")


def test_the_side_on_which_the_other_would_pass_is_seen_although_the_frame_is_mirrored():
    config = make_config("paper", n_robots=2)
    observation = make_observation(config, "side")
    columns = observation.layout["neighbours"][0]
    seen = []
    for lateral in (0.5, -0.5):
        swarm = Swarm(config, 1)
        swarm.reset(0, np.array([[0.0, 0, 1], [4, lateral, 1]]), np.zeros((2, 3)), checked=True)
        swarm.state[0, :, 3] = [1.0, -1.0]
        seen.append(observation(swarm)[0][:, columns])
    left, right = seen
    # To the left of where they go, or to the right: for both robots alike
    assert (left[:, 1:] > 0.4).all()
    np.testing.assert_allclose(left[:, 1:], -right[:, 1:], atol=1e-6)


def test_the_mask_names_those_who_come_near_the_own_plan_or_will_soon_be_near():
    observation, swarm = make_observation(CONFIG, EVERYTHING + "+mask"), flown()
    mask = observation(swarm)[..., observation.layout["action_mask"]]
    view = View(swarm)
    near = view.plan_approach.least < 1.8 * CONFIG.planner.separation
    ahead = view.approach(3.0)[0] < 1.2 * CONFIG.planner.separation
    assert np.array_equal(mask, near | ahead)
    assert 0 < near.mean() < (near | ahead).mean() < 1
    assert "action_mask" not in make_observation(CONFIG, EVERYTHING).layout


def ones(pair, *columns):
    return np.ones((*pair.view.pos.shape[:3], *columns))


@pytest.mark.parametrize("form", [np.array, np.ndarray.tolist, lambda features: features.astype(int)])
def test_a_group_of_ones_own_may_return_any_real_numbers(form, monkeypatch):
    monkeypatch.setitem(GROUPS, "own", lambda pair: form(2 * ones(pair, 2)))
    observation, swarm = make_observation(CONFIG, "state+own"), flown()
    blocks = observation(swarm)[..., 6:].reshape(3, 4, 3, -1)
    plain = make_observation(CONFIG, "state")(swarm)[..., 6:].reshape(3, 4, 3, -1)
    assert np.array_equal(blocks[..., :-2], plain)
    assert (blocks[..., -2:] == 2).all()


@pytest.mark.parametrize(
    "group",
    [
        lambda pair: None, lambda pair: 1.0, lambda pair: np.ones(2), ones,
        lambda pair: ones(pair, 2) * np.nan,
        lambda pair: ones(pair, 2) * 1e39, lambda pair: ones(pair, 2) * 1j, lambda pair: ones(pair, 2).astype(str),
        lambda pair: ones(pair, 2)[:, :1], lambda pair: [[1.0], [1.0, 2.0]],
        lambda pair: np.ma.array(ones(pair, 2), mask=True),
    ],
)  # fmt: skip
def test_a_group_of_ones_own_that_returns_something_else_is_refused(group, monkeypatch):
    monkeypatch.setitem(GROUPS, "own", group)
    with pytest.raises(
        ValueError, match=r"The observation 'own' returned .*finite numbers for every pair, shape \(1, 4, 3"
    ):
        make_observation(CONFIG, "state+own")


def test_a_group_of_ones_own_has_the_same_length_each_time(monkeypatch):
    lengths = iter((2, 3))
    monkeypatch.setitem(GROUPS, "own", lambda pair: ones(pair, next(lengths)))
    observation = make_observation(CONFIG, "state+own")
    with pytest.raises(ValueError, match=r"shape \(3, 4, 3, 2\), the same length each time"):
        observation(flown())
