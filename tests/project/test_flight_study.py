"""The study of the disturbed worlds: its conditions, and that one setting has to do everywhere."""

import itertools
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch as th
from PIL import Image

from quad_swarm.evaluation.rows import read_rows, write_rows
from quad_swarm.geometry import length
from quad_swarm.native import anticipation
from quad_swarm.quadrotor import POSITION
from quad_swarm.task.rules import parse_rule
from quad_swarm.world.anticipation import load_predictor
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm
from studies import wind
from studies.swarm import anticipation as learned_anticipation
from studies.swarm import commitment, delay_check, figures, fly, half_spaces, report, tune_flight, version2
from studies.swarm.experiment import Experiment
from studies.swarm.protocol import EARLIER, EARLIER_TEAMS, FLIGHT_TESTS, NAMES, TEST, VALIDATION, WORLDS

CALM = {
    "noise": {"vel": 0, "attitude": 0, "wind": 0, "gust": 0},
    "sensing": {"pos": 0, "vel": 0, "attitude": 0, "others_pos": 0, "others_vel": 0},
    "mismatch": 0,
    "clock_skew": 0,
}


def test_sets_of_episodes_are_apart():
    later = (
        version2.SEALED,
        version2.LATER,
        version2.LAST,
        version2.MORE,
        version2.AGAIN,
        version2.ONE,
        version2.AMONG,
        version2.TRAINED,
        version2.SEEDS,
        version2.BRAKING,
        version2.FIVE,
        version2.RESERVE,
        version2.MASKED,
        version2.CHEAP,
        version2.STRANGE,
        version2.BOLD,
        version2.LACKING,
        version2.THIRD,
        version2.OTHERS,
        version2.CHANCE,
        version2.ELSEWHERE,
        version2.MOST,
        version2.LATE,
        version2.LEARNED_LATE,
        version2.TIMELY,
        version2.PEERS,
        version2.TIMELY_SEEDS,
    )
    assert len({VALIDATION, EARLIER, EARLIER_TEAMS, TEST, *FLIGHT_TESTS.values(), WORLDS, *later}) == 34


def test_the_table_at_a_glance_says_what_it_costs():
    def row(policy: str, collisions: int, share: float, steps: float, **changed) -> dict:
        figures = {"n_robots": 8, "scenario": "symmetric_swap", "policy": policy, "plant": "model", "episodes": 2000}
        figures |= {"collisions": collisions, "request_share": share, "steps_to_arrival": steps, "arrived": 1000}
        return figures | changed

    learned = "pretrained:quad-swarm-flight-v2@0.4", "d/flight_v2_seed1.zip@0.4"
    rows = [row("full", 0, 1.0, 70.0), row("full", 1, 1.0, 70.0, episodes=10000), row("none", 1800, 0.0, 80.0)]
    rows += [row(commitment.BEST_RULE, 2, 0.07, 77.0), row(learned[0], 3, 0.02, 73.5), row(learned[1], 0, 0.01, 77.0)]
    rows += [row(learned[1], 1, 0.02, 77.0), row(learned[1], 99, 0.5, 1.0, scenario="random")]
    rows += [row("full", 99, 1.0, 1.0, plant="rotorpy:hummingbird"), row("full", 99, 1.0, 1.0, n_robots=16)]
    rows += [row("orca", 0, 0.0, 80.5)]
    text = report.glance_table(rows, "planner.md").replace("&nbsp;", " ").replace("<br>", " ")
    cells = [line.strip("| ").split(" | ") for line in text.splitlines()[2:]]
    assert [line[1:] for line in cells] == [
        ["1,800 of 2,000 [88.61, 91.24] %", "0.0%", "-"],
        ["1 of 12,000 [0.00, 0.05] %", "100.0%", "3.5 s"],
        ["0 of 2,000 [0.00, 0.19] %", "0.0%", "+15%"],
        ["2 of 2,000 [0.03, 0.36] %", "7.0%", "+10%"],
        ["4 of 6,000 [0.03, 0.17] %", "1.5% to 2.0%", "+5% to +10%"],
    ]
    assert cells[-1][0] == "**learned**, 2 training seeds together"


