"""``sb3-maddpg replay``: a web page that replays an episode.

The page is a single HTML file with a three-dimensional view, a time slider, and the requests, the smallest separation
and the number of requests of each policy. All policies fly the same held-out episode.

``replay.html`` is built from the sources in ``page/`` (``make page``). This module inserts the data.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.evaluation.command import add_flight_argument, add_policy_arguments, make_conditions, run
from quad_swarm.evaluation.flight import Condition, Flight, fly
from quad_swarm.evaluation.policies import is_model, short_name
from quad_swarm.evaluation.provenance import plant_name
from quad_swarm.evaluation.recordings import Recording, read_flights
from quad_swarm.evaluation.rows import STDOUT, check_writable, write_text
from quad_swarm.figures.colours import COLOURS
from quad_swarm.geometry import closest_approach, flattened, length
from quad_swarm.parsing import Parser
from quad_swarm.quadrotor import ATTITUDE, POSITION
from quad_swarm.task.rules import parse_rule
from quad_swarm.validation import read_assignments
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.obstacles import between, surroundings
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.scenarios import SCENARIOS

# Number of steps to show after all robots have arrived
_EXTRA_STEPS = 10
# Decimals of metres and radians, which are finer than a pixel; plans need fewer
_DIGITS, _PLAN_DIGITS = 3, 2
# Every such stage of a plan is drawn
_PLAN_STRIDE = 2

# Shown by `sb3-maddpg --help`
EXAMPLES = "  sb3-maddpg replay --policy full pretrained:quad-swarm-paper --scenario symmetric_swap --out replay.html"


def replay_page(
    conditions: Sequence[Condition], seed: int = 0, episode: int = 0, preset: str = "", world: Sequence[str] = ()
) -> str:
    """Fly an episode with several policies and create its web page.

    :param conditions: policies in the same scenario and world, which may differ in the predictor
    :param seed: index of the set of held-out episodes
    :param episode: index of the episode in the set
    :param preset: name of the world on the page
    :param world: what differs from this preset, as texts to show
    :return: the page as HTML
    """
    config = conditions[0].config
    about = {"scenario": conditions[0].scenario, "preset": preset, "world": list(world), "seed": seed}
    flights = ((one.policy, fly(one, seed, episode)) for one in conditions)
    return _page({**about, "episode": episode}, config, config.planner.dt, flights)


def recorded_page(recordings: Sequence[tuple[Path, Recording]]) -> str:
    """Create the web page of recorded flights of the same robots.

    :param recordings: files, and what they hold, see `read_flights`
    :return: the page as HTML
    :raises ValueError: if they have different numbers of robots, or a recording does not fit its world
    """
    counts = {one.n_robots for _, one in recordings}
    if len(counts) > 1:
        raise ValueError(
            f"The recordings have {', '.join(map(str, sorted(counts)))} robots: show one number at a time."
        )
    flights = [(one.policy or path.name, one.flight()) for path, one in recordings]
    step = float(np.median(np.diff(recordings[0][1].time)))
    source = ", ".join(path.name for path, _ in recordings)
    about = {"scenario": "recorded flight", "preset": "", "world": [], "seed": 0, "episode": 0, "source": source}
    return _page(about, flights[0][1].config, step, flights)


def live_page(policy: str, flight: Flight, number: int) -> str:
    """Create the web page of a flight that is under way, which asks its server for the rest.

    :param policy: what flies
    :param flight: the flight so far
    :param number: number of the flight, from 1
    :return: the page as HTML
    """
    about = {"scenario": "flight", "preset": "", "world": [], "seed": 0, "episode": 0}
    about |= {"source": f"flight {number}", "live": number}
    return _page(about, flight.config, flight.config.planner.dt, [(policy, flight)])


def live_step(flight: Flight) -> dict[str, Any]:
    """Return what the page of a flight under way is told of its last step.

    :param flight: the flight between the last two times
    """
    step = _describe("", flight)
    return {
        **{name: step[name][-1] for name in ("positions", "attitudes", "plans", "requests", "separation")},
        "colliding": [pair[1:] for pair in step["colliding"]],
        "arrived": flight.arrival is not None,
        **({"obstacles": _live_obstacles(step)} if flight.obstacles else {}),
    }


def _live_obstacles(step: dict[str, Any]) -> dict[str, Any]:
    return {
        "positions": [one["positions"][-1] for one in step["obstacles"]],
        "hitting": [pair[1:] for pair in step["hitting"]],
        "distance": step["obstacle_distance"][-1],
    }


def _page(about: dict[str, Any], config: SwarmConfig, dt: float, flights: Iterable[tuple[str, Flight]]) -> str:
    flown = list(flights)
    described = [_describe(policy, flight) for policy, flight in flown]
    if len({flight.config.predictor for _, flight in flown}) > 1:
        for one, (_, flight) in zip(described, flown, strict=True):
            one["detail"] = "others at constant velocity" if flight.config.predictor is None else "others predicted"
    data = {
        **about,
        "dt": dt,
        "plan_stride": _PLAN_STRIDE,
        "radius": config.radius,
        **({} if config.excess is None else {"radii": config.radii.tolist()}),
        "goal_radius": config.goal_radius,
        "collision_distance": 2 * config.radius,
        **({"downwash": config.planner.downwash} if config.planner.downwash != 1 else {}),
        "colours": COLOURS,
        "flights": described,
    }
    # "</script>" in the name of a policy would end the data
    text = json.dumps(data, separators=(",", ":")).replace("<", "\u003c")
    return files("quad_swarm.figures").joinpath("replay.html").read_text(encoding="utf-8").replace("__DATA__", text)


def _describe(policy: str, flight: Flight) -> dict[str, Any]:
    """Return the page's data of a flight until shortly after the arrival of all robots: T steps of n robots.

    positions, attitudes (roll, pitch, yaw): (T + 1, n, 3) (m, rad); plans made in each step, from the robots' positions
    at that time: (T, n, K, 3) (m); goals: (n, 3) (m); requests: for each step the pairs (robot, the other) of robots
    that get a plan, or (robot, the other, 1) if the plan was announced; separation, as the world counts it: (T + 1,)
    (m); arrival, collision: first steps after which all robots had arrived, and two collided, or None; colliding:
    (step, robot, robot) for each pair that collides in a step. With obstacles also these: shape, radius (m) and
    positions, (T + 1, 3) or, if it stands, (1, 3) (m), of each; hitting: (step, robot, obstacle) for each pair that
    collides; obstacle_distance: as the world counts it, (T + 1,) (m).
    """
    end = len(flight.requests) if flight.arrival is None else min(flight.arrival + _EXTRA_STEPS, len(flight.requests))
    others = other_indices(flight.n_robots)
    name, detail = _plain_name(policy)
    return {
        "policy": short_name(policy),
        "predicts": flight.config.predictor is not None,
        "name": name,
        "detail": detail,
        "positions": flight.pos[: end + 1].round(_DIGITS).tolist(),
        "attitudes": flight.state[: end + 1, :, ATTITUDE].round(_DIGITS).tolist(),
        "plans": flight.plans[1 : end + 1, :, ::_PLAN_STRIDE, POSITION].round(_PLAN_DIGITS).tolist(),
        "goals": flight.goal.round(_DIGITS).tolist(),
        "requests": [_pairs(*step, others) for step in zip(flight.requests[:end], flight.announced[:end], strict=True)],
        "separation": flight.min_separation[: end + 1].round(_DIGITS).tolist(),
        "arrival": flight.arrival,
        "collision": flight.collision if flight.collision is not None and flight.collision <= end else None,
        "colliding": [pair for pair in _colliding(flight) if pair[0] <= end],
        **(_describe_obstacles(flight, end) if flight.obstacles else {}),
    }


def _describe_obstacles(flight: Flight, end: int) -> dict[str, Any]:
    assert flight.obstacle_pos is not None
    assert flight.min_obstacle_distance is not None
    places = flight.obstacle_pos[: end + 1].round(_DIGITS)
    return {
        "obstacles": [
            {
                "shape": one.shape,
                "radius": round(one.radius, _DIGITS),
                "positions": places[: None if one.moves else 1, k].tolist(),
            }
            for k, one in enumerate(flight.obstacles)
        ],
        "hitting": [pair for pair in _hitting(flight) if pair[0] <= end],
        "obstacle_distance": flight.min_obstacle_distance[: end + 1].round(_DIGITS).tolist(),
    }


def _pairs(requests: np.ndarray, announced: np.ndarray, others: np.ndarray) -> list[list[int]]:
    """Return the requests of a step in the page's format."""
    pairs = [[int(a), int(others[a, k]), int(announced[a, k])] for a, k in np.argwhere(requests)]
    return [pair if pair[2] else pair[:2] for pair in pairs]


