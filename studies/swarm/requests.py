"""Which requests policies make, by what the robots observe, and which of them avoid collisions."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly, fly_steps
from quad_swarm.task.request_task import RequestTask
from quad_swarm.world.beliefs import other_indices
from studies.swarm.experiment import Job, Row, condition

Intervention = Callable[[np.ndarray, int, int], np.ndarray]


def ask(job: Job) -> list[Row]:
    """Count how often policies make requests at each value of several quantities."""
    return [row for policy in job.policies for row in requests_by_quantity(job, policy)]


def requests_by_quantity(job: Job, policy: str) -> list[Row]:
    """Return the rows of one policy."""
    seen: dict[str, list[np.ndarray]] = {}
    asked = []
    for number in range(job.episodes):
        flight = fly(condition(policy, job.scenario, job.config), job.seed, number)
        steps = min(filter(None, (flight.arrival, flight.collision, len(flight.requests))))
        distance = flight.separation[:steps]
        approach, time = (values[:steps] for values in flight.closest_approach)
        to_goal = np.linalg.norm(flight.goal - flight.pos[:steps], axis=-1)[..., None]
        crowd = (distance < 2.0).sum(-1, keepdims=True)
        for name, values in {
            "distance (m)": distance,
            "closest approach (m)": approach,
            "time to closest approach (s)": time,
            "distance to the goal (m)": to_goal,
            "others within 2 m": crowd,
        }.items():
            seen.setdefault(name, []).append(np.broadcast_to(values, distance.shape).ravel())
        asked.append(flight.requests[:steps].ravel())
    requests = np.concatenate(asked)
    rows = []
    for name, parts in seen.items():
        values = np.concatenate(parts)
        last = 4 if "(s)" in name else 5
        edges = np.arange(-0.5, job.config.n_robots) if "others" in name else np.linspace(0, last, 21)
        for low, high in pairwise(edges):
            inside = (values >= low) & (values < high)
            row = job.keys | {"policy": policy, "scenario": job.scenario, "quantity": name}
            rows.append(row | {"low": low, "high": high, "n": int(inside.sum()), "asked": int(requests[inside].sum())})
    return rows


def intervene(job: Job) -> list[Row]:
    """Repeat episodes that ended in a collision with additional requests in the last steps before it."""
    (policy,) = job.policies
    one = condition(policy, job.scenario, job.config)
    (rows,) = job.fly().values()
    crashes = [(number, *replay(one, job.seed, number)) for number, row in enumerate(rows) if row["collided"]]
    table = []
    for (who, more), steps in itertools.product(INTERVENTIONS.items(), (1, 2, 3, 4, 6, 8, 12)):
        again = [replay(one, job.seed, number, more, pair, range(end - steps, end)) for number, _, end, pair in crashes]
        keys = {"scenario": job.scenario, "policy": policy, "who": who, "last_steps": steps}
        table.append(job.keys | keys | {"n": len(again), "avoided": sum(not collided for collided, *_ in again)})
    return table


def replay(
    one: Condition,
    seed: int,
    number: int,
    more: Intervention | None = None,
    pair: tuple[int, int] = (0, 0),
    when: range = range(0),
) -> tuple[bool, int, tuple[int, int]]:
    """Fly an episode to a collision or the time limit, with additional requests in some steps.

    :param one: policy, scenario and world
    :param seed: index of the set of episodes
    :param number: index of the episode in the set
    :param more: function of the requests, (n, n) bool, and of the pair that returns the requests to make
    :param pair: the two robots that collide
    :param when: steps with additional requests
    :return: whether the episode ended in a collision, the number of steps, and the two closest robots at the end
    """
    n = one.config.n_robots
    rows, others = np.arange(n)[:, None], other_indices(n)
    policy, task, rngs = begin(one, [first_episode(seed) + number])

    def with_more(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        requests = policy(task, rngs)[..., 0]
        if int(task.statistics.steps[0]) in when and more is not None:
            asked = np.zeros((n, n), dtype=bool)
            asked[rows, others] = requests[0]
            requests = more(asked, *pair)[rows, others][None]
        return requests[..., None]

    for step in fly_steps(with_more, task, rngs):
        separation = step.outcome.report.separation[0]
        collided, end = bool(task.statistics.collided[0]), int(task.statistics.steps[0])
        if collided:
            break
    i, m = np.unravel_index(separation.argmin(), separation.shape)
    return collided, end, (int(i), int(others[i, m]))


def each_other(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """Let the two robots that are about to collide request each other's plans."""
    asked[[i, j], [j, i]] = True
    return asked


def everybody(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """Let the two robots request all plans."""
    asked[[i, j]] = True
    return asked


def both(asked: np.ndarray, i: int, j: int) -> np.ndarray:
    """Let all other robots request the plans of the two."""
    third = np.setdiff1d(np.arange(len(asked)), (i, j))
    asked[third[:, None], [i, j]] = True
    return asked


INTERVENTIONS: dict[str, Intervention] = {
    "the two ask each other": each_other,
    "the two ask everybody": everybody,
    "all others ask the two": both,
    "everybody asks everybody": lambda asked, i, j: np.ones_like(asked),
}
