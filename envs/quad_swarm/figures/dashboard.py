"""What TensorBoard shows of a training beside its curves: a layout, who asks whom, and how the swarm flies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly, fly_steps
from quad_swarm.figures.plots import draw_flights
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS


def _line(tag: str) -> list[Any]:
    return ["Multiline", [tag]]


# Of TensorBoard's page "Custom scalars": title -> chart -> kind and tags. One tag a chart, for the tags of a run have
# one colour there. What is flat as long as all goes well comes last.
LAYOUT: dict[str, dict[str, list[Any]]] = {
    "Safety": {
        "training: episodes with a collision": _line("swarm/collision_rate"),
        "evaluation: collisions, symmetric swap": _line("symmetric_swap/collision_rate"),
        "training: smallest separation (m)": _line("swarm/min_separation"),
        "training: arrivals": _line("swarm/arrival_rate"),
        "evaluation: arrivals": _line("eval/success_rate"),
    },
    "Communication": {
        "training: requests, of all possible": _line("comm/request_share"),
        "evaluation: requests, symmetric swap": _line("symmetric_swap/request_share"),
        "training: bytes/s that a robot sends": _line("comm/bytes_per_second"),
    },
    "Learning": {
        "training: return": _line("rollout/ep_rew_mean"),
        "evaluation: return": _line("eval/mean_reward"),
        "critics' loss": _line("train/critic_loss"),
        "actors' loss": _line("train/actor_loss"),
        "mean probability of a request": _line("train/probability_mean"),
        "its standard deviation": _line("train/probability_std"),
    },
    "Checks": {
        "steps per second": _line("time/fps"),
        "training: reward for requests": _line("reward/requests"),
        "training: planner failures": _line("planner/failure_rate"),
    },
}
# Episodes behind the heat map, a set of their own
EPISODES, SET = 32, 9
_OF_THE_WORLD = ("preset", "world", "n_robots", "memory", "planner", "noise", "radio", "space")


def draw(model: Any, env_kwargs: Mapping[str, Any]) -> dict[str, Figure | float]:
    """Fly some held-out episodes with a model.

    :param model: with ``predict`` and ``env_spec``, see `evaluation.policy_of`
    :param env_kwargs: arguments of `QuadSwarmEnv`, of which only the world's count
    :return: for TensorBoard, by tag: a flight of each scenario, who asks whom in the symmetric swap, and figures of
        the same episodes
    """
    config = make_config(**({"preset": "paper"} | {k: v for k, v in env_kwargs.items() if k in _OF_THE_WORLD}))
    conditions = [Condition("model", name, config, linger=5) for name in SCENARIOS]
    asked, possible, steps, collisions = requests_by_pair(conditions[-1], model)
    pictures: dict[str, Figure | float] = {
        f"eval/flight/{one.scenario}": draw_flights([one], [fly(one, SET, model=model)], 4.5) for one in conditions
    }
    return pictures | {
        "symmetric_swap/requests_by_pair": draw_requests_by_pair(asked / max(steps, 1), conditions[-1].scenario),
        "symmetric_swap/request_share": float(asked.sum() / max(possible, 1)),
        "symmetric_swap/collision_rate": collisions / EPISODES,
    }


def requests_by_pair(condition: Condition, model: Any) -> tuple[np.ndarray, int, int, int]:
    """Who asks whom, until a collision or the arrival of all.

    :param condition: scenario and world
    :return: how often robot i asked robot j, (n, n); how many requests were possible; the number of steps; the number
        of episodes with a collision
    """
    policy, task, rngs = begin(condition, [first_episode(SET) + k for k in range(EPISODES)], model)
    n = condition.config.n_robots
    rows, others = np.arange(n)[:, None], other_indices(n)
    asked, possible, steps = np.zeros((n, n)), 0, 0
    collided = np.zeros(EPISODES, dtype=bool)
    done = np.zeros(EPISODES, dtype=bool)
    for step in fly_steps(policy, task, rngs, linger=0):
        counted = ~done[step.episodes]
        asked[rows, others] += step.requests[counted].sum(axis=0)
        possible += int((counted * (step.outcome.report.others >= 0).sum(axis=(-2, -1))).sum())
        steps += int(counted.sum())
        collided[step.episodes] |= task.statistics.collided & counted
        done[step.episodes] |= task.statistics.collided | task.statistics.reached
    return asked, possible, steps, int(collided.sum())


def draw_requests_by_pair(share: np.ndarray, scenario: str) -> Figure:
    """A heat map.

    :param share: how often robot i asks robot j, of all steps, (n, n)
    :param scenario: for the title
    """
    n = len(share)
    figure = Figure(figsize=(4.2, 3.6), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(np.ma.masked_where(np.eye(n, dtype=bool), share), cmap="viridis", vmin=0)
    for i, j in np.argwhere(~np.eye(n, dtype=bool)):
        dark = share[i, j] < 0.6 * share.max()
        axes.text(j, i, f"{100 * share[i, j]:.0f}", ha="center", va="center", color="white" if dark else "black")
    axes.set_xticks(range(n))
    axes.set_yticks(range(n))
    axes.set_xlabel("is asked")
    axes.set_ylabel("asks")
    axes.set_title(f"{scenario.replace('_', ' ')}: % of the steps", fontsize=10)
    figure.colorbar(shown, format=PercentFormatter(1.0))
    return figure
