"""Tune all families of hand-made rules: find the rule with the fewest requests that is as safe as full communication.

``python -m studies.swarm.tune_rules [--quick] [--preset ...] [--n-robots ...] [--family ...] [--json F]`` uses the
validation set. In each scenario, all rules of a family first fly a few episodes to measure their requests. They are
then tried by increasing number of requests, in stages of more and more episodes, until one is as safe as full
communication (`Standard`). Rules that collide clearly more often in an early stage are dropped. JSON: one row per rule
and scenario with the keys of `summarise` over the episodes flown, and preset, scenario, family, rule, with
``--n-robots`` also n_robots, and safe (True, False, or None for rules with more requests than the one found).
"""

from __future__ import annotations

import itertools

from quad_swarm.evaluation.command import workers
from quad_swarm.evaluation.evaluation import Rows, summarise
from quad_swarm.world.presets import PRESETS
from quad_swarm.world.scenarios import SCENARIOS, without_obstacles
from studies.swarm.experiment import Experiment, Row, absolute_path, command_line
from studies.swarm.protocol import PRESETS_TESTED, QUICK_STAGES, STAGES, fly_validation, in_stages, world

DISTANCES = (0.62, 0.65, 0.7, 0.8, 0.9, 1.05, 1.2, 1.5)
LOOK_AHEADS = (1.0, 1.5, 2.0, 3.0, 4.0)


def families() -> dict[str, list[str]]:
    """Return the rules of each family."""
    cpa = [f"cpa:{d:g}:{t:g}" for d, t in itertools.product((0.6, *DISTANCES, 2.0), LOOK_AHEADS)]
    some = [f"cpa:{d:g}:{t:g}" for d, t in itertools.product(DISTANCES[:-1], (1.5, 2.0, 3.0))]
    return {
        "distance": [f"distance:{d:g}" for d in (1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5, 6)],
        "cpa": cpa,
        "random": [f"random:{p:g}" for p in (0.1, 0.25, 0.5, 0.75, 0.9)],
        "event": [f"event:{e:g}" for e in (0, 0.001, 0.003, 0.01, 0.02, 0.03)],
        "plan": [f"plan:{d:g}" for d in (*DISTANCES, 2.0)],
        "cpa and stale": [f"{rule}&stale:{k}" for rule in some for k in (3, 4, 5)],
        "cpa and event": [f"{rule}&event:{e:g}" for rule in some[::2] for e in (0.003, 0.01)],
        "cpa and plan": [f"{rule}&plan:{d:g}" for rule in some[::3] for d in (0.8, 1.0)],
        "plan and stale": [f"plan:{d:g}&stale:{k}" for d in (0.62, 0.65, 0.7, 0.8, 1.0, 1.5) for k in (2, 3, 4, 6)],
        "plan, or cpa and stale": [
            f"plan:{d:g}{soon}|cpa:{near}&stale:{k}"
            for d, soon in itertools.product((0.62, 0.7), ("", "&soon:0.3"))
            for near in ("0.62:1.5", "0.65:2", "0.8:2", "0.8:3", "1.05:3")
            for k in (2, 3, 4, 6)
        ],
        "cpa, soon or stale": [
            f"{rule}&soon:{t:g}|{rule}&stale:{k}" for rule in some for t in (0.15, 0.3) for k in (4, 6)
        ],
        "two cpa": [
            f"cpa:{near}|cpa:{far}&stale:{k}"
            for near in ("0.65:1", "0.7:1.5", "0.8:1")
            for far in ("0.8:3", "0.9:3", "1.05:3", "1.05:4", "1.2:3")
            for k in (3, 4, 6)
        ],
    } | fine_families()


def fine_families() -> dict[str, list[str]]:
    """Return fine grids around the best rules of the best families, as fine as those of models' thresholds."""
    product = itertools.product
    near = [f"cpa:{cpa}" for cpa in ("0.6:1.5", "0.62:1.25", "0.62:1.5", "0.62:2", "0.65:1.5", "0.65:2")]
    far = ["cpa:0.8:3", "cpa:0.95:3", "cpa:1.05:2.5", "cpa:1.05:3"]
    return {
        "plan, or cpa and stale, fine": [
            f"plan:{d:g}&soon:{t:g}|{cpa}&stale:{k}"
            for d, t, cpa, k in product((0.62, 0.64, 0.66, 0.68, 0.7), (0.2, 0.3, 0.4), near, (2, 3, 4, 6))
        ]
        + [f"plan:{d:g}|{cpa}&stale:{k}" for d, cpa, k in product((0.65, 0.67, 0.7, 0.73), far, (3, 4, 5, 6))],
        "cpa, soon or stale, fine": [
            f"{cpa}&soon:{t:g}|{cpa}&stale:{k}" for cpa, t, k in product(near, (0.2, 0.3, 0.4), (4, 5, 6, 8))
        ],
        "two cpa, fine": [
            f"cpa:{d:g}:1|{cpa}&stale:{k}" for d, cpa, k in product((0.62, 0.65, 0.68, 0.72), far, (4, 5, 6, 8))
        ],
        "plan and stale, fine": [
            f"plan:{d:g}&stale:{k}" for d, k in product((0.6, 0.61, 0.62, 0.63, 0.64), (2, 3, 4, 5))
        ],
        "cpa and stale, fine": [f"{cpa}&stale:{k}" for cpa, k in product(near, (4, 5, 6, 8))],
    }


def tune(preset: str, n_robots: int | None, scenario: str, names: list[str], quick: bool) -> list[Row]:
    """Tune several families in one scenario and return their rows."""
    stages, thin = (QUICK_STAGES, 20) if quick else (STAGES, 1)
    config = world(preset, n_robots)
    full: Rows = []
    table = []
    for family in names:
        rules = families()[family]
        flown = fly_validation(rules[::thin], preset, scenario, stages[0], n_robots)
        safe: dict[str, bool] = {}
        for rule in sorted(flown, key=lambda rule: summarise(flown[rule], config)["request_share"]):
            flown[rule], safe[rule] = in_stages(rule, preset, scenario, full, quick, n_robots, flown[rule])
            if safe[rule]:
                break
        keys: Row = {"preset": preset, "scenario": scenario, "family": family}
        keys |= {} if n_robots is None else {"n_robots": n_robots}
        table += [keys | {"rule": rule, "safe": safe.get(rule)} | summarise(flown[rule], config) for rule in flown]
        best = [rule for rule in safe if safe[rule]]
        share = f"{summarise(flown[best[0]], config)['request_share']:.2%}" if best else "-"
        print(
            f"{preset:6} {config.n_robots:2} {scenario:16} {family:30} {best[0] if best else 'none':45} {share:>8}",
            flush=True,
        )
    return table


def main() -> None:
    """Run the command line."""
    parser = command_line(__doc__, "fly few episodes and rules")
    parser.add_argument("--preset", nargs="+", default=PRESETS_TESTED, choices=list(PRESETS))
    parser.add_argument("--scenario", nargs="+", default=without_obstacles(), choices=list(SCENARIOS))
    parser.add_argument("--n-robots", nargs="+", type=int, default=[None], help="default: the preset's")
    parser.add_argument("--family", nargs="+", default=list(families()), choices=list(families()))
    parser.add_argument("--json", type=absolute_path, metavar="FILE")
    args = parser.parse_args()
    work = [(*cell, args.family, args.quick) for cell in itertools.product(args.preset, args.n_robots, args.scenario)]
    with workers(args) as pool:
        Experiment(args.json, "preset", "scenario", "family", "n_robots").run(pool, "rules", tune, work)


if __name__ == "__main__":
    main()
