"""``sb3-maddpg evaluate``: its table, its files, its messages."""

import csv
import hashlib
import json
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from quad_swarm.evaluation import export
from quad_swarm.evaluation.command import COLUMNS, main
from quad_swarm.plants import remote
from quad_swarm.plants.base import simulated_vehicles
from quad_swarm.quadrotor import VEHICLE_PARAMETERS
from quad_swarm.task.rules import RULES
from quad_swarm.world.presets import PRESETS, make_config
from quad_swarm.world.scenarios import SCENARIOS, without_obstacles
from quad_swarm.world.swarm import Swarm
from sb3_maddpg.hub.pretrained import pretrained_folder

# Columns of worlds without obstacles
USUAL = [column for column in COLUMNS if column.needs is None]

KEYS = {
    "policy", "scenario", "preset", "episodes", "collisions", "collision_low", "collision_high",
    "collisions_continuous", "requests_per_step", "request_share", "reduction", "arrived", "steps_to_arrival",
    "min_separation", "min_separation_continuous", "path_length", "planner_failures", "solver", "solve_us",
}  # fmt: skip


@pytest.mark.slow
def test_writes_table_json_and_figures(tmp_path, capsys):
    target = tmp_path / "new" / "table.json"
    arguments = ["--policy", "none", "full", "--scenario", "random", "random_swap", "--episodes", "2"]
    assert main([*arguments, "--json", str(target), "--plot", str(tmp_path / "plots")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("random_swap") == 2
    rows = json.loads(target.read_text())
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


def test_values_of_repeated_options_come_together(capsys):
    arguments = ["--policy", "none", "--policy", "full", "--scenario", "random", "--scenario", "random_swap"]
    assert main([*arguments, "--episodes", "1", "--world", "radius=0.2", "--world", "goal_radius=0.4"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in printed[2:6]] == [
        ["random", "none"], ["random", "full"], ["random_swap", "none"], ["random_swap", "full"]
    ]  # fmt: skip
    assert "preset: paper with radius=0.2 goal_radius=0.4;" in printed[7]
    assert main([*arguments, "--world", "radius=0.2", "--world", "radius=0.1"]) == 1
    assert "'radius' is given twice" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="there is no device that is always full")
def test_the_table_is_printed_even_if_a_file_cannot_be_written(tmp_path, capsys):
    (tmp_path / "full.json").symlink_to("/dev/full")
    arguments = ["--policy", "none", "--scenario", "random", "--episodes", "1"]
    with pytest.raises(OSError, match="No space left"):
        main([*arguments, "--json", str(tmp_path / "full.json")])
    assert "episodes: 1 each" in capsys.readouterr().out
    assert (tmp_path / "full.json").is_symlink()


@pytest.mark.slow
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
    assert "first/swarm.zip" in printed
    assert "second/swarm.zip" in printed


def test_a_table_fits_one_hundred_columns_unless_all_are_asked_for(capsys):
    rules = ["cpa:0.8:1.5&stale:3|distance:1&event:0.25", "cpa:0.8:1.5&stale:3|distance:2&event:0.25"]
    flags = ["--preset", "dense", "--scenario", "asymmetric_swap", "--episodes", "1", "--policy", "none", *rules]
    assert main(flags) == 0
    table = capsys.readouterr().out.partition("\n\n")[0]
    lines = table.splitlines()
    assert 90 < max(map(len, lines)) <= 100
    start, length = lines[0].index("policy"), len(lines[1].split()[1])
    names = [line[start : start + length].rstrip() for line in lines[2:]]
    assert "".join(names) == "none" + "".join(rules), "what does not fit goes on in the next line"
    assert {name[-1] for name in names} <= {"e", "&", "|", "5"}, "a line ends behind an operator"
    assert main([*flags, "--wide"]) == 0
    printed = capsys.readouterr().out
    titles = printed.splitlines()[0]
    assert [column.title for column in USUAL] == [title.strip() for title in titles.split("  ") if title]
    assert all(rule in printed for rule in rules)


def test_contact_between_steps_has_a_column_where_it_differs(capsys):
    flags = ["--policy", "none", "--scenario", "symmetric_swap", "--episodes", "3"]
    for preset, shown in (("paper", True), ("flight", False)):
        assert main([*flags, "--preset", preset]) == 0
        titles = capsys.readouterr().out.splitlines()[0]
        assert ("any time" in titles) is shown
        assert "  min. (m)" in titles


def test_a_world_is_refused_in_which_robots_would_brake_into_a_wall(capsys, tmp_path):
    world = ["--preset", "flight-v2", "--n-robots", "2", "--world", "planner.max_speed=1"]
    flags = [*world, "--policy", "none", "--scenario", "random", "--episodes", "1", "--max-steps", "2"]
    walls = "room=[[-5.5,-5.5,0],[5.5,5.5,4]]"
    assert main([*flags, "--limits", walls, "fence=0.05"]) == 1
    assert "give planner.workspace_low=[" in capsys.readouterr().err
    assert main([*flags, "--limits", "fence=0.3"]) == 1
    assert "give room=[[xlow" in capsys.readouterr().err
    assert main([*flags, "--limits", walls.replace("5.5", "7"), "fence=0.3"]) == 0
    assert "room: walls 2.20 m from the workspace" in capsys.readouterr().err
    out = str(tmp_path / "robots")
    model = str(pretrained_folder("quad-swarm-flight-v2") / "model.zip")
    given = [model, *world, "--out", out, "--limits", walls, "fence=0.05"]
    with pytest.raises(ValueError, match=r"limits\.room: 0\.7 m between"):
        export.main(given)
    assert not Path(out).exists()


def test_worlds_with_obstacles_have_columns_of_their_own(capsys):
    flags = [
        "--preset",
        "flight",
        "--n-robots",
        "4",
        "--policy",
        "none",
        "--episodes",
        "1",
        "--max-steps",
        "20",
        "--wide",
    ]
    assert main([*flags, "--scenario", "forest", "random"]) == 0
    titles, _, forest, plain = capsys.readouterr().out.partition("\n\n")[0].splitlines()
    assert "  obstacles  " in titles
    assert "  obstacle (m)  " in titles
    begin = titles.index("obstacles")
    assert forest[begin : begin + len("obstacles")].strip() == "0.0%"
    assert plain[begin : begin + len("obstacles")].strip() == "-"


def test_the_table_goes_into_latex_and_csv(tmp_path, capsys):
    flags = ["--policy", "none", "full|none", "--scenario", "random_swap", "random", "--episodes", "2"]
    assert main([*flags, "--latex", str(tmp_path / "a.tex"), "--csv", str(tmp_path / "a.csv"), "--wide"]) == 0
    printed = capsys.readouterr().out
    tex = (tmp_path / "a.tex").read_text().splitlines()
    comments, tex = tex[:2], tex[2:]
    assert [line.removeprefix("% ") for line in comments] == printed.split("\n\n")[1].splitlines()[:2]
    assert tex[:2] == [f"\\begin{{tabular}}{{ll{'r' * (len(USUAL) - 2)}}}", r"\toprule"]
    assert "$>$ 1 cm" in tex[2]
    assert tex[-2:] == [r"\bottomrule", r"\end{tabular}"]
    cells = [line.removesuffix(r" \\").split(" & ") for line in tex if line.endswith(r"\\")]
    assert {len(line) for line in cells} == {len(USUAL)}
    assert cells[2][:2] == [r"random\_swap", r"\texttt{full$|$none}"]
    assert cells[2][9] == r"100.00\%"
    assert tex.count(r"\addlinespace") == 1
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["scenario"], row["policy"], float(row["request_share"])) for row in rows] == [
        ("random_swap", "none", 0), ("random_swap", "full|none", 1), ("random", "none", 0), ("random", "full|none", 1)
    ]  # fmt: skip
    assert all(f"wrote {tmp_path / name}" in printed for name in ("a.csv", "a.tex"))


