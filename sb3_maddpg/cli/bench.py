"""``sb3-maddpg bench``: how fast a recipe trains on this machine, and where the time goes."""

import contextlib
import functools
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rl_zoo3.train
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_maddpg.cli import zoo
from sb3_maddpg.cli.experiment import TeamExperimentManager
from sb3_maddpg.cli.options import check_writable, common_options
from sb3_maddpg.cli.recipes import LengthOption, check_options

# Timed parts of an algorithm and their methods. A method that the algorithm lacks counts as 0 seconds.
PARTS = {"learning": "train", "acting": "_sample_action"}


def timed(function: Callable[..., Any], total: list[float]) -> Callable[..., Any]:
    """
    Measure the time of a function's calls.

    :param function: any function
    :param total: list with one entry, to which the seconds of each call are added
    :return: the timed function
    """

    def call(*args: Any, **kwargs: Any) -> Any:
        started = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            total[0] += time.perf_counter() - started

    return call


class BenchManager(TeamExperimentManager):
    """
    Experiment manager that measures training times and saves nothing else.

    :param result: receives the times, since rl_zoo3 does not expose its manager
    """

    def __init__(self, result: dict[str, Any], *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.result = result

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train a model and measure the times.

        :param model: a new model
        """
        totals = {name: [0.0] for name in (*PARTS, "environments")}
        for name, attribute in PARTS.items():
            if hasattr(model, attribute):
                setattr(model, attribute, timed(getattr(model, attribute), totals[name]))
        assert model.env is not None
        model.env.step = timed(model.env.step, totals["environments"])  # type: ignore[method-assign]
        started = time.perf_counter()
        super().learn(model)
        seconds = time.perf_counter() - started
        shares = {name: total[0] / seconds for name, total in totals.items()}
        shares["rest"] = 1 - sum(shares.values())
        self.result.update(
            env=self.env_name.gym_id,
            algo=self.algo,
            steps=model.num_timesteps,
            updates=getattr(model, "_n_updates", 0),
            seconds=seconds,
            steps_per_second=model.num_timesteps / seconds,
            **{f"share_{name}": share for name, share in shares.items()},
        )

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Do nothing.

        :param model: unused
        """


def main(argv: list[str]) -> int:
    """
    :param argv: options of ``sb3-maddpg train``, and ``--json FILE``, where ``-`` is the standard output
    :return: exit status
    """
    parser = common_options()
    parser.add_argument("--json", type=Path)
    parser.add_argument("--n-timesteps", "-n", type=int, default=20_000)
    known, given = parser.parse_known_args(argv)
    piped = known.json == Path("-")
    printed = sys.stderr if piped else sys.stdout
    if known.json and not piped:
        check_writable(known.json)
    check_options(known, LengthOption)
    zoo.register()
    result: dict[str, Any] = {}
    rl_zoo3.train.ExperimentManager = functools.partial(BenchManager, result)  # type: ignore[assignment,misc]
    with tempfile.TemporaryDirectory() as folder:
        options = ["--algo", known.algo, "--n-timesteps", str(known.n_timesteps), "--log-folder", folder]
        options += ["--env", known.env] if known.env else []
        options += ["--progress"] if sys.stderr.isatty() else []
        with contextlib.redirect_stdout(printed):
            zoo.train([*options, "--eval-freq", "-1", "--verbose", "0", "--seed", "0", *given], "bench")
    print(
        f"{result['steps']} steps and {result['updates']} updates in {result['seconds']:.1f} s: ", end="", file=printed
    )
    print(f"{result['steps_per_second']:.0f} steps/s", file=printed)
    for name in ("environments", "learning", "acting", "rest"):
        print(f"  {name:13} {result[f'share_{name}']:6.1%}", file=printed)
    if piped:
        print(json.dumps(result))
    elif known.json:
        known.json.write_text(json.dumps(result) + "\n")
        print(f"wrote {known.json}")
    return 0


if __name__ == "__main__":
    sys.exit("error: this module is not a command: use `sb3-maddpg bench` or `python -m sb3_maddpg bench`.")
