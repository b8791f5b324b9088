"""Errors that name the wrong value and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


def shown(value: object, most: int = 200) -> str:
    """Format a value for a message: its ``repr`` on one line, shortened if it is long.

    :param value: any value
    :param most: maximum number of characters
    """
    try:
        text = " ".join(repr(value).split())
    except Exception:  # from a foreign class, or an integer with too many digits for Python
        text = f"<{type(value).__name__}>"
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-(most // 3) :]}"


def unknown_name(kind: str, value: object, known: Iterable[str], meant: str | None = None) -> ValueError:
    """Create the error for an unknown name, which lists the known names and suggests the closest one.

    :param kind: kind of the name, e.g. ``"scenario"``
    :param value: the unknown name
    :param known: the known names
    :param meant: the known name that the unknown one stands for; by default, the one that is spelled most alike
    """
    names = sorted(known)
    text = value if isinstance(value, str) else shown(value)
    near = [meant] if meant else difflib.get_close_matches(text, names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return ValueError(f"Unknown {kind} {shown(value)}; known: {', '.join(names)}.{hint}")


@contextmanager
def needs_extra(what: str, extra: str) -> Iterator[None]:
    """Let imports in the ``with`` block fail with the name of the extra that is missing.

    :param what: what needs the extra, e.g. the option ``"--plot"``
    :param extra: name of an extra of the package
    :raises ImportError: if a package is missing
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"{what} needs the extra {extra!r}: in the clone, pip install -e '.[{extra}]' ({error})."
        ) from error
