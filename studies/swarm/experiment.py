"""Experiments: conditions over held-out episodes, whose rows a file keeps, so that a run that was ended goes on.

Rows are JSON objects, one per line, compressed in ``studies/swarm/data``: ``pandas.read_json`` reads them. A piece of
250 episodes that was flown before a run was ended is not flown again, see `quad_swarm.jobs.journal`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import gymnasium
import numpy as np
from tqdm import tqdm

from quad_swarm.evaluation.command import add_worker_arguments
from quad_swarm.evaluation.evaluation import Rows, fly_all, summarise
from quad_swarm.evaluation.flight import Condition, fly_steps
from quad_swarm.evaluation.policies import make_policy
from quad_swarm.evaluation.rows import read_rows, write_rows
from quad_swarm.jobs.journal import default_folder
from quad_swarm.task.request_task import RequestTask, RewardConfig
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm
from sb3_maddpg import MADDPG

Item = TypeVar("Item")
Row = dict[str, Any]

# Number of steps to fly after arrival
LINGER = 10


def condition(policy: str, scenario: str, config: SwarmConfig) -> Condition:
    """Return a policy in a scenario with the settings of all results of the study."""
    return Condition(policy, scenario, config, solver="rti", linger=LINGER)


def untrained(kwargs: Mapping[str, Any], policy_kwargs: Mapping[str, Any], seed: int) -> MADDPG:
    """Return a model whose actor something other than MADDPG trains.

    :param kwargs: arguments of the environment
    :param policy_kwargs: see `PairPolicy`
    :param seed: seed of the networks
    """
    env = gymnasium.make("QuadSwarm-v0", **kwargs)
    return MADDPG(
        "PairPolicy", env, policy_kwargs=dict(policy_kwargs), buffer_size=1000, batch_size=1000, seed=seed, device="cpu"
    )


def fly_kept(conditions: Sequence[Condition], episodes: int, seed: int, skip: int = 0) -> dict[Condition, Rows]:
    """Call `fly_all` with a journal, so that a killed run continues from its finished pieces."""
    return fly_all(conditions, episodes, seed, skip=skip, journal=default_folder())


def fly_swarm(swarm: Swarm, scenario: str, policy: str, episodes: Sequence[int]) -> Rows:
    """Fly a swarm that is not the world's own, as experiments with another planning step have.

    :param swarm: as many swarms as episodes
    :param scenario: name of the scenario
    :param policy: a rule or a model's zip
    :param episodes: seeds, see `first_episode`
    """
    config = swarm.config
    decide, observation = make_policy(policy, config, "sb3_maddpg:MADDPG")
    sampler = ScenarioSampler(scenario, config.n_robots, config.space, config)
    task = RequestTask(swarm, sampler, RewardConfig(), None, observation, end_at_collision=False)
    for k, seed in enumerate(episodes):
        task.reset(k, np.random.default_rng(seed))
    rows: dict[int, dict[str, Any]] = {}
    for step in fly_steps(decide, task, [np.random.default_rng([seed, 1]) for seed in episodes], LINGER):
        rows |= {int(step.episodes[k]): task.statistics.row(int(k)) for k in np.flatnonzero(step.over)}
    return [rows[k] for k in range(len(episodes))]


class Job(NamedTuple):
    """Policies in a scenario that fly the same episodes.

    :param keys: common entries of all rows
    :param policies: the policies; what is named twice flies once
    :param scenario: name of the scenario
    :param config: the world
    :param episodes: number of episodes
    :param seed: index of the set of episodes
    """

    keys: Row
    policies: Sequence[str]
    scenario: str
    config: SwarmConfig
    episodes: int = 0
    seed: int = 0

    def fly(self, linger: int | None = LINGER) -> dict[str, Rows]:
        """Return the statistics of each policy's episodes.

        :param linger: number of steps to fly after arrival, None for whole episodes
        """
        conditions = [replace(condition(policy, self.scenario, self.config), linger=linger) for policy in self.policies]
        return {one.policy: rows for one, rows in fly_kept(conditions, self.episodes, self.seed).items()}

    def row(self, policy: str, rows: Rows) -> Row:
        """Return a policy's row."""
        return (
            self.keys | {"scenario": self.scenario, "policy": policy, "set": self.seed} | summarise(rows, self.config)
        )


def summaries(job: Job, linger: int | None = LINGER) -> list[Row]:
    """Fly a job and return a row per policy."""
    return [job.row(policy, rows) for policy, rows in job.fly(linger).items()]


class Experiment:
    """Rows in a file, by the entries that say of what they are.

    :param path: the file; None keeps the rows in memory
    :param keys: the entries
    """

    def __init__(self, path: Path | None, *keys: str):
        self.path, self.keys = path, keys
        self._rows: list[Row] = []

    def rows(self) -> list[Row]:
        """Return all rows."""
        return self._rows if self.path is None else read_rows(self.path)

    def keep(self, rows: Sequence[Row], *keys: str) -> None:
        """Replace the rows of the same conditions. All others stay.

        :param keys: other entries that say of what these rows are
        """
        entries = keys or self.keys
        new = {identity(row, entries) for row in rows}
        self._rows = [*(row for row in self.rows() if identity(row, entries) not in new), *rows]
        if self.path is not None:
            write_rows(self.path, self._rows)

    def run(self, pool: Executor, what: str, fly: Callable[..., list[Row]], work: Sequence[tuple[Any, ...]]) -> None:
        """Call a function with each of the arguments in the processes of a pool, and keep its rows as they come."""
        for rows in progress(pool.map(fly, *zip(*work, strict=True)) if work else (), what, len(work)):
            self.keep(rows)

    def missing(self, jobs: Iterable[Job]) -> list[Job]:
        """Return the jobs with policies that have not flown as many of the same episodes."""
        rows = self.rows()

        def flown(job: Job, policy: str) -> bool:
            of = job.keys | {"scenario": job.scenario, "policy": policy}
            how = {"episodes": job.episodes, "set": job.seed}  # which some rows do not say
            return any(
                all(row.get(k) == v for k, v in of.items()) and all(row.get(k, v) == v for k, v in how.items())
                for row in rows
            )

        return [job for job in jobs if not all(flown(job, policy) for policy in job.policies)]


def identity(row: Mapping[str, Any], keys: Iterable[str]) -> str:
    """Return the entries that say of what a row is."""
    return json.dumps([row.get(key) for key in keys], sort_keys=True)


def progress(items: Iterable[Item], what: str, total: int) -> Iterable[Item]:
    """Show a progress bar in a terminal."""
    return tqdm(items, what, total, unit="job", disable=not sys.stderr.isatty(), leave=False)


def known_rows(path: Path) -> list[Row]:
    """Return the rows of a table, from a cache if its file has not changed. Do not modify them."""
    if not path.exists():
        return []
    stat = path.stat()
    return _parsed(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=8)
def _parsed(path: Path, modified: int, size: int) -> list[Row]:
    return read_rows(path)


def absolute_path(text: str) -> Path:
    """Convert an argument of the command line to an absolute path, so that the working directory may change."""
    return Path(text).resolve()


def command_line(doc: str | None, quick: str = "") -> argparse.ArgumentParser:
    """Return a parser with the options that choose the processes.

    :param doc: docstring of the module
    :param quick: what ``--quick`` does, if there is such an option
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if quick:
        parser.add_argument("--quick", action="store_true", help=f"{quick}, to check that everything runs")
    add_worker_arguments(parser, jobs=os.cpu_count() or 1)
    return parser
