"""Fly random worlds within and at the limits of their fields.

``python -m studies.random_worlds [--count 1000] [--steps 20] [--seed 0] [--jobs 1] [--json F]``. Each world has 2 to 64
robots, and each of its fields may have any valid value; some flights begin in motion, and some robots turn. A world is
either refused with one line when it is created, or flies:
resets never fail, steps neither raise nor return anything that is not finite, the reported separations and collisions
are those of the states, and a swarm flies in a batch as it does alone, to the last bit. Actions are random. JSON: one
row with the numbers of flown and refused worlds, and one for each failure.
"""

from __future__ import annotations

import argparse
import functools
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from quad_swarm import PRESETS, SCENARIOS, QuadSwarmEnv, QuadSwarmVectorEnv
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.jobs import Pool
from quad_swarm.quadrotor import POSITION
from quad_swarm.vehicles import VEHICLES
from quad_swarm.world.scenarios import DoesNotFit

_TOLERANCE = 1e-9
Rng = np.random.Generator


def _between(rng: Rng, low: float, high: float) -> float:
    """Draw a number, often one of the limits, and positive numbers evenly in their logarithm."""
    if rng.random() < 0.2:
        return float(rng.choice([low, high]))
    if low > 0 and high / low > 100:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return float(rng.uniform(low, high))


def _some(rng: Rng, fields: Mapping[str, Any], share: float) -> dict[str, Any]:
    """Draw some of the fields; values are functions of the generator."""
    return {name: draw(rng) for name, draw in fields.items() if rng.random() < share}


def _real(low: float, high: float) -> Any:
    return lambda rng: _between(rng, low, high)


def _whole(low: int, high: int) -> Any:
    return lambda rng: int(rng.choice([low, high])) if rng.random() < 0.2 else int(rng.integers(low, high + 1))


def _range(low: float, high: float) -> Any:
    return lambda rng: sorted(_between(rng, low, high) for _ in range(2))


def _count(high: int) -> Any:
    return lambda rng: sorted(int(rng.integers(high + 1)) for _ in range(2))


def _corner(low: float, high: float) -> Any:
    return lambda rng: [_between(rng, low, high) for _ in range(3)]


