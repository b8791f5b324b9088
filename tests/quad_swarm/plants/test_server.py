"""The calls that a server answers."""

import threading
from multiprocessing import Pipe

import pytest

from quad_swarm.plants.server import make, serve


def test_errors_are_answers_and_the_end_of_the_connection_is_the_end():
    here, there = Pipe()
    thread = threading.Thread(target=serve, args=(there,), daemon=True)
    thread.start()
    here.send(("make", None, "unreal:Plant", "unreal:ship", "ship", (0.1, 0.1), 0.01, 1, 2))
    answer = here.recv()
    assert isinstance(answer, ImportError)
    assert "plant='unreal:ship' needs the simulator: its adapter is unreal:Plant (No module named" in str(answer)
    here.send(("step", 7))
    assert "no plant 7" in str(here.recv())
    here.close()
    thread.join(timeout=500)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("adapter", "error", "message"),
    [
        ("foreign:Unknown", ImportError, "its adapter is foreign:Unknown"),
        ("quad_swarm.plants.gazebo:GazeboPlant", ImportError, r"pip install -e '\.\[plants\]'"),
        ("foreign:NoPlant", ValueError, r"its adapter foreign:NoPlant is no Plant, since it has no place\(\)"),
    ],
)
def test_what_is_no_adapter_is_refused(adapter, error, message):
    with pytest.raises(error, match=message):
        make(adapter, "gazebo:iris", "iris", (0.1, 0.1), 0.01, 1, 2)
