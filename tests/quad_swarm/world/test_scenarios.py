"""Scenarios: what the paper says of each, bounds, and robots that do not fit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quad_swarm.world.presets import PRESETS
from quad_swarm.world.scenarios import SCENARIOS, DoesNotFit, ScenarioSampler, ScenarioSpace

SPACE = ScenarioSpace()


def spacing(points: np.ndarray) -> float:
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return distance[np.triu_indices(len(points), 1)].min()


@pytest.mark.parametrize("name", SCENARIOS)
@given(n_robots=st.integers(2, 9), seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_keeps_bounds_and_spacing(name, n_robots, seed):
    starts, goals = SCENARIOS[name](n_robots, SPACE, np.random.default_rng(seed))
    assert starts.shape == goals.shape == (n_robots, 3)
    for points in (starts, goals):
        assert spacing(points) >= SPACE.spacing
        assert np.abs(points[:, :2]).max() <= 4.5
        assert points[:, 2].min() >= SPACE.heights[0] - SPACE.circle_jitter
        assert points[:, 2].max() <= SPACE.heights[1] + SPACE.circle_jitter


@given(n_robots=st.integers(2, 9), seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_random_swap_sends_everyone_to_another_start(n_robots, seed):
    starts, goals = SCENARIOS["random_swap"](n_robots, SPACE, np.random.default_rng(seed))
    assert sorted(map(tuple, starts)) == sorted(map(tuple, goals))
    assert (np.linalg.norm(starts - goals, axis=1) > 0).all()


def test_asymmetric_swap_is_between_opposite_quadrants():
    for seed in range(50):
        starts, goals = SCENARIOS["asymmetric_swap"](4, SPACE, np.random.default_rng(seed))
        sector = np.rint(np.arctan2(starts[:, 1], starts[:, 0]) / (np.pi / 2)).astype(int) % 4
        assert sector.tolist() == [0, 1, 2, 3]
        assert np.array_equal(goals, starts[[2, 3, 0, 1]])


def test_symmetric_swap_is_antipodal_but_for_the_jitter():
    starts, goals = SCENARIOS["symmetric_swap"](5, SPACE, np.random.default_rng(0))
    assert np.abs(goals[:, :2] + starts[:, :2]).max() <= 2 * SPACE.circle_jitter
    exact = ScenarioSpace(circle_jitter=0.0)
    starts, goals = SCENARIOS["symmetric_swap"](6, exact, np.random.default_rng(0))
    np.testing.assert_allclose(goals[:, :2], -starts[:, :2], atol=1e-12)


def test_mixed_draws_all_scenarios_alike():
    sampler = ScenarioSampler("mixed", 4, SPACE)
    rng = np.random.default_rng(0)
    names = [sampler.sample(rng)[0] for _ in range(800)]
    assert all(150 < names.count(name) < 250 for name in SCENARIOS)


def test_curriculum_opens_scenarios_one_by_one():
    sampler = ScenarioSampler("curriculum", 4, SPACE)
    rng = np.random.default_rng(0)
    for level in range(sampler.n_levels):
        sampler.set_level(level)
        assert {sampler.sample(rng)[0] for _ in range(100)} == set(list(SCENARIOS)[: level + 1])
    with pytest.raises(ValueError, match="Level 4 does not exist"):
        sampler.set_level(4)
    with pytest.raises(ValueError, match="levels 0 to 0"):
        ScenarioSampler("mixed", 4, SPACE).set_level(1)


@pytest.mark.parametrize("name", [*SCENARIOS, "mixed", "curriculum"])
def test_says_how_many_fit(name):
    with pytest.raises(DoesNotFit, match=r"300 robots .* do not fit .* about \d+ do"):
        ScenarioSampler(name, 300, SPACE)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_have_room_for_their_robots(preset):
    config = PRESETS[preset]
    for name in SCENARIOS:
        sampler = ScenarioSampler(name, config.n_robots, config.space)
        rng = np.random.default_rng(1)
        for _ in range(50):
            sampler.sample(rng)


def test_bad_names_and_numbers():
    with pytest.raises(ValueError, match="Did you mean 'asymmetric_swap'"):
        ScenarioSampler("asymetric", 4, SPACE)
    with pytest.raises(ValueError, match="n_robots=1"):
        ScenarioSampler("random", 1, SPACE)


def test_weights_are_shares():
    sampler = ScenarioSampler({"symmetric_swap": 3, "random": 1, "random_swap": 0}, 3, SPACE)
    rng = np.random.default_rng(0)
    names = [sampler.sample(rng)[0] for _ in range(400)]
    assert set(names) == {"symmetric_swap", "random"}
    assert abs(names.count("symmetric_swap") / 400 - 0.75) < 0.07
    assert sampler.n_levels == 1


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"random": -1, "random_swap": 2}, "not be negative"),
        ({"random": 1e308, "random_swap": 1e308}, "their sum must be positive and finite"),
        ({"rnadom": 1}, "Did you mean 'random'"),
    ],
)
def test_senseless_weights_are_refused(weights, message):
    with pytest.raises(ValueError, match=message):
        ScenarioSampler(weights, 4, SPACE)
