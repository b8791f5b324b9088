"""``sb3-maddpg train --seeds 0-9``: one training per seed, each in its own process, several at a time."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from sb3_maddpg.checkpoints import newest
from sb3_maddpg.cli.experiment import CHECKPOINTS, COMMAND_FILE
from sb3_maddpg.utils import shown

_SECONDS = 60.0  # time for a training to write its last checkpoint


def parse_seeds(text: str) -> list[int]:
    """
    Parse a list of seeds.

    :param text: numbers and ranges, such as ``0-4,7``
    :return: the seeds without duplicates
    :raises ValueError: if the text is anything else
    """
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise ValueError(f"--seeds {shown(text)}: write numbers and ranges, such as 0-4 or 0,3,7-9.")
        seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
    return list(dict.fromkeys(seeds))


def train_seeds(argv: list[str], seeds: list[int], jobs: int, log_folder: str, every: int | None = None) -> int:
    """
    Train once per seed. Killed trainings are resumed, and finished ones are skipped.

    :param argv: arguments of ``train``, without seed, log folder and checkpoints
    :param seeds: see ``parse_seeds``
    :param jobs: number of trainings at a time
    :param log_folder: folder of the runs; the output of each training goes to ``seed_K.log`` there
    :param every: number of steps between checkpoints, None for checkpoints by time
    :return: exit status of the first training that failed, 0 if none did
    :raises ValueError: if arguments are invalid
    """
    if jobs < 1:
        raise ValueError(f"--jobs {jobs} must be at least 1.")
    if "--seed" in argv:
        raise ValueError("--seeds and --seed exclude each other: pass only one of them.")
    Path(log_folder).mkdir(parents=True, exist_ok=True)
    runs = _Trainings(argv, Path(log_folder), every)
    handlers = {}
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and threading.current_thread() is threading.main_thread():
            number = getattr(signal, name)
            handlers[number] = signal.signal(number, _as_exit)
    failed = 0
    try:
        with ThreadPoolExecutor(jobs) as threads:
            futures = {threads.submit(runs.train, seed): seed for seed in seeds}
            try:
                for future in as_completed(futures):
                    failed = failed or future.result()
            except BaseException:
                runs.stop()
                raise
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return failed


class _Trainings:
    """The processes of several trainings."""

    def __init__(self, argv: list[str], log_folder: Path, every: int | None):
        self.argv, self.log_folder, self.every = argv, log_folder, every
        self._running: list[subprocess.Popen[bytes]] = []
        self._stopped = False
        self._lock = threading.Lock()

    def train(self, seed: int) -> int:
        """Start or resume a training and wait for it to end."""
        argv = [*self.argv, "--seed", str(seed), "--log-folder", str(self.log_folder)]
        every = [] if self.every is None else ["--checkpoint-every", str(self.every)]
        words, what = ["train", *argv, *every], "starts"
        run = self._run_of(argv)
        if run is not None and newest(run / CHECKPOINTS) is not None:
            words, what = ["train", "--resume", str(run)], f"resumes {run}"
        elif run is not None and not (run / CHECKPOINTS).exists() and any(run.glob("*.zip")):
            print(f"seed {seed}: finished before, {run}", flush=True)
            return 0
        output = self.log_folder / f"seed_{seed}.log"
        with self._lock, output.open("ab") as file:
            if self._stopped:
                return 1
            process = subprocess.Popen(
                [sys.executable, "-m", "sb3_maddpg", *words],
                stdout=file,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                preexec_fn=_end_with_parent if sys.platform == "linux" else None,
            )
            self._running.append(process)
        print(f"seed {seed}: {what}; {output}", flush=True)
        status = process.wait()
        print(f"seed {seed}: {'finished' if status == 0 else f'ended with {status}, see {output}'}", flush=True)
        return abs(status)

    def stop(self) -> None:
        """Stop all trainings, each with a checkpoint."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGTERM)
        end = time.monotonic() + _SECONDS
        for process in self._running:
            try:
                process.wait(max(end - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()

    def _run_of(self, argv: list[str]) -> Path | None:
        """:return: the newest run that this command started, if there is one"""
        found = []
        for path in self.log_folder.glob(f"*/*/{COMMAND_FILE}"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                if json.loads(path.read_text())["argv"] == argv:
                    found.append(path.parent)
        return max(found, key=lambda run: (run / COMMAND_FILE).stat().st_mtime, default=None)


def _as_exit(number: int, frame: object) -> None:
    sys.exit(128 + number)


def _end_with_parent() -> None:
    """Make Linux end this process, which then writes a checkpoint, when its parent dies."""
    set_parent_death_signal = 1
    ctypes.CDLL(None, use_errno=True).prctl(set_parent_death_signal, signal.SIGTERM)
    if os.getppid() == 1:
        os._exit(1)
