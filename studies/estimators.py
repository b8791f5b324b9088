"""
Compare how well the gradient estimators for bits and categories learn the small team tasks.

``python -m studies.estimators [--seeds 5] [--json FILE]``
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg import MADDPG
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.team.toys import BINARY_TASKS, OwnCategory, TeamTask
from studies.learning import interval

# Arguments for all estimators, and the steps after which the deterministic policy is evaluated
RECIPE: dict[str, Any] = {
    "learning_rate": 3e-3,
    "learning_starts": 200,
    "batch_size": 256,
    "train_freq": 4,
    "gamma": 0.5,
}
CHECKPOINTS = (500, 1000, 2000, 4000)


def learning_curve(task: type[TeamTask], estimator: str, seed: int) -> list[float]:
    """
    :param task: task to learn
    :param estimator: name of the estimator
    :param seed: seed of environment, networks and exploration
    :return: the return at each checkpoint, scaled to 0 for random actions and 1 for the best policy
    """
    model = MADDPG("MlpPolicy", task(), estimator=estimator, seed=seed, buffer_size=CHECKPOINTS[-1], **RECIPE)
    curve = []
    for steps in np.diff(CHECKPOINTS, prepend=0).tolist():
        model.learn(steps, reset_num_timesteps=False)
        curve.append(task().play(model))
    return curve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", type=int, default=5, choices=range(2, 11), help="runs per estimator and task (default 5)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all returns")
    arguments = parser.parse_args()
    th.set_num_threads(1)

    print(
        "Return of the deterministic policy by steps: 0 for random actions, 1 for the optimum; mean and 95 % interval."
    )
    print(f"{'task':12} {'estimator':24}" + "".join(f"{steps:>15}" for steps in CHECKPOINTS))
    rows = []
    for task in (*BINARY_TASKS, OwnCategory):
        for estimator in ESTIMATORS:
            curves = [learning_curve(task, estimator, seed) for seed in range(arguments.seeds)]
            cells = ["{:5.2f} ± {:.2f}".format(*interval(returns)) for returns in zip(*curves, strict=True)]
            print(f"{task.__name__:12} {estimator:24}" + "".join(f"{text:>15}" for text in cells), flush=True)
            rows.append({"task": task.__name__, "estimator": estimator, "steps": CHECKPOINTS, "returns": curves})
    if arguments.json is not None:
        write_rows(arguments.json, rows)


if __name__ == "__main__":
    main()
