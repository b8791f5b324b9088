"""The command that flies robots in real time."""

import json
import subprocess
import sys

import numpy as np
import pytest
from network import alone

from quad_swarm.evaluation.flight import Condition, begin, first_episode
from quad_swarm.evaluation.real_time import episodes, main
from quad_swarm.evaluation.recordings import read
from quad_swarm.task.rules import RULES
from quad_swarm.world.presets import make_config

MODEL = "pretrained:quad-swarm-flight"


def test_episodes_are_those_of_evaluate():
    config = make_config("flight", n_robots=3)
    seeds = [first_episode(2) + k for k in range(2)]
    _, task, _ = begin(Condition("none", "asymmetric_swap", config), seeds)
    for k, (scene, _) in enumerate(episodes(config, "asymmetric_swap", seeds)):
        np.testing.assert_array_equal(task.swarm.pos[k], scene.starts)
        np.testing.assert_array_equal(task.swarm.goal[k], scene.goals)


def test_flights_among_obstacles(tmp_path, capsys):
    words = ["--policy", "full", "--n-robots", "3", "--link", "virtual", "--scenario", "crossing_traffic"]
    words += ["--most", "5", "--record", str(tmp_path / "flight.npz"), "--json", str(tmp_path / "rows.json")]
    assert main(words) == 0
    assert "touched" not in capsys.readouterr().err
    (row,) = json.loads((tmp_path / "rows.json").read_text())
    assert (row["collided"], row["struck"], row["arrived"]) == (0, 0, 1)
    recording = read(tmp_path / "flight.npz")
    assert recording.obstacles
    assert all(one.moves for one in recording.obstacles)
    distance = recording.flight().min_obstacle_distance
    assert 0 < distance.min() < 1


