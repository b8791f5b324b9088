"""Figures of the results pages."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, PercentFormatter

from quad_swarm.evaluation.flight import Flight, begin, first_episode, fly, fly_steps
from quad_swarm.evaluation.inference import wilson_interval
from quad_swarm.evaluation.policies import is_model
from quad_swarm.figures.colours import COLOURS, INK, LEARNED, RULES, STYLE, colour_of
from quad_swarm.figures.plots import draw_flight, explain_flights
from quad_swarm.plants.base import MODEL
from quad_swarm.task.request_task import RequestTask, requests_of
from quad_swarm.task.view import View
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import PRESETS, make_config
from quad_swarm.world.scenarios import without_obstacles
from studies.swarm.commitment import BEST_RULE
from studies.swarm.experiment import condition, progress
from studies.swarm.protocol import EARLIER
from studies.swarm.version2 import BOLDER, CHEAP_RULES, EVERYWHERE, ORCA, THIRD_POLICIES, named

NAMES = without_obstacles()[::-1]  # the hardest first
WORLDS = {"paper": "Four robots (paper)", "dense": "Eight robots (dense)"}
Rows = list[dict[str, Any]]
# The set whose flights show what is sent, and the bounds (m) by which they are counted: how wrong the receiver is, and
# how close the plan passes it
LOOKED_AT = 84
WRONG, CLOSE = (0.0, 0.1, 0.2, 0.4, 0.6, np.inf), (0.0, 0.8, 1.0, 1.5, np.inf)


def rate_of(row: dict[str, Any]) -> float:
    """Return the fraction of episodes with a collision."""
    return row["collisions"] / row["episodes"]


def merged(rows: Rows) -> dict[str, Any]:
    """Count the rows of a policy in several sets together.

    :return: ``policy``, ``episodes``, ``collisions`` with the interval of their rate, ``request_share``, ``arrived``
        and ``steps_to_arrival``, None if nobody arrived
    """
    episodes, collisions, arrived = (sum(row[key] for row in rows) for key in ("episodes", "collisions", "arrived"))
    low, high = wilson_interval(collisions, episodes)
    steps = sum(row["arrived"] * (row["steps_to_arrival"] or 0.0) for row in rows)
    return {
        "policy": rows[0]["policy"],
        "episodes": episodes,
        "collisions": collisions,
        "collision_low": low,
        "collision_high": high,
        "request_share": sum(row["episodes"] * row["request_share"] for row in rows) / episodes,
        "arrived": arrived,
        "steps_to_arrival": steps / arrived if arrived else None,
    }


def by_policy(rows: Rows) -> Rows:
    """Return a row for each policy, see `merged`."""
    names = dict.fromkeys(row["policy"] for row in rows)
    return [merged([row for row in rows if row["policy"] == name]) for name in names]


@rc_context(STYLE)
def draw_fronts(rules: Rows, sweep: Rows, tests: Rows, names: Sequence[str], path: Path) -> None:
    """Draw requests against collisions of all rules tried, the learned policy at all thresholds, and the tested
    policies, with a column per preset and a row per scenario."""
    presets = [preset for preset in PRESETS if any(row["preset"] == preset for row in rules)]
    figure = Figure(figsize=(8, 0.6 + 2.5 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), len(presets), sharex="col", sharey="row", squeeze=False)
    for line, name in zip(panels, names, strict=True):
        for axes, preset in zip(line, presets, strict=True):
            here = [
                [r for r in rows if (r["preset"], r["scenario"]) == (preset, name)] for rows in (rules, sweep, tests)
            ]
            _draw_front(axes, preset, *here)
            axes.set_title(f"{WORLDS.get(preset, preset)}: {name.replace('_', ' ')}")
        line[0].set_ylabel("episodes with a collision")
    for axes in panels[-1]:
        axes.set_xlabel("requests, of all possible")
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.savefig(path)


def _draw_front(axes: Axes, preset: str, rules: Rows, sweep: Rows, tests: Rows) -> None:
    tried = [(r["request_share"], rate_of(r)) for r in rules if r["episodes"] >= 250]
    axes.plot(
        *zip(*tried, strict=True),
        ".",
        color=RULES,
        markersize=3,
        alpha=0.35,
        label="hand-made rules, each setting tried (250 to 12,000 episodes)",
    )
    best = sorted((s, c) for s, c in tried if not any(s2 <= s and c2 < c for s2, c2 in tried))
    axes.plot(
        *zip(*best, strict=True),
        color=RULES,
        drawstyle="steps-post",
        label="best rules for up to 12 (left) and 16 robots",
    )
    learned = sorted((r for r in sweep if is_model(r["policy"])), key=lambda r: r["request_share"])
    if learned:
        shares = [r["request_share"] for r in learned]
        low, high = ([r[f"collision_{end}"] for r in learned] for end in ("low", "high"))
        axes.fill_between(shares, low, high, color=LEARNED, alpha=0.15, linewidth=0)
        axes.plot(
            shares,
            [rate_of(r) for r in learned],
            ".-",
            color=LEARNED,
            label="learned: one model, all thresholds (1,000 episodes, 95 %)",
        )
    seeds = [(r["request_share"], rate_of(r)) for r in tests if f"/{preset}_seed" in r["policy"]]
    if seeds:
        style: dict[str, Any] = {"markersize": 11, "markeredgecolor": "white", "markeredgewidth": 0.7, "linestyle": ""}
        axes.plot(
            *zip(*seeds, strict=True), "*", color=LEARNED, label="learned: five seeds (12,000 sealed episodes)", **style
        )
    for row in tests:
        if row["policy"] == "full":
            axes.axhline(
                rate_of(row),
                color=INK,
                linestyle=":",
                linewidth=1.2,
                label="full communication (12,000; 100 % of the requests)",
            )
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=1e-3)
    axes.set_ylim(-1e-4, 1)
    axes.yaxis.set_major_locator(FixedLocator([0, 1e-3, 1e-2, 1e-1, 1]))
    axes.yaxis.set_minor_locator(FixedLocator([]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda share, _: f"{100 * share:.4g}%")


@rc_context(STYLE)
def draw_flight_fronts(tried: Rows, twelve: Rows, sixteen: Rows, path: Path) -> None:
    """Draw plans sent against collisions in the symmetric swap of `flight`, with a panel for each number of robots:
    rules tried on validation episodes, and the sealed flights of the best rule, five models and full communication.

    :param tried: rows of `studies.swarm.tune_flight`
    :param twelve: rows of its sealed set of rules and thresholds for up to twelve robots
    :param sixteen: rows of that for up to sixteen
    :param path: path of the figure
    """
    figure = Figure(figsize=(8, 4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, n in zip(panels, (8, 16), strict=True):
        tries, *flown = ([r for r in rows if hardest(r, n)] for rows in (tried, twelve, sixteen))
        # Most were dropped after few episodes, which say little unless some ended in collisions
        told = [r for r in tries if r["episodes"] >= 500 or r["collisions"] >= 3]
        rules = [r for r in told if not is_model(r["setting"]) and r["setting"] != "full"]
        axes.plot(
            [r["request_share"] for r in rules],
            [rate_of(r) for r in rules],
            ".",
            color=RULES,
            markersize=4,
            alpha=0.45,
            label="hand-made rules: settings that were tried",
        )
        for most, hollow, rows in ((12, False, flown[0]), (16, True, flown[1])):
            best = [r for r in rows if r["policy"].startswith("cpa")]
            _points(axes, best, "D", INK, f"best rule for up to {most} robots", hollow)
            learned = [r for r in rows if is_model(r["policy"])]
            _points(axes, learned, "*", LEARNED, f"five models, thresholds for up to {most} robots", hollow)
        full = [r for rows in flown for r in rows if r["policy"] == "full"]
        _points(axes, full, "s", COLOURS[0], "full communication, in both sealed sets")
        axes.set_title(f"{'Eight' if n == 8 else 'Sixteen'} robots, symmetric swap")
        axes.set_xscale("log")
        axes.set_xlim(2e-3, 1.3)
        _share_axes(axes, [0.003, 0.01, 0.03, 0.1, 0.3, 1])
    _finish(figure, panels, path)


@rc_context(STYLE)
def draw_version_2(sealed: Rows, tried: Rows, path: Path) -> None:
    """Draw plans sent against collisions in the symmetric swap of `flight-v2`, with a panel for each number of robots.

    :param sealed: rows of `studies.swarm.version2`
    :param tried: rows of rules, and of the packaged model at other thresholds, on validation episodes
    :param path: path of the figure
    """
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, n in zip(panels, (8, 16), strict=True):
        tries, flown = ([row for row in rows if hardest(row, n)] for rows in (tried, sealed))
        flown = by_policy([row for row in flown if row["plant"] == MODEL])
        rules = [row for row in tries if "pretrained:" not in row["policy"] and row["policy"] != "none"]
        axes.plot(
            [row["request_share"] for row in rules],
            [rate_of(row) for row in rules],
            ".",
            color=RULES,
            markersize=5,
            alpha=0.6,
            label="hand-made rules, 100 to 200 trial flights",
        )
        curve = [row for row in tries if "pretrained:" in row["policy"]]
        curve.sort(key=lambda row: float(row["policy"].partition("@")[2]))
        axes.plot(
            [row["request_share"] for row in curve],
            [rate_of(row) for row in curve],
            ".-",
            color=LEARNED,
            alpha=0.6,
            label="the packaged model at other thresholds",
        )
        silent = [row for row in flown if row["policy"] == ORCA]
        _points(axes, silent, "^", COLOURS[2], "ORCA, no messages, sealed")
        _points(axes, [row for row in flown if row["policy"] == BEST_RULE], "D", INK, "best rule of version 1, sealed")
        cheap = [row for row in flown if row["policy"] in CHEAP_RULES]
        _points(axes, cheap, "d", RULES, "cheaper rules, sealed")
        none = [row for row in flown if row["policy"] == "none"]
        _points(axes, none, "X", RULES, "no communication, sealed")
        learned = [row for row in flown if as_shipped(row["policy"])]
        _points(axes, learned, "*", LEARNED, "learned, a mark for each training seed, sealed")
        bold = [row for row in flown if row["policy"] == named(BOLDER)]
        _points(axes, bold, "*", LEARNED, "one of them at a threshold of 0.5, sealed", hollow=True)
        full = [row for row in flown if row["policy"] == "full"]
        _points(axes, full, "s", COLOURS[0], "full communication, sealed")
        axes.set_title(f"{'Eight' if n == 8 else 'Sixteen'} robots, symmetric swap")
        axes.set_xscale("symlog", linthresh=0.003)
        axes.set_xlim(-0.0005, 1.3)
        _share_axes(axes, [0, 0.003, 0.01, 0.03, 0.1, 0.3, 1])
    _finish(figure, panels, path)


def _share_axes(axes: Axes, ticks: Sequence[float]) -> None:
    axes.set_yscale("symlog", linthresh=1e-3)
    axes.set_ylim(-1e-4, 1)
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(FixedLocator([]))
    axes.yaxis.set_major_locator(FixedLocator([0, 1e-3, 1e-2, 1e-1, 1]))
    axes.yaxis.set_minor_locator(FixedLocator([]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda share, _: f"{100 * share:.4g}%")
    axes.set_xlabel("plans sent, of all possible")


def _finish(figure: Figure, panels: Sequence[Axes], path: Path) -> None:
    panels[0].set_ylabel("flights with a collision")
    handles = dict(zip(*panels[0].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2)
    figure.savefig(path)


def as_shipped(policy: str) -> bool:
    """Return whether a policy is a training seed of the model of `flight-v2` at the threshold that ships."""
    return ("flight-v2" in policy or "flight_v2_seed" in policy) and policy.endswith("@0.4")


def hardest(row: dict[str, Any], n_robots: int) -> bool:
    """Return whether a row is of the symmetric swap with so many robots."""
    return (row["scenario"], row["n_robots"]) == ("symmetric_swap", n_robots)


def _points(axes: Axes, rows: Rows, marker: str, colour: str, label: str, hollow: bool = False) -> None:
    """Draw sealed flights with their 95 % intervals."""
    rates = [rate_of(r) for r in rows]
    errors = [[abs(r[f"collision_{end}"] - rate_of(r)) for r in rows] for end in ("low", "high")]
    axes.errorbar(
        [r["request_share"] for r in rows],
        rates,
        errors,
        fmt=marker,
        color=colour,
        markersize=10 if marker == "*" else 6,
        markerfacecolor="white" if hollow else colour,
        markeredgecolor=colour if hollow else "white",
        markeredgewidth=1.2 if hollow else 0.7,
        elinewidth=1,
        label=label,
    )


def flights(model: str, rule: str, preset: str) -> dict[str, Flight]:
    """Fly the first test episode of each scenario with a model, and record the requests that a rule would have made."""
    config = make_config(preset)
    names = progress(NAMES, f"flights, {preset}", len(NAMES))
    return {name: fly(condition(model, name, config), EARLIER, other_rule=rule) for name in names}


@rc_context(STYLE)
def draw_trajectories(flown: dict[str, dict[str, Flight]], path: Path) -> None:
    """Draw flights from above as in the paper's Fig. 2, with a column per preset."""
    figure = Figure(figsize=(4 * len(flown), 4 * len(NAMES)), layout="constrained")
    panels = figure.subplots(len(NAMES), len(flown), squeeze=False)
    for column, (preset, by_name) in zip(panels.T, flown.items(), strict=True):
        for axes, (name, flight) in zip(column, by_name.items(), strict=True):
            draw_flight(axes, flight)
            axes.set_title(f"{WORLDS.get(preset, preset)}: {name.replace('_', ' ')}")
    explain_flights(figure, panels[0][0])
    figure.savefig(path)


