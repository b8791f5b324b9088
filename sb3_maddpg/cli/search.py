"""Searches for hyperparameters that outlive their processes: what was tried is kept, and killed trials come back."""

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
_PROCESS = "process"  # the attribute of a trial that tells who works at it


def kept_search(folder: Path, env_name: str, settings: Any) -> Path:
    """
    :param folder: of the algorithm's logs
    :param env_name: the environment
    :param settings: all that the search depends on; the same settings go on with the same search
    :return: the file that keeps the trials of a search without ``--storage`` until it is done
    """
    digest = hashlib.sha256(repr(settings).encode()).hexdigest()[:12]
    return folder / f"{env_name}_search_{digest}.log"


def open_storage(storage: str) -> BaseStorage | str:
    """
    :param storage: as ``--storage`` gives it
    :return: what Optuna takes; a file that ends with .log holds a journal
    """
    return JournalStorage(JournalFileBackend(as_absolute(storage))) if storage.endswith(".log") else storage


def as_absolute(storage: str) -> str:
    """
    :param storage: as ``--storage`` gives it
    :return: the same, files by their whole path: by another, Optuna would never release the lock of a killed process
    """
    return str(Path(storage).resolve()) if storage.endswith(".log") else storage


def sign(trial: optuna.Trial) -> None:
    """
    Tell who works at a trial, for ``bring_back``.

    :param trial: that begins
    """
    trial.set_user_attr(_PROCESS, _me())


def bring_back(study: optuna.Study) -> int:
    """
    Fail the trials whose processes on this machine are gone, and queue their hyperparameters again. Those of other
    machines are left alone: nobody can see from here whether they run.

    :param study: that may have been worked at by processes that were killed
    :return: number of trials that come back
    """
    count = 0
    for trial in study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
        owner = trial.user_attrs.get(_PROCESS)
        if not isinstance(owner, str) or _may_run(owner):
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
    """When a process began, as far as the system tells: its number may be given to another one."""
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
