"""The scripts behind docs/results.md, with few episodes."""

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
from quad_swarm.evaluation.evaluation import Comparison, fly_all
from quad_swarm.task.rules import parse_rule
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS
from sb3_maddpg import MADDPG
from sb3_maddpg.pretrained_models import pretrained_folder
from studies.swarm import counterfactual, fly, ppo, tune_rules, tune_thresholds
from studies.swarm import report as page


def test_every_rule_of_every_family_can_be_read():
    families = tune_rules.families()
    assert {"distance", "cpa", "random", "event"} <= set(families)
    for rules in families.values():
        assert len(set(rules)) == len(rules)
        for rule in rules:
            parse_rule(rule)


def test_comparison_counts_episodes_in_which_one_collided():
    first = [{"collided": c} for c in (1, 1, 0, 0, 1)]
    second = [{"collided": c} for c in (1, 0, 0, 1, 0)]
    assert Comparison.of(first, second) == Comparison(5, 2, 1)


def test_comparison_of_known_numbers():
    # Agresti and Min (2005) for 4,000 pairs of which 5 and 1 differ; McNemar's exact p of 5 against 1 is 14/64
    low, high = Comparison(4000, 5, 1).interval
    assert (low, high) == (pytest.approx(-0.00030, abs=2e-5), pytest.approx(0.00230, abs=2e-5))
    assert Comparison(4000, 5, 1).p_value == pytest.approx(14 / 64)
    assert Comparison(4000, 0, 0).p_value == 1.0
    assert Comparison(4000, 0, 0).interval[1] > 0, "no collisions in 4,000 episodes do not prove that there are none"
    assert Comparison(4000, 5, 1).as_safe
    assert not Comparison(4000, 12, 1).as_safe
    assert not Comparison(100, 0, 0).as_safe, "too few episodes"
    assert tune_rules.hopeless(Comparison(800, 9, 0))
    assert not tune_rules.hopeless(Comparison(800, 1, 0))


def test_stages_fly_every_episode_once_and_stop_where_there_is_no_hope(monkeypatch):
    monkeypatch.setattr(tune_rules, "STAGES", (10, 30, 60))
    flown = {policy: tune_rules.fly([policy], "paper", "random", 60)[policy] for policy in ("full", "cpa:0.7:1.5")}
    full, all_60 = flown.values()
    figures, safe = tune_rules.in_stages("cpa:0.7:1.5", "paper", "random", full, False, flown=all_60[:10])
    same = [{key: row[key] for key in row if key != "solve_seconds"} for row in (*figures, *all_60)]
    assert same[:60] == same[60:]
    assert not safe, "60 episodes prove nothing"
    collisions = tune_rules.fly(["full"], "paper", "symmetric_swap", 60)["full"]
    figures, safe = tune_rules.in_stages("none", "paper", "symmetric_swap", collisions, False)
    assert (len(figures), safe) == (10, False)


def test_teams_of_another_size_need_fewer_episodes_and_fly_full_communication_only_as_far(monkeypatch):
    monkeypatch.setattr(tune_rules, "STAGES", (5, 10, 20))
    monkeypatch.setattr(tune_rules, "OF_TEAM", tune_rules.Standard(0.3, 10))
    rival: list[dict[str, float]] = []
    figures, safe = tune_rules.in_stages("distance:4", "dense", "random", rival, False, 5)
    assert (len(figures), len(rival), safe) == (10, 10, True)
    figures, safe = tune_rules.in_stages("distance:4", "dense", "random", rival, False)
    assert (len(figures), len(rival), safe) == (20, 20, False), "a preset's own team has a standard of its own"


def test_rules_are_tuned_for_each_size_of_the_team(tmp_path, monkeypatch):
    table = tmp_path / "team_rules.json"
    words = ["tune_rules.py", "--preset", "dense", "--scenario", "random", "--family", "random", "--quick"]
    monkeypatch.setattr(sys, "argv", [*words, "--n-robots", "3", "4", "--jobs", "1", "--json", str(table)])
    tune_rules.main()
    rows = tune_rules.read_rows(table)
    assert [row["n_robots"] for row in rows] == [3, 4]
    assert rows[1]["possible_requests"] > rows[0]["possible_requests"]
    monkeypatch.setattr(fly, "FOLDER", tmp_path)
    assert fly.best_rules("dense", 3)["random"] == rows[0]["rule"]
    assert fly.best_rules("dense", 3)["random_swap"] == "full", "not tuned"
    assert fly.best_rules("dense", 5)["random"] == "full"


