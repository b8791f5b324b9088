"""What is identified is what is flown."""

import numpy as np
import pytest
import yaml

from quad_swarm.plants.identify import DT, experiment, identify, main
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


def test_a_file_that_cannot_be_written_fails_before_the_flights(tmp_path, monkeypatch):
    monkeypatch.setattr("quad_swarm.plants.identify.identify", lambda plant: pytest.fail("it flew"))
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "v.yml", tmp_path):
        with pytest.raises((OSError, ValueError)):
            main(["--plant", "model", "--out", str(path)])
    with pytest.raises(ValueError, match="is a folder: pass the path of a file"):
        main(["--plant", "model", "--out", str(tmp_path)])


def test_a_dash_writes_the_vehicle_to_the_standard_output_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--plant", "model", "--out", "-"]) == 0
    printed = capsys.readouterr()
    assert yaml.safe_load(printed.out)["parameters"]["drag_x"] == pytest.approx(QuadrotorParams().drag_x, abs=1e-3)
    assert "residuals: roll and pitch" in printed.err
    assert not list(tmp_path.iterdir())
