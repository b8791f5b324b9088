"""Vehicles by name, and vehicle files of ``sb3-maddpg identify``."""

from __future__ import annotations

import os
from pathlib import Path

from quad_swarm.errors import shown, unknown_name
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorParams
from quad_swarm.validation import MOST_CHARACTERS, read_yaml, replaced

VEHICLES: dict[str, QuadrotorParams] = {
    # Parrot Bebop 2, the paper's vehicle: identified by tud-amr/mrca-mav
    "bebop2": QuadrotorParams(),
    # Bitcraze Crazyflie 2.1 Brushless, with our climb loop: sb3-maddpg identify --plant crazyflow:cf21B_500
    "crazyflie21": QuadrotorParams(
        drag_x=0.502,
        drag_y=0.502,
        roll_gain=1.005,
        roll_time_constant=0.145,
        pitch_gain=1.005,
        pitch_time_constant=0.145,
        climb_gain=0.856,
        climb_time_constant=0.299,
    ),
    # Holybro X500: sb3-maddpg identify --plant crazyflow:hb_x500
    "x500": QuadrotorParams(
        drag_x=0.0142,
        drag_y=0.0142,
        roll_gain=0.951,
        roll_time_constant=0.2,
        pitch_gain=0.951,
        pitch_time_constant=0.2,
        climb_gain=1.0,
        climb_time_constant=0.328,
    ),
    # AscTec Hummingbird: sb3-maddpg identify --plant rotorpy:hummingbird
    "hummingbird": QuadrotorParams(
        drag_x=0.486,
        drag_y=0.486,
        roll_gain=1.005,
        roll_time_constant=0.0888,
        pitch_gain=1.005,
        pitch_time_constant=0.0887,
        climb_gain=0.774,
        climb_time_constant=0.255,
    ),
    # A racer of the 250 mm class: drag as identified by Faessler, Franchi and Scaramuzza (RA-L 2018, 610 g); attitude
    # and climb are our own values, as fast as the rate loops of such vehicles.
    "racer250": QuadrotorParams(
        drag_x=0.544,
        drag_y=0.386,
        roll_gain=1.0,
        roll_time_constant=0.05,
        pitch_gain=1.0,
        pitch_time_constant=0.05,
        climb_gain=1.0,
        climb_time_constant=0.2,
    ),
}

# Name -> `planner.downwash` of the vehicles for which somebody published one. The Crazyflie's firmware avoids others
# with semi-axes of 0.3, 0.3 and 0.9 m (bitcraze/crazyflie-firmware, src/modules/src/collision_avoidance.c).
DOWNWASH = {"crazyflie21": 3.0}


def load_vehicle(name: str | os.PathLike[str]) -> QuadrotorParams:
    """Load the parameters of a vehicle.

    :param name: a name of `VEHICLES`, or the path of a vehicle file (as a text: ``.yml``)
    :raises ValueError: if the name is unknown, or the file cannot be read, is not a valid vehicle file or lacks one of
        `quad_swarm.quadrotor.VEHICLE_PARAMETERS`; the message names the file
    :raises FileNotFoundError: if there is no such file
    """
    if isinstance(name, str) and not name.endswith((".yml", ".yaml")):
        if name not in VEHICLES:
            raise unknown_name("vehicle", name, [*VEHICLES, "FILE.yml"])
        return VEHICLES[name]
    path = Path(name)
    if path.exists() and not path.is_file():  # to read a pipe would wait for a writer
        raise ValueError(f"{path} is not a file: name a vehicle file, or one of {', '.join(VEHICLES)}.")
    try:
        with path.open(encoding="utf-8") as file:
            content = read_yaml(file.read(MOST_CHARACTERS + 1))
        values = dict(content["parameters"])
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{shown(str(path))}: there is no such vehicle file; `sb3-maddpg identify --out` writes one, and "
            f"{', '.join(VEHICLES)} need none."
        ) from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}.") from None
    except (ValueError, TypeError, KeyError) as error:
        why = "it has no `parameters`" if isinstance(error, (KeyError, TypeError)) else shown(str(error))
        raise ValueError(
            f"{path} is not a vehicle file ({why}): `sb3-maddpg identify --out` writes one, with the "
            "vehicle's values under `parameters`."
        ) from None
    try:
        vehicle = replaced(QuadrotorParams(), {str(parameter): value for parameter, value in values.items()})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if missing := [name for name in VEHICLE_PARAMETERS if name not in values]:
        others = ", ".join(f"{name}: {getattr(vehicle, name)}" for name in missing)
        raise ValueError(
            f"{path} lacks {', '.join(missing)}: a vehicle file has all parameters of its vehicle, so that it does not "
            f"fly with those of another. Add your own; the Bebop 2 has {others}."
        )
    return vehicle
