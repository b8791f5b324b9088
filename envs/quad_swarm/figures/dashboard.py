"""TensorBoard's dashboard of a training: a layout of curves, a heat map of requests, and figures of flights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly, fly_steps
from quad_swarm.evaluation.policies import trained_in
from quad_swarm.figures.plots import draw_flights
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS, without_obstacles


def _line(tag: str) -> list[Any]:
    return ["Multiline", [tag]]


# Layout of TensorBoard's tab "Custom scalars": title -> chart -> kind and tags. Each chart has one tag, because all
# tags of a run have the same colour. Curves that are flat as long as all goes well come last.
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
# Number of episodes for the heat map, and their own set of held-out episodes
EPISODES, SET = 32, 9
_OF_THE_WORLD = ("preset", "world", "n_robots", "memory", "planner", "noise", "radio", "space")


def draw(model: Any, env_kwargs: Mapping[str, Any]) -> dict[str, Figure | float]:
    """Fly held-out episodes with a model and draw figures for TensorBoard.

    :param model: a model with ``predict`` and ``env_spec``, see `evaluation.policies.policy_of`
    :param env_kwargs: arguments of `QuadSwarmEnv`, of which only those of the world are used
    :return: by tag, figures of a flight in each scenario without obstacles and in those of the training, a heat map of
        requests in the symmetric swap, and request share and collision rate of the same episodes
    """
    config = make_config(**({"preset": "paper"} | {k: v for k, v in env_kwargs.items() if k in _OF_THE_WORLD}))
    trained = env_kwargs.get("scenario", ())
    trained = [trained] if isinstance(trained, str) else list(trained)
    names = [name for name in trained if name in SCENARIOS and name not in without_obstacles()]
    conditions = [Condition("model", name, config, linger=5) for name in (*names, *without_obstacles())]
    asked, possible, steps, collisions = requests_by_pair(conditions[-1], model)
    pictures: dict[str, Figure | float] = {
        f"eval/flight/{one.scenario}": draw_flights([one], [fly(one, SET, model=model)], 4.5, "") for one in conditions
    }
    return pictures | {
        "symmetric_swap/requests_by_pair": draw_requests_by_pair(
            asked / max(steps, 1), conditions[-1].scenario, bool(trained_in(model).get("announcements"))
        ),
        "symmetric_swap/request_share": float(asked.sum() / max(possible, 1)),
        "symmetric_swap/collision_rate": collisions / EPISODES,
    }


def requests_by_pair(condition: Condition, model: Any) -> tuple[np.ndarray, int, int, int]:
    """Count requests until a collision or the arrival of all robots.

    :param condition: scenario and world
    :param model: the model that flies
    :return: number of requests of robot i to robot j, (n, n), number of possible requests, number of steps, and number
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


def draw_requests_by_pair(share: np.ndarray, scenario: str, announcements: bool = False) -> Figure:
    """Draw a heat map of requests.

    :param share: fraction of steps in which robot i gets robot j's plan, (n, n)
    :param scenario: name of the scenario, for the title
    :param announcements: whether plans are also sent without a request, for the labels
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
    axes.set_xlabel("sends its plan" if announcements else "is asked")
    axes.set_ylabel("gets it" if announcements else "asks")
    axes.set_title(f"{scenario.replace('_', ' ')}: % of the steps", fontsize=10)
    figure.colorbar(shown, format=PercentFormatter(1.0))
    return figure
