"""Files of rows: a JSON list with an object per line, or comma-separated values, both compressed if a name ends in .gz.

The path ``-`` stands for the standard output. ``pandas.read_json`` and ``pandas.read_csv`` read these files as well.
"""

from __future__ import annotations

import contextlib
import csv
import glob
import gzip
import io
import json
import os
import secrets
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

STDOUT = Path("-")
_LEFT_OVER = 3600  # seconds, after which a temporary file belongs to a process that was killed


def aligned(texts: Sequence[Sequence[str]], left: int) -> str:
    """Format texts as a table.

    :param texts: titles, and the cells of each row
    :param left: number of the first columns that are aligned to the left, the others are to the right
    """
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    lines = [texts[0], ["-" * width for width in widths], *texts[1:]]
    cells = (
        (t.ljust(w) if k < left else t.rjust(w) for k, (t, w) in enumerate(zip(line, widths, strict=True)))
        for line in lines
    )
    return "\n".join("  ".join(line).rstrip() for line in cells)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a file, none if it does not exist. Files of earlier versions, JSON Lines, are read as well."""
    data = path.read_bytes() if path.is_file() else b""
    text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode("utf-8")
    return json.loads(text) if text.startswith("[") else [json.loads(line) for line in text.splitlines()]


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows to a file as a JSON list, atomically. Each row has a line of its own, for `grep` and `diff`."""
    write_text(path, "[" + ",".join(f"\n{json.dumps(row)}" for row in rows) + "\n]\n")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as comma-separated values with a header. Nested values are written as JSON, None as empty text."""
    text = io.StringIO()
    writer = csv.DictWriter(text, dict.fromkeys(name for row in rows for name in row), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: json.dumps(v) if isinstance(v, (Mapping, list)) else v for k, v in row.items()})
    write_text(path, text.getvalue())


def write_text(path: Path, text: str) -> None:
    """Write text to a file, atomically, with gzip if its name ends in ``.gz``. Missing folders are created.

    Threads, processes and containers may write the same file at the same time; one of their files remains, whole. A
    pipe or device, such as /dev/stdout, is written to and stays.
    """
    if path == STDOUT:
        sys.stdout.write(text)
        return
    if _is_stream(path):
        with path.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
        return
    data = _compressed(text.encode("utf-8")) if path.suffix == ".gz" else text.encode("utf-8")
    path.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{path.name[:50]}."  # file systems limit names to 255 bytes
    for left in path.parent.glob(f"{glob.escape(prefix)}*.part"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > _LEFT_OVER:
                left.unlink()
    temporary = path.with_name(f"{prefix}{secrets.token_hex(8)}.part")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _compressed(data: bytes) -> bytes:
    """Compress without name and time, so that the same rows are the same bytes."""
    packed = io.BytesIO()
    with gzip.GzipFile("", "wb", 9, packed, mtime=0) as file:
        file.write(data)
    return packed.getvalue()


def _is_stream(path: Path) -> bool:
    """Return whether a path is a pipe or device, which a renamed file would replace."""
    return path.exists() and not path.is_file() and not path.is_dir()


def check_writable(path: Path, option: str) -> None:
    """Check that a file can be written before doing the work that it will hold. This creates its folder.

    :param path: path of the file, or ``-``
    :param option: option of the command line that names the file, for error messages
    :raises ValueError: if the path is a folder, or its folder cannot be created or written to
    """
    if path == STDOUT:
        return
    if _is_stream(path):
        if not os.access(path, os.W_OK):
            raise ValueError(f"{option} {path} cannot be written (Permission denied): choose another file.")
        return
    if path.is_dir():
        raise ValueError(f"{option} {path} is a folder: pass the path of a file.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ValueError(
            f"{option} {path} cannot be written ({error.strerror or error}): choose another folder."
        ) from error
