"""What the files of an evaluation say about what was flown."""

import json

import pytest

from quad_swarm.evaluation.flight import Condition
from quad_swarm.evaluation.provenance import plant_name, provenance
from quad_swarm.jobs.journal import sources_digest
from quad_swarm.task.rules import RULES
from quad_swarm.world.presets import PRESETS, make_config
from quad_swarm.world.scenarios import SCENARIOS


def of(preset="paper", world=None, policy="none", max_steps=None):
    return provenance(Condition(policy, "random", make_config(preset, world), max_steps), preset, 3, "rti")


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_has_no_changes(preset):
    row = of(preset)
    assert row["world"] == {}
    assert (row["preset"], row["seed"], row["plant"], row["solver"]) == (preset, 3, "model", "rti")
    assert row["max_steps"] == PRESETS[preset].max_steps
    assert of(preset, max_steps=7)["max_steps"] == 7


@pytest.mark.parametrize(
    ("world", "changed"),
    [
        ({"noise": {"wind": 1}}, {"noise": {"wind": 1.0}}),
        ({"n_robots": 5}, {"n_robots": 5}),
        ({"radius": 0.4}, {"radius": 0.4, "planner": {"separation": 0.8}}),
        ({"quadrotor": "hummingbird"}, None),
        ({"space": {"circle_radius": [2.0, 2.5]}}, {"space": {"circle_radius": [2.0, 2.5]}}),
        ({"obstacles": {"listed": [{"position": [0, 0, 0], "radius": 0.1}]}}, None),
        ({"vehicles": [{"radius": 0.2, "quadrotor": "x500"}, {"max_speed": 2}]}, None),
        ({"plant": "rotorpy"}, {"plant": "rotorpy:crazyflie"}),
    ],
)
def test_changes_make_the_same_world_again(world, changed):
    row = json.loads(json.dumps(of(world=world)))
    assert changed is None or row["world"] == changed
    again, config = make_config("paper", row["world"]), make_config("paper", world)
    assert again.plant == plant_name(config) == row["plant"]
    assert {**vars(again), "plant": ""} == {**vars(config), "plant": ""}


def test_modules_of_custom_scenarios_and_rules_are_named(monkeypatch, tmp_path):
    assert "modules" not in of()

    def custom(n_robots, space, rng):
        raise NotImplementedError

    custom.__module__ = "my_scenarios_of_this_test"
    monkeypatch.setitem(SCENARIOS, "custom", custom)
    monkeypatch.setitem(RULES, "custom", (custom, ()))
    monkeypatch.syspath_prepend(str(tmp_path))
    found = []
    for text in ("ROOM = 1", "ROOM = 2"):
        (tmp_path / "my_scenarios_of_this_test.py").write_text(text)
        sources_digest.cache_clear()
        found.append(of()["modules"]["my_scenarios_of_this_test"])
    assert found[0] != found[1], "the same name, other code"


def test_other_code_of_the_package_is_seen(monkeypatch):
    before = of()["code_sha256"]
    assert before == sources_digest("quad_swarm")
    monkeypatch.setattr("quad_swarm.evaluation.provenance.sources_digest", lambda name: f"other {name}")
    assert of()["code_sha256"] == "other quad_swarm"
