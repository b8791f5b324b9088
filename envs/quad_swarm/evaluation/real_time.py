"""Fly robots in real time, a process each: ``sb3-maddpg fly --n-robots 8 --policy none full pretrained:NAME``.

They talk over UDP or ROS 2 on this machine (``--link udp``, ``--link ros2``), or in virtual time in one process
(``--link virtual``), where flights are the same each time and outcomes do not depend on how busy the machine is. Each
policy flies the same episodes, whose messages are lost with the probability ``--loss``, requests as well as plans.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from quad_swarm.evaluation.command import add_limits_argument, check_limits, preset_of, run
from quad_swarm.evaluation.evaluation import user_modules
from quad_swarm.evaluation.export import export
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.inference import wilson_interval
from quad_swarm.evaluation.policies import is_model, load_model, short_names, trained_in
from quad_swarm.evaluation.recordings import MEASURED, Recording, check_suffix, numbered, write
from quad_swarm.evaluation.rows import aligned, check_writable, write_rows
from quad_swarm.parsing import Parser
from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime.arena import Arena, Exchange
from quad_swarm.realtime.link import Conditions
from quad_swarm.realtime.process import Sample, set_priority
from quad_swarm.realtime.statistics import total
from quad_swarm.realtime.team import Team
from quad_swarm.realtime.udp_world import UdpWorld
from quad_swarm.realtime.vehicles import Flight
from quad_swarm.realtime.virtual import VirtualFlight
from quad_swarm.robot import files
from quad_swarm.ros.world import RosWorld
from quad_swarm.validation import read_assignments
from quad_swarm.world.disturbances import Radio
from quad_swarm.world.kinds import make_planners
from quad_swarm.world.presets import PRESETS, REAL_TIME, SwarmConfig, for_scenario, make_config
from quad_swarm.world.route import Targets
from quad_swarm.world.scenarios import CHANGING_GOALS, SCENARIOS, ScenarioSampler, Scene

EXAMPLES = "  sb3-maddpg fly --n-robots 8 --policy none full pretrained:quad-swarm-flight-v2 --episodes 3 --loss 0.1"
LINKS = ("udp", "ros2", "virtual")
_LINGER = 1.0  # s
_MUCH = 0.02  # share of late commands
_FLOWN = ("range", "half_distance", "path_loss_exponent")  # fields of the radio
_ATTEMPTS = 3  # to fly an episode without the machine standing still


@dataclass
class Flown:
    """What a policy flew.

    :param n_robots: number of robots
    :param flights: the flights
    :param repeated: flights that did not count, since the machine, and the world with it, stood still meanwhile
    """

    n_robots: int
    flights: list[Flight] = field(default_factory=list)
    repeated: int = 0

    def row(self) -> dict[str, Any]:
        """Return its statistics by name. Durations are in milliseconds, as medians and as quantiles that one in a
        thousand exceeds."""
        flights, n = self.flights, len(self.flights)
        done = total(flight.total for flight in flights)
        counts, durations = done.counts, done.durations
        traffic = [one for flight in flights for one in flight.traffic if one is not None]
        collided = sum(flight.collided for flight in flights)
        low, high = wilson_interval(collided, n)
        arrived = np.array([flight.arrived.max() for flight in flights])
        periods = counts["periods"] + counts["missed"]
        seconds = sum(flight.seconds * self.n_robots for flight in flights)
        row: dict[str, Any] = {
            "flights": n,
            "collided": collided,
            "collision_low": low,
            "collision_high": high,
            "struck": sum(bool(flight.struck) for flight in flights),
            "closest": min(flight.closest for flight in flights),
            "arrived": int(np.isfinite(arrived).sum()),
            "seconds_to_arrival": float(np.nanmean(arrived)) if np.isfinite(arrived).any() else None,
            "periods": periods,
            "plans_sent": counts["answers"] + counts["announcements"],
            "plan_share": (counts["answers"] + counts["announcements"]) / max(periods * (self.n_robots - 1), 1),
            "bytes_per_second": sum(one.bytes for one in traffic) / seconds,
            "missed": done.share("missed"),
            "late": done.share("late commands"),
            "cpu": done.cpu_seconds / done.seconds if done.seconds else None,
            "repeated": self.repeated,
            "counts": dict(sorted(counts.items())),
        }
        for name, histogram in durations.items():
            quantiles = [histogram.quantile(share) * 1e-3 for share in (0.5, 0.999)]
            row[f"{name}_ms"] = quantiles if histogram.total else [None, None]
        return row


class Column(NamedTuple):
    """A column of the table."""

    title: str
    text: Callable[[dict[str, Any]], str]


def _pair(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: "-" if row[key][0] is None else " / ".join(f"{value:.0f}" for value in row[key])


def _share(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: "-" if row[key] is None else f"{row[key]:.2%}"


COLUMNS = [
    Column("policy", lambda row: row["policy"]),
    Column("collided", lambda row: f"{row['collided']}/{row['flights']}"),
    Column("95 % interval", lambda row: f"{100 * row['collision_low']:.1f} - {row['collision_high']:.1%}"),
    Column("arrived", lambda row: f"{row['arrived']}/{row['flights']}"),
    Column("in (s)", lambda row: "-" if row["seconds_to_arrival"] is None else f"{row['seconds_to_arrival']:.2f}"),
    Column("plans", _share("plan_share")),
    Column("B/s", lambda row: f"{row['bytes_per_second']:.0f}"),
    Column("age (ms)", _pair("plan_age_ms")),
    Column("missed", _share("missed")),
    Column("late", _share("late")),
    Column("CPU", _share("cpu")),
    Column("again", lambda row: str(row["repeated"])),
]
LEGEND = (
    "in: until the last robot was at its goal for the first time; plans: sent, of all that could be, in the whole\n"
    "flight; B/s: sent by a robot in a second; age: of plans when used, median / 99.9 %;\n"
    "missed, late: periods skipped, commands later than assumed; CPU: of a core, by a robot's process\n"
    "again: flights that did not count, since the machine stood still meanwhile"
)


def format_table(rows: Sequence[dict[str, Any]]) -> str:
    """Format rows as a table."""
    texts = [[column.title for column in COLUMNS], *([column.text(row) for column in COLUMNS] for row in rows)]
    return aligned(texts, 1)


def episodes(config: SwarmConfig, scenario: str, seeds: Iterable[int]) -> Iterator[tuple[Scene, int]]:
    """Return episodes as `evaluate` flies them, and the seeds of their disturbances.

    :param config: the world
    :param scenario: a name of `SCENARIOS`
    :param seeds: seeds, see `first_episode`
    :raises ValueError: if goals change in flight
    """
    sampler = ScenarioSampler(scenario, config.n_robots, config.space, config)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        name, scene = sampler.draw(rng)
        if Targets.of(scene.goals, scene.velocities, scene.waypoints, config.n_robots).change:
            raise ValueError(f"scenario={name!r}: its goals change in flight, which only simulated swarms fly.")
        yield scene, int(rng.integers(2**63)) if config.is_random else 0


class Watcher(Protocol):
    """Follows flights."""

    def begin(self, policy: str, scene: Scene) -> None:
        """Begin to follow a flight.

        :param policy: what flies
        :param scene: the episode
        """

    def add(self, sample: Sample) -> None:
        """Take the next period."""

    def end(self) -> None:
        """Take note that the flight is over."""


def fly(
    team: Team,
    flown: Iterable[tuple[Scene, int]],
    link: str,
    most: float,
    watchers: Sequence[Watcher] = (),
    name: str = "",
) -> Iterator[tuple[Flight, bool]]:
    """Fly episodes. Yields each flight, and whether it counts: if the machine, and the world with it, stood still for
    more than a tenth of a second, it is flown again, up to two times.

    :param team: the team
    :param flown: episodes, see `episodes`
    :param link: one of `LINKS`
    :param most: time limit of a flight (s)
    :param watchers: what follows the flights
    :param name: name of the policy for them
    """

    def sees(sample: Sample) -> None:
        for watcher in watchers:
            watcher.add(sample)

    def tell(scene: Scene | None) -> None:
        for watcher in watchers:
            if scene is None:
                watcher.end()
            else:
                watcher.begin(name, scene)

    if link == "virtual":
        virtual = _virtual(team)
        for scene, seed in flown:
            tell(scene)
            virtual.reset(scene.starts, scene.goals, seed, scene.obstacles)
            virtual.fly(most, _LINGER, sees if watchers else None)
            tell(None)
            yield virtual.result(), True
        return
    exchange: Exchange = RosWorld(team.config.n_robots) if link == "ros2" else UdpWorld()
    with Arena(team, exchange, modules=user_modules()) as arena:
        for scene, seed in flown:
            places = scene.starts, scene.goals
            for attempt in range(_ATTEMPTS):
                tell(scene)
                watched = sees if watchers else None
                flight = arena.fly(*places, seed, most, _LINGER, sees=watched, obstacles=scene.obstacles)
                tell(None)
                counts = not flight.pauses or attempt == _ATTEMPTS - 1
                yield flight, counts
                if counts:
                    break


def _virtual(team: Team) -> VirtualFlight:
    config = team.config
    planners = make_planners(config)
    policies = [team.robot(k, planner).policy for k, planner in enumerate(planners)]
    times = (team.wait, team.late)
    return VirtualFlight(config, policies, team.conditions, None, team.limits, *times, team.checked, planners)


def make_parser() -> Parser:
    """Return the parser of the command."""
    parser = Parser("sb3-maddpg fly", description=__doc__)
    parser.add_argument(
        "--policy",
        nargs="+",
        required=True,
        metavar="POLICY",
        help="rules and models, as for `sb3-maddpg evaluate`, and folders that `sb3-maddpg export` wrote",
    )
    parser.add_argument("--n-robots", type=int, help="number of robots (default: the preset's)")
    parser.add_argument(
        "--preset",
        help=f"{', '.join(PRESETS)} (default: that of exported folders or models, otherwise {REAL_TIME})",
    )
    parser.add_argument(
        "--world", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="fields of the preset"
    )
    add_limits_argument(parser)
    parser.add_argument("--plant", help="simulated vehicle, such as crazyflow:cf21B_500 (default: the preset's)")
    names = [name for name in SCENARIOS if name not in CHANGING_GOALS]
    parser.add_argument("--scenario", choices=names, default="symmetric_swap", help="(default %(default)s)")
    parser.add_argument("--episodes", type=int, default=1, help="number of flights of each policy (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="set of episodes, see `sb3-maddpg evaluate` (default 0)")
    parser.add_argument("--link", choices=LINKS, default="udp", help="how robots talk (default %(default)s)")
    parser.add_argument("--loss", type=float, default=0.0, help="share of messages that are lost (default 0)")
    parser.add_argument("--most", type=float, default=15.0, metavar="SECONDS", help="longest flight (default 15)")
    parser.add_argument("--wait", type=float, default=0.005, metavar="SECONDS", help="for answers (default 0.005)")
    parser.add_argument("--late", type=float, default=0.25, help="when commands act, in periods (default 0.25)")
    parser.add_argument(
        "--priority", type=int, default=0, help="real-time priority of all processes (SCHED_FIFO), 1 to 99"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows")
    parser.add_argument(
        "--live", type=int, nargs="?", const=0, metavar="PORT", help="show the flights on a web page of this machine"
    )
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="record the flights as .npz, .csv or .mcap; several get numbers, and none is overwritten",
    )
    parser.add_argument("--gym-packages", nargs="+", action="extend", metavar="MODULE", help="modules to import first")
    parser.add_argument("--algo", default="sb3_maddpg:MADDPG", metavar="MODULE:CLASS", help="class that loads models")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return run(_main, make_parser().parse_args(argv))


def _main(args: argparse.Namespace) -> None:
    _check(args)
    if args.json is not None:
        check_writable(args.json, "--json")
    exported = {one for one in args.policy if (Path(one) / files.DESCRIPTION).is_file()}
    named = [one for one in args.policy if is_model(one) and one not in exported]
    models = {one: trained_in(load_model(one, args.algo)) for one in named}
    worlds = {one: files.load(one).config for one in sorted(exported)}
    preset, base = _base(args.preset, models, worlds)
    config = make_config(base, read_assignments("--world", args.world), n_robots=args.n_robots, plant=args.plant)
    check_limits(args.limits, config)
    _check_radio(config, make_config(base))
    config = for_scenario(config, args.scenario)
    if not 0 <= args.priority <= 99:
        raise ValueError(f"--priority {args.priority}: it must be from 1 to 99, or 0 for none.")
    if not set_priority(args.priority):
        print("no real-time priority: the system does not allow it", file=sys.stderr)
    if args.record is not None:
        check_suffix(args.record)
        check_writable(args.record, "--record")
    rows, first = [], first_episode(args.seed)
    scenes = list(episodes(config, args.scenario, range(first, first + args.episodes)))
    about = {"scenario": args.scenario, "n_robots": config.n_robots, "preset": preset, "plant": config.plant}
    about |= {"link": args.link, "loss": args.loss, "wait": args.wait, "acts_after": args.late, "seed": args.seed}
    names = short_names(args.policy)
    recorder = None if args.record is None else _Recorder(args.record, config, len(scenes) * len(args.policy))
    options = {"wait": args.wait, "late": args.late, "priority": args.priority}
    with contextlib.ExitStack() as stack:
        watchers: list[Watcher] = [] if recorder is None else [recorder]
        if args.live is not None:
            from quad_swarm.figures.live import LivePage

            page = stack.enter_context(LivePage(config, args.live))
            print(f"The flights are shown at {page.url}", file=sys.stderr, flush=True)
            watchers.append(page)
        teams = {}
        for policy in args.policy:  # all of them before the first flight
            flown_as = policy
            if policy in models:
                flown_as = stack.enter_context(tempfile.TemporaryDirectory(prefix="quad-swarm-"))
                export(policy, config, Path(flown_as), args.algo)
            teams[policy] = Team(config, flown_as, conditions=Conditions(args.loss), **options)
            _try(teams[policy], scenes[0][0])
        for policy, team in teams.items():
            flown = _fly(team, scenes, args, names[policy], recorder, watchers)
            rows.append({"policy": names[policy], **about, **flown.row()})
            if args.link == "virtual":  # one process flies all robots
                rows[-1]["cpu"] = None
    print(format_table(rows))
    print(LEGEND)
    world = " ".join([f"preset: {preset}", *args.world])
    print(f"{world}; messages lost on purpose: {args.loss:.0%} (--loss)")
    if args.json is not None:
        write_rows(args.json, rows)


def _check(args: argparse.Namespace) -> None:
    if args.episodes < 1:
        raise ValueError(f"--episodes {args.episodes}: fly at least one.")
    if not 0 < args.most < np.inf:
        raise ValueError(f"--most {args.most:g}: it must be a number of seconds above 0.")


def _check_radio(config: SwarmConfig, base: SwarmConfig) -> None:
    """Refuse what only simulated radios do.

    :param config: the world
    :param base: what it was before the user changed it
    """
    for one in dataclasses.fields(Radio):
        value = getattr(config.radio, one.name)
        if one.name not in _FLOWN and value != getattr(base.radio, one.name):
            raise ValueError(
                f"radio.{one.name}={value}: here messages are sent, and no radio is simulated but for its range. Lose "
                "some with --loss; `sb3-maddpg evaluate` flies all of `radio`."
            )


def _try(team: Team, scene: Scene) -> None:
    """Let a robot decide once. In flight, errors of a policy are counted, and the robot asks everybody.

    :raises ValueError: if its policy fails
    """
    robot, still = team.robot(0), np.zeros(9)
    still[POSITION] = scene.starts[0]
    robot.reset(scene.starts[0], scene.goals[0], team.late, obstacles=scene.obstacles)
    robot.decide(0, still, scene.starts[1:], np.zeros_like(scene.starts[1:]))


def _base(
    preset: str | None, models: Mapping[str, Any], worlds: Mapping[str, SwarmConfig]
) -> tuple[str, str | SwarmConfig]:
    """Return name and content of the world to begin with: a preset, that of the models, or that of exported folders.

    :param preset: name of a preset, None if the user named none
    :param models: arguments of each model's environment
    :param worlds: world of each exported folder
    :raises ValueError: if models or folders have different ones
    """
    if preset is not None or not worlds:
        preset = preset or (preset_of(models) if models else REAL_TIME)
        return preset, preset
    first, *others = worlds
    for other in others:
        if worlds[other] != worlds[first]:
            raise ValueError(f"{first} and {other} were exported for different worlds: fly one after the other.")
    return "exported", worlds[first]


def _fly(
    team: Team,
    scenes: Sequence[tuple[Scene, int]],
    args: argparse.Namespace,
    policy: str,
    recorder: _Recorder | None,
    watchers: Sequence[Watcher],
) -> Flown:
    """Fly episodes, and tell how each ended."""
    flown = Flown(team.config.n_robots)
    for flight, counts in fly(team, scenes, args.link, args.most, watchers, policy):
        if counts:
            flown.flights.append(flight)
            kept = "" if recorder is None else f" -> {recorder.write(flight)}"
            print(f"{_line(policy, len(flown.flights), flight)}{kept}", file=sys.stderr, flush=True)
        flown.repeated += not counts
    _warn(policy, flown)
    return flown


def _warn(policy: str, flown: Flown) -> None:
    """Say what makes flights doubtful: errors, and commands that were later than planned."""
    done = total(flight.total for flight in flown.flights)
    errors = {name: count for name, count in done.counts.items() if name.startswith("errors")}
    if errors:
        counted = ", ".join(f"{count} {name}" for name, count in sorted(errors.items()))
        print(f"{policy}: {counted}; the last one: {done.last_error}", file=sys.stderr)
    if (late := done.share("late commands") or 0.0) > _MUCH:
        print(
            f"{policy}: {late:.0%} of the commands were later than planned, so these flights say little: fly on a "
            "machine with less to do or fewer robots, with --priority, a larger --late, or --link virtual.",
            file=sys.stderr,
        )


class _Recorder:
    """A watcher that writes recordings, with numbers if there are several.

    :param path: path of a single one
    :param config: the world
    :param count: number of flights
    :raises ValueError: if there is such a file already
    """

    def __init__(self, path: Path, config: SwarmConfig, count: int):
        self._path, self._config, self._count, self._written = path, config, count, 0
        for number in range(1, count + 1):
            if (there := numbered(path, number, count)).is_file():
                raise ValueError(
                    f"--record {path}: {there} is there already, and no flight is overwritten; remove it, or choose "
                    "another name."
                )

    def begin(self, policy: str, scene: Scene) -> None:
        """See `Watcher`."""
        self._policy, self._scene, self._samples = policy, scene, list[Sample]()

    def add(self, sample: Sample) -> None:
        """See `Watcher`."""
        self._samples.append(sample)

    def end(self) -> None:
        """See `Watcher`."""

    def write(self, flight: Flight) -> Path:
        """Write the recording of the last flight.

        :param flight: how it ended
        :return: the file
        """
        self._written += 1
        recording = recorded(self._samples, self._config, self._scene, self._policy)
        row = Flown(self._config.n_robots, [flight]).row()
        recording = dataclasses.replace(recording, measured={name: row[name] for name in MEASURED})
        path = numbered(self._path, self._written, self._count)
        write(path, recording)
        return path


def recorded(samples: Sequence[Sample], config: SwarmConfig, scene: Scene, policy: str) -> Recording:
    """Return the recording of a flight.

    :param samples: the flight
    :param config: the world
    :param scene: the episode
    :param policy: what flew
    """
    n, times = config.n_robots, len(samples)
    plan = np.full((times, n, config.planner.horizon + 1, 3), np.nan)
    asked, told = np.zeros((2, times, n, n), dtype=bool)
    bits = 1 << np.arange(n, dtype=np.uint64)
    for k, sample in enumerate(samples):
        for report in sample.reports:
            plan[k, report.robot] = report.plan
            asked[k, report.robot] |= (np.uint64(report.asked) & bits) > 0
            told[k, report.robot] |= (np.uint64(report.told) & bits) > 0
    time, state, setpoint = map(np.array, zip(*((one.time, one.state, one.setpoint) for one in samples), strict=True))
    world, arrays = dataclasses.asdict(config), (time, state, setpoint, plan, asked, told, scene.goals)
    obstacles = tuple(one.after(float(time[0])) for one in scene.obstacles)
    return Recording(*arrays, world, policy, obstacles=obstacles)


def _line(policy: str, number: int, flight: Flight) -> str:
    met = f"collided: {flight.collisions}" if flight.collisions else "no collision"
    if flight.struck:
        met += f", touched obstacles: {flight.struck}"
    there = np.isfinite(flight.arrived)
    when = f"all arrived after {flight.arrived.max():.2f} s" if there.all() else f"{there.sum()} arrived"
    paused = ", the machine stood still meanwhile" if flight.pauses else ""
    return f"{policy}, flight {number}: {met}, closest {flight.closest:.2f} m, {when}{paused}"