@pytest.mark.slow
def test_without_policies_it_is_the_papers_table(capsys):
    assert main(["--episodes", "1", "--max-steps", "3"]) == 0
    lines = [line.split()[:2] for line in capsys.readouterr().out.splitlines()[2:18]]
    policies = ("none", "full", "distance:4", "quad-swarm-paper")
    assert lines == [[scenario, policy] for scenario in without_obstacles() for policy in policies]


def test_world_can_be_changed(capsys):
    arguments = ["--policy", "full", "--scenario", "random", "--episodes", "1", "--n-robots", "3", "--max-steps", "5"]
    assert main([*arguments, "--world", "noise.wind=1", "planner.separation=0.7", "memory=0.3"]) == 0
    assert "robots: 3; preset: paper with noise.wind=1 planner.separation=0.7 memory=0.3;" in capsys.readouterr().out


SHORT = ["--scenario", "random", "--episodes", "1", "--max-steps", "3"]
FEW = ["--policy", "none", *SHORT]


def table(path: Path, *arguments: str, policy: str = "none") -> dict:
    """Fly few steps and return the only row of the JSON file."""
    assert main([*SHORT, "--policy", policy, *arguments, "--json", str(path)]) == 0
    (row,) = json.loads(path.read_text())
    return row


def test_files_say_what_was_flown(tmp_path, capsys):
    row = table(tmp_path / "a.json")
    assert {name: row[name] for name in ("world", "plant", "preset", "n_robots", "max_steps", "seed", "solver")} == {
        "world": {}, "plant": "model", "preset": "paper", "n_robots": 4, "max_steps": 3, "seed": 0,
        "solver": Swarm(make_config("paper"), 1).planner.solver.name,
    }  # fmt: skip
    assert row["versions"]["sb3-maddpg"] == version("sb3-maddpg")
    assert f"plant: model; solver: {row['solver']}; at most 3 steps; sb3-maddpg" in capsys.readouterr().out
    changed = table(tmp_path / "a.json", "--world", "noise.wind=1", "planner.separation=0.7", "--solver", "fatrop")
    assert changed["world"] == {"noise": {"wind": 1.0}, "planner": {"separation": 0.7}}
    assert changed["solver"] == "fatrop"
    assert "solver: fatrop;" in capsys.readouterr().out
    # The content of a file, not its name, and what follows from another field
    vehicle = tmp_path / "vehicle.yml"
    seen = []
    for drag in (0.2, 0.3):
        content = {name: drag for name in VEHICLE_PARAMETERS}
        vehicle.write_text(yaml.safe_dump({"parameters": content}))
        seen.append(table(tmp_path / "a.json", "--world", f"quadrotor={vehicle}", "radius=0.31")["world"])
    assert [world["quadrotor"]["drag_x"] for world in seen] == [0.2, 0.3]
    assert seen[0]["planner"] == {"separation": pytest.approx(0.62)}


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["crazyflow", "rotorpy:hummingbird"])
def test_files_and_the_table_name_the_simulator(plant, tmp_path, capsys):
    pytest.importorskip("mujoco", reason="the extra `plants` is not installed")
    flags = ("--preset", "flight", "--csv", str(tmp_path / "a.csv"), "--latex", str(tmp_path / "a.tex"))
    row = table(tmp_path / "a.json", *flags, "--plant", plant)
    name = {"crazyflow": "crazyflow:cf21B_500"}.get(plant, plant)
    simulator = name.partition(":")[0]
    assert row["plant"] == name
    assert row["world"] == {"plant": name, "mismatch": 0.0}
    assert row["versions"][simulator] == version(simulator)
    footer = (
        f"plant: {name}; solver: {row['solver']}; at most 3 steps; sb3-maddpg {version('sb3-maddpg')}, {simulator} "
    )
    assert footer in capsys.readouterr().out
    assert footer in (tmp_path / "a.tex").read_text()
    with (tmp_path / "a.csv").open(newline="") as file:
        assert next(csv.DictReader(file))["plant"] == name
    by_world = table(tmp_path / "a.json", "--preset", "flight", "--world", f"plant={plant}")
    assert {**by_world, "solve_us": 0} == {**row, "solve_us": 0}, "either option flies and records the same"


