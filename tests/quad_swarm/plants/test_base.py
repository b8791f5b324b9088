"""The interface of plants, and our own model as one of them."""

import foreign
import numpy as np
import pytest

from quad_swarm.plants import SIMULATORS, ModelPlant, Simulator, make_plant, parse_plant
from quad_swarm.plants.base import simulated_vehicles
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams
from quad_swarm.world.presets import make_config


@pytest.mark.parametrize(
    ("name", "parsed"),
    [
        ("model", ("model", "")),
        ("crazyflow", ("crazyflow", "cf21B_500")),
        ("crazyflow:hb_x500", ("crazyflow", "hb_x500")),
    ],
)
def test_names(name, parsed):
    assert parse_plant(name) == parsed


@pytest.mark.parametrize(
    ("name", "message"),
    [("crazyflo", "Did you mean 'crazyflow'"), ("crazyflow:cf21B", "Did you mean 'cf21B_500'"), ("model:x", "'model'")],
)
def test_unknown_names_are_refused_before_anything_is_built(name, message):
    with pytest.raises(ValueError, match=message) as error:
        make_config("flight", plant=name)
    assert not str(error.value).endswith("?.")


def test_our_own_model_is_the_model():
    plant = make_plant("model", QuadrotorParams(), 0.05, 3, 2)
    assert isinstance(plant, ModelPlant)
    rng = np.random.default_rng(0)
    state, u, air = rng.normal(size=(3, 2, 9)) * 0.2, rng.normal(size=(3, 2, 4)) * 0.2, rng.normal(size=(3, 2, 2))
    expected = QuadrotorModel(QuadrotorParams(), 0.05).step(state, u, air)
    assert np.array_equal(plant.step(state, u, air, None), expected)


def test_vehicles_of_others_cannot_be_varied():
    assert make_config("flight", plant="crazyflow").mismatch == 0
    with pytest.raises(ValueError, match=r"mismatch=0\.1: it only applies to the quadrotors of plant='model'"):
        make_config("flight", plant="crazyflow", mismatch=0.1)


def test_a_simulator_names_its_adapter_and_vehicles(monkeypatch):
    one = Simulator(foreign.Drifting, ["iris", "typhoon"])
    assert one == Simulator("foreign:Drifting", ("iris", "typhoon"))
    monkeypatch.setitem(SIMULATORS, "gazebo", one)
    assert parse_plant("gazebo") == ("gazebo", "iris")
    assert {"gazebo:iris", "gazebo:typhoon"} < set(simulated_vehicles())
    with pytest.raises(ValueError, match="Did you mean 'iris'"):
        parse_plant("gazebo:irs")


@pytest.mark.parametrize(
    ("adapter", "vehicles", "message"),
    [
        ("foreign", ("iris",), "a class of a module or its name, module:Class"),
        (7, ("iris",), "a class of a module"),
        ("__main__:Plant", ("iris",), "a class of a module"),
        (type("Local", (), {"__qualname__": "test.<locals>.Local"}), ("iris",), "a class of a module"),
        ("foreign:Drifting", "iris", r"one or more names, as in \('iris',\)"),
        ("foreign:Drifting", (), "one or more names"),
    ],
)
def test_simulators_that_no_process_can_import_are_refused(adapter, vehicles, message):
    with pytest.raises(ValueError, match=message):
        Simulator(adapter, vehicles)


def test_an_entry_of_another_form_is_named(monkeypatch):
    monkeypatch.setitem(SIMULATORS, "gazebo", ("iris",))
    with pytest.raises(
        ValueError, match=r"SIMULATORS\['gazebo'\]=\('iris',\): it must be a quad_swarm.plants.Simulator"
    ):
        make_config("paper", plant="gazebo:iris")
