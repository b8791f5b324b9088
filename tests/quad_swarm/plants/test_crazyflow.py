"""Crazyflow as plant: its vehicles do what our inputs say, in batches of any size, and swarms fly in it."""

import numpy as np
import pytest

from quad_swarm.evaluation.flight import Condition, first_episode, run_episodes
from quad_swarm.plants import Plant, make_plant
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.presets import make_config

pytest.importorskip("mujoco", reason="the extra `plants` is not installed")

DT = 0.01


def placed(vehicle: str = "cf21B_500", n_swarms: int = 2, n_robots: int = 3) -> tuple[Plant, np.ndarray]:
    plant = make_plant(f"crazyflow:{vehicle}", QuadrotorParams(), DT, n_swarms, n_robots)
    state = np.zeros((n_swarms, n_robots, 9))
    state[..., :3] = np.random.default_rng(0).uniform(-2, 2, (n_swarms, n_robots, 3))
    for k in range(n_swarms):
        plant.place(k, state[k])
    return plant, state


def fly(plant: Plant, state: np.ndarray, u: np.ndarray, steps: int, air: float = 0.0) -> np.ndarray:
    for _ in range(steps):
        state = plant.step(state, u, np.full((*u.shape[:2], 2), air), None)
    return state


@pytest.mark.parametrize("vehicle", ["cf21B_500", "hb_x500"])
def test_hovers_tilts_and_climbs_as_commanded(vehicle):
    plant, start = placed(vehicle)
    u = np.zeros((2, 3, 4))
    hovering = fly(plant, start, u, 50)
    np.testing.assert_allclose(hovering, start, atol=2e-2)
    u[0, 0, 0], u[0, 1, 1], u[1, 2, 2] = 0.2, -0.2, 0.5
    state = fly(plant, hovering, u, 100)
    assert state[0, 0, 6] == pytest.approx(0.2, abs=0.03)
    assert state[0, 0, 4] < -0.8, "a positive roll accelerates along -y, as in our model"
    assert state[0, 1, 7] == pytest.approx(-0.2, abs=0.03)
    assert state[0, 1, 3] < -0.8
    assert state[1, 2, 5] == pytest.approx(0.5, abs=0.1)
    still = state[[0, 1, 1], [2, 0, 1]]
    np.testing.assert_allclose(still[:, :3], start[[0, 1, 1], [2, 0, 1], :3], atol=3e-2)


def test_wind_pushes():
    plant, start = placed()
    state = fly(plant, start, np.zeros((2, 3, 4)), 100, air=1.0)
    # Drag of 0.25 and 0.33 against the air's 1 m/s, less what the vehicle's own drag takes away
    assert (state[..., 3] > 0.1).all()
    assert (state[..., 4] > state[..., 3]).all()


def test_dropped_swarms_and_forks_do_not_touch_the_others():
    plant, start = placed()
    u = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 3, 4))
    both = fly(plant, start, u, 20)
    alone, start = placed()
    alone.keep(np.array([False, True]))
    assert np.array_equal(fly(alone, start[1:], u[1:], 20), both[1:])
    fork = plant.fork()
    there, here = fly(fork, both, u, 10), fly(plant, both, u, 10)
    assert np.array_equal(there, here)


def test_refuses_sub_steps_between_its_own():
    with pytest.raises(ValueError, match=r"a sub-step of 0\.003 s is none"):
        make_plant("crazyflow", QuadrotorParams(), 0.003, 1, 2)


def test_swarms_fly_in_it_and_full_communication_keeps_them_apart():
    config = make_config("flight", plant="crazyflow", quadrotor="crazyflie21")
    rows = {}
    for policy in ("none", "full"):
        condition = Condition(policy, "symmetric_swap", config, solver="rti", linger=5)
        rows[policy] = run_episodes(condition, range(first_episode(0), first_episode(0) + 10))
    assert not any(row["collided"] for row in rows["full"])
    assert sum(row["arrived"] for row in rows["full"]) >= 9
    assert min(row["min_separation_continuous"] for row in rows["full"]) > 0.62
    assert min(row["min_separation_continuous"] for row in rows["none"]) < 0.6
