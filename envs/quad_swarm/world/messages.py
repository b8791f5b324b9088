"""Binary messages between robots, whose size measures the cost of communication."""

from __future__ import annotations

import struct

import numpy as np

from quad_swarm.errors import shown

_HEADER = struct.Struct("<BBI")  # sender, receiver, step
REQUEST_BYTES = _HEADER.size
_MILLIMETRES = 1e-3
_RANGE_OF_MESSAGES = np.iinfo(np.int16).max * _MILLIMETRES


def pack_plan(sender: int, receiver: int, step: int, positions: np.ndarray) -> bytes:
    """Pack a plan into an answer: a header, and positions in millimetres as 16-bit integers.

    :param sender: robot whose plan it is, 0 to 255
    :param receiver: robot that requested it, 0 to 255
    :param step: step in which the plan was made
    :param positions: positions at stages 0..N, (N + 1, 3), world frame, within 32.7 m (m)
    :raises ValueError: if a position is not finite or too far away, or another value does not fit into a message
    """
    for name, value, largest in (("sender", sender, 255), ("receiver", receiver, 255), ("step", step, 2**32 - 1)):
        # A bool is an int, but no number of a robot; NumPy's integers are as good as Python's
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value <= largest:
            raise ValueError(f"{name}={shown(value)}: messages hold an integer from 0 to {largest}.")
    positions = np.asarray(positions)
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions) or positions.dtype.kind not in "fiu":
        raise ValueError(
            f"positions have shape {positions.shape} and type {positions.dtype}: a plan holds positions at stages "
            "0..N, (N + 1, 3)."
        )
    if not (np.abs(positions) <= _RANGE_OF_MESSAGES).all():
        farthest = float(np.abs(positions).max())
        raise ValueError(f"A plan reaches {farthest} m: messages hold coordinates of up to {_RANGE_OF_MESSAGES:.1f} m.")
    packed = np.rint(positions / _MILLIMETRES).astype("<i2").tobytes()
    return _HEADER.pack(sender, receiver, step) + packed


def unpack_plan(message: bytes) -> tuple[int, int, int, np.ndarray]:
    """Unpack a plan into sender, receiver, step and positions, (N + 1, 3) (m).

    :raises ValueError: if the message is not a packed plan
    """
    size = len(message) - _HEADER.size
    if size <= 0 or size % 6:
        raise ValueError(f"A message of {len(message)} bytes is not a plan: {_HEADER.size} bytes and 6 per stage.")
    sender, receiver, step = _HEADER.unpack_from(message)
    return sender, receiver, step, np.frombuffer(message, "<i2", offset=_HEADER.size).reshape(-1, 3) * _MILLIMETRES


def plan_bytes(horizon: int) -> int:
    """Return the size in bytes of an answer with a plan of ``horizon`` stages."""
    return _HEADER.size + 6 * (horizon + 1)
