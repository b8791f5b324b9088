"""Errors that name the wrong value and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def shown(value: object, most: int = 200) -> str:
    """A value for a message, as Python writes it: in one line, and shortened where it is long.

    :param value: any, as it was given
    :param most: number of characters
    """
    try:
        text = " ".join(repr(value).split())
    except Exception:  # of an object of somebody else's, or of an integer of too many digits for Python
        text = f"<{type(value).__name__}>"
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-(most // 3) :]}"


def unknown_name(kind: str, value: object, known: Iterable[str]) -> ValueError:
    """The error for a name that is not among ``known``: it lists them and suggests the nearest.

    :param kind: what the name stands for, e.g. ``"scenario"``
    :param value: the name that was given
    :param known: the names that exist
    """
    names = sorted(known)
    near = difflib.get_close_matches(value if isinstance(value, str) else shown(value), names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return ValueError(f"Unknown {kind} {shown(value)}; known: {', '.join(names)}.{hint}")