def test_thresholds_of_a_model_for_all_sizes_are_those_of_the_size_that_flies(tmp_path, monkeypatch):
    monkeypatch.setattr(fly, "models", lambda recipe: ["any_seed0.zip"])
    monkeypatch.setattr(fly, "FOLDER", tmp_path)
    cells = [(4, "random", 0.9), (4, "random", 0.8), (8, "random", 0.7), (8, "symmetric_swap", 0.5)]
    rows = [
        dict(zip(("n_robots", "scenario", "threshold"), c, strict=True)) | {"model": "any_seed0.zip"} for c in cells
    ]
    (tmp_path / "thresholds.json").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert fly.tuned("any", "random", 4) == ["any_seed0.zip@0.8"], "the last that was tried"
    assert fly.tuned("any", "random", 8) == ["any_seed0.zip@0.7"]
    assert fly.tuned("any", "symmetric_swap", 8) == ["any_seed0.zip@0.5"]
    assert fly.tuned("any", "symmetric_swap") == [], "it is the threshold for all"


def test_tables_of_flown_episodes(tmp_path):
    rows = fly.compare(
        ({"preset": "paper"}, ["full", "cpa:0.65:1.5", "none"], "symmetric_swap", make_config("paper"), 30)
    )
    assert [row["policy"] for row in rows] == ["full", "cpa:0.65:1.5", "none"]
    full, rule, none = rows
    assert full["against_full"]["only_policy"] == rule["against_rule"]["only_policy"] == 0
    assert (
        none["against_full"]["only_policy"]
        == none["collisions"] - full["collisions"] + none["against_full"]["only_rival"]
    )
    assert none["requests"] == 0 < rule["requests"] < full["requests"] == full["possible_requests"]
    (tmp_path / "test.json").write_text("".join(json.dumps(row) + "\n" for row in rows))
    text = page.main_table(tune_rules.read_rows(tmp_path / "test.json"), "paper")
    assert f"| symmetric swap | `none` | {none['collisions']}/30 [" in text


def test_table_of_teams_shows_models_beside_the_rule_of_their_cell():
    model = "studies/swarm/data/any_seed0.zip"

    def row(scenario, policy, collisions, share, high, rule="cpa:1:1"):
        against = {"against_full": {"high": high}, "against_rule": {"rival": rule}}
        keys = {"n_robots": 6, "scenario": scenario, "policy": policy}
        return keys | {"collisions": collisions, "episodes": 4000, "request_share": share} | against

    policies = {
        "full": (1, 1, 0),
        "cpa:1:1": (30, 0.2, 0.009),
        f"{model}@0.5": (9, 0.1, 0.004),
        f"{model.replace('0', '1')}@0.9": (12, 0.05, 0.006),
    }
    rows = [row(name, policy, *figures) for name in page.NAMES[:-1] for policy, figures in policies.items()]
    rows += [row(page.NAMES[-1], k, *v, rule="full") for k, v in policies.items() if k != "cpa:1:1"]
    lines = page.teams_table(rows).splitlines()[2:]
    assert lines[0] == "| 6 | `full` " + "| 1/4000, 100.00% " * 4 + "|"
    assert lines[1] == "| 6 | best rule " + "| 30/4000, 20.00% " * 3 + "| none is safe |"
    cells = ["**9/4000, 10.00%** (50%), δ = 0.5 "] * 3 + ["**9/4000, 10.00%** (10%), δ = 0.5 "]
    assert lines[2] == f"| 6 | any, seed 0 | {'| '.join(cells)}|"
    cells = ["12/4000, 5.00% (25%), δ = 0.9 "] * 3 + ["12/4000, 5.00% (5%), δ = 0.9 "]
    assert lines[3] == f"| 6 | any, seed 1 | {'| '.join(cells)}|"
    assert len(lines) == 4
    rows.append(row(page.NAMES[1], model.replace("0", "2") + "@0.5", 0, 0.02, 0.006))
    assert page.teams_table(rows).splitlines()[-1] == "| 6 | any, seed 2 | - | 0/4000, 2.00% (10%), δ = 0.5 | - | - |"
    rows = [row for row in rows if row["scenario"] != page.NAMES[0]]
    assert page.teams_table(rows).splitlines()[2].startswith("| 6 | `full` | - | 1/4000, "), "not flown yet"


