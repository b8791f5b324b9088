"""Scenarios: what the paper says of each, bounds, and robots that do not fit."""

import ast
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quad_swarm import QuadSwarmEnv, QuadSwarmParallelEnv, QuadSwarmVectorEnv
from quad_swarm.evaluation.flight import Condition
from quad_swarm.world.presets import PRESETS, for_scenario, make_config
from quad_swarm.world.scenarios import (
    MOST_OBSTACLES,
    SCENARIOS,
    DoesNotFit,
    ScenarioSampler,
    ScenarioSpace,
    extent,
    without_obstacles,
)

SPACE = ScenarioSpace()


def spacing(points: np.ndarray) -> float:
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return distance[np.triu_indices(len(points), 1)].min()


@pytest.mark.parametrize("name", SCENARIOS)
@given(n_robots=st.integers(2, 9), seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_keeps_bounds_and_spacing(name, n_robots, seed):
    _, starts, goals, _ = ScenarioSampler(name, n_robots, SPACE).sample(np.random.default_rng(seed))
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


def test_tours_have_waypoints_and_goals_that_move_cross_the_room():
    space = replace(SPACE, waypoints=(2, 3))
    lengths = set()
    for seed in range(20):
        name, scene = ScenarioSampler("tour", 3, space, make_config("paper", n_robots=3)).draw(
            np.random.default_rng(seed)
        )
        assert (name, scene.velocities) == ("tour", None)
        assert np.shape(scene.waypoints)[::2] == (3, 3)
        lengths.add(np.shape(scene.waypoints)[1])
        assert min(spacing(points) for points in np.swapaxes(scene.waypoints, 0, 1)) >= space.spacing
        _, scene = ScenarioSampler("moving_goals", 3, space).draw(np.random.default_rng(seed))
        assert scene.waypoints is None
        velocity = scene.velocities[0]
        assert (scene.velocities == velocity).all()
        assert space.goal_speed[0] <= np.linalg.norm(velocity) <= space.goal_speed[1]
        assert (scene.goals @ velocity <= 0).all(), "towards the other half"
    assert lengths == {2, 3}


def test_mixed_draws_all_scenarios_alike():
    sampler = ScenarioSampler("mixed", 4, SPACE)
    rng = np.random.default_rng(0)
    names = [sampler.sample(rng)[0] for _ in range(800)]
    assert all(150 < names.count(name) < 250 for name in without_obstacles())


def test_curriculum_opens_scenarios_one_by_one():
    sampler = ScenarioSampler("curriculum", 4, SPACE)
    rng = np.random.default_rng(0)
    for level in range(sampler.n_levels):
        sampler.set_level(level)
        assert {sampler.sample(rng)[0] for _ in range(100)} == set(without_obstacles()[: level + 1])
    with pytest.raises(ValueError, match="Level 4 does not exist"):
        sampler.set_level(4)
    with pytest.raises(ValueError, match="levels 0 to 0"):
        ScenarioSampler("mixed", 4, SPACE).set_level(1)


@pytest.mark.slow
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


def test_equal_mixtures_draw_the_same_in_any_order():
    """The file of a run has its keys in another order than the recipe, and a resumed run reads that file."""
    weights = {"symmetric_swap": 3, "asymmetric_swap": 1, "random": 2}
    drawn = []
    for mixture in (weights, dict(reversed(weights.items()))):
        sampler, rng = ScenarioSampler(mixture, 3, SPACE), np.random.default_rng(0)
        drawn.append([sampler.sample(rng)[0] for _ in range(50)])
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == set(weights)


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


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "n_robots"), [("paper", 14), ("paper", 16), ("dense", 16), ("flight", 16)])
def test_robots_that_fit_at_construction_fit_at_every_reset(preset, n_robots):
    config = make_config(preset, n_robots=n_robots)
    sampler = ScenarioSampler("symmetric_swap", n_robots, config.space, config)
    for seed in range(40):  # 13 to 87 of 200 draws fail
        _, starts, goals, _ = sampler.sample(np.random.default_rng(seed))
        assert min(spacing(starts), spacing(goals)) >= config.space.spacing


@pytest.mark.slow
@given(
    name=st.sampled_from([*SCENARIOS, "mixed"]),
    n_robots=st.integers(2, 40),
    gap=st.floats(0.3, 3.0),
    half_width=st.floats(0.5, 8.0),
    circle=st.tuples(st.floats(0.1, 5.0), st.floats(0.0, 3.0)),
    jitter=st.floats(0, 1.0),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=10, deadline=None)
def test_a_room_is_refused_at_construction_or_never(name, n_robots, gap, half_width, circle, jitter, seed):
    radius = (circle[0], circle[0] + circle[1])
    space = ScenarioSpace(half_width, (0.7, 2.1), gap, radius, jitter, radius)
    try:
        sampler = ScenarioSampler(name, n_robots, space)
    except DoesNotFit:
        return
    for k in range(3):
        _, starts, goals, _ = sampler.sample(np.random.default_rng(seed + k))
        assert min(spacing(starts), spacing(goals)) >= gap


