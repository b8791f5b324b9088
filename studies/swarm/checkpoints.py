"""Compare models from different times of a training with the paper's settings: last, best in evaluation, mean of last.

``python -m studies.swarm.checkpoints RUN [RUN ...] [--episodes N] [--jobs N] [--models FOLDER] [--json F]``. A RUN is a
folder of ``sb3-maddpg train --save-freq``. It provides the last model, ``best_model.zip`` (highest return of the
evaluations during training), the checkpoint with the fewest collisions on the validation set, and the mean of the
actors of the last checkpoints. All of them then fly other episodes. JSON: one row per run, choice and scenario with the
keys of `summarise`, and run, choice, model.
"""

from __future__ import annotations

import re
from concurrent.futures import Executor
from pathlib import Path

import torch as th

from quad_swarm.evaluation.command import workers
from quad_swarm.world.presets import make_config
from sb3_maddpg import MADDPG
from studies.swarm.experiment import Experiment, Job, Row, absolute_path, command_line, progress, summaries
from studies.swarm.protocol import EARLIER, NAMES, VALIDATION

# Number of checkpoints whose actors are averaged
LAST = 5


def fly(pool: Executor, paths: list[str], episodes: int, seed: int, what: str) -> dict[str, list[Row]]:
    """Fly episodes of all scenarios with several models.

    :param pool: executor of the flights
    :param paths: paths of the models
    :param episodes: number of episodes per scenario
    :param seed: index of the set of held-out episodes
    :param what: name of the progress bar
    :return: path -> its rows
    """
    jobs = [
        Job({}, [path], name, make_config("paper"), episodes, seed) for path in dict.fromkeys(paths) for name in NAMES
    ]
    table: dict[str, list[Row]] = {}
    for (row,) in progress(pool.map(summaries, jobs), what, len(jobs)):
        table.setdefault(row["policy"], []).append(row)
    return table


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
    parser = command_line(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument(
        "--choosing", type=int, default=250, help="episodes per scenario for the choice (default %(default)s)"
    )
    parser.add_argument(
        "--episodes", type=int, default=2000, help="episodes per scenario for the test (default %(default)s)"
    )
    parser.add_argument(
        "--models", type=Path, default=Path("logs"), help="folder for averaged models (default %(default)s)"
    )
    parser.add_argument("--json", type=absolute_path, metavar="FILE")
    args = parser.parse_args()
    experiment = Experiment(args.json, "run", "choice", "scenario")
    with workers(args) as pool:
        for run in args.runs:
            name, tried = run.parents[1].name, checkpoints(run)
            flown = fly(pool, [str(path) for path in tried], args.choosing, VALIDATION, name)
            choices = {
                "last": str(next(path for path in run.glob("*-v0.zip"))),
                "highest return in evaluation": str(run / "best_model.zip"),
                "fewest collisions on the validation set": min(
                    flown, key=lambda path: sum(row["collisions"] for row in flown[path])
                ),
                f"mean of the last {LAST}": average(tried[-LAST:], args.models / f"{name}_mean.zip"),
            }
            tested = fly(pool, list(choices.values()), args.episodes, EARLIER, f"{name}, choices")
            for choice, path in choices.items():
                rows = tested[path]
                keys = {"run": name, "choice": choice, "model": Path(path).name}
                experiment.keep([keys | {k: row[k] for k in row if k != "policy"} for row in rows])
                shares = (f"{row['collisions'] / row['episodes']:.1%} ({row['request_share']:.0%})" for row in rows)
                print(f"{name:14} {choice:40} {', '.join(shares)}", flush=True)


if __name__ == "__main__":
    main()
