"""Scenarios without any training or tuning."""

from __future__ import annotations

import numpy as np

from quad_swarm.world.scenarios import Scenario, ScenarioSpace, random, symmetric_swap


def half_swap(n_robots: int, space: ScenarioSpace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mixture of scenarios in an episode: half of the robots fly `symmetric_swap`, the others `random`."""
    half = n_robots // 2
    while True:
        swapping, own = symmetric_swap(half, space, rng), random(n_robots - half, space, rng)
        starts, goals = (np.concatenate(both) for both in zip(swapping, own, strict=True))
        if min(apart(starts), apart(goals)) >= space.spacing:
            return starts, goals


def two_streams(n_robots: int, space: ScenarioSpace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two rows of robots that fly abreast at one height and cross at a right angle, with slight displacements."""
    half, along = n_robots // 2, space.sector_radius[1]
    abreast = [
        (k - (m - 1) / 2) * (space.spacing + 2 * space.circle_jitter) for m in (half, n_robots - half) for k in range(m)
    ]
    starts = np.column_stack([np.full(n_robots, -along), abreast, np.full(n_robots, rng.uniform(*space.heights))])
    goals = starts * (-1, 1, 1)
    for points in (starts, goals):
        points[half:, :2] = points[half:, 1::-1]
        points += rng.uniform(-space.circle_jitter, space.circle_jitter, size=points.shape)
    return starts, goals


def apart(points: np.ndarray) -> float:
    """Return the distance of the two closest points (m)."""
    return float((np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(len(points), np.inf))).min())


UNSEEN: dict[str, Scenario] = {"half_swap": half_swap, "two_streams": two_streams}
