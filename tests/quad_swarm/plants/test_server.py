"""The calls that a server answers."""

import threading
from multiprocessing import Pipe

import pytest

from quad_swarm.plants.server import make, serve


def test_errors_are_answers_and_the_end_of_the_connection_is_the_end():
    here, there = Pipe()
    thread = threading.Thread(target=serve, args=(there,), daemon=True)
    thread.start()
    here.send(("make", None, "unreal", "", (0.1, 0.1), 0.01, 1, 2))
    answer = here.recv()
    assert isinstance(answer, ValueError)
    assert "No adapter for the simulator 'unreal'" in str(answer)
    here.send(("step", 7))
    assert "no plant 7" in str(here.recv())
    here.close()
    thread.join(timeout=10)
    assert not thread.is_alive()


def test_an_unknown_simulator_has_no_adapter():
    with pytest.raises(ValueError, match="No adapter"):
        make("gazebo", "x", (0.1, 0.1), 0.01, 1, 2)
