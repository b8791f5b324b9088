"""Identify a vehicle: fit the planner's model to step responses of a simulator, or to logged flights.

``sb3-maddpg identify --plant crazyflow:cf21B_500 --out crazyflie.yml`` prints the parameters and the residuals, and
writes a vehicle file, which worlds accept as ``quadrotor``. ``--log FLIGHT.csv`` fits recordings, which need attitudes
and set-points, and says how large the errors are in parts of the log that were not fitted.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from quad_swarm.evaluation.recordings import Recording, read
from quad_swarm.parsing import Parser
from quad_swarm.plants.base import simulated_vehicles
from quad_swarm.plants.fit import WINDOW, Fit, Log, fit
from quad_swarm.plants.identify import Identification, identify
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorParams

EXAMPLES = """\
  sb3-maddpg identify --plant crazyflow:cf21B_500 --out crazyflie.yml
  sb3-maddpg identify --log flight_1.csv flight_2.csv --out ours.yml"""

_NEEDED = ("roll_set", "pitch_set", "climb_set")


def identify_logs(paths: Sequence[Path]) -> Fit:
    """Fit the planner's model to recorded flights of vehicles of a kind.

    :param paths: recordings
    :raises ValueError: if a file is no recording, lacks attitudes or set-points, or the flights do not determine a
        parameter
    :raises ImportError: if the extra ``plants`` is not installed, or ``record``, which ``.mcap`` needs
    """
    logs = [_log(path, read(path)) for path in paths]
    print("fitting: seconds, or a minute for twenty minutes of flight at 100 Hz", file=sys.stderr, flush=True)
    try:
        return fit(logs)
    except ValueError as error:
        raise ValueError(f"--log {' '.join(map(str, paths))}: {error}.") from None


def _log(path: Path, recording: Recording) -> Log:
    """Return the log of a recording.

    :raises ValueError: if it has no attitudes or set-points
    """
    missing = ["roll", "pitch", "yaw"] if "attitude" in recording.guessed else []
    missing += [name for k, name in enumerate(_NEEDED) if not np.isfinite(recording.setpoint[..., k]).any()]
    if missing:
        where = "the topic /NAME/cmd" if path.suffix == ".mcap" else f"the columns {', '.join(missing)}"
        raise ValueError(
            f"--log {path} has nothing in {where}: a fit needs roll, pitch and yaw (rad), and the set-points roll_set, "
            "pitch_set (rad) and climb_set (m/s) that the vehicle got; name them so."
        )
    return Log(recording.time, recording.state, recording.setpoint)


def make_parser() -> Parser:
    """Return the parser of the command."""
    parser = Parser("sb3-maddpg identify", description=__doc__)
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--plant", help=f"a simulator's vehicle: one of {', '.join(simulated_vehicles())}")
    group.add_argument(
        "--log",
        nargs="+",
        type=Path,
        action="extend",
        metavar="FILE",
        help="recorded flights with attitudes and set-points (.csv, .mcap, .npz) of vehicles of one kind",
    )
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
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    args = make_parser().parse_args(argv)
    for name in args.gym_packages or ():  # `sb3-maddpg` has imported them before
        importlib.import_module(name)
    piped = args.out == Path("-")
    if args.out and not piped:
        _write(args.out, None)
    fitted = identify_logs(args.log) if args.log else None
    found = Identification.of(fitted.params, fitted.attitude, fitted.velocity) if fitted else identify(args.plant)
    source = " ".join(map(str, args.log or [args.plant]))
    print(*_report(args.plant or "log", found, fitted), sep="\n", file=sys.stderr if piped else sys.stdout)
    if args.out:
        values = {name: round(getattr(found.params, name), 4) for name in VEHICLE_PARAMETERS}
        residuals = {name: round(getattr(found, name), 4) for name in Identification._fields[1:]}
        text = f"# sb3-maddpg identify {'--log' if fitted else '--plant'} {source}\n"
        text += yaml.safe_dump({"parameters": values, "residuals": residuals}, sort_keys=False)
        if piped:
            sys.stdout.write(text)
        else:
            _write(args.out, text)
            print(f"wrote {args.out}")
    return 0


def _report(title: str, found: Identification, fitted: Fit | None) -> list[str]:
    """Return the lines to print.

    :param title: title of the parameters
    :param found: what was found
    :param fitted: more about the fit of logs
    """
    lines = [f"{'parameter':22}{title:>22}{'bebop2':>10}" + ("  std. error" if fitted else "")]
    for name in VEHICLE_PARAMETERS:
        line = f"{name:22}{getattr(found.params, name):22.4f}{getattr(QuadrotorParams(), name):10.4f}"
        lines.append(line + (f"{fitted.errors[name]:12.4f}" if fitted else ""))
    lines.append(
        f"residuals: roll and pitch {found.attitude_rms:.2f} deg rms, {found.attitude_max:.2f} deg max; "
        f"velocity {found.velocity_rms:.3f} m/s rms, {found.velocity_max:.3f} m/s max"
    )
    if fitted:
        lines += [
            f"these are errors in {len(fitted.attitude)} windows of {WINDOW:g} s that were held out; {fitted.windows} "
            "were fitted",
            f"set-points act {1e3 * fitted.delay:+.0f} ms after their stamps, which is no part of the vehicle",
        ]
    return lines


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