def test_flights_of_teams_fill_their_table(monkeypatch):
    monkeypatch.setattr(fly, "TEAMS", (4, 6))  # flown in seconds
    rows = [row for job in fly.teams(4) for row in fly.compare(job)]
    assert {(row["n_robots"], row["scenario"]) for row in rows} == {(n, name) for n in (4, 6) for name in page.NAMES}
    lines = page.teams_table(rows).splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines] == sorted(line.split(" | ")[0] for line in lines)
    assert {line.split("|")[1].strip() for line in lines} == {"4", "6"}
    assert all(line.count("|") == 7 for line in lines)


@pytest.mark.parametrize("name", fly.UNSEEN)
@pytest.mark.parametrize("preset", ["paper", "dense"])
def test_unseen_scenarios_are_other_ones_and_gone_after_the_flight(name, preset):
    config = make_config(preset)
    for seed in range(20):
        starts, goals = fly.UNSEEN[name](config.n_robots, config.space, np.random.default_rng(seed))
        assert starts.shape == goals.shape == (config.n_robots, 3)
        for points in (starts, goals):
            assert fly.apart(points) >= config.space.spacing - 1e-9
    known = dict(SCENARIOS)
    rows = fly.compare_unseen(({"preset": preset}, ["full", "none"], name, config, 60))
    assert known == SCENARIOS
    assert [row["scenario"] for row in rows] == [name] * 2
    assert rows[1]["collisions"] > rows[0]["collisions"], "robots meet there"
    assert page.unseen_table(rows).count(f"| {name.replace('_', ' ')} |") == 2


def test_rows_of_other_keys_stay(tmp_path):
    path = tmp_path / "rows.json"
    assert tune_rules.read_rows(path) == []
    tune_rules.replace_rows(path, [{"a": 1, "b": 1}, {"a": 1, "b": 2}, {"a": 2, "b": 3}], ("a",))
    tune_rules.replace_rows(path, [{"a": 1, "b": 4}], ("a",))
    assert tune_rules.read_rows(path) == [{"a": 2, "b": 3}, {"a": 1, "b": 4}]


def test_rows_of_an_earlier_rule_do_not_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(fly, "QUICK", 1)
    for rule in ("none", "full"):
        rules = dict.fromkeys(fly.NAMES, rule)
        monkeypatch.setattr(fly, "best_rules", lambda preset, n_robots=None, rules=rules: rules)
        command = "asking --quick --preset paper --scenario random --jobs 1 --out"
        fly.main([*command.split(), str(tmp_path)])
    policies = {row["policy"] for row in tune_rules.read_rows(tmp_path / "asking.json")}
    assert policies == {"full", fly.models("paper")[0]}


def test_interventions_change_the_steps_that_they_should():
    one = tune_rules.cell("none", "symmetric_swap", make_config("paper"))
    rows = fly_all([one], 8, tune_rules.TEST)[one]
    number = next(k for k, row in enumerate(rows) if row["collided"])
    collided, end, pair = fly.replay(one, number)
    assert (collided, end) == (True, rows[number]["steps"])
    everybody = fly.INTERVENTIONS["everybody asks everybody"]
    assert fly.replay(one, number, everybody, pair, range(end, 100)) == (collided, end, pair)
    assert not fly.replay(one, number, everybody, pair, range(100))[0]
    asked = np.zeros((4, 4), dtype=bool)
    each_other = fly.INTERVENTIONS["the two ask each other"](asked.copy(), 1, 3)
    assert {tuple(map(int, place)) for place in np.argwhere(each_other)} == {(1, 3), (3, 1)}
    third = fly.INTERVENTIONS["all others ask the two"](asked.copy(), 1, 3)
    assert {tuple(map(int, place)) for place in np.argwhere(third)} == {(0, 1), (0, 3), (2, 1), (2, 3)}


