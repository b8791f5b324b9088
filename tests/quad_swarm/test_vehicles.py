"""Vehicles by name and from files."""

import pytest

from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.vehicles import VEHICLES, load_vehicle
from quad_swarm.world.presets import make_config


def test_the_paper_s_vehicle_is_the_default():
    assert VEHICLES["bebop2"] == QuadrotorParams() == make_config("paper").quadrotor


@pytest.mark.parametrize("name", VEHICLES)
def test_worlds_take_names(name):
    assert make_config("flight", quadrotor=name).quadrotor == VEHICLES[name]


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="Did you mean 'crazyflie21'"):
        make_config("flight", world={"quadrotor": "crazyflie2"})


CONTENTS = ["", "parameters: 3", "drag_x: 0.1", "parameters: {drag: 0.1}", "parameters: {drag_x: -1}", "a: [", "!!x"]


@pytest.mark.parametrize("content", CONTENTS)
def test_files_that_hold_something_else_are_refused(content, tmp_path):
    path = tmp_path / "vehicle.yml"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"not a vehicle file|drag"):
        load_vehicle(str(path))


def test_a_missing_file_is_named():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yml"):
        load_vehicle("nowhere.yml")
