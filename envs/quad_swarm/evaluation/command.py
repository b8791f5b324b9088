"""``sb3-maddpg evaluate``: compare policies over the same held-out episodes, or judge recorded flights."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from quad_swarm.errors import needs_extra, unknown_name
from quad_swarm.evaluation.evaluation import fly_all, make_pool, summarise_all
from quad_swarm.evaluation.flight import Condition, fly
from quad_swarm.evaluation.judging import flat, format_flights, judge, legend, totals
from quad_swarm.evaluation.policies import is_model, load_model, short_name, short_names, trained_in
from quad_swarm.evaluation.provenance import provenance
from quad_swarm.evaluation.recordings import Recording, check_suffix, numbered, read_flights, write
from quad_swarm.evaluation.rows import STDOUT, aligned, check_writable, write_csv, write_rows, write_text
from quad_swarm.jobs import ENGINES
from quad_swarm.jobs.journal import default_folder
from quad_swarm.parsing import Parser
from quad_swarm.planner import PROBLEMS, SOLVERS, BuildError
from quad_swarm.plants.base import MODEL, PlantError, simulated_vehicles
from quad_swarm.realtime.supervisor import SafetyLimits, Supervisor, room_of
from quad_swarm.task.rules import RULES
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import PRESETS, SwarmConfig, for_scenario, make_config
from quad_swarm.world.scenarios import SCENARIOS, ScenarioSampler, without_obstacles
from quad_swarm.world.swarm import Swarm

# Shown by `sb3-maddpg --help`
EXAMPLES = """\
  sb3-maddpg evaluate --policy none full cpa:0.7:1.5 pretrained:quad-swarm-paper --scenario all --jobs 2
  sb3-maddpg evaluate --policy none --scenario symmetric_swap --record flight.mcap --record-collided
  sb3-maddpg evaluate --flight flight.npz lab.csv --world radius=0.15 goal_radius=0.2 --json -"""


class Column(NamedTuple):
    """A column of the table."""

    title: str
    text: Callable[[Mapping[str, Any]], str]
    wide: bool = True
    """Whether only the wide table has this column"""
    needs: str | None = None
    """A name that rows need; the table has the column if any row has it"""
    unless: tuple[str, str] | None = None
    """Two names; without them being different in any row, only the wide table has the column"""


COLUMNS = [
    Column("scenario", lambda r: r["scenario"], False),
    Column("policy", lambda r: r["policy"], False),
    Column("collided", lambda r: f"{r['collisions']}/{r['episodes']}"),
    Column("collisions", lambda r: f"{r['collisions'] / r['episodes']:.1%}", False),
    Column("95 % interval", lambda r: f"{100 * r['collision_low']:.1f} - {r['collision_high']:.1%}", False),
    Column(
        "obstacles",
        lambda r: f"{r['obstacle_collisions'] / r['episodes']:.1%}",
        wide=False,
        needs="obstacle_collisions",
    ),
    Column("> 1 cm", lambda r: str(r["collisions_1cm"])),
    Column("at steps", lambda r: str(r["collisions_at_steps"])),
    Column(
        "any time",
        lambda r: f"{r['collisions_continuous'] / r['episodes']:.1%}",
        wide=False,
        unless=("collisions", "collisions_continuous"),
    ),
    Column("plans/step", lambda r: f"{r['requests_per_step']:.2f}"),
    Column("plans", lambda r: f"{r['request_share']:.2%}", False),
    Column("B/s", lambda r: f"{r['bytes_per_second']:.0f}"),
    Column("plans' age (s)", lambda r: f"{r['plan_age']:.2f}" if r["plan_age"] else "-"),
    Column("arrived", lambda r: f"{r['arrived']}/{r['episodes']}", False),
    Column("steps", lambda r: "-" if r["steps_to_arrival"] is None else f"{r['steps_to_arrival']:.1f}", False),
    Column("lost (s)", lambda r: "-" if r.get("time_lost") is None else f"{r['time_lost']:+.2f}"),
    Column("min. (m)", lambda r: f"{r['min_separation_continuous']:.2f}", False),
    Column(
        "obstacle (m)",
        lambda r: "-" if r["min_obstacle_distance"] is None else f"{r['min_obstacle_distance']:.2f}",
        wide=False,
        needs="min_obstacle_distance",
    ),
    Column("failures", lambda r: str(r["planner_failures"])),
    Column("us/solve", lambda r: f"{r['solve_us']:.0f}"),
]
WIDTH = 100
SHORTEST_NAME = 12
_MOST_RECORDED = 1000  # episodes, each a file


def table_texts(rows: Sequence[Mapping[str, Any]], wide: bool = False) -> list[list[str]]:
    """Return the titles and the cells of each row as text, with the shortest unambiguous names of models.

    :param rows: rows of `evaluate`
    :param wide: whether to include all columns instead of the most important ones
    """
    columns = [
        column
        for column in COLUMNS
        if (wide or not column.wide)
        and (column.needs is None or any(column.needs in row for row in rows))
        and (wide or column.unless is None or any(row[column.unless[0]] != row[column.unless[1]] for row in rows))
    ]
    names = short_names(row["policy"] for row in rows)
    shown = [{**row, "policy": names[row["policy"]]} for row in rows]

    def text(column: Column, row: Mapping[str, Any]) -> str:
        return column.text(row) if column.needs is None or column.needs in row else "-"

    return [[column.title for column in columns], *([text(column, row) for column in columns] for row in shown)]


def format_table(rows: Sequence[Mapping[str, Any]], wide: bool = False) -> str:
    """Format rows as a table. Unless it is wide, it fits into 100 columns of text by wrapping long names.

    :param rows: rows of `evaluate`
    :param wide: see `table_texts`
    """
    texts = table_texts(rows, wide)
    if not wide:
        taken = sum(max(map(len, column)) + 2 for k, column in enumerate(zip(*texts, strict=True)) if k != 1)
        texts = [line for text in texts for line in _wrapped(text, max(WIDTH - taken, SHORTEST_NAME))]
    return aligned(texts, 2)


def _wrapped(texts: list[str], most: int) -> list[list[str]]:
    """Return a line of the table, and additional lines for the rest of the policy's name."""
    scenario, name, *cells = texts
    # Behind operators of rules and hyphens, and in front of thresholds, if there is such a place
    first, *rest = re.findall(rf".{{1,{most}}}(?:(?<=[&|/-])|(?=@)|$)|.{{1,{most}}}", name)
    return [[scenario, first, *cells], *(["", part, *("" for _ in cells)] for part in rest)]


