"""The comparison of policies: its independence of processes, its figures, workers that die."""

import functools
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import foreign
import numpy as np
import pytest

from quad_swarm.evaluation import evaluation
from quad_swarm.evaluation.command import paper_policies
from quad_swarm.evaluation.evaluation import evaluate, fly_all, summarise
from quad_swarm.evaluation.flight import Condition, first_episode, run_episodes
from quad_swarm.jobs import Journal
from quad_swarm.native import BuildError
from quad_swarm.planner import SOLVERS, RtiSolver
from quad_swarm.plants import SIMULATORS, PlantError, Simulator
from quad_swarm.task.observation import GROUPS
from quad_swarm.task.rules import RULES, distance
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS, random


def condition(policy: str, max_steps: int = 25) -> Condition:
    return Condition(policy, "asymmetric_swap", make_config("paper"), max_steps)


@pytest.mark.slow
def test_result_does_not_depend_on_the_number_of_processes():
    conditions = [condition("random:0.3"), condition("cpa:0.7:1.5")]
    one, two = (evaluate(conditions, episodes=30, seed=1, jobs=jobs) for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert a.pop("solve_us") > 0
        assert b.pop("solve_us") > 0
        assert a == b


def test_other_processes_know_what_a_module_of_the_user_added(tmp_path, monkeypatch):
    module = """
import numpy as np
from quad_swarm.planner import SOLVERS
from quad_swarm.plants import SIMULATORS, PlantError, Simulator
from quad_swarm.task.observation import GROUPS
from quad_swarm.task.rules import RULES, distance
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
    mine = Condition("nobody", "alone", make_config("paper"))
    (row,) = evaluate([mine], episodes=4, jobs=2)
    assert (row["requests"], row["arrived"]) == (0, 4)


def test_a_condition_named_twice_is_flown_once():
    (row,) = evaluate([condition("none"), condition("none")], episodes=3)
    assert row["episodes"] == 3


def test_depths_of_collisions_are_counted_apart():
    config = make_config("paper")
    rows = run_episodes(Condition("none", "symmetric_swap", config), [first_episode(0)])
    separations = [0.61, 0.5985, 0.595, 0.589, 0.575, 0.55]
    collided = [s < 0.599 for s in separations]
    rows = [
        rows[0] | {"min_separation": s, "min_separation_continuous": s - 0.02, "collided": c}
        for s, c in zip(separations, collided, strict=True)
    ]
    figures = summarise(rows, config)
    assert (figures["collisions"], figures["collisions_1cm"], figures["collisions_3cm"]) == (5, 3, 1)
    assert (figures["collisions_continuous_1cm"], figures["collisions_continuous_3cm"]) == (5, 3)


def test_what_is_lost_against_full_communication():
    config = make_config("paper")
    conditions = [Condition(policy, "symmetric_swap", config) for policy in ("full", "cpa:0.7:1.5")]
    full, rule = evaluate(conditions, 5)
    assert (full["time_lost"], full["path_lost"]) == (0.0, 0.0)
    flown = fly_all(conditions, 5)
    both = [(a, b) for a, b in zip(*flown.values(), strict=True) if a["arrived"] and b["arrived"]]
    assert rule["time_lost"] == pytest.approx(0.1 * np.mean([b["steps_counted"] - a["steps_counted"] for a, b in both]))
    assert rule["path_lost"] == pytest.approx(np.mean([b["path_length"] - a["path_length"] for a, b in both]))
    assert "time_lost" not in evaluate(conditions[1:], 2)[0]


def killed_once(condition: Condition, episodes: range) -> list[dict[str, float]]:
    """As `run_episodes`, but the first process to fly the second piece dies."""
    marker = Path(os.environ["MARKER"])
    if episodes.start == first_episode(0) + 5 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return run_episodes(condition, episodes)


@pytest.mark.slow
def test_pieces_of_a_worker_that_died_are_flown_again(tmp_path, monkeypatch):
    monkeypatch.setenv("MARKER", str(tmp_path / "died"))
    monkeypatch.setattr(evaluation, "_CHUNK", 5)
    one = fly_all([condition("none")], 15)
    monkeypatch.setattr(evaluation, "_fly_piece", killed_once)
    two = fly_all([condition("none")], 15, jobs=2)
    assert (tmp_path / "died").exists()
    assert untimed(one) == untimed(two)


def untimed(flown: dict[Condition, list[dict[str, float]]]) -> list[dict[str, float]]:
    return [{**row, "solve_seconds": 0.0} for rows in flown.values() for row in rows]


class Killed(BaseException):
    pass


def test_finished_pieces_are_not_flown_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluation, "_CHUNK", 5)
    flown = []

    def dies_after_two(condition: Condition, episodes: range) -> list[dict[str, float]]:
        if len(flown) == 2:
            raise Killed
        flown.append(episodes)
        return run_episodes(condition, episodes)

    conditions = [condition("none"), condition("full")]
    monkeypatch.setattr(evaluation, "run_episodes", dies_after_two)
    with pytest.raises(Killed):
        fly_all(conditions, 15, journal=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    damaged = sorted(tmp_path.iterdir())[0]
    damaged.write_text(damaged.read_text()[:-20])

    again = []
    monkeypatch.setattr(evaluation, "run_episodes", lambda *piece: (again.append(piece), run_episodes(*piece))[1])
    rows = fly_all(conditions, 15, journal=tmp_path)
    assert len(again) == 5, "one was whole"
    assert "1 of 6 pieces were finished before" in capsys.readouterr().err
    assert untimed(rows) == untimed(fly_all(conditions, 15))
    assert not list(tmp_path.iterdir()), "nothing is kept of what is done"


def no_compiler(self) -> None:
    raise BuildError("no compiler for this test of keys")  # each message is issued once only


def as_rows(change):
    """A piece whose rows were changed, with a checksum that fits."""

    def damage(path: Path) -> None:
        key, rows = path.stem, json.loads(path.read_text())["value"]
        Journal(path.parent).keep(key, change(rows))

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_text(path.read_text().replace("true", "false")),
        lambda path: path.write_text(path.read_text().replace("[{", "[[{").replace("}]", "}]]")),
        as_rows(lambda rows: rows[:2]),
        as_rows(lambda rows: []),
        as_rows(lambda rows: {"rows": rows}),
        as_rows(lambda rows: [{**row, "requests": str(row["requests"])} for row in rows]),
        as_rows(lambda rows: [{**row, "path_length": float("nan")} for row in rows]),
        as_rows(lambda rows: [{name: one for name, one in row.items() if name != "collided"} for row in rows]),
        as_rows(lambda rows: [1, *rows[1:]]),
    ],
)
def test_damaged_pieces_are_flown_again(damage, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "_CHUNK", 3)
    flown = []

    def dies_after_one(condition: Condition, episodes: range) -> list[dict[str, float]]:
        if flown:
            raise Killed
        flown.append(episodes)
        return run_episodes(condition, episodes)

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "run_episodes", dies_after_one)
        with pytest.raises(Killed):
            fly_all([condition("none")], 6, journal=tmp_path)
    (piece,) = tmp_path.iterdir()
    damage(piece)
    assert untimed(fly_all([condition("none")], 6, journal=tmp_path)) == untimed(fly_all([condition("none")], 6))


def test_a_model_that_changes_under_way_makes_no_table(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "_CHUNK", 2)
    model = tmp_path / "model.zip"
    shutil.copy(paper_policies()[-1], model)

    def trained_on(condition: Condition, episodes: range) -> list[dict[str, float]]:
        model.write_bytes(model.read_bytes() + b"\0")
        return run_episodes(replace(condition, policy="none"), episodes)

    monkeypatch.setattr(evaluation, "run_episodes", trained_on)
    with pytest.raises(ValueError, match=r"another content of .*model\.zip than this command began with"):
        fly_all([condition(str(model))], 4)


def test_pieces_are_told_apart_by_all_that_they_depend_on(tmp_path, monkeypatch):
    episodes = range(3)
    model = tmp_path / "model.zip"
    model.write_bytes(b"a")
    one = condition("none")
    conditions = [one, replace(one, policy=str(model)), replace(one, max_steps=3), replace(one, linger=1)]
    keys = [evaluation._key(each, episodes) for each in conditions]
    keys.append(evaluation._key(one, range(4)))
    model.write_bytes(b"b")
    keys.append(evaluation._key(conditions[1], episodes))
    keys.append(evaluation._key(replace(one, solver="fatrop"), episodes))
    with monkeypatch.context() as without:  # "auto" then flies another solver
        without.setattr(RtiSolver, "compile", no_compiler)
        with pytest.warns(RuntimeWarning, match="plans with fatrop"):
            keys.append(evaluation._key(one, episodes))
    monkeypatch.setattr("quad_swarm.jobs.journal.sources_digest", lambda name: "other code")
    keys.append(evaluation._key(one, episodes))
    monkeypatch.setattr("quad_swarm.jobs.journal.machine", lambda: "another machine")
    keys.append(evaluation._key(one, episodes))
    assert len(set(keys)) == len(keys)
    assert evaluation._key(one, episodes) == keys[-1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_parent(kind):
    command = ["--policy", "none", "full", "--episodes", "1000000", "--jobs", "2"]
    parent = subprocess.Popen([sys.executable, "-m", "quad_swarm.evaluation.command", *command])
    workers: set[int] = set()
    for _ in range(600):
        workers = children(parent.pid)
        if sum(busy(pid) for pid in workers) >= 2:
            break
        time.sleep(0.05)
    assert len(workers) >= 2
    parent.send_signal(kind)
    parent.wait()
    for _ in range(200):
        if not any(Path(f"/proc/{pid}").exists() for pid in workers):
            return
        time.sleep(0.05)
    raise AssertionError(f"{workers} still run")


def children(pid: int) -> set[int]:
    """Ids of the processes that a process has begun."""
    found = set()
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.add(int(status.parent.name))
    return found


def busy(pid: int) -> bool:
    """Whether a process has used more than a second of a processor."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False
    return int(fields[11]) > 100


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_what_users_register_flies_in_every_process(jobs, monkeypatch):
    """Also what is no function of their own modules, such as a built-in one with other arguments."""
    monkeypatch.setitem(SCENARIOS, "apart", functools.partial(random))
    monkeypatch.setitem(RULES, "near", (functools.partial(distance, 1e3), ()))
    monkeypatch.setitem(SOLVERS, "stay", foreign.Stay)
    monkeypatch.setitem(SOLVERS, "gentle", foreign.gentle)
    monkeypatch.setitem(SIMULATORS, "gazebo", Simulator(foreign.Drifting, ("iris", "typhoon")))
    monkeypatch.setitem(GROUPS, "ones", foreign.ones)
    config = make_config("paper")
    plans = [Condition("near", "apart", config, 10, solver=solver) for solver in ("rti", "stay", "gentle")]
    flown = [*plans, Condition("none", "apart", make_config("paper", plant="gazebo:typhoon"), 10)]
    rti, stay, gentle, gazebo = (fly_all([one], 2, jobs=jobs)[one] for one in flown)
    assert [row["requests"] for row in (*rti, *stay, *gentle)] == [12 * 10] * 6
    assert [row["path_length"] for row in stay] == [0, 0]
    assert all(0.1 < a["path_length"] / b["path_length"] < 0.6 for a, b in zip(gentle, rti, strict=True))
    assert [row["path_length"] for row in gazebo] == pytest.approx([2.0, 2.0])  # 1 s at 2 m/s


@pytest.mark.parametrize("jobs", [1, 2])
def test_policies_may_be_objects(jobs):
    config = make_config("paper")
    conditions = [Condition(policy, "random", config, 10) for policy in ("none", foreign.Asker(), "full")]
    none, asker, full = evaluate(conditions, 3, jobs=jobs)
    assert (none["policy"], asker["policy"], full["policy"]) == ("none", "Asker", "full")
    assert (none["requests"], asker["requests"]) == (0, full["requests"])
    assert asker["time_lost"] == full["time_lost"]


def test_a_policy_that_cannot_be_sent_to_processes_is_named():
    class Local(foreign.Asker):
        pass

    conditions = [Condition(Local(), scenario, make_config("paper"), 2) for scenario in ("random", "random_swap")]
    assert len(evaluate(conditions, 1)) == 2
    with pytest.raises(ValueError, match=r"The policy Local cannot be pickled .* choose jobs=1"):
        evaluate(conditions, 1, jobs=2)


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_simulator_that_dies_costs_its_piece_only(jobs, tmp_path, monkeypatch):
    monkeypatch.setitem(SIMULATORS, "mortal", Simulator(foreign.Mortal, ("iris", "typhoon")))
    monkeypatch.setenv("FOREIGN_DIED", str(tmp_path / "died"))
    config = make_config("paper", plant="mortal:iris")
    conditions = [Condition("none", scenario, config, 10) for scenario in ("random", "random_swap")]
    rows = [row for one in fly_all(conditions, 2, jobs=jobs).values() for row in one]
    assert (tmp_path / "died").exists()
    assert [row["path_length"] for row in rows] == pytest.approx([1.0] * 4)


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_simulator_that_always_dies_is_told_in_one_line(jobs, tmp_path, monkeypatch):
    monkeypatch.setitem(SIMULATORS, "doomed", Simulator(foreign.Mortal, ("iris", "typhoon")))
    monkeypatch.setenv("FOREIGN_DIED", "/dev/null/nothing")  # which cannot be created
    config = make_config("paper", plant="doomed:iris")
    conditions = [Condition("none", scenario, config, 10) for scenario in ("random", "random_swap")]
    with pytest.raises(PlantError, match="The simulator's process exited with") as error:
        evaluate(conditions, 2, jobs=jobs)
    assert "\n" not in str(error.value)