def test_recordings_are_not_overwritten(tmp_path):
    (tmp_path / "flight_2.csv").write_text("mine")
    words = ["--policy", "none", "--n-robots", "2", "--link", "virtual", "--episodes", "2"]
    with pytest.raises(ValueError, match=r"flight_2\.csv is there already, and no flight is overwritten"):
        main([*words, "--record", str(tmp_path / "flight.csv"), "--debug"])
    assert [one.read_text() for one in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("scenario", ["tour", "moving_goals"])
def test_goals_that_change_are_not_flown_in_real_time(scenario):
    with pytest.raises(ValueError, match=f"scenario='{scenario}': its goals change in flight"):
        next(episodes(make_config("flight", n_robots=2), scenario, [0]))


def test_flights_in_virtual_time(tmp_path, capsys):
    words = ["--policy", "none", "full", "--n-robots", "3", "--link", "virtual", "--loss", "0.1", "--episodes", "2"]
    words += ["--most", "5", "--record", str(tmp_path / "flight.npz")]
    assert main([*words, "--json", str(tmp_path / "rows.json")]) == 0
    shown = capsys.readouterr()
    none, full = json.loads((tmp_path / "rows.json").read_text())
    assert shown.out.splitlines()[0].split()[:3] == ["policy", "collided", "95"]
    assert len(shown.err.splitlines()) == 4
    assert "flight 2: " in shown.err
    assert (none["policy"], none["flights"], none["plans_sent"], none["plan_age_ms"]) == ("none", 2, 0, [None, None])
    assert none["bytes_per_second"] == 0
    assert full["collided"] == 0
    assert full["plan_share"] == pytest.approx(0.9, abs=0.03), "requests that are lost are not answered"
    assert 15 < full["plan_age_ms"][0] < 60
    assert full["counts"]["requests"] == full["periods"] * 2
    assert full["bytes_per_second"] > 1000
    assert full["cpu"] is None, "one process flies all robots"
    assert (full["loss"], full["acts_after"]) == (0.1, 0.25)
    names = sorted(path.name for path in tmp_path.glob("*.npz"))
    assert names == [f"flight_{k}.npz" for k in range(1, 5)]
    none, full = (read(tmp_path / f"flight_{k}.npz") for k in (1, 3))
    assert (none.policy, full.policy) == ("none", "full")
    assert not none.asked.any()
    assert full.asked.sum() == pytest.approx(full.asked[..., 0].size * 2, rel=0.05)
    assert full.config().n_robots == 3
    assert np.isfinite(full.setpoint).all()
    assert full.separation().min() > 0.5
    assert np.abs(full.plan[20, :, 0] - full.state[20, :, :3]).max() < 0.2, "plans begin where robots are"


@pytest.mark.slow
def test_a_learned_policy_flies_over_udp(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    from sb3_maddpg.hub.pretrained import pretrained_folder

    model = str(pretrained_folder("quad-swarm-flight") / "model.zip")
    assert main(["--policy", model, "--n-robots", "3", "--json", str(tmp_path / "rows.json")]) == 0
    (row,) = json.loads((tmp_path / "rows.json").read_text())
    assert (row["flights"], row["preset"], row["link"]) == (1, "flight", "udp")
    assert row["periods"] > 100
    assert not [name for name in row["counts"] if name.startswith("errors")]


MODULE = """
import numpy as np
from quad_swarm.task.rules import RULES

def nearest():
    def rule(view):
        distance = np.linalg.norm(view.pos, axis=-1)
        return distance == distance.min(axis=-1, keepdims=True)
    return rule

RULES["nearest_one"] = (nearest, ())
"""


@pytest.mark.slow
@pytest.mark.parametrize("link", ["udp", "ros2"])
def test_a_rule_from_the_current_folder_flies_in_the_robots_processes(tmp_path, link):
    if link == "ros2":
        pytest.importorskip("rclpy")
    (tmp_path / "my_rules.py").write_text(MODULE)
    fly = [*alone(), sys.executable, "-m", "sb3_maddpg", "fly", "--gym-packages", "my_rules", "--json", "rows.json"]
    words = ["--policy", "nearest_one", "--n-robots", "3", "--most", "3", "--link", link]
    done = subprocess.run([*fly, *words], cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "rows.json").read_text())
    assert row["counts"]["requests"] == pytest.approx(row["periods"], rel=0.05), "each robot asks one of two"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--policy", "sometimes"], "sometimes"),
        (["--policy", "robotz"], "There is no folder of that name either"),
        (["--policy", "cpa:0.7:1.5&push:0.1"], "joins"),
        (["--policy", "none", "--world", "separation=0.7"], "did you mean planner.separation?"),
        (["--policy", "none", "--loss", "2"], "loss=2.0"),
        (["--policy", "none", "--episodes", "0"], "--episodes 0"),
        (["--policy", "none", "--most", "0"], "--most 0: it must be a number of seconds above 0"),
        (["--policy", "none", "--world", "radio.loss=0.5"], "radio.loss=0.5: here messages are sent"),
        (["--policy", "none", "--preset", "flight-v2", "--world", "radio.round_trip=3"], "radio.round_trip=3: here"),
        (["--policy", "none", "--wait", "0.06"], "wait=0.06"),
        (["--policy", "none", "--priority", "100"], "--priority 100"),
        (["--policy", "none", "--plant", "gazebo"], "gazebo"),
        (["--policy", "none", "--world", "substeps=7"], "whole microseconds"),
        (["--policy", "none", "--limits", "fence=0.3"], "give room=[[xlow"),
        (["--policy", "none", "--limits", "room=[[-5,-5,0],[5,5,3]]"], "limits.room: "),
    ],
)
def test_wrong_words_are_one_line(words, told, capsys):
    assert main([*words, "--n-robots", "2", "--link", "virtual"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert told in error
    assert len(error.splitlines()) == 1


def test_a_rule_that_fails_ends_the_command_before_the_first_flight(monkeypatch, capsys):
    monkeypatch.setitem(RULES, "broken", (lambda: lambda view: view.position, ()))
    assert main(["--policy", "none", "broken", "--n-robots", "2", "--link", "virtual"]) == 1
    printed = capsys.readouterr()
    assert "Rule 'broken' failed in test_real_time.py, line " in printed.err
    assert "has no attribute 'position'" in printed.err
    assert "flight 1" not in printed.err


@pytest.mark.slow
def test_folders_of_exported_robots_are_flown_by_their_path(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    from quad_swarm.evaluation.export import export
    from sb3_maddpg.hub.pretrained import pretrained_folder

    folder = tmp_path / "robots"
    export(str(pretrained_folder("quad-swarm-flight") / "model.zip"), make_config("flight", n_robots=2), folder)
    words = ["--policy", str(folder), "--link", "virtual", "--most", "1"]
    assert main([*words, "--json", str(tmp_path / "rows.json")]) == 0, "in the world of the folder"
    assert "robots" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "rows.json").read_text())
    assert (row["n_robots"], row["preset"]) == (2, "exported")
    assert main([*words, "--n-robots", "3"]) == 1
    assert "was exported for another world: for n_robots=2, and this one has 3" in capsys.readouterr().err
    assert main([*words, "--world", "radius=0.2"]) == 1
    assert "fly it as it was exported, with --world radius=0.3, or write" in capsys.readouterr().err
    other = tmp_path / "others"
    export(str(pretrained_folder("quad-swarm-flight") / "model.zip"), make_config("flight", n_robots=3), other)
    assert main([*words, "--policy", str(folder), str(other)]) == 1
    assert "were exported for different worlds" in capsys.readouterr().err
