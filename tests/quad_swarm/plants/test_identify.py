"""What is identified is what is flown."""

import numpy as np
import pytest
import yaml

from quad_swarm.plants.identify import DT, Identification, experiment, identify, main
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorParams
from quad_swarm.vehicles import VEHICLES, load_vehicle


def test_steps_in_every_direction_come_back_to_zero():
    u = experiment()
    assert u.shape == (round(3.0 / DT), 12, 4)
    assert (np.abs(u[0]).max(axis=1) > 0).all()
    assert not u[-1].any()
    np.testing.assert_allclose(u.sum(axis=1)[0], 0, atol=1e-12)  # as far one way as the other


def test_our_own_model_is_found_again():
    found = identify("model")
    for name in VEHICLE_PARAMETERS:
        assert getattr(found.params, name) == pytest.approx(getattr(QuadrotorParams(), name), rel=1e-3)
    assert max(found[1:]) < 1e-3


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
    monkeypatch.setattr("quad_swarm.plants.identify.identify", lambda plant: 1 / 0)
    (tmp_path / "file").touch()
    for out in (tmp_path, tmp_path / "file" / "v.yml"):
        with pytest.raises(ValueError, match=r"--out .* cannot be written: .*; choose another path"):
            main(["--plant", "rotorpy:hummingbird", "--out", str(out)])
    with pytest.raises(ZeroDivisionError):
        main(["--plant", "rotorpy:hummingbird", "--out", str(tmp_path / "missing" / "folder" / "v.yml")])
    found = Identification(QuadrotorParams(), 0.1, 0.2, 0.3, 0.4)
    monkeypatch.setattr("quad_swarm.plants.identify.identify", lambda plant: found)
    out = tmp_path / "missing" / "folder" / "v.yml"
    assert main(["--plant", "rotorpy:hummingbird", "--out", str(out)]) == 0
    assert load_vehicle(str(out)) == found.params
    assert [path.name for path in out.parent.iterdir()] == ["v.yml"]
