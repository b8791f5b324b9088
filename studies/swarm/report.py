"""Write tables and figures into the results pages: ``python -m studies.swarm.report [--data FOLDER]``.

Tables are between ``<!-- NAME -->`` and ``<!-- end -->``; the text around them is handwritten. The data come from the
other modules of this study.
"""

from __future__ import annotations

import argparse
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quad_swarm.evaluation.flight import Flight
from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison, newcombe_interval
from quad_swarm.evaluation.policies import is_model
from quad_swarm.evaluation.rows import read_rows
from quad_swarm.plants.base import MODEL
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import PRESETS
from quad_swarm.world.scenarios import MOST_OBSTACLES
from studies.swarm.commitment import BEST_RULE
from studies.swarm.experiment import absolute_path
from studies.swarm.figures import (
    NAMES,
    as_shipped,
    by_policy,
    draw_asking,
    draw_expectations,
    draw_flight_fronts,
    draw_fronts,
    draw_telling,
    draw_trajectories,
    draw_version_2,
    flights,
    hardest,
    merged,
    rate_of,
)
from studies.swarm.fly import PAPERS
from studies.swarm.protocol import DATA, OF_TEAM, ROOT, best_rules, models
from studies.swarm.tune_flight import FULL, SWAPS, best_rule
from studies.swarm.version2 import (
    BOLDER,
    BRAKING,
    CHEAP_RULES,
    ELSEWHERE,
    IMITATION_2,
    IMITATION_3,
    LOWER,
    MASK_ONLY,
    MOST,
    ORCA,
    OWN_MODEL,
    PEERS,
    PPO_2,
    PPO_3,
    SIZES,
    STRANGE,
    THIRD,
    THIRD_POLICIES,
    TIMELY,
    TIMELY_POLICIES,
    named,
)

APPENDICES = ("paper_worlds", "swarm_tables", "flight_tables", "teams", "robustness", "asking")
RESULTS = ("results", "lab_notebook", *(f"results/{name}" for name in APPENDICES))
FLIGHT = ("flight", "flight_policies", "flight_experiments", "anticipation")
PAGES = (
    ROOT / "README.md",
    *(ROOT / "docs" / f"{page}.md" for page in (*RESULTS, "swarm_learning", *FLIGHT, "obstacles", "simulators")),
)
IMAGES = ROOT / "docs" / "images"
VERSION_2 = ROOT / "studies" / "data"
Rows = list[dict[str, Any]]
# With which the best one was found; `families` has no longer the 56 of them that only a simulation can fly
RULES_TRIED = 538


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table in Markdown."""
    body = list(rows)
    if not body:
        return "Not flown yet."
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# What models are called in tables, by the names of their files; others by these names
CALLED = {
    "faithful": "the paper's settings",
    "faithful_flight": "the paper's settings",
    "ablation_approach": "without approach features",
    "ablation_credit": "without pair credit",
    "ablation_structure": "without pair networks",
}


def label(policy: str) -> str:
    """Return the name of a policy in tables."""
    if not is_model(policy):
        return f"`{policy}`".replace("|", "\\|")
    path, _, threshold = policy.partition("@")
    recipe, _, seed = Path(path).stem.partition("_seed")
    return CALLED.get(recipe, recipe) + f", seed {seed}" * bool(seed) + f", δ = {threshold}" * bool(threshold)


def rate(row: dict[str, Any]) -> str:
    """Format collisions with their interval."""
    low, high = 100 * row["collision_low"], 100 * row["collision_high"]
    return f"{row['collisions']}/{row['episodes']} [{low:.2f}, {high:.2f}] %"


def versus(row: dict[str, Any], rival: str) -> str:
    """Format the paired difference of collision rates."""
    against = row[f"against_{rival}"]
    if against["rival"] == row["policy"]:
        return "-"
    sign = "**" if against["as_safe"] and rival == "full" else ""
    return f"{sign}[{100 * against['low']:+.2f}, {100 * against['high']:+.2f}]{sign}, p = {against['p_value']:.2g}"


def depths(row: dict[str, Any], where: str = "") -> str:
    """Format the numbers of collisions deeper than the tolerance of 1 mm, than 1 cm and than 3 cm."""
    counts = (row[f"collisions{where}"], row.get(f"collisions{where}_1cm"), row.get(f"collisions{where}_3cm"))
    return " / ".join("?" if count is None else str(count) for count in counts)


def main_table(rows: Rows, preset: str) -> str:
    """Format all policies of a preset in all scenarios."""
    chosen = [row for row in rows if row["preset"] == preset and "ablation" not in row["policy"]]
    chosen.sort(key=lambda row: NAMES.index(row["scenario"]))
    head = ["scenario", "policy", "collisions, 95 %", "> 1 mm / 1 cm / 3 cm", "the same, also between steps"]
    head += ["against full (points)", "against the rule", "requests", "of the rule's", "arrived", "steps", "path (m)"]
    lines = []
    for row in chosen:
        key = (row["scenario"], row["against_rule"]["rival"])
        rule = next(r for r in chosen if (r["scenario"], r["policy"]) == key)
        ratio = f"{row['request_share'] / rule['request_share']:.0%}" if rule["request_share"] else "-"
        steps, path = row["steps_to_arrival"], row["path_length"]
        line = [row["scenario"].replace("_", " "), label(row["policy"]), rate(row), depths(row)]
        line += [depths(row, "_continuous"), versus(row, "full"), versus(row, "rule"), f"{row['request_share']:.2%}"]
        line += [ratio, f"{row['arrived']}/{row['episodes']}", "-" if steps is None else f"{steps:.1f}"]
        lines.append([*line, "-" if path is None else f"{path:.2f}"])
    return table(head, lines)


def worse_table(rows: Rows) -> str:
    """Format the cases in which a learned policy is significantly worse than full communication, though within the
    margin."""
    lines = []
    for row in rows:
        against = row["against_full"]
        if is_model(row["policy"]) and against["as_safe"] and against["low"] > 0 and against["p_value"] < 0.01:
            line = [row["preset"], row["scenario"].replace("_", " "), label(row["policy"])]
            line += [str(against["only_policy"]), str(against["only_rival"]), str(row["episodes"])]
            lines.append([*line, f"[{100 * against['low']:+.2f}, {100 * against['high']:+.2f}]"])
    head = [
        "preset",
        "scenario",
        "policy",
        "only the policy collides",
        "only `full`",
        "episodes",
        "difference (points)",
    ]
    return table(head, lines)


def faithful_table(rows: Rows) -> str:
    """Format the paper's settings by seed: collisions, those deeper than 1 cm, and requests."""
    chosen = [row for row in rows if row["preset"] == "paper" and "faithful" in row["policy"]]
    policies = list(dict.fromkeys(row["policy"] for row in chosen))
    lines = []
    for policy in policies:
        line = [Path(policy).stem.removeprefix("faithful_seed")]
        for name in NAMES:
            row = next(r for r in chosen if (r["policy"], r["scenario"]) == (policy, name))
            deeper = row.get("collisions_1cm")
            depth = "" if deeper is None else f" ({deeper / row['episodes']:.1%})"
            line.append(f"{rate_of(row):.1%}{depth}, {row['request_share']:.0%}")
        lines.append(line)
    return table(["seed", *(name.replace("_", " ") for name in NAMES)], lines)