def test_the_tables_of_version_2_count_sets_together_and_judge_cells():
    keys = {"plant": "model", "arrived": 1000, "steps_to_arrival": 70.0, "request_share": 1.0, "policy": "full"}
    keys["min_separation_quantiles"] = {"0.01": 0.7}
    own = keys | {"policy": version2.named(version2.OWN_MODEL), "episodes": 2000, "steps_to_arrival": 77.0}
    own |= {"request_share": 0.02, "set": 707}
    cells = [(name, n) for name in version2.EVERYWHERE for n in (8, 16)]
    rows = [
        one | {"scenario": name, "n_robots": n, "collisions": 0}
        for name, n in cells
        for one in (keys | {"episodes": 4000, "set": 703}, keys | {"episodes": 1000, "set": 709}, own)
        if one["set"] >= version2.BRAKING or name in version2.without_obstacles() or one["policy"] != "full"
    ]
    rows += [row | {"set": 709, "collisions": 2} for row in rows if row["scenario"] == "forest" and row["set"] == 707]
    rows += [
        row | {"set": 709} for row in rows if row["set"] == 707 and row["scenario"] in ("doorway", "crossing_traffic")
    ]
    cells = report.cells_table(rows).replace("&nbsp;", " ").splitlines()
    assert cells[2] == "| symmetric swap | 0; 2.0%, +10% | 0; 2.0%, +10% | 0 of 10,000 |"
    assert (
        next(line for line in cells if "forest" in line) == "| forest | 2†; 2.0%, +10% | 2†; 2.0%, +10% | 0 of 2,000 |"
    )
    table = report.version_2_table(rows).replace("&nbsp;", " ").splitlines()
    assert [line.split(" | ")[2:] for line in table[2:4]] == [
        ["0 of 5,000 [0.00, 0.08] %", "0.70", "100.0%", "70", "703, 709 |"],
        ["0 of 2,000 [0.00, 0.19] %", "0.70", "2.0%", "77", "707 |"],
    ]


@pytest.mark.parametrize("family", tune_flight.families(16, commitment=True))
def test_every_rule_can_be_read(family):
    rules = tune_flight.families(16, commitment=True)[family]
    assert len(set(rules)) == len(rules) > 3
    for rule in rules:
        parse_rule(rule)


@pytest.mark.parametrize("name", fly.PARTS)
def test_every_condition_is_a_world_and_none_is_named_twice(name, monkeypatch):
    monkeypatch.setattr(fly, "best_rule", lambda up_to=12: "plan:0.8&stale:8")
    monkeypatch.setattr(fly, "tuned_models", lambda up_to=12: [f"model{seed}.zip@0.9" for seed in range(5)])
    part = fly.PARTS[name]
    work = list(part.jobs())
    conditions = [str((job.keys, job.scenario, policy)) for job in work for policy in dict.fromkeys(job.policies)]
    assert len(set(conditions)) == len(conditions) >= 2
    identities = {
        str([(job.keys | job._asdict() | {"policy": job.policies[0]}).get(key) for key in part.keys]) for job in work
    }
    assert len(identities) == len(work), "no job replaces the rows of another"
    assert all((job.episodes or part.episodes) >= 200 for job in work)


