"""Tune rules and models in `flight` with one setting for all scenarios and numbers of robots, on the validation set.

``python -m studies.swarm.tune_flight rules|thresholds [MODEL.zip ...] [--preset flight] [--up-to 12] [--quick]
[--json F]``. A setting, which is a rule or a threshold of a model, is safe if it is as safe as full communication up to
a margin in each cell, which is a scenario with a number of robots (`AIMS`). ``--preset flight-v2`` tunes rules for up
to sixteen robots in version 2 (`VERSION_2`).

All rules first fly a few episodes of both swaps with eight robots to measure their requests. Of rules with identical
flights, only one is kept. The rules are then tried by increasing number of requests, in stages of more and more
episodes, until one is safe. A rule that can no longer be safe is dropped. To find this out early, each rule first flies
those episodes of the hardest cell in which most other rules collided (rows with ``selected``). The thresholds of a
model are tried in decreasing order. With ``--up-to 16``, its threshold is instead the lowest with which it makes less
than half of the best rule's requests in each swap, whether it is safe or not (rows with ``chosen``): the sealed flights
then show how safe models are at half the price.

JSON: one row per setting, number of robots and scenario with the keys of `summarise` over the episodes flown, and
family, setting, safe (None if only the requests are known). Results that the file already contains are reused.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from functools import partial
from pathlib import Path
from typing import NamedTuple

from quad_swarm.evaluation.command import workers
from quad_swarm.evaluation.evaluation import Rows, summarise
from quad_swarm.evaluation.flight import first_episode, run_episodes
from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison
from quad_swarm.evaluation.policies import is_model
from studies.swarm.experiment import Experiment, Row, absolute_path, command_line, condition, known_rows, progress
from studies.swarm.protocol import DATA, NAMES, QUICK_STAGES, VALIDATION, fly_validation, models, world

FULL = "full"
Cell = tuple[int, str]  # number of robots, scenario
Flown = dict[Cell, Rows]


PRESET = "flight"


class Setting(NamedTuple):
    """A rule with its family, or a model with a threshold, whose family is the model."""

    family: str
    name: str


SWAPS = ("symmetric_swap", "asymmetric_swap")
OWN_SWAPS: list[Cell] = [(8, name) for name in SWAPS]
STAGES = (25, 50, 100, 250, 500, 1000, 2000, 4000)
# Number of episodes to fly first in the hardest cell and in each of the other cells
FIRST, FIRST_OTHERS = 2000, 100
# Number of episodes of the hardest cell, those with the most collisions so far, to fly before all others, and the size
# of their batches
HARDEST, AT_ONCE = 240, 60


class Aim(NamedTuple):
    """What a setting has to achieve.

    :param sizes: number of episodes for a decision by the number of robots, hardest first
    :param margin: limit for the upper bound of the difference to full communication
    :param thresholds: thresholds of models to try in this order
    :param price: if given, models are not tuned to be safe, but to make at most this share of the best rule's requests
    :param preset: the world
    :param full_collides: whether full communication has to be flown, or is known not to collide
    """

    sizes: dict[int, int]
    margin: float
    thresholds: tuple[float, ...]
    price: float | None = None
    preset: str = PRESET
    full_collides: bool = True

    @property
    def cells(self) -> list[Cell]:
        """The cells, hardest first. The random scenarios of teams other than the preset's are left out, since hardly
        any collisions occur in them."""
        others = [(8, name) for name in NAMES if name not in SWAPS]
        return [*itertools.product(self.sizes, SWAPS), *others]


# By the largest team. Teams larger than in training are harder, and the cheapest setting that passes has often been
# lucky: with sixteen robots, the margin is lower than that of the sealed test.
AIMS = {
    12: Aim(
        {12: 2000, 8: 4000, 4: 2000},
        SAFETY_MARGIN,
        (0.9, 0.85, *(round(0.8 - 0.025 * k, 3) for k in range(23)), 0.2, 0.15, 0.1, 0.05, 0.02),
    ),
    16: Aim({16: 4000, 12: 4000, 8: 4000, 4: 4000}, 0.002, (0.02, *(round(0.05 * k, 2) for k in range(1, 17))), 0.45),
}
FILES = {12: "flight_tuning.json.gz", 16: "flight_sixteen.json.gz"}
# Without obstacles, full communication collides in none of 192,000 sealed flights of version 2. 1,300 episodes without
# a collision are the fewest that are within the margin.
VERSION_2 = Aim(dict.fromkeys((16, 12, 8, 4), 1300), SAFETY_MARGIN, (), preset="flight-v2", full_collides=False)
VERSION_2_FILE = "flight_v2_tuning.json.gz"
UP_TO = 12  # robots of the largest team by default
TELL_FROM = (0.1, 0.2, 0.3, 0.4, 0.5)  # deviations from the presumed plan (separations)
PRICED_ON = 100  # episodes of each swap in which the requests of a threshold are measured


def families(up_to: int = UP_TO, commitment: bool = False) -> dict[str, list[str]]:
    """Return the rules of each family, with lengths in separations.

    :param up_to: number of robots of the largest team; with more than twelve, there are also rules that ask for most of
        the plans
    :param commitment: whether robots keep to the plans that they sent, for which there are rules that tell
    """
    product = itertools.product
    cpas = [f"cpa:{d}s:{t}" for d, t in product((1.0, 1.05, 1.1, 1.15, 1.2, 1.3), (1, 1.5, 2, 3))]
    far = [f"cpa:{d}s:{t}" for d, t in product((1.0, 1.1, 1.2), (1.5, 2, 3))]
    plans = [f"plan:{d}s" for d in (0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.4, 1.5)]
    generous = {
        "distance": [f"distance:{d}s" for d in (2, 2.5, 3, 3.5, 4, 5, 6, 8)],
        "wide": [f"cpa:{d}s:{t}" for d, t in product((2, 2.5, 3), (2, 3))] + [f"plan:{d}s" for d in (1.8, 2, 2.5, 3)],
    }
    telling = {"stage": [f"stage:{d}:{e}" for d, e in product((0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2), TELL_FROM)]}
    return (
        (generous if up_to > UP_TO else {})
        | (telling if commitment else {})
        | {
            "cpa": [
                f"cpa:{d}s:{t}" for d, t in product((1.0, 1.04, 1.08, 1.12, 1.18, 1.25, 1.35, 1.5), (1, 1.5, 2, 3))
            ],
            "plan and stale": [f"{plan}&stale:{k}" for plan, k in product(plans, range(1, 9))],
            "plan, soon and stale": [
                f"{plan}&soon:{t}&stale:{k}" for plan, t, k in product(plans[2:9:2], (0.5, 0.8, 1.2), (2, 3, 4, 6))
            ],
            "cpa and stale": [f"{cpa}&stale:{k}" for cpa, k in product(cpas, (2, 3, 4, 6, 8))],
            "cpa and event": [f"{cpa}&event:{e}" for cpa, e in product(far, (0.02, 0.03, 0.05, 0.1))],
            "push": [f"push:{e}" for e in (0.1, 0.15, 0.2, 0.3, 0.4)],
            "cpa, soon or stale": [
                f"{cpa}&soon:{t}|{cpa}&stale:{k}" for cpa, t, k in product(far, (0.2, 0.3, 0.5), (3, 4, 6))
            ],
            "plan, soon or stale": [
                f"{plan}&soon:{t}|{plan}&stale:{k}" for plan, t, k in product(plans[2:9:2], (0.2, 0.3, 0.5), (3, 4, 6))
            ],
            "plan or cpa, stale": [
                f"{plan}&stale:{k}|cpa:{c}&stale:{k}"
                for plan, c, k in product(plans[3::2], ("1.05s:1.5", "1.1s:2", "1.2s:2"), (2, 3, 4))
            ],
        }
    )


def fly(policy: str, cell: Cell, episodes: int, known: Rows | None = None, preset: str = PRESET) -> Rows:
    """Return a policy's statistics in the first episodes, some of which may be known."""
    rows, (n_robots, name) = list(known or []), cell
    if episodes > len(rows):
        rows += fly_validation([policy], preset, name, episodes, n_robots, skip=len(rows))[policy]
    return rows


