"""What all parts of the study have in common: sets of episodes, worlds, what counts as safe, and the tables of rows.

Rows are JSON objects, one a line, in ``studies/swarm/data``. How a test set is sealed stands in CONTRIBUTING.md.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from tqdm import tqdm

from quad_swarm.evaluation.evaluation import Rows, fly_all
from quad_swarm.evaluation.flight import Condition
from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison
from quad_swarm.evaluation.rows import read_rows, write_rows
from quad_swarm.tasks.journal import default_folder
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.scenarios import SCENARIOS

Item = TypeVar("Item")

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "swarm" / "data"
NAMES = list(SCENARIOS)
# Those of docs/results.md; the disturbed worlds have rules and tables of their own
PRESETS_TESTED = ("paper", "dense")

# Sets of held-out episodes, see `first_episode`. Rules and thresholds are tuned on VALIDATION. The main tables were
# first flown on EARLIER (four and eight robots), which had a say in how thresholds are tuned, and on EARLIER_TEAMS. So
# the tables of today are flown on TEST, which was sealed before. The analyses beside the tables still fly EARLIER.
VALIDATION, EARLIER, EARLIER_TEAMS, TEST = 1, 2, 3, 4
# Of the disturbed worlds: the sealed test set of policies (nobody has flown it), and one for what needs no tuning. That
# was set 7 until the planner's separation changed.
FLIGHT_TEST, WORLDS = 6, 8
# The paper's hand-made rule
DBCP = "distance:4"
# Steps flown on after arrival.
LINGER = 10
STAGES, QUICK_STAGES = (30, 100, 250, 500, 1000, 2000, 4000, 12000), (10, 20)
# More than twelve robots do not fit on the circle of eight. On this one 16 that ask everybody collide in 22 of 2,000
# episodes, twelve on that in 17, 16 on one of 3 to 3.5 m in 14 of 500.
WIDER = {"circle_radius": (3.5, 4.0)}


class Standard(NamedTuple):
    """What is as safe as full communication when rules and thresholds are tuned.

    :param margin: upper bound of the 95 % interval of the paired difference of the collision rates
    :param enough: episodes from which on that is decided, as soon as the interval's half is shorter than the margin
    """

    margin: float
    enough: int


OF_PRESET, OF_TEAM = Standard(SAFETY_MARGIN, 12000), Standard(0.005, 2000)


def world(preset: str, n_robots: int | None = None) -> SwarmConfig:
    """A preset, or a team of another size in it."""
    return make_config(preset, n_robots=n_robots, space=WIDER if n_robots is not None and n_robots > 12 else None)


def condition(policy: str, scenario: str, config: SwarmConfig, algo: str = "sb3_maddpg:MADDPG") -> Condition:
    """A policy in a scenario as all results here fly it."""
    return Condition(policy, scenario, config, algo=algo, solver="rti", linger=LINGER)


def fly_kept(conditions: Sequence[Condition], episodes: int, seed: int, skip: int = 0) -> dict[Condition, Rows]:
    """`fly_all`, which goes on from its finished pieces if it was killed."""
    return fly_all(conditions, episodes, seed, skip=skip, journal=default_folder())


def fly_validation(
    policies: list[str], preset: str, scenario: str, episodes: int, n_robots: int | None = None, skip: int = 0
) -> dict[str, Rows]:
    """:return: for each policy the figures of its validation episodes, without the first ``skip``"""
    config = world(preset, n_robots)
    conditions = [condition(policy, scenario, config) for policy in policies]
    return {one.policy: rows for one, rows in fly_kept(conditions, episodes, VALIDATION, skip).items()}


def hopeless(comparison: Comparison, margin: float = SAFETY_MARGIN) -> bool:
    """Whether a policy will hardly turn out as safe as full communication with more episodes."""
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
    """Fly a policy in more and more episodes, as long as there is hope and it is not yet decided (`Standard`).

    :param full: figures of full communication in the same episodes; those that are missing are flown and appended
    :param flown: the policy's figures in the first of them
    :param standard: what is as safe; that of the preset or of teams unless given
    :return: the policy's figures, and whether it is as safe; so few episodes as in a quick run prove nothing
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


def progress(items: Iterable[Item], what: str, total: int) -> Iterable[Item]:
    """Show in a terminal how many of the items are done."""
    return tqdm(items, what, total, unit="job", disable=not sys.stderr.isatty(), leave=False)


def replace_rows(path: Path, rows: list[dict[str, Any]], keys: tuple[str, ...]) -> None:
    """Write rows instead of those with the same keys; the file's other rows stay."""
    new = {tuple(row.get(key) for key in keys) for row in rows}
    kept = [row for row in read_rows(path) if tuple(row.get(key) for key in keys) not in new]
    write_rows(path, [*kept, *rows])


def known_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a table, to look at: a table is parsed again when its file has changed only."""
    if not path.exists():
        return []
    stat = path.stat()
    return _parsed(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=8)
def _parsed(path: Path, modified: int, size: int) -> list[dict[str, Any]]:
    return read_rows(path)


def absolute_path(text: str) -> Path:
    """An argument of the command line: what it names here, also after a change of the working directory."""
    return Path(text).resolve()


def models(recipe: str) -> list[str]:
    """The trained models of a recipe, by seed."""
    return [str(path.relative_to(ROOT)) for path in sorted(DATA.glob(f"{recipe}_seed*.zip"))]


def best_rules(preset: str, n_robots: int | None = None) -> dict[str, str]:
    """For each scenario the rule with the fewest requests that was as safe as full communication in validation, in a
    preset or in a team of another size."""
    best: dict[str, dict[str, Any]] = {}
    for row in known_rows(DATA / ("rules.json" if n_robots is None else "team_rules.json")):
        if row["preset"] == preset and row.get("n_robots") == n_robots and row["safe"]:
            known = best.setdefault(row["scenario"], row)
            if row["request_share"] < known["request_share"]:
                best[row["scenario"]] = row
    return {scenario: best[scenario]["rule"] if scenario in best else "full" for scenario in NAMES}


def tuned(recipe: str, scenario: str, n_robots: int | None = None) -> list[str]:
    """The models of a recipe with the threshold that was chosen for this scenario alone, as rules are, where that is
    not the one they have for all scenarios; with ``n_robots`` all of them, with that of this number of robots."""
    for_all: dict[str, float] = {}
    for_this: dict[str, float] = {}
    paths = models(recipe)
    for row in known_rows(DATA / "thresholds.json"):  # tried from the highest on
        if (path := row["model"]) in paths:
            for_all[path] = min(row["threshold"], for_all.get(path, 1.0))
            if row["scenario"] == scenario and n_robots in (None, row["n_robots"]):
                for_this[path] = row["threshold"]
    return [
        f"{path}@{threshold:g}"
        for path, threshold in for_this.items()
        if n_robots is not None or threshold > for_all[path]
    ]
