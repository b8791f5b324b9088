"""Recorded flights, real and simulated, judged as `evaluate` judges simulated ones: ``sb3-maddpg evaluate --flight``.

Between samples, robots are taken to have flown in straight lines. At 20 Hz, that is exact to some millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.evaluation.inference import wilson_interval
from quad_swarm.evaluation.policies import short_name
from quad_swarm.evaluation.recordings import MEASURED, Meetings, Recording
from quad_swarm.evaluation.rows import aligned
from quad_swarm.geometry import length
from quad_swarm.world.presets import SwarmConfig

Row = dict[str, Any]


def judge(name: str, recording: Recording) -> Row:
    """Return what happened in a recorded flight. Times count from its first sample (s).

    :param name: name of the file
    :param recording: the flight, with its world, see `read_flights`
    :return: ``collided``, as the world counts collisions, and at which sample; ``collisions``, the pairs of robots;
        ``collided_at_samples``, ``collided_continuous``: at samples, and at any time; the smallest distance at any time
        (m), of whom and when; ``arrived``: whether all robots were at their goals at the same time before any
        collision, and ``robot_seconds_to_arrival``, when each was at its goal first; mean ``path_length`` (m) and
        ``requests``, ``announcements`` and their share of what is possible, until arrival, collision or end; values of
        `MEASURED`, of the whole flight. What the file does not tell is None. With obstacles also
        ``obstacle_collisions``, the pairs of robot and obstacle, which count as collisions, too, and the smallest
        distance between the surfaces of two, ``closest_obstacle`` (m), of whom and when. Distances of robots whose
        radii are not the world's count as in `SwarmConfig`
    """
    flight, config, time = recording.flight(), recording.config(), recording.time - recording.time[0]
    contact, downwash = 2 * config.radius - config.collision_tolerance, config.planner.downwash
    found = [recording.meetings(continuous, downwash, config.excess) for continuous in (False, True)]
    beside = [recording.encounters(config.radii, continuous) for continuous in (False, True)]
    touch = -config.collision_tolerance
    at_samples, at_any_time = (
        bool((one.closest < contact).any() or (other.closest < touch).any())
        for one, other in zip(found, beside, strict=True)
    )
    meetings, counted = found[True], found[config.continuous_collisions]
    least = int(meetings.closest.argmin())
    touching = flight.colliding
    collision = int(touching.argmax()) if touching.any() else None
    knows_goals, knows_talk = (one not in recording.guessed for one in ("goal", "talk"))
    arrival = flight.arrival if knows_goals else None
    if arrival is not None and collision is not None and collision <= arrival:
        arrival = None
    ends = [end for end in (arrival, collision) if end is not None]
    end = min(ends, default=len(time) - 1)
    at_goal = length(flight.pos - flight.goal) <= config.goal_radius
    first = np.where(at_goal.any(axis=0), time[at_goal.argmax(axis=0)], np.nan)
    n = recording.n_robots
    requests, announced = (int(one[: max(end, 1)].sum()) for one in (recording.asked, recording.told))
    both = int((recording.asked | recording.told.swapaxes(1, 2))[: max(end, 1)].sum())
    possible = n * (n - 1) * max(time[end] / config.planner.dt, 1.0)
    return {
        "flight": name,
        "policy": recording.policy or None,
        "n_robots": n,
        "seconds": float(time[-1]),
        "collided": bool(touching.any()),
        "seconds_to_collision": None if collision is None else float(time[collision]),
        "collisions": counted.pairs[counted.closest < contact].tolist(),
        "collided_at_samples": at_samples,
        "collided_continuous": at_any_time,
        "closest": float(meetings.closest[least]),
        "closest_pair": meetings.pairs[least].tolist(),
        "closest_after": float(meetings.when[least] - recording.time[0]),
        "arrived": arrival is not None if knows_goals else None,
        "seconds_to_arrival": None if arrival is None else float(time[arrival]),
        "robot_seconds_to_arrival": [None if np.isnan(one) else float(one) for one in first] if knows_goals else None,
        "path_length": float(length(np.diff(flight.pos[: end + 1], axis=0)).sum(axis=0).mean()),
        "requests": requests if knows_talk else None,
        "announcements": announced if knows_talk else None,
        "plan_share": both / possible if knows_talk else None,
        **{name: recording.measured.get(name) for name in MEASURED},
        "contact": contact,
        "radius_known": "radius" not in recording.guessed,
        "goal_radius": config.goal_radius,
        **(_among_obstacles(recording, config, beside) if recording.obstacles else {}),
    }


def _among_obstacles(recording: Recording, config: SwarmConfig, beside: Sequence[Meetings]) -> Row:
    """Return what happened among obstacles.

    :param beside: encounters at samples, and at any time
    """
    encounters, counted = beside[True], beside[config.continuous_collisions]
    least = int(encounters.closest.argmin())
    return {
        "obstacle_collisions": counted.pairs[counted.closest < -config.collision_tolerance].tolist(),
        "closest_obstacle": float(encounters.closest[least]),
        "closest_obstacle_pair": encounters.pairs[least].tolist(),
        "closest_obstacle_after": float(encounters.when[least] - recording.time[0]),
    }


def totals(rows: Sequence[Row]) -> list[Row]:
    """Return the totals of flights, a row for each policy.

    :param rows: rows of `judge`
    :return: number of flights, and of those with a collision, with the 95 % interval of the rate; smallest distance (m)
        and the flight that had it; number of flights whose goals are known, and of those in which all arrived; the
        other values of `judge` as means or sums over the flights that have them
    """
    return [_total(policy, [row for row in rows if row["policy"] == policy]) for policy in _policies(rows)]


def _policies(rows: Sequence[Row]) -> list[str | None]:
    return list(dict.fromkeys(row["policy"] for row in rows))


def _total(policy: str | None, rows: Sequence[Row]) -> Row:
    def known(name: str) -> list[Any]:
        return [row[name] for row in rows if row[name] is not None]

    def mean(name: str, weight: str | None = None) -> float | None:
        told = [row for row in rows if row[name] is not None]
        weights = [row[weight] if weight else 1.0 for row in told]
        return float(np.average([row[name] for row in told], weights=weights)) if sum(weights) else None

    collided = sum(row["collided"] for row in rows)
    low, high = wilson_interval(collided, len(rows))
    closest = min(rows, key=lambda row: row["closest"])
    paths = [row["path_length"] for row in rows if row["arrived"] is not False]
    return {
        "flights": len(rows),
        "policy": policy,
        "collided": collided,
        "collision_low": low,
        "collision_high": high,
        "closest": closest["closest"],
        "closest_flight": closest["flight"],
        "goals_known": len(known("arrived")),
        "arrived": sum(known("arrived")) if known("arrived") else None,
        "seconds_to_arrival": mean("seconds_to_arrival"),
        "path_length": float(np.mean(paths)) if paths else None,
        **{name: sum(known(name)) if known(name) else None for name in ("requests", "announcements")},
        "plan_share": mean("plan_share", "seconds"),
        **{name: sum(known(name)) if known(name) else None for name in ("periods", "plans_sent")},
        "bytes_per_second": mean("bytes_per_second", "seconds"),
        **{name: mean(name, "periods") for name in ("missed", "late")},
        **_total_obstacles([row for row in rows if row.get("closest_obstacle") is not None]),
    }


def _total_obstacles(rows: Sequence[Row]) -> Row:
    """Return the number of flights with a collision with an obstacle, and the smallest distance (m), if any has
    obstacles."""
    if not rows:
        return {}
    collided = sum(bool(row["obstacle_collisions"]) for row in rows)
    return {
        "collided_obstacle": collided,
        "obstacles_known": len(rows),
        "closest_obstacle": min(row["closest_obstacle"] for row in rows),
    }


class Column(NamedTuple):
    """A column of the table, whose cells are of flights and of totals."""

    title: str
    text: Callable[[Row], str]
    total: Callable[[Row], str] | None = None
    """That of totals, if it differs"""


def _number(name: str, form: str) -> Callable[[Row], str]:
    return lambda row: "-" if row.get(name) is None else format(row[name], form)


def _met(row: Row) -> str:
    return _pairs(row["collisions"])


def _met_obstacles(row: Row) -> str:
    return "-" if row.get("closest_obstacle") is None else _pairs(row["obstacle_collisions"])


def _pairs(met: Sequence[Sequence[int]]) -> str:
    pairs = ["-".join(map(str, pair)) for pair in met]
    return " ".join(pairs[:2]) + (f" +{len(pairs) - 2}" if len(pairs) > 2 else "") if pairs else "no"


COLUMNS = [
    Column("flight", lambda row: row["flight"], lambda row: f"all {row['flights']}"),
    Column("policy", lambda row: "-" if row["policy"] is None else short_name(row["policy"])),
    Column("collided", _met, lambda row: f"{row['collided']}/{row['flights']}"),
    Column(
        "95 % interval",
        lambda row: "",
        lambda row: f"{100 * row['collision_low']:.1f} - {row['collision_high']:.1%}",
    ),
    Column("closest (m)", _number("closest", ".3f")),
    Column("of", lambda row: "-".join(map(str, row["closest_pair"])), lambda row: ""),
    Column("after (s)", _number("closest_after", ".2f"), lambda row: ""),
    Column(
        "obstacles",
        _met_obstacles,
        lambda row: "-" if "obstacles_known" not in row else f"{row['collided_obstacle']}/{row['obstacles_known']}",
    ),
    Column("closest (m)", _number("closest_obstacle", ".3f")),
    Column(
        "arrived",
        lambda row: {None: "-", True: "yes", False: "no"}[row["arrived"]],
        lambda row: "-" if row["arrived"] is None else f"{row['arrived']}/{row['goals_known']}",
    ),
    Column("in (s)", _number("seconds_to_arrival", ".2f")),
    Column("path (m)", _number("path_length", ".2f")),
    Column("requests", _number("requests", "d")),
    Column("plans", _number("plan_share", ".2%")),
    Column("sent", _number("plans_sent", ".0f")),
    Column("B/s", _number("bytes_per_second", ".0f")),
    Column("missed", _number("missed", ".2%")),
    Column("late", _number("late", ".2%")),
]


def format_flights(rows: Sequence[Row], sums: Sequence[Row]) -> str:
    """Format flights and their totals as a table. Columns that are empty in all rows are left out.

    :param rows: rows of `judge`
    :param sums: rows of `totals`
    """
    columns = [[column.title, *map(column.text, rows), *map(column.total or column.text, sums)] for column in COLUMNS]
    return aligned(list(zip(*(one for one in columns if set(one[1:]) != {"-"}), strict=True)), 2)


def legend(rows: Sequence[Row]) -> list[str]:
    """Return the lines below the table, which say what was counted, and what is unknown.

    :param rows: rows of `judge`
    """

    def lengths(name: str) -> str:
        return " or ".join(f"{one:g}" for one in sorted({round(row[name], 6) for row in rows}))

    def files(name: str) -> str:
        return ", ".join(row["flight"] for row in rows if row[name] is None)

    lines = [
        f"collided: pairs of robots closer than {lengths('contact')} m; closest: at any time, straight between samples",
    ]
    if unknown := ", ".join(row["flight"] for row in rows if not row["radius_known"]):
        lines.append(f"radii are unknown, so contact is that of the preset (give --world radius=METRES): {unknown}")
    if any(row.get("closest_obstacle") is not None for row in rows):
        lines.append(
            "obstacles: robots that touch obstacles, as robot-obstacle, which count as collisions; closest: surfaces"
        )
    if any(row["arrived"] is not None for row in rows):
        lines.append(f"arrived: all within {lengths('goal_radius')} m of their goals at once, before any collision")
    if unknown := files("arrived"):
        lines.append(f"goals are unknown, and arrivals with them (columns goal_x, goal_y, goal_z): {unknown}")
    if any(row["plan_share"] is not None for row in rows):
        lines.append("plans: asked for or announced, of all that could be, until arrival, collision or end")
    if unknown := files("plan_share"):
        lines.append(f"who asked whom is unknown (columns asked, told): {unknown}")
    if any(row["periods"] is not None for row in rows):
        lines.append("sent: plans; B/s: sent by a robot in a second; missed, late: periods skipped, commands too late")
    return lines


def flat(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of flights and totals for a file, in which all have the same names."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]
