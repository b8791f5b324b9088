"""The scripts behind docs/results.md, with few episodes."""

import itertools
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from PIL import Image

from quad_swarm.evaluation.evaluation import fly_all
from quad_swarm.evaluation.flight import first_episode, run_episodes
from quad_swarm.evaluation.inference import Comparison
from quad_swarm.evaluation.rows import read_rows, write_rows
from quad_swarm.task.rules import parse_rule
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS
from sb3_maddpg import MADDPG
from sb3_maddpg.hub.pretrained import pretrained_folder
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from studies.swarm import (
    checkpoints,
    counterfactual,
    dual,
    fly,
    ppo,
    protocol,
    requests,
    tune_rules,
    tune_thresholds,
    unseen,
)
from studies.swarm import report as page
from studies.swarm.experiment import Experiment, Job, condition, known_rows


def test_every_rule_of_every_family_can_be_read():
    families = tune_rules.families()
    assert {"distance", "cpa", "random", "event"} <= set(families)
    for rules in families.values():
        assert len(set(rules)) == len(rules)
        for rule in rules:
            parse_rule(rule)


def test_hopeless_is_what_collides_clearly_more_often():
    assert protocol.hopeless(Comparison(800, 9, 0))
    assert not protocol.hopeless(Comparison(800, 1, 0))


@pytest.mark.slow
def test_stages_fly_every_episode_once_and_stop_where_there_is_no_hope(monkeypatch):
    monkeypatch.setattr(protocol, "STAGES", (10, 30, 60))
    full, all_60 = protocol.fly_validation(["full", "cpa:0.7:1.5"], "paper", "random", 60).values()
    figures, safe = protocol.in_stages("cpa:0.7:1.5", "paper", "random", full, False, flown=all_60[:10])
    same = [{key: row[key] for key in row if key != "solve_seconds"} for row in (*figures, *all_60)]
    assert same[:60] == same[60:]
    assert not safe, "60 episodes prove nothing"
    collisions = protocol.fly_validation(["full"], "paper", "symmetric_swap", 60)["full"]
    figures, safe = protocol.in_stages("none", "paper", "symmetric_swap", collisions, False)
    assert (len(figures), safe) == (10, False)


@pytest.mark.slow
def test_teams_of_another_size_need_fewer_episodes_and_fly_full_communication_only_as_far(monkeypatch):
    monkeypatch.setattr(protocol, "STAGES", (5, 10, 20))
    monkeypatch.setattr(protocol, "OF_TEAM", protocol.Standard(0.3, 10))
    rival: list[dict[str, float]] = []
    figures, safe = protocol.in_stages("distance:4", "dense", "random", rival, False, 5)
    assert (len(figures), len(rival), safe) == (10, 10, True)
    figures, safe = protocol.in_stages("distance:4", "dense", "random", rival, False)
    assert (len(figures), len(rival), safe) == (20, 20, False), "a preset's own team has a standard of its own"


@pytest.mark.slow
def test_rules_are_tuned_for_each_size_of_the_team(tmp_path, monkeypatch):
    table = tmp_path / "team_rules.json.gz"
    words = ["tune_rules.py", "--preset", "dense", "--scenario", "random", "--family", "random", "--quick"]
    monkeypatch.setattr(sys, "argv", [*words, "--n-robots", "3", "4", "--jobs", "1", "--json", str(table)])
    tune_rules.main()
    rows = read_rows(table)
    assert [row["n_robots"] for row in rows] == [3, 4]
    assert rows[1]["possible_requests"] > rows[0]["possible_requests"]
    monkeypatch.setattr(protocol, "DATA", tmp_path)
    assert protocol.best_rules("dense", 3)["random"] == rows[0]["rule"]
    assert protocol.best_rules("dense", 3)["random_swap"] == "full", "not tuned"
    assert protocol.best_rules("dense", 5)["random"] == "full"