def _latex(texts: Sequence[Sequence[str]]) -> str:
    """Format the texts of a table as LaTeX for the package booktabs."""
    escape = str.maketrans({
        **{c: f"\\{c}" for c in "&%$#_{}"},
        **{"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"},
        **{c: f"${c}$" for c in "<>|"},
    })  # fmt: skip
    titles, *rows = ([text.replace(" - ", " -- ").translate(escape) for text in line] for line in texts)
    lines = [
        f"\\begin{{tabular}}{{ll{'r' * (len(titles) - 2)}}}",
        r"\toprule",
        " & ".join(titles) + r" \\",
        r"\midrule",
    ]
    for k, row in enumerate(rows):
        lines += [r"\addlinespace"] * (k > 0 and row[0] != rows[k - 1][0])
        lines.append(" & ".join((row[0], f"\\texttt{{{row[1]}}}", *row[2:])) + r" \\")
    return "\n".join((*lines, r"\bottomrule", r"\end{tabular}", ""))


def _rules_usage() -> str:
    return ", ".join(":".join((name, *arguments)) for name, (_, arguments) in RULES.items())


def paper_policies() -> list[str]:
    """Return the policies of the paper's table: no and full communication, by distance, and a learned policy."""
    return ["none", "full", "distance:4", str(files("quad_swarm.models") / "quad-swarm-paper" / "model.zip")]


