"""What a robot's process and its simulated world tell each other."""

import subprocess
import sys

import numpy as np
import pytest

from quad_swarm.realtime import Sensed
from quad_swarm.realtime.process import Report, pack_report, pack_sensed, set_priority, unpack_report, unpack_sensed
from quad_swarm.realtime.team import Team
from quad_swarm.world.presets import make_config


def test_what_is_perceived_is_not_rounded():
    rng = np.random.default_rng(0)
    sensed = Sensed(1_790_000_000_000_001, *(rng.normal(size=shape) for shape in ((9,), (3, 3), (3, 3))))
    again = unpack_sensed(pack_sensed(sensed), 3)
    assert again.stamp == sensed.stamp
    for one, other in zip(again[1:], sensed[1:], strict=True):
        assert one.tobytes() == other.tobytes()
    with pytest.raises(ValueError, match="no state"):
        unpack_sensed(pack_sensed(sensed), 4)


def test_reports():
    plan = np.arange(63, dtype=float).reshape(21, 3)
    report = Report(5, 1, 0b1001, 2**63, 0, plan)
    again = unpack_report(pack_report(report))
    assert again[:5] == report[:5]
    np.testing.assert_array_equal(again.plan, plan)
    with pytest.raises(ValueError, match="no report"):
        unpack_report(pack_report(report)[:-1])


def test_a_process_without_a_team_ends_with_one_line(tmp_path):
    command = [sys.executable, "-m", "quad_swarm.realtime.process", str(tmp_path / "no.json"), "0", "127.0.0.1:9"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert "no.json" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_robot_that_the_team_does_not_have(tmp_path):
    Team(make_config("flight", n_robots=2), "none").write(tmp_path / "team.json")
    command = [sys.executable, "-m", "quad_swarm.realtime.process", str(tmp_path / "team.json"), "2", "127.0.0.1:9"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, "error: index=2: a team of 2 has the robots 0 to 1.\n")


def test_no_priority_is_no_request():
    assert set_priority(0)


def test_a_process_imports_what_a_vehicle_has():
    code = (
        "import quad_swarm.realtime.process, sys; "
        "print([m for m in ('torch', 'gymnasium', 'pettingzoo', 'stable_baselines3') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
