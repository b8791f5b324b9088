"""A custom scenario and a custom rule, in wind and with lost plans: ``python examples/own_world.py [--quick]``."""

import argparse

import numpy as np

from quad_swarm.evaluation import Condition, evaluate
from quad_swarm.evaluation.command import format_table
from quad_swarm.task.rules import RULES
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="only a few episodes, as a test")
quick = parser.parse_args().quick


def gate(n_robots, space, rng):
    """All robots pass through the same gap, half of them from each side."""
    side = np.where(np.arange(n_robots) % 2, 1.0, -1.0)
    row = (np.arange(n_robots) // 2 - (n_robots // 2 - 1) / 2) * 1.2
    starts = np.column_stack([3.0 * side, row, np.full(n_robots, 1.4)])
    goals = np.column_stack([-3.0 * side, -row, np.full(n_robots, 1.4)])  # their paths cross at the origin
    return tuple(points + rng.uniform(-0.15, 0.15, points.shape) for points in (starts, goals))


def crowded(radius, count):
    """Request plans from all robots closer than ``radius`` (m), if there are at least ``count`` of them."""

    def rule(view):
        near = np.linalg.norm(view.pos, axis=-1) < radius
        return near & (near.sum(axis=-1, keepdims=True) >= count)

    return rule


SCENARIOS["gate"] = gate
RULES["crowded"] = (crowded, ("RADIUS", "COUNT"))

worlds = {
    "still air": make_config("paper", n_robots=6),
    "wind, a third of the plans lost": make_config("paper", n_robots=6, noise={"wind": 1.0}, radio={"loss": 0.33}),
}
for name, config in worlds.items():
    policies = ("none", "full", "cpa:0.7:1.5", "crowded:2.5:2")
    conditions = [Condition(policy, "gate", config) for policy in policies]
    print(f"{name}:\n{format_table(evaluate(conditions, episodes=5 if quick else 200))}\n")