def overview_table(rows: Rows) -> str:
    """Format an overview of four robots: collisions, in brackets those deeper than 1 cm, and requests, with seeds as
    ranges."""
    chosen = [row for row in rows if row["preset"] == "paper"]
    groups = {f"`{name}`": [name] for name in ("none", "full", "distance:4", "cpa:0.7:1.5")}
    for what, recipe in {"the paper's settings": "faithful", "`quad_swarm_paper.yml`": "paper"}.items():
        groups[f"MADDPG, {what}, {len(models(recipe))} seeds"] = models(recipe)
    lines = []
    for what, policies in groups.items():
        by_scenario = ([r for r in chosen if r["policy"] in policies and r["scenario"] == name] for name in NAMES)
        lines.append([what, *map(overview, by_scenario)])
    return table(["policy", *(name.replace("_", " ") for name in NAMES)], lines)


def overview(rows: Rows) -> str:
    """Format an overview of rows of one scenario."""
    if not rows:
        return "-"
    rates, deeper, shares = (
        [f"{float(f'{100 * value:.2g}'):g} %" for value in sorted(values)]
        for values in (
            map(rate_of, rows),
            (row["collisions_1cm"] / row["episodes"] for row in rows),
            (row["request_share"] for row in rows),
        )
    )
    return f"{spread(rates)} ({spread(deeper)}), asks {spread(shares)}"


def counts_table(rows: Rows) -> str:
    """Format the paper's comparison: requests in whole episodes, compared with full communication and 4-DBCP."""
    lines = []
    for name in NAMES:
        here = {row["policy"]: row for row in rows if row["scenario"] == name}
        if not here:
            continue
        full, dbcp = here["full"], here["distance:4"]
        groups = {"`full`": [full], "4-DBCP (`distance:4`)": [dbcp], "`none`": [here["none"]]}
        for what, pattern in {"the paper's settings": "/faithful_", "own recipe": "/paper_seed"}.items():
            if members := [row for policy, row in here.items() if pattern in policy]:
                groups[f"{what}, {len(members)} seeds"] = members
        for what, members in groups.items():
            episode = [r["requests_flown"] / r["episodes"] for r in members]
            lines.append(
                [
                    name.replace("_", " "),
                    what,
                    spread([f"{value:.0f}" for value in sorted(episode)]),
                    spread([f"{1 - r['requests_flown'] / full['requests_flown']:.0%}" for r in by_requests(members)]),
                    spread([f"{1 - r['requests_flown'] / dbcp['requests_flown']:.0%}" for r in by_requests(members)]),
                    spread([f"{rate_of(r):.1%}" for r in sorted(members, key=rate_of)]),
                ]
            )
    head = ["scenario", "policy", "requests an episode", "fewer than `full`", "fewer than 4-DBCP"]
    return table([*head, "episodes with a collision"], lines)


def by_requests(rows: Rows) -> Rows:
    """Sort rows by decreasing number of requests."""
    return sorted(rows, key=lambda row: -row["requests_flown"])


def spread(values: Sequence[str]) -> str:
    """Format the first and the last of some values."""
    return values[0] if values[0] == values[-1] else f"{values[0]} to {values[-1]}"


def checkpoints_table(rows: Rows) -> str:
    """Format the comparison of models from different times of a training with the paper's settings."""
    lines = []
    for kind, choice in dict.fromkeys((row["run"].partition("_")[0], row["choice"]) for row in rows):
        line = ["constant" if kind == "faithful" else "falls to 0", choice]
        for name in NAMES:
            mine = [
                row
                for row in rows
                if (row["run"].startswith(kind), row["choice"], row["scenario"]) == (True, choice, name)
            ]
            rates, shares = sorted(map(rate_of, mine)), sorted(row["request_share"] for row in mine)
            mean = sum(rates) / len(rates)
            line.append(f"{rates[0]:.1%} to {rates[-1]:.1%} ({mean:.1%}), {shares[0]:.0%} to {shares[-1]:.0%}")
        lines.append(line)
    return table(["learning rate", "model taken", *(name.replace("_", " ") for name in NAMES)], lines)


def pooled(rows: Rows) -> float:
    """Return the requests of all rows as a fraction of the possible requests."""
    return sum(row["requests"] for row in rows) / max(sum(row["possible_requests"] for row in rows), 1)


def targets(rows: Rows) -> str:
    """Format the targets and the results of each seed."""
    lines = []
    for preset in ("paper", "dense"):
        learned = [row for row in rows if row["preset"] == preset and f"/{preset}_seed" in row["policy"]]
        for path in dict.fromkeys(row["policy"].partition("@")[0] for row in learned):
            one = {row["scenario"]: row for row in learned if row["policy"] == path}
            own = {row["scenario"]: row for row in learned if row["policy"].startswith(f"{path}@")}
            for how, mine in (("one for all", one), ("tuned", one | own)):
                ratios = [f"{mine[name]['request_share'] / share_of_rule(rows, mine[name]):.0%}" for name in NAMES]
                safe = sum(mine[name]["against_full"]["as_safe"] for name in NAMES)
                saved = 1 - pooled(list(mine.values()))
                lines.append([label(path), how, f"{safe} of {len(NAMES)}", *ratios, f"{saved:.1%}"])
        rules = [row for row in rows if row["preset"] == preset and row["policy"] == row["against_rule"]["rival"]]
        if rules:
            saved = 1 - pooled(rules)
            safe = sum(row["against_full"]["as_safe"] for row in rules)
            lines.append([f"{preset}, rules", "tuned", f"{safe} of {len(NAMES)}", *["100%"] * 4, f"{saved:.1%}"])
    head = ["policy", "threshold", "within the margin in"]
    head += [f"{name.replace('_', ' ')}: requests, of the rule's" for name in NAMES]
    return table([*head, "all scenarios: fewer than full"], lines)


