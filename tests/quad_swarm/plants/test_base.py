"""The interface of plants, and our own model as one of them."""

import numpy as np
import pytest

from quad_swarm.plants import ModelPlant, make_plant, parse_plant
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
    with pytest.raises(ValueError, match=r"mismatch=0\.1: it only applies to plant='model'"):
        make_config("flight", plant="crazyflow", mismatch=0.1)
