"""The process behind `RemotePlant`: ``python -m quad_swarm.plants.server DESCRIPTOR`` answers calls on a connection."""

from __future__ import annotations

import functools
import importlib
import itertools
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from quad_swarm.plants.base import Plant, PlantError


def make(adapter: str, plant: str, *arguments: Any) -> Plant:
    """Create a plant in this process.

    :param adapter: see `Simulator`
    :param plant: name of the plant, for error messages
    :param arguments: arguments of the adapter
    :raises ImportError: if the adapter or its simulator is not installed
    :raises ValueError: if the adapter is no `Plant`
    """
    module, _, name = adapter.partition(":")
    try:
        created = functools.reduce(getattr, name.split("."), importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        needed = f"the simulator: its adapter is {adapter}"
        if module.startswith("quad_swarm."):
            needed = "the extra 'plants': in the clone, pip install -e '.[plants]'"
        raise ImportError(f"plant={plant!r} needs {needed} ({error}).") from None
    made = created(*arguments)  # type: ignore[operator]
    if missing := [name for name in ("place", "keep", "fork", "step") if not callable(getattr(made, name, None))]:
        raise ValueError(f"plant={plant!r}: its adapter {adapter} is no Plant, since it has no {missing[0]}().")
    return made


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
                if np.iscomplexobj(answer):
                    raise TypeError("step() returned complex numbers")
                answer = np.asarray(answer, dtype=float) if method == "step" else None
        except ImportError as error:
            answer = ImportError(str(error))
        except Exception as error:  # whatever a foreign adapter raises
            if method in ("make", "fork") and isinstance(error, ValueError):  # an argument that it refuses
                answer = ValueError(str(error))
            else:
                traceback.print_exc()
                answer = PlantError(f"The simulator raised {type(error).__name__}: {error}")
        connection.send(answer)


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])))
