"""The command ``sb3-maddpg``: what it hands on, and what it does itself."""

import ast
import json
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from sb3_maddpg import MADDPG
from sb3_maddpg.cli import commands
from sb3_maddpg.cli.commands import COMMANDS, examples, main
from sb3_maddpg.pretrained_models import pretrained_folder


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_helps_with_an_example(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert stopped.value.code == 0
    shown = capsys.readouterr().out
    assert "usage:" in shown
    assert examples(name).splitlines()[0].strip() in shown
    assert not any(word in COMMANDS[name].examples for word in ("Swarm", "swarm"))


def test_pretrained_models_are_listed_shown_and_copied(capsys):
    assert main(["pretrained"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert "quad-swarm-paper" in listed
    assert main(["pretrained"]) == 0
    assert "  Four robots of the preset paper that learned whom to ask\n" in capsys.readouterr().out
    assert main(["pretrained", "quad-swarm-paper"]) == 0
    assert (pretrained_folder("quad-swarm-paper") / "README.md").read_text() in capsys.readouterr().out
    copy = ["pretrained", "quad-swarm-paper", "--out", "models"]
    assert main(copy) == 0
    assert MADDPG.load("models/quad-swarm-paper/model.zip").env_spec["id"] == "QuadSwarm-v0"
    assert main(copy) == 2  # nothing is overwritten
    assert "models/quad-swarm-paper" in capsys.readouterr().err
    assert main(["pretrained", "quad-swarm-papr"]) == 2
    assert "did you mean 'quad-swarm-paper'" in capsys.readouterr().err


def test_a_pretrained_model_is_evaluated_and_replayed_by_its_name(capsys):
    flown = ["--policy", "pretrained:quad-swarm-paper@0.5"]
    argv = ["evaluate", *flown, "--scenario", "random", "--episodes", "2", "--json", "table.json"]
    assert main(argv) == 0
    (row,) = map(json.loads, Path("table.json").read_text().splitlines())
    assert row["policy"].endswith("quad-swarm-paper/model.zip@0.5")
    assert main(["replay", *flown, "--out", "page.html"]) == 0
    assert "quad-swarm-paper@0.5" in Path("page.html").read_text()
    assert main(["replay", "--env", "CartPole-v1", *flown]) == 2
    assert "CartPole-v1" in capsys.readouterr().err


def test_bench_says_where_the_time_goes(capsys):
    assert main(["bench", "--env", "OwnBit-v0", "-n", "700", "--json", "bench.json"]) == 0
    result = json.loads(Path("bench.json").read_text())
    assert result["steps"] == 700
    assert result["updates"] > 0
    shares = [result[f"share_{name}"] for name in ("environments", "learning", "acting", "rest")]
    assert all(share > 0 for share in shares)
    assert sum(shares) == pytest.approx(1)
    assert "steps/s" in capsys.readouterr().out
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["-n", "0"], "--n-timesteps=0: give 1 or more"),
        (["--json", "folder"], "folder: Is a directory"),
        (["--json", "file/bench.json"], "file"),
    ],
)
def test_bench_finds_out_before_the_work_that_it_cannot_be_done(capsys, argv, message):
    Path("folder").mkdir()
    Path("file").touch()
    assert main(["bench", "--env", "OwnBit-v0", *argv]) == 2
    shown = capsys.readouterr()
    assert f"error: {message}" in shown.err
    assert shown.err.count("\n") == 1
    assert "hyperparameters" not in shown.out


def test_modules_of_the_command_line_import_each_other_in_one_direction():
    imported = {}
    for path in Path(commands.__file__).parent.glob("*.py"):
        nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        names = {f"{node.module}.{alias.name}" for node in nodes for alias in node.names}
        imported[path.stem] = {name.split(".")[2] for name in names if name.startswith("sb3_maddpg.cli.")}
    order = list(TopologicalSorter(imported).static_order())
    assert order.index("options") < order.index("experiment") < order.index("zoo") < order.index("commands")
