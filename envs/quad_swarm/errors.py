"""Errors that name the wrong value and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def unknown_name(kind: str, value: object, known: Iterable[str]) -> ValueError:
    """The error for a name that is not among ``known``: it lists them and suggests the nearest.

    :param kind: what the name stands for, e.g. ``"scenario"``
    :param value: the name that was given
    :param known: the names that exist
    """
    names = sorted(known)
    near = difflib.get_close_matches(str(value), names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return ValueError(f"Unknown {kind} {value!r}; known: {', '.join(names)}.{hint}")
