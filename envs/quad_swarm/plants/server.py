"""The process behind `RemotePlant`: ``python -m quad_swarm.plants.server DESCRIPTOR`` answers calls on a connection."""

from __future__ import annotations

import importlib
import itertools
import sys
from multiprocessing.connection import Connection
from typing import Any

from quad_swarm.plants.base import SIMULATORS


def make(simulator: str, vehicle: str, *arguments: Any) -> Any:
    """Create a plant in this process."""
    if simulator not in SIMULATORS:
        raise ValueError(f"No adapter for the simulator {simulator!r}.")
    try:
        adapter = getattr(importlib.import_module(f"quad_swarm.plants.{simulator}"), f"{simulator.capitalize()}Plant")
    except ImportError as error:
        raise ImportError(
            f"plant='{simulator}:{vehicle}' needs the simulator: pip install -e '.[plants]' in the clone ({error})."
        ) from None
    return adapter(vehicle, *arguments)


def serve(connection: Connection) -> None:
    """Answer calls until the other side closes the connection."""
    plants: dict[int, Any] = {}
    numbers = itertools.count()
    while True:
        try:
            method, number, *arguments = connection.recv()
        except EOFError:
            return
        answer: Any = None
        try:
            if method != "make" and number not in plants:
                raise ValueError(f"There is no plant {number}.")
            if method in ("make", "fork"):
                plant = make(*arguments) if method == "make" else plants[number].fork()
                answer = next(numbers)
                plants[answer] = plant
            elif method == "drop":
                del plants[number]
            else:
                answer = getattr(plants[number], method)(*arguments)
        except (ValueError, ImportError) as error:
            answer = type(error)(str(error))
        connection.send(answer)


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])))
