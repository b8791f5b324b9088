"""``sb3-maddpg bench``: the times it measures, and what it refuses."""

import json
import time
from pathlib import Path

import pytest

from sb3_maddpg.cli.bench import timed
from sb3_maddpg.cli.main import main


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_stopwatch_adds_up_and_changes_nothing():
    def function(seconds: float, *, fail: bool = False) -> float:
        time.sleep(seconds)
        if fail:
            raise KeyError(seconds)
        return seconds

    total = [1.0]
    call = timed(function, total)
    assert call(0.01) == 0.01
    with pytest.raises(KeyError):
        call(0.01, fail=True)
    assert 1.02 <= total[0] < 2


def test_bench_says_where_the_time_goes(capsys):
    assert main(["bench", "--env", "OwnBit-v0", "-n", "700", "--json", "bench.json"]) == 0
    result = json.loads(Path("bench.json").read_text())
    assert result["steps"] == 700
    assert result["updates"] > 0
    shares = [result[f"share_{name}"] for name in ("environments", "learning", "acting", "rest")]
    assert all(share > 0 for share in shares)
    assert sum(shares) == pytest.approx(1)
    assert "steps/s" in capsys.readouterr().out
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["-n", "0"], "argument -n/--n-timesteps: 0: choose 1 or more"),
        (["--json", "folder"], "folder: Is a directory"),
        (["--json", "file/bench.json"], "file"),
    ],
)
def test_bench_finds_out_before_the_work_that_it_cannot_be_done(capsys, argv, message):
    Path("folder").mkdir()
    Path("file").touch()
    assert main(["bench", "--env", "OwnBit-v0", *argv]) == (2 if "-n" in argv else 1)
    shown = capsys.readouterr()
    assert f"error: {message}" in shown.err
    assert shown.err.count("\n") == 1
    assert "hyperparameters" not in shown.out


def test_bench_writes_a_json_object_alone_to_the_standard_output(capsys):
    assert main(["bench", "--env", "OwnBit-v0", "-n", "300", "--json", "-"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["steps"] == 300
    assert "steps/s" in printed.err
    assert not Path("-").exists()
