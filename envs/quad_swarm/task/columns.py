"""The columns of observations: name, unit, frame and meaning of each. Sizes of observations follow from these lists."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

# Approximate maximum speed (m/s) and typical distance (m), which scale the paper's observation to unit size
VELOCITY_SCALE = 4.0
POSITION_SCALE = 4.0
# Typical speed (m/s), which scales velocities in pair features to unit size
SPEED = 1.5
# Lengths (m) at which a gap becomes a feature
GAPS = (0.05, 0.2, 1.0)
# Stages of a trajectory that become features, as fractions of the horizon N
STAGES = (0.2, 0.5, 1.0)
# Errors of plans (m) become features on this scale, and their components on half a metre
ERROR_SCALE, ERROR_RANGE = 0.1, 0.5


class Column(NamedTuple):
    """A column of an observation.

    :param name: name, unique within its group
    :param unit: what a value of 1 stands for; empty for pure numbers
    :param frame: "world"; "goal": x points horizontally from the robot to its goal; "pair": x points horizontally from
        the robot to the other, mirrored so that the other moves to the left, z up; empty for scalars
    :param meaning: what it measures
    """

    name: str
    unit: str
    frame: str
    meaning: str


def _vector(name: str, unit: str, frame: str, meaning: str) -> list[Column]:
    return [Column(f"{name}_{axis}", unit, frame, f"{meaning}, {axis}") for axis in "xyz"]


def _gap(name: str, meaning: str, scales: Iterable[float] = GAPS) -> list[Column]:
    text = "tanh of the gap between the hulls over {} m, {}"
    return [Column(f"{name}_gap_{scale:g}", "", "", text.format(f"{scale:g}", meaning)) for scale in scales]


def _known(whose: str) -> list[Column]:
    return [
        Column("remembers", "", "", f"whether {whose} is believed, 1 or 0"),
        Column("age", "N steps", "", f"age of {whose}, at most 1"),
        Column("freshness", "", "", f"exp(2 - age in steps) of {whose}"),
    ]


def _at(stages: Iterable[float]) -> list[str]:
    return [f"{stage:g}N" for stage in stages]


_THEIRS, _MINE = "the newest plan received from the other", "the newest plan of the robot sent to the other"

# Of a pair observation, about the robot itself
OWN: list[Column] = [
    Column("vel_along", f"{SPEED} m/s", "goal", "own velocity towards the goal"),
    Column("vel_across", f"{SPEED} m/s", "goal", "own velocity to the left of that"),
    Column("vel_up", "m/s", "world", "own vertical velocity"),
    Column("goal_far", f"{POSITION_SCALE:g} m", "", "horizontal distance to the goal"),
    Column("goal_near", "m", "", "the same, at most 1 m"),
    Column("goal_up", "m", "world", "height of the goal above the robot"),
]

# Name of a group -> its columns about one of the others
COLUMNS: dict[str, list[Column]] = {
    "state": [
        Column("distance", f"{POSITION_SCALE:g} m", "", "distance to the other"),
        Column("pos_up", "m", "world", "height of the other above the robot"),
        *_gap("now", "now", GAPS[1:]),
        *_vector("vel", f"{SPEED} m/s", "pair", "velocity of the other relative to the robot"),
        *_vector("own_vel", f"{SPEED} m/s", "pair", "own velocity"),
        *_vector("goal", "distance to the goal, at least 1 m", "pair", "direction of the own goal"),
    ],
    "approach": [
        *_gap("least", "at the closest approach at constant velocities within 4 s"),
        Column("time", "4 s", "", "time until then"),
        Column("soon_0.3", "", "", "exp(-time / 0.3 s)"),
        Column("soon_1", "", "", "exp(-time / 1 s)"),
    ],
    "side": [
        Column("mirrored", "", "", "-1 if the pair's frame is mirrored, otherwise 1"),
        Column("miss_0.2", "", "", "tanh of the distance over 0.2 m at which the other passes on the left"),
        Column("miss_1", "", "", "tanh of that distance over 1 m"),
    ],
    "memory": [
        *_known(_THEIRS),
        Column("drift", "memory", "", "error of that plan now, at most 2; 0 without one"),
        *(
            column
            for stage in _at(STAGES[1:])
            for column in _vector(
                f"bend_{stage}", "m", "pair", f"predicted minus steady motion of the other at {stage}"
            )
        ),
    ],
    "plan": [
        *_gap("least", "least of the own plan and the predicted other"),
        Column("stage", "N steps", "", "stage at which it is reached"),
        *_gap("last", "of the two at the last stage", GAPS[1:]),
        *(
            column
            for stage in _at(STAGES[1:])
            for column in _vector(f"own_bend_{stage}", "m", "pair", f"own plan minus own steady motion at {stage}")
        ),
    ],
    "told": [
        *_known(_MINE),
        *(
            Column(
                f"off_{stage}", "", "", f"tanh over {ERROR_SCALE} m of the error of the other's prediction at {stage}"
            )
            for stage in _at(STAGES)
        ),
        *(
            column
            for stage in _at(STAGES[1:])
            for column in _vector(
                f"off_{stage}", f"{ERROR_RANGE} m", "pair", f"own plan minus the other's prediction of it at {stage}"
            )
        ),
    ],
    "obstacles": [
        column
        for whose, what in (("own", "the own plan"), ("their", "the predicted motion of the other"))
        for column in (
            *_gap(f"{whose}_least", f"least of {what} and the nearest obstacle; 1 without obstacles"),
            Column(f"{whose}_stage", "N steps", "", "stage at which it is reached; 0 without obstacles"),
            *_vector(f"{whose}_way", "", "pair", "direction of that obstacle then; 0 without obstacles"),
        )
    ],
    "radius": [
        Column("own_radius", "m", "", "radius of the robot"),
        Column("other_radius", "m", "", "radius of the other"),
    ],
    "mask": [Column("mask", "", "", "whether the two may come close, 1 or 0: otherwise there is nothing to ask for")],
    "critic": [
        *(
            column
            for stage in _at(STAGES)
            for column in _vector(
                f"surprise_{stage}", f"{ERROR_RANGE} m", "pair", f"the other's plan minus its prediction at {stage}"
            )
        ),
        *(
            Column(f"{whose}surprise_{stage}", "", "", f"tanh over {ERROR_SCALE} m of the error of {what} at {stage}")
            for whose, what in (("", "the prediction"), ("their_", "the other's prediction"))
            for stage in _at(STAGES)
        ),
        *_gap("true", "least of the two plans"),
        *_gap("seen", "least of the own plan and the predicted other"),
        Column("they_remember", "", "", "whether the other believes a plan of the robot, 1 or 0"),
    ],
}


def of_paper(n_others: int, scaled: bool = False) -> list[Column]:
    """Return the columns of the paper's observation.

    :param n_others: number of others that a robot perceives
    :param scaled: whether distances and velocities are scaled
    """
    speed, distance = (f"{VELOCITY_SCALE:g} m/s", f"{POSITION_SCALE:g} m") if scaled else ("m/s", "m")
    numbers = range(1, n_others + 1)
    return [
        *_vector("own.vel", speed, "world", "own velocity"),
        *_vector("own.goal", distance, "world", "goal relative to the robot"),
        *(c for k in numbers for c in _vector(f"other{k}.pos", distance, "world", "position relative to the robot")),
        *(c for k in numbers for c in _vector(f"other{k}.vel", speed, "world", "velocity relative to the robot")),
    ]


def unnamed(size: int) -> list[Column]:
    """Return the columns of a group that users registered."""
    return [Column(str(k), "", "", "of a registered group") for k in range(size)]


def of_pairs(groups: Mapping[str, Sequence[Column]], n_others: int) -> list[Column]:
    """Return the columns of a pair observation.

    :param groups: names of groups and their columns about one of the others, in their order
    :param n_others: number of others that a robot perceives
    """
    about = [column._replace(name=f"{group}.{column.name}") for group, columns in groups.items() for column in columns]
    return [
        *(column._replace(name=f"own.{column.name}") for column in OWN),
        *(column._replace(name=f"other{k}.{column.name}") for k in range(1, n_others + 1) for column in about),
    ]


def of_numbers(n_others: int) -> list[Column]:
    """Return the last columns of robots that perceive only some of the others."""
    meaning = "number of the other, counted from 1, or 0 for an empty slot"
    return [Column(f"other{k}.number", "", "", meaning) for k in range(1, n_others + 1)]


def as_table() -> str:
    """Return a Markdown table of the columns of all groups, which `docs/observation_columns.md` shows."""
    lines = ["| column | unit | frame | meaning |", "|---|---|---|---|"]
    for group, columns in {"own": OWN, **COLUMNS}.items():
        lines += [f"| `{group}.{name}` | {unit} | {frame} | {meaning} |" for name, unit, frame, meaning in columns]
    return "\n".join(lines)


if __name__ == "__main__":
    print(as_table())
