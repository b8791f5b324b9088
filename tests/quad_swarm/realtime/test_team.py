"""The file that the processes of a team's robots read."""

import dataclasses
import json

import pytest

from quad_swarm.realtime import Conditions, SafetyLimits
from quad_swarm.realtime.team import Team, load
from quad_swarm.robot import RulePolicy, files
from quad_swarm.world.presets import make_config

CONFIG = make_config("flight", n_robots=3)


def test_what_is_written_is_read(tmp_path):
    team = Team(
        CONFIG, "cpa:1.0s:3", SafetyLimits(fence=2.0, separation=0.4), 0.004, 0.3, 7, True, ("239.255.77.77", 4000),
        Conditions(0.1, 0.2, 0.3, 0.4), 50, (0.0, 0.02, -0.02),
    )  # fmt: skip
    team.write(tmp_path / "team.json")
    assert load(tmp_path / "team.json") == team
    assert load(tmp_path / "team.json").conditions.loss == 0.1
    robot = team.robot(2)
    assert robot.index == 2
    assert isinstance(robot.policy, RulePolicy)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"policy": "sometimes"}, "sometimes"),
        ({"policy": "cpa:0.7:1.5&push:0.1"}, "joins"),
        ({"wait": "long"}, "wait"),
        ({"priority": 100}, "priority=100"),
        ({"clock_errors": [0.1]}, "clock_errors"),
        ({"limits": {"stale": 9.0}}, "hovers before it lands"),
        ({"limits": {"patience": 1.0}}, "patience"),
        ({"config": {"n_robots": 1}}, "n_robots"),
        ({"conditions": {"loss": 2}}, "loss"),
        ({"colour": "red"}, "a team has the fields"),
        ({"policy": None}, "policy"),
        ({"group": ["10.0.0.1", 4000]}, "multicast"),
        ({"session": 256}, "session"),
    ],
)
def test_what_is_no_team_is_refused(change, told, tmp_path):
    path = tmp_path / "team.json"
    Team(CONFIG, "full").write(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match="describes no team") as error:
        load(path)
    assert told in str(error.value)


@pytest.mark.parametrize("content", ["", "[]", "{}", "[" * 100_000])
def test_files_of_something_else_are_refused(content, tmp_path):
    (tmp_path / "team.json").write_text(content)
    with pytest.raises(ValueError, match="describes no team"):
        load(tmp_path / "team.json")


@pytest.mark.slow
def test_a_model_flies_in_the_world_that_it_was_exported_for(tmp_path):
    pytest.importorskip("onnxruntime")
    from quad_swarm.evaluation.export import export
    from sb3_maddpg.hub.pretrained import pretrained_folder

    export(str(pretrained_folder("quad-swarm-flight") / "model.zip"), CONFIG, tmp_path)
    team = Team(CONFIG, str(tmp_path))
    assert team.is_learned
    assert team.robot(1).policy.n_bits == 2
    Team(dataclasses.replace(CONFIG, plant="crazyflow:cf21B_500", mismatch=0.0), str(tmp_path))
    told = "another world: for goal_radius=0.3, and this one has 0.4; .*export ... --world goal_radius=0.4"
    with pytest.raises(ValueError, match=told):
        Team(dataclasses.replace(CONFIG, goal_radius=0.4), str(tmp_path))
    planner = dataclasses.replace(CONFIG.planner, max_speed=1.0)
    with pytest.raises(ValueError, match=r"for planner\.max_speed=4\.0, and this one has 1\.0"):
        Team(dataclasses.replace(CONFIG, planner=planner), str(tmp_path))
    with pytest.raises(ValueError, match=r"for n_robots=3, .*export \.\.\. --n-robots 7"):
        Team(dataclasses.replace(CONFIG, n_robots=7), str(tmp_path))
    with pytest.raises(ValueError, match="give the folder"):
        files.load(tmp_path / "robot.json")
