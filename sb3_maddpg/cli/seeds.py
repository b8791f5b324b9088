"""``sb3-maddpg train --seeds 0-9``: one training for each seed, some at a time, each in a process of its own."""

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

_SECONDS = 60.0  # that a training has to write its last checkpoint


def parse_seeds(text: str) -> list[int]:
    """
    :param text: numbers and ranges, such as ``0-4,7``
    :return: the seeds, each once
    :raises ValueError: something else
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
    Train once for each seed. A training that was killed is resumed, one that is finished is left alone.

    :param argv: of ``train``, without seed, log folder and checkpoints
    :param seeds: see ``parse_seeds``
    :param jobs: trainings at a time
    :param log_folder: of the runs; what each training prints goes to ``seed_K.log`` there
    :param every: steps from one checkpoint to the next, None: by time
    :return: the exit status: of the first training that failed, 0 if none did
    """
    if jobs < 1:
        raise ValueError(f"--jobs {jobs} must be at least 1.")
    if "--seed" in argv:
        raise ValueError("--seeds and --seed: give one of them.")
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
    """The processes of some trainings."""

    def __init__(self, argv: list[str], log_folder: Path, every: int | None):
        self.argv, self.log_folder, self.every = argv, log_folder, every
        self._running: list[subprocess.Popen[bytes]] = []
        self._stopped = False
        self._lock = threading.Lock()

    def train(self, seed: int) -> int:
        """Train, or go on, and wait for the end."""
        argv = [*self.argv, "--seed", str(seed), "--log-folder", str(self.log_folder)]
        every = [] if self.every is None else ["--checkpoint-every", str(self.every)]
        words, what = ["train", *argv, *every], "begins"
        run = self._run_of(argv)
        if run is not None and newest(run / CHECKPOINTS) is not None:
            words, what = ["train", "--resume", str(run)], f"goes on with {run}"
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
        """End all trainings, with a checkpoint each."""
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
        """The newest run that was begun by this command."""
        found = []
        for path in self.log_folder.glob(f"*/*/{COMMAND_FILE}"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                if json.loads(path.read_text())["argv"] == argv:
                    found.append(path.parent)
        return max(found, key=lambda run: (run / COMMAND_FILE).stat().st_mtime, default=None)


def _as_exit(number: int, frame: object) -> None:
    sys.exit(128 + number)


def _end_with_parent() -> None:
    """Have Linux end this process, with a checkpoint, when its parent is gone, however it went."""
    set_parent_death_signal = 1
    ctypes.CDLL(None, use_errno=True).prctl(set_parent_death_signal, signal.SIGTERM)
    if os.getppid() == 1:
        os._exit(1)
