"""Messages between robots, version 1, little-endian: requests, and plans of at most 64 bytes.

====== ==== =========================================================
offset size request, and the head of a plan
====== ==== =========================================================
0      1    magic and version, 0xA1
1      1    kind (1 request, 2 answer, 3 announcement), or 16 more with a checksum
2      1    sender
3      1    receiver, 255 for everybody
4      1    session, which tells apart teams and flights on one channel
5      4    time of sending (us, modulo 2^32)
====== ==== =========================================================

A plan continues with the age of its first point (0.1 ms, 2 bytes), the length of a stage (ms, 1 byte), and 2 bytes that
hold the number of points (6 bits) and the widths of the first difference and of the second differences (4 bits each).
The first point follows (mm, 3 x 2 bytes), and then without gaps the three numbers of the first difference and those of
the second differences, in as few bits as hold all of them. Positions are thus exact to half a millimetre. A checksum
(CRC-16/CCITT) may end a message, for radios without one of their own.

`pack_plan` and `unpack` are inverse to each other on that grid. `unpack` raises `WireError` for everything else.
"""

from __future__ import annotations

import binascii
import struct
from typing import NamedTuple

import numpy as np

MAGIC, EVERYBODY = 0xA1, 255
REQUEST, ANSWER, ANNOUNCEMENT = 1, 2, 3
CHECKED = 16  # added to the kind of messages with a checksum
MOST_BYTES = 64

_HEAD = struct.Struct("<BBBBBI")
_CONTENT = struct.Struct("<HBH")  # age, stage, number of points and widths
_FIRST = struct.Struct("<3h")
_CHECKSUM = struct.Struct("<H")
_LARGEST = 2**15 - 1  # mm
_MODULUS = 2**32


class WireError(ValueError):
    """Raised for bytes that are no message of this version and session, and for what no message can hold."""


class Message(NamedTuple):
    """A message.

    :param kind: `REQUEST`, `ANSWER` or `ANNOUNCEMENT`
    :param sender: robot that sent it
    :param receiver: robot that it is for, or `EVERYBODY`
    :param sent: time of sending (us, modulo 2^32), see `nearest`
    :param stamp: time of the plan's first point (us, modulo 2^32); 0 in a request
    :param period: length of the plan's stages (us); 0 in a request
    :param positions: the plan, (N + 1, 3), world frame (m); None in a request
    """

    kind: int
    sender: int
    receiver: int
    sent: int
    stamp: int = 0
    period: int = 0
    positions: np.ndarray | None = None


