"""Studies of learning: particle worlds, other libraries, cross-play, estimators, and the cost of large swarms."""

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from quad_swarm.evaluation.rows import read_rows

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "data"

pytest.importorskip("mpe2")
from studies import crossplay, learning, mpe  # noqa: E402


def test_worlds_in_batches_step_as_those_of_mpe2():
    for name in crossplay.COMPETITIVE:
        crossplay.check(name, crossplay.EPISODES[:2])
        worlds = crossplay.Worlds(name, crossplay.EPISODES[:2])
        assert set(learning.sides(worlds.agents)) == {"adversary", "good"}


def test_trainings_are_averaged_by_side_and_compared_with_ours():
    shared = {"library": "x", "version": "1", "steps": 9, "train_freq": 100, "machine": "m", "training_cpu_s": 1.0}
    returns = {"adversary_0": 4.0, "adversary_1": 2.0, "agent_0": -1.0}
    runs = [
        {"env": "simple_tag_v3", "driver": driver, "returns": {agent: k + value for agent, value in returns.items()}}
        for driver, numbers in ((learning.OURS, (0, 2)), (learning.REFERENCE, (0, 0, 0)))
        for k in numbers
    ]
    rows = learning.summarise(run | shared for run in runs)
    assert [(row["side"], row["driver"], row["return"]) for row in rows] == [
        ("adversary", learning.OURS, 4.0),
        ("adversary", learning.REFERENCE, 3.0),
        ("good", learning.OURS, 0.0),
        ("good", learning.REFERENCE, -1.0),
    ]
    assert rows[1]["ours_minus"] == 1.0
    assert learning.interval([1.0, 3.0]) == pytest.approx((2.0, 12.706205))
    assert np.isnan(learning.interval([1.0])[1])


def test_a_side_scores_against_every_library_alike():
    trainings = [(learning.OURS, 0, 9), (learning.OURS, 1, 9), (learning.REFERENCE, 0, 9)]
    adversary = np.array([[0.0, 2.0, 5.0], [0.0, 2.0, 5.0], [1.0, 1.0, 1.0]])
    ours, plain = crossplay.summarise("simple_tag_v3", trainings, {"adversary": adversary})
    assert ours["against"] == {learning.OURS: 1.0, learning.REFERENCE: 5.0}
    assert (ours["score"], ours["others"], plain["score"], plain["ours_minus"]) == (3.0, 5.0, 1.0, 2.0)


def test_the_recorded_curves_are_those_of_the_table(capsys):
    mpe.report(json.loads((DATA / "mpe2.json").read_text())["runs"])
    page = (ROOT / "docs" / "results" / "mpe2.md").read_text()
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("mpe2/")]
    assert len(lines) >= 5
    means = [word for line in lines for word, sign in pairwise(line) if sign == "±"]
    assert len(means) == 2 * len(lines)
    assert [mean for mean in means if mean not in page] == []


def test_comparisons_are_corrected_for_their_number(capsys):
    # Holm's example has p-values whose corrected ones may not fall again
    assert mpe.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    rows = json.loads((DATA / "mpe2.json").read_text())["runs"]
    found = mpe.comparisons(rows)
    assert len(found) == 10
    difference, half, p = found["mpe2/simple_speaker_listener_v4", "continuous", "iddpg"]
    assert (difference, half, p) == pytest.approx((3.93, 3.75, 0.0431), abs=0.01)
    assert min(mpe.holm([p for _, _, p in found.values()])) > 0.3
    mpe.report(rows)
    assert "mpe2/simple_speaker_listener_v4  continuous  iddpg     +3.93 ± 3.75" in capsys.readouterr().out


def test_the_recorded_trainings_and_games_are_printed(capsys):
    for study in (learning, crossplay):
        rows = read_rows(DATA / f"{study.__name__.rpartition('.')[2]}.json")
        study.report([{key: np.nan if value is None else value for key, value in row.items()} for row in rows])
    out = capsys.readouterr().out
    assert "-16.57" in out
    assert "simple_adversary_v3, good" in out


@pytest.mark.slow
def test_large_swarms_are_measured_with_and_without_a_neighbourhood(tmp_path):
    words = ["--sizes", "4", "--envs", "2", "--seconds", "0.01", "--json", str(tmp_path / "rows.json")]
    subprocess.run([sys.executable, "-m", "studies.large_swarms", *words], check=True, cwd=ROOT, timeout=500)
    rows = read_rows(tmp_path / "rows.json")
    assert [row["perceived"] for row in rows] == ["all", "planned", "limited"]
    assert rows[0].keys() == read_rows(DATA / "large_swarms_speed.json")[0].keys()


@pytest.mark.slow
def test_robots_fly_while_something_goes_wrong(tmp_path):
    words = ["--fault", "nothing", "a process dies", "--episodes", "1", "--json", str(tmp_path / "rows.json")]
    subprocess.run([sys.executable, "-m", "studies.robots", *words], check=True, cwd=ROOT, timeout=500)
    rows = read_rows(tmp_path / "rows.json")
    assert [row["fault"] for row in rows] == ["nothing"] * 3 + ["a process dies"] * 3
    assert rows[0].keys() == read_rows(DATA / "robots.json")[0].keys()
    assert all(row["counts"]["plans received"] > 0 for row in rows)
