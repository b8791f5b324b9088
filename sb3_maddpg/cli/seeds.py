"""``sb3-maddpg train --seeds 0-9``: one training per seed, each in its own process, several at a time."""

from __future__ import annotations

import argparse
import contextlib
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from sb3_maddpg.checkpoints.commit import locked, newest
from sb3_maddpg.cli.processes import SECONDS_TO_END, run_all, without_processes
from sb3_maddpg.cli.resuming import parsed
from sb3_maddpg.cli.runs import CHECKPOINTS, name_of
from sb3_maddpg.cli.safety import as_yaml, read_settings
from sb3_maddpg.cli.terminal import aligned
from sb3_maddpg.common.evaluation import mean_interval
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import shown

MOST_SEEDS = 10_000  # of a range
# Options that do not change a training
_ASIDE = (
    "resume",
    "seeds",
    "jobs",
    "engine",
    "address",
    "log_folder",
    "debug",
    "quiet",
    "trust",
    "command",
    "progress",
)


def parse_seeds(text: str) -> list[int]:
    """
    Parse a list of seeds.

    :param text: numbers and ranges, such as ``0-4,7``
    :return: the seeds without duplicates
    :raises InvalidArgumentError: if the text is anything else
    """
    seeds: dict[int, None] = {}
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise InvalidArgumentError(f"--seeds {shown(text)}: write numbers and ranges, such as 0-4 or 0,3,7-9.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last - first >= MOST_SEEDS:
            raise InvalidArgumentError(f"--seeds {shown(text)}: a range holds at most {MOST_SEEDS} seeds.")
        seeds |= dict.fromkeys(range(first, last + 1))
    return list(seeds)


def train_seeds(args: argparse.Namespace, words: list[str], seeds: list[int], jobs: int) -> int:
    """
    Train once per seed. Killed trainings are resumed, and finished ones are skipped.

    :param args: options of ``train``
    :param words: the options as they were given
    :param seeds: see ``parse_seeds``
    :param jobs: number of trainings at a time; the output of each goes to ``seed_K.log`` in the folder of the runs
    :return: exit status of the first training that failed, 0 if none did
    :raises InvalidArgumentError: if arguments are invalid
    """
    if args.seed != -1:
        raise InvalidArgumentError("--seeds and --seed exclude each other: pass only one of them.")
    folder = Path(args.log_folder)
    folder.mkdir(parents=True, exist_ok=True)
    words = without_processes(words)
    trainings = [_Training(seed, words, folder) for seed in seeds]
    status = run_all(trainings, jobs, args.engine, args.address)
    if curves := {one.seed: curve for one in trainings if (curve := one.curve()) is not None}:
        print(summary(curves))
        if find_spec("matplotlib") is not None:
            from sb3_maddpg.cli.plots import draw_seeds

            path = folder / f"{args.algo}-{name_of(args.env)}-seeds.png"
            named = {f"seed {seed}": (curve.steps, curve.returns) for seed, curve in curves.items()}
            print(f"figure: {draw_seeds(named, args.env, path)}")
    return status


class Curve(NamedTuple):
    """The evaluations during a training."""

    run: Path
    """Folder of the run"""
    steps: np.ndarray
    """Numbers of steps after which the model was evaluated, (evaluations,)"""
    returns: np.ndarray
    """Mean return of each evaluation, (evaluations,)"""


def summary(curves: Mapping[int, Curve]) -> str:
    """
    :param curves: the evaluations of each seed
    :return: a table of the last and the best evaluations, with means over the seeds and their 95 % intervals
    """
    lines = [["seed", "last", "best", "after steps", "folder"]]
    for seed, (run, steps, returns) in curves.items():
        best = int(returns.argmax())
        lines.append([str(seed), f"{returns[-1]:.3f}", f"{returns[best]:.3f}", str(int(steps[best])), str(run)])
    if len(curves) > 1:
        figures = []
        for values in ([curve.returns[-1] for curve in curves.values()], [max(one.returns) for one in curves.values()]):
            mean, low, high = mean_interval(values)
            figures.append(f"{mean:.3f} [{low:.3f}, {high:.3f}]")
        lines.append(["mean", *figures, "", f"95 % intervals of {len(curves)} seeds"])
    return f"Returns in the evaluations during training:\n{aligned(lines)}"


@dataclass(frozen=True)
class _Training:
    """A training, which continues the run of an earlier command if that was killed."""

    seed: int
    words: list[str]
    log_folder: Path

    @property
    def name(self) -> str:
        return f"seed {self.seed}"

    @property
    def output(self) -> Path:
        return self.log_folder / f"seed_{self.seed}.log"

    @property
    def environment(self) -> dict[str, str]:
        return {}

    def command(self) -> tuple[list[str], str]:
        words = [*self.words, "--seed", str(self.seed)]
        run = self._run_of(parsed(words))
        if run is not None:
            _wait_until_free(run / CHECKPOINTS)
            if newest(run / CHECKPOINTS) is not None:
                return ["train", *words, "--resume", str(run)], f"resumes {run}"
            if not (run / CHECKPOINTS).exists() and any(run.glob("*.zip")):
                return [], f"finished before, {run}"
        return ["train", *words], "starts"

    def curve(self) -> Curve | None:
        """:return: the evaluations of this training, None if there are none"""
        run = self._run_of(parsed([*self.words, "--seed", str(self.seed)]))
        path = None if run is None else run / "evaluations.npz"
        if run is None or path is None or not path.is_file():
            return None
        with np.load(path, allow_pickle=False) as file:
            steps, results = file["timesteps"], file["results"]
        return Curve(run, steps, results.mean(axis=1)) if len(steps) else None

    def _run_of(self, args: argparse.Namespace) -> Path | None:
        """:return: the newest run that these options started, if there is one"""
        expected, found = _compared(as_yaml(vars(args))), []
        for path in self.log_folder.glob(f"{args.algo}/*/*/args.yml"):
            with contextlib.suppress(OSError, ValueError, yaml.YAMLError):
                if _compared(read_settings(path)) == expected:
                    found.append((path.stat().st_mtime, path.parent.parent))
        return max(found)[1] if found else None


def _compared(options: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in options.items() if key not in _ASIDE and value not in (None, [], "", {})}


def _wait_until_free(folder: Path) -> None:
    """Wait for a process whose parent was killed to write its last checkpoint and end."""
    end = time.monotonic() + SECONDS_TO_END
    while folder.exists() and time.monotonic() < end:
        try:
            with locked(folder):
                return
        except ValueError:
            time.sleep(0.1)