def test_another_model_under_the_same_name_is_seen_in_the_file(tmp_path):
    copy = tmp_path / "model.zip"
    sums = []
    for name in ("quad-swarm-paper", "quad-swarm-dense"):
        model = pretrained_folder(name) / "model.zip"
        copy.write_bytes(model.read_bytes())
        sums.append(table(tmp_path / "a.json", policy=str(copy))["model_sha256"])
        assert sums[-1] == hashlib.sha256(model.read_bytes()).hexdigest()
    assert sums[0] != sums[1]


@pytest.mark.parametrize("option", ["--json", "--csv", "--latex"])
def test_a_dash_writes_a_file_to_the_standard_output_alone(option, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*FEW, option, "-"]) == 0
    printed = capsys.readouterr()
    assert "at most 3 steps" in printed.err
    assert not list(tmp_path.iterdir())
    if option == "--json":
        assert [row["policy"] for row in json.loads(printed.out)] == ["none"]
    elif option == "--csv":
        assert [row["policy"] for row in csv.DictReader(printed.out.splitlines())] == ["none"]
    else:
        assert printed.out.endswith("\\end{tabular}\n")
        assert "wrote" not in printed.out
    assert main([*FEW, option, "-", "--json" if option != "--json" else "--csv", "-"]) == 1
    assert "are both -: one would overwrite the other" in capsys.readouterr().err


