"""Vehicles are identified from simulators and from logs, with the same report and the same file."""

import csv

import numpy as np
import pytest
import yaml

from quad_swarm.evaluation.command import main as evaluate
from quad_swarm.evaluation.identification import identify_logs, main
from quad_swarm.evaluation.recordings import Recording, read, write
from quad_swarm.plants.identify import Identification
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorModel, QuadrotorParams
from quad_swarm.vehicles import VEHICLES, load_vehicle


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "vehicle"), [("crazyflow:cf21B_500", "crazyflie21"), ("rotorpy:hummingbird", "hummingbird")]
)
def test_a_vehicle_file_is_written_that_worlds_take(plant, vehicle, tmp_path, capsys):
    pytest.importorskip("mujoco", reason="the extra `plants` is not installed")
    path = tmp_path / "vehicle.yml"
    assert main(["--plant", plant, "--out", str(path)]) == 0
    assert "residuals: roll and pitch" in capsys.readouterr().out
    found = load_vehicle(str(path))
    for name in VEHICLE_PARAMETERS:
        assert getattr(found, name) == pytest.approx(getattr(VEHICLES[vehicle], name), rel=0.02)


def test_a_dash_writes_the_vehicle_to_the_standard_output_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--plant", "model", "--out", "-"]) == 0
    printed = capsys.readouterr()
    assert yaml.safe_load(printed.out)["parameters"]["drag_x"] == pytest.approx(QuadrotorParams().drag_x, abs=1e-3)
    assert "residuals: roll and pitch" in printed.err
    assert not list(tmp_path.iterdir())


