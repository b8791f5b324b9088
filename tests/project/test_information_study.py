"""What plans are worth: planning again with them."""

import sys

import numpy as np
import pytest

from quad_swarm.evaluation.rows import read_rows
from quad_swarm.task.request_task import make_task
from quad_swarm.task.rules import RULES
from quad_swarm.task.view import View
from sb3_maddpg import MADDPG
from studies.swarm import history, information

HEAD_ON = np.array([[-1.5, 0.05, 1.0], [1.5, -0.05, 1.0]])


@pytest.fixture(autouse=True)
def _rules():
    before = dict(RULES)
    yield
    RULES.clear()
    RULES.update(before)


def head_on():
    task = make_task(1, preset="paper", n_robots=2)
    task.place(0, "given", HEAD_ON, HEAD_ON[::-1].copy(), np.random.default_rng(0), checked=True)
    return task


def test_a_plan_that_evades_is_worth_more_than_one_that_does_what_is_expected():
    task = head_on()
    worths = []
    for _ in range(6):
        worths.append(information.worth(View(task.swarm)))
        task.step(np.zeros((1, 2, 1), bool))
    changes, regrets = (np.array([getattr(one, name).max() for one in worths]) for name in ("change", "regret"))
    assert changes[0] < 0.01, "both fly straight on at first"
    assert changes.max() > 0.1
    assert regrets[changes.argmax()] > regrets[0]


def test_who_does_what_is_expected_tells_nothing_new_and_planning_again_changes_nothing():
    task = make_task(1, preset="paper", n_robots=2)
    line = np.array([[-0.5, 0, 1.0], [0.5, 0, 1.0]])
    task.place(0, "given", line, line, np.random.default_rng(0), checked=True)
    task.step(np.zeros((1, 2, 1), bool))
    before = task.swarm.state_dict()
    worth = information.worth(View(task.swarm))
    after = task.swarm.state_dict()
    assert worth.change.max() < 1e-3
    assert abs(worth.regret).max() < 1e-3
    assert task.swarm.planner.rate is None
    assert before.keys() == after.keys()
    assert np.array_equal(before["state"], after["state"])


def test_robots_that_are_far_from_each_other_are_not_planned_for(monkeypatch):
    task = head_on()
    task.step(np.zeros((1, 2, 1), bool))
    monkeypatch.setattr(information, "NEAR", 0.0)
    worth = information.worth(View(task.swarm))
    assert not worth.change.any()
    assert not worth.regret.any()


@pytest.mark.slow
def test_an_actor_learns_what_is_worth_knowing_and_flies(tmp_path, monkeypatch):
    monkeypatch.setattr(information, "SWARMS", 4)
    out = tmp_path / "worth.zip"
    words = ["information", "train", "--out", str(out), "--rounds", "2", "--lessons", "3", "--updates", "40"]
    monkeypatch.setattr(sys, "argv", [*words, "--n-robots", "6"])
    information.main()
    assert MADDPG.load(out).policy.team.n_agents == 6
    table = tmp_path / "rows.json"
    words = ["information", "evaluate", "--preset", "flight-v3", "--n-robots", "4", "--scenario", "forest"]
    words += ["--episodes", "2", "--json", str(table), "--policy", "none", "change:0.2", "regret:1", f"{out}@0.2"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        information.main()
    assert ended.value.code in (0, None)
    shares = {row["policy"]: row["request_share"] for row in read_rows(table)}
    assert shares.pop("none") == 0
    assert 0 < shares["change:0.2"] < 0.2


def test_frames_are_of_the_same_episode(monkeypatch):
    monkeypatch.setattr(information, "SWARMS", 2)
    kwargs = {"preset": "flight-v2", "n_robots": 3, "observation": "state+memory+mask", "announcements": True}
    school = information.School({**kwargs, "max_steps": 6}, "stage:1.2:0.2", 0)
    seen = []
    observe = school.task.observe
    school.task.observe = lambda: seen.append((school.age.copy(), observe())) or seen[-1][1]
    for _ in range(4):
        frames = history.film(school).frames
        ages, obs = seen[-1]
        for swarm, age in enumerate(ages):
            for k, frame in enumerate(frames[:, swarm]):
                then = seen[-1 - min(k, age)][1][swarm]
                assert np.array_equal(frame, then), f"{k} steps ago, {age} steps after the episode began"
        assert np.array_equal(frames[0], obs)


def test_average_precision_is_one_if_all_that_matters_comes_first():
    matters = np.array([True, False, True, False])
    assert history.precision_of(np.array([4.0, 1.0, 3.0, 2.0]), matters) == 1.0
    assert history.precision_of(np.array([1.0, 4.0, 2.0, 3.0]), matters) == pytest.approx((1 / 3 + 2 / 4) / 2)


@pytest.mark.slow
def test_a_network_learns_from_what_robots_remember(tmp_path, monkeypatch, capsys):
    table = tmp_path / "history.json"
    words = ["history", "--lessons", "12", "--updates", "60", "--n-robots", "6", "--frames", "1", "5"]
    monkeypatch.setattr(sys, "argv", [*words, "--json", str(table)])
    history.main()
    rows = read_rows(table)
    assert [row["frames"] for row in rows] == [1, 5]
    assert len({(row["pairs"], row["matter"]) for row in rows}) == 1, "of the same flights"
    assert all(row["matter"] < row["average_precision"] < 1 for row in rows)
