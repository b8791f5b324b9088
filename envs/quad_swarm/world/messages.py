"""What robots send each other, packed as it would be sent: the size of a message is what communication costs."""

from __future__ import annotations

import struct

import numpy as np

_HEADER = struct.Struct("<BBI")  # who sends, whom it is for, the step in which it was made
REQUEST_BYTES = _HEADER.size
_MILLIMETRES = 1e-3
_FARTHEST = np.iinfo(np.int16).max * _MILLIMETRES


def pack_plan(sender: int, receiver: int, step: int, positions: np.ndarray) -> bytes:
    """A plan as an answer carries it: a header, and positions in millimetres as 16-bit integers.

    :param sender: whose plan it is, 0 to 255
    :param receiver: who asked for it, 0 to 255
    :param step: in which it was made
    :param positions: at stages 0..N, (N + 1, 3), world frame, within 32.7 m (m)
    :raises ValueError: a position is not finite or too far away
    """
    if not (np.abs(positions) <= _FARTHEST).all():
        farthest = float(np.abs(positions).max())
        raise ValueError(f"A plan reaches {farthest} m: messages hold coordinates of up to {_FARTHEST:.1f} m.")
    packed = np.rint(positions / _MILLIMETRES).astype("<i2").tobytes()
    return _HEADER.pack(sender, receiver, step) + packed


def unpack_plan(message: bytes) -> tuple[int, int, int, np.ndarray]:
    """Sender, receiver, step and positions, (N + 1, 3) (m), of a packed plan.

    :raises ValueError: it is no packed plan
    """
    size = len(message) - _HEADER.size
    if size <= 0 or size % 6:
        raise ValueError(f"A message of {len(message)} bytes is no plan: a header of {_HEADER.size} and 6 a stage.")
    sender, receiver, step = _HEADER.unpack_from(message)
    return sender, receiver, step, np.frombuffer(message, "<i2", offset=_HEADER.size).reshape(-1, 3) * _MILLIMETRES


def plan_bytes(horizon: int) -> int:
    """Size of an answer with a plan of ``horizon`` stages."""
    return _HEADER.size + 6 * (horizon + 1)
