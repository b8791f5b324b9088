"""Pieces of work on the machines of a Ray cluster, or in Ray's processes on this one."""

from __future__ import annotations

import importlib
import logging
import os
import pickle
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from types import TracebackType
from typing import Any

from quad_swarm.errors import shown
from quad_swarm.tasks.journal import machine

# How often Ray begins a piece again whose process or machine died
_RETRIES = 3


class Cluster(Executor):
    """Ray (https://docs.ray.io) as an executor of `concurrent.futures`. A piece whose process or machine dies is begun
    again elsewhere, so it must be a function of its arguments. This package, in the same version, must be installed on
    every machine, and the files that pieces name must lie there under the same path.

    :param jobs: processes on this machine; of no meaning where ``address`` names a cluster
    :param modules: imported by each process first
    :param address: of a running cluster, ``auto`` or ``HOST:PORT``; None begins one on this machine and ends it again
    :param mixed: take results of machines with another processor or other versions of what computes, whose last bits
        may differ
    :raises ValueError: Ray is not installed, or there is no such cluster
    """

    def __init__(self, jobs: int, modules: Sequence[str] = (), address: str | None = None, mixed: bool = False):
        try:
            import ray
        except ImportError as error:
            raise ValueError(f'Ray is not installed ({error}): pip install "sb3-maddpg[ray]".') from error
        self._ray, self._modules, self._mixed = ray, tuple(modules), mixed
        self._begun = not ray.is_initialized()
        if self._begun:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anybody unasked
            try:
                ray.init(
                    address=address,
                    num_cpus=None if address else jobs,
                    include_dashboard=None if address else False,
                    log_to_driver=False,
                    logging_level=logging.WARNING,
                )
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise ValueError(f"address={shown(address)}: no Ray cluster answers there ({error}).") from error
        self._run = ray.remote(_run).options(max_retries=_RETRIES, num_cpus=1)
        self._open: dict[Future[Any], Any] = {}

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `concurrent.futures.Executor.submit`.

        The future raises ValueError where processes died again and again, or the machine is unlike this one.
        """
        result: Future[Any] = Future()
        result.set_running_or_notify_cancel()
        # Unlike pickle it also takes what a script or a module run by python -m defines itself
        piece = self._ray.cloudpickle.dumps(partial(function, *args, **kwargs))
        reference = self._run.remote(piece, self._modules)
        self._open[result] = reference
        reference.future().add_done_callback(partial(self._settle, result))
        return result

    def _settle(self, result: Future[Any], done: Future[Any]) -> None:
        self._open.pop(result, None)
        if result.done():
            return
        try:
            value, error, trace, where = done.result()
        except self._ray.exceptions.RayError as lost:
            message = f"{_RETRIES + 1} processes died at the same piece of work, or it was cancelled: {lost}"
            result.set_exception(ValueError(message))
            return
        if error is not None:
            error.__cause__ = RuntimeError(f"in a process of the cluster:\n{trace}")
            result.set_exception(error)
        elif where != machine() and not self._mixed:
            message = (
                f"A piece was worked off on a machine unlike this one, where the last bits may differ: {where}, here "
                f"{machine()}. Use machines of one kind, or allow it (on the command line --mixed)."
            )
            result.set_exception(ValueError(message))
        else:
            result.set_result(value)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `concurrent.futures.Executor.shutdown`; what runs is stopped too where futures are to be cancelled."""
        if cancel_futures:
            for future, reference in list(self._open.items()):
                self._ray.cancel(reference, force=True)
                if not future.done():
                    future.set_exception(RuntimeError("The executor was stopped."))
        elif wait and self._open:
            self._ray.wait(list(self._open.values()), num_returns=len(self._open))
        if self._begun and (wait or cancel_futures):
            self._ray.shutdown()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        self.shutdown(cancel_futures=kind is not None)
        return None


def _run(piece: bytes, modules: Sequence[str]) -> tuple[Any, Exception | None, str, str]:
    """:return: value, error and its traceback, and the machine"""
    try:
        for module in modules:
            importlib.import_module(module)
        return pickle.loads(piece)(), None, "", machine()
    except Exception as error:  # it is the caller's
        trace = traceback.format_exc()
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # some exceptions can be written but not read
            error = RuntimeError(repr(error))
        return None, error, trace, machine()