def test_thresholds_are_kept_cell_by_cell_and_the_smallest_is_written_into_the_model(tmp_path, monkeypatch):
    path, table = tmp_path / "model.zip", tmp_path / "thresholds.json"
    path.write_bytes((pretrained_folder("quad-swarm-paper") / "model.zip").read_bytes())
    other_cell = {"model": str(path), "scenario": "symmetric_swap", "n_robots": 4, "threshold": 0.3, "safe": True}
    stale = {"model": str(path), "scenario": "random", "n_robots": 4, "threshold": 0.1, "safe": True}
    table.write_text("".join(json.dumps(row) + "\n" for row in (other_cell, stale)))
    words = ["tune_thresholds.py", str(path), "--scenario", "random", "--quick", "--jobs", "1", "--json", str(table)]
    monkeypatch.setattr(sys, "argv", words)
    tune_thresholds.main()
    rows = tune_rules.read_rows(table)
    assert rows[0] == other_cell
    assert stale not in rows
    chosen = rows[-1]
    assert chosen["scenario"] == "random"
    assert chosen["safe"]
    assert chosen["threshold"] > 0.3
    assert MADDPG.load(path, device="cpu").policy.threshold == 0.3


def test_a_threshold_needs_a_reserve():
    standard, share = tune_thresholds.STANDARDS["preset"]
    assert tune_thresholds.has_reserve(Comparison(12000, 17, 1), standard.margin, share)
    assert not tune_thresholds.has_reserve(Comparison(12000, 17, 0), standard.margin, share)
    standard, share = tune_thresholds.STANDARDS["team"]
    assert tune_thresholds.has_reserve(Comparison(4000, 7, 2), standard.margin, share)
    assert not tune_thresholds.has_reserve(Comparison(4000, 7, 1), standard.margin, share)
    assert Comparison(12000, 25, 0).as_safe, "though it would do without"


def test_ppo_is_trained_and_flown(tmp_path, monkeypatch):
    table = tmp_path / "ppo.json"
    words = ["ppo.py", "--price", "0.05", "--steps", "2048", "--episodes", "3", "--models", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--json", str(table)])
    ppo.main()
    rows = tune_rules.read_rows(table)
    assert len(rows) == 4 * len(ppo.THRESHOLDS)
    shares = [row["request_share"] for row in rows if row["scenario"] == "random"]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[-1]
    assert page.reference_table(rows, "price", "threshold").count("/3, ") == len(rows)


def test_forks_differ_by_the_request_that_is_turned_round_and_by_nothing_else(monkeypatch):
    env = gymnasium.make("QuadSwarm-v0", **ppo.env_kwargs(0.0))
    model = MADDPG("PairPolicy", env, policy_kwargs={"pair_credit": True}, buffer_size=100, seed=0, device="cpu")
    monkeypatch.setattr(counterfactual, "SWARMS", 4)
    source = counterfactual.Forks(model, 0)
    monkeypatch.setattr(counterfactual, "HELD", 0)
    labels = source.fork()
    assert labels.obs.shape[0] == labels.gain.shape[0] == 4 * 4
    assert not labels.gain.any(), "nothing was turned round"
    pos = source.task.swarm.pos.copy().reshape(13, 4, 4, 3)
    assert (pos == pos[:1]).all(), "forks leave the swarms where they are"
    monkeypatch.setattr(counterfactual, "HELD", 3)
    gains = np.concatenate([source.fork().gain for _ in range(6)])
    assert 0 < (gains != 0).mean() < 1


def test_a_regression_on_forks_is_trained_and_flown(tmp_path, monkeypatch):
    table = tmp_path / "counterfactual.json"
    words = [
        "counterfactual.py",
        "--forks",
        "2",
        "--episodes",
        "3",
        "--models",
        str(tmp_path),
        "--json",
        str(table),
    ]
    monkeypatch.setattr(sys, "argv", words)
    counterfactual.main()
    rows = tune_rules.read_rows(table)
    assert len(rows) == 4 * len(counterfactual.PRICES)
    shares = [row["request_share"] for row in rows if row["scenario"] == "symmetric_swap"]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[-1]
    assert page.reference_table(rows, "price").count("/3, ") == len(rows)
