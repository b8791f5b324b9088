"""Common parts of the study: sets of episodes, worlds, and the criterion of safety.

CONTRIBUTING.md explains how test sets are sealed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from quad_swarm.evaluation.evaluation import Rows
from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.scenarios import without_obstacles
from studies.swarm.experiment import condition, fly_kept, known_rows

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "swarm" / "data"
NAMES = without_obstacles()
# Presets of docs/results.md; the disturbed worlds have their own rules and tables
PRESETS_TESTED = ("paper", "dense")

# Sets of held-out episodes, see `first_episode`. Rules and thresholds are tuned on VALIDATION. The main tables were
# first flown on EARLIER (four and eight robots), which influenced how thresholds are tuned, and on EARLIER_TEAMS.
# Therefore, the current tables are flown on TEST, which was sealed before. The additional analyses still fly EARLIER.
VALIDATION, EARLIER, EARLIER_TEAMS, TEST = 1, 2, 3, 4
# Sets of the disturbed worlds: the sealed test sets of settings for teams of up to twelve and sixteen robots, and one
# for experiments without tuning, which was set 7 until the planner's separation changed
FLIGHT_TESTS, WORLDS = {12: 6, 16: 9}, 8
# The paper's hand-made rule
DBCP = "distance:4"
STAGES, QUICK_STAGES = (30, 100, 250, 500, 1000, 2000, 4000, 12000), (10, 20)
# Circle for more than twelve robots, which do not fit on that of eight. With full communication, 16 robots on this one
# collide in 22 of 2,000 episodes, twelve robots on that of eight in 17 of 2,000, and 16 on one of 3 to 3.5 m in 14 of
# 500.
WIDER = {"circle_radius": (3.5, 4.0)}


class Standard(NamedTuple):
    """Criterion of being as safe as full communication when tuning rules and thresholds.

    :param margin: limit for the upper bound of the 95 % interval of the paired difference of collision rates
    :param enough: minimum number of episodes for a decision, which also needs the half-width of the interval to be less
        than the margin
    """

    margin: float
    enough: int


OF_PRESET, OF_TEAM = Standard(SAFETY_MARGIN, 12000), Standard(0.005, 2000)


def world(preset: str, n_robots: int | None = None) -> SwarmConfig:
    """Return a preset, optionally with another number of robots."""
    return make_config(preset, n_robots=n_robots, space=WIDER if n_robots is not None and n_robots > 12 else None)


def fly_validation(
    policies: list[str], preset: str, scenario: str, episodes: int, n_robots: int | None = None, skip: int = 0
) -> dict[str, Rows]:
    """:return: statistics of each policy's validation episodes, without the first ``skip``"""
    config = world(preset, n_robots)
    conditions = [condition(policy, scenario, config) for policy in policies]
    return {one.policy: rows for one, rows in fly_kept(conditions, episodes, VALIDATION, skip).items()}


def hopeless(comparison: Comparison, margin: float = SAFETY_MARGIN) -> bool:
    """Return whether more episodes are unlikely to show that a policy is as safe as full communication."""
    excess = comparison.only_first - comparison.only_second
    return excess >= 4 and excess / comparison.episodes > margin


def in_stages(
    policy: str,
    preset: str,
    scenario: str,
    full: Rows,
    quick: bool,
    n_robots: int | None = None,
    flown: Rows | None = None,
    standard: Standard | None = None,
) -> tuple[Rows, bool]:
    """Fly a policy in stages of more and more episodes until its safety is decided (`Standard`) or hopeless.

    :param policy: the policy
    :param preset: name of the world
    :param scenario: name of the scenario
    :param full: statistics of full communication in the same episodes; missing episodes are flown and appended
    :param quick: whether to fly only a few episodes, which prove nothing
    :param n_robots: number of robots, by default the preset's
    :param flown: the policy's statistics in the first episodes
    :param standard: criterion, by default that of presets or of teams
    :return: the policy's statistics, and whether it is as safe as full communication
    """
    figures = list(flown or [])
    margin, enough = standard or (OF_PRESET if n_robots is None else OF_TEAM)
    for episodes in QUICK_STAGES if quick else STAGES:
        for name, known in ((policy, figures), ("full", full)):
            if episodes > len(known):
                known += fly_validation([name], preset, scenario, episodes, n_robots, skip=len(known))[name]
        comparison = Comparison.of(figures, full[:episodes])
        if hopeless(comparison, margin):
            return figures, False
        low, high = comparison.interval
        if episodes >= enough and (high - low) / 2 < margin:
            return figures, comparison.as_safe(margin)
    return figures, quick


def models(recipe: str) -> list[str]:
    """Return the trained models of a recipe by seed."""
    return [str(path.relative_to(ROOT)) for path in sorted(DATA.glob(f"{recipe}_seed*.zip"))]


def best_rules(preset: str, n_robots: int | None = None) -> dict[str, str]:
    """Return for each scenario the rule with the fewest requests that was as safe as full communication on the
    validation set, in a preset or with another number of robots."""
    best: dict[str, dict[str, Any]] = {}
    for row in known_rows(DATA / ("rules.json.gz" if n_robots is None else "team_rules.json.gz")):
        if row["preset"] == preset and row.get("n_robots") == n_robots and row["safe"]:
            known = best.setdefault(row["scenario"], row)
            if row["request_share"] < known["request_share"]:
                best[row["scenario"]] = row
    return {scenario: best[scenario]["rule"] if scenario in best else "full" for scenario in NAMES}


def tuned(recipe: str, scenario: str, n_robots: int | None = None) -> list[str]:
    """Return the models of a recipe whose threshold for this scenario, chosen like the rules', differs from the one for
    all scenarios. With ``n_robots``, return all models with their thresholds for this number of robots."""
    for_all: dict[str, float] = {}
    for_this: dict[str, float] = {}
    paths = models(recipe)
    for row in known_rows(DATA / "thresholds.json.gz"):  # tried from the highest on
        if (path := row["model"]) in paths:
            for_all[path] = min(row["threshold"], for_all.get(path, 1.0))
            if row["scenario"] == scenario and n_robots in (None, row["n_robots"]):
                for_this[path] = row["threshold"]
    return [
        f"{path}@{threshold:g}"
        for path, threshold in for_this.items()
        if n_robots is not None or threshold > for_all[path]
    ]