def last(aim: Aim, cell: Cell, stages: Sequence[int]) -> int:
    """Return the number of episodes for a decision in a cell."""
    return min(aim.sizes[cell[0]], stages[-1])


class Trial(NamedTuple):
    """Result of trying a setting.

    :param flown: statistics of the episodes flown
    :param safe: whether the setting is as safe as full communication; a quick run has too few episodes to prove this
    :param collided: episodes of the hardest cell in which the setting collided
    :param selected: whether only selected episodes were flown, in which other settings collided
    """

    flown: Flown
    safe: bool
    collided: list[int]
    selected: bool = False


def try_out(policy: str, full: Flown, stages: Sequence[int], hard: Sequence[int] = (), aim: Aim = AIMS[12]) -> Trial:
    """Fly a policy in more and more episodes as long as it may be as safe as full communication in all cells.

    :param policy: the policy
    :param full: statistics of full communication, of all episodes for a decision
    :param stages: numbers of episodes of the stages
    :param hard: episodes of the hardest cell to fly before all others
    :param aim: what the policy has to achieve
    """
    cell = aim.cells[0]
    if hard:
        first_one = first_episode(VALIDATION)
        one = condition(policy, cell[1], world(aim.preset, cell[0]))
        rows: Rows = []
        collided: set[int] = set()
        for begin in range(0, len(hard), AT_ONCE):
            part = hard[begin : begin + AT_ONCE]
            rows += run_episodes(one, [first_one + k for k in part])
            collided |= {k for k, row in zip(part, rows[begin:], strict=True) if row["collided"]}
            at_best: Rows = [{"collided": k in collided} for k in range(last(aim, cell, stages))]
            if not may_be_safe(at_best, full[cell], aim.sizes[cell[0]], aim.margin):
                return Trial({cell: rows}, False, sorted(collided), selected=True)
    flown, safe = _by_stages(policy, full, stages, aim)
    return Trial(flown, safe, [k for k, row in enumerate(flown[cell]) if row["collided"]])


