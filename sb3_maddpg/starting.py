"""Ctrl-C where it must not raise: while ``sb3-maddpg`` still imports its modules, and in what must not be cut short."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import pairwise
from typing import Any


def _is_command() -> bool:
    is_module = ("-m", "sb3_maddpg") in pairwise(sys.orig_argv)
    return is_module or os.path.basename(sys.argv[0] if sys.argv else "").split(".")[0] == "sb3-maddpg"


def _end(number: int, frame: Any) -> None:
    os.write(2, b"Interrupted.\n")
    os._exit(128 + number)  # an import could catch an exception


def end_on_interrupt() -> None:
    """End the command on Ctrl-C with one line, until ``interruptible``. Other programs keep Python's behaviour."""
    if (
        _is_command()
        and multiprocessing.parent_process() is None
        and threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):
        signal.signal(signal.SIGINT, _end)


def interruptible() -> None:
    """Let Ctrl-C raise ``KeyboardInterrupt`` again."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def uninterrupted() -> Iterator[Callable[[], AbstractContextManager[None]]]:
    """
    Let Ctrl-C raise ``KeyboardInterrupt`` only after the block, and within it where ``with`` what it yields allows it:
    there at once, also for a Ctrl-C that came before. In other threads it raises nothing anyway.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield nullcontext
        return
    interrupts: list[int] = []

    def hold(number: int, frame: Any) -> None:
        interrupts.append(number)

    def release() -> None:
        signal.signal(signal.SIGINT, handler)
        if interrupts:
            interrupts.clear()
            signal.raise_signal(signal.SIGINT)

    @contextmanager
    def allowed() -> Iterator[None]:
        try:
            release()
            yield
        finally:
            signal.signal(signal.SIGINT, hold)

    signal.signal(signal.SIGINT, hold)
    try:
        yield allowed
    finally:
        release()
