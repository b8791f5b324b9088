"""Fly the results of docs/results.md and docs/flight.md with the models and rules in studies/swarm/data.

``python -m studies.swarm.fly [PART ...] [--preset ...] [--scenario ...] [--n-robots ...] [--again] [--quick]``
flies episodes that neither training nor tuning have seen. Each part is a declaration (`PARTS`): conditions, the
set of their episodes, and how many. What has flown according to the file does not fly again, unless
``--again`` is given; all other rows stay. JSON: one row per policy with the keys of `summarise`, its condition,
``policy`` and ``set``; `compare`, `with_outcomes` and `studies.swarm.requests` say what else. `studies.swarm.report`
fills the pages.

- ``test``, ``teams``, ``counts``, ``quadrants``: the main tables, on a sealed set.
- ``sweep``, ``robustness``, ``unseen``, ``asking``, ``interventions``: additional analyses, most of the first seeds.
- ``flight``, ``flight_sixteen_sealed``: the sealed sets of `flight`, with the settings of `studies.swarm.tune_flight`
  for up to twelve and sixteen robots: commit these first. Policies without a setting fly the former only.
- ``world``: no and full communication in `flight` and `flight-hard`.
- ``delays``: full communication with answers that are one, two and three steps late, with and without the right of way.
- ``delay_check``: the same with the baseline of `studies.swarm.delay_check`.
- ``paper``: four robots with the paper's settings, trained in `flight`, over whole episodes as in the paper.
- ``plants``: separations and models of the planner in other simulators, in symmetric swaps, with the tuned rule and
  the shipped model.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

from quad_swarm.evaluation.command import workers
from quad_swarm.evaluation.flight import first_episode
from quad_swarm.evaluation.inference import Comparison
from quad_swarm.world.presets import PRESETS, SwarmConfig, make_config
from quad_swarm.world.scenarios import SCENARIOS
from studies.swarm import delay_check
from studies.swarm.experiment import Experiment, Job, Row, absolute_path, command_line, summaries
from studies.swarm.protocol import (
    DATA,
    DBCP,
    EARLIER,
    FLIGHT_TESTS,
    NAMES,
    PRESETS_TESTED,
    ROOT,
    TEST,
    WORLDS,
    best_rules,
    models,
    tuned,
    world,
)
from studies.swarm.requests import ask, intervene
from studies.swarm.tune_flight import PRESET, SWAPS, best_rule, tuned_models
from studies.swarm.unseen import UNSEEN

QUICK = 10
# A threshold with enough collisions to analyse
RECKLESS = 0.6
# The simplest rule that is better than the paper's
CPA = "cpa:0.7:1.5"
# Numbers of robots other than in training
TEAMS = (6, 12, 16)
CONDITIONS: dict[str, dict[str, Any]] = {
    "as trained": {},
    "state noise": {"noise": {"pos": 0.004, "vel": 0.02, "attitude": 0.006}},
    "wind 1 m/s": {"noise": {"wind": 1.0}},
    "10 % of plans lost": {"radio": {"loss": 0.1}},
    "30 % of plans lost": {"radio": {"loss": 0.3}},
    "50 % of plans lost": {"radio": {"loss": 0.5}},
    "plans 1 step late": {"radio": {"delay": 1}},
    "plans 2 steps late": {"radio": {"delay": 2}},
    "plans 3 steps late": {"radio": {"delay": 3}},
    "faster robots": {"planner": {"max_tilt": 0.44}},
}
# Recipe of the models with the paper's settings, which only fly with the number of robots of their training
PAPERS = "faithful_flight"
# Numbers of robots in the sealed sets of `flight`, and their episodes
FLOWN = {8: 12000, 4: 4000, 12: 4000, 16: 4000}
# Separations of the planner in the part `plants`; contact is at 0.6 m
SEPARATIONS = (0.8, 0.7, 0.6)
# Simulated vehicles, and the planner's model identified from each
IDENTIFIED = {"crazyflow:cf21B_500": "crazyflie21", "rotorpy:hummingbird": "hummingbird"}
SHIPPED = 2  # seed of the model quad-swarm-flight
# Clearance of the delay check: the one of 0.62, 0.66 and 0.7 m with the fewest collisions in validation episodes
CLEARANCE = 0.62
DELAY_CHECK = f"full, delay check at {CLEARANCE} m"


def compare(job: Job) -> list[Row]:
    """Fly policies over the same episodes. The first is full communication, the second the rule to beat.

    :return: a row per policy, with its paired differences from both
    """
    flown, table = job.fly(), []
    for policy, rows in flown.items():
        row = job.row(policy, rows)
        for name, rival in (("full", job.policies[0]), ("rule", job.policies[1])):
            comparison = Comparison.of(rows, flown[rival])
            low, high = comparison.interval
            row[f"against_{name}"] = {
                "rival": rival,
                "only_policy": comparison.only_first,
                "only_rival": comparison.only_second,
                "low": low,
                "high": high,
                "p_value": comparison.p_value,
                "as_safe": comparison.as_safe(),
            }
        table.append(row)
    return table


def compare_unseen(job: Job) -> list[Row]:
    """Do the same as `compare`, while the scenarios of `UNSEEN` are registered in this process."""
    with patch.dict(SCENARIOS, UNSEEN):
        return compare(job)


def with_outcomes(job: Job) -> list[Row]:
    """Fly a job and return a row per policy, with its episodes' outcomes as text (1: a collision) for comparisons."""
    return [
        job.row(policy, rows) | {"outcomes": "".join("1" if row["collided"] else "0" for row in rows)}
        for policy, rows in job.fly().items()
    ]