def nearest(time: int, now: int) -> int:
    """Return the time (us) nearest to another that equals a time modulo 2^32."""
    return now + (time - now + _MODULUS // 2) % _MODULUS - _MODULUS // 2


def pack_request(session: int, sender: int, receiver: int, sent: int, checked: bool = False) -> bytes:
    """Pack a request.

    :param session: session, 0 to 255
    :param sender: robot that asks, 0 to 254
    :param receiver: robot that is asked, 0 to 254, or `EVERYBODY`
    :param sent: time of sending (us)
    :param checked: whether to add a checksum
    :raises WireError: if a number does not fit into a message
    """
    return _ended(_head(session, sender, receiver, sent, REQUEST, checked), checked)


def pack_plan(
    session: int,
    sender: int,
    receiver: int,
    sent: int,
    stamp: int,
    period: int,
    positions: np.ndarray,
    asked: bool = True,
    checked: bool = False,
) -> bytes:
    """Pack a plan.

    :param session: session, 0 to 255
    :param sender: robot whose plan it is, 0 to 254
    :param receiver: robot that it is for, 0 to 254, or `EVERYBODY`
    :param sent: time of sending (us)
    :param stamp: time of the plan's first point (us), at most 6.5 s before that
    :param period: length of a stage (us), whole milliseconds up to 255
    :param positions: positions, (N + 1, 3), N from 2 to 62, world frame, within 32.767 m (m)
    :param asked: whether it answers a request, or announces the plan
    :param checked: whether to add a checksum
    :raises WireError: if a number does not fit into a message
    """
    points = np.asarray(positions, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not 3 <= len(points) <= 63:
        raise WireError(f"A plan of shape {points.shape} cannot be sent: it has 3 to 63 points, (N + 1, 3).")
    if not (np.abs(points) <= _LARGEST * 1e-3).all():
        raise WireError(f"A plan must be finite and within {_LARGEST * 1e-3} m.")
    milliseconds, rest = divmod(period, 1000)
    age = (sent - stamp + 50) // 100
    if rest or not 0 < milliseconds < 256:
        raise WireError(f"Stages of {period} us cannot be sent: they last whole milliseconds up to 255.")
    if not 0 <= age < 2**16:
        raise WireError(f"A plan of {(sent - stamp) * 1e-6} s ago cannot be sent: at most 6.5 s ago.")
    grid = np.rint(points * 1e3).astype(np.int64)
    steps = np.diff(grid, axis=0)
    first, second = steps[0], np.diff(steps, axis=0).ravel()
    widths = _width(first), _width(second)
    if max(widths) > 15:
        raise WireError("The points of a plan are too far apart to be sent.")
    bits = np.concatenate([_to_bits(first, widths[0]), _to_bits(second, widths[1])])
    shape = len(points) | widths[0] << 6 | widths[1] << 10
    head = _head(session, sender, receiver, sent, ANSWER if asked else ANNOUNCEMENT, checked)
    content = _CONTENT.pack(age, milliseconds, shape)
    packed = np.packbits(bits, bitorder="little").tobytes()
    return _ended(head + content + _FIRST.pack(*grid[0]) + packed, checked)


def unpack(message: bytes, session: int) -> Message:
    """Unpack a message.

    :param message: bytes that arrived
    :param session: the own session
    :raises WireError: if the bytes are no message of this version and session, or damaged
    """
    if len(message) < _HEAD.size:
        raise WireError(f"{len(message)} bytes are too few for a message.")
    magic, kind, sender, receiver, theirs, sent = _HEAD.unpack_from(message)
    if magic != MAGIC:
        raise WireError(f"The first byte is {magic:#x}, not {MAGIC:#x}: another protocol or version.")
    if theirs != session:
        raise WireError(f"The message belongs to session {theirs}, not {session}.")
    if kind & CHECKED:
        kind ^= CHECKED
        message, tail = message[: -_CHECKSUM.size], message[-_CHECKSUM.size :]
        if len(message) < _HEAD.size or binascii.crc_hqx(message, 0xFFFF) != _CHECKSUM.unpack(tail)[0]:
            raise WireError("The checksum does not fit the message.")
    if sender == EVERYBODY:
        raise WireError(f"{EVERYBODY} is no sender.")
    if kind == REQUEST:
        if len(message) != _HEAD.size:
            raise WireError(f"A request has {_HEAD.size} bytes, not {len(message)}.")
        return Message(kind, sender, receiver, sent)
    if kind not in (ANSWER, ANNOUNCEMENT):
        raise WireError(f"There is no message of kind {kind}.")
    age, milliseconds, positions = _plan(message)
    return Message(kind, sender, receiver, sent, (sent - 100 * age) % _MODULUS, 1000 * milliseconds, positions)


def _plan(message: bytes) -> tuple[int, int, np.ndarray]:
    """Return age (0.1 ms), length of a stage (ms) and positions of a message with a plan."""
    start = _HEAD.size + _CONTENT.size + _FIRST.size
    if len(message) <= start:
        raise WireError(f"{len(message)} bytes are too few for a plan.")
    age, milliseconds, shape = _CONTENT.unpack_from(message, _HEAD.size)
    count, widths, rest = shape & 63, (shape >> 6 & 15, shape >> 10 & 15), shape >> 14
    sizes = 3 * widths[0], 3 * (count - 2) * widths[1]
    if count < 3 or not min(widths) or not milliseconds or rest or len(message) != start + (sum(sizes) + 7) // 8:
        raise WireError("The sizes in a plan do not fit its length.")
    bits = np.unpackbits(np.frombuffer(message, np.uint8, offset=start), bitorder="little")
    if bits[sum(sizes) :].any():
        raise WireError("There are bits after the end of a plan.")
    grid = np.empty((count, 3), dtype=np.int64)
    grid[0] = _FIRST.unpack_from(message, _HEAD.size + _CONTENT.size)
    grid[1] = _from_bits(bits[: sizes[0]], widths[0])
    grid[2:] = _from_bits(bits[sizes[0] : sum(sizes)], widths[1]).reshape(-1, 3)
    grid[1:] = grid[1:].cumsum(axis=0)
    grid = grid.cumsum(axis=0)
    if np.abs(grid).max() > _LARGEST:
        raise WireError(f"A plan leads beyond {_LARGEST * 1e-3} m.")
    return age, milliseconds, grid * 1e-3


def _head(session: int, sender: int, receiver: int, sent: int, kind: int, checked: bool) -> bytes:
    for name, value, most in (("session", session, 255), ("sender", sender, 254), ("receiver", receiver, 255)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value <= most:
            raise WireError(f"{name}={value!r} must be an integer from 0 to {most}.")
    return _HEAD.pack(MAGIC, kind | (CHECKED if checked else 0), sender, receiver, session, sent % _MODULUS)


def _ended(message: bytes, checked: bool) -> bytes:
    return message + _CHECKSUM.pack(binascii.crc_hqx(message, 0xFFFF)) if checked else message


def _width(numbers: np.ndarray) -> int:
    """Return the number of bits that hold all of some integers in two's complement."""
    return max(int(numbers.max()), -int(numbers.min()) - 1).bit_length() + 1


def _to_bits(numbers: np.ndarray, width: int) -> np.ndarray:
    return (numbers[:, None] >> np.arange(width) & 1).astype(np.uint8).ravel()


def _from_bits(bits: np.ndarray, width: int) -> np.ndarray:
    weights = 1 << np.arange(width)
    weights[-1] *= -1
    return bits.reshape(-1, width).astype(np.int64) @ weights