_FLAG = lambda rng: bool(rng.integers(2))  # noqa: E731
_FIELDS: dict[str, dict[str, Any]] = {
    "planner": {
        "horizon": _whole(2, 40), "dt": _real(1e-3, 0.5), "separation": _real(0.05, 5), "max_tilt": _real(1e-6, 1.57),
        "max_climb_rate": _real(1e-6, 1e4), "max_yaw_rate": _real(0, 100), "max_speed": _real(1e-3, 1e3),
        "max_vertical_speed": _real(1e-3, 1e3), "workspace_low": _corner(-50, -1), "workspace_high": _corner(1, 50),
        "goal_weight": _real(0, 1e4), "input_weight": _real(1e-4, 1e4), "repulsion_weight": _real(0, 1e3),
        "right_of_way": _real(0, 2), "violation_weight": _real(1e-2, 1e6), "max_neighbours": _whole(1, 8),
        "max_obstacles": _whole(1, 12), "downwash": _real(1, 20), "max_descent_rate": _real(1e-6, 1e4),
        "max_descent_speed": _real(1e-3, 1e3), "cruise_distance": _real(1e-2, 1e3), "commitment": _real(0, 1e4),
        "commitment_fade": _real(0, 100), "disturbance_time": _real(1e-3, 1e4), "obstacle_penalty": _real(1, 1e3),
        "braking_reserve": _real(0, 10), "prediction_penalty": _real(1e-3, 1),
    },
    "space": {
        "half_width": _real(0.1, 1e4), "heights": _range(-1e4, 1e4), "spacing": _real(0, 5),
        "circle_radius": _range(0, 50), "circle_jitter": _real(0, 5), "sector_radius": _range(0, 50),
        "whole_sectors": _FLAG, "pillars": _count(10), "pillar_radius": _range(1e-3, 1), "doorway": _range(0.1, 10),
        "traffic": _count(6), "traffic_radius": _range(1e-3, 1), "traffic_speed": _range(1e-3, 10),
    },
    "obstacles": {
        "number": _count(8), "shape": lambda rng: str(rng.choice(["sphere", "cylinder"])), "radius": _range(1e-3, 2),
        "speed": _range(0, 10), "spacing": _real(0, 2), "margin": _real(0, 1),
        "listed": lambda rng: [
            {"position": _corner(-4, 4)(rng), "radius": _between(rng, 1e-3, 1), "velocity": _corner(-1, 1)(rng)}
            for _ in range(rng.integers(4))
        ],
    },
    "noise": {
        "pos": _real(0, 1), "vel": _real(0, 10), "attitude": _real(0, 3.14), "wind": _real(0, 1e3),
        "gust": _real(0, 1e3), "gust_time": _real(0, 10),
    },
    "sensing": {
        "pos": _real(0, 1e3), "vel": _real(0, 1e3), "attitude": _real(0, 3.14), "others_pos": _real(0, 1e3),
        "others_vel": _real(0, 1e3), "correlation_time": _real(0, 10), "others_delay": _whole(0, 30),
        "gaps": _real(0, 0.99), "gap_length": _real(1, 100),
    },
    "radio": {
        "loss": _real(0, 1), "delay": _whole(0, 30), "jitter": _whole(0, 10), "bursts": _real(0, 0.99),
        "burst_length": _real(1, 100), "outage": _real(0, 1), "range": _real(0.1, 100),
        "half_distance": _real(0.1, 100), "path_loss_exponent": _real(1, 10), "round_trip": _whole(0, 10),
    },
    "neighbourhood": {"max_others": _whole(1, 16), "range": _real(0.1, 100), "look_ahead": _real(0, 5)},
    "quadrotor": {
        "gravity": _real(1e-2, 1e2), "drag_x": _real(0, 5), "drag_y": _real(0, 5), "roll_gain": _real(0.1, 3),
        "pitch_gain": _real(0.1, 3), "climb_gain": _real(0.1, 3), "roll_time_constant": _real(0.02, 10),
        "pitch_time_constant": _real(0.02, 10), "climb_time_constant": _real(0.02, 10),
    },
}  # fmt: skip
_COMPILED = ("planner", "quadrotor", "neighbourhood", "obstacles", "space")  # what kernels depend on
_PLAIN: dict[str, Any] = {
    "collision_tolerance": _real(0, 0.1), "goal_radius": _real(1e-3, 10),
    "memory": _real(0, 1e4), "substeps": _whole(1, 10), "continuous_collisions": _FLAG, "mismatch": _real(0, 0.5),
    "clock_skew": _real(0, 0.99),
}  # fmt: skip
_VEHICLE: dict[str, Any] = {
    "quadrotor": lambda rng: str(rng.choice(list(VEHICLES))) if rng.random() < 0.5 else _some(
        rng, _FIELDS["quadrotor"], 0.3
    ),
    "radius": _real(1e-2, 1), "max_tilt": _real(0.05, 1), "max_climb_rate": _real(0.1, 10), "max_speed": _real(0.1, 20),
    "max_yaw_rate": _real(0, 10), "max_vertical_speed": _real(0.1, 10), "max_descent_rate": _real(0.1, 10),
    "max_descent_speed": _real(0.1, 10),
}  # fmt: skip


