"""Recordings of flights, simulated and real: ``.npz``, ``.csv``, and ``.mcap`` for Foxglove and Lichtblick.

A table (``.csv``) has a row for each robot at each time, and these columns. Only the first five are needed to see a
flight and to count its collisions; ``sb3-maddpg identify --log`` also needs attitudes and set-points:

================================== =========================================================
``time``, ``robot``                time (s), number of the robot, from 0
``x``, ``y``, ``z``                position, world frame (m)
``vx``, ``vy``, ``vz``             velocity (m/s), otherwise by differences
``roll``, ``pitch``, ``yaw``       attitude (rad), otherwise 0
``roll_set``, ``pitch_set``,       set-point from then on (rad, rad, m/s, rad/s)
``climb_set``, ``yaw_rate_set``
``goal_x``, ``goal_y``, ``goal_z`` goal (m), otherwise unknown
``asked``, ``told``                robots whose plan it asked for, and to whom it sent its own unasked, as in ``2 5``
``obstacles``                      obstacles at the first time, see `Obstacle`, as JSON in one row; otherwise those that
                                   the world lists
``world``, ``policy``              fields of the world, see `SwarmConfig`, as JSON, and what flew, in one row
================================== =========================================================

Of velocities, attitudes and goals, a table has all columns or none. It does not hold the plans, which the other two
formats do.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import needs_extra, shown
from quad_swarm.evaluation.flight import Flight
from quad_swarm.geometry import closest_approach, flattened, length
from quad_swarm.quadrotor import POSITION
from quad_swarm.validation import replaced
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.obstacles import Obstacle, Surroundings, between, surroundings
from quad_swarm.world.presets import SwarmConfig, make_config

SUFFIXES = (".npz", ".csv", ".mcap")
_STATE = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw")
_SET = ("roll_set", "pitch_set", "climb_set", "yaw_rate_set")
_GOAL = ("goal_x", "goal_y", "goal_z")
_MOST_ROBOTS, _MOST_TIMES, _MOST_OBSTACLES = 1000, 10**6, 200
_MOST_DISTANCES = 10**6  # at once
_FASTEST, _SLOWEST, _SHORT = 20.0, 0.01, 0.5  # m/s, m/s, m
# What a file need not tell: velocities are then differences, attitudes 0, goals where robots end, nobody talks, and
# radii are those of a preset
GUESSES = ("velocity", "attitude", "goal", "talk", "radius")
# What robots that fly in real time measure in a flight: their periods, missed ones included; plans that all sent; bytes
# that a robot sent in a second; shares of the periods that were missed, and whose commands were late
MEASURED = ("periods", "plans_sent", "bytes_per_second", "missed", "late")
# Members of .npz files: axes after the times
_ARRAYS: dict[str, Callable[[int, int], tuple[int, ...]]] = {
    "state": lambda n, horizon: (n, 9),
    "setpoint": lambda n, horizon: (n, 4),
    "plan": lambda n, horizon: (n, horizon, 3),
    "asked": lambda n, horizon: (n, n),
    "told": lambda n, horizon: (n, n),
}


class Meetings(NamedTuple):
    """How close the pairs of robots, or of a robot and an obstacle, came.

    :param pairs: numbers of each pair, (P, 2)
    :param closest: smallest distance of each pair, (P,) (m)
    :param when: when that was (s), (P,)
    """

    pairs: np.ndarray
    closest: np.ndarray
    when: np.ndarray


@dataclass(frozen=True)
class Recording:
    """A flight of n robots at T times.

    :param time: times (s), ascending, (T,)
    :param state: position (m), velocity (m/s), roll, pitch and yaw (rad), (T, n, 9)
    :param setpoint: roll, pitch (rad), climb rate (m/s) and yaw rate (rad/s) from then on, (T, n, 4); NaN if unknown
    :param plan: planned positions, (T, n, K, 3) (m); K is 0 if unknown, and a robot without a plan has NaN
    :param asked: whom each robot asked for its plan, (T, n, n) bool
    :param told: whom each robot sent its plan unasked, (T, n, n) bool
    :param goal: goals, (n, 3) (m)
    :param world: fields of the world, see `SwarmConfig`; empty if unknown
    :param policy: what flew
    :param guessed: some of `GUESSES`, which the file did not tell
    :param measured: values of `MEASURED`; empty if unknown
    :param obstacles: obstacles, where they are at the first time
    :raises ValueError: if the arrays do not belong together, or times, states or goals are not finite
    """

    time: np.ndarray
    state: np.ndarray
    setpoint: np.ndarray
    plan: np.ndarray
    asked: np.ndarray
    told: np.ndarray
    goal: np.ndarray
    world: dict[str, Any] = dataclasses.field(default_factory=dict)
    policy: str = ""
    guessed: frozenset[str] = frozenset()
    measured: dict[str, float] = dataclasses.field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        times, n = len(self.time), len(self.goal)
        if not 1 < times <= _MOST_TIMES or not 1 <= n <= _MOST_ROBOTS:
            raise ValueError(
                f"a flight has 2 to {_MOST_TIMES} times and 1 to {_MOST_ROBOTS} robots, not {times} and {n}"
            )
        horizon = self.plan.shape[2] if self.plan.ndim == 4 else 0
        for name, shape in _ARRAYS.items():
            expected = (times, *shape(n, horizon))
            if getattr(self, name).shape != expected:
                raise ValueError(f"{name} has the shape {getattr(self, name).shape}, not {expected}")
        if self.goal.shape != (n, 3) or not np.isfinite(self.goal).all():
            raise ValueError("goals must be finite, (n, 3)")
        if not np.isfinite(self.time).all() or (np.diff(self.time) <= 0).any():
            raise ValueError("times must be finite and ascending")
        if not np.isfinite(self.state).all():
            raise ValueError("states must be finite")
        if not self.guessed <= set(GUESSES):
            raise ValueError(f"guessed must be some of {', '.join(GUESSES)}, not {', '.join(sorted(self.guessed))}")
        if self.measured and (set(self.measured) != set(MEASURED) or not all(map(_is_amount, self.measured.values()))):
            raise ValueError(f"measured must be finite numbers from 0: {', '.join(MEASURED)}")

    @property
    def n_robots(self) -> int:
        """Number of robots n."""
        return len(self.goal)

    def separation(
        self, continuous: bool = True, downwash: float = 1.0, excess: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the smallest distance of two robots at each time, (T,) (m); infinity for a single robot.

        :param continuous: whether also since the time before, if robots moved in straight lines
        :param downwash: see `PlannerConfig`
        :param excess: see `SwarmConfig.excess`
        """
        return self._smallest(self._apart(continuous, downwash, excess))

    def meetings(self, continuous: bool = True, downwash: float = 1.0, excess: np.ndarray | None = None) -> Meetings:
        """Return how close each pair of robots came, and when.

        :param continuous: see `separation`
        :param downwash: see `PlannerConfig`
        :param excess: see `SwarmConfig.excess`
        """
        pairs = np.transpose(np.triu_indices(self.n_robots, k=1))
        return self._met(pairs, self._apart(continuous, downwash, excess))

    def clearance(self, radii: np.ndarray, continuous: bool = True) -> np.ndarray:
        """Return the smallest distance between the surfaces of a robot and an obstacle at each time, (T,) (m);
        infinity without obstacles.

        :param radii: radii of the robots, (n,) (m)
        :param continuous: see `separation`
        """
        return self._smallest(self._beside(continuous, radii))

    def encounters(self, radii: np.ndarray, continuous: bool = True) -> Meetings:
        """Return how close the surface of each robot came to that of each obstacle, and when.

        :param radii: radii of the robots, (n,) (m)
        :param continuous: see `separation`
        """
        pairs = np.transpose(np.divmod(np.arange(self.n_robots * len(self.obstacles)), max(len(self.obstacles), 1)))
        return self._met(pairs, self._beside(continuous, radii))

    @property
    def obstacle_pos(self) -> np.ndarray:
        """Centres of the obstacles at each time, (T, K, 3), world frame (m)."""
        among, since = self._among, self.time - self.time[0]
        return among.position + since[:, None, None] * among.velocity

    @property
    def _among(self) -> Surroundings:
        return surroundings(self.obstacles)

    def _smallest(self, distances: Iterator[tuple[int, np.ndarray, np.ndarray]]) -> np.ndarray:
        return np.concatenate([apart.min(axis=1, initial=np.inf) for _, apart, _ in distances])

    def _met(self, pairs: np.ndarray, distances: Iterator[tuple[int, np.ndarray, np.ndarray]]) -> Meetings:
        closest, when = np.full((2, len(pairs)), np.inf)
        for first, apart, back in distances:
            least = apart.argmin(axis=0)
            nearest, rows = apart[least, np.arange(len(pairs))], first + least
            shorter = nearest < closest
            steps = self.time[rows] - self.time[np.maximum(rows - 1, 0)]
            met = self.time[rows] - back[least, np.arange(len(pairs))] * steps
            closest, when = np.where(shorter, nearest, closest), np.where(shorter, met, when)
        return Meetings(pairs, closest, when)

    def _apart(
        self, continuous: bool, downwash: float, excess: np.ndarray | None
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield some times after the other: the index of the first, the distances of the pairs at and since the time
        before (m), and how long before each time they were so close, as a share of the step, both (times, P)."""
        one, other = np.triu_indices(self.n_robots, k=1)

        def apart(times: slice) -> np.ndarray:
            pos = self.state[times, :, POSITION]
            return flattened(pos[:, other] - pos[:, one], downwash)

        for first, distance, back in self._distances(apart, len(one), continuous):
            yield first, distance if excess is None else distance - excess[one, other], back

    def _beside(self, continuous: bool, radii: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield the same of the pairs of a robot's and an obstacle's surface, those of the first robot first."""
        among, centres, count = self._among, self.obstacle_pos, self.n_robots * len(self.obstacles)
        reach, own = np.tile(among.radius, self.n_robots), np.repeat(radii, len(self.obstacles))

        def away(times: slice) -> np.ndarray:
            pos = self.state[times, :, POSITION]
            return between(pos, centres[times], among.factors).reshape(len(pos), count, 3)

        for first, distance, back in self._distances(away, count, continuous):
            yield first, distance - reach - own, back

    def _distances(
        self, vectors: Callable[[slice], np.ndarray], count: int, continuous: bool
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """See `_apart`.

        :param vectors: returns what is between the pairs at some times, (times, P, 3) (m)
        :param count: number of pairs P
        """
        size = max(_MOST_DISTANCES // max(count, 1), 1)
        for first in range(0, len(self.time), size):
            found = vectors(slice(max(first - 1, 0), first + size))
            if first == 0:
                found = np.concatenate([found[:1], found])
            nearest, back = found[1:], np.zeros(found[1:].shape[:2])
            if continuous:
                nearest, share = closest_approach(found[:-1], np.diff(found, axis=0), 1.0)
                back = 1.0 - share
            yield first, length(nearest), back

    def config(self, otherwise: SwarmConfig | None = None) -> SwarmConfig:
        """Return the world.

        :param otherwise: the world if the recording does not tell
        :raises ValueError: if it has no such world, or another number of robots
        """
        config = replaced(SwarmConfig(), self.world, "world") if self.world or otherwise is None else otherwise
        return dataclasses.replace(config, n_robots=self.n_robots)

    def flight(self, otherwise: SwarmConfig | None = None) -> Flight:
        """Return the recording as a flight, as pictures and pages show it.

        :param otherwise: see `config`
        """
        config, others = self.config(otherwise), other_indices(self.n_robots)
        horizon = max(self.plan.shape[2], 1)
        plans = np.zeros((*self.state.shape[:2], horizon, 9))
        plans[..., POSITION] = self.state[:, :, None, POSITION]
        if self.plan.shape[2]:
            known = np.isfinite(self.plan).all(axis=(2, 3))
            plans[known, :, POSITION] = self.plan[known]
        rows = np.arange(self.n_robots)[:, None]
        asked = self.asked[:-1][:, rows, others]
        announced = self.told[:-1].swapaxes(1, 2)[:, rows, others] & ~asked
        continuous = config.continuous_collisions
        none, separation = np.zeros_like(asked), self.separation(continuous, config.planner.downwash, config.excess)
        flight = Flight(config, self.state, plans, self.goal, asked | announced, announced, none, separation)
        if not self.obstacles:
            return flight
        return dataclasses.replace(
            flight,
            obstacles=self.obstacles,
            obstacle_pos=self.obstacle_pos,
            min_obstacle_distance=self.clearance(config.radii, continuous),
        )

    @classmethod
    def of(cls, flight: Flight, policy: str = "") -> Recording:
        """Return the recording of a simulated flight.

        :param flight: the flight
        :param policy: what flew
        """
        times, n = flight.state.shape[:2]
        asked, told = np.zeros((2, times, n, n), dtype=bool)
        rows, others = np.arange(n)[:, None], other_indices(n)
        asked[:-1, rows, others] = flight.requests & ~flight.announced
        told[:-1, others, rows] = flight.announced
        time = np.arange(times) * flight.config.planner.dt
        setpoint = np.full((times, n, 4), np.nan)
        if flight.inputs is not None:
            setpoint[:-1] = flight.inputs
        world, plan = dataclasses.asdict(flight.config), flight.plans[..., POSITION]
        # Recordings hold a single goal of each robot, so that of flights to several, nothing is said about arrivals
        guessed = frozenset() if flight.goals is None else frozenset({"goal"})
        arrays = (time, flight.state, setpoint, plan, asked, told, flight.goal)
        return cls(*arrays, world, policy, guessed, obstacles=flight.obstacles)


def _is_amount(value: object) -> bool:
    return isinstance(value, (int, float)) and 0 <= value < np.inf


def check_suffix(path: Path) -> None:
    """Check the name of a recording.

    :raises ValueError: if its suffix is none of `SUFFIXES`
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path}: recordings end in {', '.join(SUFFIXES)}.")


def write(path: Path, recording: Recording) -> None:
    """Write a recording in the format of the file's suffix.

    :raises ValueError: if there is no such format
    :raises ImportError: if the extra ``record`` is not installed, which ``.mcap`` needs
    """
    check_suffix(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mcap":
        with needs_extra(f"{path.name}", "record"):
            from quad_swarm.evaluation import mcap_files
        mcap_files.write(path, recording)
        return
    {".npz": _write_npz, ".csv": _write_csv}[path.suffix](path, recording)


def read(path: Path) -> Recording:
    """Read a recording, of this package or a laboratory's own.

    :raises ValueError: if the file cannot be read, or is no recording
    :raises ImportError: if the extra ``record`` is not installed, which ``.mcap`` needs
    """
    check_suffix(path)
    readers = {".npz": _read_npz, ".csv": _read_csv}
    if path.suffix == ".mcap":
        with needs_extra(f"{path.name}", "record"):
            from quad_swarm.evaluation import mcap_files
        readers[".mcap"] = mcap_files.read
    try:
        recording = readers[path.suffix](path)
        _check_units(recording)
        return recording
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile, EOFError, RecursionError) as error:
        told = " ".join(str(error).split()) if isinstance(error, ValueError) else shown(str(error))
        raise ValueError(f"{path} is no recording of a flight: {told[:300].rstrip('.')}.") from None


def _check_units(recording: Recording) -> None:
    """Check that robots move as fast, and lean as much, as robots do.

    :raises ValueError: if they do not
    """
    steepest = float(np.abs(recording.state[..., 6:8]).max())
    if steepest > np.pi:
        raise ValueError(f"its roll and pitch are up to {steepest:.3g}: give attitudes in rad")
    moved = length(np.diff(recording.state[..., POSITION], axis=0))
    speed, paths = moved / np.diff(recording.time)[:, None], moved.sum(axis=0)
    typical = float(np.median(speed[moved > 0])) if moved.any() else 0.0
    if typical > _FASTEST:
        raise ValueError(
            f"its robots move at {typical:.3g} m/s, in the median: give positions in metres and times in seconds"
        )
    if paths.max() > _SHORT and speed.max() < _SLOWEST:
        seconds = recording.time[-1] - recording.time[0]
        raise ValueError(
            f"its robots take {seconds:.0f} s for {paths.max():.1f} m: give positions in metres and times in seconds"
        )


def read_flights(
    paths: Sequence[Path], preset: str | None = None, changes: Mapping[str, Any] | None = None
) -> list[tuple[Path, Recording]]:
    """Read recordings of swarms, each with its file. All get a world, whose listed obstacles a recording has that tells
    none.

    :param paths: files
    :param preset: name of a preset, which replaces recorded worlds; it is "flight" for those that do not tell
    :param changes: fields that replace those of the worlds, see `make_config`
    :raises ValueError: if a file is no recording of two or more robots, or does not fit its world
    """
    found = []
    for path in paths:
        recording = read(path)
        if recording.n_robots < 2:
            raise ValueError(f"{path} holds one robot, which cannot meet another: name a flight of two or more.")
        base = preset or (recording.config() if recording.world else "flight")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtfulWorld)  # which is about what will fly
            world = make_config(base, changes, n_robots=recording.n_robots)
        listed = world.obstacles.listed
        given = recording.world and listed != recording.config().obstacles.listed
        obstacles = listed if listed and given else recording.obstacles or listed
        guessed = recording.guessed
        if not recording.world and preset is None and not {"radius", "vehicles"} & set(changes or ()):
            guessed |= {"radius"}
        told: dict[str, Any] = {"world": dataclasses.asdict(world), "obstacles": obstacles, "guessed": guessed}
        found.append((path, dataclasses.replace(recording, **told)))
    return found


def numbered(path: Path, number: int, count: int) -> Path:
    """Return the path of one of several recordings.

    :param path: path of a single one
    :param number: its number, from 1
    :param count: how many there are
    """
    return path if count == 1 else path.with_name(f"{path.stem}_{number}{path.suffix}")


def about(recording: Recording) -> str:
    """Return as JSON what is no array, see `from_about`, and goals."""
    rest = {"guessed": sorted(recording.guessed), "measured": recording.measured, "goal": recording.goal.tolist()}
    if recording.obstacles:
        rest["obstacles"] = _plain(recording.obstacles)
    return json.dumps({"world": recording.world, "policy": recording.policy, **rest})


def _plain(obstacles: Sequence[Obstacle]) -> list[dict[str, Any]]:
    return [dataclasses.asdict(one) for one in obstacles]


def _obstacles(listed: Any) -> tuple[Obstacle, ...]:
    """Return obstacles from what `_plain` returned.

    :raises ValueError: if there are too many, or one is none
    """
    if (
        not isinstance(listed, list)
        or len(listed) > _MOST_OBSTACLES
        or not all(isinstance(one, dict) for one in listed)
    ):
        raise ValueError(f"obstacles={shown(listed)}: it must be a list of up to {_MOST_OBSTACLES} obstacles")
    return tuple(Obstacle(**one) for one in listed)


def from_about(rest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `Recording` that are no arrays from what `about` returned."""
    return {
        "world": dict(rest["world"]),
        "policy": str(rest["policy"]),
        "guessed": frozenset(rest.get("guessed", ())),
        "measured": dict(rest.get("measured", {})),
        "obstacles": _obstacles(rest.get("obstacles", [])),
    }


def _write_npz(path: Path, recording: Recording) -> None:
    arrays = {name: getattr(recording, name) for name in ("time", "goal", *_ARRAYS)}
    with path.open("wb") as file:
        np.savez_compressed(file, about=np.array(about(recording)), **arrays)


def _read_npz(path: Path) -> Recording:
    with np.load(path, allow_pickle=False) as content:
        rest = json.loads(str(content["about"]))
        arrays = {name: content[name] for name in ("time", "goal", *_ARRAYS)}
    return Recording(**from_about(rest), **arrays)


def _write_csv(path: Path, recording: Recording) -> None:
    known = {name: name not in recording.guessed for name in GUESSES}
    shown = [True] * 3 + [known["velocity"]] * 3 + [known["attitude"]] * 3 + [True] * 4 + [known["goal"]] * 3
    titles = [name for name, wanted in zip((*_STATE, *_SET, *_GOAL), shown, strict=True) if wanted]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        once = {
            "obstacles": json.dumps(_plain(recording.obstacles)) if recording.obstacles else "",
            "world": json.dumps(recording.world) if recording.world else "",
            "policy": recording.policy,
        }
        once = {name: text for name, text in once.items() if text}
        titles += [*(["asked", "told"] if known["talk"] else []), *once]
        writer.writerow(["time", "robot", *titles])
        for k, time in enumerate(recording.time):
            for robot in range(recording.n_robots):
                numbers = (*recording.state[k, robot], *recording.setpoint[k, robot], *recording.goal[robot])
                wanted = (one for one, wanted in zip(numbers, shown, strict=True) if wanted)
                texts = ("" if np.isnan(one) else repr(float(one)) for one in wanted)
                talk = (recording.asked, recording.told) if known["talk"] else ()
                lists = (" ".join(map(str, np.flatnonzero(one[k, robot]))) for one in talk)
                writer.writerow([repr(float(time)), robot, *texts, *lists, *once.values()])
                once = dict.fromkeys(once, "")


def _rows_of_csv(path: Path) -> tuple[list[dict[str, Any]], np.ndarray, int]:
    """Return the rows of a table by time and robot, the times (T,), and the number of robots n."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        table = csv.DictReader(file)
        rows: list[dict[str, Any]] = list(table)
        titles = table.fieldnames or ()
    missing = [name for name in ("time", "robot", *_STATE[:3]) if name not in titles]
    if missing and any(";" in title or "\t" in title for title in titles):
        raise ValueError("its columns are separated by semicolons or tabs: separate them by commas")
    if missing:
        raise ValueError(f"it needs the columns time, robot, x, y and z, and has no {', '.join(missing)}")
    if not rows:
        raise ValueError("it has no rows")
    for line, row in enumerate(rows, start=2):
        row["time"], row["robot"] = _number(row, "time", line), _number(row, "robot", line)
        if not row["robot"].is_integer():
            raise ValueError(f"line {line}: robot={row['robot']:g} is no whole number")
        row["robot"] = int(row["robot"])
    times, robots = sorted({row["time"] for row in rows}), sorted({row["robot"] for row in rows})
    if robots != list(range(len(robots))):
        named = ", ".join(map(str, robots[:8]))
        raise ValueError(f"its robots have the numbers {named}: count them from 0, without gaps")
    found = Counter((row["time"], row["robot"]) for row in rows)
    for time in times if len(rows) != len(times) * len(robots) or len(found) != len(rows) else ():
        for robot in robots:
            if (count := found[time, robot]) != 1:
                raise ValueError(
                    f"it has {count or 'no'} rows of robot {robot} at time {time:g}, and needs one row for each time "
                    "and each robot: interpolate"
                )
    rows.sort(key=lambda row: (row["time"], row["robot"]))
    return rows, np.array(times), len(robots)


def _number(row: Mapping[str, Any], name: str, line: int) -> float:
    try:
        return float(row[name])
    except (TypeError, ValueError):
        raise ValueError(f"line {line}: {name}={shown(row[name])} is no number") from None


def _has(row: Mapping[str, Any], names: Sequence[str]) -> bool:
    """Return whether a table has columns that belong together.

    :raises ValueError: if it has some of them
    """
    there, missing = ([name for name in names if (name in row) is given] for given in (True, False))
    if there and missing:
        raise ValueError(f"it has {', '.join(there)}, but no {', '.join(missing)}: give all of them, or leave all out")
    return not missing


def _read_csv(path: Path) -> Recording:
    rows, time, n = _rows_of_csv(path)
    shape, guessed = (len(time), n), set()

    def column(name: str) -> np.ndarray:
        return np.array([float(row.get(name) or "nan") for row in rows]).reshape(shape)

    def columns(names: Sequence[str]) -> np.ndarray:
        return np.stack([column(name) for name in names], axis=-1)

    def columns_or(kind: str, names: Sequence[str], otherwise: np.ndarray) -> np.ndarray:
        if _has(rows[0], names):
            return columns(names)
        guessed.add(kind)
        return otherwise

    def sets(name: str) -> np.ndarray:
        marks = np.zeros((len(rows), n), dtype=bool)
        for row, mark in zip(rows, marks, strict=True):
            mark[[int(one) for one in (row.get(name) or "").split()]] = True
        return marks.reshape(*shape, n)

    pos = columns(_STATE[:3])
    vel = columns_or("velocity", _STATE[3:6], np.gradient(pos, time, axis=0) if len(time) > 1 else np.zeros_like(pos))
    attitude = columns_or("attitude", _STATE[6:], np.zeros((*shape, 3)))
    goal = columns_or("goal", _GOAL, np.broadcast_to(pos[-1], pos.shape))[-1]
    if rows[0].keys().isdisjoint({"asked", "told"}):
        guessed.add("talk")
    state, plan = np.concatenate([pos, vel, attitude], axis=-1), np.zeros((*shape, 0, 3))
    talk = (sets("asked"), sets("told"))

    def told(name: str) -> str:
        return next(filter(None, (row.get(name) for row in rows)), "")

    obstacles, world = _obstacles(json.loads(told("obstacles") or "[]")), dict(json.loads(told("world") or "{}"))
    arrays = (time, state, columns(_SET), plan, *talk, goal)
    return Recording(*arrays, world, told("policy"), guessed=frozenset(guessed), obstacles=obstacles)
