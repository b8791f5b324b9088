"""Fly policies over the same held-out episodes and count what happens.

A policy is a rule (`communication.RULES`) or the zip of a trained model, loaded by the class that ``algo`` names;
``MODEL.zip@0.3`` acts with the threshold 0.3 instead of its own.
"""

from __future__ import annotations

import functools
import importlib
import math
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from tqdm import tqdm

from quad_swarm.task.observation import Observation, PaperObservation, make_observation
from quad_swarm.task.request_task import RequestTask, RewardConfig
from quad_swarm.task.rules import RULES, parse_rule
from quad_swarm.task.view import View
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.scenarios import SCENARIOS, ScenarioSampler
from quad_swarm.world.swarm import Swarm

Requests = Callable[[RequestTask, list[np.random.Generator]], np.ndarray]

# Arguments of the environment that shape what a model sees: they are the model's, everything else is the evaluation's.
OBSERVATION_ARGUMENTS = ("observation", "scale_observation")
# Held-out episodes begin here; training seeds count from 0.
_FIRST_SEED = 10**9
# Fixed, so that neither the batches nor the results depend on the number of processes.
_CHUNK = 250


@dataclass(frozen=True)
class Cell:
    """One policy in one scenario.

    :param policy: rule or path of a model's zip, as given on the command line
    :param scenario: a name of `SCENARIOS`
    :param config: the world
    :param max_steps: time limit (steps)
    :param algo: ``module:Class`` that loads models
    :param solver: see `make_planner`
    :param linger: steps that are flown on after all have arrived; None: until the time limit
    """

    policy: str
    scenario: str
    config: SwarmConfig
    max_steps: int
    algo: str
    solver: str
    linger: int | None = None


def is_model(policy: str) -> bool:
    """Whether a policy's text names a model's file instead of a rule."""
    return policy.partition("@")[0].endswith(".zip") or os.sep in policy


def short_name(policy: str) -> str:
    """A rule as it is written, a model by its file's name, or its folder's where many files are called model.zip."""
    if not is_model(policy):
        return policy
    path, at, threshold = policy.partition("@")
    name = Path(path).name
    return (Path(path).parent.name or name if name == "model.zip" else name) + at + threshold


@functools.lru_cache(maxsize=4)
def load_model(policy: str, algo: str) -> Any:
    """A trained model.

    :param policy: its zip, with a threshold where that is not to be its own: ``MODEL.zip@0.3``
    :param algo: ``module:Class`` with a ``load(path, device=...)`` as in Stable-Baselines3, and a ``set_threshold`` if
        one is given
    :raises FileNotFoundError: no such file
    :raises ValueError: the class does not exist, or it cannot read the file, or the threshold is none
    """
    path, at, threshold = policy.partition("@")
    if not Path(path).is_file():
        raise FileNotFoundError(f"No model at {path!r}: train one first, or give the zip's full path.")
    module_name, _, class_name = algo.partition(":")
    try:
        loader = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"--algo {algo!r} is no importable module:Class ({error}).") from error
    try:
        model = loader.load(path, device="cpu")
    except Exception as error:  # whatever the loader raises for a damaged or foreign file
        raise ValueError(
            f"{path} cannot be loaded by {algo} ({type(error).__name__}: {error}). "
            "Is the file complete, and was it saved by that class?"
        ) from error
    if at:
        if not hasattr(model, "set_threshold"):
            raise ValueError(f"{policy}: {algo} has no threshold; leave out '@{threshold}'.")
        model.set_threshold(_number(threshold, policy))
    return model


