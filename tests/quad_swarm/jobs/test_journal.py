"""Finished pieces in files: whole or absent, told apart by what they are a function of."""

import os
import time
import warnings
from pathlib import Path

import pytest

from quad_swarm.jobs import Journal
from quad_swarm.jobs.journal import default_folder


def test_keeps_values_as_they_are(tmp_path):
    journal = Journal(tmp_path / "pieces")
    value = [{"a": 0.1 + 0.2, "b": 3, "c": True, "d": float("inf"), "e": None}]
    assert journal.fetch("key") is None
    journal.keep("key", value)
    assert Journal(tmp_path / "pieces").fetch("key") == value
    assert [path.name for path in (tmp_path / "pieces").iterdir()] == ["key.json"]
    journal.drop(["key", "never kept"])
    assert journal.fetch("key") is None


@pytest.mark.parametrize("content", ["", "{", "[]", '{"other": 1}', "\0\0", '{"value": [1', '{"value": 1}', "[" * 9999])
def test_a_damaged_file_counts_as_none(content, tmp_path):
    (tmp_path / "key.json").write_text(content)
    assert Journal(tmp_path).fetch("key") is None


def test_a_changed_value_counts_as_none(tmp_path):
    journal = Journal(tmp_path)
    journal.keep("key", [{"collided": True}])
    whole = (tmp_path / "key.json").read_text()
    (tmp_path / "key.json").write_text(whole.replace("true", "false"))
    (tmp_path / "another.json").write_text(whole)
    assert (journal.fetch("key"), journal.fetch("another")) == (None, None)
    (tmp_path / "key.json").write_text(whole)
    assert journal.fetch("key") == [{"collided": True}]


def test_keeps_nothing_without_a_folder():
    journal = Journal(None)
    journal.keep("key", 1)
    assert journal.fetch("key") is None
    journal.drop(["key"])


def test_where_nothing_can_be_written_the_work_goes_on(tmp_path):
    (tmp_path / "file").touch()
    journal = Journal(tmp_path / "file" / "pieces")
    with pytest.warns(RuntimeWarning, match="a killed run will start from scratch") as notices:
        journal.keep("a", 1)
    assert len(notices) == 1
    journal.keep("b", 1)  # said once is enough


def test_a_full_disk_leaves_no_half_written_file(tmp_path, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.warns(RuntimeWarning, match="No space left"):
        Journal(tmp_path).keep("key", 1)
    assert not list(tmp_path.iterdir())


def test_what_a_kill_left_of_a_piece_goes_with_it(tmp_path, monkeypatch):
    class Killed(BaseException):
        pass

    def die(*_, **__):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", die)
        patch.setattr(Path, "unlink", die)  # the dead clear nothing away
        with pytest.raises(Killed):
            Journal(tmp_path).keep("key", 1)
    journal = Journal(tmp_path)
    journal.keep("other", 2)
    assert len(list(tmp_path.glob("key.*.part"))) == 1
    journal.drop(["key"])
    assert [path.name for path in tmp_path.iterdir()] == ["other.json"]


def test_two_that_do_the_same_work_may_both_finish(tmp_path, monkeypatch):
    replace = os.replace

    def beaten(source, target):
        Journal(tmp_path).drop(["key"])
        replace(source, target)

    monkeypatch.setattr(os, "replace", beaten)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Journal(tmp_path).keep("key", 1)
    assert not list(tmp_path.iterdir())


def test_what_nobody_fetches_is_removed_after_a_month(tmp_path):
    for name in ("old", "young"):
        Journal(tmp_path).keep(name, 1)
    for name, days in (("old", 40), ("young", 1)):
        path = tmp_path / f"{name}.json"
        os.utime(path, (time.time() - days * 86400,) * 2)
    journal = Journal(tmp_path)
    assert (journal.fetch("old"), journal.fetch("young")) == (None, 1)


def test_keys_name_code_files_and_arguments(tmp_path, monkeypatch):
    module = tmp_path / "own_rules_of_a_user.py"
    module.write_text("a = 1")
    monkeypatch.syspath_prepend(tmp_path)
    model = tmp_path / "model"
    model.write_bytes(b"1")
    base = ("what", ["quad_swarm"], [model])
    keys = [
        Journal.key(*base),
        Journal.key("else", *base[1:]),
        Journal.key("what", ["quad_swarm", module.stem], [model]),
    ]
    model.write_bytes(b"2")
    keys.append(Journal.key(*base))
    assert len(set(keys)) == len(keys)
    assert Journal.key(*base) == keys[-1]


def test_lies_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("QUAD_SWARM_CACHE", str(tmp_path))
    assert default_folder() == tmp_path / "pieces"
