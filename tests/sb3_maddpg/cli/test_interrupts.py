"""Ctrl-C that other libraries catch is noticed."""

import signal
import threading
from contextlib import suppress

import pytest

from sb3_maddpg.cli.interrupts import noticed_interrupts


def test_an_interrupt_that_is_caught_is_noticed():
    with noticed_interrupts() as pressed:
        assert not pressed.is_set()
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert pressed.is_set()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt), noticed_interrupts():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_first_interrupt_can_wait():
    with noticed_interrupts(lambda: True) as pressed:
        signal.raise_signal(signal.SIGINT)
        assert pressed.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_whoever_ignores_interrupts_keeps_doing_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with noticed_interrupts() as pressed:
            signal.raise_signal(signal.SIGINT)
        assert not pressed.is_set()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_handle_no_signals():
    def work() -> None:
        with noticed_interrupts() as pressed:
            found.append(pressed.is_set())

    found: list[bool] = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [False]
