"""Replay buffers in files: what is refused. That they come back is in test_buffers.py."""

import io
import zipfile

import numpy as np
import pytest
from gymnasium import spaces

from sb3_maddpg import PrioritizedTeamReplayBuffer, TeamReplayBuffer
from sb3_maddpg.common.buffer_files import read_buffer, write_buffer
from sb3_maddpg.files.archive import Archive

BOX, BITS = spaces.Box(-9, 9, (3, 2), np.float32), spaces.MultiBinary(6)


def filled(count: int = 3) -> PrioritizedTeamReplayBuffer:
    memory = PrioritizedTeamReplayBuffer(8, BOX, BITS, device="cpu")
    for index in range(count):
        obs = np.full((1, 3, 2), index, np.float32)
        memory.add(obs, obs, np.ones((1, 6)), np.ones(1), np.zeros(1), [{}])
    memory.sample(2)
    return memory


class Unnamed(TeamReplayBuffer):
    """A buffer of somebody else's."""


def test_a_buffer_of_ones_own_class_has_to_be_allowed():
    with pytest.raises(ValueError, match=r"class=.*Unnamed.* cannot be saved"):
        write_buffer(Unnamed(4, BOX, BITS), io.BytesIO())


@pytest.mark.parametrize(
    ("member", "change", "message"),
    [
        ("buffer.json", lambda b: b"[]", "buffer.json is damaged: it holds a list instead of values by name"),
        ("buffer.json", lambda b: b.replace(b'"pos": 3', b'"pos": 8'), "pos is 8"),
        ("buffer.json", lambda b: b.replace(b'"pos": 3', b'"pos": -1'), "pos is -1"),
        ("buffer.json", lambda b: b.replace(b'"pos": 3', b'"pos": 2'), r"of shape \(3, .*not .*of shape \(2, "),
        ("buffer.json", lambda b: b.replace(b'"full": false', b'"full": 0'), "full is 0"),
        ("buffer.json", lambda b: b.replace(b'"pos": 3, ', b""), "has the counters"),
        ("buffer.json", lambda b: b.replace(b"PrioritizedTeamReplayBuffer", b"ReplayBuffer"), "Unknown class"),
        (
            "buffer.json",
            lambda b: b.replace(b"sb3_maddpg.buffers.Prior", b"stable_baselines3.common.buffers.X"),
            "Unknown",
        ),
        ("priorities.npy", lambda b: b[:-8], "priorities.npy has 144 bytes"),
        ("priorities.npy", lambda b: b[:-8] + np.float64(-1).tobytes(), "negative"),
        ("numbers.npy", lambda b: b[:-4] + np.float32(np.nan).tobytes(), "numbers hold NaN or infinity"),
        ("actions.npy", lambda b: b.replace(b"(3, ", b"(9999999999, "), "not an array of"),
        ("actions.npy", lambda b: b.replace(b"'|i1'", b"'|O' "), r"not an array of|object"),
        ("actions.npy", lambda b: b"", "magic"),
    ],
)
def test_a_spoilt_file_of_a_buffer_is_refused(member, change, message):
    memory = filled()
    written, spoilt = io.BytesIO(), io.BytesIO()
    write_buffer(memory, written)
    with zipfile.ZipFile(written) as old, zipfile.ZipFile(spoilt, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == member:
                assert change(content) != content
                content = change(content)
            new.writestr(name, content)
    with pytest.raises(ValueError, match=message):
        read_buffer(Archive(spoilt, "buffer"), "cpu")


def test_a_compressed_file_of_a_buffer_is_refused_before_its_arrays_are_read(monkeypatch):
    original, compressed = io.BytesIO(), io.BytesIO()
    write_buffer(filled(), original)
    with zipfile.ZipFile(original) as old, zipfile.ZipFile(compressed, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name) + bytes(10**6) * (name == "observations.npy"))
    monkeypatch.setattr(np.lib.format, "read_array", None)
    with pytest.raises(ValueError, match=r"it has members of \d+ bytes, more than the file has"):
        read_buffer(Archive(compressed, "buffer"), "cpu")