def checked(job: Job) -> list[Row]:
    """Fly a job with full communication and the delay check."""
    first = first_episode(job.seed)
    rows = delay_check.fly(job.config, job.scenario, CLEARANCE, range(first, first + job.episodes))
    return [job.row(DELAY_CHECK, rows)]


class Part(NamedTuple):
    """A part of the results: conditions x episodes -> rows.

    :param episodes: number of episodes per condition, unless the jobs say it
    :param seed: index of the set of episodes
    :param jobs: function that returns what to fly
    :param fly: function that flies a job and returns its rows
    :param keys: entries of the rows that a job replaces
    :param file: name of the file, by default the part's
    """

    episodes: int
    seed: int
    jobs: Callable[[], Iterable[Job]]
    fly: Callable[[Job], list[Row]] = compare
    keys: tuple[str, ...] = ("preset", "scenario", "condition", "n_robots")
    file: str = ""


def jobs_of(
    presets: Sequence[str],
    names: Iterable[str],
    policies: Callable[[str, str], list[str]],
    config: SwarmConfig | None = None,
) -> Iterator[Job]:
    """Yield a job per preset and scenario; ``policies`` is a function of both."""
    for preset, name in itertools.product(presets, names):
        yield Job({"preset": preset}, policies(preset, name), name, config or make_config(preset))


def _test(preset: str, name: str) -> list[str]:
    papers = [*models("faithful"), *models("ablation*")] if preset == "paper" else []
    return ["full", best_rules(preset)[name], "none", DBCP, CPA, *models(preset), *papers, *tuned(preset, name)]


def _first_seed(preset: str, name: str) -> list[str]:
    return ["full", best_rules(preset)[name], *models(preset)[:1]]


def _sweep(preset: str, name: str) -> list[str]:
    deltas = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
    return ["full", best_rules(preset)[name], *(f"{path}@{delta}" for path in models(preset)[:1] for delta in deltas)]


def _unseen(preset: str, name: str) -> list[str]:
    return ["full", *(best_rules(preset)[swap] for swap in SWAPS), "none", *models(preset)[:1]]


def counts() -> Iterator[Job]:
    """Yield jobs that count requests over whole episodes of 100 steps, as in the paper."""
    return jobs_of(["paper"], NAMES, lambda preset, _: ["full", DBCP, "none", *models("faithful"), *models(preset)])


def quadrants() -> Iterator[Job]:
    """Yield jobs of the asymmetric swap as in the paper, with one robot anywhere in each quadrant."""

    def policies(preset: str, name: str) -> list[str]:
        return ["full", best_rules(preset)[name], "none", DBCP, *models(preset), *models("faithful")]

    return jobs_of(["paper"], ["asymmetric_swap"], policies, make_config("paper", space={"whole_sectors": True}))


def robustness() -> Iterator[Job]:
    """Yield jobs in disturbed worlds."""
    for preset, (name_of_world, changes) in itertools.product(PRESETS_TESTED, CONDITIONS.items()):
        for job in jobs_of([preset], NAMES, _first_seed, make_config(preset, **changes)):
            yield job._replace(keys=job.keys | {"condition": name_of_world})


def teams() -> Iterator[Job]:
    """Yield jobs with other numbers of robots, in which all models have thresholds tuned for that number."""
    for n, name in itertools.product(TEAMS if models("any") else (), NAMES):
        policies = ["full", best_rules("dense", n)[name], *tuned("any", name, n)]
        yield Job({"preset": "dense", "n_robots": n}, policies, name, world("dense", n))


def flight(up_to: int) -> list[Job]:
    """Return the conditions of a sealed set: first the swaps, in which most collisions occur, and the largest teams.

    :param up_to: number of robots of the largest team that the settings were tuned for
    """
    first = up_to == min(FLIGHT_TESTS)  # the policies without a setting have flown with this one
    everywhere = ["full", *(["none"] if first else []), best_rule(up_to), *tuned_models(up_to)]
    work = [
        Job({"preset": PRESET, "n_robots": n}, [policy], name, world(PRESET, n), episodes)
        for n, episodes in FLOWN.items()
        for policy in (*everywhere, *(models(PAPERS) if n == 4 and first else ()))
        for name in NAMES
    ]
    return sorted(work, key=lambda job: (job.scenario not in SWAPS, -job.config.n_robots))


