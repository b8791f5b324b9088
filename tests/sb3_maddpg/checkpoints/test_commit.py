"""A checkpoint is on disk as a whole or not at all, and is used by one process."""

import json
import subprocess
import sys
import textwrap

import pytest
from resumed import EVERY, STEPS, Killed, edit, go_on, kill_at, make

from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.commit import locked, newest
from sb3_maddpg.checkpoints.state import digest
from studies.commit_points import POINTS


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_a_kill_at_any_moment_of_a_commit_loses_nothing_but_that_checkpoint(point, tmp_path, monkeypatch):
    expected = digest(make("replayed").learn(STEPS))
    kill_at(monkeypatch, point, 3)
    with pytest.raises(Killed):
        make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    path = newest(tmp_path)
    assert path is not None
    assert int(path.name.rpartition("-")[2]) in (2 * EVERY, 3 * EVERY)
    assert digest(go_on("replayed", tmp_path)) == expected
    assert not list(tmp_path.glob("*.unfinished"))
    assert len(list(tmp_path.glob("checkpoint-*"))) == 2


@pytest.mark.parametrize("damage", ["truncated", "flipped", "missing", "segment"])
def test_a_damaged_checkpoint_is_passed_over(damage, tmp_path):
    make("replayed").learn(350, callback=[RunCheckpoint(tmp_path, EVERY)])
    last = newest(tmp_path)
    path = last / "arrays.npz"
    if damage == "segment":
        path = max((tmp_path / "segments").iterdir())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2] if damage == "truncated" else content)
    with pytest.warns(UserWarning, match="is skipped: .*"):
        before = newest(tmp_path)
    assert before is not None
    assert before < last


def test_a_segment_counts_once(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, lambda state: state["segments"].extend(state["segments"][:1] * 40))
    with pytest.warns(UserWarning, match="is skipped: it names a segment twice"):
        assert newest(tmp_path) is None


def test_other_names_than_numbers_are_no_checkpoints(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    expected = newest(tmp_path)
    for name in ("checkpoint-²", "checkpoint-", "checkpoint-1e9", "checkpoint-+1", "checkpoint-٣x"):
        (tmp_path / name).mkdir()
    assert newest(tmp_path) == expected


@pytest.mark.parametrize("name", ["/dev/zero", "../" * 20 + "dev/zero", "..", "segments"])
@pytest.mark.parametrize("where", ["manifest", "segment"])
def test_a_checkpoint_names_files_in_its_folder_only(where, name, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    if where == "segment":
        edit(tmp_path, lambda state: state["segments"][0].update(name=name))
    else:
        (newest(tmp_path) / "manifest.json").write_text(json.dumps({name: "x"}))
    with pytest.warns(UserWarning, match=r"is skipped: InvalidFileError: there is no file .* in"):
        assert newest(tmp_path) is None


@pytest.mark.slow
def test_two_processes_do_not_write_into_one_folder(tmp_path):
    program = textwrap.dedent("""
        import sys
        from sb3_maddpg.checkpoints import locked
        with locked(sys.argv[1]):
            print("locked", flush=True)
            sys.stdin.read()
    """)
    other = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "locked\n"
    with pytest.raises(ValueError, match=f"is in use by process {other.pid} on "), locked(tmp_path):
        pass
    other.kill()
    other.wait()
    with locked(tmp_path):
        assert "process" in (tmp_path / "lock").read_text()
