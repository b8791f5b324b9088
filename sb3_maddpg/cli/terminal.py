"""What a command prints, also if nobody can read it any more."""

import errno
import io
import os
import select
import stat
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

_SECONDS = 0.3  # within which a signal arrives
_telling = threading.Lock()


class _Terminal(io.FileIO):
    """A terminal. What is written to it after it was closed is lost, without an error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return memoryview(data).nbytes


class _Pipe(io.FileIO):
    """
    A pipe, perhaps to a ``tee`` that ends because its terminal was closed. The signal of that may arrive a little later
    and replace this output.
    """

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            time.sleep(_SECONDS)
            return super().write(data)


def _open_missing() -> None:
    """Open the null device for each standard stream that is closed, before a file takes its number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))


@contextmanager
def lasting_output() -> Iterator[None]:
    """Let a command go on when its terminal is closed: a training would be lost for the sake of a table."""
    _open_missing()
    before = sys.stdout, sys.stderr
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if stream is None or stream is not getattr(sys, f"__{name}__"):
            continue
        is_pipe = stat.S_ISFIFO(os.fstat(stream.fileno()).st_mode)
        if is_pipe or stream.isatty():
            stream.flush()
            raw = io.BufferedWriter((_Pipe if is_pipe else _Terminal)(stream.fileno(), "w", closefd=False))
            buffering = stream.line_buffering if is_pipe else True
            setattr(sys, name, io.TextIOWrapper(raw, stream.encoding, stream.errors, line_buffering=buffering))
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        sys.stdout, sys.stderr = before


def is_unread() -> bool:
    """:return: whether standard output is a pipe whose reader has ended, such as ``head``"""
    if not hasattr(select, "poll"):
        return False
    poll = select.poll()
    poll.register(1, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def discard_output() -> None:
    """Discard what is still to be printed, which Python would complain about at its end."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.close(null)


def tell(text: str) -> None:
    """
    Print a line, in one piece even if several threads do so at the same time.

    :param text: the line
    """
    with _telling:
        print(text, flush=True)


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """
    :param lines: cells of a table's lines
    :return: the table as text: the first column begins at the left, the others end at the right
    """
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in lines
    )
