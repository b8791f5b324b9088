"""Simulators in a process of their own: what they refuse arrives, and their death is told."""

import gc
import os
import signal

import numpy as np
import pytest

from quad_swarm.plants import make_plant
from quad_swarm.plants.remote import RemotePlant, _server
from quad_swarm.quadrotor import QuadrotorParams

pytest.importorskip("mujoco", reason="the extra `plants` is not installed")


def make(dt: float = 0.01) -> RemotePlant:
    plant = make_plant("crazyflow", QuadrotorParams(), dt, 1, 2)
    assert isinstance(plant, RemotePlant)
    plant.place(0, np.zeros((2, 9)))
    return plant


def test_what_the_simulator_refuses_arrives_as_it_is():
    with pytest.raises(ValueError, match=r"crazyflow needs sub-steps that are multiples of 2 ms"):
        make(0.005001)


def test_all_plants_share_one_process_until_it_dies():
    first, second = make(), make()
    assert first._server is second._server
    state, u, air = np.zeros((1, 2, 9)), np.zeros((1, 2, 4)), np.zeros((1, 2, 2))
    assert np.isfinite(first.step(state, u, air, None)).all()
    os.kill(first._server.process.pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="The simulator's process exited with -9"):
        first.step(state, u, air, None)
    third = make()
    assert third._server is not first._server
    assert np.isfinite(third.step(state, u, air, None)).all()


def test_plants_that_are_gone_are_dropped():
    plant = make()
    number = plant._number
    del plant
    gc.collect()
    with pytest.raises(ValueError, match=f"no plant {number}"):
        _server("crazyflow").call("fork", number)


def test_each_simulator_has_a_process_of_its_own():
    assert _server("crazyflow") is _server("crazyflow")
    assert _server("crazyflow").process.pid != _server("rotorpy").process.pid
