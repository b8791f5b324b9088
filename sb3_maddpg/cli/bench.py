"""``sb3-maddpg bench``: how fast a recipe trains on this machine, and where the time goes."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_maddpg.cli.experiment import begin, given_recipe
from sb3_maddpg.cli.options import check_writable
from sb3_maddpg.cli.training import Training

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


class _Timed(Training):
    """Training that measures times and saves no model."""

    result: dict[str, Any]

    def learn(self, model: BaseAlgorithm, callbacks: list[BaseCallback]) -> None:
        totals = {name: [0.0] for name in (*PARTS, "environments")}
        for name, attribute in PARTS.items():
            if hasattr(model, attribute):
                setattr(model, attribute, timed(getattr(model, attribute), totals[name]))
        assert model.env is not None
        model.env.step = timed(model.env.step, totals["environments"])  # type: ignore[method-assign]
        started = time.perf_counter()
        super().learn(model, callbacks)
        seconds = time.perf_counter() - started
        shares = {name: total[0] / seconds for name, total in totals.items()}
        shares["rest"] = 1 - sum(shares.values())
        self.result = {
            "env": self.args.env,
            "algo": self.args.algo,
            "steps": model.num_timesteps,
            "updates": getattr(model, "_n_updates", 0),
            "seconds": seconds,
            "steps_per_second": model.num_timesteps / seconds,
            **{f"share_{name}": share for name, share in shares.items()},
        }

    def save(self, model: BaseAlgorithm) -> None:
        """Do nothing, unless the training was interrupted."""
        if self.interrupted:
            raise KeyboardInterrupt


def bench(args: argparse.Namespace, words: list[str]) -> int:
    """
    :param args: options of ``bench``
    :param words: unused
    :return: exit status
    """
    piped = args.json == Path("-")
    printed = sys.stderr if piped else sys.stdout
    if args.json and not piped:
        check_writable(args.json)
    args.n_timesteps = 20_000 if args.n_timesteps < 0 else args.n_timesteps
    args.progress = args.progress or sys.stderr.isatty()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(printed):
        args.log_folder = folder
        begin(args)
        training = _Timed(args, *given_recipe(args))
        training.run()
    result = training.result
    print(
        f"{result['steps']} steps and {result['updates']} updates in {result['seconds']:.1f} s: "
        f"{result['steps_per_second']:.0f} steps/s",
        file=printed,
    )
    for name in ("environments", "learning", "acting", "rest"):
        print(f"  {name:13} {result[f'share_{name}']:6.1%}", file=printed)
    if piped:
        print(json.dumps(result))
    elif args.json:
        args.json.write_text(json.dumps(result) + "\n")
        print(f"wrote {args.json}")
    return 0