def test_thresholds_of_a_model_for_all_sizes_are_those_of_the_size_that_flies(tmp_path, monkeypatch):
    monkeypatch.setattr(protocol, "models", lambda recipe: ["any_seed0.zip"])
    monkeypatch.setattr(protocol, "DATA", tmp_path)
    cells = [(4, "random", 0.9), (4, "random", 0.8), (8, "random", 0.7), (8, "symmetric_swap", 0.5)]
    rows = [
        dict(zip(("n_robots", "scenario", "threshold"), c, strict=True)) | {"model": "any_seed0.zip"} for c in cells
    ]
    write_rows(tmp_path / "thresholds.json.gz", rows)
    assert protocol.tuned("any", "random", 4) == ["any_seed0.zip@0.8"], "the last that was tried"
    assert protocol.tuned("any", "random", 8) == ["any_seed0.zip@0.7"]
    assert protocol.tuned("any", "symmetric_swap", 8) == ["any_seed0.zip@0.5"]
    assert protocol.tuned("any", "symmetric_swap") == [], "it is the threshold for all"


def test_tables_of_flown_episodes(tmp_path):
    policies = ["full", "cpa:0.65:1.5", "none"]
    job = Job({"preset": "paper"}, policies, "symmetric_swap", make_config("paper"), 30, protocol.EARLIER)
    rows = fly.compare(job)
    assert [row["policy"] for row in rows] == ["full", "cpa:0.65:1.5", "none"]
    full, rule, none = rows
    assert full["against_full"]["only_policy"] == rule["against_rule"]["only_policy"] == 0
    assert (
        none["against_full"]["only_policy"]
        == none["collisions"] - full["collisions"] + none["against_full"]["only_rival"]
    )
    assert none["requests"] == 0 < rule["requests"] < full["requests"] == full["possible_requests"]
    write_rows(tmp_path / "test.json.gz", rows)
    text = page.main_table(read_rows(tmp_path / "test.json.gz"), "paper")
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


@pytest.mark.slow
def test_flights_of_teams_fill_their_table(monkeypatch):
    monkeypatch.setattr(fly, "TEAMS", (4, 6))  # flown in seconds
    jobs = [job._replace(episodes=4, seed=protocol.TEST) for job in fly.teams()]
    rows = [row for job in jobs for row in fly.compare(job)]
    assert {(row["n_robots"], row["scenario"]) for row in rows} == {(n, name) for n in (4, 6) for name in page.NAMES}
    lines = page.teams_table(rows).splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines] == sorted(line.split(" | ")[0] for line in lines)
    assert {line.split("|")[1].strip() for line in lines} == {"4", "6"}
    assert all(line.count("|") == 7 for line in lines)


@pytest.mark.parametrize("name", unseen.UNSEEN)
@pytest.mark.parametrize("preset", ["paper", "dense"])
def test_unseen_scenarios_are_other_ones(name, preset):
    config = make_config(preset)
    for seed in range(20):
        starts, goals = unseen.UNSEEN[name](config.n_robots, config.space, np.random.default_rng(seed))
        assert starts.shape == goals.shape == (config.n_robots, 3)
        for points in (starts, goals):
            assert unseen.apart(points) >= config.space.spacing - 1e-9
    known = list(SCENARIOS)
    job = Job({"preset": preset}, ["full", "none"], name, config, 60, protocol.EARLIER)
    rows = fly.compare_unseen(job)
    assert list(SCENARIOS) == known
    assert [row["scenario"] for row in rows] == [name] * 2
    assert rows[1]["collisions"] > rows[0]["collisions"], "robots meet there"
    assert page.unseen_table(rows).count(f"| {name.replace('_', ' ')} |") == 2


def test_rows_of_other_keys_stay(tmp_path):
    path = tmp_path / "rows.json"
    for experiment in (Experiment(path, "a"), Experiment(None, "a")):
        assert experiment.rows() == []
        experiment.keep([{"a": 1, "b": 1}, {"a": 1, "b": 2}, {"a": {"c": 2}, "b": 3}])
        experiment.keep([{"a": 1, "b": 4}])
        assert experiment.rows() == [{"a": {"c": 2}, "b": 3}, {"a": 1, "b": 4}]
        experiment.keep([{"a": 5, "b": 4}], "b")
        assert experiment.rows() == [{"a": {"c": 2}, "b": 3}, {"a": 5, "b": 4}]
    assert read_rows(path) == experiment.rows()


