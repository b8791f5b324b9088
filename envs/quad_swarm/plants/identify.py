"""Identify a vehicle: fit the planner's model to step responses of a plant.

``sb3-maddpg identify --plant crazyflow:cf21B_500 --out crazyflie.yml`` prints the parameters and the residuals, and
writes a vehicle file, which worlds accept as ``quadrotor``.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from quad_swarm.errors import needs_extra
from quad_swarm.parsing import Parser
from quad_swarm.plants.base import make_plant, simulated_vehicles
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorModel, QuadrotorParams

EXAMPLES = "  sb3-maddpg identify --plant crazyflow:cf21B_500 --out crazyflie.yml"

DT = 0.01  # s
SECONDS = 3.0
HELD = 2.0  # duration of an input before it returns to zero (s)
TILTS = (-0.3, -0.15, 0.15, 0.3)  # rad
CLIMBS = (-1.0, -0.5, 0.5, 1.0)  # m/s
# Scales that weight the errors: attitudes of 0.1 rad count as much as velocities of 1 m/s
_SCALE = np.array([1.0, 1.0, 1.0, 0.1, 0.1])


class Identification(NamedTuple):
    """Result of an identification.

    :param params: parameters of the model
    :param attitude_rms: root mean square error of roll and pitch (deg)
    :param attitude_max: largest error of roll and pitch (deg)
    :param velocity_rms: root mean square error of the velocities (m/s)
    :param velocity_max: largest error of the velocities (m/s)
    """

    params: QuadrotorParams
    attitude_rms: float
    attitude_max: float
    velocity_rms: float
    velocity_max: float


def experiment() -> np.ndarray:
    """Return the inputs of the step responses in roll, pitch and climb rate, one robot each, (T, robots, 4)."""
    steps = [(axis, size) for axis, sizes in enumerate((TILTS, TILTS, CLIMBS)) for size in sizes]
    u = np.zeros((round(SECONDS / DT), len(steps), 4))
    for robot, (axis, size) in enumerate(steps):
        u[: round(HELD / DT), robot, axis] = size
    return u


def identify(plant: str) -> Identification:
    """Fit the planner's model to step responses of a plant in roll, pitch and climb rate.

    :param plant: see `parse_plant`
    :raises ValueError: if the plant is unknown
    :raises ImportError: if the extra ``plants`` is not installed
    """
    with needs_extra("identify", "plants"):
        from scipy.optimize import least_squares  # imported here, so that the help needs no extra
    u = experiment()
    count = u.shape[1]
    params = QuadrotorParams()
    flown = make_plant(plant, params, DT, 1, count)
    states = [np.zeros((1, count, 9))]
    states[0][0, :, 0] = 10.0 * np.arange(count)
    flown.place(0, states[0][0])
    still = np.zeros((1, count, 2))
    for inputs in u:
        states.append(flown.step(states[-1], inputs[None], still, None))
    measured = np.concatenate(states[1:])[..., 3:8]

    model = QuadrotorModel(params, DT)

    def predicted(factors: np.ndarray) -> np.ndarray:
        x, path = states[0][0], []
        for inputs in u:
            x = model.step(x, inputs, None, np.broadcast_to(factors, (count, len(factors))))
            path.append(x[:, 3:8])
        return np.array(path)

    fit = least_squares(
        lambda factors: ((predicted(factors) - measured) / _SCALE).ravel(),
        np.ones(len(VEHICLE_PARAMETERS)),
        bounds=(1e-2, 50.0),
    )
    error = predicted(fit.x) - measured
    attitude, velocity = np.degrees(error[..., 3:]), error[..., :3]
    values = {name: float(getattr(params, name) * f) for name, f in zip(VEHICLE_PARAMETERS, fit.x, strict=True)}
    return Identification(
        QuadrotorParams(**values),
        float(np.sqrt((attitude**2).mean())),
        float(np.abs(attitude).max()),
        float(np.sqrt((velocity**2).mean())),
        float(np.abs(velocity).max()),
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    parser = Parser("sb3-maddpg identify", description=__doc__)
    parser.add_argument("--plant", required=True, help=f"one of {', '.join(simulated_vehicles())}")
    parser.add_argument(
        "--gym-packages",
        nargs="+",
        action="extend",
        metavar="MODULE",
        help="modules to import first, with simulators",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="vehicle file to write, YAML; - is the standard output"
    )
    args = parser.parse_args(argv)
    for name in args.gym_packages or ():  # `sb3-maddpg` has imported them before
        importlib.import_module(name)
    piped = args.out == Path("-")
    if args.out and not piped:
        _write(args.out, None)
    found = identify(args.plant)
    lines = [f"{'parameter':22}{args.plant:>22}{'bebop2':>10}"]
    for name in VEHICLE_PARAMETERS:
        lines.append(f"{name:22}{getattr(found.params, name):22.4f}{getattr(QuadrotorParams(), name):10.4f}")
    lines.append(
        f"residuals: roll and pitch {found.attitude_rms:.2f} deg rms, {found.attitude_max:.2f} deg max; "
        f"velocity {found.velocity_rms:.3f} m/s rms, {found.velocity_max:.3f} m/s max"
    )
    print(*lines, sep="\n", file=sys.stderr if piped else sys.stdout)
    if args.out:
        values = {name: round(getattr(found.params, name), 4) for name in VEHICLE_PARAMETERS}
        residuals = {name: round(getattr(found, name), 4) for name in Identification._fields[1:]}
        text = f"# sb3-maddpg identify --plant {args.plant}\n"
        text += yaml.safe_dump({"parameters": values, "residuals": residuals}, sort_keys=False)
        if piped:
            sys.stdout.write(text)
        else:
            _write(args.out, text)
            print(f"wrote {args.out}")
    return 0


def _write(path: Path, text: str | None) -> None:
    """Write a file atomically, or, without a text, only check that it could be written. Missing folders are created.

    :raises ValueError: if it cannot be written
    """
    try:
        if path.is_dir():
            raise IsADirectoryError(0, "it is a folder")
        if path.exists() and not path.is_file():
            raise OSError(0, "it is a pipe or a device")
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
            if text is not None:
                part = Path(folder, path.name)
                part.write_text(text, encoding="utf-8")
                os.replace(part, path)
    except OSError as error:
        raise ValueError(f"--out {path} cannot be written: {error.strerror}; choose another path.") from error
