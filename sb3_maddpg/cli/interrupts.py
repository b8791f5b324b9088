"""Ctrl-C in functions of rl_zoo3, which end as if they were finished."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def noticed_interrupts(waits: Callable[[], bool] = lambda: False) -> Iterator[threading.Event]:
    """
    Notice Ctrl-C even where the ``KeyboardInterrupt`` is caught.

    :param waits: whether there is to be no ``KeyboardInterrupt`` at this moment, but only the event; a second Ctrl-C
        does not wait
    :return: event that is set once Ctrl-C was pressed
    """
    pressed = threading.Event()

    def interrupt(number: int, frame: Any) -> None:
        leave = waits() and not pressed.is_set()
        pressed.set()
        if leave:
            return
        signal.default_int_handler(number, frame)

    # Whoever ignores SIGINT, as shells do for jobs in the background, or handles it otherwise, keeps doing so
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    ):
        yield pressed
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