def test_what_has_flown_as_many_of_the_same_episodes_is_not_missing(tmp_path):
    experiment = Experiment(tmp_path / "rows.json.gz", "n", "scenario", "policy")
    job = Job({"n": 4}, ["full", "none"], "random", make_config("paper"), 5, seed=1)
    row = {"n": 4, "scenario": "random", "policy": "full", "set": 1, "episodes": 5}
    experiment.keep([row])
    assert experiment.missing([job]) == [job], "one policy has not"
    experiment.keep([row | {"policy": "none"}])
    assert experiment.missing([job]) == []
    others = [job._replace(episodes=6), job._replace(seed=2), job._replace(keys={"n": 5})]
    others += [job._replace(scenario="random_swap"), job._replace(policies=["full", "distance:4"])]
    assert experiment.missing([job, *others]) == others
    experiment.keep([{"n": 4, "scenario": "random_swap", "policy": policy} for policy in job.policies])
    assert others[3] not in experiment.missing(others), "its rows do not say how many"


def test_a_table_is_read_again_when_it_has_changed(tmp_path):
    path = tmp_path / "rows.json"
    assert known_rows(path) == []
    write_rows(path, [{"a": 1}])
    rows = known_rows(path)
    assert rows == [{"a": 1}]
    assert known_rows(path) is rows, "parsed once"
    write_rows(path, [{"a": 1}, {"a": 2}])
    assert known_rows(path) == [{"a": 1}, {"a": 2}]


@pytest.mark.slow
def test_rows_of_an_earlier_rule_do_not_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(fly, "QUICK", 1)
    for rule in ("none", "full"):
        rules = dict.fromkeys(protocol.NAMES, rule)
        monkeypatch.setattr(fly, "best_rules", lambda preset, n_robots=None, rules=rules: rules)
        command = "asking --quick --preset paper --scenario random --jobs 1 --out"
        fly.main([*command.split(), str(tmp_path)])
    policies = {row["policy"] for row in read_rows(tmp_path / "asking.json.gz")}
    assert policies == {"full", protocol.models("paper")[0]}


def test_interventions_change_the_steps_that_they_should():
    one = condition("none", "symmetric_swap", make_config("paper"))
    rows = fly_all([one], 8, protocol.EARLIER)[one]
    number = next(k for k, row in enumerate(rows) if row["collided"])
    collided, end, pair = requests.replay(one, protocol.EARLIER, number)
    assert (collided, end) == (True, rows[number]["steps_counted"])
    everybody = requests.INTERVENTIONS["everybody asks everybody"]
    assert requests.replay(one, protocol.EARLIER, number, everybody, pair, range(end, 100)) == (collided, end, pair)
    assert not requests.replay(one, protocol.EARLIER, number, everybody, pair, range(100))[0]
    asked = np.zeros((4, 4), dtype=bool)
    each_other = requests.INTERVENTIONS["the two ask each other"](asked.copy(), 1, 3)
    assert {tuple(map(int, place)) for place in np.argwhere(each_other)} == {(1, 3), (3, 1)}
    third = requests.INTERVENTIONS["all others ask the two"](asked.copy(), 1, 3)
    assert {tuple(map(int, place)) for place in np.argwhere(third)} == {(0, 1), (0, 3), (2, 1), (2, 3)}


@pytest.mark.slow
def test_thresholds_are_kept_by_scenario_and_written_into_the_model_only_when_asked(tmp_path, monkeypatch):
    path, table = tmp_path / "model.zip", tmp_path / "thresholds.json.gz"
    path.write_bytes((pretrained_folder("quad-swarm-paper") / "model.zip").read_bytes())
    other_cell = {"model": str(path), "scenario": "symmetric_swap", "n_robots": 4, "threshold": 0.3, "safe": True}
    stale = {"model": str(path), "scenario": "random", "n_robots": 4, "threshold": 0.1, "safe": True}
    write_rows(table, [other_cell, stale])
    words = ["tune_thresholds.py", str(path), "--scenario", "random", "--quick", "--jobs", "1", "--json", str(table)]
    monkeypatch.setattr(sys, "argv", words)
    before = path.read_bytes()
    tune_thresholds.main()
    rows = read_rows(table)
    assert rows[0] == other_cell
    assert stale not in rows
    chosen = rows[-1]
    assert chosen["scenario"] == "random"
    assert chosen["safe"]
    assert chosen["threshold"] > 0.3
    assert path.read_bytes() == before, "nothing is written unless asked for"
    tune_thresholds.set_threshold(str(path), rows)
    assert MADDPG.load(path, device="cpu").policy.threshold == 0.3
    monkeypatch.setattr(sys, "argv", [*words, "--write"])
    with pytest.raises(SystemExit):
        tune_thresholds.main()  # so few episodes choose nothing