def _number(text: str, policy: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{policy}: the threshold {text!r} is no number; write MODEL.zip@0.3.") from None


def make_policy(cell: Cell) -> tuple[Requests, Observation]:
    """The policy of a cell, and the observation that it needs.

    :raises ValueError: unknown rule, or a model that was trained for another number of robots or another space
    """
    if not is_model(cell.policy):
        try:
            rule = parse_rule(cell.policy)
        except ValueError as error:
            raise ValueError(f"{error} A model is given by the path of its .zip.") from None
        return (lambda task, rngs: rule(View(task.swarm, rngs))), PaperObservation(cell.config.n_robots)

    return policy_of(load_model(cell.policy, cell.algo), cell.policy, cell.config)


def policy_of(model: Any, name: str, config: SwarmConfig) -> tuple[Requests, Observation]:
    """A model as a policy, and the observation that it needs.

    :param name: what messages call it
    :raises ValueError: it was trained for another number of robots or another space
    """
    spec = getattr(model, "env_spec", None) or {}
    arguments = {k: v for k, v in spec.get("kwargs", {}).items() if k in OBSERVATION_ARGUMENTS}
    n = config.n_robots
    seen = make_observation(config, **arguments, critics=False)
    expected, trained = (n, seen.size), tuple(model.observation_space.shape)
    predictor = model
    if trained != expected:
        if not hasattr(model, "policy_for") or not hasattr(model.policy, "observation_layout"):
            robots = f"{trained[0]} robots" if len(trained) == 2 else "another environment"
            raise ValueError(
                f"{name} was trained for {robots} (observation {trained}); "
                f"this world has {n} robots (observation {expected}). "
                "Choose the preset or --n-robots that it was trained with."
            )
        # A policy that looks at its neighbours one by one fits any number of them
        predictor = model.policy_for(
            spaces.Box(-np.inf, np.inf, expected, np.float32), spaces.MultiBinary(n * (n - 1)), seen.layout
        )

    def request(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        bits, _ = predictor.predict(task.observe(), deterministic=True)
        return np.asarray(bits).reshape(-1, n, n - 1) > 0.5

    return request, seen


def begin(
    cell: Cell, episodes: Sequence[int], model: Any = None
) -> tuple[Requests, RequestTask, list[np.random.Generator]]:
    """A policy, the episodes at their start, and the streams of rules that draw.

    :param cell: policy, scenario and world
    :param episodes: seeds, see `first_episode`
    :param model: flies instead of the cell's policy
    """
    config = cell.config
    policy, seen = make_policy(cell) if model is None else policy_of(model, cell.policy, config)
    task = RequestTask(
        Swarm(config, len(episodes), cell.solver),
        ScenarioSampler(cell.scenario, config.n_robots, config.space),
        RewardConfig(),
        cell.max_steps,
        seen,
    )
    for k, seed in enumerate(episodes):
        task.reset(k, np.random.default_rng(seed))
    rngs = [np.random.default_rng([seed, 1]) for seed in episodes]  # a stream of its own for rules that draw
    return policy, task, rngs


class Flight(NamedTuple):
    """One episode step by step.

    :param state: states, (T + 1, n, 9)
    :param plans: planned states as of each step, stages 0..N, (T + 1, n, N + 1, 9)
    :param goal: goals, (n, 3), world frame (m)
    :param requests: who asked whom in each step, (T, n, n - 1) bool
    :param beside: whom another rule would have asked in each step, (T, n, n - 1) bool
    """

    state: np.ndarray
    plans: np.ndarray
    goal: np.ndarray
    requests: np.ndarray
    beside: np.ndarray


def fly(cell: Cell, seed: int, number: int = 0, beside: str = "none", model: Any = None) -> Flight:
    """Fly a held-out episode of a set, step by step.

    :param cell: policy, scenario and world
    :param seed: which set
    :param number: which episode of it
    :param beside: a rule that is asked in every step too, but not heeded
    :param model: flies instead of the cell's policy
    """
    policy, task, rngs = begin(cell, [first_episode(seed) + number], model)
    rule = parse_rule(beside)
    state, plans, asked, unheeded = [task.swarm.state[0].copy()], [task.swarm.plans[0].copy()], [], []
    over, since = False, 0
    while not over:
        unheeded.append(rule(View(task.swarm, rngs)))
        asked.append(policy(task, rngs))
        outcome = task.step(asked[-1])
        state.append(task.swarm.state[0].copy())
        plans.append(task.swarm.plans[0].copy())
        since += int(task.statistics.arrived[0])
        over = bool(outcome.terminated[0] | outcome.truncated[0]) or (cell.linger is not None and since > cell.linger)
    requests, others = np.concatenate(asked), np.concatenate(unheeded)
    return Flight(np.array(state), np.array(plans), task.swarm.goal[0], requests, others)


def run_episodes(cell: Cell, episodes: Sequence[int]) -> list[dict[str, float]]:
    """Fly some episodes of a cell, all at once.

    :param cell: policy, scenario and world
    :param episodes: seeds; ``env.reset(seed=...)`` of `QuadSwarm-v0` draws the same episodes
    :return: for each episode its figures, see `EpisodeStatistics`
    """
    policy, task, rngs = begin(cell, episodes)
    index, since = np.arange(len(episodes)), np.zeros(len(episodes), dtype=int)
    rows: dict[int, dict[str, float]] = {}
    while index.size:
        outcome = task.step(policy(task, rngs))
        done = outcome.terminated | outcome.truncated
        if cell.linger is not None:
            since += task.statistics.arrived
            done |= since > cell.linger
        if done.any():
            rows |= {int(index[k]): task.statistics.row(int(k)) for k in np.flatnonzero(done)}
            task.keep(~done)
            rngs = [rng for rng, over in zip(rngs, done, strict=True) if not over]
            index, since = index[~done], since[~done]
    return [rows[k] for k in range(len(episodes))]


def first_episode(seed: int) -> int:
    """Seed of the first held-out episode of set ``seed``; the others follow it.

    :raises ValueError: the set is negative, where training's seeds are
    """
    if seed < 0:
        raise ValueError(f"seed={seed}: sets of held-out episodes are counted from 0.")
    return _FIRST_SEED + seed * 10**6


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """95 % Wilson score interval of a rate."""
    rate = successes / trials
    centre = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    return max(0.0, centre - half), min(1.0, centre + half)


class Comparison(NamedTuple):
    """Collisions of two policies over the same episodes.

    :param episodes: number of episodes
    :param only_first: episodes in which only the first policy collided
    :param only_second: episodes in which only the second did
    """

    episodes: int
    only_first: int
    only_second: int

    @classmethod
    def of(cls, first: Sequence[Mapping[str, float]], second: Sequence[Mapping[str, float]]) -> Comparison:
        """From the figures of the same episodes, see `run_episodes`."""
        pairs = [(bool(a["collided"]), bool(b["collided"])) for a, b in zip(first, second, strict=True)]
        return cls(len(pairs), sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the difference of the rates, first minus second (Agresti and Min 2005: half an episode is
        added to each of the four counts)."""
        n, b, c = self.episodes + 2, self.only_first + 0.5, self.only_second + 0.5
        half = 1.959964 / n * math.sqrt(b + c - (b - c) ** 2 / n)
        return (b - c) / n - half, (b - c) / n + half

    @property
    def p_value(self) -> float:
        """Of McNemar's exact test that both collide equally often."""
        n = self.only_first + self.only_second
        tail = sum(math.comb(n, k) for k in range(min(self.only_first, self.only_second) + 1)) / 2**n
        return min(1.0, 2 * tail)

    @property
    def as_safe(self) -> bool:
        """Whether the first policy collides at most 0.3 percentage points more often, with 97.5 % confidence."""
        return self.interval[1] < 0.003


def summarise(rows: Sequence[Mapping[str, float]], n_robots: int) -> dict[str, Any]:
    """The figures of a cell from those of its episodes; `main`'s help explains them."""
    figures = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    arrived = figures["arrived"].astype(bool)
    collisions = int(figures["collided"].sum())
    low, high = wilson_interval(collisions, len(rows))
    requests = int(figures["requests"].sum())
    possible = int(figures["steps_counted"].sum()) * n_robots * (n_robots - 1)
    share = requests / possible
    return {
        "episodes": len(rows),
        "collisions": collisions,
        "collision_low": low,
        "collision_high": high,
        "collisions_continuous": int(figures["collided_continuous"].sum()),
        "requests": requests,
        "possible_requests": possible,
        "requests_per_step": float(figures["requests"].sum() / figures["steps_counted"].sum()),
        "request_share": share,
        "reduction": 1.0 - share,
        "arrived": int(arrived.sum()),
        "steps_to_arrival": float(figures["steps_counted"][arrived].mean()) if arrived.any() else None,
        "min_separation": float(figures["min_separation"].min()),
        "min_separation_continuous": float(figures["min_separation_continuous"].min()),
        "path_length": float(figures["path_length"][arrived].mean()) if arrived.any() else None,
        "planner_failures": int(figures["planner_failures"].sum()),
        "solve_us": float(1e6 * figures["solve_seconds"].sum() / (figures["steps"].sum() * n_robots)),
    }


def evaluate(cells: Sequence[Cell], episodes: int, seed: int = 0, jobs: int = 1) -> list[dict[str, Any]]:
    """Fly ``episodes`` episodes of every cell.

    :param cells: policies in scenarios
    :param episodes: number of episodes of each cell
    :param seed: which set of held-out episodes; every cell flies the same
    :param jobs: processes
    :return: one row a cell, see `summarise`
    """
    flown = fly_all(cells, episodes, seed, jobs)
    return [
        {
            "policy": cell.policy,
            "scenario": cell.scenario,
            **summarise(rows, cell.config.n_robots),
            "n_robots": cell.config.n_robots,
        }
        for cell, rows in flown.items()
    ]


def fly_all(
    cells: Sequence[Cell], episodes: int, seed: int = 0, jobs: int = 1, skip: int = 0
) -> dict[Cell, list[dict[str, float]]]:
    """`evaluate`, episode by episode: the figures of each, see `EpisodeStatistics`.

    :param skip: leave out that many of the ``episodes``, which have been flown before
    """
    if episodes <= skip or jobs < 1:
        raise ValueError(f"episodes={episodes} must be at least {skip + 1}, jobs={jobs} at least 1.")
    for cell in cells:
        make_policy(cell)  # say what is wrong before anything is flown
    first = first_episode(seed)
    chunks = [range(first + k, first + min(k + _CHUNK, episodes)) for k in range(skip, episodes, _CHUNK)]
    work = [(cell, chunk) for cell in cells for chunk in chunks]
    flown: dict[Cell, list[dict[str, float]]] = {cell: [] for cell in cells}
    for (cell, _), rows in zip(work, _run_all(work, jobs), strict=True):
        flown[cell] += rows
    return flown


def _import_all(modules: Sequence[str]) -> None:
    for module in modules:
        importlib.import_module(module)


def _run_all(work: Sequence[tuple[Cell, range]], jobs: int) -> Iterable[list[dict[str, float]]]:
    progress = functools.partial(
        tqdm, total=len(work), unit="chunk", desc="evaluate", disable=not sys.stderr.isatty(), leave=False
    )
    if jobs == 1:
        yield from progress(run_episodes(*item) for item in work)
        return
    # Spawned, not forked: the numerical libraries behind a model hold threads. One thread each, or they fight for the
    # cores.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # They know what a user added to the scenarios and rules once the modules are imported there too.
    added = {function.__module__ for function in (*SCENARIOS.values(), *(make for make, _ in RULES.values()))}
    with ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), _import_all, (sorted(added - {"__main__"}),)
    ) as pool:
        yield from progress(pool.map(run_episodes, *zip(*work, strict=True)))
