"""Hyperparameter searches that survive killed processes: finished trials are kept, and killed ones are repeated."""

import argparse
import hashlib
import json
import os
import shlex
import socket
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from optuna.trial import TrialState

from sb3_maddpg.cli.options import PROG
from sb3_maddpg.cli.processes import run_all, without_processes
from sb3_maddpg.cli.runs import name_of
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.starting import uninterrupted
from sb3_maddpg.utils import process_runs, told

STUDY = "search"
_BEGINS = b'{"op_code":'  # a journal
_IDENTITY = "SB3_MADDPG_WORKER"  # environment variable with the identity that a worker keeps when it is restarted
_PROCESS = "process"  # attribute of a trial that identifies the process running it
_WORKER = "worker "  # prefix of the attributes of a study that identify the processes that work on it


def kept_search(folder: Path, env_name: str, settings: Any) -> Path:
    """
    :param folder: folder of the algorithm's logs
    :param env_name: name of the environment
    :param settings: everything that the search depends on; the same settings continue the same search
    :return: path of the file that keeps the trials of a search without ``--storage`` until it is finished
    """
    digest = hashlib.sha256(repr(settings).encode()).hexdigest()[:12]
    return folder / f"{env_name}_search_{digest}.log"


def open_storage(storage: str) -> BaseStorage | str:
    """
    :param storage: value of ``--storage``
    :return: storage for Optuna; a file with the suffix .log is a journal
    :raises ValueError: if such a file is not a journal; Optuna would append to it
    """
    if not storage.endswith(".log"):
        return storage
    try:
        if Path(storage).is_file():
            with Path(storage).open("rb") as file:
                first = file.readline()
            # A line without end may be one that another worker is writing
            if first.endswith(b"\n"):
                json.loads(first)["op_code"]
            elif not first.startswith(_BEGINS) and not _BEGINS.startswith(first):
                raise ValueError("its first line is no entry")
            _end_last_line(as_absolute(storage))
        return JournalStorage(_Journal(as_absolute(storage)))
    except (
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        ArithmeticError,
        RecursionError,
        AssertionError,
    ) as error:
        raise InvalidFileError(
            f"--storage {storage} is not a journal of Optuna ({told(error)}): name another file."
        ) from error


class _Journal(JournalFileBackend):
    """A journal whose entries Ctrl-C does not cut short. Optuna's lock cannot be released after that."""

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        with uninterrupted():
            super().append_logs(logs)


def _end_last_line(path: str) -> None:
    """Remove the damaged last line that a power loss left in a journal. Optuna would append to it, and stop there."""
    if _damaged(Path(path).read_bytes()) == 0:
        return
    lock = JournalFileSymlinkLock(path)  # without it, another worker may be writing the line
    lock.acquire()
    try:
        with Path(path).open("rb+") as file:
            content = file.read()
            if damaged := _damaged(content):
                file.truncate(len(content) - damaged)
                file.seek(0, os.SEEK_END)
                file.write(content[-damaged:] + b"\n" if _is_entry(content[-damaged:]) else b"")
                os.fsync(file.fileno())
    finally:
        lock.release()


def _damaged(content: bytes) -> int:
    """
    :return: length of the last line of a journal, if it has no end or is no entry, such as one that was cut off and to
        which Optuna then appended another. Earlier lines are the reader's matter.
    """
    last = content[content.rfind(b"\n", 0, -1) + 1 :]
    return 0 if not last or (last.endswith(b"\n") and _is_entry(last)) else len(last)


def _is_entry(line: bytes) -> bool:
    try:
        json.loads(line)["op_code"]
    except (ValueError, KeyError, TypeError, IndexError, RecursionError):
        return False
    return True


def check_trials(study: optuna.Study, storage: str) -> None:
    """
    Check the trials of a study, since a storage may have been edited.

    :param study: a study
    :param storage: value of ``--storage``
    :raises ValueError: if a value of a trial cannot be one
    """
    try:
        for trial in study.get_trials(deepcopy=False):
            optuna.trial.create_trial(
                state=trial.state,
                values=trial.values,
                params=trial.params,
                distributions=trial.distributions,
                intermediate_values=trial.intermediate_values,
            )
            numbers = [*(trial.values or ()), *trial.intermediate_values, *trial.intermediate_values.values()]
            if any(isinstance(one, bool) or not isinstance(one, (int, float)) for one in numbers):
                raise TypeError(f"trial {trial.number} has values that are no numbers")
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
        raise InvalidFileError(f"--storage {storage} is damaged ({told(error)}): name another one.") from error


