"""What all commands share: their options, and the check of files that they are going to write."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sb3_maddpg.cli.options import check_writable, import_packages


@pytest.mark.parametrize("name", ["../..", "", ".json", "a b", "\0", "json."])
def test_what_names_no_package_is_refused(name):
    with pytest.raises(ValueError, match=r"^--gym-packages .*: write the names of packages"):
        import_packages(["json", name])


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("my_ruls", "my_rules"),
        ("sb3_madpg", "sb3_maddpg"),
        ("sb3_maddpg.checkpoint", "sb3_maddpg.checkpoints"),
    ],
)
def test_the_nearest_module_is_named(tmp_path, monkeypatch, name, nearest):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_rules.py").touch()
    with pytest.raises(ModuleNotFoundError, match=rf"--gym-packages {name}: .*\. Did you mean '{nearest}'\?$"):
        import_packages([name])


def test_a_module_that_lacks_another_says_so(tmp_path, monkeypatch):
    (tmp_path / "needy.py").write_text("import jsom")
    monkeypatch.syspath_prepend(tmp_path)
    message = r"^--gym-packages needy: .* \(ModuleNotFoundError: No module named 'jsom'\): repair it, or install what"
    with pytest.raises(ImportError, match=message):
        import_packages(["needy"])


def test_a_file_that_can_be_written_is_left_as_it_is(tmp_path):
    new = tmp_path / "a" / "b" / "new.json"
    check_writable(new)
    assert new.parent.is_dir()
    assert not new.exists()
    old = tmp_path / "old.json"
    old.write_text("kept")
    check_writable(old)
    assert old.read_text() == "kept"


@pytest.mark.parametrize("path", [".", "file/new.json"])
def test_a_file_that_cannot_be_written_is_told_before_the_work(tmp_path, path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=path.partition("/")[0]):
        check_writable(tmp_path / path)


def test_other_processes_never_find_an_empty_file(tmp_path, monkeypatch):
    opened, found = Path.open, []

    def watched(path: Path, *args, **kwargs):
        file = opened(path, *args, **kwargs)
        found.extend(tmp_path.iterdir())
        return file

    monkeypatch.setattr(Path, "open", watched)
    check_writable(tmp_path / "best.yml")
    assert not found
    assert not list(tmp_path.iterdir())


def test_processes_that_start_together_check_the_same_file(tmp_path):
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(check_writable, [tmp_path / "best.yml"] * 2000))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_to_is_told_with_the_file(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError, match=r"best\.yml"):
        check_writable(tmp_path / "best.yml")
