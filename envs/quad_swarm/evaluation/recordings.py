"""Recordings of flights, simulated and real: ``.npz``, ``.csv``, and ``.mcap`` for Foxglove and Lichtblick.

A table (``.csv``) has a row for each robot at each time, and these columns; only the first five are needed:

================================== =========================================================
``time``, ``robot``                time (s), number of the robot, from 0
``x``, ``y``, ``z``                position, world frame (m)
``vx``, ``vy``, ``vz``             velocity (m/s), otherwise by differences
``roll``, ``pitch``, ``yaw``       attitude (rad), otherwise 0
``roll_set``, ``pitch_set``,       set-point from then on (rad, rad, m/s, rad/s)
``climb_set``, ``yaw_rate_set``
``goal_x``, ``goal_y``, ``goal_z`` goal (m), otherwise where the robot ends
``asked``, ``told``                robots whose plan it asked for, and to whom it sent its own unasked, as in ``2 5``
================================== =========================================================
"""

from __future__ import annotations

import csv
import dataclasses
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.errors import needs_extra, shown
from quad_swarm.evaluation.flight import Flight
from quad_swarm.geometry import closest_approach, length
from quad_swarm.quadrotor import POSITION
from quad_swarm.validation import replaced
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import SwarmConfig

SUFFIXES = (".npz", ".csv", ".mcap")
_STATE = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw")
_SET = ("roll_set", "pitch_set", "climb_set", "yaw_rate_set")
_GOAL = ("goal_x", "goal_y", "goal_z")
_MOST_ROBOTS, _MOST_TIMES = 1000, 10**6
_NS = 1_000_000_000
# Members of .npz files: axes after the times
_ARRAYS: dict[str, Callable[[int, int], tuple[int, ...]]] = {
    "state": lambda n, horizon: (n, 9),
    "setpoint": lambda n, horizon: (n, 4),
    "plan": lambda n, horizon: (n, horizon, 3),
    "asked": lambda n, horizon: (n, n),
    "told": lambda n, horizon: (n, n),
}


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

    def __post_init__(self) -> None:
        times, n = len(self.time), len(self.goal)
        if not 1 < times <= _MOST_TIMES or not 2 <= n <= _MOST_ROBOTS:
            raise ValueError(f"a flight has two or more times and robots, not {times} and {n}")
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

    @property
    def n_robots(self) -> int:
        """Number of robots n."""
        return len(self.goal)

    def separation(self, continuous: bool = True) -> np.ndarray:
        """Return the smallest distance of two robots at each time, (T,) (m).

        :param continuous: whether also since the time before, if robots moved in straight lines
        """
        others = other_indices(self.n_robots)
        between = self.state[:, others, POSITION] - self.state[:, :, None, POSITION]
        apart = length(between).min(axis=(1, 2))
        if continuous:
            closest, _ = closest_approach(between[:-1], np.diff(between, axis=0), 1.0)
            apart[1:] = length(closest).min(axis=(1, 2))
        return apart

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
        none, separation = np.zeros_like(asked), self.separation(config.continuous_collisions)
        return Flight(config, self.state, plans, self.goal, asked | announced, announced, none, separation)

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
        unknown = np.full((times, n, 4), np.nan)
        world = dataclasses.asdict(flight.config)
        return cls(time, flight.state, unknown, flight.plans[..., POSITION], asked, told, flight.goal, world, policy)


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

    :raises ValueError: if the file is no recording
    :raises ImportError: if the extra ``record`` is not installed, which ``.mcap`` needs
    """
    check_suffix(path)
    readers = {".npz": _read_npz, ".csv": _read_csv}
    if path.suffix == ".mcap":
        with needs_extra(f"{path.name}", "record"):
            from quad_swarm.evaluation import mcap_files
        readers[".mcap"] = mcap_files.read
    try:
        return readers[path.suffix](path)
    except (ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile, EOFError, RecursionError) as error:
        raise ValueError(f"{path} is no recording of a flight: {shown(str(error))}.") from None


def about(recording: Recording) -> str:
    """Return as JSON what is no array: world, policy, and goals."""
    return json.dumps({"world": recording.world, "policy": recording.policy, "goal": recording.goal.tolist()})


def _write_npz(path: Path, recording: Recording) -> None:
    arrays = {name: getattr(recording, name) for name in ("time", "goal", *_ARRAYS)}
    with path.open("wb") as file:
        np.savez_compressed(file, about=np.array(about(recording)), **arrays)


def _read_npz(path: Path) -> Recording:
    with np.load(path, allow_pickle=False) as content:
        rest = json.loads(str(content["about"]))
        arrays = {name: content[name] for name in ("time", "goal", *_ARRAYS)}
    return Recording(world=dict(rest["world"]), policy=str(rest["policy"]), **arrays)


def _write_csv(path: Path, recording: Recording) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", "robot", *_STATE, *_SET, *_GOAL, "asked", "told"])
        for k, time in enumerate(recording.time):
            for robot in range(recording.n_robots):
                numbers = (*recording.state[k, robot], *recording.setpoint[k, robot], *recording.goal[robot])
                texts = ("" if np.isnan(one) else repr(float(one)) for one in numbers)
                lists = (" ".join(map(str, np.flatnonzero(one[k, robot]))) for one in (recording.asked, recording.told))
                writer.writerow([repr(float(time)), robot, *texts, *lists])


def _read_csv(path: Path) -> Recording:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or not {"time", "robot", "x", "y", "z"} <= rows[0].keys():
        raise ValueError("it needs the columns time, robot, x, y and z")
    times = sorted({float(row["time"]) for row in rows})
    robots = sorted({int(row["robot"]) for row in rows})
    if robots != list(range(len(robots))) or len(rows) != len(times) * len(robots):
        raise ValueError("it needs one row for each time and each robot, whose numbers count from 0")
    rows.sort(key=lambda row: (float(row["time"]), int(row["robot"])))

    def column(name: str) -> np.ndarray | None:
        if name not in rows[0]:
            return None
        return np.array([float(row[name] or "nan") for row in rows]).reshape(len(times), len(robots))

    def columns(names: Sequence[str], otherwise: np.ndarray) -> np.ndarray:
        found = [column(name) for name in names]
        return otherwise if any(one is None for one in found) else np.stack(found, axis=-1)  # type: ignore[arg-type]

    def sets(name: str) -> np.ndarray:
        marks = np.zeros((len(rows), len(robots)), dtype=bool)
        for row, mark in zip(rows, marks, strict=True):
            mark[[int(one) for one in (row.get(name) or "").split()]] = True
        return marks.reshape(len(times), len(robots), len(robots))

    shape, time = (len(times), len(robots)), np.array(times)
    pos = columns(_STATE[:3], np.zeros((*shape, 3)))
    vel = columns(_STATE[3:6], np.gradient(pos, time, axis=0) if len(times) > 1 else np.zeros_like(pos))
    attitude = columns(_STATE[6:], np.zeros((*shape, 3)))
    goal = columns(_GOAL, np.broadcast_to(pos[-1], pos.shape))[-1]
    return Recording(
        time,
        np.concatenate([pos, vel, attitude], axis=-1),
        columns(_SET, np.full((*shape, 4), np.nan)),
        np.zeros((*shape, 0, 3)),
        sets("asked"),
        sets("told"),
        goal,
    )
