"""Worlds of QuadSwarm-v0 whose fields do not fit each other: they are refused in a sentence, or fly plausibly."""

# ruff: noqa: C901 - a list of cases

import dataclasses
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import yaml
from cases import Case, Silent

import quad_swarm
from quad_swarm.planner import BuildError
from quad_swarm.world.kinds import VehicleConfig
from quad_swarm.world.presets import PRESETS, SwarmConfig
from quad_swarm.world.scenarios import SCENARIOS

FACTORS = (-1, 0, 0.01, 0.1, 0.5, 0.9, 1.1, 2, 5, 10, 100, 1e4, 180 / np.pi, np.pi / 180)
FROM_ZERO = (1e-3, 0.01, 0.1, 0.5, 1, 3, 30)
WHOLE = (0, 1, 2, 3, 5, 8, 16, 40, 1001)  # hundreds of robots fly, but take their time
PLANTS = ("model", "rotorpy:hummingbird", "x", "model:x", "")


def odd_world(rng: random.Random, preset: str) -> dict[str, Any]:
    """:return: one to four fields of a preset, each another value of its type"""
    world: dict[str, Any] = {}
    for _ in range(rng.choice((1, 1, 2, 2, 3, 4))):
        part, place = PRESETS[preset], world
        while True:
            field = rng.choice(dataclasses.fields(part))  # type: ignore[arg-type]
            value = getattr(part, field.name)
            if not dataclasses.is_dataclass(value):
                break
            part, place = value, place.setdefault(field.name, {})
        place[field.name] = _other(rng, field.name, value)
    return world


def _other(rng: random.Random, name: str, value: Any) -> Any:
    if name == "plant":
        return rng.choice(PLANTS)
    if name == "vehicles":
        return [_vehicle(rng) for _ in range(rng.choice((0, 1, 2, 2, 3, 5)))]
    if isinstance(value, str):  # shapes of obstacles
        return rng.choice(("sphere", "cylinder", "cube", ""))
    if isinstance(value, tuple):
        if rng.random() < 0.3:
            return list(reversed(value))
        factor = rng.choice(FACTORS)
        return [one if rng.random() < 0.3 else one * factor for one in value]
    if isinstance(value, bool):
        return not value
    if isinstance(value, int) or (value is None and rng.random() < 0.4):
        return rng.choice(WHOLE)
    return rng.choice(FROM_ZERO) if not value else value * rng.choice(FACTORS)


def _vehicle(rng: random.Random) -> dict[str, Any]:
    paper, found = PRESETS["paper"], dict[str, Any]()
    for name in rng.sample([field.name for field in dataclasses.fields(VehicleConfig)], rng.choice((1, 1, 2, 3))):
        usual = paper.radius if name == "radius" else getattr(paper.planner, name, 0)
        found[name] = usual * rng.choice(FACTORS) if usual else rng.choice(FROM_ZERO)
        if name == "quadrotor":
            drag = paper.quadrotor.drag_x * rng.choice(FACTORS)
            found[name] = rng.choice(("x500", "bebop2", "x", "", {"drag_x": drag}, {"drag": drag}))
    return found


def check_flight(env: gymnasium.Env, options: dict[str, Any] | None = None, n_steps: int = 8) -> None:
    """
    :param env: QuadSwarm-v0
    :param options: of ``reset``
    :param n_steps: number of steps, with random requests
    :raises Silent: if robots begin inside each other, have goals that they cannot reach, or do what robots cannot do
    """
    swarm = env.unwrapped.task.swarm
    config: SwarmConfig = swarm.config
    rng = np.random.default_rng(0)
    contact = 2 * config.radius - config.collision_tolerance
    excess = np.zeros(1) if config.excess is None else config.excess[np.triu_indices(config.n_robots, 1)]
    lean = max(
        kind.planner.max_tilt * max(kind.quadrotor.roll_gain, kind.quadrotor.pitch_gain) * (1 + config.mismatch)
        for kind in config.kinds
    )
    steepest = np.hypot(lean, lean) + 8 * config.noise.attitude * np.sqrt(n_steps) + 1e-6
    for seed in range(2):
        obs, _ = env.reset(seed=seed, options=options)
        for name, points in (("starts", swarm.pos[0]), ("goals", swarm.goal[0])):
            apart = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(len(points), 1)]
            apart = (apart - excess).min()
            if name == "starts" and apart < contact - 1e-9:
                raise Silent(f"robots begin {apart} m apart, and touch at {contact}")
            if config.outside(points).max() > config.goal_radius:
                raise Silent(f"{name} are {config.outside(points).max()} m outside the workspace")
        for _ in range(n_steps):
            obs, reward, terminated, truncated, _ = env.step(rng.integers(0, 2, env.action_space.shape))
            pos = swarm.pos[0]
            if not (np.isfinite(obs).all() and np.isfinite(reward) and np.isfinite(swarm.state).all()):
                raise Silent("observation, reward or state is not finite")
            if config.plant == "model" and np.abs(swarm.state[..., 6:8]).max() > steepest:
                raise Silent(f"robots tilt by {np.abs(swarm.state[..., 6:8]).max()} rad, at most {lean} are possible")
            apart = np.linalg.norm(pos[:, None] - pos, axis=-1)[np.triu_indices(len(pos), 1)]
            apart = (apart - excess).min()
            if not config.continuous_collisions and (apart < contact) != terminated:
                raise Silent(
                    f"robots are {apart} m apart, touch at {contact}, and the episode goes on: {not terminated}"
                )
            if terminated or truncated:
                break
    env.close()


