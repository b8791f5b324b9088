"""Simulators in a process of their own: what they refuse arrives, and their death is told."""

import gc
import importlib.util
import os
import signal
import subprocess
import sys

import foreign
import gymnasium as gym
import numpy as np
import pytest

import quad_swarm  # noqa: F401 - registers the environment
from quad_swarm.plants import SIMULATORS, PlantError, Simulator, make_plant
from quad_swarm.plants.remote import RemotePlant, _server, _servers
from quad_swarm.quadrotor import QuadrotorParams

needs_crazyflow = pytest.mark.skipif(
    importlib.util.find_spec("mujoco") is None, reason="the extra `plants` is not installed"
)


def make(dt: float = 0.01) -> RemotePlant:
    plant = make_plant("crazyflow", QuadrotorParams(), dt, 1, 2)
    assert isinstance(plant, RemotePlant)
    plant.place(0, np.zeros((2, 9)))
    return plant


@needs_crazyflow
def test_what_the_simulator_refuses_arrives_as_it_is():
    with pytest.raises(ValueError, match=r"crazyflow needs sub-steps that are multiples of 2 ms"):
        make(0.005001)


@pytest.mark.slow
@needs_crazyflow
def test_all_plants_share_one_process_until_it_dies():
    first, second = make(), make()
    assert first._server is second._server
    state, u, air = np.zeros((1, 2, 9)), np.zeros((1, 2, 4)), np.zeros((1, 2, 2))
    assert np.isfinite(first.step(state, u, air, None)).all()
    os.kill(first._server.process.pid, signal.SIGKILL)
    with pytest.raises(PlantError, match="The simulator's process exited with -9"):
        first.step(state, u, air, None)
    third = make()
    assert third._server is not first._server
    assert np.isfinite(third.step(state, u, air, None)).all()


@pytest.mark.slow
@needs_crazyflow
def test_plants_that_are_gone_are_dropped():
    plant = make()
    number = plant._number
    del plant
    gc.collect()
    with pytest.raises(ValueError, match=f"no plant {number}"):
        _server("crazyflow").call("fork", number)


@needs_crazyflow
def test_each_simulator_has_a_process_of_its_own():
    assert _server("crazyflow") is _server("crazyflow")
    assert _server("crazyflow").process.pid != _server("rotorpy").process.pid


@pytest.fixture
def gazebo(monkeypatch):
    """Registers a simulator from outside."""

    def register(adapter: type) -> None:
        monkeypatch.setitem(SIMULATORS, "gazebo", Simulator(adapter, ("iris", "typhoon")))

    yield register
    server = _servers.pop((os.getpid(), "gazebo"), None)
    if server is not None:
        server.process.kill()
        server.process.wait()


@pytest.mark.parametrize(("plant", "speed"), [("gazebo:iris", 1.0), ("gazebo:typhoon", 2.0), ("gazebo", 1.0)])
def test_an_own_plant_flies_in_every_interface(plant, speed, gazebo):
    gazebo(foreign.Drifting)
    world = {"world": {"plant": plant}, "scenario": "random"}
    team = gym.make("QuadSwarm-v0", **world).unwrapped
    batch = gym.make_vec("QuadSwarm-v0", num_envs=2, vectorization_mode="vector_entry_point", **world).unwrapped
    for env in (team, batch):
        env.reset(seed=0)
        before = env.task.swarm.pos
        env.step(np.zeros(env.action_space.shape, np.int8))
        np.testing.assert_allclose(env.task.swarm.pos - before, np.full(before.shape, [0.1 * speed, 0, 0]), atol=1e-12)


@pytest.mark.parametrize(
    ("adapter", "message"),
    [
        (foreign.Raising, "The simulator raised KeyError: 'battery'"),
        (foreign.Lost, r"plant='gazebo:iris' returned .*nan.*; a step returns the finite states"),
        (foreign.Imaginary, "The simulator raised TypeError: .* returned complex numbers"),
        (foreign.Truncated, r"finite states of all robots, shape \(1, 2, 9\)"),
    ],
)
def test_what_a_plant_may_not_return_is_told_in_one_line(adapter, message, gazebo):
    gazebo(adapter)
    plant = make_plant("gazebo:iris", QuadrotorParams(), 0.01, 1, 2)
    with pytest.raises(PlantError, match=message) as error:
        plant.step(np.zeros((1, 2, 9)), np.zeros((1, 2, 4)), np.zeros((1, 2, 2)), None)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("safe", [True, False])
def test_files_of_the_current_folder_do_not_run_in_the_simulator(safe, tmp_path):
    """Neither on its own nor, in an interactive session, before what is installed."""
    (tmp_path / "pickle.py").write_text("import pathlib; pathlib.Path('RAN').touch(); raise ImportError('mine')")
    (tmp_path / "my_plant.py").write_text("from foreign import Drifting\nclass Mine(Drifting): pass\n")
    code = """
import sys
sys.path[:] = [path for path in sys.path if path]
import numpy as np
from quad_swarm.plants import SIMULATORS, Simulator, make_plant
from quad_swarm.quadrotor import QuadrotorParams
SIMULATORS["gazebo"] = Simulator("my_plant:Mine", ("iris",))
if len(sys.argv) > 1:
    sys.path.append("")
try:
    plant = make_plant("gazebo", QuadrotorParams(), 0.01, 1, 2)
    print(plant.step(np.zeros((1, 2, 9)), np.zeros((1, 2, 4)), np.zeros((1, 2, 2)), None)[0, 0, 0])
except ImportError as error:
    print(error)
"""
    helpers = os.path.dirname(foreign.__file__)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([helpers, *filter(None, sys.path)])}
    command = [sys.executable, "-c", code, *([] if safe else ["interactive"])]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == (
        "plant='gazebo:iris' needs the simulator: its adapter is my_plant:Mine (No module named 'my_plant')."
        if safe
        else "0.01"
    )
    assert not (tmp_path / "RAN").exists()
