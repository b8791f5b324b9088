"""Executor with processes whose deaths do no harm."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import multiprocessing.util
import os
import pickle
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext
from types import TracebackType
from typing import Any

# Number of attempts before a task, or the machine, is considered the cause of the processes' deaths
_ATTEMPTS = 3


@dataclass
class _Task:
    function: Callable[[], Any]
    future: Future[Any] = field(default_factory=Future)
    attempts: int = 0


@dataclass
class _Worker:
    process: multiprocessing.process.BaseProcess
    task: _Task | None = None


class Pool(Executor):
    """Executor like `concurrent.futures.ProcessPoolExecutor`, but tolerant of dying processes.

    If a process dies, a new process repeats its task, so a task must be a pure function of its arguments. All
    processes end with their parent, however that ends. An exception in the ``with`` block stops running tasks.

    Each process has its own pipe and shares no lock, so it cannot leave anything locked.

    :param jobs: number of processes
    :param modules: modules that each process imports first
    :raises ValueError: if ``jobs`` is less than 1
    """

    def __init__(self, jobs: int, modules: Sequence[str] = ()):
        if jobs < 1:
            raise ValueError(f"jobs={jobs} must be at least 1.")
        self._jobs, self._modules = jobs, tuple(modules)
        # Spawned, not forked, because numerical libraries have threads
        self._context: SpawnContext = multiprocessing.get_context("spawn")
        self._waiting: deque[_Task] = deque()
        self._workers: dict[Connection, _Worker] = {}
        self._closing = self._stopping = False
        self._lock = threading.Lock()
        self._woken, self._wake = self._context.Pipe(duplex=False)
        self._manager: threading.Thread | None = None

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `concurrent.futures.Executor.submit`.

        The future raises ValueError if the task's processes died repeatedly.
        """
        task = _Task(partial(function, *args, **kwargs))
        with self._lock:
            if self._closing:
                raise RuntimeError("This pool is closed.")
            self._waiting.append(task)
            if self._manager is None:
                self._manager = threading.Thread(target=self._manage, daemon=True)
                self._manager.start()
        self._wake.send(None)
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `concurrent.futures.Executor.shutdown`. ``cancel_futures`` also stops running tasks."""
        with self._lock:
            self._closing, self._stopping = True, self._stopping or cancel_futures
        with contextlib.suppress(OSError):  # the pool has already ended
            self._wake.send(None)
        if wait and self._manager is not None:
            self._manager.join()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        self.shutdown(cancel_futures=kind is not None)
        return None

    def _manage(self) -> None:
        """Distribute tasks and collect results until the pool is closed and no task is left."""
        while True:
            with self._lock:
                stopping, closing = self._stopping, self._closing
            if not stopping:
                self._dispatch()
            busy = any(worker.task for worker in self._workers.values())
            if stopping or (closing and not busy and not self._waiting):
                break
            for ready in wait([self._woken, *self._workers]):
                if ready is self._woken:
                    self._woken.recv()
                else:
                    self._receive(ready)  # type: ignore[arg-type]  # a Connection like the one above
        self._end()

    def _dispatch(self) -> None:
        while self._waiting:
            idle = next((connection for connection, worker in self._workers.items() if worker.task is None), None)
            if idle is None and len(self._workers) == self._jobs:
                return
            task = self._waiting.popleft()
            if not task.attempts and not task.future.set_running_or_notify_cancel():
                continue
            try:
                text = pickle.dumps(task.function)
            except Exception as error:  # whatever pickle raises
                task.future.set_exception(error)
                continue
            connection = idle or self._start_worker()
            self._workers[connection].task = task
            task.attempts += 1
            try:
                connection.send_bytes(text)
            except OSError:
                self._remove_worker(connection)

    def _start_worker(self) -> Connection:
        mine, theirs = self._context.Pipe()
        # One thread per process, so that processes do not compete for cores
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        process = self._context.Process(target=_work, args=(theirs, self._modules), daemon=True)
        with _without_current_folder():
            process.start()
        theirs.close()  # so that the end of the process ends the pipe
        self._workers[mine] = _Worker(process)
        return mine

    def _receive(self, connection: Connection) -> None:
        worker = self._workers[connection]
        try:
            result = connection.recv_bytes()
        except (OSError, EOFError):
            self._remove_worker(connection)
            return
        task, worker.task = worker.task, None
        assert task is not None
        try:
            value, error, trace = pickle.loads(result)
        except Exception as unreadable:  # whatever the value's class raises
            value, error, trace = None, unreadable, "as it was read"
        if error is None:
            task.future.set_result(value)
        else:
            error.__cause__ = RuntimeError(f"in a process of the pool:\n{trace}")
            task.future.set_exception(error)

    def _remove_worker(self, connection: Connection) -> None:
        """Remove a dead process and requeue its task, unless it has had all its attempts."""
        worker = self._workers.pop(connection)
        connection.close()
        worker.process.join()
        if worker.task is None:
            return
        if worker.task.attempts < _ATTEMPTS:
            self._waiting.appendleft(worker.task)
        else:
            message = f"{_ATTEMPTS} processes died in the same piece of work. If memory is short, use fewer --jobs."
            worker.task.future.set_exception(ValueError(message))

    def _end(self) -> None:
        for connection, worker in self._workers.items():
            connection.close()  # this ends an idle process
            if worker.task is not None:
                worker.process.kill()
                worker.task.future.set_exception(RuntimeError("The pool was stopped."))
        for worker in self._workers.values():
            worker.process.join()
        for task in self._waiting:
            if task.attempts or not task.future.cancel():
                task.future.set_exception(RuntimeError("The pool was stopped."))
        self._workers.clear()
        self._waiting.clear()


@contextlib.contextmanager
def _without_current_folder() -> Iterator[None]:
    """Start processes of Python that do not import from the current folder, whose files are not to be run: a spawned
    process has it first on its path until it gets the path of this one."""
    if sys.version_info >= (3, 11):
        before = os.environ.get("PYTHONSAFEPATH")
        os.environ["PYTHONSAFEPATH"] = "1"
        try:
            yield
        finally:
            os.environ.pop("PYTHONSAFEPATH")
            if before is not None:
                os.environ["PYTHONSAFEPATH"] = before
    else:  # only isolated processes do without it
        flags = multiprocessing.util._args_from_interpreter_flags  # type: ignore[attr-defined]
        multiprocessing.util._args_from_interpreter_flags = lambda: [*flags(), "-I"]  # type: ignore[attr-defined]
        try:
            yield
        finally:
            multiprocessing.util._args_from_interpreter_flags = flags  # type: ignore[attr-defined]


def _work(connection: Connection, modules: Sequence[str]) -> None:
    """Run tasks until the pipe is closed."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this one
    for module in modules:
        importlib.import_module(module)
    while True:
        try:
            task = connection.recv_bytes()
        except EOFError:
            return
        value, error, trace = None, None, ""
        try:
            value = pickle.loads(task)()
        except Exception as raised:  # passed on to the caller
            error, trace = raised, traceback.format_exc()
        try:
            result = pickle.dumps((value, error, trace))
            pickle.loads(result) if error else None  # some exceptions can be pickled but not unpickled
        except Exception as unpicklable:
            error = RuntimeError(f"{error or 'a result'} cannot be sent to the caller: {unpicklable!r}")
            result = pickle.dumps((None, error, trace))
        connection.send_bytes(result)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
