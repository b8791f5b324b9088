"""The process of a robot."""

import subprocess
import sys

import pytest

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


def test_a_priority_is_that_of_all_threads_but_not_of_processes_that_start():
    code = """
import os, subprocess, sys, threading
from quad_swarm.realtime.process import set_priority, without_priority
ends = threading.Event()
threading.Thread(target=ends.wait).start()
if set_priority(1):
    print({os.sched_getscheduler(int(one)) == os.SCHED_FIFO for one in os.listdir("/proc/self/task")})
    child = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0) == os.SCHED_FIFO)"]
    with without_priority():
        print(subprocess.run(child, capture_output=True, text=True).stdout.strip())
    print(os.sched_getscheduler(0) == os.SCHED_FIFO)
ends.set()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if not done.stdout:
        pytest.skip("the system allows no real-time priority")
    assert done.stdout == "{True}\nFalse\nTrue\n"


def test_a_process_imports_what_a_vehicle_has():
    code = (
        "import quad_swarm.realtime.udp_process, sys; "
        "print([m for m in ('torch', 'gymnasium', 'pettingzoo', 'stable_baselines3') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