@rc_context(STYLE)
def draw_expectations(path: Path) -> None:
    """Draw what a robot that is told nothing expects of the others in a symmetric swap of eight, by a network and at
    constant velocities, beside what they then do."""
    config = make_config("flight-v3", n_robots=8)
    shown, horizon = (18, 30), config.planner.horizon
    policy, task, rngs = begin(condition("none", "symmetric_swap", config), [first_episode(EARLIER)])
    flown, expected = [task.swarm.pos[0].copy()], {}
    for step in range(max(shown) + horizon):
        if step in shown:
            swarm = task.swarm
            prediction = swarm.beliefs.predict(*swarm.observe(), swarm.scene())
            expected[step] = [
                one.believed()[0, 0] for one in (prediction, replace(prediction, outlook=None))
            ]  # of the first robot
        task.act(policy(task, rngs))
        flown.append(task.swarm.pos[0].copy())
    paths = np.array(flown)
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    for axes, step in zip(figure.subplots(1, 2, sharey=True), shown, strict=True):
        now, later = paths[step], paths[step : step + horizon + 1]
        for other in range(1, 8):
            axes.plot(*later[:, other, :2].T, color=INK, linewidth=4, alpha=0.25, label="what they do")
            network, steady = (one[other - 1] for one in expected[step])
            axes.plot(*network[:, :2].T, color=LEARNED, label="expected by the network")
            axes.plot(*steady[:, :2].T, "--", color=RULES, label="at constant velocity")
        axes.plot(*now[1:, :2].T, "o", color=INK, label="the others")
        axes.plot(*now[0, :2], "o", color=LEARNED, markersize=9, label="the robot that expects")
        axes.set(aspect="equal", xlabel="x (m)", title=f"after {step * config.planner.dt:.1f} s, the next second")
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.axes[0].set_ylabel("y (m)")
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3)
    figure.savefig(path)


