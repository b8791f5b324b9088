"""The command ``sb3-maddpg``: what it hands on, and what it does itself."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import quad_swarm
import sb3_maddpg
from quad_swarm.evaluation import policies
from quad_swarm.task.rules import RULES
from quad_swarm.world.scenarios import SCENARIOS
from sb3_maddpg import MADDPG
from sb3_maddpg.cli.algorithms import ALGORITHMS
from sb3_maddpg.cli.main import COMMANDS, build_parser, main
from sb3_maddpg.cli.overview import packaged_recipes
from sb3_maddpg.files import registry
from sb3_maddpg.hub.pretrained import pretrained_folder, pretrained_models


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_helps_with_an_example(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert stopped.value.code == 0
    shown = capsys.readouterr().out
    assert f"usage: sb3-maddpg {name}" in shown
    assert f"  sb3-maddpg {name}" in shown.partition("examples:")[2]
    assert not any(word in COMMANDS[name].examples for word in ("Swarm", "swarm"))


def test_the_full_help_names_what_is_installed(capsys):
    for argv in ([], ["train"], ["tune"]):
        with pytest.raises(SystemExit):
            main([*argv, "--help-all"])
        shown = capsys.readouterr().out
        known = (*ALGORITHMS, *pretrained_models(), *packaged_recipes(), "QuadSwarm-v0")
        assert all(name in shown for name in known)
        assert not argv or "--resume" in shown
    for command in ("evaluate", "replay"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        shown = capsys.readouterr().out
        assert all(f"pretrained:{name}" in shown for name in pretrained_models())


def test_the_short_help_shows_the_frequent_options_and_the_full_one_all(capsys):
    shown = {}
    for command in ("train", "tune"):
        for option in ("--help", "--help-all"):
            with pytest.raises(SystemExit):
                main([command, option])
            shown[command, option] = capsys.readouterr().out
    assert len(shown["train", "--help"].splitlines()) < 50
    for rare, command in (("--save-freq", "train"), ("--pruner", "train"), ("--engine", "tune")):
        assert rare not in shown[command, "--help"]
        assert rare in shown[command, "--help-all"]
    assert "--pruner" in shown["tune", "--help"]
    options = {one for action in build_parser()[1]["train"]._actions for one in action.option_strings}
    assert all(option in shown["train", "--help-all"] for option in options)


def test_the_help_loads_neither_pytorch_nor_an_environment(tmp_path):
    code = "import sys; from sb3_maddpg.cli.main import main\ntry: main(sys.argv[1:])\nexcept SystemExit: pass\n"
    code += "print(sorted({'torch', 'gymnasium', 'stable_baselines3', 'casadi', 'quad_swarm'} & set(sys.modules)))"
    for argv in (["--help"], ["train", "--help"], ["--version"], ["train", "--nonsense"]):
        done = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, text=True, cwd=tmp_path)
        assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr


@pytest.mark.parametrize("columns", [80, 100, 200])
def test_help_fits_the_terminal(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main(["train", "--help-all"])
    options = capsys.readouterr().out.partition("examples:")[0]
    assert max(map(len, options.splitlines())) <= columns


def test_help_names_own_rules_and_scenarios(capsys):
    known = dict(RULES), dict(SCENARIOS)
    Path("own_rules.py").write_text(
        "from quad_swarm.task.rules import RULES, none\n"
        "from quad_swarm.world.scenarios import SCENARIOS\n"
        'RULES["mine"] = none, ()\nSCENARIOS["two_rows"] = SCENARIOS["random"]\n'
    )
    try:
        with pytest.raises(SystemExit):
            main(["evaluate", "--gym-packages", "own_rules", "--help"])
    finally:
        for registry, entries in zip((RULES, SCENARIOS), known, strict=True):
            registry.clear()
            registry.update(entries)
    shown = capsys.readouterr().out
    assert "mine" in shown
    assert "two_rows" in shown


@pytest.mark.parametrize(
    ("argv", "nearest"),
    [
        (["evalute"], "evaluate"),
        (["evaluate", "--polcy", "none"], "--policy"),
        (["train", "--env", "OwnBit-v0", "--tensorbord-log", "tb"], "--tensorboard-log"),
        (["tune", "--env", "OwnBit-v0", "--sampler", "tpee"], "tpe"),
    ],
)
def test_the_nearest_of_what_is_mistyped_is_named(argv, nearest, capsys):
    with contextlib.suppress(SystemExit):  # of a package's parser
        assert main(argv) == 2
    error = capsys.readouterr().err
    assert f"did you mean '{nearest}'?" in error
    assert f"sb3-maddpg {argv[0]}: error" in error or argv == ["evalute"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["evaluate", "--policy", "latst:logs"], "Did you mean 'latest'?"),
        (["train", "--env", "mpe/simple_spread_v3"], "Did you mean 'mpe2/simple_spread_v3'?"),
        (["train", "--env", "mpe/mine_v0"], "Did you mean 'mpe2'?"),
        (["train", "--env", "OwnBit-v0", "--conf-file", "my_recipe.yml"], "Did you mean 'my_recipes.yml'?"),
        (["train", "--env", "QuadSwarm-v0", "--conf-file", "quad_swarm_papr.yml"], "'quad_swarm_paper.yml'?"),
    ],
)
def test_the_nearest_file_or_module_is_named(argv, message, capsys):
    Path("my_recipes.yml").touch()
    assert main(argv) == (2 if "--env" in argv and "--conf-file" not in argv else 1)
    assert message in capsys.readouterr().err


def test_packaged_recipes_are_found_by_their_names(capsys):
    argv = ["train", "--env", "QuadSwarm-v0", "--conf-file", "quad_swarm_paper.yml", "--eval-freq", "-1", "-n", "100"]
    assert main([*argv, "-params", "n_envs:4"]) == 0
    assert str(packaged_recipes()["quad_swarm_paper.yml"]) in capsys.readouterr().out


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
    assert main(copy) == 1  # nothing is overwritten
    assert "models/quad-swarm-paper" in capsys.readouterr().err
    assert main(["pretrained", "quad-swarm-papr"]) == 2
    assert "did you mean 'quad-swarm-paper'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_pretrained_model_is_evaluated_and_replayed_by_its_name(capsys):
    flown = ["--policy", "pretrained:quad-swarm-paper@0.5"]
    argv = ["evaluate", *flown, "--scenario", "random", "--episodes", "2", "--json", "table.json"]
    assert main(argv) == 0
    (row,) = json.loads(Path("table.json").read_text())
    assert row["policy"].endswith("quad-swarm-paper/model.zip@0.5")
    assert main(["replay", *flown, "--out", "page.html"]) == 0
    assert "quad-swarm-paper@0.5" in Path("page.html").read_text()
    assert main(["replay", "--env", "CartPole-v1", *flown]) == 2
    assert "CartPole-v1" in capsys.readouterr().err


def test_ctrl_c_ends_any_command_with_one_line(monkeypatch, capsys):
    def interrupted(*_) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_maddpg.cli.bench.bench", interrupted)
    assert main(["bench"]) == 130
    assert capsys.readouterr().err == "Interrupted.\n"
    with pytest.raises(KeyboardInterrupt):
        main(["bench", "--debug"])


def test_debug_reaches_the_commands_of_packages(capsys):
    for argv in (["evaluate", "--policy", "nope.zip", "--debug"], ["evaluate", "--debug", "--policy", "nope.zip"]):
        with pytest.raises((ValueError, OSError), match="nope"):
            main(argv)
        assert main([word for word in argv if word != "--debug"]) == 1
        assert capsys.readouterr().err.count("\n") == 1


def test_the_version_is_told(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"sb3-maddpg {sb3_maddpg.__version__}\n"
    assert quad_swarm.__version__ == sb3_maddpg.__version__


@pytest.mark.parametrize(
    ("group", "argv"),
    [
        ("environments", ["train", "--env", "OwnBit-v0"]),
        ("environments", ["--help-all"]),
        ("models", ["pretrained"]),
        ("evaluators", ["evaluate", "--env", "Broken-v0"]),
        ("replays", ["replay", "--env", "Broken-v0", "--help"]),
        ("allowed_in_files", ["evaluate", "--policy", "pretrained:quad-swarm-flight", "--episodes", "1"]),
    ],
)
@pytest.mark.parametrize("code", ["import no_such_module", "raise RuntimeError('a\\nb')", "raise SystemExit(3)"])
def test_a_package_that_cannot_be_loaded_is_named(group, argv, code, tmp_path, monkeypatch, capsys):
    (tmp_path / "broken_package.py").write_text(code)
    info = tmp_path / "their_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Name: their-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[sb3_maddpg.{group}]\nBroken-v0 = broken_package:thing\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path / "elsewhere")
    registry._load_entry_points.cache_clear()
    policies._load.cache_clear()  # another test may have loaded this model, and files are not read again then
    try:
        assert main(argv) == 1
    finally:
        registry._load_entry_points.cache_clear()
    (told,) = capsys.readouterr().err.strip().splitlines()
    assert f"their-package is installed, but its entry point sb3_maddpg.{group}: Broken-v0" in told


def test_quiet_commands_print_results_and_errors_only(capsys):
    train = ["train", "--env", "OwnBit-v0", "-n", "600", "--eval-freq", "200", "--quiet"]
    assert main([*train, "--progress"]) == 0
    assert capsys.readouterr().out == ""
    assert list(Path("logs").rglob("OwnBit-v0.zip"))
    assert main([*train, "-params", "estimater:1"]) == 2
    assert "did you mean 'estimator'" in capsys.readouterr().err
    assert main(["pretrained", "--quiet"]) == 0
    assert "quad-swarm-paper" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("sb3-maddpg tr", {"train "}),
        ("sb3-maddpg train --tens", {"--tensorboard-log "}),
        ("sb3-maddpg train --vec-env ", {"dummy", "subproc"}),
        ("sb3-maddpg convert --lean ", {"actor", "critic"}),
    ],
)
def test_words_are_completed(line, expected, tmp_path):
    """As the shell functions of argcomplete ask for it."""
    pytest.importorskip("argcomplete")
    env = {**os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    env |= {"_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words")}
    done = subprocess.run([sys.executable, "-m", "sb3_maddpg"], env=env, capture_output=True, text=True)
    assert expected <= set((tmp_path / "words").read_text().split("\n")), done.stderr