def _by_stages(policy: str, full: Flown, stages: Sequence[int], aim: Aim) -> tuple[Flown, bool]:
    flown: Flown = {}
    cells = aim.cells
    first = {
        cell: [stage for stage in stages if stage <= (FIRST_OTHERS if k else FIRST)] for k, cell in enumerate(cells)
    }
    order = [(stage, cell) for cell in cells for stage in first[cell]]
    order += [(stage, cell) for stage in stages for cell in cells if stage not in first[cell]]
    for stage, cell in order:
        flown[cell] = fly(policy, cell, min(stage, last(aim, cell, stages)), flown.get(cell), aim.preset)
        if not may_be_safe(flown[cell], full[cell], aim.sizes[cell[0]], aim.margin):
            return flown, False
    return flown, True


def may_be_safe(flown: Rows, full: Rows, deciding: int, margin: float) -> bool:
    """Return whether a policy would be as safe as full communication without any further collision.

    :param flown: the policy's statistics in the first episodes
    :param full: statistics of full communication in all episodes
    :param deciding: number of episodes for a decision
    :param margin: limit for the upper bound of the difference
    """
    no_more: Rows = [{"collided": False}] * deciding
    return Comparison.of([*flown, *no_more][:deciding], [*full, *no_more][:deciding]).as_safe(margin)


def rows_of(
    family: str, setting: str, flown: Flown, safe: bool | None, selected: bool = False, preset: str = PRESET
) -> list[Row]:
    """Return the rows of a setting."""
    keys: Row = {"preset": preset, "family": family, "setting": setting, "safe": safe}
    keys |= {"selected": True} if selected else {}
    return [
        keys | {"n_robots": n_robots, "scenario": name} | summarise(rows, world(preset, n_robots))
        for (n_robots, name), rows in flown.items()
        if rows
    ]


def table_of(path: Path) -> Experiment:
    """Return the table in a file."""
    return Experiment(path, "preset", "setting", "n_robots", "scenario")


def fly_full(pool: Executor, table: Experiment, stages: Sequence[int], aim: Aim = AIMS[12]) -> Flown:
    """Return the collisions with full communication in all episodes for a decision. Known results are reused."""
    if not aim.full_collides:
        return {cell: [{"collided": False}] * last(aim, cell, stages) for cell in aim.cells}
    known = {cell_of(row): row["outcomes"] for row in table.rows() if row["family"] == FULL}
    missing = [cell for cell in aim.cells if len(known.get(cell, "")) < last(aim, cell, stages)]
    work = pool.map(fly, [FULL] * len(missing), missing, [last(aim, cell, stages) for cell in missing])
    for cell, rows in zip(missing, progress(work, FULL, len(missing)), strict=True):
        known[cell] = "".join("1" if row["collided"] else "0" for row in rows)
        (line,) = rows_of(FULL, FULL, {cell: rows}, True)
        table.keep([line | {"outcomes": known[cell]}])
    return {cell: [{"collided": letter == "1"} for letter in known[cell]] for cell in aim.cells}


