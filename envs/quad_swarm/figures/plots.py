"""Figures of an evaluation: collisions and requests (the paper's Fig. 3 and 4), flights (Fig. 2) and an animation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon
from matplotlib.ticker import FixedLocator, PercentFormatter
from PIL import Image

from quad_swarm.evaluation.flight import Condition, Flight, fly
from quad_swarm.evaluation.policies import short_name
from quad_swarm.figures.colours import INK, OBSTACLE, OUTLINE, RULES, STYLE, colour_of
from quad_swarm.figures.render import Renderer
from quad_swarm.geometry import length
from quad_swarm.world.beliefs import other_indices

_SMALLEST_SHARE = 1e-3  # up to which axes are linear
_FILM, _SMOOTHING = (1280, 960), 2  # pixels of a GIF, and how many times as large it is drawn
_SHORTEST_FRAME = 0.02  # players slow down shorter frames of a GIF (s)


def draw_all(rows: Sequence[Mapping[str, Any]], conditions: Sequence[Condition], seed: int, folder: Path) -> list[Path]:
    """Draw all figures as PNG and PDF files, and a flight as an animation.

    :param rows: result of `evaluate`
    :param conditions: arguments of `evaluate`; the flights of the last policy are drawn
    :param seed: seed of `evaluate`
    :param folder: folder of the files
    :return: paths of the files
    """
    folder.mkdir(parents=True, exist_ok=True)
    last = [one for one in conditions if one.policy == conditions[-1].policy]
    flights = [fly(one, seed) for one in last]
    figures = {
        "collisions": draw_collisions(rows),
        "requests": draw_requests(rows),
        "front": draw_front(rows),
        "flights": draw_flights(last, flights),
    }
    paths = []
    for name, figure in figures.items():
        for kind in ("png", "pdf"):
            paths.append(folder / f"{name}.{kind}")
            figure.savefig(paths[-1], dpi=STYLE["savefig.dpi"])
    paths.append(folder / "swarm.gif")
    animate(last[-1], flights[-1], paths[-1])
    return paths


@rc_context(STYLE)
def draw_collisions(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the fraction of episodes with a collision, with 95 % Wilson intervals. Hatched: those with an obstacle."""
    figure = Figure(figsize=(8, 3.5), layout="constrained")
    axes = figure.subplots()
    interval = ("collision_low", "collision_high")
    _bars(axes, rows, lambda r: r["collisions"] / r["episodes"], lambda r: [r[name] for name in interval])
    if any("obstacle_collisions" in row for row in rows):
        _hatch(axes, rows, lambda r: r.get("obstacle_collisions", 0) / r["episodes"], "with an obstacle")
    axes.set_ylabel("episodes with a collision")
    return figure


