"""The command of a run is its user's only where that user gave it."""

import json
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sb3_maddpg.cli.command_files import _key, read_command, resumable, write_command

ARGV = ["--env", "my_team/parallel_env", "-n", "300"]


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "state"))
    return tmp_path


def test_a_command_is_its_users_with_the_folder_where_it_was_given(home, monkeypatch):
    write_command(Path("run"), ARGV, 200)
    assert read_command(Path("run")) == (ARGV, 200, home)
    Path("run").rename("moved")
    (home / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert read_command(Path("../moved")) == (ARGV, 200, home)


@pytest.mark.parametrize(
    "change", [{"argv": ["--env", "other"]}, {"folder": "/"}, {"signature": "é"}, {"signature": None}]
)
def test_a_changed_command_is_not(change):
    write_command(Path("run"), ARGV, None)
    path = Path("run/command.json")
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    assert read_command(Path("run")).folder is None


def test_a_command_of_another_user_or_a_folder_that_is_gone_is_not(home, monkeypatch):
    Path("project").mkdir()
    monkeypatch.chdir("project")
    write_command(Path("../run"), ARGV, None)
    monkeypatch.chdir("..")
    assert read_command(Path("run")).folder == home / "project"
    Path("project").rename("renamed")
    assert read_command(Path("run")).folder is None
    Path("renamed").rename("project")
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "other"))
    monkeypatch.setenv("LOCALAPPDATA", str(home / "other"))
    assert read_command(Path("run")).folder is None


def test_without_a_place_for_a_key_nothing_is_signed(home, monkeypatch):
    write_command(Path("signed"), ARGV, None)
    (key,) = (home / "state").rglob("key")
    key.write_bytes(b"")  # anyone could sign with that
    assert read_command(Path("signed")).folder is None
    (home / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "file"))
    monkeypatch.setenv("LOCALAPPDATA", str(home / "file"))
    write_command(Path("run"), ARGV, None)
    assert read_command(Path("run")) == (ARGV, None, None)


def test_the_key_is_private_and_the_same_for_processes_that_start_together(home):
    with ThreadPoolExecutor(8) as threads:
        keys = set(threads.map(lambda _: _key(), range(8)))
    assert len(keys) == 1
    (path,) = (home / "state").rglob("*key*")
    assert path.read_bytes() in keys
    if os.name == "posix":
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"argv": 1, "every": null}', "[" * 100_000])
def test_a_damaged_command_is_refused(text):
    Path("run").mkdir()
    Path("run/command.json").write_text(text)
    with pytest.raises(ValueError, match="run is not the folder of a run with checkpoints"):
        read_command(Path("run"))


@pytest.mark.parametrize("option", ["-conf", "--conf-file", "--conf"])
def test_the_recipe_gets_an_absolute_path(home, option):
    argv = ["--env", "E", option, "r.yml"]
    assert resumable(argv) == argv  # there is no such file: the name of a packaged recipe
    Path("r.yml").touch()
    assert resumable(argv) == [*argv, "-conf", str(home / "r.yml")]
    assert resumable(resumable(argv)) == resumable(argv)