def by_requests(
    pool: Executor, table: Experiment, stages: Sequence[int], quick: bool, up_to: int = UP_TO, preset: str = PRESET
) -> list[Setting]:
    """Return the rules by increasing number of requests in both swaps of eight robots, without rules with identical
    flights."""
    known_families = families(up_to, commitment=preset == VERSION_2.preset)
    rules = [Setting(family, rule) for family, rules in known_families.items() for rule in rules[:: 12 if quick else 1]]
    known: dict[str, list[Row]] = {}
    for row in table.rows():
        if cell_of(row) in OWN_SWAPS:
            known.setdefault(row["setting"], []).append(row)
    work = [(rule, cell) for rule in rules if len(known.get(rule.name, [])) < len(OWN_SWAPS) for cell in OWN_SWAPS]
    first = partial(fly, episodes=stages[0], preset=preset)
    flown = pool.map(first, [rule.name for rule, _ in work], [cell for _, cell in work])
    lines = []
    for (rule, cell), rows in zip(work, progress(flown, "requests", len(work)), strict=True):
        lines += rows_of(*rule, {cell: rows}, None, preset=preset)
        known.setdefault(rule.name, []).append(lines[-1])
    table.keep(lines, "preset", "setting")
    rules.sort(key=lambda rule: sum(row["request_share"] for row in known[rule.name]))
    figures = ("request_share", "requests_flown", "path_length", "min_separation")
    alike = {repr([[row.get(key) for key in figures] for row in known[rule.name]]): rule for rule in reversed(rules)}
    return [rule for rule in rules if rule in alike.values()]


def cheapest_rule(rows: Iterable[Row]) -> str | None:
    """Return the safe rule that makes the fewest requests in both swaps of eight robots, None if no rule is safe."""
    shares: Counter[str] = Counter()
    for row in rows:
        if row["safe"] and not is_model(row["setting"]) and row["family"] != FULL:
            shares[row["setting"]] += row["request_share"] if cell_of(row) in OWN_SWAPS else 0
    return min(shares, key=lambda rule: shares[rule], default=None)


def best_rule(up_to: int = UP_TO) -> str:
    """Return the rule that is safe everywhere and makes the fewest requests in both swaps of eight robots.

    :param up_to: number of robots of the largest team that it was tuned for
    :raises ValueError: if no rule is safe
    """
    if (rule := cheapest_rule(known_rows(DATA / FILES[up_to]))) is None:
        raise ValueError(f"{DATA / FILES[up_to]} holds no safe rule: run `studies.swarm.tune_flight` first.")
    return rule


def tuned_models(up_to: int = UP_TO) -> list[str]:
    """Return the models with their tuned thresholds. Models without one keep their own."""
    rows = known_rows(DATA / FILES[up_to])
    tuned = {row["family"]: row["setting"] for row in rows if row.get("chosen", row["safe"])}
    return [tuned.get(path, path) for path in models("flight")]


def at_the_price_of(
    rule: str, pool: Executor, table: Experiment, models: Sequence[str], aim: Aim, episodes: int = PRICED_ON
) -> None:
    """Choose the first threshold of each model with which it makes few enough requests in each swap, and write its
    rows.

    :param rule: the rule whose requests are the measure; the table contains its rows
    :param pool: executor of the flights
    :param table: the table
    :param models: the models
    :param aim: thresholds and price
    :param episodes: number of episodes of each swap
    :raises ValueError: if a model makes too many requests with all thresholds
    """
    assert aim.price is not None
    known = {cell_of(row): row["request_share"] for row in table.rows() if row["setting"] == rule}
    limits = {cell: aim.price * known[cell] for cell in aim.cells if cell[1] in SWAPS}
    for model in models:
        for threshold in aim.thresholds:
            setting = f"{model}@{threshold:g}"
            count = len(limits)
            flown = dict(zip(limits, pool.map(fly, [setting] * count, limits, [episodes] * count), strict=True))
            rows = [row | {"chosen": True} for row in rows_of(model, setting, flown, None)]
            if all(row["request_share"] <= limits[cell_of(row)] for row in rows):
                break
        else:
            raise ValueError(f"{model} makes more than {aim.price:.0%} of the requests of {rule} with all thresholds.")
        table.keep(rows, "family", "chosen", "n_robots", "scenario")
        print(setting, *(f"{row['request_share']:.2%}" for row in rows), flush=True)


def cell_of(row: Row) -> Cell:
    """Return the number of robots and the scenario of a row."""
    return row["n_robots"], row["scenario"]


