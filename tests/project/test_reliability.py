"""Short forms of the studies of kills and of damaged files."""

import subprocess
import sys
from pathlib import Path

import pytest

from quad_swarm.evaluation.rows import read_rows
from studies.kills import POINTS

ROOT = Path(__file__).parents[2]


def study(name: str, *words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", f"studies.{name}", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500)


def test_five_kills_change_nothing(tmp_path):
    done = study("kills", "--kills", "5", "--steps", "4800", "--json", str(tmp_path / "kills.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    *rows, end = read_rows(tmp_path / "kills.json")
    assert end["kills"] == 5
    assert end["found"] == end["expected"]
    assert {row["kill"] for row in rows} == {"at any time", *POINTS[:2]}
    assert all(row["kept_step"] >= row["from_step"] for row in rows)


@pytest.mark.parametrize("seed", ["1"])
def test_damaged_files_are_refused_or_harmless(tmp_path, seed):
    done = study("mutated_files", "--count", "250", "--seed", seed, "--json", str(tmp_path / "files.json"))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = read_rows(tmp_path / "files.json")
    assert sum(row["count"] for row in rows) == 250
    assert {row["outcome"] for row in rows} == {"refused", "loaded"}
    assert len({row["file"] for row in rows}) == 8
