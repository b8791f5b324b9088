"""Tables of rows in files."""

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
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


def test_compressed_rows_come_back_and_are_the_same_bytes_every_time(tmp_path, monkeypatch):
    pandas = pytest.importorskip("pandas")
    rows = [{"a": 1, "b": None, "c": "é"}, {"a": 2, "b": 0.1, "c": "d"}] * 50
    first, second = tmp_path / "table.json.gz", tmp_path / "other.json.gz"
    write_rows(first, rows)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    write_rows(second, rows)
    assert read_rows(first) == rows
    assert first.read_bytes() == second.read_bytes()
    assert first.stat().st_size < len(json.dumps(rows)) / 10
    assert pandas.read_json(first).equals(pandas.DataFrame(rows))
    write_csv(tmp_path / "table.csv.gz", rows)
    assert pandas.read_csv(tmp_path / "table.csv.gz").equals(pandas.DataFrame(rows))


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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_a_pipe_is_written_to_and_stays(tmp_path):
    pipe = tmp_path / "table.json"
    os.mkfifo(pipe)
    check_writable(pipe, "--json")
    with ThreadPoolExecutor() as pool:
        read = pool.submit(pipe.read_text)
        write_rows(pipe, [{"a": 1}])
        assert json.loads(read.result()) == [{"a": 1}]
    assert pipe.is_fifo()


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


def test_writers_at_the_same_time_leave_one_whole_table(tmp_path):
    path = tmp_path / "table.json"
    tables = [[{"a": number}] * 5_000 for number in range(4)]

    def write(rows: list) -> None:
        for _ in range(10):
            write_rows(path, rows)

    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(write, rows) for rows in tables]:
            done.result()
    assert read_rows(path) in tables
    assert os.listdir(tmp_path) == ["table.json"]


def test_what_kills_left_of_a_table_is_removed(tmp_path):
    for name, age in ((".table.json.0123456789abcdef.part", 7200), (".table.json.fedcba9876543210.part", 60)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    write_rows(tmp_path / "table.json", [{"a": 1}])
    assert sorted(os.listdir(tmp_path)) == [".table.json.fedcba9876543210.part", "table.json"]