def _sent(scenario: str, episodes: int) -> tuple[np.ndarray, ...]:
    """Fly episodes of eight robots with the packaged model of `flight-v3`, and look at each pair in each step.

    :return: how wrong the other is about the robot's plan within the next second (m), how close that plan passes it by
        what the robot expects of it (m), and whether the plan is sent to it, (pairs,) each
    """
    policy, task, rngs = begin(
        condition(THIRD_POLICIES["model"], scenario, make_config("flight-v3", n_robots=8)),
        [first_episode(LOOKED_AT) + k for k in range(episodes)],
    )
    seen: list[tuple[np.ndarray, ...]] = []

    def looking(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        bits, view, neighbours = policy(task, rngs), View(task.swarm), task.swarm.neighbours
        believed = view.seen_by_others(range(view.horizon)).believed
        wrong = np.linalg.norm(view.absolute_plans[:, :, None, 1:] - believed, axis=-1).max(axis=-1)
        sent = neighbours.of_the_other(requests_of(task.sent(bits), neighbours))
        seen.append(tuple(each.ravel() for each in (wrong, view.plan_approach.least, sent)))
        return bits

    for _ in fly_steps(looking, task, rngs, linger=0):
        pass
    return tuple(np.concatenate(part) for part in zip(*seen, strict=True))


def _draw_sent(axes: Axes, flight: Flight) -> int:
    """Draw a flight from above, with an arrow for each plan that is sent, from where its sender is to its receiver.

    :return: number of plans
    """
    nobody = np.zeros_like(flight.requests)
    draw_flight(axes, replace(flight, requests=nobody, announced=nobody))
    for line in axes.lines:
        line.set_alpha(0.45)
    others, plans = other_indices(flight.n_robots), np.argwhere(flight.requests[: flight.arrival])
    for number, (step, receiver, k) in enumerate(plans, 1):
        sender = others[receiver, k]
        here, there = (tuple(flight.pos[step, one, :2]) for one in (sender, receiver))
        arrow = {"arrowstyle": "-|>", "color": colour_of(sender), "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", there, here, arrowprops=arrow, zorder=4)
        axes.plot(*here, "o", color=colour_of(sender), markeredgecolor=INK, markersize=10, zorder=5)
        axes.annotate(str(number), here, ha="center", va="center", fontsize=7, color="white", zorder=6)
    return len(plans)


@rc_context(STYLE)
def draw_telling(path: Path, episodes: int = 40) -> None:
    """Draw what the packaged model of `flight-v3` sends: the plans of two flights, and how often it sends one by how
    wrong the other is and how close the two will pass.

    :param episodes: number of episodes of each scenario that are counted
    """
    config = make_config("flight-v3", n_robots=8)
    figure = Figure(figsize=(8, 7), layout="constrained")
    panels = list(figure.subplot_mosaic([[0, 1], [2, 2]], height_ratios=[1.25, 1]).values())
    for axes, name in zip(panels, ("forest", "crossing_traffic"), strict=False):
        flight = fly(condition(THIRD_POLICIES["model"], name, config), LOOKED_AT)
        possible = (flight.arrival or len(flight.requests)) * 8 * 7
        axes.set_title(f"{name.replace('_', ' ')}: {_draw_sent(axes, flight)} of {possible:,} plans")
    wrong, close, sent = (
        np.concatenate(part) for part in zip(*(_sent(name, episodes) for name in EVERYWHERE), strict=True)
    )
    axes, shares = panels[2], np.zeros((len(CLOSE) - 1, len(WRONG) - 1))
    for (row, (low, high)), (column, (least, most)) in itertools.product(
        enumerate(pairwise(CLOSE)), enumerate(pairwise(WRONG))
    ):
        inside = (close >= low) & (close < high) & (wrong >= least) & (wrong < most)
        shares[row, column] = sent[inside].mean() if inside.any() else 0.0
        colour = "white" if shares[row, column] > 0.03 else INK
        axes.text(column, row, f"{shares[row, column]:.2%}", ha="center", va="center", color=colour)
    axes.imshow(np.log10(np.maximum(shares, 1e-4)), cmap="Oranges", vmax=0, origin="lower", aspect="auto")
    for axis, bounds in ((axes.xaxis, WRONG), (axes.yaxis, CLOSE)):
        inner = [f"{low:g} to {high:g}" for low, high in pairwise(bounds[1:-1])]
        axis.set_ticks(range(len(bounds) - 1), [f"< {bounds[1]:g}", *inner, f"> {bounds[-2]:g}"])
    axes.set(
        xlabel="how far off the other is about the robot, within a second (m)",
        ylabel="how close the robot's\nplan passes the other (m)",
        title=f"share of possible plans that are sent, {episodes * len(EVERYWHERE)} flights",
    )
    axes.grid(visible=False)
    marks: dict[str, dict[str, Any]] = {
        "start": {"marker": "o", "markersize": 7, "markerfacecolor": "white"},
        "goal": {"marker": "*", "markersize": 10},
        "a plan, from its sender to its receiver, in order": {"marker": r"$1\to$", "markersize": 16},
    }
    handles = [axes.plot([], [], linestyle="", color=RULES, label=name, **style)[0] for name, style in marks.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    figure.savefig(path)


@rc_context(STYLE)
def draw_asking(rows: Rows, path: Path) -> None:
    """Draw how often policies make requests depending on what they observe, with a row per quantity and a column per
    preset."""
    quantities = list(dict.fromkeys(row["quantity"] for row in rows))
    presets = list(dict.fromkeys(row["preset"] for row in rows))
    figure = Figure(figsize=(8, 0.4 + 2.0 * len(quantities)), layout="constrained")
    panels = figure.subplots(len(quantities), len(presets), sharex="row", squeeze=False)
    for line, quantity in zip(panels, quantities, strict=True):
        for axes, preset in zip(line, presets, strict=True):
            for learned in (False, True):
                sums: dict[float, list[int]] = {}
                for row in rows:
                    if (row["preset"], row["quantity"], is_model(row["policy"])) == (preset, quantity, learned):
                        total = sums.setdefault((row["low"] + row["high"]) / 2, [0, 0])
                        total[0] += row["asked"]
                        total[1] += row["n"]
                points = [(x, asked / n) for x, (asked, n) in sorted(sums.items()) if n >= 100]
                if points:
                    name, colour = ("learned", LEARNED) if learned else ("best rule of each scenario", RULES)
                    axes.plot(*zip(*points, strict=True), ".-", color=colour, label=name)
            axes.set_xlabel(quantity)
            axes.set_ylim(bottom=0)
            axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        line[0].set_ylabel("share asked")
    for axes, preset in zip(panels[0], presets, strict=True):
        axes.set_title(WORLDS.get(preset, preset))
    panels[0][0].legend()
    figure.savefig(path)
