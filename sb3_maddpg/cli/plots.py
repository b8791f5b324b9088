"""Figures of returns, which need the extra ``plot``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

try:
    import matplotlib
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError(f"{error}: figures need the extra 'plot': in the clone, pip install -e '.[plot]'.") from error

_INCHES, _ROW = 7.0, 0.32


def draw_returns(rows: Sequence[Mapping[str, Any]], folder: Path) -> Path:
    """
    Draw the mean returns of the team and its agents with their intervals.

    :param rows: rows of ``sb3-maddpg evaluate``, one per policy
    :param folder: where the figure is written
    :return: its path
    """
    names = ["team", *rows[0]["agents"]]
    figure = Figure(figsize=(_INCHES, 1.4 + _ROW * len(names) * max(len(rows), 2) / 1.6), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    places, width = np.arange(len(names))[::-1], 0.7 / len(rows)
    for k, row in enumerate(rows):
        found = [row["return"], *(row["agents"][name]["return"] for name in names[1:])]
        means = np.array([one["mean"] for one in found])
        bounds = np.array([[one["mean"] if one[end] is None else one[end] for one in found] for end in ("low", "high")])
        axes.errorbar(
            means, places + width * ((len(rows) - 1) / 2 - k), xerr=np.abs(bounds - means), fmt="o", capsize=3,
            markersize=5, label=row["policy"],
        )  # fmt: skip
    axes.set_yticks(places, names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlabel(f"return: mean of {rows[0]['episodes']} episodes with its 95 % interval")
    axes.set_title(rows[0]["env"])
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return _written(figure, folder / "returns.png")


def draw_seeds(curves: Mapping[str, tuple[np.ndarray, np.ndarray]], env_id: str, path: Path) -> Path:
    """
    Draw the evaluations during several trainings, and their mean.

    :param curves: by the training's name, numbers of steps and mean returns, (evaluations,) each
    :param env_id: title
    :param path: path of the figure
    """
    figure = Figure(figsize=(_INCHES, 4.2), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    for name, (steps, returns) in curves.items():
        axes.plot(steps, returns, color="tab:blue", alpha=0.35, linewidth=1, label=name)
    shortest = min((steps for steps, _ in curves.values()), key=len)
    means = np.mean([returns[: len(shortest)] for _, returns in curves.values()], axis=0)
    axes.plot(shortest, means, color="tab:blue", linewidth=2.5)
    axes.set_xlabel("steps of training")
    axes.set_ylabel("return of an evaluation")
    axes.set_title(f"{env_id}: {len(curves)} seeds and their mean")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return _written(figure, path)


def _written(figure: Figure, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"savefig.facecolor": "white"}):
        figure.savefig(path)
    return path