@pytest.mark.parametrize("missing", ["matplotlib", "pygame", "PIL"])
def test_figures_without_their_packages_fail_before_the_flights(missing, tmp_path, monkeypatch, capsys):
    for name in [name for name in sys.modules if name.startswith(("quad_swarm.figures", missing))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr("quad_swarm.evaluation.command.fly_all", lambda *_, **__: pytest.fail("it flew"))
    assert main([*FEW, "--plot", str(tmp_path / "plots"), "--json", str(tmp_path / "a.json")]) == 1
    error = capsys.readouterr().err
    assert "--plot needs the extra 'plot': in the clone, pip install -e '.[plot]'" in error
    assert missing in error
    assert not (tmp_path / "a.json").exists()


def test_a_missing_simulator_is_told_before_the_flights(tmp_path, monkeypatch, capsys):
    (tmp_path / "crazyflow.py").write_text("raise ModuleNotFoundError('no crazyflow here')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(remote, "_servers", {})
    monkeypatch.setattr("quad_swarm.evaluation.command.fly_all", lambda *_, **__: pytest.fail("it flew"))
    assert main([*FEW, "--plant", "crazyflow"]) == 1
    error = capsys.readouterr().err
    assert "needs the extra 'plants': in the clone, pip install -e '.[plants]' (no crazyflow here)" in error
    assert error.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "nonne"], "Did you mean 'none'"),
        (["--policy", "nowhere/model.zip"], "No model at 'nowhere/model.zip'"),
        (["--policy", "none", "--scenario", "asymmetric"], "Did you mean 'asymmetric_swap'"),
        (["--policy", "none", "--preset", "papper"], "Did you mean 'paper'"),
        (["--policy", "none", "--n-robots", "99"], "do not fit"),
        (["--policy", "none", "--episodes", "0"], "episodes=0"),
        (["--policy", "none", "--seed", "-1"], "seed=-1: sets of held-out episodes count from 0"),
        (["--policy", "none", "--solver", "fatrob"], "Did you mean 'fatrop'"),
        (["--policy", "none", "--world", "separation"], "write NAME=VALUE"),
        (["--policy", "none", "--world", "planner.seperation=1"], "Did you mean 'separation'"),
        (["--policy", "none", "--world", "memory={"], "'{' is not valid YAML"),
        (["--policy", "none", "--world", "preset=dense"], "Unknown SwarmConfig parameter 'preset'"),
        (["--policy", "none", "--world", "noise=1", "noise.wind=2"], "already has a plain value"),
        (["--policy", "none", "--world", "noise.wind=1", "noise.wind=2"], "is given twice"),
        (["--policy", "none", "--scenario", "all", "random"], "'all' already names every scenario"),
        (["--policy", "pretrained:quad-swarm-paper"], "only `sb3-maddpg evaluate` also accepts"),
        (["--policy", "none", "--json", "."], "--json . is a folder"),
        (["--policy", "none", "--csv", "."], "--csv . is a folder"),
        (["--policy", "none", "--latex", "."], "--latex . is a folder"),
        (["--policy", "none", "--json", "/proc/nowhere/table.json"], "choose another folder"),
        (["--policy", "none", "--json", "a", "--csv", "./a"], "--json and --csv are both a: one would overwrite"),
        (["--policy", "none", "--latex", "a", "--plot", "a"], "--latex and --plot are both a: one would overwrite"),
        (["--policy", "none", "--plot", "-"], "figures need a folder"),
    ],
)
def test_errors_are_one_line_with_the_remedy(arguments, message, capsys):
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_nearest_model_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("maddpg_swarm.zip").touch()
    assert main(["--policy", "maddpg_swrm.zip@0.5"]) == 1
    assert "Did you mean 'maddpg_swarm.zip'?" in capsys.readouterr().err


def test_a_damaged_model_is_named(tmp_path, capsys):
    broken = tmp_path / "model.zip"
    broken.write_bytes(b"PK\x03\x04 and no more")
    assert main(["--policy", str(broken), "--scenario", "random", "--episodes", "1"]) == 1
    error = capsys.readouterr().err
    assert str(broken) in error
    assert "Is the file complete" in error
    assert main(["--policy", str(broken), "--algo", "quad_swarm:Nothing"]) == 1
    assert "not an importable module:Class" in capsys.readouterr().err


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
    assert "robots: 8; preset: dense;" in printed.out
    assert not printed.err
    assert main(["--policy", dense, *flags, "--preset", "paper"]) == 0
    assert "note: quad-swarm-dense was trained in 'dense', but this is 'paper'" in capsys.readouterr().err
    paper = str(pretrained_folder("quad-swarm-paper") / "model.zip")
    assert main(["--policy", dense, paper, *flags]) == 1
    assert "choose one of these with --preset" in capsys.readouterr().err


def test_the_help_names_every_rule_and_the_command(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    printed = " ".join(capsys.readouterr().out.split()).replace("- ", "-")  # names may be broken at hyphens
    assert "usage: sb3-maddpg evaluate" in printed
    known = (*RULES, *PRESETS, *SCENARIOS, *simulated_vehicles())
    assert all(name in printed for name in (*known, "cpa:DIST:LOOKAHEAD", "pretrained:NAME", "--gym-packages"))