def add_policy_arguments(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add the options of commands that fly policies in a world.

    :param parser: parser to add to
    :param required: whether --policy is required
    """
    parser.add_argument(
        "--policy",
        nargs="+",
        action="extend",
        required=required,
        metavar="POLICY",
        help=f"a rule ({_rules_usage()}; EPS and DIST in m, or in separations of the planner with the suffix s, which "
        "does not mean seconds: 1.1s; LOOKAHEAD and TIME in seconds), rules joined by & (both) and | (either), a "
        "model's zip, MODEL.zip@THRESHOLD, latest:LOGDIR or pretrained:NAME",
    )
    parser.add_argument("--seed", type=int, default=0, help="index of the set of held-out episodes (default 0)")
    parser.add_argument(
        "--preset", help=f"{', '.join(PRESETS)} (default: the preset of the models' training, paper for rules)"
    )
    parser.add_argument("--n-robots", type=int, default=None, help="number of robots (default: the preset's)")
    parser.add_argument("--max-steps", type=int, help="time limit in steps (default: the preset's)")
    names = ", ".join(field.name for field in dataclasses.fields(SwarmConfig))
    parser.add_argument(
        "--world",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help=f"fields of the preset, e.g. noise.wind=1 or planner.problem=NAME ({', '.join(PROBLEMS)}): {names}",
    )
    add_limits_argument(parser)
    simulated = ", ".join(simulated_vehicles())
    parser.add_argument("--plant", help=f"simulated vehicle: {MODEL} (default), or one of a simulator ({simulated})")
    parser.add_argument(
        "--gym-packages",
        nargs="+",
        action="extend",
        metavar="MODULE",
        help="modules to import first, which add scenarios, rules, observations, solvers or simulators",
    )
    parser.add_argument(
        "--algo",
        default="sb3_maddpg:MADDPG",
        metavar="MODULE:CLASS",
        help="class that loads models (default %(default)s)",
    )
    parser.add_argument("--solver", default="auto", help=f"auto, {', '.join(SOLVERS)} (default auto)")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def add_limits_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option of what robots will be guarded by, see `check_limits`."""
    parser.add_argument(
        "--limits",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="fields of the robots' SafetyLimits, e.g. room=[[-3,-3,0],[3,3,3]] fence=0.3: a world in which robots "
        "could brake into a wall or the ceiling is refused. They change no flight",
    )


def check_limits(assignments: Sequence[str], config: SwarmConfig) -> None:
    """Check that robots may be guarded by limits in a world, see `Supervisor`, and print what their room leaves.

    :param assignments: values of ``--limits``
    :raises ValueError: if they are invalid or do not fit the world
    """
    limits = SafetyLimits(**read_assignments("--limits", assignments))
    for robot in range(config.n_robots if assignments else 0):
        Supervisor(config, limits, robot)
    if assignments and limits.room is None:
        raise ValueError("--limits: give room=[[xlow,ylow,zlow],[xhigh,yhigh,zhigh]], your walls, floor and ceiling.")
    if limits.room is not None:
        print(f"room: {room_of(config, limits)}", file=sys.stderr)


def make_conditions(args: argparse.Namespace, scenarios: Sequence[str]) -> list[Condition]:
    """Create the conditions of a command line: its policies in some scenarios. Sets ``args.preset`` if it is missing.

    :param args: parsed options of `add_policy_arguments`
    :param scenarios: names of the scenarios
    :raises ValueError: if a scenario, preset or field is unknown, or the robots do not fit into the world
    """
    for name in scenarios:
        if name not in SCENARIOS:
            raise unknown_name("scenario", name, SCENARIOS)
    models = {policy: trained_in(load_model(policy, args.algo)) for policy in args.policy if is_model(policy)}
    args.preset = args.preset or preset_of(models)
    config = make_config(args.preset, read_assignments("--world", args.world), n_robots=args.n_robots, plant=args.plant)
    check_limits(args.limits, config)
    for policy, trained in models.items():
        if (preset := trained.get("preset", args.preset)) != args.preset:
            print(f"note: {short_name(policy)} was trained in {preset!r}, but this is {args.preset!r}", file=sys.stderr)
    for name in scenarios:
        world = for_scenario(config, name)
        ScenarioSampler(name, world.n_robots, world.space, world)  # raises if the robots do not fit
    return [
        Condition(policy, name, config, args.max_steps, args.algo, args.solver)
        for name in dict.fromkeys(scenarios)
        for policy in dict.fromkeys(args.policy)
    ]


def preset_of(models: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the preset that models were trained in, "paper" if they do not say.

    :param models: name -> arguments of its environment, see `trained_in`
    :raises ValueError: if they were trained in several
    """
    presets = {str(trained["preset"]) for trained in models.values() if "preset" in trained}
    if len(presets) > 1:
        raise ValueError(f"The models were trained in {', '.join(sorted(presets))}: choose one of these with --preset.")
    return presets.pop() if presets else "paper"


def run(command: Callable[[argparse.Namespace], None], args: argparse.Namespace) -> int:
    """Run a command and print errors that the user can fix as one line.

    :return: exit status
    """
    try:
        for name in args.gym_packages or ():  # `sb3-maddpg` has imported them before
            importlib.import_module(name)
        command(args)
    except (ValueError, FileNotFoundError, ImportError, BuildError, PlantError) as error:
        if args.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def make_parser() -> Parser:
    """Return the parser of the command."""
    parser = Parser(
        "sb3-maddpg evaluate",
        description="Fly the same held-out episodes with several policies and compare them. Without options, this "
        "prints the paper's table: four policies in all scenarios. With --flight, recorded flights are judged instead.",
        epilog=f"examples:\n{EXAMPLES}",
    )
    add_policy_arguments(parser, required=False)
    parser.add_argument(
        "--scenario",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"some of {', '.join(SCENARIOS)}, or all without obstacles and changing goals (default)",
    )
    parser.add_argument("--episodes", type=int, default=200, help="episodes per policy and scenario (default 200)")
    add_worker_arguments(parser, jobs=1)
    add_flight_argument(parser)
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="record the episodes as .npz, .csv or .mcap; several get numbers, so choose few (--episodes)",
    )
    parser.add_argument("--record-collided", action="store_true", help="record only episodes with a collision")
    parser.add_argument("--wide", action="store_true", help="print all columns, in long lines")
    parser.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="write a JSON list with an object per policy and scenario, and what was flown; - is the standard output, "
        "also for the next two, and the table then goes to the standard error",
    )
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the same results as comma-separated values")
    parser.add_argument("--latex", type=Path, metavar="FILE", help="write the printed table as LaTeX with booktabs")
    parser.add_argument(
        "--plot", type=Path, metavar="DIR", help="write figures of collisions, requests and flights to this folder"
    )
    return parser


def add_flight_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument that names recorded flights, see `quad_swarm.evaluation.recordings`."""
    parser.add_argument(
        "--flight",
        nargs="+",
        type=Path,
        action="extend",
        default=[],
        metavar="FILE",
        help="recorded flights, real or simulated (.npz, .csv, .mcap), instead of policies to fly; --preset (otherwise "
        "that of the file, or flight) and --world tell the rest, such as radius and goal_radius",
    )


def add_worker_arguments(parser: argparse.ArgumentParser, jobs: int) -> None:
    """Add the options that choose the processes: ``--jobs``, ``--engine``, ``--address`` and ``--mixed``.

    :param jobs: default number of processes
    """
    parser.add_argument(
        "--jobs",
        type=int,
        default=jobs,
        help="number of processes; results do not depend on it (default %(default)s)",
    )
    parser.add_argument("--engine", default="local", help=f"{', '.join(ENGINES)}: where processes run (default local)")
    parser.add_argument("--address", help="a running Ray cluster: auto, or HOST:PORT (default: one on this machine)")
    parser.add_argument("--mixed", action="store_true", help="accept results of machines that differ from this one")


def workers(args: argparse.Namespace) -> Executor:
    """Create the executor that the options of ``add_worker_arguments`` choose, see ``make_pool``."""
    return make_pool(args.jobs, args.engine, args.address, args.mixed)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    args = make_parser().parse_args(argv)
    return run(_judge if args.flight else _compare, args)


def _judge(args: argparse.Namespace) -> None:
    """Judge recorded flights."""
    for name in ("policy", "scenario", "latex", "plot", "record"):
        if getattr(args, name):
            raise ValueError(f"--{name} is for policies to fly, --flight for recorded flights: leave one of them out.")
    printed = _check_files(args)
    flights = read_flights(args.flight, args.preset, read_assignments("--world", args.world))
    rows = [judge(str(path), recording) for path, recording in flights]
    sums = totals(rows)
    try:
        if args.json:
            write_rows(args.json, flat([*rows, *sums]))
        if args.csv:
            write_csv(args.csv, flat([*rows, *sums]))
    finally:
        print(format_flights(rows, sums), "", *legend(rows), sep="\n", file=printed)


def _compare(args: argparse.Namespace) -> None:
    args.scenario = args.scenario or ["all"]
    if "all" in args.scenario and len(args.scenario) > 1:
        raise ValueError(f"--scenario {' '.join(args.scenario)}: 'all' already names every scenario.")
    args.policy = args.policy or paper_policies()
    conditions = make_conditions(args, without_obstacles() if args.scenario == ["all"] else args.scenario)
    printed = _check_files(args)
    _check_record(args, len(conditions))
    solver = Swarm(conditions[0].config, 1, args.solver).planner.solver.name  # fails here if a simulator is missing
    elsewhere = args.engine != "local" or args.address is not None
    try:
        with workers(args) if elsewhere else nullcontext() as executor:
            flown = fly_all(
                conditions, args.episodes, args.seed, args.jobs, journal=default_folder(), executor=executor
            )
    except KeyboardInterrupt:
        print("interrupted; repeat the command to continue", file=sys.stderr)
        raise
    rows = summarise_all(flown)
    rows = [
        row | provenance(condition, args.preset, args.seed, solver)
        for row, condition in zip(rows, conditions, strict=True)
    ]
    footer = _footer(args, rows)
    # Files first, and the table whether or not they are written: the pieces of the evaluation are gone
    try:
        if args.json:
            write_rows(args.json, rows)
        if args.csv:
            write_csv(args.csv, rows)
        if args.latex:
            comment = "".join(f"% {line}\n" for line in footer)
            write_text(args.latex, comment + _latex(table_texts(rows, args.wide)))
    finally:
        print(format_table(rows, args.wide), "", *footer, sep="\n", file=printed)
    for path in filter(None, (args.json, args.csv, args.latex)):
        if path != STDOUT:
            print(f"wrote {path}", file=printed)
    if args.record:
        _record(args, flown, printed)
    if args.plot:
        from quad_swarm.figures.plots import draw_all  # matplotlib is only needed here

        for path in draw_all(rows, conditions, args.seed, args.plot):
            print(f"drew {path}", file=printed)


def _record(
    args: argparse.Namespace, flown: Mapping[Condition, Sequence[Mapping[str, float]]], printed: TextIO
) -> None:
    """Fly the chosen episodes again, one by one, and write their recordings."""
    chosen = [
        (condition, number)
        for condition, rows in flown.items()
        for number, row in enumerate(rows)
        if row["collided"] or not args.record_collided
    ]
    if not chosen:
        print(f"no episode had a collision: {args.record} is not written", file=printed)
    if len(chosen) > _MOST_RECORDED:
        print(f"only the first {_MOST_RECORDED} of {len(chosen)} episodes are recorded", file=printed)
        chosen = chosen[:_MOST_RECORDED]
    names = short_names(condition.policy for condition in flown)
    for k, (condition, number) in enumerate(chosen, 1):
        path = numbered(args.record, k, len(chosen))
        write(path, Recording.of(fly(condition, args.seed, number), names[condition.policy]))
        print(f"recorded {path}: {condition.scenario}, {names[condition.policy]}, episode {number}", file=printed)


def _check_record(args: argparse.Namespace, conditions: int) -> None:
    """Check before the flights that they can be recorded.

    :param conditions: number of conditions
    """
    if args.record is None:
        if args.record_collided:
            raise ValueError("--record-collided needs --record FILE.")
        return
    check_suffix(args.record)
    if args.record.suffix == ".mcap":
        with needs_extra(args.record.name, "record"):
            import quad_swarm.evaluation.mcap_files  # noqa: F401
    if (count := conditions * args.episodes) > _MOST_RECORDED and not args.record_collided:
        raise ValueError(
            f"--record {args.record}: {count} episodes would be {count} files, more than {_MOST_RECORDED}; choose "
            "fewer policies, scenarios or --episodes, or --record-collided."
        )


def _check_files(args: argparse.Namespace) -> TextIO:
    """Check before the flights that everything can be written and drawn after them.

    :return: where the table goes: the standard output, unless a file is written there
    """
    paths = {f"--{name}": path for name in ("json", "csv", "latex", "plot", "record") if (path := getattr(args, name))}
    for option, path in paths.items():
        same = [other for other, its in paths.items() if its.absolute() == path.absolute()]
        if len(same) > 1:
            raise ValueError(f"{' and '.join(same)} are both {path}: one would overwrite the other; name two files.")
        if option != "--plot":
            check_writable(path, option)
    if args.plot == STDOUT:
        raise ValueError("--plot -: figures need a folder.")
    if args.plot:
        check_writable(args.plot / "plot", "--plot")
        with needs_extra("--plot", "plot"):
            import quad_swarm.figures.plots  # noqa: F401  matplotlib is only needed here
    return sys.stderr if STDOUT in paths.values() else sys.stdout


def _footer(args: argparse.Namespace, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines below the table, which say what was flown."""
    row = rows[0]
    world = f" with {' '.join(args.world)}" if args.world else ""
    simulator = row["plant"].partition(":")[0]
    versions = [f"{name} {row['versions'][name]}" for name in ("sb3-maddpg", simulator) if name in row["versions"]]
    limit = "" if args.max_steps is None else f"at most {args.max_steps} steps; "
    return [
        f"episodes: {args.episodes} each; robots: {row['n_robots']}; preset: {args.preset}{world}; set: {args.seed}",
        f"plant: {row['plant']}; solver: {row['solver']}; {limit}{', '.join(versions)}",
    ]


if __name__ == "__main__":
    sys.exit(main())
