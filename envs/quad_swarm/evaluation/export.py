"""Export a model for robots: ``sb3-maddpg export pretrained:quad-swarm-flight --n-robots 8 --out FOLDER``.

The folder holds actor.onnx, the policy of each robot, and robot.json: the world, the observation's columns, versions
and the program's digest. `quad_swarm.robot.files.load` reads it, without PyTorch.
"""

from __future__ import annotations

import importlib
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

from quad_swarm.errors import needs_extra, shown
from quad_swarm.evaluation.command import add_limits_argument, check_limits, preset_of
from quad_swarm.evaluation.policies import OBSERVATION_ARGUMENTS, fitted, is_model, load_model, short_name, trained_in
from quad_swarm.parsing import Parser
from quad_swarm.robot import files
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import PRESETS, SwarmConfig, first_difference, make_config

EXAMPLES = "  sb3-maddpg export pretrained:quad-swarm-flight --n-robots 8 --out robots"


def export(model: str, config: SwarmConfig, folder: Path, algo: str = "sb3_maddpg:MADDPG") -> files.RobotFiles:
    """Write what robots need to fly with a model.

    :param model: path of the model's zip, optionally with a threshold as in ``MODEL.zip@0.3``
    :param config: the world of the robots
    :param folder: folder to write to
    :param algo: ``module:Class`` that loads the model
    :return: what has been written, as a robot loads it
    :raises ValueError: if the model does not fit the world, robots cannot fly by themselves in it, the folder holds
        an export for another world, or the extra ``onnx`` is not installed
    """
    if (other := _other_world(folder, config)) is not None:
        name, there, here = other
        raise ValueError(
            f"{folder} holds an export for another world, with {name}={shown(there)} instead of {shown(here)}: choose "
            "another folder, or remove it."
        )
    if config.is_limited:
        raise ValueError("neighbourhood: a robot of its own perceives all others; leave it out.")
    loaded = load_model(model, algo)
    predictor, observation, n_bits = fitted(loaded, model, config)
    if not hasattr(predictor, "agent_policy"):
        raise ValueError(f"{model}: {type(loaded).__name__} has no policies of single agents to export.")
    if getattr(getattr(predictor, "policy", predictor), "share_actor", None) is not True:
        raise ValueError(f"{model}: its robots have different actors, but load one; train with share_actor=True.")
    actor = predictor.agent_policy(0)
    known = [k for k, column in enumerate(observation.columns) if ".critic." not in column.name]
    given = {name: value for name, value in trained_in(loaded).items() if name in OBSERVATION_ARGUMENTS}
    with tempfile.TemporaryDirectory(prefix="quad-swarm-") as temporary:  # an export that fails leaves nothing
        part = Path(temporary)
        with needs_extra("export", "onnx"):
            actor.of_columns(known).export(part / files.ACTOR)
        written = files.RobotFiles(
            part,
            config,
            given.get("observation", "paper"),
            bool(given.get("scale_observation", False)),
            n_bits,
            getattr(getattr(loaded, "policy", None), "threshold", None),
            short_name(model.partition("@")[0]),
        )
        versions = {name: version(name) for name in ("sb3-maddpg", "torch", "onnx")}
        files.write(written, [observation.columns[k].name for k in known], versions)
        folder.mkdir(parents=True, exist_ok=True)
        for name in (files.ACTOR, files.DESCRIPTION):
            shutil.move(part / name, folder / name)
    return files.load(folder)


def _other_world(folder: Path, config: SwarmConfig) -> tuple[str, Any, Any] | None:
    try:
        return first_difference(files.load(folder).config, config)
    except ValueError:  # nothing, or what the loader asks to replace by another export
        return None


def make_parser() -> Parser:
    """Return the parser of the command."""
    parser = Parser("sb3-maddpg export", description=__doc__)
    parser.add_argument(
        "model", metavar="MODEL", help="a model's zip, MODEL.zip@THRESHOLD, latest:LOGDIR or pretrained:NAME"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder to write to")
    parser.add_argument("--n-robots", type=int, help="number of robots (default: the preset's)")
    parser.add_argument("--preset", help=f"{', '.join(PRESETS)} (default: the preset of the model's training)")
    parser.add_argument(
        "--world", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="fields of the preset"
    )
    add_limits_argument(parser)
    parser.add_argument("--gym-packages", nargs="+", action="extend", metavar="MODULE", help="modules to import first")
    parser.add_argument(
        "--algo",
        default="sb3_maddpg:MADDPG",
        metavar="MODULE:CLASS",
        help="class that loads models (default %(default)s)",
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    args = make_parser().parse_args(argv)
    for name in args.gym_packages or ():  # `sb3-maddpg` has imported them before
        importlib.import_module(name)
    if not is_model(args.model):
        raise ValueError(f"{shown(args.model)} is no model: pass the path of a .zip, latest:LOGDIR or pretrained:NAME.")
    trained = trained_in(load_model(args.model, args.algo))
    preset = args.preset or preset_of({args.model: trained})
    config = make_config(preset, read_assignments("--world", args.world), n_robots=args.n_robots)
    check_limits(args.limits, config)
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out {args.out} is a file: choose a folder.")
    written = export(args.model, config, args.out, args.algo)
    actor = written.actor()
    print(
        f"wrote {args.out / files.ACTOR} and {args.out / files.DESCRIPTION}: {config.n_robots} robots in {preset!r}, "
        f"{actor.observation.size} columns, {config.n_others * written.n_bits} bits\n"
        f"robots know this world only (--world changes it): radius {config.radius:g} m, separation "
        f"{config.planner.separation:g} m, downwash {config.planner.downwash:g}, workspace "
        f"{list(config.planner.workspace_low)} to {list(config.planner.workspace_high)} m, "
        f"roll time constant {config.quadrotor.roll_time_constant:g} s"
    )
    return 0
