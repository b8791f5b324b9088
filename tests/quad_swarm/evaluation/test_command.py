"""The evaluation: its figures against an episode flown by hand, its independence of processes, its messages."""

import importlib
import json
import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from quad_swarm.evaluation.command import main
from quad_swarm.evaluation.evaluation import Cell, evaluate, first_episode, fly, run_episodes, wilson_interval
from quad_swarm.task.rules import RULES
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS
from sb3_maddpg.pretrained_models import pretrained_folder

KEYS = {
    "policy", "scenario", "preset", "episodes", "collisions", "collision_low", "collision_high",
    "collisions_continuous", "requests_per_step", "request_share", "reduction", "arrived", "steps_to_arrival",
    "min_separation", "min_separation_continuous", "path_length", "planner_failures", "solver", "solve_us",
}  # fmt: skip


def cell(policy: str, max_steps: int = 100) -> Cell:
    return Cell(policy, "asymmetric_swap", make_config("paper"), max_steps, "sb3_maddpg:MADDPG", "auto")


def test_counts_what_the_environment_shows():
    """The same episodes through Gymnasium, with the definitions of the figures written out again."""
    seeds = [first_episode(0) + k for k in range(3)]
    rows = run_episodes(cell("full"), seeds)
    for seed, row in zip(seeds, rows, strict=True):
        env = gymnasium.make("QuadSwarm-v0", scenario="asymmetric_swap").unwrapped
        env.reset(seed=seed)
        requests, path, closest, arrived_after = 0, 0.0, math.inf, None
        for step in range(1, 101):
            before = env.task.swarm.pos[0].copy()
            *_, terminated, _, info = env.step(np.ones(12, dtype=np.int8))
            closest = min(closest, info["min_separation"])
            if arrived_after is None:
                requests += 12
                path += np.linalg.norm(env.task.swarm.pos[0] - before, axis=1).mean()
                if info["at_goal"].all():
                    arrived_after = step
            if terminated:
                break
        assert row["requests"] == requests
        assert row["steps_counted"] == (arrived_after or step)
        assert row["arrived"] == (arrived_after is not None)
        assert row["path_length"] == pytest.approx(path)
        assert row["min_separation"] == closest


def test_result_does_not_depend_on_the_number_of_processes():
    cells = [cell("random:0.3", max_steps=25), cell("cpa:0.7:1.5", max_steps=25)]
    one, two = (evaluate(cells, episodes=30, seed=1, jobs=jobs) for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert a.pop("solve_us") > 0
        assert b.pop("solve_us") > 0
        assert a == b


def test_other_processes_know_what_a_module_of_the_user_added(tmp_path, monkeypatch):
    module = """
import numpy as np
from quad_swarm.task.rules import RULES
from quad_swarm.world.scenarios import SCENARIOS, random

def alone(n_robots, space, rng):
    starts, _ = random(n_robots, space, rng)
    return starts, starts + [0.2, 0, 0]

def nobody():
    return lambda view: np.zeros(view.age.shape, dtype=bool)

SCENARIOS["alone"], RULES["nobody"] = alone, (nobody, ())
"""
    (tmp_path / "my_swarm.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(SCENARIOS, "alone", None)  # so that both are taken out again
    monkeypatch.setitem(RULES, "nobody", None)
    importlib.import_module("my_swarm")
    mine = Cell("nobody", "alone", make_config("paper"), 100, "sb3_maddpg:MADDPG", "auto")
    (row,) = evaluate([mine], episodes=4, jobs=2)
    assert (row["requests"], row["arrived"]) == (0, 4)


def test_other_seeds_are_other_episodes():
    first, second = (fly(cell("none"), seed) for seed in (0, 1))
    assert not np.array_equal(first.goal, second.goal)
    assert first.requests.shape[1:] == (4, 3)
    assert len(first.state) == len(first.plans) == len(first.requests) + 1


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_interval_as_published(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


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
