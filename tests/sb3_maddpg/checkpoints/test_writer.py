"""Segments of the replay buffer, written while the training goes on."""

import time

import pytest
from resumed import EVERY, STEPS, Killed, edit, go_on, kill_at, make

from sb3_maddpg.checkpoints import writer
from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.checkpoints.state import digest
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.states import Replayable


@pytest.mark.slow
def test_only_new_transitions_are_written(tmp_path):
    make("replayed", buffer_size=500).learn(400, callback=[RunCheckpoint(tmp_path, EVERY)])
    sizes = [path.stat().st_size for path in sorted((tmp_path / "segments").iterdir())]
    assert len(sizes) == 3
    row = sizes[0] // 100
    assert all(abs(size / row - EVERY) < 8 for size in sizes)
    make("replayed", buffer_size=150).learn(STEPS, callback=[RunCheckpoint(tmp_path / "ring", EVERY)])
    assert len(list((tmp_path / "ring" / "segments").iterdir())) <= 4, "what the ring has overwritten is removed"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["swarms", "memory", "replayed"])
def test_a_slow_disk_does_not_change_a_checkpoint(name, tmp_path, monkeypatch):
    """The training overwrites all rows of the buffer while the thread writes."""
    expected = digest(make(name, buffer_size=100).learn(STEPS))
    monkeypatch.setattr(writer, "_BLOCK", 1000)
    waited = []
    blocks, wait = writer._stored_block, writer.Writer.wait_for

    def slowly(*args):
        time.sleep(0.01)
        return blocks(*args)

    monkeypatch.setattr(writer, "_stored_block", slowly)
    monkeypatch.setattr(writer.Writer, "wait_for", lambda self, row: waited.append(row) or wait(self, row))
    kill_at(monkeypatch, "committed", 3)
    with pytest.raises(Killed):
        make(name, buffer_size=100).learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    assert waited, "the training would have overwritten rows that were not yet written"
    assert digest(go_on(name, tmp_path)) == expected


@pytest.mark.slow
def test_observations_are_written_once(tmp_path):
    model = make("swarms")
    model.learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    record = model.replay_buffer.records.dtype
    for path in (tmp_path / "segments").iterdir():
        first, end = map(int, path.stem.split("-"))
        rows = (end - first) * model.n_envs
        assert path.stat().st_size < rows * (record.itemsize - 0.8 * record["next_observations"].itemsize)


@pytest.mark.parametrize("rows", [{"end": 10**12}, {"first": 90, "end": 90}, {"end": 251}, {"first": "0"}])
def test_a_segment_holds_the_rows_that_it_claims(rows, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, lambda state: state["segments"][0].update(rows))
    with pytest.raises(ValueError, match=r"does not hold the rows|but rows from|its segments end"):
        resume(tmp_path, Replayable(OwnBit()))
