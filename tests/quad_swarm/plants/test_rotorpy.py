"""RotorPy as plant: its vehicles do what our inputs say, in batches of any size, and swarms fly in it."""

import numpy as np
import pytest

from quad_swarm.evaluation.flight import Condition, first_episode, run_episodes
from quad_swarm.plants import Plant, make_plant
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.presets import make_config

pytest.importorskip("torchdiffeq", reason="the extra `plants` is not installed")

DT = 0.01


def placed(vehicle: str = "crazyflie", n_swarms: int = 2, n_robots: int = 3) -> tuple[Plant, np.ndarray]:
    plant = make_plant(f"rotorpy:{vehicle}", QuadrotorParams(), DT, n_swarms, n_robots)
    state = np.zeros((n_swarms, n_robots, 9))
    state[..., :3] = np.random.default_rng(0).uniform(-2, 2, (n_swarms, n_robots, 3))
    for k in range(n_swarms):
        plant.place(k, state[k])
    return plant, state


def fly(plant: Plant, state: np.ndarray, u: np.ndarray, steps: int, air: float = 0.0) -> np.ndarray:
    for _ in range(steps):
        state = plant.step(state, u, np.full((*u.shape[:2], 2), air), None)
    return state


@pytest.mark.parametrize("vehicle", ["crazyflie", "hummingbird"])
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
    assert state[1, 2, 5] == pytest.approx(0.45, abs=0.1)
    still = state[[0, 1, 1], [2, 0, 1]]
    np.testing.assert_allclose(still[:, :3], start[[0, 1, 1], [2, 0, 1], :3], atol=3e-2)


def test_wind_drags_the_rotors():
    plant, start = placed("hummingbird")
    state = fly(plant, start, np.zeros((2, 3, 4)), 100, air=1.0)
    # Identified drag of 0.49 1/s against air of 1 m/s: 1 - exp(-0.49) after a second, less what the tilt takes away
    np.testing.assert_allclose(state[..., 3:5], 0.35, atol=0.1)


def test_dropped_swarms_and_forks_do_not_touch_the_others():
    plant, start = placed()
    u = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 3, 4))
    both = fly(plant, start, u, 20)
    alone, start = placed()
    alone.keep(np.array([False, True]))
    np.testing.assert_allclose(fly(alone, start[1:], u[1:], 20), both[1:], rtol=0, atol=1e-12)
    fork = plant.fork()
    there, here = fly(fork, both, u, 10), fly(plant, both, u, 10)
    assert np.array_equal(there, here)
    plant.keep(np.array([False, False]))
    assert plant.step(both[:0], u[:0], np.zeros((0, 3, 2)), None).shape == (0, 3, 9)


def test_a_swarm_that_begins_anew_has_forgotten_the_last_episode():
    plant, start = placed()
    u = np.full((2, 3, 4), 0.2)
    first = fly(plant, start, u, 10)
    for k in range(2):
        plant.place(k, start[k])
    assert np.array_equal(fly(plant, start, u, 10), first)


def test_swarms_fly_in_it_and_full_communication_keeps_them_apart():
    config = make_config("flight", plant="rotorpy:hummingbird", quadrotor="hummingbird")
    rows = {}
    for policy in ("none", "full"):
        condition = Condition(policy, "symmetric_swap", config, solver="rti", linger=5)
        rows[policy] = run_episodes(condition, range(first_episode(0), first_episode(0) + 5))
    assert not any(row["collided"] for row in rows["full"])
    assert sum(row["arrived"] for row in rows["full"]) >= 4
    assert min(row["min_separation_continuous"] for row in rows["full"]) > 0.62
    assert min(row["min_separation_continuous"] for row in rows["none"]) < 0.6
