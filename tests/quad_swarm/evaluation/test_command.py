"""``sb3-maddpg evaluate``: its table, its files, its messages."""

import json
from pathlib import Path

import pytest

from quad_swarm.evaluation.command import main
from quad_swarm.task.rules import RULES
from sb3_maddpg.pretrained_models import pretrained_folder

KEYS = {
    "policy", "scenario", "preset", "episodes", "collisions", "collision_low", "collision_high",
    "collisions_continuous", "requests_per_step", "request_share", "reduction", "arrived", "steps_to_arrival",
    "min_separation", "min_separation_continuous", "path_length", "planner_failures", "solver", "solve_us",
}  # fmt: skip


def test_writes_table_json_and_figures(tmp_path, capsys):
    target = tmp_path / "new" / "table.json"
    arguments = ["--policy", "none", "full", "--scenario", "random", "random_swap", "--episodes", "2"]
    assert main([*arguments, "--json", str(target), "--plot", str(tmp_path / "plots")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("random_swap") == 2
    rows = [json.loads(line) for line in target.read_text().splitlines()]
    assert [(row["scenario"], row["policy"]) for row in rows] == [
        ("random", "none"), ("random", "full"), ("random_swap", "none"), ("random_swap", "full")
    ]  # fmt: skip
    for row in rows:
        assert row.keys() >= KEYS
        assert (row["request_share"], row["reduction"]) == ((1.0, 0.0) if row["policy"] == "full" else (0.0, 1.0))
        assert row["requests_per_step"] == 12 * row["request_share"]
        assert row["arrived"] <= row["episodes"] == 2
    assert list(target.parent.iterdir()) == [target]
    figures = [f"{name}.{kind}" for name in ("collisions", "requests", "front", "flights") for kind in ("png", "pdf")]
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {*figures, "swarm.gif"}


def test_the_table_names_models_shortly_where_that_tells_them_apart(capsys, tmp_path):
    path = str(pretrained_folder("quad-swarm-paper") / "model.zip")
    flags = ["--scenario", "random", "--episodes", "1"]
    assert main(["--policy", path, f"{path}@0.7", *flags]) == 0
    names = [line.split()[1] for line in capsys.readouterr().out.splitlines() if "quad-swarm-paper" in line]
    assert names == ["quad-swarm-paper", "quad-swarm-paper@0.7"]
    copies = [tmp_path / folder / "swarm.zip" for folder in ("first", "second")]
    for copy in copies:
        copy.parent.mkdir()
        copy.write_bytes(Path(path).read_bytes())
    assert main(["--policy", *map(str, copies), *flags]) == 0
    printed = capsys.readouterr().out
    assert all(str(copy) in printed for copy in copies)


def test_world_can_be_changed(capsys):
    arguments = ["--policy", "full", "--scenario", "random", "--episodes", "1", "--n-robots", "3", "--max-steps", "5"]
    assert main([*arguments, "--world", "noise.wind=1", "planner.separation=0.7", "memory=0.3"]) == 0
    assert "6.00" in capsys.readouterr().out  # requests a step of three robots


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "nonne"], "Did you mean 'none'"),
        (["--policy", "nowhere/model.zip"], "No model at 'nowhere/model.zip'"),
        (["--policy", "none", "--scenario", "asymmetric"], "Did you mean 'asymmetric_swap'"),
        (["--policy", "none", "--preset", "papper"], "Did you mean 'paper'"),
        (["--policy", "none", "--n-robots", "99"], "do not fit"),
        (["--policy", "none", "--episodes", "0"], "episodes=0"),
        (["--policy", "none", "--seed", "-1"], "seed=-1: sets of held-out episodes are counted from 0"),
        (["--policy", "none", "--solver", "fatrob"], "Did you mean 'fatrop'"),
        (["--policy", "none", "--world", "separation"], "write NAME=VALUE"),
        (["--policy", "none", "--world", "planner.seperation=1"], "Did you mean 'separation'"),
        (["--policy", "none", "--world", "memory={"], "'{' is no valid YAML"),
        (["--policy", "none", "--world", "preset=dense"], "Unknown SwarmConfig parameter 'preset'"),
        (["--policy", "none", "--world", "noise=1", "noise.wind=2"], "was given a plain value before"),
        (["--policy", "none", "--world", "noise.wind=1", "noise.wind=2"], "is given twice"),
        (["--policy", "none", "--scenario", "all", "random"], "'all' already names every scenario"),
        (["--policy", "pretrained:quad-swarm-paper"], "`sb3-maddpg evaluate` knows"),
        (["--policy", "none", "--json", "."], "--json . is a folder"),
        (["--policy", "none", "--json", "/proc/nowhere/table.json"], "choose another folder"),
    ],
)
def test_errors_are_one_line_with_the_remedy(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_damaged_model_is_named(tmp_path, capsys):
    broken = tmp_path / "model.zip"
    broken.write_bytes(b"PK\x03\x04 and no more")
    assert main(["--policy", str(broken), "--scenario", "random", "--episodes", "1"]) == 2
    error = capsys.readouterr().err
    assert str(broken) in error
    assert "Is the file complete" in error
    assert main(["--policy", str(broken), "--algo", "quad_swarm:Nothing"]) == 2
    assert "no importable module:Class" in capsys.readouterr().err


def test_a_scenario_named_twice_is_flown_once(capsys):
    """Counted twice, the same episodes would pass for independent ones and narrow the interval."""
    flags = ["--policy", "none", "none", "--episodes", "3", "--max-steps", "5"]
    assert main([*flags, "--scenario", "random", "random"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("random")]
    assert len(lines) == 1
    assert "/3" in lines[0]


def test_models_fly_in_the_world_that_they_were_trained_in(capsys):
    dense = str(pretrained_folder("quad-swarm-dense") / "model.zip")
    flags = ["--scenario", "random", "--episodes", "1", "--max-steps", "2"]
    assert main(["--policy", "full", dense, *flags]) == 0
    printed = capsys.readouterr()
    assert "56.00" in printed.out  # requests a step of eight robots
    assert not printed.err
    assert main(["--policy", dense, *flags, "--preset", "paper"]) == 0
    assert "note: quad-swarm-dense was trained in 'dense', this is 'paper'" in capsys.readouterr().err
    paper = str(pretrained_folder("quad-swarm-paper") / "model.zip")
    assert main(["--policy", dense, paper, *flags]) == 2
    assert "choose one of these by --preset" in capsys.readouterr().err


def test_the_help_names_every_rule_and_the_command(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "usage: sb3-maddpg evaluate" in printed
    assert all(name in printed for name in (*RULES, "cpa:DIST:LOOKAHEAD", "pretrained:NAME", "--gym-packages"))
