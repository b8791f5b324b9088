"""Recorded flights are judged as simulated ones are."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from quad_swarm.evaluation.command import main
from quad_swarm.evaluation.inference import wilson_interval
from quad_swarm.evaluation.judging import judge, totals
from quad_swarm.evaluation.real_time import main as fly_main
from quad_swarm.evaluation.recordings import SUFFIXES, read, read_flights, write
from quad_swarm.world.presets import make_config

TIME = np.arange(0, 2, 0.02)


def table(path, rows, titles=("time", "robot", "x", "y", "z")):
    with Path(path).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([titles, *rows])
    return path


def crossing(path, miss, **columns):
    """Two robots that pass each other at 2 m/s, between two samples, with a distance (m)."""
    rows = [
        [time, robot, (-1) ** robot * (time - 0.99), robot * miss, 1.0, *columns.values()]
        for time in TIME
        for robot in (0, 1)
    ]
    return table(path, rows, ("time", "robot", "x", "y", "z", *columns))


def test_who_met_when_at_any_time(tmp_path):
    (flight,) = read_flights([crossing(tmp_path / "lab.csv", 0.3)], changes={"radius": 0.1507})
    row = judge("lab.csv", flight[1])
    assert (row["collided"], row["collisions"], row["closest_pair"]) == (True, [[0, 1]], [0, 1])
    assert row["closest"] == pytest.approx(0.3)
    assert row["closest_after"] == pytest.approx(0.99)
    assert row["seconds_to_collision"] == pytest.approx(1.0)
    assert not row["collided_at_samples"], "only between two samples were they closer than 0.3004 m"
    assert (row["arrived"], row["requests"], row["plan_share"]) == (None, None, None)
    assert row["path_length"] == pytest.approx(1.0)
    world = dataclasses.replace(flight[1].config(), continuous_collisions=False)
    row = judge("lab.csv", dataclasses.replace(flight[1], world=dataclasses.asdict(world)))
    assert (row["collided"], row["collided_continuous"], row["collisions"]) == (False, True, [])


def test_arrivals_have_the_tolerance_of_the_world(tmp_path):
    path = crossing(tmp_path / "lab.csv", 2.0, goal_x=0.5, goal_y=1.0, goal_z=1.0)
    for tolerance, arrived in ((1.2, True), (0.9, False)):
        ((_, recording),) = read_flights([path], changes={"goal_radius": tolerance})
        row = judge("lab.csv", recording)
        assert row["arrived"] is arrived
    assert row["robot_seconds_to_arrival"] == [None, None]


def test_many_pairs_do_not_need_to_be_held_at_once(tmp_path, monkeypatch):
    ((_, recording),) = read_flights([crossing(tmp_path / "lab.csv", 0.3)])
    whole = recording.separation(), recording.meetings()
    monkeypatch.setattr("quad_swarm.evaluation.recordings._MOST_DISTANCES", 7)
    np.testing.assert_array_equal(recording.separation(), whole[0])
    for one, other in zip(recording.meetings(), whole[1], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("preset", ["flight", "paper"])
def test_recorded_episodes_are_judged_as_they_were_evaluated(preset, tmp_path, capsys):
    flown = ["--preset", preset, "--n-robots", "4", "--policy", "none", "cpa:0.7:1.5", "--scenario", "symmetric_swap"]
    flown += ["--episodes", "3", "--record", str(tmp_path / "flight.npz"), "--json", str(tmp_path / "flown.json")]
    assert main(flown) == 0
    assert "flight_4.npz: symmetric_swap, cpa:0.7:1.5, episode 0" in capsys.readouterr().out
    files = [str(tmp_path / f"flight_{k}.npz") for k in range(1, 7)]
    assert main(["--flight", *files, "--json", str(tmp_path / "judged.json")]) == 0
    judged = json.loads((tmp_path / "judged.json").read_text())
    assert [row["flight"] for row in judged] == [*files, None, None]
    dt = make_config(preset).planner.dt
    for was, row in zip(json.loads((tmp_path / "flown.json").read_text()), judged[6:], strict=True):
        assert (row["policy"], row["flights"]) == (was["policy"], 3)
        for name, other in (("collided", "collisions"), ("arrived", "arrived"), ("requests", "requests")):
            assert row[name] == was[other], name
        assert (row["collision_low"], row["collision_high"]) == (was["collision_low"], was["collision_high"])
        assert row["plan_share"] == pytest.approx(was["request_share"], rel=0.1)
        # Simulated robots do not fly quite straight between samples
        assert row["closest"] == pytest.approx(was["min_separation_continuous"], abs=5e-3)
        if was["arrived"]:
            assert row["seconds_to_arrival"] == pytest.approx(dt * was["steps_to_arrival"])
            assert row["path_length"] == pytest.approx(was["path_length"], rel=0.02)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_gives_the_same_rows(suffix, tmp_path, capsys):
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    words = ["--policy", "cpa:1.2s:3", "--preset", "flight", "--n-robots", "3", "--scenario", "random"]
    path = tmp_path / f"flight{suffix}"
    for one in (path, tmp_path / "same.npz"):
        assert main([*words, "--episodes", "1", "--max-steps", "60", "--record", str(one)]) == 0
    found, same = read(path), read(tmp_path / "same.npz")
    for name in ("time", "state", "setpoint", "asked", "told", "goal"):
        atol = 1e-9 if suffix == ".mcap" else 0
        np.testing.assert_allclose(getattr(found, name), getattr(same, name), atol=atol, err_msg=name)
    assert np.isfinite(found.setpoint[:-1]).all()
    rows = []
    for one in (path, tmp_path / "same.npz"):
        ((_, recording),) = read_flights([one], "flight")
        rows.append(judge("flight", dataclasses.replace(recording, policy="")))
    assert rows[0] == {name: pytest.approx(value, abs=1e-9) for name, value in rows[1].items()}


def test_what_robots_in_real_time_measure_is_told(tmp_path, capsys):
    words = ["--policy", "full", "--n-robots", "3", "--link", "virtual", "--loss", "0.1", "--most", "4"]
    path = tmp_path / "flight.npz"
    assert fly_main([*words, "--record", str(path), "--json", str(tmp_path / "flown.json")]) == 0
    (was,) = json.loads((tmp_path / "flown.json").read_text())
    capsys.readouterr()
    assert main(["--flight", str(path), "--json", "-"]) == 0
    shown = capsys.readouterr()
    row, total = json.loads(shown.out)
    for name in ("bytes_per_second", "missed", "late", "plans_sent", "periods"):
        assert row[name] == total[name] == was[name]
    assert row["requests"] > 0.9 * was["counts"]["requests"] * row["seconds_to_arrival"] / row["seconds"]
    assert "sent: plans; B/s" in shown.err


def test_totals_are_of_each_policy_and_of_what_is_known(tmp_path):
    flights = read_flights([
        crossing(tmp_path / "a.csv", 0.1),
        crossing(tmp_path / "b.csv", 1.0),
        crossing(tmp_path / "c.csv", 1.0, goal_x=0.0, goal_y=0.5, goal_z=1.0),
    ])  # fmt: skip
    rows = [judge(path.name, recording) for path, recording in flights]
    (total,) = totals(rows)
    assert (total["flights"], total["collided"], total["closest_flight"]) == (3, 1, "a.csv")
    assert (total["collision_low"], total["collision_high"]) == wilson_interval(1, 3)
    assert (total["goals_known"], total["arrived"], total["plan_share"]) == (1, 0, None)
    assert [one["policy"] for one in totals([{**rows[0], "policy": "full"}, *rows])] == ["full", None]


def test_the_table_says_what_is_unknown(tmp_path, capsys):
    path = str(crossing(tmp_path / "lab.csv", 0.3))
    assert main(["--flight", path, "--world", "radius=0.16"]) == 0
    shown = capsys.readouterr().out
    assert "closer than 0.319 m" in shown
    assert f"goals are unknown, and arrivals with them (columns goal_x, goal_y, goal_z): {path}" in shown
    assert f"who asked whom is unknown (columns asked, told): {path}" in shown
    assert "1/1" in shown
    assert "20.7 - 100.0%" in shown


def test_what_is_given_replaces_what_is_recorded(tmp_path, capsys):
    path = str(tmp_path / "flight.npz")
    flown = ["--policy", "full", "--n-robots", "3", "--scenario", "symmetric_swap", "--max-steps", "30"]
    assert main([*flown, "--episodes", "1", "--record", path, "--world", "radius=0.2"]) == 0
    for words, contact in (([], 0.399), (["--world", "radius=0.1"], 0.199), (["--preset", "flight"], 0.599)):
        capsys.readouterr()
        assert main(["--flight", path, *words]) == 0
        assert f"closer than {contact} m" in capsys.readouterr().out


def test_only_collisions_are_recorded_on_request(tmp_path, capsys):
    words = ["--preset", "flight", "--n-robots", "6", "--policy", "none", "full", "--scenario", "symmetric_swap"]
    words += ["--episodes", "2", "--json", str(tmp_path / "rows.json")]
    assert main([*words, "--record", str(tmp_path / "met.npz"), "--record-collided"]) == 0
    none, full = json.loads((tmp_path / "rows.json").read_text())
    assert none["collisions"] > 0
    assert full["collisions"] == 0
    files = [tmp_path / f"met_{k}.npz" for k in range(1, none["collisions"] + 1)]
    files = files if len(files) > 1 else [tmp_path / "met.npz"]
    assert sorted(tmp_path.glob("*.npz")) == files
    assert all(judge("", recording)["collided"] for _, recording in read_flights(files))
    capsys.readouterr()
    words[words.index("none")] = "full"
    assert main([*words, "--record", str(tmp_path / "none.npz"), "--record-collided"]) == 0
    assert "no episode had a collision" in capsys.readouterr().out
    assert not (tmp_path / "none.npz").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--flight", "lab.csv", "--policy", "full"], "--policy is for policies to fly"),
        (["--flight", "lab.csv", "--record", "a.npz"], "--record is for policies to fly"),
        (["--flight", "lab.csv", "--world", "radius=-1"], "radius"),
        (["--flight", "lab.csv", "--preset", "fligth"], "flight"),
        (["--flight", "missing.csv"], "missing.csv"),
        (["--flight", "lab.bag"], ".npz, .csv, .mcap"),
        (["--flight", "one.csv"], "one.csv holds one robot"),
        (["--flight", "short.csv"], "short.csv is no recording of a flight: it needs the columns"),
        (["--policy", "none", "--record", "a.bag"], ".npz, .csv, .mcap"),
        (["--policy", "none", "--record-collided"], "--record-collided needs --record"),
        (["--policy", "none", "--record", "a.npz", "--episodes", "300"], "1200 episodes would be 1200 files"),
        (["--policy", "none", "--record", "a.csv", "--csv", "a.csv"], "--csv and --record are both a.csv"),
        (["--policy", "none", "--record", "lab.csv/a.csv"], "--record lab.csv/a.csv cannot be written"),
    ],
)
def test_mistakes_are_one_line_with_the_remedy(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    crossing("lab.csv", 0.3)
    table("one.csv", [[time, 0, time, 0, 1] for time in TIME])
    table("short.csv", [[0, 0, 1]], ("time", "robot", "x"))
    assert main(words) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert told in error


def test_a_flight_without_words_keeps_them_unknown(tmp_path):
    for suffix in SUFFIXES:
        if suffix == ".mcap":
            pytest.importorskip("mcap_ros2")
        found = read(crossing(tmp_path / "lab.csv", 0.3))
        write(tmp_path / f"again{suffix}", found)
        again = read(tmp_path / f"again{suffix}")
        assert again.guessed == found.guessed == {"velocity", "attitude", "goal", "talk"}


def test_contact_with_obstacles_is_judged_at_any_time(tmp_path):
    """Robot 0 flies to +x past x = 0 at t = 0.99, 0.3 m from the surface of a pillar."""
    path = crossing(tmp_path / "lab.csv", 2.0)
    pillar = {"position": [0.0, -0.4, 0.0], "radius": 0.1}
    for radius, collided in ((0.29, False), (0.31, True)):
        world = {"radius": radius, "obstacles": {"listed": [pillar]}}
        ((_, recording),) = read_flights([path], changes=world)
        row = judge("lab.csv", recording)
        assert (row["collided"], row["obstacle_collisions"]) == (collided, [[0, 0]] if collided else [])
        assert row["collisions"] == []
        assert row["closest_obstacle"] == pytest.approx(0.3 - radius)
        assert row["closest_obstacle_pair"] == [0, 0]
        assert row["closest_obstacle_after"] == pytest.approx(0.99)
    moving = {"position": [1.0, -0.4, 1.0], "radius": 0.1, "shape": "sphere", "velocity": [0.0, 1.0, 0.0]}
    ((_, recording),) = read_flights([path], changes={"obstacles": {"listed": [moving]}})
    # Robot 0 at (t - 0.99, 0), the sphere at (1, t - 0.4)
    assert judge("lab.csv", recording)["closest_obstacle_after"] == pytest.approx((1.99 + 0.4) / 2)
    write(tmp_path / "flight.npz", recording)
    ((_, again),) = read_flights([tmp_path / "flight.npz"], changes={"radius": 0.2})
    assert again.obstacles == recording.obstacles, "they are those of the file"
    ((_, other),) = read_flights([tmp_path / "flight.npz"], changes={"obstacles": {"listed": [pillar]}})
    assert other.obstacles[0].radius == 0.1, "unless others are given"
    assert other.obstacles[0].shape == "cylinder"


def test_flights_among_obstacles_are_judged_as_they_were_evaluated(tmp_path, capsys):
    flown = ["--preset", "flight", "--n-robots", "6", "--policy", "none", "--scenario", "forest", "--episodes", "4"]
    assert main([*flown, "--record", str(tmp_path / "f.csv"), "--json", str(tmp_path / "flown.json")]) == 0
    table = capsys.readouterr().out
    assert "obstacles" in table
    files = [str(tmp_path / f"f_{k}.csv") for k in range(1, 5)]
    assert main(["--flight", *files, "--preset", "flight", "--json", str(tmp_path / "judged.json")]) == 0
    assert "obstacles" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "flown.json").read_text())
    judged = json.loads((tmp_path / "judged.json").read_text())
    assert sum(one["collided"] for one in judged[:4]) == row["collisions"] == judged[4]["collided"]
    assert row["obstacle_collisions"] <= judged[4]["collided_obstacle"], "flights go on after a collision"


def test_downwash_counts_in_what_is_judged(tmp_path):
    above = [[time, robot, 0.5 * time, 0.0, 1.0 + robot] for time in TIME for robot in (0, 1)]
    path = table(tmp_path / "lab.csv", above)
    for downwash, collided in ((1.0, False), (2.0, True)):
        ((_, recording),) = read_flights([path], changes={"planner": {"downwash": downwash}})
        row = judge("lab.csv", recording)
        assert (row["collided"], row["closest"]) == (collided, pytest.approx(1.0 / downwash))
