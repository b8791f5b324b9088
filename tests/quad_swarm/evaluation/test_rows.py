"""Tables of rows in files."""

import json
from pathlib import Path

import pytest

from quad_swarm.evaluation.rows import check_writable, read_rows, write_csv, write_rows


def test_rows_come_back(tmp_path):
    path = tmp_path / "new" / "table.json"
    assert read_rows(path) == []
    rows = [{"a": 1, "b": None}, {"a": [1.5, "x"]}]
    write_rows(path, rows)
    assert read_rows(path) == json.loads(path.read_text()) == rows
    assert path.read_text().splitlines()[1] == '{"a": 1, "b": null},', "a line for each row, for grep and diff"
    assert list(path.parent.iterdir()) == [path]
    write_rows(path, [])
    assert read_rows(path) == json.loads(path.read_text()) == []


def test_files_of_earlier_versions_are_read(tmp_path):
    path = tmp_path / "table.json"
    path.write_text('{"a": 1}\n{"a": [2]}\n')
    assert read_rows(path) == [{"a": 1}, {"a": [2]}]


def test_a_dash_is_the_standard_output(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    check_writable(Path("-"), "--json")
    write_rows(Path("-"), [{"a": 1}, {"a": 2}])
    assert json.loads(capsys.readouterr().out) == [{"a": 1}, {"a": 2}]
    assert not list(tmp_path.iterdir())


def test_a_table_as_comma_separated_values(tmp_path):
    write_csv(tmp_path / "table.csv", [{"a": 1, "b": None}, {"a": "x, y", "c": {"d": 0.5}}])
    assert (tmp_path / "table.csv").read_text() == 'a,b,c\n1,,\n"x, y",,"{""d"": 0.5}"\n'


def test_nothing_is_left_of_a_table_that_cannot_be_written(tmp_path):
    with pytest.raises(TypeError):
        write_rows(tmp_path / "table.json", [{"a": 1}, {"a": object()}])
    assert not list(tmp_path.iterdir())


def test_a_path_that_cannot_be_written_is_found_before_the_work(tmp_path):
    check_writable(tmp_path / "new" / "table.json", "--json")
    with pytest.raises(ValueError, match=r"--json .* is a folder"):
        check_writable(tmp_path, "--json")
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="choose another folder"):
        check_writable(tmp_path / "file" / "table.json", "--json")