def share_of_rule(rows: Rows, row: dict[str, Any]) -> float:
    """Return the request share of the rule that a policy is compared with."""
    key = (row["preset"], row["scenario"], row["against_rule"]["rival"])
    return next(r["request_share"] for r in rows if (r["preset"], r["scenario"], r["policy"]) == key)


def family_table(rules: Rows, preset: str) -> str:
    """Format the safe rule of each family with the fewest requests on the validation set."""
    names = list(dict.fromkeys(row["family"] for row in rules if row["preset"] == preset))
    lines = []
    for family in names:
        line = [family]
        for name in NAMES:
            safe = [
                r for r in rules if (r["preset"], r["scenario"], r["family"]) == (preset, name, family) and r["safe"]
            ]
            best = min(safe, key=lambda r: r["request_share"], default=None)
            line.append(f"{best['request_share']:.2%} {label(best['rule'])}" if best else "none is safe")
        lines.append(line)
    return table(["family", *(name.replace("_", " ") for name in NAMES)], lines)


def wide_table(rows: Rows, first: str, preset: str) -> str:
    """Format collisions and requests of all policies, with a column per scenario."""
    chosen = [row for row in rows if row["preset"] == preset]
    kinds = dict.fromkeys((row[first], kind_of(row)) for row in chosen)
    lines = []
    for value, kind in kinds:
        line = [str(value), kind]
        for name in NAMES:
            row = next((r for r in chosen if r[first] == value and r["scenario"] == name and kind_of(r) == kind), None)
            line.append(f"{row['collisions']}/{row['episodes']}, {row['request_share']:.1%}" if row else "-")
        lines.append(line)
    return table([first.replace("_", " "), "policy", *(name.replace("_", " ") for name in NAMES)], lines)


def teams_table(rows: Rows) -> str:
    """Format each number of robots: collisions and requests, in bold if at most half a percentage point less safe than
    full communication, the ratio to the best rule's requests, and the models' thresholds."""
    lines = []
    for n in dict.fromkeys(row["n_robots"] for row in rows):
        cells: dict[str, dict[str, str]] = {}
        for name in NAMES:
            here = {row["policy"]: row for row in rows if (row["n_robots"], row["scenario"]) == (n, name)}
            if not here:
                continue
            rule = here["full"]["against_rule"]["rival"]
            for policy, row in here.items():
                path, _, threshold = policy.partition("@")
                kind = label(path) if is_model(policy) else "best rule"
                mark = "**" if policy != "full" and row["against_full"]["high"] < OF_TEAM.margin else ""
                text = f"{mark}{row['collisions']}/{row['episodes']}, {row['request_share']:.2%}{mark}"
                if is_model(policy):
                    text += f" ({row['request_share'] / max(here[rule]['request_share'], 1e-9):.0%}), δ = {threshold}"
                cells.setdefault("`full`" if policy == "full" else kind, {})[name] = text
                if policy == rule == "full":  # no rule is safe, or none was tuned
                    cells.setdefault("best rule", {})[name] = "none is safe"
        lines += [[str(n), kind, *(by_name.get(name, "-") for name in NAMES)] for kind, by_name in cells.items()]
    return table(["robots", "policy", *(name.replace("_", " ") for name in NAMES)], lines)


def unseen_table(rows: Rows) -> str:
    """Format policies in scenarios without any training or tuning."""
    lines = []
    for row in rows:
        line = [row["preset"], row["scenario"].replace("_", " "), label(row["policy"]), rate(row), versus(row, "full")]
        lines.append([*line, f"{row['request_share']:.2%}"])
    return table(["preset", "scenario", "policy", "collisions, 95 %", "against full (points)", "requests"], lines)


def worlds_table(rows: Rows, part: str) -> str:
    """Format a part of the rows in disturbed worlds: contact at any time, with the changes to the worlds.
    The columns of the world, the changes and the policy are left out if they are the same in all rows."""
    columns: dict[str, list[str]] = {}
    for row in rows:
        if row["part"] == part:
            steps = row["steps_to_arrival"]
            cells = {
                "world": row["preset"],
                "changed": changes(row["changed"]),
                "scenario": row["scenario"].replace("_", " "),
                "policy": f"`{row['policy']}`",
                "collisions, 95 %": rate(row),
                "at steps": str(row["collisions_at_steps"]),
                "closest, 1 % quantile (m)": f"{row['min_separation_quantiles']['0.01']:.2f}",
                "arrived": f"{row['arrived']}/{row['episodes']}",
                "steps": "-" if steps is None else f"{steps:.1f}",
            }
            for name, cell in cells.items():
                columns.setdefault(name, []).append(cell)
    for name in ("world", "changed", "policy"):
        if len(set(columns.get(name, []))) == 1:
            del columns[name]
    lines = [list(line) for line in zip(*columns.values(), strict=True)]
    return table(list(columns), lines) if lines else "Not flown yet."


def plants_table(rows: Rows) -> str:
    """Format the part `plants` of `studies.swarm.fly`: collisions, arrivals and requests by policy."""
    chosen = [row for row in rows if row["part"] == "plants"]
    policies = list(dict.fromkeys(row["policy"] for row in chosen))
    lines: dict[tuple[str, str, float], dict[str, str]] = {}
    for row in chosen:
        changed = row["changed"]
        key = changed["plant"], changed["quadrotor"], changed["planner"]["separation"]
        text = f"{rate(row)}, {row['arrived'] / row['episodes']:.1%} arrive"
        if row["policy"] not in ("none", "full"):
            text += f", {row['request_share']:.2%} asked"
        lines.setdefault(key, {})[row["policy"]] = text
    return table(
        ["simulator", "planner's model", "separation (m)", *map(label, policies)],
        [[*map(str, key), *(cells.get(policy, "-") for policy in policies)] for key, cells in sorted(lines.items())],
    )


def against(row: dict[str, Any], rival: dict[str, Any]) -> Comparison:
    """Compare the outcomes of the same episodes."""
    pairs = [[{"collided": letter == "1"} for letter in one["outcomes"]] for one in (row, rival)]
    return Comparison.of(*pairs)


