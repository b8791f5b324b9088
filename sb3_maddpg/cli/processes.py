"""Commands of this program that run in processes of their own, several at a time, on this machine or a Ray cluster."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Protocol

from sb3_maddpg.cli.options import ENGINES
from sb3_maddpg.cli.terminal import tell
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import suggest
from sb3_maddpg.vec_env.ray_cluster import connect

SECONDS_TO_END = 60.0  # time for a process to write its last checkpoint
_RETRIES = 3  # number of times that Ray restarts a process whose machine was lost


class Job(Protocol):
    """A command to run. Ray pickles it."""

    @property
    def name(self) -> str:
        """Its name on the screen, such as "seed 3"."""

    @property
    def output(self) -> Path:
        """File for its output."""

    @property
    def environment(self) -> dict[str, str]:
        """Additional environment variables."""

    def command(self) -> tuple[list[str], str]:
        """:return: the arguments of ``sb3-maddpg``, none if there is nothing left to do, and what happens in words"""


def run_all(jobs: Sequence[Job], parallel: int, engine: str = "local", address: str | None = None) -> int:
    """
    Run commands to their end. SIGINT, SIGTERM and SIGHUP end all of them, unless this process ignores the signal, as
    under ``nohup``.

    :param jobs: the commands
    :param parallel: number of processes at a time
    :param engine: "local" for processes of this machine, "ray" for those of a cluster whose machines share the files;
        a command whose process or machine is lost is then repeated elsewhere
    :param address: address of the cluster, see ``connect``; its size then decides how many processes run at a time
    :return: exit status of the first command that failed, 0 if none did
    :raises InvalidArgumentError: if arguments are invalid
    """
    if parallel < 1:
        raise InvalidArgumentError(f"--jobs {parallel} must be at least 1.")
    if engine not in ENGINES:
        raise InvalidArgumentError(suggest("engine", engine, ENGINES))
    if address is not None and engine != "ray":
        raise InvalidArgumentError(f"--address {address} is for --engine ray only; leave it out.")
    runs = _ClusterProcesses(address, parallel) if engine == "ray" else _Processes()
    handlers = {}
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is None or threading.current_thread() is not threading.main_thread():
            continue
        if signal.getsignal(number) is not signal.SIG_IGN:
            handlers[number] = signal.signal(number, _as_exit)
    failed = 0
    try:
        # On a cluster, each thread waits for a command, and Ray decides when it starts
        with ThreadPoolExecutor(len(jobs) if engine == "ray" else parallel) as threads:
            futures = [threads.submit(runs.run, job) for job in jobs]
            try:
                for future in as_completed(futures):
                    failed = failed or future.result()
            except BaseException as error:
                runs.stop()
                if not isinstance(error, KeyboardInterrupt):
                    raise
                tell("Interrupted; repeat the command to continue.")
                failed = 128 + signal.SIGINT
    finally:
        runs.close()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return failed


def without_processes(words: list[str]) -> list[str]:
    """
    :param words: options of ``train``
    :return: the options without those that say how many processes run, and where
    """
    parser = argparse.ArgumentParser(add_help=False)
    for option in ("--seeds", "--seed", "--jobs", "--engine", "--address"):  # --seed is not an abbreviation of --seeds
        parser.add_argument(option)
    known, rest = parser.parse_known_args(words)
    return rest if known.seed is None else [*rest, "--seed", known.seed]


class _Processes:
    """Processes of this machine."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen[bytes]] = []
        self._stopped = False
        self._lock = threading.Lock()

    def run(self, job: Job) -> int:
        """Run a command and return its exit status."""
        words, what = job.command()
        if not words:
            tell(f"{job.name}: {what}")
            return 0
        with self._lock, job.output.open("ab") as file:
            if self._stopped:
                return 1
            process = subprocess.Popen(
                [*_launcher(), *words],
                stdout=file,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env={**os.environ, **job.environment},
                preexec_fn=_end_with_parent if sys.platform == "linux" else None,
            )
            self._running.append(process)
        tell(f"{job.name}: {what}; {job.output}")
        return _told(job, process.wait())

    def stop(self) -> None:
        """End all processes with SIGTERM, on which a training writes a checkpoint."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGTERM)
        end = time.monotonic() + SECONDS_TO_END
        for process in self._running:
            try:
                process.wait(max(end - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()

    def close(self) -> None:
        """Release what the processes needed."""


class _ClusterProcesses(_Processes):
    """
    Processes of a Ray cluster.

    :param address: see ``connect``
    :param parallel: number of processes of a cluster on this machine
    """

    def __init__(self, address: str | None, parallel: int):
        super().__init__()
        self._ray, self._connected = connect(address, parallel)
        self._start = self._ray.remote(_run_there).options(max_retries=_RETRIES, num_cpus=1)
        self._references: list[Any] = []

    def run(self, job: Job) -> int:
        with self._lock:
            if self._stopped:
                return 1
            reference = self._start.remote(os.getcwd(), job)
            self._references.append(reference)
        tell(f"{job.name}: waits for a process of the cluster; {job.output}")
        try:
            status = self._ray.get(reference)
        except self._ray.exceptions.TaskCancelledError:
            return 1
        except self._ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[-1]
            tell(f"{job.name}: lost {_RETRIES + 1} times ({reason})")
            return 1
        return _told(job, status)

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for reference in self._references:
                # Ray cannot interrupt a process that waits; the end of its parent ends a command like SIGTERM
                self._ray.cancel(reference, force=True)

    def close(self) -> None:
        if self._connected:
            self._ray.shutdown()


def _launcher() -> list[str]:
    """
    :return: the words that start ``sb3-maddpg`` in another process. ``-m`` alone would import modules from the current
        folder before all others.
    """
    if sys.version_info >= (3, 11):
        return [sys.executable, "-P", "-m", "sb3_maddpg"]
    start = "import sys; del sys.path[0]; import runpy; runpy.run_module('sb3_maddpg', run_name='__main__')"
    return [sys.executable, "-c", start]


def _run_there(directory: str, job: Job) -> int:
    """Run a command in a process of a cluster."""
    os.chdir(directory)
    return _Processes().run(job)


def _told(job: Job, status: int) -> int:
    """Print how a command ended and return its exit status."""
    tell(f"{job.name}: {'finished' if status == 0 else f'ended with {status}, see {job.output}'}")
    return abs(status)


def _as_exit(number: int, frame: object) -> None:
    sys.exit(128 + number)


def _end_with_parent() -> None:
    """Make Linux send this process SIGTERM when its parent dies."""
    set_parent_death_signal = 1
    ctypes.CDLL(None, use_errno=True).prctl(set_parent_death_signal, signal.SIGTERM)
    if os.getppid() == 1:
        os._exit(1)
