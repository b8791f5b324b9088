"""Executor on the machines of a Ray cluster, or in Ray's processes on this machine."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import pickle
import re
import socket
import threading
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from types import TracebackType
from typing import Any

from quad_swarm.errors import shown
from quad_swarm.jobs.journal import differences, machine, origin

# Number of times that Ray retries a piece whose process or machine died
_RETRIES = 3


class Cluster(Executor):
    """Executor of `concurrent.futures` based on Ray (https://docs.ray.io).

    If the process or machine of a piece dies, the piece is repeated elsewhere, so it must be a pure function of its
    arguments. Every machine needs the same version of this package, and the files that pieces name at the same paths.
    Results of other sources of this package or of ``modules`` are refused.

    :param jobs: number of processes on this machine, unused if ``address`` names a cluster
    :param modules: modules that each process imports first
    :param address: address of a running cluster, ``auto`` or ``HOST:PORT``; None starts a cluster on this machine and
        stops it at the end
    :param mixed: accept results of machines with another processor or other library versions, which may differ in the
        last bits
    :raises ValueError: if Ray is not installed, or there is no such cluster
    """

    def __init__(self, jobs: int, modules: Sequence[str] = (), address: str | None = None, mixed: bool = False):
        try:
            import ray
        except ImportError as error:
            raise ValueError(f'Ray is not installed ({error}): in the clone, pip install -e ".[ray]".') from error
        self._ray, self._modules, self._mixed = ray, tuple(modules), mixed
        self._begun = not ray.is_initialized()
        if self._begun:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # do not report usage unasked
            try:
                if address is not None and (found := re.fullmatch(r"([^/]+):(\d+)", address)):
                    # Ray would wait for minutes
                    socket.create_connection((found[1], int(found[2])), timeout=5.0).close()
                    _use_token()
                ray.init(
                    address=address or "local",  # None would follow RAY_ADDRESS or a cluster found here
                    num_cpus=None if address else jobs,
                    include_dashboard=None if address else False,
                    log_to_driver=False,
                    logging_level=logging.WARNING,
                )
            except (OSError, OverflowError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
                raise ValueError(
                    f"address={shown(address)}: no Ray cluster responds there ({shown(str(error))[1:-1]}). If it asks "
                    "for a token, put the cluster's token into ~/.ray/auth_token and set RAY_AUTH_MODE=token."
                ) from error
        self._code = _code(self._modules)
        self._run = ray.remote(_run).options(max_retries=_RETRIES, num_cpus=1)
        self._open: dict[Future[Any], Any] = {}
        self._lock = threading.RLock()  # Ray settles results in threads of its own

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `concurrent.futures.Executor.submit`.

        The future raises ValueError if its processes died repeatedly, or its machine differs from this one.
        """
        result: Future[Any] = Future()
        result.set_running_or_notify_cancel()
        # Unlike pickle, cloudpickle accepts functions defined in a script or in a module run with python -m
        piece = self._ray.cloudpickle.dumps(partial(function, *args, **kwargs))
        reference = self._run.remote(piece, self._modules)
        self._open[result] = reference
        reference.future().add_done_callback(partial(self._settle, result))
        return result

    def _settle(self, result: Future[Any], done: Future[Any]) -> None:
        with self._lock:
            self._open.pop(result, None)
            if not result.done():
                self._set(result, done)

    def _set(self, result: Future[Any], done: Future[Any]) -> None:
        try:
            value, error, trace, where, *code = done.result()
        except self._ray.exceptions.RayError as lost:
            message = f"{_RETRIES + 1} processes died in the same piece of work, or it was cancelled: {lost}"
            result.set_exception(ValueError(message))
            return
        if error is not None:
            error.__cause__ = RuntimeError(f"in a process of the cluster:\n{trace}")
            result.set_exception(error)
        elif names := differences(code[0] if code else {}, self._code):  # earlier versions return no digests
            result.set_exception(other_code(names))
        elif where != machine() and not self._mixed:
            message = (
                f"A piece was computed on a machine that differs from this one, so its last bits may differ: {where}, "
                f"here {machine()}. Use machines of the same kind, or allow it (on the command line --mixed)."
            )
            result.set_exception(ValueError(message))
        else:
            result.set_result(value)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `concurrent.futures.Executor.shutdown`. ``cancel_futures`` also stops running pieces."""
        if cancel_futures:
            with self._lock:
                stopped, self._open = self._open, {}
                for future in stopped:
                    future.set_exception(RuntimeError("The executor was stopped."))
            for reference in stopped.values():
                self._ray.cancel(reference, force=True)
        elif wait and (running := list(self._open.values())):
            self._ray.wait(running, num_returns=len(running))
        if self._begun and (wait or cancel_futures):
            self._ray.shutdown()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        self.shutdown(cancel_futures=kind is not None)
        return None


def _use_token() -> None:
    """Use the user's token if there is one, as Ray does only for clusters that it finds on this machine."""
    with contextlib.suppress(ImportError):  # Ray before 2.56 uses none unless RAY_AUTH_MODE says so
        from ray._private.authentication import authentication_token_setup

        authentication_token_setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)


def other_code(names: Sequence[str]) -> ValueError:
    """Create the error for a result of other code.

    :param names: what differs, see `differences`
    """
    return ValueError(
        f"A piece was computed with another content of {', '.join(names)} than this command began with, or without: "
        "leave code and models alone while it runs; on a cluster, give all machines the same ones, where Python finds "
        "them, and restart Ray after changes."
    )


def _code(modules: Sequence[str]) -> dict[str, str]:
    return origin(["quad_swarm", *modules])


def _run(piece: bytes, modules: Sequence[str]) -> tuple[Any, Exception | None, str, str, dict[str, str]]:
    """Run a piece and return its value, its error and traceback, the machine, and digests of the sources."""
    code: dict[str, str] = {}
    try:
        code = _code(modules)
        for module in modules:
            importlib.import_module(module)
        return pickle.loads(piece)(), None, "", machine(), code
    except Exception as error:  # passed on to the caller
        trace = traceback.format_exc()
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # some exceptions can be pickled but not unpickled
            error = RuntimeError(repr(error))
        return None, error, trace, machine(), code
