"""Comparison of policies over the same held-out episodes, optionally in several processes."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import pickle
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from quad_swarm.errors import shown
from quad_swarm.evaluation.flight import Condition, checked_condition, first_episode, run_episodes
from quad_swarm.evaluation.inference import wilson_interval
from quad_swarm.evaluation.policies import is_model, make_policy, name_of
from quad_swarm.jobs import Journal, make_executor
from quad_swarm.jobs.cluster import other_code
from quad_swarm.jobs.journal import differences, origin
from quad_swarm.planner import PROBLEMS, SOLVERS
from quad_swarm.plants.base import MODEL, SIMULATORS, PlantDied, parse_plant, simulator_of
from quad_swarm.task.episode_statistics import exchange_bytes, is_row
from quad_swarm.task.observation import GROUPS
from quad_swarm.task.rules import RULES
from quad_swarm.world.kinds import make_planner_of
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.scenarios import SCENARIOS

# Episodes per piece; fixed, so that batches and results do not depend on the number of processes
_CHUNK = 250
# Number of attempts before a piece is considered the cause of the deaths of a simulator's process
_ATTEMPTS = 3
# Depths of collisions that are counted separately (m), since many collisions beyond the tolerance of 1 mm are grazes
DEPTHS = {"1cm": 0.01, "3cm": 0.03}

# Quantiles of the smallest separation in an episode at any time
QUANTILES = (0.001, 0.01, 0.05, 0.25, 0.5)

Rows = list[dict[str, float]]


def summarise(rows: Sequence[Mapping[str, float]], config: SwarmConfig) -> dict[str, Any]:
    """Summarise the statistics of episodes.

    :param rows: statistics of each episode, see `run_episodes`
    :param config: the world
    :return: number of episodes, number of episodes with a collision and the 95 % interval of the rate;
        ``collisions_at_steps``, ``collisions_1cm`` and ``collisions_3cm`` (deeper than that) at steps, and the same
        with ``_continuous`` at any time; requests until arrival or collision: in total, per step, as a fraction of the
        possible requests, and the maximum in a step; bytes that a robot sends per second (requests and answers); mean
        age of believed plans (s); requests in all steps flown; number of arrivals, and mean steps and path length (m)
        until arrival; smallest separation, and quantiles over episodes of the smallest separation at any time (m);
        number of plans without a successful solve, and time of the planner per plan (us). In worlds with obstacles also
        ``obstacle_collisions``, number of episodes that a collision with an obstacle ended, and
        ``min_obstacle_distance`` (m)
    """
    n, dt = config.n_robots, config.planner.dt
    figures = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    arrived = figures["arrived"].astype(bool)
    collisions = int(figures["collided"].sum())
    low, high = wilson_interval(collisions, len(rows))
    requests = int(figures["requests"].sum())
    possible = int(figures["possible_requests"].sum())
    share = requests / max(possible, 1)
    deeper = {
        f"collisions{suffix}_{name}": int((figures[f"min_separation{suffix}"] < 2 * config.radius - depth).sum())
        for suffix in ("", "_continuous")
        for name, depth in DEPTHS.items()
    }
    return {
        "episodes": len(rows),
        "collisions": collisions,
        "collision_low": low,
        "collision_high": high,
        "collisions_at_steps": int(figures["collided_at_steps"].sum()),
        "collisions_continuous": int(figures["collided_continuous"].sum()),
        **deeper,
        "requests": requests,
        "possible_requests": possible,
        "requests_per_step": float(figures["requests"].sum() / figures["steps_counted"].sum()),
        "request_share": share,
        "reduction": 1.0 - share,
        "peak_requests": int(figures["peak_requests"].max()),
        "bytes_per_second": exchange_bytes(config) * requests / (float(figures["steps_counted"].sum()) * n * dt),
        "plan_age": dt * float(figures["plan_ages"].sum() / max(figures["plans_used"].sum(), 1)),
        "requests_flown": int(figures["requests_flown"].sum()),
        "steps_flown": int(figures["steps"].sum()),
        "arrived": int(arrived.sum()),
        "steps_to_arrival": float(figures["steps_counted"][arrived].mean()) if arrived.any() else None,
        "min_separation": float(figures["min_separation"].min()),
        "min_separation_continuous": float(figures["min_separation_continuous"].min()),
        "min_separation_quantiles": {
            f"{quantile:g}": float(np.quantile(figures["min_separation_continuous"], quantile))
            for quantile in QUANTILES
        },
        "path_length": float(figures["path_length"][arrived].mean()) if arrived.any() else None,
        "planner_failures": int(figures["planner_failures"].sum()),
        "solve_us": float(1e6 * figures["solve_seconds"].sum() / (figures["steps"].sum() * n)),
        **(_among_obstacles(figures) if "collided_obstacle" in figures else {}),
    }


def _among_obstacles(figures: Mapping[str, np.ndarray]) -> dict[str, Any]:
    distance = float(figures["min_obstacle_distance"].min())
    return {
        "obstacle_collisions": int(figures["collided_obstacle"].sum()),
        "min_obstacle_distance": distance if np.isfinite(distance) else None,
    }


def evaluate(
    conditions: Sequence[Condition],
    episodes: int,
    seed: int = 0,
    jobs: int = 1,
    journal: Path | None = None,
    executor: Executor | None = None,
) -> list[dict[str, Any]]:
    """Evaluate conditions over the same held-out episodes.

    :param conditions: policies in scenarios; duplicates are flown once
    :param episodes: number of episodes per condition
    :param seed: index of the set of held-out episodes
    :param jobs: number of processes
    :param journal: folder that keeps finished pieces until all are finished, see `Journal`; None keeps none
    :param executor: executor that flies the pieces, such as a `Cluster`; by default ``jobs`` processes of this machine
    :return: one row per condition, see `summarise` and, if full communication is among the policies, `lost_against`
    """
    return summarise_all(fly_all(conditions, episodes, seed, jobs, journal=journal, executor=executor))


def summarise_all(flown: Mapping[Condition, Rows]) -> list[dict[str, Any]]:
    """Return the rows of `evaluate`.

    :param flown: statistics of the episodes of each condition, see `fly_all`
    """
    table = []
    for condition, rows in flown.items():
        row = {"policy": name_of(condition.policy), "scenario": condition.scenario, **summarise(rows, condition.config)}
        full = flown.get(replace(condition, policy="full"))
        table.append(
            row | (lost_against(full, rows, condition.config) if full else {}) | {"n_robots": condition.config.n_robots}
        )
    return table


def lost_against(full: Rows, rows: Rows, config: SwarmConfig) -> dict[str, float | None]:
    """Compute what a policy loses compared with full communication, over the episodes in which both arrive.

    :param full: statistics of episodes with full communication
    :param rows: statistics of the same episodes with the policy
    :param config: the world
    :return: mean ``time_lost`` (s) and ``path_lost`` (m), None without such episodes
    """
    both = [(a, b) for a, b in zip(full, rows, strict=True) if a["arrived"] and b["arrived"]]
    if not both:
        return {"time_lost": None, "path_lost": None}
    steps, path = (float(np.mean([b[name] - a[name] for a, b in both])) for name in ("steps_counted", "path_length"))
    return {"time_lost": config.planner.dt * steps, "path_lost": path}


def fly_all(
    conditions: Sequence[Condition],
    episodes: int,
    seed: int = 0,
    jobs: int = 1,
    skip: int = 0,
    journal: Path | None = None,
    executor: Executor | None = None,
) -> dict[Condition, Rows]:
    """Fly held-out episodes and return the statistics of each episode, see `EpisodeStatistics`. The other arguments are
    those of `evaluate`.

    :param skip: number of the first ``episodes`` to leave out, which have been flown before
    :raises ValueError: if there are no episodes or processes, or a policy is invalid
    """
    if isinstance(conditions, (str, Condition)) or not isinstance(conditions, Iterable):
        raise ValueError(f"conditions={shown(conditions)}: they must be a list of conditions.")
    conditions = list(conditions)
    for condition in conditions:
        checked_condition(condition)
    for name, number in (("episodes", episodes), ("jobs", jobs)):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)):
            raise ValueError(f"{name}={shown(number)}: it must be a whole number.")
    if episodes <= skip or jobs < 1:
        raise ValueError(f"episodes={episodes} must be at least {skip + 1}, jobs={jobs} at least 1.")
    for condition in conditions:
        make_policy(condition.policy, condition.config, condition.algo)  # fail before anything is flown
    first = first_episode(seed)
    chunks = [range(first + k, first + min(k + _CHUNK, episodes)) for k in range(skip, episodes, _CHUNK)]
    flown: dict[Condition, Rows] = {condition: [] for condition in conditions}
    work = [(condition, chunk) for condition in flown for chunk in chunks]
    for (condition, _), rows in zip(work, _run_all(work, jobs, Journal(journal), executor), strict=True):
        flown[condition] += rows
    return flown


def _run_all(
    work: Sequence[tuple[Condition, range]], jobs: int, journal: Journal, executor: Executor | None
) -> list[Rows]:
    """Return the statistics of each piece of work, in order. Pieces in the journal are not flown again."""
    of_condition = {condition: _condition_key(condition) for condition in dict.fromkeys(one for one, _ in work)}
    keys = [_key(condition, episodes, of_condition[condition]) for condition, episodes in work]
    found = {k: journal.fetch(key) for k, key in enumerate(keys)}
    done: dict[int, Rows] = {k: rows for k, rows in found.items() if _fits(rows, work[k][1])}
    left = [k for k in range(len(work)) if k not in done]
    if done:
        print(f"{len(done)} of {len(work)} pieces were finished before this run.", file=sys.stderr)
    progress = tqdm(
        total=len(work), initial=len(done), unit="piece", desc="evaluate", disable=not sys.stderr.isatty(), leave=False
    )
    with progress:
        for k, rows in _fly(work, left, jobs, executor):
            journal.keep(keys[k], rows)
            done[k] = rows
            progress.update()
    journal.drop(keys)
    return [done[k] for k in range(len(work))]


def _fits(rows: Any, episodes: range) -> bool:
    """Return whether a piece of the journal holds the statistics of these episodes."""
    return isinstance(rows, list) and len(rows) == len(episodes) and all(map(is_row, rows))


def _fly(
    work: Sequence[tuple[Condition, range]], left: Sequence[int], jobs: int, executor: Executor | None
) -> Iterator[tuple[int, Rows]]:
    """Yield the index and the statistics of each piece of work when it is finished."""
    began = {condition: _origin(condition) for condition in {work[k][0] for k in left}}

    def checked(k: int, there: dict[str, str], rows: Rows) -> tuple[int, Rows]:
        if names := differences(there, began[work[k][0]]):
            raise other_code(names)
        return k, rows

    if executor is None and (jobs == 1 or len(left) < 2):
        for k in left:
            yield checked(k, *_flown(_fly_piece, *work[k]))
        return
    for condition in dict.fromkeys(work[k][0] for k in left):
        if _pickled(condition) is None:
            raise ValueError(
                f"The policy {name_of(condition.policy)} cannot be pickled and sent to other processes: choose jobs=1, "
                "or define it, or its class, in a module."
            )
    additions = _additions()
    with make_pool(jobs) if executor is None else nullcontext(executor) as pool:
        futures = {pool.submit(_informed, additions, _flown, _fly_piece, *work[k]): k for k in left}
        for future in as_completed(futures):
            yield checked(futures[future], *future.result())


def _flown(fly: Callable[..., Rows], condition: Condition, episodes: range) -> tuple[dict[str, str], Rows]:
    """Fly a piece of work, possibly on another machine, and return what made it, see `_origin`, and its rows."""
    return _origin(condition), fly(condition, episodes)


def _depends_on(condition: Condition) -> tuple[set[str], list[Path]]:
    """Return the packages and the files whose content the episodes of a condition are a function of."""
    packages, files = {"quad_swarm", *user_modules()}, []
    if (simulator := parse_plant(condition.config.plant)[0]) != MODEL:
        packages.add(simulator_of(simulator).module)
    if is_model(condition.policy):
        packages.add(condition.algo.partition(":")[0])
        files.append(Path(condition.policy.partition("@")[0]))
    elif not isinstance(condition.policy, str):
        of = condition.policy if inspect.isfunction(condition.policy) else type(condition.policy)
        packages.add(of.__module__)
    return packages - {"__main__"}, files


def _solver(condition: Condition) -> str:
    """Return the name of the solver that flies, which for "auto" depends on whether there is a compiler."""
    config = condition.config
    return make_planner_of(config, 0, condition.solver).solver.name


def _origin(condition: Condition) -> dict[str, str]:
    """Return the code, files and solver that the episodes of a condition are a function of, by name, see `origin`."""
    return {**origin(*_depends_on(condition)), "solver (is there a C++ compiler?)": _solver(condition)}


def _informed(additions: Sequence[bytes], function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in another process, which gets what the registries hold in this one."""
    for entry in additions:
        with contextlib.suppress(Exception):  # whatever does not exist there: it is missed only if it is used
            number, name, value = pickle.loads(entry)
            _REGISTRIES[number][name] = value
    return function(*arguments)


