"""``sb3-maddpg train --seeds 0-9``: one training per seed, each in its own process, several at a time."""

from __future__ import annotations

import argparse
import contextlib
import re
import time
from dataclasses import dataclass
from pathlib import Path

from sb3_maddpg.checkpoints.commit import locked, newest
from sb3_maddpg.cli.command_files import COMMAND_FILE, read_command, resumable, write_command
from sb3_maddpg.cli.experiment import CHECKPOINTS
from sb3_maddpg.cli.processes import SECONDS_TO_END, run_all
from sb3_maddpg.utils import shown

MOST_SEEDS = 10_000  # of a range


def parse_seeds(text: str) -> list[int]:
    """
    Parse a list of seeds.

    :param text: numbers and ranges, such as ``0-4,7``
    :return: the seeds without duplicates
    :raises ValueError: if the text is anything else
    """
    seeds: dict[int, None] = {}
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise ValueError(f"--seeds {shown(text)}: write numbers and ranges, such as 0-4 or 0,3,7-9.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last - first >= MOST_SEEDS:
            raise ValueError(f"--seeds {shown(text)}: a range holds at most {MOST_SEEDS} seeds.")
        seeds |= dict.fromkeys(range(first, last + 1))
    return list(seeds)


def train_seeds(
    argv: list[str],
    seeds: list[int],
    jobs: int,
    log_folder: str,
    every: int | None = None,
    engine: str = "local",
    address: str | None = None,
) -> int:
    """
    Train once per seed. Killed trainings are resumed, and finished ones are skipped.

    :param argv: arguments of ``train``, without seed, log folder and checkpoints
    :param seeds: see ``parse_seeds``
    :param jobs: number of trainings at a time
    :param log_folder: folder of the runs; the output of each training goes to ``seed_K.log`` there
    :param every: number of steps between checkpoints, None for checkpoints by time
    :param engine: see ``run_all``
    :param address: see ``run_all``
    :return: exit status of the first training that failed, 0 if none did
    :raises ValueError: if arguments are invalid
    """
    options = argparse.ArgumentParser(add_help=False)  # rl_zoo3 accepts abbreviations
    options.add_argument("--seed")
    if options.parse_known_args(argv)[0].seed is not None:
        raise ValueError("--seeds and --seed exclude each other: pass only one of them.")
    folder = Path(log_folder)
    folder.mkdir(parents=True, exist_ok=True)
    return run_all([_Training(seed, argv, folder, every) for seed in seeds], jobs, engine, address)


@dataclass(frozen=True)
class _Training:
    """A training, which continues the run of an earlier command if that was killed."""

    seed: int
    argv: list[str]
    log_folder: Path
    every: int | None

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
        argv = [*self.argv, "--seed", str(self.seed), "--log-folder", str(self.log_folder)]
        run = self._run_of(resumable(argv))
        if run is not None:
            _wait_until_free(run / CHECKPOINTS)
            if newest(run / CHECKPOINTS) is not None:
                command = read_command(run)
                if command.folder is None:  # started elsewhere, but the user gives the same command here
                    write_command(run, command.argv, command.every)
                return ["train", "--resume", str(run)], f"resumes {run}"
            if not (run / CHECKPOINTS).exists() and any(run.glob("*.zip")):
                return [], f"finished before, {run}"
        every = [] if self.every is None else ["--checkpoint-every", str(self.every)]
        return ["train", *argv, *every], "starts"

    def _run_of(self, argv: list[str]) -> Path | None:
        """:return: the newest run that this command started, if there is one"""
        found = []
        for path in self.log_folder.glob(f"*/*/{COMMAND_FILE}"):
            with contextlib.suppress(ValueError):
                if resumable(read_command(path.parent).argv) == argv:
                    found.append(path.parent)
        return max(found, key=lambda run: (run / COMMAND_FILE).stat().st_mtime, default=None)


def _wait_until_free(folder: Path) -> None:
    """Wait for a process whose parent was killed to write its last checkpoint and end."""
    end = time.monotonic() + SECONDS_TO_END
    while folder.exists() and time.monotonic() < end:
        try:
            with locked(folder):
                return
        except ValueError:
            time.sleep(0.1)