def _plain_name(policy: str) -> tuple[str, str]:
    """Return the name of a policy on the page, and its subtitle."""
    if policy == "none":
        return "No communication", "nobody asks"
    if policy == "full":
        return "Full communication", "everybody asks everybody"
    if is_model(policy):
        return "Learned policy", short_name(policy)
    try:
        parse_rule(policy)
    except ValueError:  # a recording, or a policy of another process
        return policy, ""
    return "Rule", policy


def _colliding(flight: Flight) -> list[list[int]]:
    """Return the pairs of robots that collide in each step, counting from 1: (step, robot, robot).

    `Flight.min_separation` decides whether any do. With continuous collisions it takes sub-steps into account, which a
    flight does not record. The closest pair on the straight line between steps then has this distance, and others
    those on that line.
    """
    relative, config = flattened(flight.relative_pos, flight.config.planner.downwash), flight.config
    others, reach = other_indices(flight.n_robots), np.zeros(flight.n_robots - 1)
    if config.excess is not None:
        reach = np.take_along_axis(config.excess, others, axis=1)
    limit = 2 * config.radius - config.collision_tolerance
    touching = _touching(flight, relative, limit, flight.min_separation, reach)
    pairs = ([int(step) + 1, int(a), int(others[a, k])] for step, a, k in touching)
    return [pair for pair in pairs if pair[1] < pair[2]]


