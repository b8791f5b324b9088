"""Simulators in separate processes, which isolates their threads, memory and library requirements."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from multiprocessing import Pipe
from typing import Any

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.plants.base import PlantDied, PlantError, simulator_of
from quad_swarm.quadrotor import QuadrotorParams

# What `-c` puts first on the path is the current folder, whose files are not to be run; `sys` is built in
_LAUNCH = (
    "import sys; sys.path[:] = [path for path in sys.path if path]; import runpy; "
    "runpy.run_module('quad_swarm.plants.server', run_name='__main__', alter_sys=True)"
)


class _Server:
    """Process of a simulator. It ends with this process, however that ends."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._connection, there = Pipe()
        # An interactive session imports from the current folder: so does the simulator, but after everything else
        path = [*filter(None, sys.path), *([os.getcwd()] if "" in sys.path else [])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path), "PYTHONSAFEPATH": "1"}
        command = [sys.executable, "-c", _LAUNCH, str(there.fileno())]
        self.process = subprocess.Popen(command, pass_fds=[there.fileno()], env=environment, stdin=subprocess.DEVNULL)
        there.close()

    def call(self, *message: Any) -> Any:
        """Send a message to the process and return its answer.

        :raises ValueError: if the process raised it
        :raises ImportError: if the process raised it
        :raises PlantError: if the process died (`PlantDied`) or raised another error
        """
        with self._lock:
            try:
                self._connection.send(message)
                answer = self._connection.recv()
            except (EOFError, OSError) as error:
                code = self.process.wait()
                raise PlantDied(f"The simulator's process exited with {code}; see its messages above.") from error
        if isinstance(answer, Exception):
            raise answer
        return answer


_servers: dict[tuple[int, str], _Server] = {}


def _server(simulator: str) -> _Server:
    """Return this process's server for a simulator. Each simulator has its own server, because their libraries
    conflict, and a forked process starts its own servers."""
    key = os.getpid(), simulator
    server = _servers.get(key)
    if server is None or server.process.poll() is not None:
        server = _servers[key] = _Server()
    return server


class RemotePlant:
    """`Plant` in another process.

    :param simulator: one of `SIMULATORS`
    :param vehicle: one of its vehicles
    :param params: see `make_plant`
    :param dt: length of a sub-step (s)
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    :raises ValueError: if the simulator rejects an argument
    :raises ImportError: if the simulator is not installed
    :raises PlantError: if its process dies, or its adapter raises another error
    """

    def __init__(self, simulator: str, vehicle: str, params: QuadrotorParams, dt: float, n_swarms: int, n_robots: int):
        self._server = _server(simulator)
        drag = (params.drag_x, params.drag_y)
        self._name = f"{simulator}:{vehicle}"
        adapter = simulator_of(simulator).adapter
        self._number = self._server.call("make", None, adapter, self._name, vehicle, drag, dt, n_swarms, n_robots)

    def place(self, swarm: int, state: np.ndarray) -> None:
        """See `Plant`."""
        self._server.call("place", self._number, swarm, np.array(state))

    def keep(self, swarms: np.ndarray) -> None:
        """See `Plant`."""
        self._server.call("keep", self._number, np.array(swarms))

    def fork(self) -> RemotePlant:
        """See `Plant`."""
        fork = object.__new__(RemotePlant)
        fork._server, fork._name, fork._number = self._server, self._name, self._server.call("fork", self._number)
        return fork

    def step(self, state: np.ndarray, u: np.ndarray, air: np.ndarray, factors: np.ndarray | None) -> np.ndarray:
        """See `Plant`.

        :raises PlantError: if the process died, or the states are not finite
        """
        after = self._server.call("step", self._number, state, u, np.array(air), None)
        if after.shape != state.shape or not np.isfinite(after).all():
            raise PlantError(
                f"plant={self._name!r} returned {shown(after)}; a step returns the finite states of all robots, shape "
                f"{state.shape}."
            )
        return after

    def __del__(self) -> None:
        if hasattr(self, "_number") and self._server.process.poll() is None:
            try:
                self._server.call("drop", self._number)
            except (OSError, AttributeError, TypeError):  # at interpreter shutdown
                return
