"""Recordings of flights, which are read as they were written."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from quad_swarm.evaluation.flight import Condition, fly
from quad_swarm.evaluation.judging import judge, legend
from quad_swarm.evaluation.recordings import MEASURED, SUFFIXES, Recording, read, read_flights, write
from quad_swarm.world.obstacles import Obstacle
from quad_swarm.world.presets import make_config


@pytest.fixture(scope="module")
def recording():
    """A flight with requests, announcements, set-points, and a robot without a plan for a while."""
    condition = Condition("cpa:1.2s:3", "symmetric_swap", make_config("paper", n_robots=3), 25)
    flown = Recording.of(fly(condition, 1), "a rule")
    rng = np.random.default_rng(0)
    setpoint, plan = rng.normal(size=flown.setpoint.shape), flown.plan.copy()
    plan[3:6, 1] = np.nan
    assert flown.asked.any()
    told = np.zeros_like(flown.told)
    told[7, 2, 0] = told[7, 2, 1] = True
    return dataclasses.replace(flown, setpoint=setpoint, plan=plan, told=told)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_written_is_read(suffix, recording, tmp_path):
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    path = tmp_path / f"flight{suffix}"
    write(path, recording)
    again = read(path)
    exact = suffix != ".mcap"  # whose velocities are turned into the robots' frames and back
    for name in ("time", "state", "setpoint", "asked", "told", "goal"):
        np.testing.assert_allclose(getattr(again, name), getattr(recording, name), atol=0 if exact else 1e-9)
    assert again.policy == "a rule"
    assert again.config() == recording.config()
    if suffix != ".csv":
        np.testing.assert_array_equal(again.plan, recording.plan)


def test_a_recording_is_a_flight_again():
    config = make_config("paper", n_robots=4)
    flown = fly(Condition("cpa:1.2s:3", "asymmetric_swap", config, 30), 0)
    announced = flown.requests & (np.arange(30) % 2 == 0)[:, None, None]
    assert announced.any()
    flown = dataclasses.replace(flown, announced=announced)
    again = Recording.of(flown, "rule").flight()
    assert again.config == config
    for name in ("state", "requests", "announced", "goal"):
        np.testing.assert_array_equal(getattr(again, name), getattr(flown, name))
    np.testing.assert_array_equal(again.plans[..., :3], flown.plans[..., :3])
    assert (again.arrival, again.collision) == (flown.arrival, flown.collision)


def test_a_laboratory_needs_five_columns(tmp_path):
    path = tmp_path / "lab.csv"
    times = np.arange(0, 2, 0.02)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["robot", "time", "z", "x", "y"])
        for robot in (1, 0):
            writer.writerows([[robot, time, 1.0, (-1) ** robot * (time - 1.0), 0.0] for time in times])
    found = read(path)
    assert found.n_robots == 2
    np.testing.assert_allclose(found.state[:, :, 3], np.tile([1.0, -1.0], (100, 1)), atol=1e-9)
    np.testing.assert_allclose(found.goal[:, 0], [0.98, -0.98])
    assert found.separation().min() == pytest.approx(0.0, abs=1e-12), "they met between two times"
    flight = found.flight(make_config("paper"))
    assert flight.n_robots == 2
    assert flight.collision == 36, "0.6 m apart"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "columns"),
        ("time,robot,x,y,z\n", "it has no rows"),
        ("time;robot;x;y;z\n0;0;0;0;0\n", "separated by semicolons or tabs: separate them by commas"),
        ("time,robot,x,y,z\n0,cf1,0,0,0\n", "line 2: robot='cf1' is no number"),
        ("time,robot,x,y,z,roll,pitch,yaw\n0,0,0,0,0,2,-15,0\n1,0,0,0,0,2,-15,0\n", "up to 15: give attitudes in rad"),
        ("time,robot,x,y\n0,0,0,0\n", "has no z"),
        ("time,robot,x,y,z\n0,0,0,0,0\n0,1,0,0,0\n", "2 to 1000000 times"),
        ("time,robot,x,y,z\n0,0,0,0,0\n0,2,0,0,0\n1,0,0,0,0\n1,2,0,0,0\n", "numbers 0, 2: count them from 0"),
        ("time,robot,x,y,z\n0,0,0,0,0\n0,1,0,0,0\n1,0,0,0,0\n", "one row for each"),
        ("time,robot,x,y,z\n0,0,0,0,0\n0,1,0,0,nan\n1,0,0,0,0\n1,1,0,0,0\n", "finite"),
        ("time,robot,x,y,z\n0,0,0,0,far\n", "far"),
        ("time,robot,x,y,z,roll,pitch\n0,0,0,0,0,0,0\n", "it has roll, pitch, but no yaw: give all of them"),
        ("time,robot,x,y,z,vz\n0,0,0,0,0,0\n", "it has vz, but no vx, vy"),
        ("time,robot,x,y,z,world\n0,0,0,0,0,[1]\n1,0,0,0,0,\n", "no recording"),
        ("time,robot,x,y,z,asked\n0,0,0,0,0,7\n0,1,0,0,1,\n1,0,0,0,0,\n1,1,0,0,1,\n", "7"),
    ],
)
def test_tables_of_something_else_are_refused(content, told, tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match="is no recording of a flight") as error:
        read(path)
    assert told in str(error.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("metres", "seconds", "told"),
    [(1000.0, 1.0, r"move at [0-9.e+]+ m/s, in the median"), (1.0, 1000.0, r"take \d+ s for \d\.\d m")],
)
def test_millimetres_and_milliseconds_are_refused(suffix, metres, seconds, told, recording, tmp_path):
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    path = tmp_path / f"flight{suffix}"
    state = recording.state * np.where(np.arange(9) < 6, metres, 1.0)
    write(path, dataclasses.replace(recording, state=state, time=recording.time * seconds))
    with pytest.raises(ValueError, match=rf"its robots {told}: give positions in metres and times in seconds"):
        read(path)


def test_robots_that_stand_have_no_units(tmp_path, recording):
    path = tmp_path / "flight.npz"
    write(path, dataclasses.replace(recording, state=np.tile(recording.state[:1], (len(recording.time), 1, 1))))
    assert read(path).n_robots == recording.n_robots


@pytest.mark.parametrize(
    ("given", "told"), [({}, True), ({"changes": {"radius": 0.1}}, False), ({"preset": "flight"}, False)]
)
def test_a_radius_that_nobody_told_is_said(given, told, tmp_path):
    path = tmp_path / "lab.csv"
    lines = ["time,robot,x,y,z", *(f"{t / 10},{k},{k},{t / 20},1" for t in range(4) for k in range(2))]
    path.write_text("\n".join(lines))
    ((_, recording),) = read_flights([path], **given)
    row = judge("lab.csv", recording)
    assert row["radius_known"] is not told
    assert any("give --world radius=METRES): lab.csv" in line for line in legend([row])) is told


@pytest.mark.parametrize("suffix", [".npz", ".mcap"])
@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x89MCAP0\r\n", bytes(range(256)) * 8])
def test_files_of_something_else_are_refused(suffix, content, tmp_path):
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    path = tmp_path / f"flight{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is no recording of a flight"):
        read(path)


def test_no_code_runs_when_a_recording_is_read(tmp_path, recording):
    path = tmp_path / "flight.npz"
    with path.open("wb") as file:
        np.savez(file, about=np.array([print], dtype=object), time=recording.time)
    with pytest.raises(ValueError, match="is no recording"):
        read(path)


def test_a_format_that_does_not_exist(tmp_path, recording):
    for function in (lambda path: write(path, recording), read):
        with pytest.raises(ValueError, match=r"\.npz, \.csv, \.mcap"):
            function(tmp_path / "flight.bag")


@pytest.mark.parametrize(
    "change",
    [
        {"time": np.zeros(26)},
        {"state": np.full((26, 3, 9), np.nan)},
        {"state": np.zeros((26, 3, 8))},
        {"asked": np.zeros((26, 3, 2), bool)},
        {"goal": np.full((3, 3), np.inf)},
        {"guessed": frozenset({"all"})},
        {"measured": {"missed": 0.1}},
        {"measured": dict.fromkeys(MEASURED, float("nan"))},
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(change, recording):
    with pytest.raises(ValueError, match=r"times|state|asked|goals|guessed|measured"):
        dataclasses.replace(recording, **change)


def test_the_world_of_a_recording_is_checked(recording, tmp_path):
    path = tmp_path / "flight.npz"
    write(path, dataclasses.replace(recording, world={"radius": -1}))
    with pytest.raises(ValueError, match="radius"):
        read(path).config()
    assert json.dumps(recording.world)


AMONG = (
    Obstacle((0.1, 0.2, 0.0), 0.3),
    Obstacle((-1.0, 0.30000000000000004, 1.2), 0.25, "sphere", (0.5, -0.1, 0.0)),
)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_obstacles_are_read_as_they_were_written(suffix, recording, tmp_path):
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    path = tmp_path / f"flight{suffix}"
    write(path, dataclasses.replace(recording, obstacles=AMONG))
    again = read(path)
    assert again.obstacles == AMONG
    np.testing.assert_allclose(again.state, recording.state, atol=1e-9)
    write(path, recording)
    assert read(path).obstacles == ()


@pytest.mark.parametrize(
    "told", ['{"position": 1}', '[{"position": [0, 0, 0]}]', '[{"radius": 1, "place": 1}]', "[1]", "x"]
)
def test_obstacles_that_are_none_are_refused(told, recording, tmp_path):
    path = tmp_path / "flight.csv"
    write(path, dataclasses.replace(recording, obstacles=AMONG))
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    rows[1][rows[0].index("obstacles")] = told
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    with pytest.raises(ValueError, match="is no recording of a flight"):
        read(path)


@pytest.mark.parametrize("preset", ["flight", "paper"])
def test_a_flight_among_obstacles_is_a_flight_again(preset):
    flown = fly(Condition("none", "crossing_traffic", make_config(preset), 60), 0)
    assert flown.obstacle_pos is not None
    assert any(one.moves for one in flown.obstacles)
    again = Recording.of(flown, "none").flight()
    assert again.obstacles == flown.obstacles
    np.testing.assert_allclose(again.obstacle_pos, flown.obstacle_pos, atol=1e-9)
    # Between steps, a recording is straight
    np.testing.assert_allclose(again.min_obstacle_distance, flown.min_obstacle_distance, atol=0.02)
    assert again.obstacles_at(60)[0].position == pytest.approx(tuple(flown.obstacle_pos[60, 0]))


def test_numbers_of_robots_may_be_written_as_floats(tmp_path):
    path = tmp_path / "lab.csv"
    lines = ["time,robot,x,y,z", *(f"{t / 10},{k:.6f},{k},{t / 20},1" for t in range(4) for k in range(2))]
    path.write_text("\n".join(lines))
    assert read(path).n_robots == 2
    path.write_text("\n".join([*lines, "0.4,0.5,0,0,1"]))
    with pytest.raises(ValueError, match=r"line 10: robot=0\.5 is no whole number"):
        read(path)
    with pytest.raises(ValueError, match=r"nothere.npz cannot be read \(No such file"):
        read(tmp_path / "nothere.npz")
