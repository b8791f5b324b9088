"""The command that compares policies over the same held-out episodes.

``python -m quad_swarm.evaluation.command --policy none full cpa:0.7:1.5 MODEL.zip --scenario all``
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from quad_swarm.errors import unknown_name
from quad_swarm.evaluation.evaluation import Cell, evaluate, short_name
from quad_swarm.planner import BuildError
from quad_swarm.world.presets import PRESET_VERSION, PRESETS, make_config
from quad_swarm.world.scenarios import SCENARIOS, ScenarioSampler
from quad_swarm.world.swarm import Swarm


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a table to print; models by their short names where these tell them apart."""
    names = {row["policy"]: short_name(row["policy"]) for row in rows}
    if len(set(names.values())) < len(names):
        names = {policy: policy for policy in names}
    columns: list[tuple[str, Callable[[Mapping[str, Any]], str]]] = [
        ("scenario", lambda r: r["scenario"]),
        ("policy", lambda r: names[r["policy"]]),
        ("collisions", lambda r: f"{r['collisions']}/{r['episodes']}"),
        ("rate", lambda r: f"{r['collisions'] / r['episodes']:.1%}"),
        ("95 % interval", lambda r: f"{r['collision_low']:.1%} - {r['collision_high']:.1%}"),
        ("between steps", lambda r: str(r["collisions_continuous"])),
        ("requests/step", lambda r: f"{r['requests_per_step']:.2f}"),
        ("share", lambda r: f"{r['request_share']:.1%}"),
        ("arrived", lambda r: f"{r['arrived']}/{r['episodes']}"),
        ("steps", lambda r: "-" if r["steps_to_arrival"] is None else f"{r['steps_to_arrival']:.1f}"),
        ("min. dist. (m)", lambda r: f"{r['min_separation']:.3f}"),
        ("failures", lambda r: str(r["planner_failures"])),
        ("us/solve", lambda r: f"{r['solve_us']:.0f}"),
    ]  # fmt: skip
    cells = [[title for title, _ in columns]] + [[cell(row) for _, cell in columns] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(columns))]
    lines = [
        "  ".join(
            text.ljust(w) if k < 2 else text.rjust(w) for k, (text, w) in enumerate(zip(line, widths, strict=True))
        )
        for line in cells
    ]
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(line.rstrip() for line in lines)


def write_json(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write one JSON object a line; the file appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=path.name, suffix=".part", delete=False) as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)


def _parse_world(assignments: Iterable[str]) -> dict[str, Any]:
    """``["noise.wind=1", "memory=0.3"]`` -> ``{"noise": {"wind": 1}, "memory": 0.3}``."""
    world: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise ValueError(f"--world {assignment!r}: write NAME=VALUE, for example planner.separation=0.63.")
        *parents, leaf = name.split(".")
        place = world
        for parent in parents:
            place = place.setdefault(parent, {})
        place[leaf] = yaml.safe_load(value)
    return world


def add_policy_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of every command that flies policies in a world."""
    parser.add_argument(
        "--policy",
        nargs="+",
        required=True,
        metavar="POLICY",
        help="none, full, distance:EPS, cpa:DIST:LOOKAHEAD, random:P, or a model's zip, also MODEL.zip@THRESHOLD",
    )
    parser.add_argument("--seed", type=int, default=0, help="which set of held-out episodes (default 0)")
    parser.add_argument("--preset", default="paper", help=f"{' or '.join(PRESETS)} (default paper)")
    parser.add_argument("--n-robots", type=int, default=None, help="number of robots (default: the preset's)")
    parser.add_argument("--max-steps", type=int, default=100, help="time limit in steps (default 100)")
    parser.add_argument(
        "--world", nargs="+", default=[], metavar="NAME=VALUE", help="fields of SwarmConfig, e.g. noise.wind=1"
    )
    parser.add_argument(
        "--algo",
        default="sb3_maddpg:MADDPG",
        metavar="MODULE:CLASS",
        help="class that loads models (default %(default)s)",
    )
    parser.add_argument("--solver", default="auto", help="planner's solver (default auto)")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def make_cells(args: argparse.Namespace, scenarios: Sequence[str]) -> list[Cell]:
    """The policies of a command line in some scenarios.

    :param args: with what `add_policy_arguments` added
    :raises ValueError: unknown scenario, preset or field, or a world in which the robots do not fit
    """
    for name in scenarios:
        if name not in SCENARIOS:
            raise unknown_name("scenario", name, ["all", *SCENARIOS])
    config = make_config(args.preset, **({"n_robots": args.n_robots} | _parse_world(args.world)))
    for name in scenarios:
        ScenarioSampler(name, config.n_robots, config.space)  # raises where the robots do not fit
    return [
        Cell(policy, name, config, args.max_steps, args.algo, args.solver)
        for name in scenarios
        for policy in dict.fromkeys(args.policy)
    ]


def run(command: Callable[[argparse.Namespace], None], args: argparse.Namespace) -> int:
    """Run a command; what the user can mend is told in one line.

    :return: the exit status
    """
    try:
        command(args)
    except (ValueError, FileNotFoundError, ModuleNotFoundError, BuildError) as error:
        if args.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m quad_swarm.evaluation.command",
        description="Fly the same held-out episodes with several policies and compare them.",
        epilog="Example: python -m quad_swarm.evaluation.command --policy none full cpa:0.7:1.5 --episodes 200 --jobs 2",
    )
    add_policy_arguments(parser)
    parser.add_argument(
        "--scenario", nargs="+", default=["all"], metavar="NAME", help=f"all, or some of {', '.join(SCENARIOS)}"
    )
    parser.add_argument("--episodes", type=int, default=200, help="episodes of each policy and scenario (default 200)")
    parser.add_argument("--jobs", type=int, default=1, help="processes; the result does not depend on it (default 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write one JSON object a policy and scenario")
    parser.add_argument(
        "--plot", type=Path, metavar="DIR", help="draw collisions, requests and flights into this folder"
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    return run(_compare, _parser().parse_args(argv))


def _compare(args: argparse.Namespace) -> None:
    cells = make_cells(args, list(SCENARIOS) if args.scenario == ["all"] else args.scenario)
    rows = evaluate(cells, args.episodes, args.seed, args.jobs)
    solver = Swarm(cells[0].config, 1, args.solver).planner.solver.name
    common = {"preset": args.preset, "preset_version": PRESET_VERSION, "seed": args.seed, "solver": solver}
    rows = [row | common | ({"world": _parse_world(args.world)} if args.world else {}) for row in rows]
    print(format_table(rows))
    if args.json:
        write_json(args.json, rows)
        print(f"\nwrote {args.json}")
    if args.plot:
        from quad_swarm.figures.plots import draw_all  # matplotlib is needed only here

        for path in draw_all(rows, cells, args.seed, args.plot):
            print(f"drew {path}")


if __name__ == "__main__":
    sys.exit(main())