def _fly_piece(condition: Condition, episodes: range) -> Rows:
    """Fly a piece of work. A simulator whose process dies costs only the piece, which is flown again.

    :raises PlantError: if it dies again and again
    """
    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(PlantDied):
            return run_episodes(condition, episodes)
    return run_episodes(condition, episodes)


def _key(condition: Condition, episodes: range, of_condition: str | None = None) -> str:
    """Return the key of a piece of work.

    :param of_condition: the condition's key, which takes milliseconds to compute
    """
    digest = hashlib.sha256(f"{of_condition or _condition_key(condition)} {episodes!r}".encode())
    return digest.hexdigest()[:32]


def _condition_key(condition: Condition) -> str:
    """Return the key of a condition, which includes the content of a model's file, or of a policy that is an object."""
    what: list[Any] = [replace(condition, policy=name_of(condition.policy)), _solver(condition), _additions()]
    if not isinstance(condition.policy, str):
        what.append(_pickled(condition.policy) or uuid.uuid4())  # what cannot be kept is flown again
    return Journal.key(repr(what), *_depends_on(condition))


def make_pool(jobs: int, engine: str = "local", address: str | None = None, mixed: bool = False) -> Executor:
    """Create an executor that flies episodes. Its processes import the modules of custom scenarios and rules.

    :param jobs: number of processes
    :param engine: see `make_executor`
    :param address: see `make_executor`
    :param mixed: see `make_executor`
    """
    return make_executor(engine, jobs, user_modules(), address, mixed)


def user_modules() -> list[str]:
    """Return the modules of what users have added to the registries, which other processes import first."""
    rules = (make for make, _ in RULES.values())
    made = [*SCENARIOS.values(), *rules, *GROUPS.values(), *SOLVERS.values(), *PROBLEMS.values()]
    added = {getattr(one, "__module__", None) for one in made}
    return sorted(
        name for name in added if isinstance(name, str) and name.partition(".")[0] not in ("quad_swarm", "__main__")
    )


# What users add to by name
_REGISTRIES: tuple[dict[str, Any], ...] = (SCENARIOS, RULES, GROUPS, SOLVERS, SIMULATORS, PROBLEMS)


def _additions() -> list[bytes]:
    """Return the entries of the registries, pickled. Others, such as lambdas, come with their modules."""
    entries = [_pickled((k, *entry)) for k, registry in enumerate(_REGISTRIES) for entry in registry.items()]
    return [entry for entry in entries if entry is not None]


def _pickled(value: Any) -> bytes | None:
    try:
        return pickle.dumps(value)
    except Exception:  # whatever a foreign object raises
        return None
