"""Compare models from different times of a training with the paper's settings: last, best in evaluation, mean of last.

``python -m studies.swarm.checkpoints RUN [RUN ...] [--episodes N] [--jobs N] [--models FOLDER] [--json F]``. A RUN is a
folder of ``sb3-maddpg train --save-freq``. It provides the last model, ``best_model.zip`` (highest return of the
evaluations during training), the checkpoint with the fewest collisions on the validation set, and the mean of the
actors of the last checkpoints. All of them then fly other episodes. JSON: one row per run, choice and scenario with the
keys of `summarise`, and run, choice, model.
"""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import torch as th

from quad_swarm.evaluation.command import add_worker_arguments, workers
from quad_swarm.evaluation.evaluation import summarise
from quad_swarm.evaluation.rows import write_rows
from quad_swarm.world.presets import make_config
from sb3_maddpg import MADDPG
from studies.swarm.protocol import EARLIER, NAMES, VALIDATION, condition, fly_kept, progress

# Number of checkpoints whose actors are averaged
LAST = 5


class Flown(NamedTuple):
    """Results of a model in all scenarios.

    :param path: path of the model
    :param rows: scenario -> result, see `summarise`
    """

    path: str
    rows: dict[str, dict[str, Any]]

    @property
    def collisions(self) -> int:
        """Number of collisions in all scenarios."""
        return sum(row["collisions"] for row in self.rows.values())


def fly(path: str, episodes: int, seed: int) -> Flown:
    """Fly episodes of all scenarios.

    :param path: path of the model
    :param episodes: number of episodes per scenario
    :param seed: index of the set of held-out episodes
    """
    config = make_config("paper")
    flown = fly_kept([condition(path, name, config) for name in NAMES], episodes, seed)
    return Flown(path, {one.scenario: summarise(rows, config) for one, rows in flown.items()})


def checkpoints(run: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    steps = {path: re.fullmatch(r"rl_model_(\d+)_steps", path.stem) for path in run.glob("rl_model_*_steps.zip")}
    return sorted((path for path, found in steps.items() if found), key=lambda path: int(steps[path][1]))  # type: ignore[index]


def average(paths: list[Path], target: Path) -> str:
    """Write a model whose actors have the mean weights of several models. Its critics are those of the last one."""
    models = [MADDPG.load(path, device="cpu") for path in paths]
    with th.no_grad():
        for weights in zip(*(model.actor.parameters() for model in models), strict=True):
            weights[-1].copy_(th.stack(weights).mean(dim=0))
    models[-1].save(target)
    return str(target)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument(
        "--choosing", type=int, default=250, help="episodes per scenario for the choice (default %(default)s)"
    )
    parser.add_argument(
        "--episodes", type=int, default=2000, help="episodes per scenario for the test (default %(default)s)"
    )
    add_worker_arguments(parser, jobs=os.cpu_count() or 1)
    parser.add_argument(
        "--models", type=Path, default=Path("logs"), help="folder for averaged models (default %(default)s)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    choices: list[tuple[str, str, str]] = []
    with workers(args) as pool:
        for run in args.runs:
            tried = checkpoints(run)
            count = len(tried)
            paths = [str(path) for path in tried]
            flown = pool.map(fly, paths, [args.choosing] * count, [VALIDATION] * count)
            best = min(progress(flown, run.parents[1].name, count), key=lambda one: one.collisions)
            mean = average(tried[-LAST:], args.models / f"{run.parents[1].name}_mean.zip")
            last = next(path for path in run.glob("*-v0.zip"))
            name = run.parents[1].name
            choices += [
                (name, "last", str(last)),
                (name, "highest return in evaluation", str(run / "best_model.zip")),
                (name, "fewest collisions on the validation set", best.path),
                (name, f"mean of the last {LAST}", mean),
            ]
        tested = pool.map(fly, [path for *_, path in choices], [args.episodes] * len(choices), [EARLIER] * len(choices))
        table = []
        for (name, choice, path), one in zip(choices, progress(tested, "choices", len(choices)), strict=True):
            keys = {"run": name, "choice": choice, "model": Path(path).name}
            table += [keys | {"scenario": scenario} | row for scenario, row in one.rows.items()]
            shares = ", ".join(
                f"{row['collisions'] / row['episodes']:.1%} ({row['request_share']:.0%})" for row in one.rows.values()
            )
            print(f"{name:14} {choice:40} {shares}", flush=True)
    if args.json:
        write_rows(args.json, table)


if __name__ == "__main__":
    main()
