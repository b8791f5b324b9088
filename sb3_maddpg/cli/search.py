"""Hyperparameter searches that survive killed processes: finished trials are kept, and killed ones are repeated."""

import hashlib
import os
import socket
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from sb3_maddpg.utils import process_runs

STUDY = "search"
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
    """
    return JournalStorage(JournalFileBackend(as_absolute(storage))) if storage.endswith(".log") else storage


def as_absolute(storage: str) -> str:
    """
    :param storage: value of ``--storage``
    :return: the storage with an absolute path, without which Optuna would never release the lock of a killed process
    """
    return str(Path(storage).resolve()) if storage.endswith(".log") else storage


def enlist(study: optuna.Study) -> None:
    """
    Note that this process works on a study. Call it before the first trial: a process may be killed after Optuna
    created a trial and before ``sign``.

    :param study: a study
    """
    study.set_user_attr(_WORKER + _me(), True)


def sign(trial: optuna.Trial) -> None:
    """
    Mark a trial as run by this process, for ``bring_back``.

    :param trial: a trial that starts
    """
    trial.set_user_attr(_PROCESS, _me())


def bring_back(study: optuna.Study) -> int:
    """
    Mark the trials of dead processes on this machine as failed and queue their hyperparameters again. Trials of other
    machines are left alone, since it is unknown whether they are still running.

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


def _me() -> str:
    return f"{socket.gethostname()} {os.getpid()} {_began(os.getpid())}"


def _began(process: int) -> str:
    """:return: start time of a process, if available, since process ids are reused"""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return "?"


def _may_run(owner: str) -> bool:
    host, _, rest = owner.partition(" ")
    process, _, began = rest.partition(" ")
    if host != socket.gethostname() or not process.isdecimal():
        return True
    return process_runs(int(process)) and _began(int(process)) == began