def as_absolute(storage: str) -> str:
    """
    :param storage: value of ``--storage``
    :return: the storage with an absolute path, without which Optuna would never release the lock of a killed process
    """
    return str(Path(storage).resolve()) if storage.endswith(".log") else storage


def register_worker(study: optuna.Study) -> None:
    """
    Note that this process works on a study. Call it before the first trial: a process may be killed after Optuna
    created a trial and before ``mark_owner``.

    :param study: a study
    """
    study.set_user_attr(_WORKER + _me(), True)


def mark_owner(trial: optuna.Trial) -> None:
    """
    Mark a trial as run by this process, for ``retry_lost_trials``.

    :param trial: a trial that starts
    """
    trial.set_user_attr(_PROCESS, _me())


def retry_lost_trials(study: optuna.Study) -> int:
    """
    Mark the trials of dead processes on this machine as failed and queue their hyperparameters again. Trials of other
    machines are left alone, since it is unknown whether they are still running, except those of a worker that a cluster
    restarts here.

    :param study: a study that may have trials of killed processes
    :return: number of trials that will be repeated
    """
    workers = [name.removeprefix(_WORKER) for name in study.user_attrs if name.startswith(_WORKER)]
    count = 0
    for trial in study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
        owner = trial.user_attrs.get(_PROCESS)
        # A trial without parameters and owner has only just been created, by one of the workers
        owners = [owner] if isinstance(owner, str) else [] if trial.params else workers
        if not owners or any(map(_may_run, owners)):
            continue
        try:
            study.tell(trial.number, state=TrialState.FAIL)
        except (RuntimeError, ValueError):  # another worker was faster
            continue
        study.enqueue_trial(trial.params)
        count += 1
    return count


def search(args: argparse.Namespace, words: list[str]) -> int:
    """
    Search with several workers, which share a study, and print where the best trial is.

    :param args: options of ``tune``
    :param words: the options as they were given; the output of each worker goes to ``search_K.log`` in the log folder
    :return: exit status of the first worker that failed, 0 if none did
    :raises InvalidArgumentError: if arguments are invalid
    """
    if args.storage is None or args.study_name is None:
        raise InvalidArgumentError(
            "--jobs and --engine ray need --storage and --study-name: the workers share that study."
        )
    jobs = 1 if args.jobs is None else args.jobs
    total = args.max_total_trials or args.n_trials
    words = [*without_processes(words), "--max-total-trials", str(total)]
    folder = Path(args.log_folder)
    folder.mkdir(parents=True, exist_ok=True)
    workers = [_Worker(number, words, folder) for number in range(1, max(min(jobs, total), 1) + 1)]
    failed = run_all(workers, jobs, args.engine, args.address)
    if not failed and args.env is not None:
        tell_best(args.algo, args.env, best_recipe(folder / args.algo, name_of(args.env)))
    return failed


def best_recipe(folder: Path, env_name: str) -> Path:
    """
    :param folder: folder of the algorithm's logs
    :param env_name: name of the environment
    :return: path of the recipe of the best trial
    """
    return folder / f"{env_name}_best.yml"


def tell_best(algo: str, env_id: str, best: Path) -> None:
    """Print where the recipe of the best trial is, and how to train with it."""
    print(f"Recipe of the best trial: {best}. To train with it:")
    print(f"  {shlex.join([PROG, 'train', '--algo', algo, '--env', env_id, '--conf-file', str(best)])}")


@dataclass(frozen=True)
class _Worker:
    number: int
    words: list[str]
    log_folder: Path
    identity: str = field(default_factory=lambda: uuid.uuid4().hex)

    @property
    def name(self) -> str:
        return f"worker {self.number}"

    @property
    def output(self) -> Path:
        return self.log_folder / f"search_{self.number}.log"

    @property
    def environment(self) -> dict[str, str]:
        return {_IDENTITY: self.identity}

    def command(self) -> tuple[list[str], str]:
        return ["tune", *self.words], "starts"


def _me() -> str:
    return f"{socket.gethostname()} {os.getpid()} {_began(os.getpid())} {os.environ.get(_IDENTITY, '')}".rstrip()


def _began(process: int) -> str:
    """:return: start time of a process, if available, since process ids are reused"""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return "?"


def _may_run(owner: str) -> bool:
    host, process, began, identity = (*owner.split(), "", "", "", "")[:4]
    if identity and identity == os.environ.get(_IDENTITY) and owner != _me():
        return False  # this process takes its place
    if host != socket.gethostname() or not process.isdecimal():
        return True
    return process_runs(int(process)) and _began(int(process)) == began