class Inline(Executor):
    """Runs what it is given at once, in this process."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture
def flown(monkeypatch):
    """All flights. Who is bad collides in every fifth asymmetric swap of sixteen; numbers in names are requests."""
    flown = []

    def fly(policies, preset, scenario, episodes, n_robots=None, skip=0):
        (policy,) = policies
        flown.append((policy, (n_robots, scenario), skip, episodes))
        collides = policy.startswith("bad") and (n_robots, scenario) == (12, "asymmetric_swap")
        requests = float(policy.split()[-1]) if " " in policy else 1.0
        return {policy: [{"collided": collides and k % 5 == 0, "requests": requests} for k in range(skip, episodes)]}

    monkeypatch.setattr(tune_flight, "fly_validation", fly)
    monkeypatch.setattr(tune_flight, "summarise", lambda rows, config: {"request_share": rows[0]["requests"]})
    return flown


CELLS = tune_flight.AIMS[12].cells
FULL: tune_flight.Flown = {cell: [{"collided": False}] * tune_flight.STAGES[-1] for cell in CELLS}


def test_a_rule_has_to_be_safe_in_every_scenario_and_team(flown):
    assert tune_flight.try_out("good", FULL, tune_flight.STAGES).safe
    assert not tune_flight.try_out("bad", FULL, tune_flight.STAGES).safe
    # Piece by piece, in every scenario
    stages = [0, *tune_flight.STAGES]
    assert [one[2:] for one in flown if one[:2] == ("good", (8, "random"))] == list(pairwise(stages))
    assert [one[2:] for one in flown if one[:2] == ("good", (12, "symmetric_swap"))] == list(pairwise(stages))[:-1]
    swaps = itertools.product((4, 8, 12), ("symmetric_swap", "asymmetric_swap"))
    assert {one[1] for one in flown if one[0] == "good"} == {*swaps, *((8, name) for name in NAMES)}
    hardest, other = (
        {one[3] for one in flown if one[0] == "bad" and (one[1] == CELLS[0]) == same} for same in (True, False)
    )
    assert max(hardest) == tune_flight.FIRST
    assert max(other) == tune_flight.STAGES[0], "what cannot turn out to be safe is not flown on"
    assert CELLS[0] == (12, "symmetric_swap")


def test_what_collides_where_others_do_is_not_flown_on(flown, monkeypatch):
    flights = []

    def collide(one, episodes):
        flights.append((one.scenario, one.config.n_robots, [k - tune_flight.first_episode(1) for k in episodes]))
        return [{"collided": k % 2 == 1, "requests": 1.0} for k in flights[-1][2]]

    monkeypatch.setattr(tune_flight, "run_episodes", collide)
    trial = tune_flight.try_out("bad", FULL, tune_flight.STAGES, hard=(7, 4, 9, 1501))
    assert flights == [("symmetric_swap", 12, [7, 4, 9, 1501])]
    assert (trial.safe, trial.selected, trial.collided) == (False, True, [7, 9, 1501])
    assert not flown, "three collisions in 2,000 episodes are too many"
    # Two are not, so it flies as all do
    trial = tune_flight.try_out("good", FULL, tune_flight.STAGES, hard=(7, 9, 10))
    assert (trial.safe, trial.selected) == (True, False)
    assert max(one[3] for one in flown) == tune_flight.STAGES[-1]


def settings(path: Path) -> dict[str, bool | None]:
    return {row["setting"]: row["safe"] for row in read_rows(path)}


def test_rules_are_tried_from_the_cheapest_on_until_one_is_safe(flown, monkeypatch, tmp_path):
    families = {"one": ["good 0.4", "bad 0.1", "good 0.3"], "two": ["bad 0.35", "good 0.2"]}
    monkeypatch.setattr(tune_flight, "families", lambda up_to, commitment: families)
    path, stages = tmp_path / "tuning.json", tune_flight.STAGES
    table = tune_flight.table_of(path)
    rules = tune_flight.by_requests(Inline(), table, stages, quick=False)
    assert [rule.name for rule in rules] == ["bad 0.1", "good 0.2", "good 0.3", "bad 0.35", "good 0.4"]
    tune_flight.tune(Inline(), 1, [rules], FULL, stages, table)
    expected = {"bad 0.1": False, "good 0.2": True, "good 0.3": None, "bad 0.35": None, "good 0.4": None}
    assert settings(path) == expected
    assert {row["setting"] for row in read_rows(path) if row["family"] == "two"} == {"bad 0.35", "good 0.2"}
    assert max(episodes for policy, *_, episodes in flown if policy == "good 0.4") == stages[0]
    # Neither what was screened nor what was decided is flown again.
    flown.clear()
    assert tune_flight.by_requests(Inline(), table, stages, quick=False) == rules
    tune_flight.tune(Inline(), 1, [rules], FULL, stages, table)
    assert not flown
    assert settings(path) == expected
    # A cheaper rule that is undecided is tried although a dearer one is known to be safe
    rows = [row for row in read_rows(path) if row["setting"] != "good 0.2"]
    write_rows(path, [*rows, {"setting": "good 0.3", "safe": True, "n_robots": 8, "scenario": "random"}])
    tune_flight.tune(Inline(), 1, [rules], FULL, stages, table)
    assert settings(path)["good 0.2"]


def test_thresholds_are_tried_from_the_highest_on_each_model_by_itself(flown, tmp_path):
    ladders = [
        [tune_flight.Setting(path, f"{path}@{threshold}") for threshold in (0.9, 0.8)] for path in ("a.zip", "bad.zip")
    ]
    tune_flight.tune(Inline(), 1, ladders, FULL, tune_flight.STAGES, tune_flight.table_of(tmp_path / "t.json"))
    assert settings(tmp_path / "t.json") == {"a.zip@0.9": True, "bad.zip@0.9": False, "bad.zip@0.8": False}


def test_models_fly_at_half_the_price_of_the_best_rule(flown, monkeypatch, tmp_path):
    path, aim = tmp_path / "tuning.json", tune_flight.AIMS[16]
    cells = [cell for cell in aim.cells if cell[1] in tune_flight.SWAPS]
    assert {n for n, _ in cells} == {4, 8, 12, 16}
    rows = [
        {"family": "cpa", "setting": rule, "safe": safe, "n_robots": n, "scenario": name, "request_share": share}
        for rule, safe, share in [("dear", True, 0.5), ("rule", True, 0.25), ("bad", False, 0.1)]
        for n, name in cells
    ]
    write_rows(path, rows)
    table = tune_flight.table_of(path)
    assert tune_flight.cheapest_rule(read_rows(path)) == "rule"
    assert tune_flight.cheapest_rule(rows[-4:]) is None
    shares = {"m@0.02": 0.15, "m@0.05": 0.12, "m@0.1": 0.11, "m@0.15": 0.1}

    def fly(policy, cell, episodes):
        assert episodes == tune_flight.PRICED_ON
        return [{"requests": shares.get(policy, 1.0) + (policy == "m@0.1" and cell == (4, "asymmetric_swap")) * 0.1}]

    monkeypatch.setattr(tune_flight, "fly", fly)
    tune_flight.at_the_price_of("rule", Inline(), table, ["m"], aim)
    tune_flight.at_the_price_of("rule", Inline(), table, ["m"], aim)  # replaces its rows
    chosen = [row for row in read_rows(path) if row.get("chosen")]
    assert [(row["setting"], tune_flight.cell_of(row)) for row in chosen] == [("m@0.15", cell) for cell in cells]
    with pytest.raises(ValueError, match="more than 45% of the requests of rule"):
        tune_flight.at_the_price_of("rule", Inline(), table, ["other"], aim)


def test_full_communication_is_flown_once(flown, tmp_path):
    stages = (5, 10)
    full = tune_flight.fly_full(Inline(), tune_flight.table_of(tmp_path / "t.json"), stages)
    assert {len(rows) for rows in full.values()} == {10}
    assert {one[1] for one in flown} == set(CELLS)
    flown.clear()
    assert tune_flight.fly_full(Inline(), tune_flight.table_of(tmp_path / "t.json"), stages) == full
    assert not flown


@pytest.mark.slow
def test_conditions_fill_their_tables(tmp_path: Path):
    parts = {part: list(fly.PARTS[part].jobs()) for part in ("world", "delays", "delay_check")}
    jobs = [
        (part, job._replace(episodes=3, seed=WORLDS)) for part, jobs in parts.items() for job in (jobs[0], jobs[-1])
    ]
    rows = [row for part, job in jobs for row in fly.PARTS[part].fly(job)]
    assert report.worlds_table(rows, "world").startswith("| world | scenario | policy | collisions")
    for part in ("delays", "delay_check"):
        table = report.worlds_table(rows, part)
        assert table.startswith("| changed | scenario | collisions"), "all fly alike, in the same preset"
        assert "radio.delay=3, radio.jitter=0, planner.right_of_way=0.3" in table
        assert "3/3" in table
    assert report.worlds_table(rows, "plants") == "Not flown yet."


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 2])
def test_plans_that_passed_the_delay_check_never_come_near_each_other(delay):
    config = make_config("flight", CALM | {"n_robots": 6, "radio": {"loss": 0, "delay": delay, "jitter": 0}})
    swarm = delay_check.DelayCheckedSwarm(config, 2, clearance=0.65)
    for k in range(2):
        swarm.reset(k, *ScenarioSampler("symmetric_swap", 6, config.space).sample(np.random.default_rng(k))[1:])
    committed = 0
    for _ in range(200):
        swarm.step(np.ones((2, 6, 5), dtype=bool))
        pos = swarm.plans[..., POSITION]
        committed += bool((length(pos[:, :, -1] - pos[:, :, 0]) > 0.5).any())
        apart = length(pos[:, swarm.neighbours.others] - pos[:, :, None])
        assert apart.min() > 0.65 - 1e-9
    assert committed > 30
    assert length(swarm.pos - swarm.goal).max() < 1.0


def test_tables_of_version_3_say_who_sends_and_what_it_costs():
    def row(policy: str, collisions: int, share: float, steps: float, **changed) -> dict:
        figures = {"n_robots": 8, "scenario": "symmetric_swap", "policy": policy, "plant": "model", "episodes": 2000}
        figures |= {"collisions": collisions, "request_share": share, "steps_to_arrival": steps, "arrived": 1000}
        low, high = 0.0, 0.01
        return figures | {"set": version2.THIRD, "collision_low": low, "collision_high": high} | changed

    rule, model = (version2.named(version2.THIRD_POLICIES[what]) for what in ("rule", "model"))
    third = [row("none", 2, 0.0, 68.6), row(rule, 1, 0.0025, 70.0), row(model, 0, 0.0003, 71.4), row("full", 0, 1, 70)]
    third += [row("none", 5, 0.0, 90.0, n_robots=16), row("full", 9, 1.0, 99.0, set=version2.ELSEWHERE)]
    second = [
        row("none", 1800, 0.0, 90.0, set=710),
        row("orca", 4, 0.0, 77.0, set=716),
        row("full", 7, 1.0, 1.0, set=703),
    ]
    text = report.front_table(second, third, "planner.md").replace("&nbsp;", " ").replace("<br>", " ")
    cells = [[one.strip() for one in line.strip("|").split("|")][1:] for line in text.splitlines()[2:]]
    assert cells == [
        ["nobody", "1,800 of 2,000 [88.61, 91.24] % 0.00% sent", ""],
        ["nobody", "4 of 2,000 [0.08, 0.51] % 0.00% sent, +10%", ""],
        ["nobody", "2 of 2,000 [0.03, 0.36] % 0.00% sent, -2%", "5 of 2,000 [0.11, 0.58] % 0.00% sent"],
        [
            f"rule: who passes near tells its plan if it is not expected (`{rule}`)",
            "1 of 2,000 [0.01, 0.28] % 0.25% sent, +0%",
            "",
        ],
        ["**learned**", "0 of 2,000 [0.00, 0.19] % 0.03% sent, +2%", ""],
        ["everybody", "0 of 2,000 [0.00, 0.19] % 100.00% sent, 3.5 s", ""],
    ]
    text = report.anticipation_table([row for row in third if row["set"] == version2.THIRD]).replace("&nbsp;", " ")
    head, _, first, *_ = text.splitlines()
    assert head == "| scenario | 8 robots | 16 robots |"
    assert first.split(" | ")[1] == "*nobody:* 2†; -2%<br>*rule:* 1; 0.25%; +0%<br>*model:* 0; 0.03%; +2%"
    assert first.strip("| ").split(" | ")[2] == "*nobody:* 5"


def test_the_table_of_other_learners_counts_scenarios_together():
    def row(policy: str, n_robots: int, scenario: str, collisions: int, share: float, steps: float, of: int) -> dict:
        figures = {"policy": version2.named(policy), "n_robots": n_robots, "scenario": scenario, "plant": "model"}
        figures |= {"collisions": collisions, "episodes": 1000, "request_share": share, "steps_to_arrival": steps}
        return figures | {"arrived": 1000 - collisions, "set": of}

    second = [
        row("full", 8, "random", 0, 1.0, 60.0, 700),
        row("full", 8, "forest", 0, 1.0, 100.0, version2.BRAKING),
        row(version2.OWN_MODEL, 8, "random", 1, 0.01, 63.0, version2.TRAINED),
        row(version2.OWN_MODEL, 8, "forest", 50, 0.03, 99.0, version2.TRAINED),
        row(version2.OWN_MODEL, 8, "forest", 2, 0.02, 99.0, version2.BRAKING),
        row(version2.PPO_2, 8, "random", 4, 0.015, 60.0, version2.PEERS),
    ]
    unbound = row(version2.IMITATION_3, 4, "random", 9, 0.5, 50.0, version2.TIMELY)
    third = [
        row("full", 4, "random", 0, 1.0, 50.0, version2.THIRD),
        row(version2.THIRD_POLICIES["model"], 4, "random", 0, 0.001, 50.0, version2.THIRD),
        row(version2.THIRD_POLICIES["model"], 4, "random", 1, 0.001, 50.0, version2.MOST),
        unbound,
    ]
    head, _, *lines = report.peers_table(second, third).replace("&nbsp;", " ").splitlines()
    table = {
        tuple(cells[:2]): cells[2:] for cells in ([c.strip() for c in line.strip("|").split("|")] for line in lines)
    }
    assert [c.strip() for c in head.strip("|").split("|")][2:] == ["4 robots", "8 robots", "12 robots", "16 robots"]
    assert table["`flight-v2`", "MADDPG"] == [
        "",
        "3 of 2,000<br>[0.05, 0.44] %<br>1.00% to 2.00%<br>-1% to +5%",
        "",
        "",
    ]
    assert table["`flight-v2`", "PPO"][1] == "4 of 1,000<br>[0.16, 1.02] %<br>1.50% to 1.50%<br>+0% to +0%"
    assert table["`flight-v3`", "MADDPG"][0].startswith("1 of 2,000<br>")
    assert table["`flight-v3`", "imitation"] == ["", "", "", ""]


def test_the_table_of_late_perception_compares_within_each_world():
    def row(policy: str, collisions: int, share: float, steps: float, **sensing) -> dict:
        figures = {"scenario": "forest", "policy": version2.named(policy), "episodes": 1000, "collisions": collisions}
        return figures | {
            "request_share": share,
            "steps_to_arrival": steps,
            "changes": {"sensing": sensing},
            "preset": "flight-v3",
        }

    rule, model = version2.THIRD_POLICIES["rule"], version2.THIRD_POLICIES["model"]
    rows = [
        row("none", 400, 0.0, 110.0, others_delay=4),
        row(rule, 2, 0.01, 105.0, others_delay=4),
        row(model, 90, 0.0097, 105.8, others_delay=4),
        row(version2.LOWER, 0, 0.036, 101.3, others_delay=4),
        row("full", 0, 1.0, 100.0, others_delay=4),
    ]
    rows += [row(name, 0, 0.5, 90.0, gaps=0.1) for name in ("none", rule, model, version2.LOWER, "full")]
    learned = {"changes": {"sensing": {"others_delay": 4}, "predictor": version2.LATE_NETWORK}}
    rows += [row(name, 0, 0.5, 90.0) | learned for name in ("none", "full")]
    head, _, *lines = report.late_table(rows).replace("&nbsp;", " ").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in (head, *lines)]
    assert cells[0] == [
        "others are seen",
        "scenario",
        "nobody",
        f"`{rule}`",
        "model at 0.6",
        "model at 0.3",
        "everybody",
    ]
    assert cells[1] == [
        "200 ms late",
        "forest",
        "400; +10%",
        "2; 1.00%; +5%",
        "90; 0.97%; +6%",
        "0; 3.60%; +1%",
        "0",
    ]
    assert cells[2][:3] == ["lost at times", "forest", "0; +0%"]
    assert cells[3] == ["200 ms late, and the network learned so", "forest", "0; +0%", "", "", "", "0"]


def test_a_delay_check_needs_a_longest_delay():
    with pytest.raises(ValueError, match=r"radio\.jitter=1"):
        delay_check.DelayCheckedSwarm(make_config("flight"), 1, clearance=0.62)


def test_a_delay_check_keeps_to_no_plans_that_were_sent():
    with pytest.raises(ValueError, match=r"planner\.commitment=1: set it to 0"):
        delay_check.DelayCheckedSwarm(make_config("flight-v2", {"radio": {"jitter": 0}}), 1, clearance=0.62)


@pytest.mark.parametrize("kind", ["voronoi", "orca"])
def test_half_spaces_touch_where_they_should(kind):
    config = make_config("flight-v2", CALM | {"n_robots": 2, "radio": {"loss": 0, "jitter": 0}})
    swarm = half_spaces.CautiousSwarm(config, 1, half_spaces.Fallback(kind, 0, 3.0))
    swarm.reset(0, [[-1, 0, 1.5], [1, 0, 1.5]], [[1, 0, 1.5], [-1, 0, 1.5]])
    problems = swarm._problems(*swarm._believe(np.zeros((1, 2, 1), dtype=bool)))
    kept = config.planner.separation + problems.clearance[0, 0]
    # Robot 0 rests at x = -1 and may go as far as half of the separation before the middle. ORCA's velocities shrink
    # the gap to the separation and its margin within a second, half each
    last = np.array([-0.5 * config.planner.separation, 0.0, 1.5])
    if kind == "orca":
        last = np.array([-1 + 0.5 * (2 - config.planner.separation - 0.15), 0.0, 1.5])
    assert length(last - problems.others[0, 0, -1]) == pytest.approx(kept[-1], abs=1e-6)
    assert length(last + np.array([0.05, 0, 0]) - problems.others[0, 0, -1]) < kept[-1]
    assert swarm.replaced == swarm.beliefs_held == 2
    far = half_spaces.CautiousSwarm(config, 1, half_spaces.Fallback(kind, 0, 1.9))
    far.reset(0, [[-1, 0, 1.5], [1, 0, 1.5]], [[1, 0, 1.5], [-1, 0, 1.5]])
    far.step(np.zeros((1, 2, 1), dtype=bool))
    assert far.replaced == 0


def test_the_table_of_half_spaces(tmp_path, monkeypatch, capsys):
    words = ["--kind", "voronoi", "--age", "2", "--policy", "none", "--n-robots", "3", "--episodes", "2", "--jobs", "1"]
    monkeypatch.setattr("sys.argv", ["half_spaces", *words, "--json", str(tmp_path / "rows.json")])
    half_spaces.main()
    without, with_it = read_rows(tmp_path / "rows.json")
    assert (without["kind"], without["replaced"]) == ("none", 0.0)
    assert (with_it["kind"], with_it["age"]) == ("voronoi", 2)
    assert "voronoi, 2 steps, 1.2 m" in capsys.readouterr().out


def test_the_tables_of_the_sealed_flights_compare_with_full_and_the_rule():
    def row(policy: str, collisions: int, share: float) -> dict:
        figures = {"n_robots": 8, "scenario": "random", "policy": policy, "request_share": share, "episodes": 4000}
        figures |= {"outcomes": "1" * collisions + "0" * (4000 - collisions), "collisions": collisions}
        figures |= {"collision_low": 0.0, "collision_high": 0.01, "collisions_at_steps": 0, "bytes_per_second": 9.0}
        return figures | {"steps_to_arrival": None, "arrived": 4000 - collisions}

    rows = [row("full", 0, 1.0), row("none", 900, 0.0), row("plan:0.8", 2, 0.02), row("a/x_seed1.zip@0.9", 3, 0.01)]
    lines = report.flight_table(rows).splitlines()[2:]
    assert [line.split(" | ")[5].startswith("**") for line in lines] == [False, False, True, True]
    assert [line.split(" | ")[7] for line in lines] == ["5000%", "0%", "100%", "50%"]
    summary = report.flight_targets(rows).splitlines()[2:]
    assert len(summary) == 2
    assert "x, seed 1, δ = 0.9 | 1 of 1 | - | - | - | 1.00% (50%)" in summary[1]
    assert report.flight_table([]) == report.flight_targets([]) == report.swaps_table([]) == "Not flown yet."
    swaps = [one | {"scenario": name} for one in rows for name in tune_flight.SWAPS]
    cells = [line.split(" | ") for line in report.swaps_table(swaps).splitlines()[2:]]
    assert [line[2:5] for line in cells] == [[*line[5:7], line[7].removesuffix(" |")] for line in cells]
    assert [line[3].startswith("**") for line in cells] == [False, False, True, True]
    assert cells[0][3] == "-"
    assert cells[3][2:3] + cells[3][4:5] == ["3/4000", "1.00% (50%)"]


def test_settings_that_are_safe_are_tabled_with_their_validation_figures():
    figures = {"collisions": 1, "episodes": 2000, "request_share": 0.0125}
    rows = [
        {"family": family, "setting": setting, "safe": safe, "n_robots": n, "scenario": "random", **figures}
        for family, setting, safe in (("full", "full", True), ("r", "cpa:1:2", True), ("r", "cpa:2:2", False))
        for n in (12, 8)
    ]
    assert report.tuned_table(rows).splitlines() == [
        "|  | 12 robots, random | 8 robots, random |",
        "| --- | --- | --- |",
        "| `full` | 1/2000, 1.25% | 1/2000, 1.25% |",
        "| `cpa:1:2` | 1/2000, 1.25% | 1/2000, 1.25% |",
    ]
    assert report.tuned_table([]) == "Not flown yet."


def test_the_headline_table_has_five_rows_and_gives_seeds_as_ranges():
    def row(policy: str, collisions: int, n_robots: int = 8, name: str = "symmetric_swap") -> dict:
        figures = {"n_robots": n_robots, "scenario": name, "policy": policy, "requests": 10 * collisions}
        figures |= {"possible_requests": 1000, "episodes": 12000, "collisions": collisions, "bytes_per_second": 2000.0}
        return figures | {"collision_low": collisions / 24000, "collision_high": collisions / 6000}

    rows = [row("full", 0), row("none", 9000), row("cpa:1:2|push:0.1", 2), row("d/flight_seed0.zip@0.4", 3)]
    rows += [row("d/flight_seed0.zip@0.4", 6, name="asymmetric_swap"), row("d/flight_seed1.zip@0.3", 1)]
    rows += [row("d/faithful_flight_seed0.zip", 99, n_robots=4), row("d/flight_seed0.zip@0.4", 77, n_robots=4)]
    text = report.headline_table(rows, "cpa:1:2|push:0.1").replace("&nbsp;", " ").replace("<br>", " ")
    lines = [line.split(" | ")[1:] for line in text.splitlines()[2:]]
    assert len(lines) == 5
    assert lines[0][:3] == ["9,000 of 12,000 [37.50, 150.00] %", "-", "9000.00%"]
    assert lines[2][0] == "2 of 12,000 [0.01, 0.03] %"
    assert lines[3][0].startswith("99 of 12,000")
    assert lines[4] == ["1 to 3 of 12,000 [0.00, 0.05] %", "6 of 12,000 [0.03, 0.10] %", "1.00% to 4.50%", "2,000 |"]


@pytest.mark.slow
def test_the_sealed_flights_take_what_was_tuned_and_do_not_repeat_what_was_flown(tmp_path, monkeypatch):
    monkeypatch.setattr(tune_flight, "DATA", tmp_path)
    with pytest.raises(ValueError, match="holds no safe rule"):
        tune_flight.best_rule()
    rules = [
        {"family": setting, "setting": setting, "n_robots": 8, "scenario": name, "safe": safe, "request_share": share}
        for setting, safe, share in (("plan:0.8", True, 0.03), ("cpa:0.8:1", True, 0.02), ("plan:0.7", False, 0.01))
        for name in NAMES
    ]
    write_rows(tmp_path / "flight_tuning.json.gz", rules)
    assert tune_flight.best_rule() == "cpa:0.8:1"
    assert {job.policies[0] for job in fly.flight(12)} >= {"full", "none", "cpa:0.8:1"}
    with pytest.raises(ValueError, match=r"flight_sixteen\.json\.gz holds no safe rule"):
        fly.flight(16)
    write_rows(tmp_path / "flight_sixteen.json.gz", rules[: len(NAMES)])
    work = fly.flight(16)
    assert [job.config.n_robots for job in work[:2]] == [16, 16]
    assert {job.episodes for job in work if job.config.n_robots == 16} == {4000}
    assert {"full", "plan:0.8"} <= {job.policies[0] for job in work}
    assert "none" not in {job.policies[0] for job in work}
    assert [job.scenario in tune_flight.SWAPS for job in work] == [True] * (len(work) // 2) + [False] * (len(work) // 2)
    monkeypatch.setattr(fly, "NAMES", NAMES[:1])
    monkeypatch.setattr(fly, "models", lambda recipe: [])
    monkeypatch.setattr(fly, "tuned_models", lambda up_to: [])
    words = ["flight", "--quick", "--jobs", "1", "--n-robots", "4", "--out", str(tmp_path)]
    fly.main(words)
    rows = read_rows(tmp_path / "flight.json.gz")
    assert {(row["n_robots"], row["policy"], len(row["outcomes"]), row["set"]) for row in rows} == {
        (4, policy, fly.QUICK, FLIGHT_TESTS[12]) for policy in ("full", "none", "cpa:0.8:1")
    }
    ran = []
    monkeypatch.setattr(Experiment, "run", lambda self, pool, what, fly, work: ran.append(len(work)))
    fly.main(words)
    fly.main([*words, "--again"])
    assert ran == [0, 3]


@pytest.mark.slow
def test_the_scan_of_commitments_flies_what_it_says(tmp_path, monkeypatch, capsys):
    words = ["--rule", "full", "stage:0.9:0.3", "--commitment", "0", "3", "--estimate", "1", "--fade", "2", "1"]
    monkeypatch.setattr("sys.argv", ["commitment", *words, "--episodes", "2", "--json", str(tmp_path / "rows.json")])
    commitment.main()
    rows = read_rows(tmp_path / "rows.json")
    points = [(row["commitment"], row["fade"], row["rule"]) for row in rows]
    rules = ["full", "stage:0.9:0.3"]
    assert points == [(*point, rule) for point in ((0, 2), (3, 2), (3, 1)) for rule in rules]  # no fade of nothing
    assert [row["request_share"] for row in rows[::2]] == [1.0] * 3
    assert all(0 < row["request_share"] < 0.2 for row in rows[1::2])
    times = [row["steps_to_arrival"] for row in rows[::2]]
    assert times[0] < times[1] < times[2]
    assert capsys.readouterr().out.count("full") == 3


@pytest.mark.slow
def test_the_sealed_test_of_version_2_flies_its_parts(tmp_path, monkeypatch, capsys):
    words = ["--part", "none", "teams", "--episodes", "1", "--json", str(tmp_path / "rows.json")]
    monkeypatch.setattr("sys.argv", ["version2", *words])
    version2.main()
    rows = read_rows(tmp_path / "rows.json")
    expected = [(8, "none"), (8, "none"), (4, "full"), (4, "stage:1.0:0.2"), (12, "full"), (12, "stage:1.0:0.2")]
    assert [(row["n_robots"], row["policy"]) for row in rows] == expected
    assert [row["request_share"] for row in rows[:2]] == [0, 0]
    assert "symmetric_swap" in capsys.readouterr().out


def test_orca_flies_the_sealed_test_as_a_planner_of_its_own():
    part = version2.PARTS["orca_eight"]._replace(policies=(version2.ORCA, "none"))
    orca, none = version2.fly(part._replace(scenarios=("symmetric_swap",)), 3, ThreadPoolExecutor(1))
    assert (orca["policy"], orca["request_share"], orca["collisions"]) == ("orca", 0, 0)
    assert none["collisions"] > 0


def test_wind_moves_robots_beside_their_goals_unless_they_estimate_it():
    assert wind.distance("paper", 4.0, None) > 0.3
    assert wind.distance("paper", 4.0, 1.0) < 0.01


def test_robots_learn_what_others_plan(tmp_path, capsys):
    """With three robots in one scenario, in seconds, in a world of one's own that limits whom robots perceive."""
    world = make_config("flight-v2", {"neighbourhood": {"max_others": 1}}, n_robots=3)
    with ThreadPoolExecutor(1) as pool:
        learned_anticipation.train([world], ["random_swap"], 2, 6, pool, tmp_path / "mine.npz")
    number, rows, _, _, learned, *steady, _ = capsys.readouterr().out.strip().splitlines()[-1].split()
    assert number == "2"
    assert int(rows) > 1000
    assert float(learned) < 0.8 * float(steady[-1])  # root mean square errors after a second
    mine = load_predictor(str(tmp_path / "mine.npz"))
    assert '"n_robots": [3]' in mine.about
    assert Swarm(make_config(world, predictor=str(tmp_path / "mine.npz"))).beliefs.horizon == mine.horizon