def test_a_threshold_needs_a_reserve():
    standard, share = tune_thresholds.STANDARDS["preset"]
    assert tune_thresholds.has_reserve(Comparison(12000, 17, 1), standard.margin, share)
    assert not tune_thresholds.has_reserve(Comparison(12000, 17, 0), standard.margin, share)
    standard, share = tune_thresholds.STANDARDS["team"]
    assert tune_thresholds.has_reserve(Comparison(4000, 7, 2), standard.margin, share)
    assert not tune_thresholds.has_reserve(Comparison(4000, 7, 1), standard.margin, share)
    assert Comparison(12000, 25, 0).as_safe(), "though it would do without"


@pytest.mark.slow
def test_ppo_is_trained_and_flown(tmp_path, monkeypatch):
    table = tmp_path / "ppo.json"
    words = ["ppo.py", "--price", "0.05", "--steps", "8192", "--episodes", "3", "--models", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--json", str(table)])
    ppo.main()
    rows = read_rows(table)
    assert len(rows) == 4 * len(ppo.THRESHOLDS)
    shares = [row["request_share"] for row in rows if row["scenario"] == "random"]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[-1]
    assert page.reference_table(rows, "price", "threshold").count("/3, ") == len(rows)


@pytest.mark.slow
def test_what_ppo_trains_in_version_2_flies_with_any_number_of_robots(tmp_path, monkeypatch):
    monkeypatch.setattr(ppo, "TEAMS", 8)
    untrained = ppo.train("flight_v2", 0.2, 0, 0).policy.state_dict()
    words = ["ppo.py", "--recipe", "flight_v2", "--price", "0.2", "--steps", "1024", "--models", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    ppo.main()
    path = tmp_path / "ppo_flight_v2_price0.2_seed0.zip"
    trained = MADDPG.load(path).policy.state_dict()
    changed = [name for name, weight in trained.items() if "actor.net" in name and not weight.equal(untrained[name])]
    assert len(changed) >= 8, "PPO has trained MADDPG's actor"
    config = make_config("flight-v2", n_robots=5)
    rows = run_episodes(condition(f"{path}@0.4", "random_swap", config), [first_episode(1)])
    assert 0 < rows[0]["requests"] / rows[0]["possible_requests"] < 1


@pytest.mark.slow
def test_models_from_different_times_of_a_training_are_flown(tmp_path, monkeypatch):
    run, model = tmp_path / "faithful_0" / "maddpg" / "QuadSwarm-v0_1", protocol.ROOT / protocol.models("faithful")[0]
    run.mkdir(parents=True)
    for name in ("rl_model_1000_steps", "rl_model_2000_steps", "best_model", "QuadSwarm-v0"):
        shutil.copy(model, run / f"{name}.zip")
    table = tmp_path / "checkpoints.json.gz"
    words = ["checkpoints.py", str(run), "--choosing", "1", "--episodes", "2", "--jobs", "1", "--models", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--json", str(table)])
    checkpoints.main()
    rows = read_rows(table)
    assert len({(row["choice"], row["scenario"]) for row in rows}) == len(rows) == 16
    assert {(row["run"], row["episodes"], row["set"]) for row in rows} == {("faithful_0", 2, protocol.EARLIER)}
    assert len({row["requests"] for row in rows if row["scenario"] == "random"}) == 1, "all are the same model"
    assert len(page.checkpoints_table(rows).splitlines()) == 6


def test_forks_differ_by_the_request_that_is_turned_round_and_by_nothing_else(monkeypatch):
    env = gymnasium.make("QuadSwarm-v0", **ppo.env_kwargs(0.0))
    model = MADDPG(
        "PairPolicy", env, policy_kwargs={"pair_credit": True}, buffer_size=100, batch_size=100, seed=0, device="cpu"
    )
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


@pytest.mark.slow
def test_a_regression_on_forks_is_trained_and_flown(tmp_path, monkeypatch):
    table = tmp_path / "counterfactual.json"
    words = ["counterfactual.py", "--forks", "2", "--episodes", "3", "--models", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--json", str(table)])
    counterfactual.main()
    rows = read_rows(table)
    assert len(rows) == 4 * len(counterfactual.PRICES)
    shares = [row["request_share"] for row in rows if row["scenario"] == "symmetric_swap"]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[-1]
    assert page.reference_table(rows, "price").count("/3, ") == len(rows)


def test_the_test_set_is_one_that_nothing_was_chosen_on():
    sealed = dict.fromkeys(("test", "teams", "counts", "quadrants"), protocol.TEST)
    sealed |= {"flight": protocol.FLIGHT_TESTS[12], "flight_sixteen_sealed": protocol.FLIGHT_TESTS[16]}
    sealed |= dict.fromkeys(("world", "delays", "delay_check", "paper", "plants"), protocol.WORLDS)
    for name, part in fly.PARTS.items():
        assert part.seed == sealed.get(name, protocol.EARLIER), name
    assert len({protocol.VALIDATION, protocol.EARLIER, protocol.EARLIER_TEAMS, protocol.TEST}) == 4


def test_requests_are_counted_over_whole_episodes_as_in_the_paper():
    job = Job({"preset": "paper"}, ["full", "distance:4"], "random", make_config("paper"), 3, protocol.EARLIER)
    full, rule = fly.whole(job)
    assert full["requests_flown"] == 3 * 100 * 12
    assert full["steps_flown"] == rule["steps_flown"] == 300
    assert 0 < rule["requests_flown"] < full["requests_flown"]


def test_the_papers_asymmetric_swap_has_a_robot_in_each_quadrant():
    (job,) = fly.quadrants()
    for seed in range(20):
        starts, goals = SCENARIOS["asymmetric_swap"](4, job.config.space, np.random.default_rng(seed))
        assert [(x > 0, y > 0) for x, y, _ in starts] == [(True, True), (False, True), (False, False), (True, False)]
        assert (np.sign(goals[:, :2]) == -np.sign(starts[:, :2])).all()


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), reason="no Chromium")
def test_hero_is_an_animation_in_two_themes(tmp_path):
    # A process of its own: Playwright allows one driver in a process, and other tests have one
    words = ["-m", "studies.swarm.hero", "--policy", "none", "full", "--n-robots", "2", "--size", "300", "200"]
    words += ["--seconds", "0.4", "--speed", "0.5", "--fps", "5", "--format", "webp", "gif", "--out", str(tmp_path)]
    subprocess.run([sys.executable, *words], check=True, cwd=protocol.ROOT, timeout=500)
    first = {}
    for theme, suffix in itertools.product(("light", "dark"), ("webp", "gif")):
        with Image.open(tmp_path / f"hero-{theme}.{suffix}") as film:
            assert (film.size, film.n_frames) == ((300, 200), 5)
            first[theme, suffix] = np.asarray(film.convert("RGB")).astype(int)
            film.seek(4)
            assert np.abs(np.asarray(film.convert("RGB")) - first[theme, suffix]).max() > 50, "something moves"
    assert first["light", "webp"].mean() > 160
    assert first["dark", "webp"].mean() < 80
    assert np.abs(first["dark", "webp"] - first["dark", "gif"]).mean() < 10


@pytest.mark.slow
def test_the_price_rises_while_fewer_collide_than_tolerated_and_falls_otherwise():
    prices = {}
    for rate in (0.0, 1.0):
        deaf = {"preset": "flight-v2", "observation": "state", "world": {"radio": {"loss": 1.0}}}
        env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", 8, scenario="symmetric_swap", **deaf))
        model = MADDPG("PairPolicy", env, learning_starts=1000, buffer_size=1000, batch_size=100, seed=0, device="cpu")
        model.learn(900, callback=dual.TolerateCollisions(rate, price=0.1))
        prices[rate] = model.threshold_price or ()
    assert prices[0.0] == pytest.approx((dual.LOWEST / dual.WIDTH, dual.LOWEST * dual.WIDTH)), "most collide"
    assert prices[1.0][0] > 0.1 / dual.WIDTH
