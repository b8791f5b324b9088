"""What the trials of malformed inputs consist of: cases, and the error that says that one went wrong unnoticed."""

from collections.abc import Callable
from typing import Any, NamedTuple


class Silent(Exception):
    """Malformed input was accepted, and what came of it is wrong."""


class Theirs(Exception):
    """An error that a user's own code raises, and that may pass through."""


class Case(NamedTuple):
    """Something that a user could do."""

    name: str
    run: Callable[[], Any]
    """Returns where it works, and raises what the user sees."""