@pytest.mark.slow
def test_draws_that_succeed_at_once_are_as_they_were():
    space = PRESETS["paper"].space
    sampler = ScenarioSampler("symmetric_swap", 16, space)
    same = 0
    for seed in range(20):
        try:
            expected = SCENARIOS["symmetric_swap"](16, space, np.random.default_rng(seed))
        except DoesNotFit:
            continue
        found = sampler.sample(np.random.default_rng(seed))[1:3]
        assert np.array_equal(found, expected)
        same += 1
    assert 5 < same < 20, "the others were drawn again"


@pytest.mark.slow
@pytest.mark.parametrize("n_robots", [18, 20, 40, 300])
@pytest.mark.parametrize("name", SCENARIOS)
def test_the_number_and_the_room_that_are_named_fit(name, n_robots):
    space = SPACE if n_robots < 100 or "swap" in name[6:] else replace(SPACE, half_width=5.0)
    try:
        ScenarioSampler(name, n_robots, space)
        return
    except DoesNotFit as error:
        told = str(error)
    field = extent(SCENARIOS[name], space).field
    found = re.fullmatch(
        rf"{n_robots} robots .* of '{name}'; about (\d+) do\. .*"
        rf" space\.{field}=(.*) if the workspace is large enough\.",
        told,
    )
    assert found, told
    ScenarioSampler(name, int(found[1]), space)
    ScenarioSampler(name, n_robots, replace(space, **{field: ast.literal_eval(found[2])}))
    with pytest.raises(DoesNotFit):
        ScenarioSampler(name, 2 * int(found[1]) + 4, space)


@pytest.mark.parametrize("highest", [2.1, 2.6])
def test_all_that_leaves_a_workspace_is_said_at_once(highest):
    given = {"workspace_low": (-1.5, -1.5, 0.5), "workspace_high": (1.5, 1.5, 2.0)}
    room = {"radius": 0.15, "planner": given, "space": {"heights": (0.7, highest)}}
    with pytest.raises(ValueError, match="half_width=3") as caught:
        ScenarioSampler("random", 2, SPACE, make_config("flight-v2", n_robots=2, **room))
    fields = dict(re.findall(r"space\.(\w+)=(\[[^]]*\]|[0-9.]+)(?: and|,)", str(caught.value)))
    fitting = {name: ast.literal_eval(value) for name, value in fields.items()}
    assert fitting.keys() == {"half_width", "sector_radius", "circle_radius", "heights"}
    config = make_config("flight-v2", n_robots=2, **{**room, "space": fitting})
    for name in without_obstacles():
        ScenarioSampler(name, 2, config.space, config)