def _worlds(part: str, preset: str, changed: Row, names: Iterable[str], policies: Iterable[str]) -> Iterator[Job]:
    keys = {"part": part, "preset": preset, "changed": changed}
    spheres = {**changed, "planner": {"downwash": 1.0, **changed.get("planner", {})}}
    for name, policy in itertools.product(names, policies):
        yield Job(keys, [policy], name, make_config(preset, spheres))


def worlds() -> Iterator[Job]:
    """Yield jobs with untuned rules in the disturbed worlds."""
    for preset in ("flight", "flight-hard"):
        yield from _worlds("world", preset, {}, NAMES, ("none", "full"))


def delays(part: str, policy: str) -> Iterator[Job]:
    """Yield jobs with late answers."""
    for delay, right_of_way in itertools.product((1, 2, 3), (0.0, 0.3)):
        changed = {"radio": {"delay": delay, "jitter": 0}, "planner": {"right_of_way": right_of_way}}
        yield from _worlds(part, "flight", changed, SWAPS, [policy])


def paper() -> Iterator[Job]:
    """Yield jobs of the models with the paper's settings."""
    return _worlds("paper", "flight", {"n_robots": 4}, NAMES, ("full", DBCP, "none", *models(PAPERS)))


def plants() -> Iterator[Job]:
    """Yield jobs in other simulators."""
    policies = ("none", "full", best_rule(), tuned_models()[SHIPPED])
    for separation, (plant, identified) in itertools.product(SEPARATIONS, IDENTIFIED.items()):
        for vehicle in ("bebop2", identified):
            changed = {"plant": plant, "quadrotor": vehicle, "planner": {"separation": separation}}
            yield from _worlds("plants", "flight", changed, ["symmetric_swap"], policies)


whole = partial(summaries, linger=None)
both = partial(jobs_of, PRESETS_TESTED)
OF_POLICY = ("n_robots", "scenario", "policy")
IN_WORLDS: dict[str, Any] = {"keys": ("part", "preset", "changed", "scenario", "policy"), "file": "flight_world"}
PARTS = {
    "test": Part(12000, TEST, partial(both, NAMES, _test)),
    "teams": Part(4000, TEST, teams),
    "counts": Part(1000, TEST, counts, whole),
    "quadrants": Part(4000, TEST, quadrants),
    "sweep": Part(1000, EARLIER, partial(both, NAMES, _sweep)),
    "robustness": Part(1000, EARLIER, robustness),
    "unseen": Part(4000, EARLIER, partial(both, UNSEEN, _unseen), compare_unseen),
    "asking": Part(200, EARLIER, partial(both, NAMES, lambda preset, name: _first_seed(preset, name)[1:]), ask),
    "interventions": Part(
        12000,
        EARLIER,
        partial(both, SWAPS[:1], lambda preset, _: [f"{path}@{RECKLESS}" for path in models(preset)[:1]]),
        intervene,
    ),
    "flight": Part(0, FLIGHT_TESTS[12], partial(flight, 12), with_outcomes, OF_POLICY),
    "flight_sixteen_sealed": Part(0, FLIGHT_TESTS[16], partial(flight, 16), with_outcomes, OF_POLICY),
    "world": Part(1000, WORLDS, worlds, summaries, **IN_WORLDS),
    "delays": Part(4000, WORLDS, partial(delays, "delays", "full"), summaries, **IN_WORLDS),
    "delay_check": Part(1000, WORLDS, partial(delays, "delay_check", DELAY_CHECK), checked, **IN_WORLDS),
    "paper": Part(1000, WORLDS, paper, whole, **IN_WORLDS),
    "plants": Part(1000, WORLDS, plants, summaries, **IN_WORLDS),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = command_line(__doc__, f"fly only {QUICK} episodes per condition")
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="parts to fly (default: all)")
    parser.add_argument("--preset", nargs="+", choices=list(PRESETS), help="only these worlds")
    parser.add_argument("--scenario", nargs="+", choices=[*NAMES, *UNSEEN], help="only these scenarios")
    parser.add_argument("--n-robots", nargs="+", type=int, help="only these numbers of robots")
    parser.add_argument("--again", action="store_true", help="also fly what the files already hold")
    parser.add_argument("--out", type=absolute_path, default=DATA, help="folder of the rows (default %(default)s)")
    args = parser.parse_args(argv)
    os.chdir(ROOT)
    with workers(args) as pool:
        for name in args.parts or PARTS:
            part = PARTS[name]
            experiment = Experiment(args.out / f"{part.file or name}.json.gz", *part.keys)
            jobs = [
                job._replace(seed=part.seed, episodes=QUICK if args.quick else job.episodes or part.episodes)
                for job in part.jobs()
                if job.keys["preset"] in (args.preset or PRESETS)
                and job.scenario in (args.scenario or (*NAMES, *UNSEEN))
                and job.config.n_robots in (args.n_robots or [job.config.n_robots])
            ]
            experiment.run(pool, name, part.fly, [(job,) for job in (jobs if args.again else experiment.missing(jobs))])
            print(f"wrote {experiment.path}, {len(experiment.rows())} rows", flush=True)


if __name__ == "__main__":
    main()