def tune(
    pool: Executor,
    jobs: int,
    ladders: list[list[Setting]],
    full: Flown,
    stages: Sequence[int],
    table: Experiment,
    aim: Aim = AIMS[12],
) -> None:
    """Try the settings of each ladder in order until one is safe, and write their rows. Known results are reused.

    :param pool: executor of the trials
    :param jobs: number of settings to try at a time
    :param ladders: ordered settings
    :param full: see `fly_full`
    :param stages: numbers of episodes of the stages
    :param table: the table
    :param aim: what the settings have to achieve
    """
    hardest = aim.cells[0]
    decided = {row["setting"]: row["safe"] for row in table.rows() if row["safe"] is not None}
    running: dict[Future[Trial], Setting] = {}
    collisions = Counter(k for row in table.rows() if cell_of(row) == hardest for k in row.get("collided", []))

    def following() -> Setting | None:
        busy = {setting.name for setting in running.values()}
        ladders.sort(key=lambda ladder: len(busy & {setting.name for setting in ladder}))
        for ladder in ladders:
            for setting in itertools.takewhile(lambda one: not decided.get(one.name), ladder):
                if setting.name not in decided and setting.name not in busy:
                    return setting
        return None

    while True:
        while len(running) < jobs and (setting := following()):
            hard = [k for k, _ in collisions.most_common(HARDEST)]
            running[pool.submit(try_out, setting.name, full, stages, hard, aim)] = setting
        if not running:
            return
        for done in wait(running, return_when=FIRST_COMPLETED).done:
            setting = running.pop(done)
            trial = done.result()
            decided[setting.name] = trial.safe
            collisions.update(trial.collided)
            rows = rows_of(*setting, trial.flown, trial.safe, trial.selected, aim.preset)
            for row in rows:
                row |= {"collided": trial.collided} if cell_of(row) == hardest else {}
            table.keep(rows)
            print(f"{setting.name:50} {verdict(trial, full, hardest)}", flush=True)


def verdict(trial: Trial, full: Flown, hardest: Cell) -> str:
    """Describe in which cell a setting turned out not to be safe."""
    flown = trial.flown
    if trial.safe:
        return "safe"
    if trial.selected:
        return f"{len(trial.collided)} of {len(flown[hardest])} in which others collided"
    excess = {c: sum(a["collided"] - b["collided"] for a, b in zip(flown[c], full[c], strict=False)) for c in flown}
    cell = max(excess, key=lambda cell: excess[cell])
    collisions = sum(bool(row["collided"]) for row in flown[cell])
    return f"{collisions} of {len(flown[cell])} in {cell[1]} of {cell[0]}"


def main() -> None:
    """Run the command line."""
    parser = command_line(__doc__, "fly few episodes")
    parser.add_argument("what", choices=("rules", "thresholds"))
    parser.add_argument("models", nargs="*", metavar="MODEL.zip")
    parser.add_argument("--preset", choices=(PRESET, VERSION_2.preset), default=PRESET, help="the world")
    parser.add_argument("--up-to", type=int, choices=AIMS, default=UP_TO, help="number of robots of the largest team")
    parser.add_argument(
        "--json",
        type=absolute_path,
        metavar="FILE",
        help=f"default: {', '.join((*FILES.values(), VERSION_2_FILE))} in {DATA}",
    )
    args = parser.parse_args()
    aim, name = AIMS[args.up_to], FILES[args.up_to]
    if args.preset == VERSION_2.preset:
        if args.what != "rules":
            parser.error("thresholds of version 2 are chosen on other sets: only rules are tuned in it")
        aim, name = VERSION_2, VERSION_2_FILE
    table = table_of(args.json or DATA / name)
    if args.what == "thresholds" and not args.models:
        parser.error("pass the models whose thresholds should be tuned")
    stages = QUICK_STAGES if args.quick else STAGES
    with workers(args) as pool:
        full = fly_full(pool, table, stages, aim)
        if args.what == "thresholds" and aim.price is not None:
            rule = cheapest_rule(table.rows()) or parser.error(f"{table.path} holds no safe rule: tune the rules first")
            at_the_price_of(rule, pool, table, args.models, aim, stages[0] if args.quick else PRICED_ON)
            return
        if args.what == "rules":
            ladders = [by_requests(pool, table, stages, args.quick, max(aim.sizes), aim.preset)]
        else:
            ladders = [[Setting(model, f"{model}@{t:g}") for t in aim.thresholds] for model in args.models]
        tune(pool, args.jobs, ladders, full, stages, table, aim)


if __name__ == "__main__":
    main()
