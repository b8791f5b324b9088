"""What all commands share: their options, and the check of files that they are going to write."""

import pytest

from sb3_maddpg.cli.options import check_writable, common_options, import_packages


def test_what_is_not_common_is_left_to_others():
    options, rest = common_options().parse_known_args(["--env", "OwnBit-v0", "--seed", "1", "--gym-packages", "a", "b"])
    assert (options.algo, options.env, options.gym_packages) == ("maddpg", "OwnBit-v0", ["a", "b"])
    assert rest == ["--seed", "1"]
    options, rest = common_options().parse_known_args(["--al", "matd3"])
    assert (options.algo, rest) == ("maddpg", ["--al", "matd3"]), "options are not abbreviated"


@pytest.mark.parametrize("name", ["../..", "", ".json", "a b", "\0", "json."])
def test_what_names_no_package_is_refused(name):
    with pytest.raises(ValueError, match=r"^--gym-packages .*: give the names of packages"):
        import_packages(["json", name])


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
