"""Flying a plant by itself, and what every simulator's vehicle has to do."""

import numpy as np
import pytest

from quad_swarm.evaluation.flight import Condition, first_episode, run_episodes
from quad_swarm.plants import Plant, make_plant
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.presets import make_config

DT = 0.01  # s


def placed(name: str, n_swarms: int = 2, n_robots: int = 3) -> tuple[Plant, np.ndarray]:
    """A plant whose robots hang somewhere, and their states."""
    plant = make_plant(name, QuadrotorParams(), DT, n_swarms, n_robots)
    state = np.zeros((n_swarms, n_robots, 9))
    state[..., :3] = np.random.default_rng(0).uniform(-2, 2, (n_swarms, n_robots, 3))
    for k in range(n_swarms):
        plant.place(k, state[k])
    return plant, state


def fly(plant: Plant, state: np.ndarray, u: np.ndarray, steps: int, air: float = 0.0) -> np.ndarray:
    """States after some sub-steps with the same inputs, in air that moves along x and y."""
    for _ in range(steps):
        state = plant.step(state, u, np.full((*u.shape[:2], 2), air), None)
    return state


def check_hovers_tilts_and_climbs(name: str, climb: float) -> None:
    """
    :param climb: rate that comes of a command of 0.5 m/s (m/s)
    """
    plant, start = placed(name)
    u = np.zeros((2, 3, 4))
    hovering = fly(plant, start, u, 50)
    np.testing.assert_allclose(hovering, start, atol=2e-2)
    u[0, 0, 0], u[0, 1, 1], u[1, 2, 2] = 0.2, -0.2, 0.5
    state = fly(plant, hovering, u, 100)
    assert state[0, 0, 6] == pytest.approx(0.2, abs=0.03)
    assert state[0, 0, 4] < -0.8, "a positive roll accelerates along -y, as in our model"
    assert state[0, 1, 7] == pytest.approx(-0.2, abs=0.03)
    assert state[0, 1, 3] < -0.8
    assert state[1, 2, 5] == pytest.approx(climb, abs=0.1)
    still = state[[0, 1, 1], [2, 0, 1]]
    np.testing.assert_allclose(still[:, :3], start[[0, 1, 1], [2, 0, 1], :3], atol=3e-2)


def check_full_communication_keeps_apart(name: str, vehicle: str, episodes: int) -> None:
    """
    :param vehicle: what the planner takes it for
    """
    config = make_config("flight", plant=name, quadrotor=vehicle)
    rows = {}
    for policy in ("none", "full"):
        condition = Condition(policy, "symmetric_swap", config, solver="rti", linger=5)
        rows[policy] = run_episodes(condition, range(first_episode(0), first_episode(0) + episodes))
    assert not any(row["collided"] for row in rows["full"])
    assert sum(row["arrived"] for row in rows["full"]) >= episodes - 1
    assert min(row["min_separation_continuous"] for row in rows["full"]) > 0.62
    assert min(row["min_separation_continuous"] for row in rows["none"]) < 0.6
