"""Problems for the tests of the planner: such as flights meet, and such as none would."""

import numpy as np

from quad_swarm.planner import PlannerConfig, Plans, Problems
from quad_swarm.quadrotor import QuadrotorParams

QUADROTOR = QuadrotorParams()
Call = tuple[Problems, np.ndarray, np.ndarray]


def crossing(count: int, config: PlannerConfig, n_others: int = 2, seed: int = 0) -> Problems:
    """Robots in flight with others that cross their way."""
    rng = np.random.default_rng(seed)
    x = np.zeros((count, 9))
    x[:, :3] = rng.uniform([-2, -2, 1], [2, 2, 2], (count, 3))
    x[:, 3:5] = rng.uniform(-2, 2, (count, 2))
    start = x[:, None, :3] + rng.uniform(0.8, 1.5, (count, n_others, 1)) * unit(rng.normal(size=(count, n_others, 3)))
    velocity = rng.uniform(-1.5, 1.5, (count, n_others, 3)) * [1, 1, 0.2]
    times = config.dt * np.arange(1, config.horizon + 1)
    others = start[:, :, None] + times[:, None] * velocity[:, :, None]
    return Problems(x, rng.uniform([-4, -4, 0.7], [4, 4, 2.1], (count, 3)), others)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def hover(problems: Problems, config: PlannerConfig) -> Plans:
    return Plans.hover(problems.x, config.horizon)


def scattered(config: PlannerConfig, count: int, n_others: int, seed: int = 0, scale: float = 1.0) -> Call:
    """Problems that no flight would meet: anything anywhere, at any speed, with any guess."""
    rng = np.random.default_rng(seed)
    x = scale * rng.normal(size=(count, 9)) * ([2, 2, 1] + [2] * 3 + [0.2] * 3)
    others = scale * rng.normal(size=(count, n_others, config.horizon, 3)) * 2
    limits = [config.max_tilt, config.max_tilt, config.max_climb_rate, config.max_yaw_rate]
    u_guess = rng.uniform(-1, 1, (count, config.horizon, 4)) * limits
    return Problems(x, 3 * rng.normal(size=(count, 3)), others), np.zeros((count, config.horizon + 1, 9)), u_guess


def assert_same(first, second) -> None:
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a, b)
