"""Crazyflow as plant: its vehicles do what our inputs say, in batches of any size, and swarms fly in it."""

import numpy as np
import pytest
from flown_plants import check_full_communication_keeps_apart, check_hovers_tilts_and_climbs, fly, placed

from quad_swarm.plants import make_plant
from quad_swarm.quadrotor import QuadrotorParams

pytest.importorskip("mujoco", reason="the extra `plants` is not installed")


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["cf21B_500", "hb_x500"])
def test_hovers_tilts_and_climbs_as_commanded(vehicle):
    check_hovers_tilts_and_climbs(f"crazyflow:{vehicle}", climb=0.5)


@pytest.mark.slow
def test_wind_pushes():
    plant, start = placed("crazyflow:cf21B_500")
    state = fly(plant, start, np.zeros((2, 3, 4)), 100, air=1.0)
    # Drag of 0.25 and 0.33 against the air's 1 m/s, less what the vehicle's own drag takes away
    assert (state[..., 3] > 0.1).all()
    assert (state[..., 4] > state[..., 3]).all()


@pytest.mark.slow
def test_dropped_swarms_and_forks_do_not_touch_the_others():
    plant, start = placed("crazyflow:cf21B_500")
    u = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 3, 4))
    both = fly(plant, start, u, 20)
    alone, start = placed("crazyflow:cf21B_500")
    alone.keep(np.array([False, True]))
    assert np.array_equal(fly(alone, start[1:], u[1:], 20), both[1:])
    fork = plant.fork()
    there, here = fly(fork, both, u, 10), fly(plant, both, u, 10)
    assert np.array_equal(there, here)


@pytest.mark.slow
def test_refuses_sub_steps_between_its_own():
    with pytest.raises(ValueError, match=r"multiples of 2 ms, not 0\.003 s"):
        make_plant("crazyflow", QuadrotorParams(), 0.003, 1, 2)


@pytest.mark.slow
def test_swarms_fly_in_it_and_full_communication_keeps_them_apart():
    check_full_communication_keeps_apart("crazyflow", "crazyflie21", episodes=10)
