"""Figures of an evaluation: collisions and requests (the paper's Fig. 3 and 4), one flight a scenario (Fig. 2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .colours import colour_of
from .evaluation import Cell, Flight, fly


def draw_all(rows: Sequence[Mapping[str, Any]], cells: Sequence[Cell], seed: int, folder: Path) -> list[Path]:
    """Draw every figure as PNG into ``folder``; returns their paths.

    :param rows: what `evaluate` returned
    :param cells: what it was given; the last policy's flights are drawn
    :param seed: the same seed
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "collisions": draw_collisions(rows),
        "requests": draw_requests(rows),
        "flights": draw_flights(cells, seed),
    }
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], dpi=130)
        plt.close(figure)
    return paths


def draw_collisions(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Share of episodes with a collision, with 95 % Wilson intervals."""
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    _bars(axes, rows, lambda r: r["collisions"] / r["episodes"], lambda r: (r["collision_low"], r["collision_high"]))
    axes.set_ylabel("episodes with a collision")
    return figure


def draw_requests(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Share of the possible requests that were made."""
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    _bars(axes, rows, lambda r: r["request_share"], None)
    axes.set_ylabel("requests made, of all possible")
    return figure


def _bars(axes: Axes, rows: Sequence[Mapping[str, Any]], height: Any, interval: Any) -> None:
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    width = 0.8 / len(policies)
    for k, policy in enumerate(policies):
        mine = {row["scenario"]: row for row in rows if row["policy"] == policy}
        x = np.arange(len(scenarios)) + (k - (len(policies) - 1) / 2) * width
        heights = np.array([height(mine[name]) for name in scenarios])
        label = policy if len(policy) <= 30 else "..." + policy[-27:]
        axes.bar(x, heights, 0.9 * width, color=colour_of(k), label=label)
        if interval is not None:
            bounds = np.array([interval(mine[name]) for name in scenarios]).T
            axes.errorbar(x, heights, np.abs(bounds - heights), fmt="none", ecolor="#333333", capsize=2, linewidth=1)
    axes.set_xticks(range(len(scenarios)), [name.replace("_", " ") for name in scenarios])
    axes.yaxis.set_major_formatter(matplotlib.ticker.PercentFormatter(1.0, decimals=0))
    axes.legend(frameon=False, ncols=min(len(policies), 5), loc="upper left", bbox_to_anchor=(0, 1.17))
    axes.spines[["top", "right"]].set_visible(False)


def draw_flights(cells: Sequence[Cell], seed: int) -> Figure:
    """One flight of the last policy in each scenario, from above: where robots asked, and where they did not."""
    last = [cell for cell in cells if cell.policy == cells[-1].policy]
    figure, panels = plt.subplots(1, len(last), figsize=(3.4 * len(last), 3.8), layout="constrained", squeeze=False)
    for axes, cell in zip(panels[0], last, strict=True):
        _draw_flight(axes, fly(cell, seed))
        axes.set_title(cell.scenario.replace("_", " "), fontsize=10)
    figure.suptitle(f"{cells[-1].policy}: dots mark steps with a request", fontsize=9)
    return figure


def _draw_flight(axes: Axes, flight: Flight) -> None:
    for i in range(flight.pos.shape[1]):
        colour = colour_of(i)
        path = flight.pos[:, i]
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1)
        asked = path[:-1][flight.requests[:, i].any(axis=1)]
        axes.scatter(asked[:, 0], asked[:, 1], s=14, color=colour)
        axes.plot(*path[0, :2], "o", color=colour, markersize=7, markerfacecolor="white")
        axes.plot(*flight.goal[i, :2], "*", color=colour, markersize=11)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.margins(0.08)
