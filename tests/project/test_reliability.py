"""Short forms of the studies of kills, of damaged files, of wrong commands, of solvers that fail, of random worlds."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quad_swarm.evaluation.flight import run_episodes
from quad_swarm.evaluation.rows import read_rows
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm
from studies import command_lines, random_worlds, solver_faults
from studies.commit_points import POINTS
from studies.swarm.experiment import condition

ROOT = Path(__file__).parents[2]


def study(name: str, *words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", f"studies.{name}", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500)


@pytest.mark.slow
def test_five_kills_change_nothing(tmp_path):
    done = study("kills", "--no-faults", "--kills", "5", "--steps", "4800", "--json", str(tmp_path / "kills.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    *rows, end = read_rows(tmp_path / "kills.json")
    assert end["kills"] == 5
    assert end["found"] == end["expected"]
    assert {row["kill"] for row in rows} == {"at any time", *POINTS[:2]}
    assert all(row["kept_step"] >= row["from_step"] for row in rows)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_killed_workers_change_no_table(tmp_path):
    done = study("killed_workers", "--what", "evaluation", "--kills", "4", "--json", str(tmp_path / "workers.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = read_rows(tmp_path / "workers.json")
    assert (row["workers_killed"], row["commands_killed"]) == (3, 1)
    assert (row["same"], row["orphans"], row["pieces_left"]) == (True, 0, 0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_many_episodes_do_not_grow_the_process(tmp_path):
    done = study("soak", "--episodes", "3000", "--json", str(tmp_path / "soak.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = read_rows(tmp_path / "soak.json")
    assert row["episodes"] == 3006
    assert (row["files_grown"], row["threads_grown"]) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", ["1"])
def test_damaged_files_are_refused_or_harmless(tmp_path, seed):
    counts = ("--count", "250", "--used", "120")
    done = study("mutated_files", *counts, "--seed", seed, "--json", str(tmp_path / "files.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = read_rows(tmp_path / "files.json")
    assert sum(row["count"] for row in rows) == 370
    assert {row["outcome"] for row in rows} == {"refused", "loaded"}
    assert len({row["file"] for row in rows}) == 19


@pytest.mark.slow
def test_wrong_commands_are_refused_in_one_line_or_harmless(tmp_path):
    kinds = [one.__name__ for one in command_lines.KINDS]
    done = study("command_lines", "--count", "250", "--seed", "3", "--json", str(tmp_path / "commands.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = read_rows(tmp_path / "commands.json")
    assert sum(row["count"] for row in rows) == 250
    assert {row["outcome"] for row in rows} == {"accepted", "usage", "one line"}
    assert {row["kind"] for row in rows} == set(kinds)


def test_the_study_of_wrong_commands_hears_what_a_command_does(tmp_path):
    recorder = command_lines.Recorder(tmp_path / "here")
    with recorder.listening() as caught:
        (tmp_path / "elsewhere").write_text("")
        os.system("true")
    assert [one.split()[0] for one in caught] == ["open", "os.system"]


@pytest.mark.parametrize("kind", solver_faults.KINDS)
@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_solver_that_fails_neither_raises_nor_leaves_anything_that_is_not_finite(kind, share):
    rows = solver_faults.fly("asymmetric_swap", share, kind, range(6))
    assert len(rows) == 6
    assert sum(row["planner_failures"] for row in rows) > 0
    assert sum(row["collided"] for row in rows) <= (0 if share < 0.5 else 6)


def test_without_faults_it_is_the_evaluation():
    one = condition("full", "random", make_config("flight"))
    expected = run_episodes(one, range(3))
    for row, same in zip(solver_faults.fly("random", 0.0, "none", range(3)), expected, strict=True):
        assert {**row, "solve_seconds": 0} == {**same, "solve_seconds": 0}


WORLDS = [random_worlds.draw_world(0, number) for number in range(20)]


@pytest.mark.slow
def test_random_worlds_fly_or_are_refused_when_they_are_created():
    outcomes = [random_worlds.attempt(world, number, steps=6) for number, world in enumerate(WORLDS)]
    assert [told for outcome, told in outcomes if outcome == "wrong"] == []
    assert {"flown", "refused"} == {outcome for outcome, _ in outcomes}


def _reports(**changes):
    report = Swarm._report

    def wrong(self, *args):
        found = report(self, *args)
        return found._replace(**{name: change(getattr(found, name)) for name, change in changes.items()})

    return wrong


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"min_separation": lambda value: value + 1e-3}, "min_separation is"),
        ({"collision": lambda value: ~value}, "collision is"),
        ({"at_goal": lambda value: ~value}, "at_goal is wrong"),
        ({"min_separation": lambda value: value + np.nan}, "min_separation"),
        ({"belief_source": lambda value: value + (len(value) > 1)}, "otherwise alone than in a batch"),
    ],
)
def test_random_worlds_find_wrong_reports(changes, message, monkeypatch):
    monkeypatch.setattr(Swarm, "_report", _reports(**changes))
    outcome, told = random_worlds.attempt({"n_robots": 2, "preset": "paper"}, 0, steps=3)
    assert outcome == "wrong"
    assert message in " ".join(told)


def test_random_worlds_find_steps_and_resets_that_fail(monkeypatch):
    def fails(self, rng):
        raise ValueError("late")

    monkeypatch.setattr(ScenarioSampler, "draw", fails)
    outcome, told = random_worlds.attempt({"n_robots": 2, "preset": "paper"}, 0, steps=3)
    assert outcome == "wrong"
    assert "late" in told[0]