def flight_groups(rows: Rows) -> Iterator[tuple[int, str, dict[str, dict[str, Any]]]]:
    """Group the sealed flights of `flight`: yield the number of robots, the scenario, and the rows by policy."""
    for n_robots in sorted({row["n_robots"] for row in rows}):
        for name in NAMES:
            here = {r["policy"]: r for r in rows if (r["n_robots"], r["scenario"]) == (n_robots, name)}
            if "full" in here:
                yield n_robots, name, here


def rule_of(here: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Return the row of the tuned rule, if it was flown."""
    return next((row for policy, row in here.items() if not is_model(policy) and policy not in ("none", "full")), None)


def flight_table(rows: Rows) -> str:
    """Format all policies in `flight`, in teams of all sizes."""
    lines = []
    for n_robots, name, here in flight_groups(rows):
        rule = rule_of(here)
        for policy, row in here.items():
            low, high = against(row, here["full"]).interval
            sign = "**" if high < SAFETY_MARGIN else ""
            difference = "-" if policy == "full" else f"{sign}[{100 * low:+.2f}, {100 * high:+.2f}]{sign}"
            ratio = f"{row['request_share'] / rule['request_share']:.0%}" if rule else "-"
            steps = row["steps_to_arrival"]
            line = [str(n_robots), name.replace("_", " "), label(policy), rate(row), str(row["collisions_at_steps"])]
            line += [difference, f"{row['request_share']:.2%}", ratio, f"{row['bytes_per_second']:.0f}"]
            lines.append([*line, f"{row['arrived']}/{row['episodes']}", "-" if steps is None else f"{steps:.1f}"])
    head = ["robots", "scenario", "policy", "collisions, 95 %", "at steps", "against full (points)", "requests"]
    return table([*head, "of the rule's", "B/s", "arrived", "steps"], lines)


def swaps_table(rows: Rows) -> str:
    """Format the collisions and requests in both swaps, one row per number of robots and policy."""
    lines: dict[tuple[int, str], list[str]] = {}
    for n_robots, name, here in flight_groups(rows):
        if name in SWAPS:
            rule = rule_of(here)
            for policy, row in here.items():
                difference = against(row, here["full"])
                low, high = (f"{100 * end:+.2f}" for end in difference.interval)
                sign = "**" if difference.as_safe() else ""
                texts = [f"{row['collisions']}/{row['episodes']}", f"{sign}[{low}, {high}]{sign}"]
                texts[1] = "-" if policy == FULL else texts[1]
                requests = f"{row['request_share']:.2%}"
                if rule is not None and policy != FULL:
                    requests += f" ({row['request_share'] / rule['request_share']:.0%})"
                lines.setdefault((n_robots, policy), []).extend([*texts, requests])
    names = [name.replace("_", " ") for name in SWAPS]
    head = [text for name in names for text in (f"{name}: collisions", "against full (points)", "requests")]
    return table(["robots", "policy", *head], [[str(n), label(one), *texts] for (n, one), texts in lines.items()])


def flight_targets(rows: Rows) -> str:
    """Format in how many scenarios of `flight` each policy is as safe as full communication, and its requests."""
    lines: dict[tuple[int, str], list[Any]] = {}
    for n_robots, name, here in flight_groups(rows):
        rule = rule_of(here)
        for policy, row in here.items():
            if rule is None or policy in ("none", "full"):
                continue
            safe, ratios = lines.setdefault((n_robots, policy), [[], {}])
            safe.append(against(row, here["full"]).as_safe())
            ratios[name] = f"{row['request_share']:.2%} ({row['request_share'] / rule['request_share']:.0%})"
    return table(
        ["robots", "policy", "as safe as full in", *(name.replace("_", " ") for name in NAMES)],
        [
            [str(n), label(policy), f"{sum(safe)} of {len(safe)}", *(ratios.get(name, "-") for name in NAMES)]
            for (n, policy), (safe, ratios) in lines.items()
        ],
    )


def tuned_table(rows: Rows) -> str:
    """Return the validation figures of the settings for `flight` that are as safe as full communication everywhere."""
    cells = dict.fromkeys((row["n_robots"], row["scenario"]) for row in rows if row["family"] != FULL and row["safe"])
    lines = []
    for setting in dict.fromkeys(row["setting"] for row in rows if row["safe"]):
        here = {(row["n_robots"], row["scenario"]): row for row in rows if row["setting"] == setting}
        texts = [f"{here[c]['collisions']}/{here[c]['episodes']}, {here[c]['request_share']:.2%}" for c in cells]
        lines.append([label(setting), *texts])
    return table(["", *(f"{n} robots, {name.replace('_', ' ')}" for n, name in cells)], lines)


def headline_table(rows: Rows, best: str) -> str:
    """Format the sealed flights of `flight` in five rows: eight robots, except for the paper's settings; seeds as
    ranges. Plans and bytes are those of all four scenarios.

    :param rows: rows of the sealed flights
    :param best: the tuned rule
    """
    eight, four = ([row for row in rows if row["n_robots"] == n] for n in (8, 4))
    rule = f"best of {RULES_TRIED} hand-made rules"
    groups = {
        "nobody asks (`none`)": [row for row in eight if row["policy"] == "none"],
        "everybody asks everybody (`full`)": [row for row in eight if row["policy"] == "full"],
        rule: [row for row in eight if row["policy"] == best],
        "MADDPG, the paper's settings (four robots)": [row for row in four if f"/{PAPERS}_seed" in row["policy"]],
        "MADDPG, `quad_swarm_flight.yml`": [row for row in eight if "/flight_seed" in row["policy"]],
    }
    lines = []
    for what, chosen in groups.items():
        policies = dict.fromkeys(row["policy"] for row in chosen)
        line = [what + (f", {len(policies)} seeds" if len(policies) > 1 else "")]
        for name in ("symmetric_swap", "asymmetric_swap"):
            line.append(seeds_rate([row for row in chosen if row["scenario"] == name]))
        by_seed = [[row for row in chosen if row["policy"] == policy] for policy in policies]
        line.append(spread([f"{share:.2%}" for share in sorted(map(pooled, by_seed))]) if chosen else "-")
        sent = sorted(float(np.mean([row["bytes_per_second"] for row in one])) for one in by_seed)
        lines.append([*line, spread([f"{value:,.0f}" for value in sent]) if chosen else "-"])
    head = ["", "collisions, symmetric swap", "collisions, asymmetric swap"]
    return table([*head, "plans sent, of all possible, all scenarios", "bytes/s a robot sends, all scenarios"], lines)


def of_version_2(rows: Rows, n_robots: int, page: str) -> dict[str, Rows]:
    """Group the sealed flights of the symmetric swap in `flight-v2` by who sends plans, with a row for each policy.

    :param rows: rows of `studies.swarm.version2`; those of several sets, and of training seeds, are counted together
    :param n_robots: number of robots
    :param page: address of the planner's page
    """
    here = [row for row in rows if hardest(row, n_robots) and row["plant"] == MODEL]
    learned = [row for row in here if as_shipped(row["policy"])]
    seeds = len({row["policy"] for row in learned})
    named_alike = {
        "nobody tells anybody": "none",
        "everybody tells everybody": FULL,
        f"[ORCA]({page}#without-messages-orca-and-voronoi-cells)": ORCA,
        f"best of {RULES_TRIED} rules, found in version 1": BEST_RULE,
    }
    named_alike |= {f"`{rule}`": rule for rule in CHEAP_RULES}
    groups = {what: [row for row in here if row["policy"] == policy] for what, policy in named_alike.items()}
    groups["all whom the action mask allows"] = [row for row in here if row["policy"] == named(MASK_ONLY)]
    groups["**learned**" + (f", {seeds} training seeds together" if seeds > 1 else "")] = learned
    groups["learned, training seed 0 at a threshold of 0.5"] = [row for row in here if row["policy"] == named(BOLDER)]
    return {what: chosen for what, chosen in groups.items() if chosen}


def glance_table(rows: Rows, page: str) -> str:
    """Format the symmetric swap of eight robots in the sealed flights of `flight-v2`: what it is worth, what it costs.
    See `of_version_2`.

    :param page: address of the planner's page
    """
    groups = of_version_2(rows, 8, page)
    full = merged(groups["everybody tells everybody"])["steps_to_arrival"]
    lines = []
    for what, chosen in groups.items():
        each = by_policy(chosen)
        sent = sorted(one["request_share"] for one in each)
        later = spread([f"+{time / full - 1:.0%}" for time in sorted(one["steps_to_arrival"] for one in each)])
        if what == "nobody tells anybody":  # only those arrive there that met nobody
            later = "-"
        elif chosen[0]["policy"] == FULL:
            later = f"{full * PRESETS['flight-v2'].planner.dt:.1f} s"
        lines.append([what, seeds_rate([merged(chosen)]), spread([f"{share:.1%}" for share in sent]), later])
    return table(["", "flights with a collision", "plans sent", "time to arrival"], lines)


def version_2_table(rows: Rows) -> str:
    """Format the symmetric swap of eight and sixteen robots in the sealed flights of `flight-v2`, with the sets that
    are counted, without the cheap rules and the mask. See `of_version_2`."""
    lines = []
    for n in (8, 16):
        for what, chosen in of_version_2(rows, n, "planner.md").items():
            each = by_policy(chosen)
            if each[0]["policy"] in (*CHEAP_RULES, named(MASK_ONLY)):
                continue
            times = sorted(float(one["steps_to_arrival"]) for one in each if one["steps_to_arrival"])
            if 2 * merged(chosen)["collisions"] > merged(chosen)["episodes"]:  # only those arrive that met nobody
                times = []
            lines.append(
                [
                    str(n),
                    what,
                    seeds_rate([merged(chosen)]).replace("<br>", "&nbsp;"),
                    f"{min(row['min_separation_quantiles']['0.01'] for row in chosen):.2f}",
                    spread([f"{share:.1%}" for share in sorted(one["request_share"] for one in each)]),
                    spread([f"{time:.0f}" for time in times]) if times else "-",
                    ", ".join(map(str, sorted({row["set"] for row in chosen}))),
                ]
            )
    return table(["robots", "who sends", "collided", "near (m)", "plans sent", "steps", "sets"], lines)


def cells_table(rows: Rows) -> str:
    """Format the flights of the packaged model of `flight-v2` by scenario and number of robots, and below them those of
    all training seeds together, if there are others.

    :param rows: rows of `studies.swarm.version2`. Flights among obstacles count from the braking reserve on
    """
    flown = [row for row in rows if row["plant"] == MODEL and (row["scenario"] in NAMES or row["set"] >= BRAKING)]
    cells: dict[tuple[str, int], Rows] = {}
    for row in flown:
        cells.setdefault((row["scenario"], row["n_robots"]), []).append(row)
    sizes = sorted({n for _, n in cells})
    lines = []
    for name in (*NAMES, *MOST_OBSTACLES):
        line, everybody = [name.replace("_", " ")], []
        for n in sizes:
            full = merged([row for row in cells[name, n] if row["policy"] == FULL])
            own = merged([row for row in cells[name, n] if row["policy"] == named(OWN_MODEL)])
            seeds = [row for row in cells[name, n] if as_shipped(row["policy"])]
            later = f"{own['steps_to_arrival'] / full['steps_to_arrival'] - 1:+.0%}".replace("-0%", "+0%")
            text = f"{judged(own, full)}; {own['request_share']:.1%}, {later}"
            if len(each := by_policy(seeds)) > 1:
                together = merged(seeds)
                sent = spread([f"{share:.1%}" for share in sorted(one["request_share"] for one in each)])
                text += f"<br>*{len(each)} seeds:* {judged(together, full)} of {together['episodes']:,}; {sent}"
            line.append(text.replace(" ", "&nbsp;"))
            everybody.append(full)
        flights = sum(one["episodes"] for one in everybody)
        lines.append([*line, f"{sum(one['collisions'] for one in everybody)} of {flights:,}".replace(" ", "&nbsp;")])
    return table(["scenario", *(f"{n} robots" for n in sizes), "full, all sizes"], lines)


def front_table(second: Rows, third: Rows, page: str) -> str:
    """Format the symmetric swap of eight and sixteen robots at a glance: how others are predicted, who sends, what it
    costs. A cell has the flights with a collision, their interval, the share of plans sent, and the time to arrival
    beside full communication.

    :param second: rows of `studies.swarm.version2` in `flight-v2`
    :param third: those in `flight-v3`
    :param page: address of the planner's page
    """

    def flown(rows: Rows, policy: str, n: int) -> dict[str, Any] | None:
        here = [row for row in rows if hardest(row, n) and row["plant"] == MODEL and row["set"] != ELSEWHERE]
        chosen = [row for row in here if row["policy"] == named(policy)]
        return merged(chosen) if chosen else None

    def cell(row: dict[str, Any] | None, full: dict[str, Any] | None) -> str:
        if row is None:
            return ""
        parts = [seeds_rate([row]), f"{row['request_share']:.2%}&nbsp;sent"]
        if row is full:
            parts.append(f"{full['steps_to_arrival'] * PRESETS['flight-v3'].planner.dt:.1f}&nbsp;s")
        # Of those that collide mostly, only those arrive that met nobody
        elif full is not None and 2 * row["collisions"] < row["episodes"]:
            parts.append(f"{row['steps_to_arrival'] / full['steps_to_arrival'] - 1:+.0%}".replace("-0%", "+0%"))
        return "<br>".join([parts[0], ",&nbsp;".join(parts[1:])])

    sizes = (8, 16)
    everybody = {n: flown(third, FULL, n) for n in sizes}
    orca = f"[ORCA]({page}#without-messages-orca-and-voronoi-cells) (`flight-v2`)"
    lines = []
    for predicted, who, rows, policy in (
        ("planning at constant velocities (`flight-v2`)", "nobody", second, "none"),
        (orca, "nobody", second, ORCA),
        ("network, keeping right (`flight-v3`)", "nobody", third, "none"),
        (
            "network, keeping right (`flight-v3`)",
            f"rule: who passes near tells its plan if it is not expected (`{THIRD_POLICIES['rule']}`)",
            third,
            THIRD_POLICIES["rule"],
        ),
        ("network, keeping right (`flight-v3`)", "**learned**", third, THIRD_POLICIES["model"]),
        ("network, keeping right (`flight-v3`)", "everybody", third, FULL),
    ):
        found = {n: everybody[n] if policy == FULL else flown(rows, policy, n) for n in sizes}
        if any(found.values()):
            lines.append([predicted, who, *(cell(found[n], everybody[n]) for n in sizes)])
    return table(["how they avoid each other", "who sends", "eight robots", "sixteen robots"], lines)


def anticipation_table(rows: Rows, flown: Mapping[str, str] = THIRD_POLICIES, marked: bool = True) -> str:
    """Format the flights in `flight-v3` by scenario and number of robots: who collides if nobody sends anything, by a
    rule, and with a model. Without flights of full communication, they are not compared.

    :param rows: rows of `studies.swarm.version2` in that preset
    :param flown: the policies "none", "rule" and "model"
    :param marked: whether to mark who is not within the margin of full communication
    """
    cells = {(row["scenario"], row["n_robots"], row["policy"]): row for row in rows}
    sizes = sorted({row["n_robots"] for row in rows})
    policies = {"nobody": flown["none"], "rule": flown["rule"], "model": named(flown["model"])}
    lines = []
    for name in (*NAMES, *MOST_OBSTACLES):
        line = [name.replace("_", " ")]
        for n in sizes:
            full, texts = cells.get((name, n, FULL)), []
            for who, policy in policies.items():
                if (one := cells.get((name, n, policy))) is None:
                    continue
                parts = [judged(one, full) if full is not None and marked else str(one["collisions"])]
                if policy != "none":
                    parts.append(f"{one['request_share']:.2%}")
                if full is not None:
                    parts.append(later(one, full))
                texts.append(f"*{who}:*&nbsp;" + "; ".join(parts).replace(" ", "&nbsp;"))
            line.append("<br>".join(texts))
        lines.append(line)
    return table(["scenario", *(f"{n} robots" for n in sizes)], lines)


def peers_table(second: Rows, third: Rows) -> str:
    """Format the flights of models that learned in other ways, with the networks and observations of the packaged one:
    all scenarios together, with the least and most plans sent and time to arrival of a scenario.

    :param second: rows of `studies.swarm.version2` in `flight-v2`. Flights among obstacles count from the braking
        reserve on
    :param third: those in `flight-v3`
    """
    second = [row for row in second if row["scenario"] in NAMES or row["set"] >= BRAKING]
    third = [row for row in third if row["set"] in (THIRD, MOST, PEERS)]
    learners = {
        "`flight-v2`": (second, {"MADDPG": OWN_MODEL, "PPO": PPO_2, "imitation": IMITATION_2}),
        "`flight-v3`": (third, {"MADDPG": THIRD_POLICIES["model"], "PPO": PPO_3, "imitation": IMITATION_3}),
    }
    lines = []
    for preset, (rows, policies) in learners.items():
        flown = [row for row in rows if row["plant"] == MODEL and not row.get("changes")]
        for learner, policy in policies.items():
            line = [preset, learner]
            for n in SIZES.values():
                here = [row for row in flown if row["n_robots"] == n]
                own, full = ([row for row in here if row["policy"] == one] for one in (named(policy), FULL))
                names = {row["scenario"] for row in own}
                if not own:
                    line.append("")
                    continue
                each = [
                    [merged([row for row in part if row["scenario"] == name]) for part in (own, full)] for name in names
                ]
                shares = sorted(one["request_share"] for one, _ in each)
                times = sorted(_lateness(*pair) for pair in each)
                sent = f"{shares[0]:.2%} to {shares[-1]:.2%}"
                took = f"{times[0]:+.0%} to {times[-1]:+.0%}".replace("-0%", "+0%")
                line.append("<br>".join([seeds_rate([merged(own)]), sent, took]).replace(" ", "&nbsp;"))
            lines.append(line)
    return table(["preset", "learned by", *(f"{n} robots" for n in SIZES.values())], lines)


def _lateness(own: dict[str, Any], full: dict[str, Any]) -> float:
    return own["steps_to_arrival"] / full["steps_to_arrival"] - 1


def late_table(rows: Rows) -> str:
    """Format flights in which others are observed late or lost from sight: collisions, plans sent, and arrival beside
    full communication.

    :param rows: rows with the fields of the world under ``changes``
    """
    policies = {
        "nobody": "none",
        f"`{THIRD_POLICIES['rule']}`": THIRD_POLICIES["rule"],
        "model at 0.6": named(THIRD_POLICIES["model"]),
        "model at 0.3": named(LOWER),
        "everybody": FULL,
    }
    worlds: dict[str, Rows] = {}
    for row in rows:
        late = row["changes"]["sensing"].get("others_delay")
        seen = "lost at times" if late is None else f"{1000 * PRESETS[row['preset']].planner.dt * late:.0f} ms late"
        learned = ", and the network learned so" if "predictor" in row["changes"] else ""
        worlds.setdefault(seen + learned, []).append(row)
    lines = []
    for changed, flown in worlds.items():
        for name in dict.fromkeys(row["scenario"] for row in flown):
            here = {row["policy"]: row for row in flown if row["scenario"] == name}
            line = [changed, name.replace("_", " ")]
            for policy in policies.values():
                if (one := here.get(policy)) is None:
                    line.append("")
                    continue
                full, parts = here[FULL], [f"{one['collisions']:,}"]
                if policy not in ("none", FULL):
                    parts.append(f"{one['request_share']:.2%}")
                if policy != FULL:
                    parts.append(later(one, full))
                line.append("; ".join(parts).replace(" ", "&nbsp;"))
            lines.append(line)
    return table(["others are seen", "scenario", *policies], lines)


def later(own: dict[str, Any], full: dict[str, Any]) -> str:
    """Format the time to arrival beside full communication, of flights that arrive."""
    return f"{_lateness(own, full):+.0%}".replace("-0%", "+0%")


def judged(own: dict[str, Any], full: dict[str, Any]) -> str:
    """Format collisions, with a mark unless they are within the margin of full communication."""
    counts = [one[key] for one in (own, full) for key in ("collisions", "episodes")]
    return f"{own['collisions']}{'' if newcombe_interval(*counts)[1] < SAFETY_MARGIN else '†'}"


def obstacles_table(rows: Rows) -> str:
    """Format full communication and the packaged model of `flight-v2` among obstacles, with the braking reserve.

    :param rows: rows of `studies.swarm.version2`; those of several sets are counted together
    """
    flown = [row for row in rows if row["plant"] == MODEL and row["set"] >= BRAKING]
    lines = []
    for n, name in itertools.product(sorted({row["n_robots"] for row in flown}), MOST_OBSTACLES):
        here = [row for row in flown if (row["scenario"], row["n_robots"]) == (name, n)]
        pair = [[row for row in here if row["policy"] == policy] for policy in (FULL, named(OWN_MODEL))]
        figures = [merged(one) for one in pair]
        near = [min(row["min_separation_quantiles"]["0.01"] for row in one) for one in pair]
        beside = [min(row["min_obstacle_distance"] for row in one) for one in pair]
        both = ", ".join
        lines.append(
            [
                str(n),
                name.replace("_", " "),
                *(seeds_rate([one]) for one in figures),
                both(f"{distance:.2f}" for distance in near),
                both(f"{distance:.2f}" for distance in beside),
                f"{figures[1]['request_share']:.1%}",
                both(f"{one['arrived'] / one['episodes']:.1%}" for one in figures),
                both(f"{one['steps_to_arrival']:.0f}" for one in figures),
            ]
        )
    head = ["robots", "scenario", "full: collided", "learned: collided", "robots (m)", "obstacles (m)", "plans sent"]
    return table([*head, "arrived", "steps"], lines)


def seeds_rate(rows: Rows) -> str:
    """Format the collisions of several seeds in the same episodes, with the envelope of their intervals."""
    if not rows:
        return "-"
    counts = spread([f"{count:,}" for count in sorted(row["collisions"] for row in rows)])
    low, high = 100 * min(row["collision_low"] for row in rows), 100 * max(row["collision_high"] for row in rows)
    # Narrow columns would break lines anywhere
    lines = (f"{counts} of {rows[0]['episodes']:,}", f"[{low:.2f}, {high:.2f}] %")
    return "<br>".join(line.replace(" ", "&nbsp;") for line in lines)


def changes(changed: Any, path: str = "") -> str:
    """Format nested fields as on the command line."""
    if isinstance(changed, dict):
        return ", ".join(changes(value, f"{path}.{name}" if path else name) for name, value in changed.items()) or "-"
    return f"{path}={changed:g}" if isinstance(changed, (int, float)) else f"{path}={changed}"


def reference_table(rows: Rows, *names: str) -> str:
    """Format collisions and requests of another learner by its parameters."""
    lines = []
    for values in dict.fromkeys(tuple(row[name] for name in names) for row in rows):
        here = {row["scenario"]: row for row in rows if tuple(row[name] for name in names) == values}
        cells = [f"{here[k]['collisions']}/{here[k]['episodes']}, {here[k]['request_share']:.1%}" for k in NAMES]
        lines.append([*(f"{value:g}" for value in values), *cells])
    return table([*names, *(name.replace("_", " ") for name in NAMES)], lines)


def training_table(rows: Rows) -> str:
    """Format the duration of trainings and the shares of their parts."""
    parts = ("planner", "learner", "acting", "rest")
    lines = []
    for row in rows:
        line = [f"`{row['recipe']}`", f"{row['steps']:,}", f"{row['episodes']:,}", f"{row['updates']:,}"]
        line += [str(row["threads"]), f"{row['seconds'] / 60:.1f}"]
        lines.append([*line, *(f"{row[f'share_{part}']:.0%}" for part in parts)])
    return table(["recipe", "steps", "episodes", "updates", "threads", "minutes", *parts], lines)


def kind_of(row: dict[str, Any]) -> str:
    """Return the role of a policy in a comparison."""
    return label(row["policy"]) if is_model(row["policy"]) or row["policy"] in ("full", "none") else "best rule"


def step_by_step(flight: Flight) -> str:
    """Format a flight as a table: requests with what the robots observe, and the requests of the rule."""
    others = other_indices(flight.n_robots)
    approach, time = flight.closest_approach
    last: dict[tuple[int, int], int] = {}
    lines = []
    for k, (asked, by_rule) in enumerate(zip(flight.requests, flight.other_requests, strict=True)):
        texts = []
        for i, m in np.argwhere(asked):
            j = others[i, m]
            age = f"asked {k - last[i, j]} steps ago" if (i, j) in last else "not asked before"
            seen = f"{flight.separation[k, i, m]:.1f} m away, {approach[k, i, m]:.2f} m in {time[k, i, m]:.1f} s"
            texts.append(f"**{i} → {j}** {seen}, {age}")
            last[i, j] = k
        rule = ", ".join(f"{i} → {others[i, m]}" for i, m in np.argwhere(by_rule))
        if texts or rule:
            lines.append([str(k), f"{flight.separation[k].min():.2f}", "<br>".join(texts) or "-", rule or "-"])
    return table(["step", "closest two (m)", "asks", "the rule would ask"], lines)


def interventions_table(rows: Rows) -> str:
    """Format which additional requests avoid the collisions of a policy with too few requests."""
    steps = list(dict.fromkeys(row["last_steps"] for row in rows))
    lines = []
    for preset, who in dict.fromkeys((row["preset"], row["who"]) for row in rows):
        mine = {row["last_steps"]: row for row in rows if (row["preset"], row["who"]) == (preset, who)}
        shares = [f"{mine[k]['avoided'] / max(mine[k]['n'], 1):.0%}" for k in steps]
        lines.append([f"{preset}, {mine[steps[0]]['n']} collisions", who, *shares])
    return table(["world", "from so many steps before the collision on", *(str(k) for k in steps)], lines)


def fill(page: str, blocks: dict[str, str]) -> str:
    """Fill all places ``<!-- NAME --> ... <!-- end -->`` of a page."""

    def block(place: re.Match[str]) -> str:
        return f"<!-- {place[1]} -->\n\n{blocks[place[1]]}\n\n<!-- end -->"

    return re.sub(r"<!-- ((?!end )[\w ]+) -->\n.*?<!-- end -->", block, page, flags=re.DOTALL)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=absolute_path, default=DATA, help="folder of the rows (default %(default)s)")
    parser.add_argument("--pages", type=absolute_path, default=ROOT, help="folder of the pages (default %(default)s)")
    parser.add_argument(
        "--images", type=absolute_path, default=IMAGES, help="folder of the figures (default %(default)s)"
    )
    args = parser.parse_args()
    os.chdir(ROOT)
    names = "rules test sweep robustness unseen teams asking interventions ppo counterfactual training counts quadrants"
    rows = {
        name: read_rows(args.data / f"{name}.json.gz")
        for name in [*names.split(), "checkpoints", "flight", "flight_tuning", "flight_sixteen_sealed", "flight_world"]
    }
    rules, test, sweep, robustness, asking = (rows[k] for k in ("rules", "test", "sweep", "robustness", "asking"))
    # Those in other disturbances, or with more robots, are no part of the tables
    sealed_2 = [row for row in read_rows(VERSION_2 / "version2.json") if row["set"] != STRANGE]
    version_3 = read_rows(VERSION_2 / "version3.json")
    sealed_3 = [row for row in version_3 if row["set"] == THIRD]
    tried_2 = read_rows(VERSION_2 / "front.json")
    blocks = {
        "targets": targets(test),
        "worse": worse_table(test),
        "overview": overview_table(test),
        "faithful": faithful_table(test),
        "counts": counts_table(rows["counts"]),
        "quadrants": main_table(rows["quadrants"], "paper"),
        "checkpoints": checkpoints_table(rows["checkpoints"]),
        "paper": main_table(test, "paper"),
        "dense": main_table(test, "dense"),
        "rules paper": family_table(rules, "paper"),
        "rules dense": family_table(rules, "dense"),
        "ablations": wide_table([r for r in test if "ablation" in r["policy"]], "preset", "paper"),
        "sweep paper": wide_table([r for r in sweep if is_model(r["policy"])], "policy", "paper"),
        "sweep dense": wide_table([r for r in sweep if is_model(r["policy"])], "policy", "dense"),
        "robustness paper": wide_table(robustness, "condition", "paper"),
        "robustness dense": wide_table(robustness, "condition", "dense"),
        "interventions": interventions_table(rows["interventions"]),
        "unseen": unseen_table(rows["unseen"]),
        "teams": teams_table(rows["teams"]),
        "ppo": reference_table(rows["ppo"], "price", "threshold"),
        "counterfactual": reference_table(rows["counterfactual"], "price"),
        "training": training_table(rows["training"]),
        "headline": headline_table(rows["flight"], best_rule()) if rows["flight"] else "Not flown yet.",
        "glance": glance_table(sealed_2, "docs/planner.md"),
        "results": glance_table(sealed_2, "planner.md"),
        "version 2": version_2_table(sealed_2),
        "cells": cells_table(sealed_2),
        "obstacles": obstacles_table(sealed_2),
        "anticipation": anticipation_table(sealed_3),
        "late": late_table([row for row in version_3 if "sensing" in row.get("changes", {})]),
        "timely": anticipation_table([row for row in version_3 if row["set"] == TIMELY], TIMELY_POLICIES, marked=False),
        "peers": peers_table(sealed_2, version_3),
        "front": front_table(sealed_2, sealed_3, "docs/planner.md"),
        "front results": front_table(sealed_2, sealed_3, "planner.md"),
        "flight": flight_table(rows["flight"]),
        "flight tuning": tuned_table(rows["flight_tuning"]),
        "flight targets": flight_targets(rows["flight"]),
        "flight sixteen": swaps_table(rows["flight_sixteen_sealed"]),
        "flight sixteen targets": flight_targets(rows["flight_sixteen_sealed"]),
        "flight sixteen all": flight_table(rows["flight_sixteen_sealed"]),
        "world": worlds_table(rows["flight_world"], "world"),
        "delays": worlds_table(rows["flight_world"], "delays"),
        "delay check": worlds_table(rows["flight_world"], "delay_check"),
        "paper flight": counts_table([row for row in rows["flight_world"] if row["part"] == "paper"]),
        "plants": plants_table(rows["flight_world"]),
    }
    flown = {
        preset: flights(models(preset)[0], best_rules(preset)["symmetric_swap"], preset)
        for preset in dict.fromkeys(row["preset"] for row in asking)
    }
    for name in ("symmetric_swap", "asymmetric_swap"):
        blocks[f"told {name}"] = step_by_step(flown["paper"][name]) if "paper" in flown else "Not flown yet."
    picture = "![How often policies ask: distance, approach, time, way to go, crowd](../images/asking.png)"
    blocks["asking"] = picture if asking else "Not flown yet."
    for page in PAGES:
        target = args.pages / page.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(fill(page.read_text(), blocks))
    args.images.mkdir(parents=True, exist_ok=True)
    if rules:
        draw_fronts(rules, sweep, test, NAMES[:2], args.images / "fronts.png")
        draw_fronts(rules, sweep, test, NAMES, args.images / "fronts_all.png")
        tried = [*rows["flight_tuning"], *read_rows(args.data / "flight_sixteen.json.gz")]
        sealed = rows["flight"], rows["flight_sixteen_sealed"]
        draw_flight_fronts(tried, *sealed, args.images / "front_flight.png")
    draw_version_2(sealed_2, tried_2, args.images / "front_version_2.png")
    draw_expectations(args.images / "expectations.png")
    draw_telling(args.images / "telling.png")
    if flown:
        draw_trajectories(flown, args.images / "flights.png")
    if asking:
        draw_asking(asking, args.images / "asking.png")


if __name__ == "__main__":
    main()