def _hitting(flight: Flight) -> list[list[int]]:
    """Return which robots collide with obstacles in each step, as `_colliding` does: (step, robot, obstacle)."""
    assert flight.obstacle_pos is not None
    assert flight.min_obstacle_distance is not None
    among, tolerance = surroundings(flight.obstacles), flight.config.collision_tolerance
    relative = between(flight.pos, flight.obstacle_pos, among.factors)
    reach = among.radius + flight.config.radii[:, None]
    touching = _touching(flight, relative, -tolerance, flight.min_obstacle_distance, reach)
    return [[int(step) + 1, int(robot), int(obstacle)] for step, robot, obstacle in touching]


def _touching(
    flight: Flight, relative: np.ndarray, limit: float, least: np.ndarray, reach: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the steps and pairs, counting from 0, that are closer than a limit, (pairs, 3).

    :param relative: what is between pairs, (T + 1, n, m, 3) (m)
    :param limit: distance (m)
    :param least: smallest distances as the world counts them, (T + 1,) (m)
    :param reach: what is subtracted from the lengths, (m,) (m)
    """
    before, after = relative[:-1], relative[1:]
    if flight.config.continuous_collisions:
        after, _ = closest_approach(before, after - before, 1.0)
    apart = length(after) - reach
    closest, counted = apart == apart.min(axis=(1, 2), keepdims=True), least[1:, None, None]
    apart = np.where(counted < limit, np.where(closest, counted, apart), np.inf)
    return np.argwhere(apart < limit)


def make_parser() -> Parser:
    """Return the parser of the command."""
    parser = Parser(
        "sb3-maddpg replay",
        description="Fly a held-out episode with several policies and write a web page that replays it.",
        epilog=f"example:\n{EXAMPLES}",
    )
    add_policy_arguments(parser, required=False)
    add_flight_argument(parser)
    parser.add_argument("--scenario", default="symmetric_swap", help=f"one of {', '.join(SCENARIOS)} (%(default)s)")
    parser.add_argument("--episode", type=int, default=0, help="index of the episode in the set (default 0)")
    parser.add_argument(
        "--out", type=Path, default=Path("replay.html"), help="file of the page, or - (default %(default)s)"
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return run(_write, make_parser().parse_args(argv))


def _write(args: argparse.Namespace) -> None:
    if args.episode < 0:
        raise ValueError(f"--episode {args.episode}: episodes count from 0.")
    if args.out.suffix.lower() not in ("", ".html", ".htm") and not args.out.is_char_device():
        raise ValueError(f"--out {args.out}: what is written is a web page; use the ending .html.")
    check_writable(args.out, "--out")
    if bool(args.flight) == bool(args.policy):
        raise ValueError("pass either policies to fly (--policy) or recorded flights (--flight).")
    if args.flight:
        flights = read_flights(args.flight, args.preset, read_assignments("--world", args.world))
        _finish(args.out, recorded_page(flights))
        return
    conditions = make_conditions(args, [args.scenario])
    changes = [*args.world, *([f"plant={plant_name(conditions[0].config)}"] if args.plant else [])]
    _finish(args.out, replay_page(conditions, args.seed, args.episode, args.preset, changes))


def _finish(out: Path, page: str) -> None:
    write_text(out, page)
    if out != STDOUT:
        print(f"wrote {out}, {len(page) / 1e6:.1f} MB: open it in a browser")


if __name__ == "__main__":
    sys.exit(main())