def test_what_is_trained_is_what_flies():
    network = learned_anticipation.Network(20)
    config = make_config("flight-v3", n_robots=4)
    swarm = Swarm(config)
    starts = np.array([[3.0, 0, 1.2], [0, 3, 1.2], [-3, 0, 1.2], [0, -3, 1.2]])
    swarm.reset(0, starts, -starts * [1, 1, -1])
    for _ in range(10):
        swarm.step(np.zeros((1, 4, 3), bool))
    seen = swarm.beliefs.predict(*swarm.observe(), swarm.scene()).outlook.of_others
    own, bodies, near = (th.from_numpy(array.reshape(-1, *array.shape[3:])) for array in anticipation.features(seen))
    change = network(own, bodies, near).detach().numpy().reshape(1, 4, 3, 20, 3)
    weights = network.weights(), learned_anticipation.HIDDEN, learned_anticipation.WIDTH
    expected = anticipation.anticipate(seen, *weights, 20, 0.05)
    assert np.allclose(anticipation.outputs(seen, expected[..., 1:, :], 0.05), change, atol=1e-4)
    assert np.abs(change).max() > 0.01


def test_who_sends_for_time_is_compared_with_full_communication_in_the_same_world():
    policies = version2.TIMELY_POLICIES
    steps = {"none": 103.2, "full": 100.0, policies["rule"]: 99.8, version2.named(policies["model"]): 101.6}
    rows = [
        {
            "policy": policy,
            "scenario": "forest",
            "n_robots": n,
            "collisions": int(policy == "none"),
            "request_share": 0.0512,
            "steps_to_arrival": one,
        }
        for policy, one in steps.items()
        for n in (4, 8)
    ]
    table = report.anticipation_table(rows, policies, marked=False)
    line = next(line for line in table.splitlines() if line.startswith("| forest"))
    cell = "*nobody:* 1; +3%<br>*rule:* 0; 5.12%; +0%<br>*model:* 0; 5.12%; +2%"
    assert line.replace("&nbsp;", " ") == f"| forest | {cell} | {cell} |"


@pytest.mark.slow
def test_the_figure_of_what_is_sent_counts_what_was_flown(tmp_path):
    wrong, close, sent = figures._sent("forest", 2)
    assert wrong.shape == close.shape == sent.shape
    assert len(sent) % (8 * 7) == 0, "every robot, towards every other"
    assert 0 < sent.mean() < 0.02
    assert wrong[sent].mean() > 2 * wrong.mean(), "those who are wrong are told"
    assert close[sent].mean() < 0.5 * close.mean(), "whom a plan passes closely"
    figures.draw_telling(tmp_path / "telling.png", episodes=1)
    with Image.open(tmp_path / "telling.png") as picture:
        assert picture.size[0] >= 1000