@rc_context(STYLE)
def draw_requests(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the fraction of the possible requests that were made."""
    figure = Figure(figsize=(8, 3.5), layout="constrained")
    axes = figure.subplots()
    _bars(axes, rows, lambda r: r["request_share"], None)
    _by_magnitude(axes, "y", 0.0)
    axes.set_ylabel("requests made, of all possible")
    return figure


@rc_context(STYLE)
def draw_front(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw requests against collisions, with a panel per scenario. A line connects the Pareto front; bars are 95 %
    Wilson intervals."""
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    figure = Figure(figsize=(3.4 * len(scenarios), 3.6), layout="constrained")
    panels = figure.subplots(1, len(scenarios), sharey="row", squeeze=False)
    for axes, name in zip(panels[0], scenarios, strict=True):
        mine = [row for row in rows if row["scenario"] == name]
        points = {row["policy"]: (row["request_share"], row["collisions"] / row["episodes"]) for row in mine}
        front = sorted(p for p in points.values() if not any(_dominates(q, p) for q in points.values()))
        axes.plot(*zip(*front, strict=True), color=RULES, linewidth=1, zorder=1)
        for row in mine:
            x, y = points[row["policy"]]
            k = policies.index(row["policy"])
            bar = [[y - row["collision_low"]], [row["collision_high"] - y]]
            style = {"fmt": "os^Dv"[k // 8 % 5], "color": colour_of(k), "capsize": 2}
            axes.errorbar([x], [y], np.maximum(bar, 0), label=short_name(row["policy"]), **style)
        axes.set_title(name.replace("_", " "))
        axes.set_xlabel("requests made, of all possible")
        for which in ("x", "y"):
            _by_magnitude(axes, which)
    panels[0][0].set_ylabel("episodes with a collision")
    columns = min(5, 2 * len(scenarios))
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    return figure


def _by_magnitude(axes: Axes, which: str, low: float = -_SMALLEST_SHARE / 5) -> None:
    """Show fractions by their order of magnitude, and zero too: policies differ by tenths of a percent."""
    getattr(axes, f"set_{which}scale")("symlog", linthresh=_SMALLEST_SHARE, linscale=0.5)
    getattr(axes, f"set_{which}lim")(low, 1.4)
    axis = getattr(axes, f"{which}axis")
    axis.set_major_locator(FixedLocator([0, 1e-3, 1e-2, 1e-1, 1]))
    axis.set_minor_locator(FixedLocator([]))
    axis.set_major_formatter(lambda share, _: f"{100 * share:.4g}%")


def _dominates(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one != other and one[0] <= other[0] and one[1] <= other[1]


def _places(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[Mapping[str, Any]], np.ndarray, float]]:
    """Yield each policy, its rows by scenario, and where its bars are and how wide."""
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    width = 0.8 / len(policies)
    for k, policy in enumerate(policies):
        mine = {row["scenario"]: row for row in rows if row["policy"] == policy}
        x = np.arange(len(scenarios)) + (k - (len(policies) - 1) / 2) * width
        yield policy, [mine[name] for name in scenarios], x, 0.9 * width


def _hatch(axes: Axes, rows: Sequence[Mapping[str, Any]], height: Any, label: str) -> None:
    """Hatch the lower parts of bars."""
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": "white", "hatch": "////", "linewidth": 0}
    for _, mine, x, width in _places(rows):
        axes.bar(x, [height(row) for row in mine], width, **style)
    handles, labels = axes.get_legend_handles_labels()
    swatch = Patch(**{**style, "facecolor": RULES})
    axes.legend([*handles, swatch], [*labels, label], **_legend(len(labels) + 1))


def _legend(entries: int) -> dict[str, Any]:
    return {"ncols": min(entries, 5), "loc": "upper left", "bbox_to_anchor": (0, 1.17)}


def _bars(axes: Axes, rows: Sequence[Mapping[str, Any]], height: Any, interval: Any) -> None:
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    for k, (policy, mine, x, width) in enumerate(_places(rows)):
        heights = np.array([height(row) for row in mine])
        axes.bar(x, heights, width, color=colour_of(k), label=short_name(policy))
        if interval is not None:
            bounds = np.array([interval(row) for row in mine]).T
            axes.errorbar(x, heights, np.abs(bounds - heights), fmt="none", ecolor=INK, capsize=2, linewidth=1)
    axes.set_xticks(range(len(scenarios)), [name.replace("_", " ") for name in scenarios])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.legend(**_legend(k + 1))
    axes.grid(axis="x", visible=False)


@rc_context(STYLE)
def draw_flights(
    conditions: Sequence[Condition], flights: Sequence[Flight], size: float = 3.6, name: str | None = None
) -> Figure:
    """Draw a flight of a policy in each scenario from above, with the places of requests (Fig. 2).

    :param conditions: conditions of the flights
    :param flights: the flights
    :param size: width and height of each flight's panel (inches)
    :param name: name of the policy in the legend, by default its short name; empty for none
    """
    columns = min(len(conditions), 2)
    lines = math.ceil(len(conditions) / columns)
    figure = Figure(figsize=(size * columns, size * lines + 0.3), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False)
    for axes in panels.flat[len(conditions) :]:
        axes.set_visible(False)
    for axes, condition, flight in zip(panels.flat, conditions, flights, strict=False):
        draw_flight(axes, flight)
        axes.set_title(condition.scenario.replace("_", " "))
    policy = short_name(conditions[-1].policy) if name is None else name
    explain_flights(figure, panels.flat[0], policy, flights)
    return figure


def animate(condition: Condition, flight: Flight, path: Path) -> None:
    """Write a flight as an animated GIF in real time, until shortly after all robots have arrived.

    Steps that are shorter than `_SHORTEST_FRAME` share an image.
    """
    size = (_FILM[0] * _SMOOTHING, _FILM[1] * _SMOOTHING)
    renderer = Renderer(flight.config, size, scale=size[0] // 640)
    steps = len(flight.requests) if flight.arrival is None else min(flight.arrival + 9, len(flight.requests))
    dt = flight.config.planner.dt
    stride = math.ceil(_SHORTEST_FRAME / dt - 1e-9)
    shown = range(0, steps, stride)
    # GIF counts hundredths of a second: rounding the times, not the durations, keeps the film in real time
    times = np.rint(100 * dt * np.array([*shown, steps])).astype(int)
    frames = []
    for k in shown:
        lines = [
            f"{short_name(condition.policy)}, {condition.scenario}",
            f"step {k + 1}   {'plans sent' if flight.announced.any() else 'requests'} {flight.requests[k].sum()}",
        ]
        goal = flight.goal if flight.goals is None else flight.goals[k + 1]
        step = (flight.state[k + 1], goal, flight.plans[k + 1], flight.requests[k])
        picture = renderer.draw(*step, lines, flight.obstacles_at(k + 1))
        smooth = Image.fromarray(picture).reduce(_SMOOTHING)
        frames.append(smooth.quantize(colors=64, dither=Image.Dither.NONE))
    durations = (10 * np.diff(times)).tolist()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0)


def draw_flight(axes: Axes, flight: Flight) -> None:
    """Draw a flight from above in the colours of the robots, with dots where a robot makes requests, squares where it
    announces its plan, and an arrow halfway along each path. Obstacles that move are drawn where they are when it ends,
    with the way that they came."""
    asks = (flight.requests & ~flight.announced).any(axis=2)
    others = other_indices(flight.n_robots)
    for i, goal in enumerate(flight.goal):
        path, colour = flight.state[:, i, :2], colour_of(i)
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.2)
        travelled = np.cumsum(length(np.diff(flight.pos[:, i], axis=0)))
        k = int(np.searchsorted(travelled, travelled[-1] / 2))
        arrow = {"arrowstyle": "-|>", "color": colour, "mutation_scale": 15, "linewidth": 0}
        axes.annotate("", path[k + 1], path[k], arrowprops=arrow)
        asking = path[:-1][asks[:, i]]
        axes.scatter(asking[:, 0], asking[:, 1], s=18, color=colour, edgecolor="black", linewidth=0.5, zorder=3)
        if flight.announced.any():
            telling = path[:-1][(flight.announced & (others == i)).any(axis=(1, 2))]
            axes.scatter(
                telling[:, 0], telling[:, 1], s=26, marker="s", color="white", edgecolor=colour, linewidth=1.2, zorder=2
            )
        axes.plot(*path[0], "o", color=colour, markersize=7, markerfacecolor="white")
        axes.plot(*goal[:2], "*", color=colour, markersize=10)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.margins(0.08)
    _draw_obstacles(axes, flight)


def _draw_obstacles(axes: Axes, flight: Flight) -> None:
    """Draw the obstacles of a flight from above. Only those that stand belong to what must be seen."""
    end = len(flight.requests) if flight.arrival is None else flight.arrival
    style: dict[str, Any] = {"facecolor": OBSTACLE, "edgecolor": OUTLINE, "linewidth": 0.8, "zorder": 1.5}
    for one, there in zip(flight.obstacles_at(0), flight.obstacles_at(end), strict=True):
        before, after = np.array(one.position[:2]), np.array(there.position[:2])
        body = Circle((after[0], after[1]), one.radius, label="obstacle", **style)
        if not one.moves:
            axes.add_patch(body)
            continue
        if (before != after).any():
            along = (after - before) / np.hypot(*(after - before))
            aside = one.radius * np.array([-along[1], along[0]])
            way = Polygon([before - aside, before + aside, after + aside, after - aside])
            way.set(facecolor=OBSTACLE, alpha=0.3, linewidth=0, zorder=0.5)
            arrow = FancyArrowPatch(
                (before[0], before[1]),
                (after[0], after[1]),
                arrowstyle="-|>",
                mutation_scale=10,
                color=OUTLINE,
                shrinkB=0,
            )
            arrow.set(linewidth=0.8, zorder=1.6)
            for artist in (way, arrow):
                axes.add_artist(artist)
        axes.add_artist(body)


def explain_flights(figure: Figure, axes: Axes, policy: str = "", flights: Sequence[Flight] = ()) -> None:
    """Add a legend of `draw_flight` at the bottom of a figure.

    :param figure: the figure
    :param axes: any of its panels
    :param policy: name of the policy
    :param flights: the flights, of which some may have announcements and obstacles
    """
    marks: dict[str, dict[str, Any]] = {
        "start": {"marker": "o", "markersize": 7, "markerfacecolor": "white"},
        "goal": {"marker": "*", "markersize": 10},
        "asks somebody": {"marker": "o", "markersize": 5, "markeredgecolor": "black"},
    }
    if any(flight.announced.any() for flight in flights):
        marks["announces its plan"] = {"marker": "s", "markersize": 5, "markerfacecolor": "white"}
    obstacles = [one for flight in flights for one in flight.obstacles]
    if obstacles:
        moving = any(one.moves for one in obstacles)
        marks["obstacle, at the end of its way" if moving else "obstacle"] = {
            "marker": "o",
            "markersize": 10,
            "color": OBSTACLE,
            "markeredgecolor": OUTLINE,
        }
    styles = {name: {"color": RULES, **style} for name, style in marks.items()}
    handles = [axes.plot([], [], linestyle="", label=name, **style)[0] for name, style in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), title=policy or None)
