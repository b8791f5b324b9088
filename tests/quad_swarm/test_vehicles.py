"""Vehicles by name and from files."""

import os
import warnings

import pytest
import yaml

from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorParams
from quad_swarm.vehicles import VEHICLES, load_vehicle
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import make_config


def test_the_paper_s_vehicle_is_the_default():
    assert VEHICLES["bebop2"] == QuadrotorParams() == make_config("paper").quadrotor


@pytest.mark.parametrize("name", VEHICLES)
def test_worlds_take_names(name):
    assert make_config("flight", quadrotor=name).quadrotor == VEHICLES[name]


NAMED = {"quadrotor": "crazyflie21"}


@pytest.mark.parametrize(
    ("preset", "world", "downwash"),
    [
        ("flight", {}, 1.0),
        ("flight", NAMED, 3.0),
        ("flight", {"quadrotor": "x500"}, 1.0),
        ("flight", {**NAMED, "planner": {"separation": 0.9}}, 3.0),
        ("flight", {**NAMED, "planner": {"downwash": 1.0}}, 1.0),
        ("flight", {"vehicles": [{}, NAMED]}, 3.0),
        ("flight", {"quadrotor": VEHICLES["crazyflie21"]}, 1.0),
        (make_config("flight", planner={"downwash": 2.0}), NAMED, 2.0),
    ],
)
def test_the_downwash_of_a_world_is_that_of_the_named_vehicle(preset, world, downwash):
    assert make_config(preset, world).planner.downwash == downwash


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
    with pytest.raises(FileNotFoundError, match=r"'nowhere\.yml': there is no such vehicle file; .* hummingbird"):
        load_vehicle("nowhere.yml")


BOMB = "a: &a [x, x]\n" + "".join(f"{one}: &{one} [{9 * f'*{chr(ord(one) - 1)}, '}]\n" for one in "bcdefghij")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("parameters: {drag_x: -1}", "drag_x=-1: it must be greater"),
        ("parameters: {drag_x: 2001-99-99}", "drag_x='2001-99-99': it must be a valid number"),
        ("parameters: {drag_x: 1:30}", "drag_x='1:30': it must be a valid number"),
        ("parameters: {drag_x: true}", "drag_x='True': it must be a valid number"),
        ("parameters: {drag_x: 1, drag_x: 2}", "'drag_x' is given twice"),
        ("parameters: {mass: 2}", "parameter 'mass'"),
        ("parameters: " + "[" * 9000, "nested too deeply"),
        (BOMB + "parameters: {drag_x: *j}", "more than 10000 values"),
        (b"\xff\xfe", "utf-8"),
    ],
)
def test_every_message_names_the_file_in_one_line(content, message, tmp_path):
    path = tmp_path / "vehicle.yml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for name in (path, str(path)):
        with pytest.raises(ValueError, match=message) as caught:
            make_config("paper", quadrotor=name)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.yml")
    (tmp_path / "folder.yml").mkdir()
    for name in ("pipe.yml", "folder.yml"):
        with pytest.raises(ValueError, match=rf"{name} is not a file"):
            load_vehicle(tmp_path / name)


def test_paths_may_be_objects_and_numbers_are_decimal(tmp_path):
    path = tmp_path / "vehicle.txt"
    rest = "".join(f", {name}: 1" for name in VEHICLE_PARAMETERS if not name.startswith("drag"))
    path.write_text(f"# mine\nparameters: {{drag_x: 010, drag_y: 1e-1{rest}}}\nresiduals: {{roll_rms: 0.1}}\n")
    for make in (lambda: make_config("paper", quadrotor=path), lambda: make_config("paper", {"quadrotor": path})):
        assert make().quadrotor == QuadrotorParams(9.81, 10.0, 0.1, *6 * [1.0])


def test_a_file_has_no_downwash_and_a_world_that_does_not_say_it_is_doubted(tmp_path):
    path = tmp_path / "vehicle.yml"
    given = {name: getattr(QuadrotorParams(), name) for name in VEHICLE_PARAMETERS}
    path.write_text(yaml.safe_dump({"parameters": given}))
    with pytest.warns(DoubtfulWorld, match=r"vehicle\.yml': a vehicle file has no downwash.* set planner\.downwash"):
        make_config("paper", quadrotor=str(path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for downwash in (1, 3):
            make_config("paper", quadrotor=str(path), planner={"downwash": downwash})
        make_config("paper", quadrotor="hummingbird")


def test_a_file_that_lacks_a_parameter_is_not_completed_with_another_vehicle(tmp_path):
    path = tmp_path / "vehicle.yml"
    given = {name: 1.0 for name in VEHICLE_PARAMETERS}
    del given["drag_y"], given["climb_gain"]
    path.write_text(yaml.safe_dump({"parameters": given}))
    with pytest.raises(ValueError, match=r"lacks drag_y, climb_gain: .* Bebop 2 has drag_y: 0\.33, climb_gain: 1\.227"):
        make_config("flight", quadrotor=path)
