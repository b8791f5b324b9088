"""The study of the disturbed worlds: its conditions, and that one setting has to do everywhere."""

from pathlib import Path

import pytest

from quad_swarm.evaluation.rows import read_rows, write_rows
from quad_swarm.task.rules import parse_rule
from quad_swarm.world.presets import make_config
from studies.swarm import flight_world, fly_flight, report, tune_flight
from studies.swarm.protocol import EARLIER, EARLIER_TEAMS, FLIGHT_TEST, NAMES, TEST, VALIDATION, WORLDS


def test_sets_of_episodes_are_apart():
    assert len({VALIDATION, EARLIER, EARLIER_TEAMS, TEST, FLIGHT_TEST, WORLDS}) == 6


@pytest.mark.parametrize("family", tune_flight.families())
def test_every_rule_can_be_read(family):
    rules = tune_flight.families()[family]
    assert len(set(rules)) == len(rules) > 3
    for rule in rules:
        parse_rule(rule)


@pytest.mark.parametrize("part", flight_world.PARTS)
def test_every_condition_is_a_world_and_none_is_named_twice(part):
    work = list(flight_world.jobs(part))
    assert len({str(job) for job in work}) == len(work) >= 12
    for job in work:
        make_config(job.preset, job.changed)


def test_a_rule_has_to_be_safe_in_every_scenario(monkeypatch):
    flown = []

    def fly(policies, preset, scenario, episodes, n_robots=None, skip=0):
        flown.append((policies[0], scenario, skip, episodes))
        collides = policies[0] == "bad" and scenario == "random"
        return {policies[0]: [{"collided": collides and k % 5 == 0} for k in range(skip, episodes)]}

    monkeypatch.setattr(tune_flight, "fly_validation", fly)
    trial = tune_flight.Trial(quick=False)
    assert trial.safe("good", {})
    assert not trial.safe("bad", {})
    # Full communication is flown once, in every scenario and piece by piece.
    assert [one[2:] for one in flown if one[:2] == ("full", "random")] == [
        (0, 100), (100, 250), (250, 500), (500, 1000), (1000, 2000), (2000, 4000)
    ]  # fmt: skip
    assert {one[1] for one in flown if one[0] == "good"} == set(NAMES)
    assert max(one[3] for one in flown if one[0] == "bad") == 100, "without hope it is not flown on"


def test_conditions_fill_their_tables(tmp_path: Path):
    jobs = [next(flight_world.jobs("world")), list(flight_world.jobs("delays"))[-1]]
    rows = [flight_world.fly(job, 3) for job in jobs]
    table = report.worlds_table(rows, "delays")
    assert "radio.delay=3, radio.jitter=0, planner.right_of_way=0.3" in table
    assert "3/3" in table
    assert report.worlds_table(rows, "plants") == "Not flown yet."


def test_the_sealed_flights_take_what_was_tuned_and_do_not_repeat_what_was_flown(tmp_path, monkeypatch):
    monkeypatch.setattr(fly_flight, "DATA", tmp_path)
    with pytest.raises(ValueError, match="holds no safe rule"):
        fly_flight.best_rule()
    rules = [
        {"setting": setting, "scenario": name, "safe": safe, "request_share": share}
        for setting, safe, share in (("plan:0.8", True, 0.03), ("cpa:0.8:1", True, 0.02), ("plan:0.7", False, 0.01))
        for name in NAMES
    ]
    write_rows(tmp_path / "flight_rules.json", rules)
    assert fly_flight.best_rule() == "cpa:0.8:1"
    assert {job.policy for job in fly_flight.jobs([8, 4], quick=True)} >= {"full", "none", "cpa:0.8:1"}
    monkeypatch.setattr(fly_flight, "NAMES", NAMES[:1])
    monkeypatch.setattr(fly_flight, "tuned_models", list)
    monkeypatch.setattr("sys.argv", ["", "--quick", "--jobs", "1", "--n-robots", "4", "--json", f"{tmp_path}/f.json"])
    fly_flight.main()
    rows = read_rows(tmp_path / "f.json")
    assert {(row["n_robots"], row["policy"], len(row["outcomes"])) for row in rows} == {
        (4, policy, fly_flight.QUICK) for policy in ("full", "none", "cpa:0.8:1")
    }
    monkeypatch.setattr(fly_flight, "fly", None)
    fly_flight.main()
    assert read_rows(tmp_path / "f.json") == rows
