"""Draw learning curves: ``python -m studies.swarm.learning_curve RUN [RUN ...] --out curve.png``.

A RUN is a folder of `sb3-maddpg train` with its `evaluations.npz`. For several seeds of a recipe, the figure shows the
mean and the range.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--out", type=Path, required=True, help="image file to write")
    args = parser.parse_args()
    logs = [np.load(run / "evaluations.npz") for run in args.runs]
    length = min(len(log["timesteps"]) for log in logs)
    steps = logs[0]["timesteps"][:length]
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for axes, key, title in zip(panels, ("results", "successes"), ("return", "success rate"), strict=True):
        values = np.array([log[key][:length].mean(axis=1) for log in logs])
        axes.plot(steps, values.mean(axis=0), color="#0072B2")
        axes.fill_between(steps, values.min(axis=0), values.max(axis=0), color="#0072B2", alpha=0.2, linewidth=0)
        axes.set_xlabel("environment steps")
        axes.set_title(f"{title} in evaluation, {len(logs)} seed{'s' if len(logs) > 1 else ''}", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out, dpi=130)
    print(f"drew {args.out}")


if __name__ == "__main__":
    main()
