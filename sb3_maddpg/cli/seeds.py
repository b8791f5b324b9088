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
from typing import Any

from sb3_maddpg.checkpoints import locked, newest
from sb3_maddpg.cli.experiment import CHECKPOINTS, COMMAND_FILE
from sb3_maddpg.ray_cluster import connect
from sb3_maddpg.utils import shown, suggest

ENGINES = ("local", "ray")
_SECONDS = 60.0  # time for a training to write its last checkpoint
_RETRIES = 3  # number of times that Ray restarts a training whose machine was lost


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
    :param engine: "local" for processes of this machine, "ray" for those of a cluster whose machines share the files
    :param address: address of the cluster, see ``connect``; its size then decides how many trainings run at a time
    :return: exit status of the first training that failed, 0 if none did
    :raises ValueError: if arguments are invalid
    """
    if jobs < 1:
        raise ValueError(f"--jobs {jobs} must be at least 1.")
    if engine not in ENGINES:
        raise ValueError(suggest("engine", engine, ENGINES))
    if address is not None and engine != "ray":
        raise ValueError(f"--address {address} is for --engine ray only; leave it out.")
    if "--seed" in argv:
        raise ValueError("--seeds and --seed exclude each other: pass only one of them.")
    Path(log_folder).mkdir(parents=True, exist_ok=True)
    folder = Path(log_folder)
    if engine == "ray":
        runs: _Trainings = _ClusterTrainings(argv, folder, every, address, jobs)
        jobs = len(seeds)  # each thread waits for a training, and Ray decides when it starts
    else:
        runs = _Trainings(argv, folder, every)
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
        runs.close()
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
        if run is not None:
            _wait_until_free(run / CHECKPOINTS)
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
        return _told(seed, status, output)

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

    def close(self) -> None:
        """Release what the trainings needed."""

    def _run_of(self, argv: list[str]) -> Path | None:
        """:return: the newest run that this command started, if there is one"""
        found = []
        for path in self.log_folder.glob(f"*/*/{COMMAND_FILE}"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                if json.loads(path.read_text())["argv"] == argv:
                    found.append(path.parent)
        return max(found, key=lambda run: (run / COMMAND_FILE).stat().st_mtime, default=None)


class _ClusterTrainings(_Trainings):
    """
    Trainings in the processes of a Ray cluster. A training whose process or machine is lost is resumed elsewhere.

    :param address: see ``connect``
    :param jobs: number of processes of a cluster on this machine
    """

    def __init__(self, argv: list[str], log_folder: Path, every: int | None, address: str | None, jobs: int):
        super().__init__(argv, log_folder, every)
        self._ray, self._connected = connect(address, jobs)
        self._start = self._ray.remote(_train_there).options(max_retries=_RETRIES, num_cpus=1)
        self._references: list[Any] = []

    def train(self, seed: int) -> int:
        with self._lock:
            if self._stopped:
                return 1
            reference = self._start.remote(os.getcwd(), self.argv, self.log_folder, self.every, seed)
            self._references.append(reference)
        output = self.log_folder / f"seed_{seed}.log"
        print(f"seed {seed}: waits for a process of the cluster; {output}", flush=True)
        try:
            status = self._ray.get(reference)
        except self._ray.exceptions.TaskCancelledError:
            return 1
        except self._ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[-1]
            print(f"seed {seed}: the training was lost {_RETRIES + 1} times ({reason})", flush=True)
            return 1
        return _told(seed, status, output)

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for reference in self._references:
                self._ray.cancel(reference, force=True)  # the end of its parent ends a training, with a checkpoint

    def close(self) -> None:
        if self._connected:
            self._ray.shutdown()


def _told(seed: int, status: int, output: Path) -> int:
    """Print how a training ended and return its exit status."""
    print(f"seed {seed}: {'finished' if status == 0 else f'ended with {status}, see {output}'}", flush=True)
    return abs(status)


def _train_there(directory: str, argv: list[str], log_folder: Path, every: int | None, seed: int) -> int:
    """Train in a process of a cluster, see ``_Trainings.train``."""
    os.chdir(directory)
    return _Trainings(argv, log_folder, every).train(seed)


def _wait_until_free(folder: Path) -> None:
    """Wait for a process whose parent was killed to write its last checkpoint and end."""
    end = time.monotonic() + _SECONDS
    while folder.exists() and time.monotonic() < end:
        try:
            with locked(folder):
                return
        except ValueError:
            time.sleep(0.1)


def _as_exit(number: int, frame: object) -> None:
    sys.exit(128 + number)


def _end_with_parent() -> None:
    """Make Linux end this process, which then writes a checkpoint, when its parent dies."""
    set_parent_death_signal = 1
    ctypes.CDLL(None, use_errno=True).prctl(set_parent_death_signal, signal.SIGTERM)
    if os.getppid() == 1:
        os._exit(1)
