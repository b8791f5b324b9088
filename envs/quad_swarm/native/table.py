"""The functions of pairs.cpp: their signatures, which pairs.py and steps.py explain, and how they are loaded."""

from __future__ import annotations

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from quad_swarm.native.build import BuildError, build, load
from quad_swarm.native.signature import Signature

SOURCE = "pairs.cpp"

# Record of what is counted of an episode, see `quad_swarm.task.episode_statistics`; pairs.cpp has the same
STATISTICS = np.dtype(
    [
        *((name, np.int64) for name in ("steps", "steps_counted", "requests", "possible_requests", "peak_requests")),
        *((name, np.int64) for name in ("plans_used", "plan_ages", "requests_flown", "planner_failures")),
        *((name, np.float64) for name in ("path_length", "min_separation", "min_separation_continuous")),
        ("solve_seconds", np.float64),
        *((name, np.bool_) for name in ("at_goals", "reached", "arrived")),
        *((name, np.bool_) for name in ("collided", "collided_at_steps", "collided_continuous")),
    ],
    align=True,
)

# E: swarms, n or R: robots, m or M: the others of a robot, P: pairs, N: stages of a plan, K: some of them, A: answers,
# S: sub-steps or weights, O: obstacles, K: also bodies in sight, T: those of them to predict
_REMEMBER = Signature(
    "quad_swarm_remember",
    "P N",
    memory="real",
    pos="*P 3 f8",
    remembered="*P N+1 3 f8",
    age="*P i8",
    next="*P N+1 3 f8 out",
    next_age="*P i8 out",
    error="*P f8 out",
    remembers="*P bool out",
)
_BELIEVE = Signature(
    "quad_swarm_believe",
    "P N K",
    dt="real",
    chosen="K i8",
    pos="*P 3 f8",
    vel="*P 3 f8",
    remembered="*P N+1 3 f8",
    remembers="*P bool",
    believed="*P K 3 f8 out",
)
_RECEIVE = Signature(
    "quad_swarm_receive",
    "P N",
    age="int",
    dt="real",
    misfit="real",
    arriving="*P bool",
    received="A N+1 3 f8 optional",
    ages="A i8 optional",
    pos="*P 3 f8",
    vel="*P 3 f8",
    remembers="*P bool",
    known_age="*P i8",
    known="*P N+1 3 f8",
    remembered="*P N+1 3 f8 changed optional",
    next_age="*P i8 out",
    believed="*P N 3 f8 out optional",
    source="*P i8 out optional",
)
_APPROACH = Signature(
    "quad_swarm_approach",
    "R M N",
    dt="real",
    own="*R 3 f8",
    plan="*R N 3 f8",
    pos="*R M 3 f8",
    vel="*R M 3 f8",
    remembered="*R M N+1 3 f8",
    remembers="*R M bool",
    least="*R M f8 out",
    nearest="*R M i8 out",
    last="*R M f8 out",
)
_NEAREST_OBSTACLE = Signature(
    "quad_swarm_nearest_obstacle",
    "E P N O",
    trajectories="E P N 3 f8",
    radii="E P f8",
    centres="E O N 3 f8",
    factors="E O 3 f8",
    radius="E O f8",
    present="E O bool",
    gap="E P f8 out",
    stage="E P i8 out",
    towards="E P 3 f8 out",
)
_RESAMPLE = Signature(
    "quad_swarm_resample",
    "R M N",
    later="*R f8",
    trajectories="*R M N 3 f8 changed",
)
_KEEP_RIGHT = Signature(
    "quad_swarm_keep_right",
    "R M N",
    width="real",
    dt="real",
    fade="real",
    slow="real",
    x="R 9 f8",
    known="R M bool",
    others="R M N 3 f8 changed",
    clearance="R M N f8 changed",
)
_NEIGHBOURS = Signature(
    "quad_swarm_neighbours",
    "E n m",
    limit="real",
    look_ahead="real",
    pos="E n 3 f8",
    vel="E n 3 f8",
    errors="E n m 6 f8 optional",
    others="E n m i8 changed",
    present="E n m bool changed",
    reverse="E n m i8 out",
)


def _measure(pairs: str) -> Signature:
    """Return the signature of the function whose results for pairs have these axes."""
    return Signature(
        "quad_swarm_measure",
        "S E n m",
        contact="real",
        goal_radius="real",
        positions="S+1 E n 3 f8",
        goals="E n 3 f8",
        others="E n m i8 optional",
        min_separation="E f8 out",
        min_separation_continuous="E f8 out",
        separation=f"{pairs} f8 out",
        separation_continuous=f"{pairs} f8 out",
        colliding=f"{pairs} bool out",
        colliding_continuous=f"{pairs} bool out",
        moved="E n f8 out",
        at_goal="E n bool out",
    )


_ANTICIPATE = Signature(
    "quad_swarm_anticipate",
    "E n K T O N",
    hidden="int",
    width="int",
    dt="real",
    weights="S f4",
    pos="E n K 3 f8",
    vel="E n K 3 f8",
    place="n T i8",
    changes="E n T 2 3 f8",
    skipped="E n T bool",
    centres="E O 3 f8",
    velocities="E O 3 f8",
    factors="E O 3 f8",
    radius="E O f8",
    expected="E n T N+1 3 f8 out",
)
_COUNT = Signature(
    "quad_swarm_count",
    "E n m",
    records={"statistics": STATISTICS},
    failed="int",
    seconds="real",
    n_requests="E i8",
    collided="E bool",
    collision="E bool",
    collision_continuous="E bool",
    at_goal="E n bool",
    belief_source="E n m i8",
    plan_age="E n m i8",
    plan_status="E n i8",
    others="E n m i8 optional",
    moved="E f8",
    min_separation="E f8",
    min_separation_continuous="E f8",
    statistics="E statistics changed",
)

# Name -> function
TABLE: dict[str, Signature] = {
    "remember": _REMEMBER,
    "believe": _BELIEVE,
    "receive": _RECEIVE,
    "approach": _APPROACH,
    "nearest_obstacle": _NEAREST_OBSTACLE,
    "resample": _RESAMPLE,
    "keep_right": _KEEP_RIGHT,
    "neighbours": _NEIGHBOURS,
    "anticipate": _ANTICIPATE,
    "measure": _measure("E n m"),
    "measure_all": _measure("n m E"),  # without `others`
    "count": _COUNT,
}


@functools.cache
def compiled() -> Any | None:
    """Return the compiled functions by their names in `TABLE`, None if they cannot be compiled, of which the planner
    warns."""
    try:
        text = Path(__file__).with_name(SOURCE).read_text(encoding="utf-8")
        library = load(str(build("pairs", SOURCE, {SOURCE: text})), *(one.name for one in TABLE.values()))
    except BuildError:
        return None
    return SimpleNamespace(**{name: signature.of(library) for name, signature in TABLE.items()})