def draw_world(seed: int, number: int) -> dict[str, Any]:
    """Return the arguments of a `QuadSwarmEnv` in a random world. Ten consecutive ones share what the planner's kernel
    depends on, because to compile one takes seconds."""
    shared, rng = np.random.default_rng([seed, number // 10]), np.random.default_rng([seed, number, 1])
    preset, n_robots = str(shared.choice(list(PRESETS))), int(shared.choice([2, 4, 8, 16, int(shared.integers(2, 65))]))
    world: dict[str, Any] = {}
    for source, names in ((shared, _COMPILED), (rng, [name for name in _FIELDS if name not in _COMPILED])):
        share = float(source.choice([0.0, 0.1, 0.3]))
        world |= {name: drawn for name in names if (drawn := _some(source, _FIELDS[name], share))}
    if "quadrotor" not in world and shared.random() < 0.3:
        world["quadrotor"] = str(shared.choice(list(VEHICLES)))
    if shared.random() < 0.2:
        world["radius"] = _between(shared, 1e-3, 3)
    kinds = np.random.default_rng([seed, number // 10, 2])
    if kinds.random() < 0.2:
        share = float(kinds.choice([0.3, 0.6]))
        world["vehicles"] = [_some(kinds, _VEHICLE, share) for _ in range(kinds.integers(1, min(n_robots, 3) + 1))]
    return {
        "preset": preset,
        "n_robots": n_robots,
        "scenario": str(rng.choice([*SCENARIOS, "mixed"])),
        "announcements": bool(rng.random() < 0.2),
        "world": {**world, **_some(rng, _PLAIN, float(rng.choice([0.0, 0.1, 0.3])))},
    }


def draw_motion(rng: Rng, swarm: Any) -> dict[str, Any]:
    """Return options of a reset, for two thirds of the flights: the flight that a swarm begins, in motion."""
    config, n = swarm.config, swarm.config.n_robots
    names = [name for name in ("initial_velocities", "initial_headings", "headings") if rng.random() < 0.3]
    if not names or not config.flies_quadrotors:
        return {}
    fastest = config.per_robot(lambda kind: min(kind.planner.max_speed, 50.0))
    options: dict[str, Any] = {"starts": swarm.pos[0].copy(), "goals": swarm.final_goal[0].copy()}
    drawn = {
        "initial_velocities": rng.uniform(-1, 1, (n, 3)) * fastest[:, None],
        "initial_headings": rng.uniform(-7, 7, n),
        "headings": rng.uniform(-7, 7, n),
    }
    options |= {name: drawn[name] for name in names}
    if "headings" in names:  # robots that may not turn keep theirs
        options["headings"] = np.where(config.turning, drawn["headings"], options.get("initial_headings", np.zeros(n)))
    return options


def _not_finite(where: str, value: Any) -> list[str]:
    """Return the names of everything in nested results that is not finite."""
    if isinstance(value, Mapping):
        return [name for key, one in value.items() for name in _not_finite(f"{where}.{key}", one)]
    array = np.asarray(value)
    finite = array.dtype.kind not in "fc" or bool(np.isfinite(array).all())
    # Empty places of a limited neighbourhood, separations of none and distances to no obstacle are infinite
    none = where.endswith(("separation", "obstacle_distance", "obstacle_distance_continuous"))
    return [] if finite or (none and not np.isnan(array).any()) else [where]


def _misreports(swarm: Any, info: Mapping[str, Any]) -> list[str]:
    """Return what a step reports of the swarms, but the states do not say."""
    config, found = swarm.config, []
    pos = swarm.state[..., POSITION]
    flat = np.array([1.0, 1.0, 1 / config.planner.downwash])
    distances = np.linalg.norm(flat * (pos[:, :, None] - pos[:, None]), axis=-1)
    distances -= 0.0 if config.excess is None else config.excess
    distances[:, np.arange(config.n_robots), np.arange(config.n_robots)] = np.inf
    least = distances.min(axis=(1, 2))
    contact = 2 * config.radius - config.collision_tolerance
    scale = _TOLERANCE * max(1.0, float(np.abs(pos).max()))
    if not np.allclose(least, info["min_separation"], rtol=_TOLERANCE, atol=scale):
        found.append(f"min_separation is {info['min_separation']}, but {least}")
    sure, collides = np.abs(least - contact) > scale, least < contact
    if swarm.obstacles is not None:
        obstacles = swarm.obstacles
        between = obstacles.factors[:, None] * (pos[:, :, None] - obstacles.position[:, None])
        gaps = np.linalg.norm(between, axis=-1) - obstacles.radius[:, None] - config.radii[:, None]
        nearest = np.where(obstacles.radius[:, None] > 0, gaps, np.inf).min(axis=(1, 2))
        if not np.allclose(nearest, info["min_obstacle_distance"], rtol=_TOLERANCE, atol=scale):
            found.append(f"min_obstacle_distance is {info['min_obstacle_distance']}, but {nearest}")
        sure &= np.abs(nearest + config.collision_tolerance) > scale
        collides |= nearest < -config.collision_tolerance
    if (collides != info["collision"])[sure].any():
        found.append(f"collision is {info['collision']} at {least}")
    if (np.asarray(info["min_separation_continuous"]) > np.asarray(info["min_separation"]) + scale).any():
        found.append("the least separation during the step exceeds that after it")
    to_goal = np.linalg.norm(pos - swarm.final_goal, axis=-1)
    sure = np.abs(to_goal - config.goal_radius) > scale
    last = True if swarm.route is None else swarm.route.at_last
    if (((to_goal < config.goal_radius) & last) != info["at_goal"])[sure].any():
        found.append("at_goal is wrong")
    return found


def _next_goals(swarm: Any) -> np.ndarray:
    """Return where the goals of swarms must be after a step, (E, n, 3) (m)."""
    route, dt = swarm.route, swarm.config.planner.dt
    return swarm.final_goal.copy() if route is None else swarm.final_goal + dt * route.velocity


def _same(one: Any, batch: Any, k: int) -> bool:
    """Return whether a result of a swarm alone is, bit for bit, that of swarm ``k`` of a batch."""
    if isinstance(one, Mapping):
        return all(_same(value, batch[name], k) for name, value in one.items() if name in batch)
    return np.asarray(one).tobytes() == np.asarray(batch)[k].astype(np.asarray(one).dtype).tobytes()


def fly(arguments: Mapping[str, Any], seed: int, steps: int = 20, resets: int = 4, n_swarms: int = 3) -> list[str]:
    """Create and fly a world, alone and in a batch.

    :param arguments: see `draw_world`
    :param seed: seed of the episodes and actions
    :param steps: number of steps
    :param resets: number of further resets
    :param n_swarms: number of swarms of the batch
    :return: what is wrong
    :raises ValueError: if the world is refused
    """
    alone, batch = QuadSwarmEnv(**arguments), QuadSwarmVectorEnv(n_swarms, **arguments)
    wrong: list[str] = []
    rng = np.random.default_rng(seed)
    try:
        for k in range(resets):
            alone.reset(seed=seed + 1000 + k)
        which = n_swarms - 1
        motion = draw_motion(rng, alone.task.swarm)
        seen, _ = batch.reset(seed=seed, options={"swarms": {which: motion}})
        own, _ = alone.reset(seed=seed + which, options=motion)
        wrong += _not_finite("observation", seen)
        for _ in range(steps):
            actions = rng.integers(0, 2, batch.action_space.shape)
            goals, running = _next_goals(batch.task.swarm), np.ones(n_swarms, dtype=bool)
            own, reward, terminated, truncated, info = alone.step(actions[which])
            wrong += _misreports(
                alone.task.swarm, {key: np.asarray(value)[None] for key, value in info.items() if key != "planner"}
            )
            seen, rewards, ended, cut, infos = batch.step(actions)
            running &= ~(ended | cut)
            wrong += _not_finite("observation", seen) + _not_finite("reward", rewards)
            wrong += _not_finite("state", batch.task.swarm.state) + _not_finite("info", info)
            if not np.array_equal(goals[running], batch.task.swarm.final_goal[running]):
                wrong.append("goals changed in flight")
            last = infos["final_obs"][which] if terminated or truncated else seen[which]
            same = own.tobytes() == last.tobytes() and reward == rewards[which]
            results = {name: info[name] for name in ("min_separation", "collision", "at_goal", "belief_source")}
            if not (same and _same(results, infos, which)):
                wrong.append("a swarm flies otherwise alone than in a batch")
            if terminated or truncated:
                own, _ = alone.reset()
            if wrong:
                break
    except Exception:
        wrong.append(traceback.format_exc()[-600:])
    finally:
        alone.close()
        batch.close()
    return wrong


def attempt(arguments: Mapping[str, Any], seed: int, steps: int = 20) -> tuple[str, list[str]]:
    """Fly a world.

    :return: "flown", "refused" or "wrong", and what is wrong
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            wrong = fly(arguments, seed, steps)
        except (ValueError, DoesNotFit) as error:
            told = str(error)
            return ("wrong", [f"several lines: {told}"]) if "\n" in told else ("refused", [told])
        except Exception:
            return "wrong", [traceback.format_exc()[-600:]]
    return ("wrong", wrong) if wrong else ("flown", [])


def _numbered(number: int, seed: int, steps: int) -> tuple[dict[str, Any], str, list[str]]:
    """Draw and fly a world, see `attempt`."""
    arguments = draw_world(seed, number)
    return arguments, *attempt(arguments, number, steps)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    tally, wrong = Counter[str](), []
    with Pool(args.jobs) as pool:
        results = pool.map(functools.partial(_numbered, seed=args.seed, steps=args.steps), range(args.count))
        for k, (arguments, outcome, told) in enumerate(
            tqdm(results, total=args.count, disable=not sys.stderr.isatty())
        ):
            tally[outcome] += 1
            if outcome == "wrong":
                wrong.append({"world": k, "arguments": arguments, "errors": told})
                print(f"world {k}: {arguments}\n  {told[0]}")
    print(f"{args.count} worlds: {tally['flown']} flown, {tally['refused']} refused, {len(wrong)} failures")
    if args.json:
        write_rows(args.json, [{"seed": args.seed, "steps": args.steps, **tally}, *wrong])
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
