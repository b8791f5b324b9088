"""Draw learning curves: ``python -m studies.swarm.learning_curve RUN [RUN ...] --out curve.png``.

A RUN is a folder of `sb3-maddpg train` with its `evaluations.npz`. For several seeds of a recipe, the figure shows the
mean and the range. Lines mark no and full communication in the environment of the first run, in mixed
scenarios.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib
import numpy as np
from gymnasium.spaces import MultiBinary
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

import quad_swarm  # noqa: F401 - registers the environment
from quad_swarm.figures.colours import INK, LEARNED, RULES, STYLE
from sb3_maddpg import MADDPG
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import EngFormatter, PercentFormatter

EPISODES, SEED, SCENARIO = 1000, 10_000, "mixed"  # of the reference lines; the recipes evaluate in this scenario


class Constant:
    """Policy that always takes the same action."""

    def __init__(self, action: np.ndarray):
        self.action = action

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """See `BaseAlgorithm.predict`."""
        return np.stack([self.action] * len(observation)), state


def reference(kwargs: dict[str, Any], bit: int) -> tuple[float, float]:
    """Evaluate no (``bit`` 0) or full communication (1).

    :param kwargs: arguments of the environment
    :return: mean return and share of successes
    """
    env = VecMonitor(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=50, **kwargs)))
    env.seed(SEED)
    assert isinstance(env.action_space, MultiBinary)
    policy = Constant(np.full(env.action_space.shape, bit, dtype=np.int8))
    successes: list[bool] = []

    def note(values: dict[str, Any], _: dict[str, Any]) -> None:
        if values["done"]:
            successes.append(values["info"]["is_success"])

    returns, _ = evaluate_policy(policy, env, EPISODES, callback=note, return_episode_rewards=True, warn=False)
    env.close()
    return float(np.mean(returns)), float(np.mean(successes))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--out", type=Path, required=True, help="image file to write")
    args = parser.parse_args()
    logs = [np.load(run / "evaluations.npz") for run in args.runs]
    spec = MADDPG.load(args.runs[0] / "QuadSwarm-v0.zip").env_spec
    assert spec is not None, "models of registered environments have one"
    kwargs = spec["kwargs"] | {"scenario": SCENARIO}
    none, full = (reference(kwargs, bit) for bit in (0, 1))
    length = min(len(log["timesteps"]) for log in logs)
    steps = logs[0]["timesteps"][:length]
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(7.5, 3), layout="constrained")
        titles = ("Return of an episode", "Episodes without a collision in which all arrive")
        for k, (axes, key, title) in enumerate(zip(panels, ("results", "successes"), titles, strict=True)):
            values = np.array([log[key][:length].mean(axis=1) for log in logs])
            axes.plot(steps, values.mean(axis=0), color=LEARNED)
            axes.fill_between(steps, values.min(axis=0), values.max(axis=0), color=LEARNED, alpha=0.2, linewidth=0)
            for text, value in (("no communication", none[k]), ("full communication", full[k])):
                axes.axhline(value, color=RULES, linewidth=1.2, linestyle="--")
                axes.annotate(
                    text, (1, value), (-2, 3), ("axes fraction", "data"), "offset points", ha="right", color=INK
                )
            axes.set(title=title, xlabel="environment steps")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        panels[1].yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        label = f"mean and range of {len(logs)} seeds" if len(logs) > 1 else "one seed"
        panels[1].annotate(label, (0.97, 0.2), xycoords="axes fraction", ha="right", color=LEARNED)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(args.out)
    print(f"drew {args.out}; no and full communication: {none}, {full}")


if __name__ == "__main__":
    main()