def test_the_file_is_checked_before_the_identification_and_written_as_a_whole(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("quad_swarm.evaluation.identification.identify", lambda plant: 1 / 0)
    (tmp_path / "file").touch()
    for out in (tmp_path, tmp_path / "file" / "v.yml"):
        with pytest.raises(ValueError, match=r"--out .* cannot be written: .*; choose another path"):
            main(["--plant", "rotorpy:hummingbird", "--out", str(out)])
    with pytest.raises(ZeroDivisionError):
        main(["--plant", "rotorpy:hummingbird", "--out", str(tmp_path / "missing" / "folder" / "v.yml")])
    found = Identification(QuadrotorParams(), 0.1, 0.2, 0.3, 0.4)
    monkeypatch.setattr("quad_swarm.evaluation.identification.identify", lambda plant: found)
    out = tmp_path / "missing" / "folder" / "v.yml"
    assert main(["--plant", "rotorpy:hummingbird", "--out", str(out)]) == 0
    assert load_vehicle(str(out)) == found.params
    assert [path.name for path in out.parent.iterdir()] == ["v.yml"]


def swarm(path, plant, vehicle, episodes):
    """Record a swarm that flies a vehicle and plans with its model."""
    words = ["--policy", "full", "--scenario", "symmetric_swap", "--episodes", str(episodes), "--max-steps", "150"]
    world = [f"quadrotor={vehicle}", "planner.dt=0.05"]
    assert evaluate([*words, "--plant", plant, "--world", *world, "--record", str(path)]) == 0
    return sorted(path.parent.glob(f"*{path.suffix}"))


@pytest.mark.parametrize("suffix", [".npz", ".csv", pytest.param(".mcap", marks=pytest.mark.slow)])
def test_a_swarm_gives_its_vehicle_back(suffix, tmp_path, capsys):
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    logs = swarm(tmp_path / f"flight{suffix}", "model", "hummingbird", 2)
    out = tmp_path / "found.yml"
    capsys.readouterr()
    assert main(["--log", *map(str, logs), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert [line.split()[0] for line in shown.splitlines()[1:9]] == list(VEHICLE_PARAMETERS)
    assert "residuals: roll and pitch 0.0" in shown
    assert "windows of 2 s that were held out" in shown
    assert "set-points act +0 ms after" in shown.replace("-0 ms", "+0 ms")
    found = load_vehicle(str(out))
    for name in VEHICLE_PARAMETERS:
        assert getattr(found, name) == pytest.approx(getattr(VEHICLES["hummingbird"], name), rel=0.02), name
    assert out.read_text().startswith("# sb3-maddpg identify --log ")
    assert set(yaml.safe_load(out.read_text())["residuals"]) == set(Identification._fields[1:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "vehicle", "tolerance"),
    [("crazyflow:cf21B_500", "crazyflie21", 0.06), ("rotorpy:hummingbird", "hummingbird", 0.08)],
)
def test_a_swarm_in_a_simulator_gives_its_vehicle_back(plant, vehicle, tolerance, tmp_path):
    pytest.importorskip("mujoco", reason="the extra `plants` is not installed")
    found = identify_logs(swarm(tmp_path / "flight.npz", plant, vehicle, 3))
    # Step responses know no delay: their time constants contain it
    for name in VEHICLE_PARAMETERS:
        delay = max(found.delay, 0.0) if "time" in name else 0.0
        assert getattr(found.params, name) + delay == pytest.approx(getattr(VEHICLES[vehicle], name), rel=tolerance)


@pytest.fixture(scope="module")
def lab():
    """The rows of a table of one robot, as a laboratory logs it."""
    rng, model = np.random.default_rng(0), QuadrotorModel(QuadrotorParams(), 0.02)
    inputs = np.repeat(rng.uniform(-1, 1, (80, 4)) * [0.2, 0.2, 1.0, 0.0], 25, axis=0)
    state, rows = np.zeros((1, 9)), []
    names = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw")
    for k, u in enumerate(inputs):
        rows.append({"time": 0.02 * k, "robot": 0, **dict(zip(names, state[0], strict=True))})
        rows[-1] |= dict(zip(("roll_set", "pitch_set", "climb_set"), u[:3], strict=True))
        state = model.step(state, u[None])
    return rows


def table(path, rows, leave_out=()):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [name for name in rows[0] if name not in leave_out], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.mark.parametrize(("leave_out", "tolerance"), [((), 0.01), (("vx", "vy", "vz"), 0.03)])
def test_one_robot_and_a_table_of_your_own_are_enough(leave_out, tolerance, lab, tmp_path):
    found = identify_logs([table(tmp_path / "lab.csv", lab, leave_out)])
    for name in VEHICLE_PARAMETERS:
        assert getattr(found.params, name) == pytest.approx(getattr(QuadrotorParams(), name), rel=tolerance), name


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"leave_out": ["roll_set", "climb_set"]}, "has nothing in the columns roll_set, climb_set: a fit needs"),
        ({"leave_out": ["roll", "pitch", "yaw"]}, "has nothing in the columns roll, pitch, yaw"),
        ({"leave_out": ["yaw"]}, "it has roll, pitch, but no yaw: give all of them, or leave all out"),
        (
            {"climb_set": lambda row: 0.0},
            "cannot determine climb_gain and climb_time_constant: climb_set varies by 0 m/s",
        ),
        ({"roll": lambda row: "nan"}, "states must be finite"),
        ({"vx": lambda row: "fast"}, "fast"),
        ({"time": lambda row: 10 * row["time"]}, "a sample each 0.2 s"),
        ({"rows": 300}, "the fit needs 12, which are 24 s of flight"),
        ({"rows": 1}, "times"),
    ],
)
def test_damaged_logs_are_refused_in_one_line(change, told, lab, tmp_path):
    change = dict(change)
    rows, leave_out = lab[: change.pop("rows", None)], change.pop("leave_out", ())
    rows = [{**row, **{name: value(row) for name, value in change.items()}} for row in rows]
    path = table(tmp_path / "lab.csv", rows, leave_out)
    with pytest.raises(ValueError, match=r"lab\.csv") as error:
        main(["--log", str(path)])
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_a_bag_without_commands_is_refused(tmp_path):
    pytest.importorskip("mcap_ros2")
    time, state = np.arange(10) * 0.1, np.zeros((10, 1, 9))
    talk = np.zeros((10, 1, 1), bool)
    known = Recording(time, state, np.full((10, 1, 4), np.nan), np.zeros((10, 1, 0, 3)), talk, talk, np.zeros((1, 3)))
    write(tmp_path / "bag.mcap", known)
    assert read(tmp_path / "bag.mcap").n_robots == 1
    with pytest.raises(ValueError, match="nothing in the topic /NAME/cmd"):
        main(["--log", str(tmp_path / "bag.mcap")])


@pytest.mark.parametrize("words", [[], ["--log", "a.csv", "--plant", "model"]])
def test_one_source_is_named(words, capsys):
    with pytest.raises(SystemExit):
        main(words)
    assert "--plant" in capsys.readouterr().err


def test_the_file_is_checked_before_the_logs_are_read(tmp_path):
    with pytest.raises(ValueError, match=r"--out .* cannot be written"):
        main(["--log", "missing.csv", "--out", str(tmp_path)])
    with pytest.raises(ValueError, match=r"missing\.csv cannot be read \(No such file"):
        main(["--log", str(tmp_path / "missing.csv")])
