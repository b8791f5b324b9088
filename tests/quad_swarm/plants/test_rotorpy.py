"""RotorPy as plant: its vehicles do what our inputs say, in batches of any size, and swarms fly in it."""

import numpy as np
import pytest
from flown_plants import check_full_communication_keeps_apart, check_hovers_tilts_and_climbs, fly, placed

pytest.importorskip("torchdiffeq", reason="the extra `plants` is not installed")


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["crazyflie", "hummingbird"])
def test_hovers_tilts_and_climbs_as_commanded(vehicle):
    check_hovers_tilts_and_climbs(f"rotorpy:{vehicle}", climb=0.45)


@pytest.mark.slow
def test_wind_drags_the_rotors():
    plant, start = placed("rotorpy:hummingbird")
    state = fly(plant, start, np.zeros((2, 3, 4)), 100, air=1.0)
    # Identified drag of 0.49 1/s against air of 1 m/s: 1 - exp(-0.49) after a second, less what the tilt takes away
    np.testing.assert_allclose(state[..., 3:5], 0.35, atol=0.1)


@pytest.mark.slow
def test_dropped_swarms_and_forks_do_not_touch_the_others():
    plant, start = placed("rotorpy:crazyflie")
    u = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 3, 4))
    both = fly(plant, start, u, 20)
    alone, start = placed("rotorpy:crazyflie")
    alone.keep(np.array([False, True]))
    np.testing.assert_allclose(fly(alone, start[1:], u[1:], 20), both[1:], rtol=0, atol=1e-12)
    fork = plant.fork()
    there, here = fly(fork, both, u, 10), fly(plant, both, u, 10)
    assert np.array_equal(there, here)
    plant.keep(np.array([False, False]))
    assert plant.step(both[:0], u[:0], np.zeros((0, 3, 2)), None).shape == (0, 3, 9)


@pytest.mark.slow
def test_a_swarm_that_begins_anew_has_forgotten_the_last_episode():
    plant, start = placed("rotorpy:crazyflie")
    u = np.full((2, 3, 4), 0.2)
    first = fly(plant, start, u, 10)
    for k in range(2):
        plant.place(k, start[k])
    assert np.array_equal(fly(plant, start, u, 10), first)


@pytest.mark.slow
def test_swarms_fly_in_it_and_full_communication_keeps_them_apart():
    check_full_communication_keeps_apart("rotorpy:hummingbird", "hummingbird", episodes=5)