def make(**arguments: Any) -> gymnasium.Env:
    """:return: QuadSwarm-v0, with a solver that stays in place where there is no kernel"""
    try:
        return gymnasium.make("QuadSwarm-v0", solver="rti", disable_env_checker=True, **arguments)
    except BuildError:
        return gymnasium.make("QuadSwarm-v0", solver="stay", disable_env_checker=True, **arguments)


def _points(rng: random.Random, n: int) -> list[list[float]]:
    width, height = rng.choice((0.2, 1.0, 3.0, 4.7, 8.0)), rng.choice(((0.5, 2.2), (1, 1), (-1, 5)))
    found = [[rng.uniform(-width, width), rng.uniform(-width, width), rng.uniform(*height)] for _ in range(n)]
    if rng.random() < 0.2:
        found[-1] = found[0]
    return found


def worlds(rng: random.Random, call: Any) -> Iterator[Case]:
    """
    :param call: calls the command line with words
    :return: odd worlds
    """
    for _ in range(300):
        preset = rng.choice([*PRESETS])
        arguments = {"preset": preset, "world": odd_world(rng, preset), "scenario": rng.choice([*SCENARIOS, "mixed"])}
        if rng.random() < 0.2:
            arguments["max_steps"] = rng.choice((1, 5, 1000))
        if rng.random() < 0.2:
            arguments["observation"] = rng.choice(("state", "state+plan+told", "state+memory+mask+critic"))
        yield Case(f"make({arguments})", lambda arguments=arguments: check_flight(make(**arguments)))
    for _ in range(80):
        n, preset = rng.randrange(2, 6), rng.choice([*PRESETS])
        options = {"starts": _points(rng, n), "goals": _points(rng, n)}
        world = odd_world(rng, preset) if rng.random() < 0.3 else {}
        world = {name: value for name, value in world.items() if name != "n_robots"}
        yield Case(
            f"{preset} {world}: reset({options})",
            lambda n=n, preset=preset, world=world, options=options: check_flight(
                make(preset=preset, n_robots=n, world=world), options),
        )  # fmt: skip

    def flat(world: dict[str, Any], path: str = "") -> Iterator[str]:
        for name, value in world.items():
            if isinstance(value, dict):
                yield from flat(value, f"{path}{name}.")
            else:
                yield f"{path}{name}={yaml.safe_dump(value, default_flow_style=True).split(chr(10))[0]}"

    for _ in range(60):
        preset = rng.choice([*PRESETS])
        words = [*flat(odd_world(rng, preset))]
        yield Case(
            f"evaluate --preset {preset} --world {words}",
            lambda preset=preset, words=words: call(
                "evaluate", "--preset", preset, "--policy", "none", "--scenario", "random", "--episodes", "2",
                "--max-steps", "4", "--solver", "stay", "--world", *words),
        )  # fmt: skip

    def fly_vehicle(content: Any, where: str) -> None:
        path = Path("vehicle.yml")
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
        if where == "world":
            check_flight(make(world={"quadrotor": str(path)}))
        else:
            call("evaluate", "--policy", "none", "--scenario", "random", "--episodes", "1", "--max-steps", "3",
                 "--solver", "stay", "--world", f"quadrotor={path}")  # fmt: skip

    names = [field.name for field in dataclasses.fields(quad_swarm.quadrotor.QuadrotorParams)]
    for _ in range(60):
        drawn = {name: _other(rng, name, getattr(PRESETS["paper"].quadrotor, name)) for name in rng.sample(names, 3)}
        content: Any = rng.choice((drawn, {"parameters": drawn}, {"parameters": drawn, "more": 1}, [drawn],
                                   {"parameters": {**drawn, "mass": 0.5}}, {"parameters": [*drawn]}))  # fmt: skip
        where = rng.choice(("world", "command"))
        yield Case(f"vehicle {content} ({where})", lambda c=content, w=where: fly_vehicle(c, w))

    def recipe(world: dict[str, Any], preset: str) -> None:
        task = {"preset": preset, "world": world, "solver": "stay", "max_steps": 4}
        text = {"QuadSwarm-v0": {"n_timesteps": 12, "policy": "MlpPolicy", "learning_starts": 100, "env_kwargs": task}}
        Path("recipe.yml").write_text(yaml.safe_dump(text))
        call("train", "--env", "QuadSwarm-v0", "-f", "logs", "--eval-freq", "-1", "--conf-file", "recipe.yml")

    for _ in range(25):
        preset = rng.choice([*PRESETS])
        world = {**odd_world(rng, preset), "plant": "model"}  # a simulator takes long to start
        yield Case(f"recipe: {preset} {world}", lambda world=world, preset=preset: recipe(world, preset))
