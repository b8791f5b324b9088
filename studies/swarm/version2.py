"""Fly the sealed tests of `flight-v2` and `flight-v3`: full communication, none, rules, models, and rivals.

``python -m studies.swarm.version2 [--part full ...] [--episodes ...] [--jobs 2] [--json F]`` flies sets on which
nothing was chosen, in parts: set 700 is ``obstacles``, ``full`` (all scenarios with eight robots), ``sixteen``,
``rules``, ``teams`` (four and twelve) and ``none``; set 701 ``learned`` (version 1's model), ``hummingbird`` and
``crazyflie`` (the foreign simulators), ``delay_check`` (`studies.swarm.delay_check`), and ``four``, ``twelve`` and
``crowd`` (full communication of sixteen) in all scenarios; set 702 ``identified``, RotorPy's Hummingbird with its own
model in the planner; set 703 ``eight``, full communication of eight in all scenarios again, five times as often; set
704 the same of four, twelve and, without obstacles, sixteen (``four_again``, ``twelve_again``, ``crowd_again``); set
705 ``one_small`` and ``one_large``, one model of version 1 at one threshold, with four to sixteen robots; set 706
``safe_small`` and ``safe_large``, the same model at a lower threshold, and ``among_four``, ``among_eight``,
``among_twelve`` and ``among_sixteen``, full communication and that model among obstacles, after these had been given a
larger penalty than robots; set 707 ``trained_four``, ``trained_eight``, ``trained_twelve`` and ``trained_sixteen``, the
packaged model, which was trained in version 2 and with obstacles; set 708 ``seeds_four``, ``seeds_eight``,
``seeds_twelve`` and ``seeds_sixteen``, its recipe with other training seeds, at its threshold; set 709
``braking_learned``, ``braking_full``, ``braking_twelve`` and ``braking_sixteen``, full communication and the packaged
model among obstacles with the braking reserve; set 710 ``five_eight``, ``five_among_eight``, ``five_four``,
``five_twelve`` and ``five_sixteen``, the flights that the other seeds need to have 12,000 of eight robots and 4,000 of
other numbers with the packaged model, ``rule_again`` and ``none_again``, the best rule and no communication, and
``own_crazyflie`` and ``own_hummingbird``, the packaged model in the foreign simulators; set 713 ``reserve_four``,
``reserve_eight``, ``reserve_twelve`` and ``reserve_sixteen``, the flights that full communication needs to have 12,000
of each scenario with obstacles and each number of robots; set 715 ``mask``, the packaged model at a threshold at which
it asks and tells all whom its action mask allows; set 716 ``orca_eight`` and ``orca_sixteen``, and, of what did not
collide in 200 symmetric swaps of eight robots in ``studies/data/front.json``, the four cheapest rules and the model at
0.5, ``cheap_eight`` and ``cheap_sixteen``; set 717 ``hard``, the packaged model in the disturbances of `flight-hard`,
and ``many``, with 24 and 32 robots; set 718 ``bold_four``, ``bold_eight``, ``bold_twelve`` and ``bold_sixteen``, the
packaged model at 0.5 everywhere, after set 716 had shown that cheap rules are not safe with sixteen robots where this
threshold is; set 719 ``lacking_eight``, what full communication of eight lacks of 12,000; set 722 ``third_model_SIZE``,
``third_none_SIZE``, ``third_full_SIZE`` and ``third_rule_SIZE``, all scenarios in `flight-v3` with four to sixteen
robots: the packaged model of version 2, nobody, everybody, and a rule that tells; set 723 ``third_hard``,
``third_hummingbird``, ``third_crazyflie`` and ``third_many``, these in the disturbances of `flight-hard`, in the
foreign simulators, and with 24 and 32 robots; set 724 ``third_seeds_SIZE``, all scenarios in `flight-v3` with the
recipe's other training seeds; set 726 ``third_random_SIZE``, robots that ask at random about as often as the model
sends; set 727 ``third_more_SIZE``, the packaged model as in set 722, for 12,000 flights of eight robots and 4,000 of
other numbers in all. Set 729 is ``late_1``, ``late_2``, ``late_4`` and ``lost``, eight robots in `flight-v3` that
observe others 50, 100 or 200 ms late, or lose them from sight for a tenth of the time; set 730 ``late_learned``, 200 ms
late with a network that learned so. Set 731 is ``timely_SIZE`` and ``timely_model_SIZE``, all scenarios in `flight-v3`
without commitment: nobody, everybody, a rule that tells much, and a model that knows which plans change others. Set 732
is ``peers_SIZE`` and ``third_peers_SIZE``, all scenarios in `flight-v2` and `flight-v3`: PPO and imitation with the
networks and observations of the packaged model; set 733 ``timely_seeds_SIZE``, the model of set 731 with other training
seeds. Set 720 (``third_model_eight`` and ``third_none_eight``) flew at 2fd9813, before robots of version 3 kept right
of predicted others; set 721 never flew. All parts before set 706 fly with equal penalties, those before set 709 without
the reserve, as they did. JSON: one row per policy, scenario and number of robots with the keys of `summarise`; written
after each row, so that a run that is ended keeps what it has.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from quad_swarm.evaluation.evaluation import Rows, fly_all, make_pool, summarise
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.rows import aligned, write_rows
from quad_swarm.plants.base import MODEL
from quad_swarm.world.presets import PRESETS, make_config
from quad_swarm.world.scenarios import MOST_OBSTACLES, without_obstacles
from sb3_maddpg.hub.pretrained import pretrained_folder
from studies.swarm import delay_check
from studies.swarm.commitment import BEST_RULE
from studies.swarm.experiment import condition
from studies.swarm.fly import CLEARANCE, DELAY_CHECK
from studies.swarm.protocol import models, world

SEALED, LATER, LAST, MORE, AGAIN, ONE, AMONG, TRAINED, SEEDS, BRAKING, FIVE = range(700, 711)
RESERVE, MASKED, CHEAP, STRANGE, BOLD, LACKING, THIRD, ELSEWHERE, OTHERS, CHANCE, MOST = (
    713,
    *range(715, 720),
    722,
    723,
    724,
    726,
    727,
)
LATE, LEARNED_LATE, TIMELY, PEERS, TIMELY_SEEDS = range(729, 734)
SWAPS = ("asymmetric_swap", "symmetric_swap")
# Version 1's model, at its threshold and at the safe one
LEARNED = str(pretrained_folder("quad-swarm-flight") / "model.zip")
MODELS = (LEARNED, f"{LEARNED}@0.05")
# Of the five models, the one that sent least with eight and sixteen robots on validation episodes of version 2, none of
# which collided; the threshold too
ONE_MODEL = f"{models('flight')[4]}@0.5"
# The same model at the highest threshold at which twelve robots did not collide on validation episodes (crossing
# traffic, set 47: 3 of 600 at 0.5)
SAFE_MODEL = f"{models('flight')[4]}@0.4"
# The model that was trained in version 2, at the threshold that was chosen on sets 51 and 52
OWN_MODEL = f"{pretrained_folder('quad-swarm-flight-v2') / 'model.zip'}@0.4"
# All that its action mask allows
MASK_ONLY = f"{pretrained_folder('quad-swarm-flight-v2') / 'model.zip'}@0.001"
BOLDER = f"{pretrained_folder('quad-swarm-flight-v2') / 'model.zip'}@0.5"
CHEAP_RULES = ("plan:1.0s&stale:4", "stage:0.7:0.3", "stage:0.8:0.3", "cpa:1.0s:3&stale:8")
# What flies in version 3, of which the threshold and the rule were chosen on sets 66, 70, 71, 73 and 74
THIRD_POLICIES = {
    "model": f"{pretrained_folder('quad-swarm-flight-v2') / 'model.zip'}@0.6",
    "none": "none",
    "full": "full",
    "rule": "stage:0.8:0.5",
}
# Of those who do not tell
ORCA = "orca"
OTHER_SEEDS = tuple(f"studies/swarm/data/flight_v2_seed{seed}.zip@0.4" for seed in (1, 2, 3, 4))
BOLDER_SEEDS = tuple(f"studies/swarm/data/flight_v2_seed{seed}.zip@0.6" for seed in (1, 2, 3, 4))
# The disturbances of `flight-hard`, which is a world of version 1
HARD: dict[str, Any] = {
    name: getattr(PRESETS["flight-hard"], name) for name in ("noise", "sensing", "mismatch", "max_steps")
} | {
    "radio": {
        name: getattr(PRESETS["flight-hard"].radio, name)
        for name in ("loss", "jitter", "bursts", "burst_length", "outage")
    }
}
EVERYWHERE = (*without_obstacles(), *MOST_OBSTACLES)
# What the delay check assumes of the world: a longest delay, and robots that keep to what passed it anyway
CHECKED: dict[str, Any] = {"radio": {"jitter": 0}, "planner": {"commitment": 0.0}}
# Of sets before 706 and 709
ALIKE = {"planner": {"obstacle_penalty": 1.0}}
UNRESERVED = {"planner": {"braking_reserve": 0.0}}


class Part(NamedTuple):
    """Policies that fly scenarios with some number of robots.

    :param policies: the policies; `DELAY_CHECK` is no rule but `studies.swarm.delay_check`, and `ORCA` another planner
    :param scenarios: names of the scenarios
    :param n_robots: numbers of robots
    :param episodes: number of episodes of each
    :param set: index of the set of episodes
    :param plant: what flies
    :param vehicle: whose model the planner has, None for the preset's
    :param changes: further fields of the world
    :param preset: the preset
    """

    policies: tuple[str, ...]
    scenarios: tuple[str, ...]
    n_robots: tuple[int, ...]
    episodes: int
    set: int = SEALED
    plant: str = MODEL
    vehicle: str | None = None
    changes: Mapping[str, Any] = {}
    preset: str = "flight-v2"


PARTS = {
    "obstacles": Part(("full",), tuple(MOST_OBSTACLES), (8,), 2000),
    "full": Part(("full",), tuple(without_obstacles()), (8,), 2000),
    "sixteen": Part(("full", "stage:1.0:0.2", "stage:1.2:0.3"), ("symmetric_swap",), (16,), 2000),
    "rules": Part((BEST_RULE, "stage:0.9:0.3", "stage:1.0:0.2"), SWAPS, (8,), 2000),
    "teams": Part(("full", "stage:1.0:0.2"), ("symmetric_swap",), (4, 12), 2000),
    "none": Part(("none",), SWAPS, (8,), 1000),
    "learned": Part(MODELS, SWAPS, (8,), 2000, LATER),
    "hummingbird": Part(
        ("full", BEST_RULE, *MODELS, "none"), ("symmetric_swap",), (8,), 1000, LATER, "rotorpy:hummingbird"
    ),
    "crazyflie": Part(
        ("full", BEST_RULE, *MODELS, "none"), ("symmetric_swap",), (8,), 1000, LATER, "crazyflow:cf21B_500"
    ),
    "identified": Part(
        ("full", BEST_RULE, *MODELS), ("symmetric_swap",), (8,), 1000, LAST, "rotorpy:hummingbird", "hummingbird"
    ),
    "delay_check": Part((DELAY_CHECK,), SWAPS, (8,), 1000, LATER),
    "four": Part(("full",), EVERYWHERE, (4,), 2000, LATER),
    "twelve": Part(("full",), EVERYWHERE, (12,), 2000, LATER),
    "crowd": Part(("full",), EVERYWHERE, (16,), 2000, LATER),
    "eight": Part(("full",), EVERYWHERE, (8,), 10000, MORE),
    "four_again": Part(("full",), EVERYWHERE, (4,), 10000, AGAIN),
    "twelve_again": Part(("full",), EVERYWHERE, (12,), 10000, AGAIN),
    "crowd_again": Part(("full",), tuple(without_obstacles()), (16,), 10000, AGAIN),
    "one_small": Part((ONE_MODEL,), tuple(without_obstacles()), (4, 8), 4000, ONE),
    "one_large": Part((ONE_MODEL,), tuple(without_obstacles()), (12, 16), 2000, ONE),
    "safe_small": Part((SAFE_MODEL,), tuple(without_obstacles()), (4, 8), 4000, AMONG),
    "safe_large": Part((SAFE_MODEL,), tuple(without_obstacles()), (12, 16), 2000, AMONG),
    "among_four": Part(("full", SAFE_MODEL), tuple(MOST_OBSTACLES), (4,), 4000, AMONG),
    "among_eight": Part(("full", SAFE_MODEL), tuple(MOST_OBSTACLES), (8,), 4000, AMONG),
    "among_twelve": Part(("full", SAFE_MODEL), tuple(MOST_OBSTACLES), (12,), 2000, AMONG),
    "among_sixteen": Part(("full", SAFE_MODEL), tuple(MOST_OBSTACLES), (16,), 2000, AMONG),
    "trained_eight": Part((OWN_MODEL,), EVERYWHERE, (8,), 2000, TRAINED),
    "trained_twelve": Part((OWN_MODEL,), EVERYWHERE, (12,), 2000, TRAINED),
    "trained_sixteen": Part((OWN_MODEL,), EVERYWHERE, (16,), 2000, TRAINED),
    "trained_four": Part((OWN_MODEL,), EVERYWHERE, (4,), 2000, TRAINED),
    "seeds_four": Part(OTHER_SEEDS[:2], EVERYWHERE, (4,), 2000, SEEDS),
    "seeds_eight": Part(OTHER_SEEDS[:2], EVERYWHERE, (8,), 2000, SEEDS),
    "seeds_twelve": Part(OTHER_SEEDS[:2], EVERYWHERE, (12,), 2000, SEEDS),
    "seeds_sixteen": Part(OTHER_SEEDS[:2], EVERYWHERE, (16,), 2000, SEEDS),
    "braking_sixteen": Part(("full", OWN_MODEL), tuple(MOST_OBSTACLES), (16,), 2000, BRAKING),
    "braking_twelve": Part(("full", OWN_MODEL), tuple(MOST_OBSTACLES), (12,), 2000, BRAKING),
    "braking_learned": Part((OWN_MODEL,), tuple(MOST_OBSTACLES), (8, 4), 2000, BRAKING),
    "braking_full": Part(("full",), tuple(MOST_OBSTACLES), (8, 4), 4000, BRAKING),
    "rule_again": Part((BEST_RULE,), ("symmetric_swap",), (8,), 10000, FIVE),
    "none_again": Part(("none",), ("symmetric_swap",), (8,), 2000, FIVE),
    "own_crazyflie": Part((OWN_MODEL,), ("symmetric_swap",), (8,), 1000, FIVE, "crazyflow:cf21B_500"),
    "own_hummingbird": Part((OWN_MODEL,), ("symmetric_swap",), (8,), 1000, FIVE, "rotorpy:hummingbird", "hummingbird"),
    "five_eight": Part(OTHER_SEEDS[2:], tuple(without_obstacles()), (8,), 3000, FIVE),
    "five_among_eight": Part(OTHER_SEEDS, tuple(MOST_OBSTACLES), (8,), 2500, FIVE),
    "five_four": Part(OTHER_SEEDS, EVERYWHERE, (4,), 500, FIVE),
    "five_twelve": Part(OTHER_SEEDS, EVERYWHERE, (12,), 500, FIVE),
    "five_sixteen": Part(OTHER_SEEDS, EVERYWHERE, (16,), 500, FIVE),
    "reserve_four": Part(("full",), tuple(MOST_OBSTACLES), (4,), 8000, RESERVE),
    "reserve_eight": Part(("full",), tuple(MOST_OBSTACLES), (8,), 8000, RESERVE),
    "reserve_twelve": Part(("full",), tuple(MOST_OBSTACLES), (12,), 10000, RESERVE),
    "reserve_sixteen": Part(("full",), tuple(MOST_OBSTACLES), (16,), 10000, RESERVE),
    "mask": Part((MASK_ONLY,), SWAPS, (8, 16), 2000, MASKED),
    "orca_eight": Part((ORCA,), SWAPS, (8,), 10000, CHEAP),
    "orca_sixteen": Part((ORCA,), SWAPS, (16,), 2000, CHEAP),
    "cheap_eight": Part((*CHEAP_RULES, BOLDER), SWAPS, (8,), 4000, CHEAP),
    "cheap_sixteen": Part((*CHEAP_RULES, BOLDER), SWAPS, (16,), 1000, CHEAP),
    "bold_four": Part((BOLDER,), EVERYWHERE, (4,), 2000, BOLD),
    "bold_eight": Part((BOLDER,), EVERYWHERE, (8,), 2000, BOLD),
    "bold_twelve": Part((BOLDER,), EVERYWHERE, (12,), 2000, BOLD),
    "bold_sixteen": Part((BOLDER,), EVERYWHERE, (16,), 2000, BOLD),
    "lacking_eight": Part(("full",), tuple(without_obstacles()), (8,), 2000, LACKING),
    "hard": Part(("full", OWN_MODEL), SWAPS, (8,), 1000, STRANGE, changes=HARD),
    "many": Part(("full", OWN_MODEL), ("random_swap",), (24, 32), 300, STRANGE),
}
SIZES = {"four": 4, "eight": 8, "twelve": 12, "sixteen": 16}
PARTS |= {
    f"third_{what}_{size}": Part((policy,), EVERYWHERE, (n,), 2000, THIRD, preset="flight-v3")
    for what, policy in THIRD_POLICIES.items()
    for size, n in SIZES.items()
}
PARTS |= {
    f"third_seeds_{size}": Part(BOLDER_SEEDS, EVERYWHERE, (n,), 500, OTHERS, preset="flight-v3")
    for size, n in SIZES.items()
}
# As often as the model sends on average with sixteen robots in set 722, or more
PARTS |= {
    f"third_random_{size}": Part(("random:0.003",), EVERYWHERE, (SIZES[size],), 2000, CHANCE, preset="flight-v3")
    for size in ("twelve", "sixteen")
}
# Others are observed late, or lost from sight; the lower threshold was chosen on set 79, with 200 ms
LOWER = f"{pretrained_folder('quad-swarm-flight-v2') / 'model.zip'}@0.3"
_SIGHT = {f"late_{steps}": {"others_delay": steps} for steps in (1, 2, 4)} | {"lost": {"gaps": 0.1}}
PARTS |= {
    name: Part(
        ("none", THIRD_POLICIES["rule"], THIRD_POLICIES["model"], LOWER, "full"),
        ("symmetric_swap", "forest", "crossing_traffic"),
        (8,),
        1000,
        LATE,
        changes={"sensing": sensing},
        preset="flight-v3",
    )
    for name, sensing in _SIGHT.items()
}
# With a network that learned from robots that observe others so late
LATE_NETWORK = "studies/data/late_perception.npz"
PARTS["late_learned"] = Part(
    ("none", THIRD_POLICIES["rule"], THIRD_POLICIES["model"], "full"),
    ("symmetric_swap", "forest", "crossing_traffic"),
    (8,),
    1000,
    LEARNED_LATE,
    changes={"sensing": {"others_delay": 4}, "predictor": LATE_NETWORK},
    preset="flight-v3",
)
# What set 722 lacks of 12,000 flights of eight robots and 4,000 of other numbers
PARTS |= {
    f"third_more_{size}": Part(
        (THIRD_POLICIES["model"],), EVERYWHERE, (n,), 10000 if n == 8 else 2000, MOST, preset="flight-v3"
    )
    for size, n in SIZES.items()
}
# Who sends for the sake of time: robots do not keep to what they sent, and the model was trained by
# `studies.swarm.information`. Its threshold and the rule were chosen on sets 81 and 82
UNBOUND: dict[str, Any] = {"planner": {"commitment": 0.0}}
TIMELY_POLICIES = {"none": "none", "full": "full", "rule": "stage:1.2:0.2", "model": "studies/data/worth.zip@0.3"}
# Last, the same training with other seeds
PARTS |= {
    f"{what}_{size}": Part(policies, EVERYWHERE, (n,), episodes, of, changes=UNBOUND, preset="flight-v3")
    for what, policies, episodes, of in (
        ("timely", tuple(TIMELY_POLICIES[who] for who in ("none", "full", "rule")), 500, TIMELY),
        ("timely_model", (TIMELY_POLICIES["model"],), 1500, TIMELY),
        ("timely_seeds", tuple(f"studies/data/worth_seed{seed}.zip@0.3" for seed in (1, 2, 3, 4)), 250, TIMELY_SEEDS),
    )
    for size, n in SIZES.items()
}
# Other ways to learn, with the networks, observations and rewards of the packaged model: Stable-Baselines3's PPO, and
# imitation of who knows which plans change others (`studies.swarm.ppo`, `studies.swarm.information`). Prices and
# thresholds were chosen on set 83, in which both send about as much as the packaged model does at its threshold
PPO_2, PPO_3 = (f"studies/swarm/data/ppo_flight_v2_price{price}_seed0.zip@0.5" for price in (0.05, 0.2))
IMITATION_2, IMITATION_3 = (f"studies/data/imitation.zip@{threshold}" for threshold in (0.5, 0.8))
PARTS |= {
    f"{what}_{size}": Part(policies, EVERYWHERE, (n,), 1000 if n == 8 else 500, PEERS, preset=preset)
    for what, policies, preset in (
        ("peers", (PPO_2, IMITATION_2), "flight-v2"),
        ("third_peers", (PPO_3, IMITATION_3), "flight-v3"),
    )
    for size, n in SIZES.items()
}
_THREE = tuple(THIRD_POLICIES[what] for what in ("full", "none", "model"))
PARTS |= {
    "third_hard": Part(_THREE, SWAPS, (8,), 1000, ELSEWHERE, changes=HARD, preset="flight-v3"),
    "third_hummingbird": Part(
        _THREE, SWAPS, (8,), 1000, ELSEWHERE, "rotorpy:hummingbird", "hummingbird", preset="flight-v3"
    ),
    "third_crazyflie": Part(_THREE, SWAPS, (8,), 1000, ELSEWHERE, "crazyflow:cf21B_500", preset="flight-v3"),
    "third_many": Part(_THREE, ("random_swap",), (24, 32), 300, ELSEWHERE, preset="flight-v3"),
}


def fly(part: Part, episodes: int | None, executor: Any) -> Iterator[dict[str, Any]]:
    """Fly a part. Yields its rows.

    :param episodes: number of episodes, None for the part's
    """
    count = episodes or part.episodes
    for n in part.n_robots:
        config = make_config(world(part.preset, n), part.changes, plant=part.plant, quadrotor=part.vehicle)
        if part.set < AMONG:
            config = make_config(config, ALIKE)
        if part.set < BRAKING:
            config = make_config(config, UNRESERVED)
        for scenario in part.scenarios:
            flown: dict[str, Rows] = {}
            conditions = {
                policy: replace(
                    condition("none", scenario, make_config(config, {"planner": {"problem": "orca"}})), solver=ORCA
                )
                if policy == ORCA
                else condition(policy, scenario, config)
                for policy in part.policies
                if policy != DELAY_CHECK
            }
            if conditions:
                found = fly_all(list(conditions.values()), count, part.set, executor=executor)
                flown |= {policy: found[one] for policy, one in conditions.items()}
            if DELAY_CHECK in part.policies:
                first, checked = first_episode(part.set), make_config(config, CHECKED)
                pieces = [range(first + k, first + min(k + 100, count)) for k in range(0, count, 100)]
                fly_piece = partial(delay_check.fly, checked, scenario, CLEARANCE)
                flown[DELAY_CHECK] = [row for rows in executor.map(fly_piece, pieces) for row in rows]
            for policy, rows in flown.items():
                keys: dict[str, Any] = {"policy": named(policy), "scenario": scenario, "n_robots": n}
                keys["plant"] = part.plant
                if part.set in (LATE, LEARNED_LATE, TIMELY):
                    keys["changes"] = part.changes
                yield (
                    keys
                    | {"vehicle": part.vehicle, "set": part.set, "hard": part.changes is HARD, "preset": part.preset}
                    | summarise(rows, config)
                )


def named(policy: str) -> str:
    """Return how rows name a policy: packaged models by their names, others by their paths."""
    for model in ("quad-swarm-flight", "quad-swarm-flight-v2"):
        policy = policy.replace(str(pretrained_folder(model) / "model.zip"), f"pretrained:{model}")
    return policy


OUTCOME = ("collided", "95 % interval", "1 % closer than", "plans", "arrived", "steps")


def outcome(row: dict[str, Any]) -> list[str]:
    """Format what `OUTCOME` names."""
    return [
        f"{row['collisions']}/{row['episodes']}",
        f"{100 * row['collision_low']:.2f} - {100 * row['collision_high']:.2f} %",
        f"{row['min_separation_quantiles']['0.01']:.3f} m",
        f"{row['request_share']:.2%}",
        str(row["arrived"]),
        "-" if row["steps_to_arrival"] is None else f"{row['steps_to_arrival']:.1f}",
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Format rows."""
    texts = [["robots", "scenario", "policy", *OUTCOME]]
    for row in rows:
        texts.append([
            str(row["n_robots"]),
            row["scenario"],
            row["policy"],
            *outcome(row),
        ])  # fmt: skip
    return aligned(texts, 3)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--episodes", type=int, help="default: those of each part")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with make_pool(args.jobs) as pool:
        for name in args.part:
            found = []
            for row in fly(PARTS[name], args.episodes, pool):
                found.append(row)
                if args.json:
                    write_rows(args.json, [*rows, *found])
            print(table(found), flush=True)
            rows += found


if __name__ == "__main__":
    main()
