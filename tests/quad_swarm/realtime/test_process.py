"""The process of a robot."""

import subprocess
import sys

from quad_swarm.realtime.process import set_priority
from quad_swarm.realtime.team import Team
from quad_swarm.world.presets import make_config


def test_a_process_without_a_team_ends_with_one_line(tmp_path):
    command = [sys.executable, "-m", "quad_swarm.realtime.udp_process", str(tmp_path / "no.json"), "0", "127.0.0.1:9"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert "no.json" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_robot_that_the_team_does_not_have(tmp_path):
    Team(make_config("flight", n_robots=2), "none").write(tmp_path / "team.json")
    command = [sys.executable, "-m", "quad_swarm.realtime.udp_process", str(tmp_path / "team.json"), "2", "127.0.0.1:9"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, "error: index=2: a team of 2 has the robots 0 to 1.\n")


def test_no_priority_is_no_request():
    assert set_priority(0)


def test_a_process_imports_what_a_vehicle_has():
    code = (
        "import quad_swarm.realtime.udp_process, sys; "
        "print([m for m in ('torch', 'gymnasium', 'pettingzoo', 'stable_baselines3') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