@pytest.mark.slow
def test_about_sixteen_robots_fit_on_the_circle_of_the_paper():
    for n_robots in (20, 40):
        with pytest.raises(DoesNotFit, match=r"about 1[5-8] do\..* space\.circle_radius="):
            ScenarioSampler("symmetric_swap", n_robots, SPACE)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        (
            "random",
            {"half_width": 10},
            r"space\.half_width=10\.0: starts and goals of 'random' lie up to 5\.2 m outside",
        ),
        ("symmetric_swap", {"circle_radius": [5, 6]}, r"space\.circle_radius=.* 'symmetric_swap' lie up to 1\.35 m"),
        ("asymmetric_swap", {"sector_radius": [2, 6]}, r"space\.sector_radius=.* 'asymmetric_swap' lie up to 1\.2 m"),
        ("mixed", {"heights": [4, 8]}, r"space\.heights=.* lie up to 5\.6 m outside"),
        ("mixed", {"heights": [800, 1700]}, r"space\.heights=.* outside the workspace.* Lengths are in metres\.$"),
    ],
)
def test_a_room_beyond_a_given_workspace_is_refused_where_it_is_used(name, changes, message):
    given = {"workspace_low": (-4.8, -4.8, 0.48), "workspace_high": (4.8, 4.8, 2.4)}
    config = make_config("paper", planner=given, space=changes)
    for make in (
        lambda: ScenarioSampler(name, 4, config.space, config),
        lambda: QuadSwarmEnv(scenario=name, planner=given, space=changes),
        lambda: QuadSwarmVectorEnv(2, scenario=name, planner=given, space=changes),
        lambda: QuadSwarmParallelEnv(scenario=name, planner=given, space=changes),
        lambda: Condition("none", name, config),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            make()
        assert "\n" not in str(caught.value)
    wider = re.findall(r"workspace_\w+=(\[[^]]*\])", str(caught.value))
    workspace = dict(zip(given, map(ast.literal_eval, wider), strict=True))
    ScenarioSampler(name, 4, config.space, make_config("paper", planner=workspace, space=changes))
    ((field, smaller),) = re.findall(r"give space\.(\w+)=(.*?), or", str(caught.value)) or [("", "")]
    assert (not field) is ("heights" in changes), "no smaller heights are left"
    if field:
        config = make_config("paper", planner=given, space={field: ast.literal_eval(smaller)})
        ScenarioSampler(name, 4, config.space, config)
    other = "random" if name != "random" else "symmetric_swap"
    if "heights" not in changes:
        ScenarioSampler(other, 4, config.space, config)


def test_a_workspace_in_a_corner_of_the_frame_is_told_as_such():
    planner = {"workspace_low": (0, 0, 0.4), "workspace_high": (6, 6, 2.4)}
    config = make_config("flight-v2", planner=planner, n_robots=2)
    with pytest.raises(
        ValueError, match=r"around x = y = 0, but the middle of the workspace is \[3\.0, 3\.0\]: give"
    ) as caught:
        ScenarioSampler("symmetric_swap", 2, config.space, config)
    assert "workspace_low=[" not in str(caught.value), "a workspace beyond the walls"


def _foreign(starts, goals):
    return lambda n_robots, space, rng: (np.array(starts, float), np.array(goals, float))


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        (_foreign([[0, 0, 1], [0.2, 0, 1]], [[2, 0, 1], [-2, 0, 1]]), r"starts\[0\] and starts\[1\] are 0\.2 m apart"),
        (_foreign([[0, 0, 1], [2, 0, 1]], [[9, 0, 1], [-2, 0, 1]]), r"goals\[0\]=.* 4\.2 m outside the workspace"),
        (_foreign([[0, 0, 1], [2, 0, 1]], [[0, np.nan, 1], [-2, 0, 1]]), "goals must be 2 finite points"),
        (_foreign([[0, 0], [2, 0]], [[0, 1], [-2, 0]]), r"starts must be 2 finite points, shape \(2, 3\)"),
        (lambda n_robots, space, rng: None, "returns None: it must return starts and goals"),
    ],
)
def test_what_a_registered_scenario_returns_is_checked(scenario, message, monkeypatch):
    monkeypatch.setitem(SCENARIOS, "foreign", scenario)
    for make in (
        lambda: QuadSwarmEnv(n_robots=2, scenario="foreign"),
        lambda: QuadSwarmVectorEnv(2, n_robots=2, scenario="foreign"),
        lambda: QuadSwarmParallelEnv(n_robots=2, scenario={"random": 1, "foreign": 1}),
        lambda: Condition("none", "foreign", make_config("paper", n_robots=2)),
    ):
        with pytest.raises(ValueError, match=f"^Scenario 'foreign':? {message}") as caught:
            make()
        assert "\n" not in str(caught.value)


def test_a_registered_scenario_that_seldom_fails_is_drawn_again(monkeypatch):
    def seldom(n_robots, space, rng):
        starts, goals = SCENARIOS["random"](n_robots, space, rng)
        if rng.random() < 0.05:
            starts[1] = starts[0]
        return starts, goals

    monkeypatch.setitem(SCENARIOS, "seldom", seldom)
    config = make_config("paper")
    sampler = ScenarioSampler("seldom", 4, config.space, config)
    assert min(spacing(sampler.sample(np.random.default_rng(seed))[1]) for seed in range(100)) >= SPACE.spacing


@pytest.mark.parametrize("name", [*without_obstacles(), *MOST_OBSTACLES])
def test_starts_and_goals_are_apart_in_the_metric_of_the_downwash(name):
    """Robots would start in each other's downwash otherwise, which counts as contact."""
    config = make_config("flight", planner={"downwash": 3.0, "separation": 0.8}, n_robots=6)
    sampler = ScenarioSampler(name, 6, config.space, for_scenario(config, name))
    for seed in range(20):
        _, starts, goals, *_ = sampler.sample(np.random.default_rng(seed))
        for places in (starts, goals):
            between = (places[:, None] - places) * (1, 1, 1 / 3)
            assert np.linalg.norm(between[np.triu_indices(6, 1)], axis=-1).min() >= config.space.spacing


def test_given_starts_in_the_downwash_of_others_are_refused():
    env = QuadSwarmEnv(preset="flight", n_robots=2, world={"planner": {"downwash": 3.0}})
    starts, goals = [[0.0, 0.0, 0.8], [0.0, 0.1, 2.2]], [[2.0, 0.0, 1.0], [-2.0, 0.0, 1.0]]
    with pytest.raises(
        ValueError, match=r"starts\[0\] and starts\[1\] are 0.477 m apart \(vertical distances count 1 / 3"
    ):
        env.reset(seed=0, options={"starts": starts, "goals": goals})
