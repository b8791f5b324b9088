"""The settings of a world: what is accepted, and what is refused with its path, its value and what is allowed."""

import dataclasses
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from quad_swarm.planner import PlannerConfig
from quad_swarm.world.presets import PRESET_VERSION, PRESETS, SwarmConfig, make_config

FROZEN = json.loads(Path(__file__).with_name(f"presets_v{PRESET_VERSION}.json").read_text())


def test_presets_are_frozen():
    """Results name the version of the presets. A new field needs a default that changes nothing."""
    for name, frozen in FROZEN.items():
        values = json.loads(json.dumps(dataclasses.asdict(PRESETS[name])))
        for part, value in frozen.items():
            found = {key: values[part][key] for key in value} if isinstance(value, dict) else values[part]
            assert found == value, (name, part)
    assert FROZEN.keys() == PRESETS.keys()


def test_replacing_by_the_same_changes_nothing():
    dense = PRESETS["dense"]
    assert make_config("dense", n_robots=None) == dense
    assert make_config("dense", radius=0.3) == dense


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_pickling_and_can_be_hashed_and_replaced(preset):
    config = PRESETS[preset]
    assert pickle.loads(pickle.dumps(config)) == config
    assert hash(make_config(preset)) == hash(config)
    assert dataclasses.replace(config, n_robots=3).n_robots == 3
    with pytest.raises(ValueError, match="n_robots=0: it must be greater than or equal to 2"):
        dataclasses.replace(config, n_robots=0)


def test_fields_are_replaced_one_by_one():
    config = make_config("dense", n_robots=5, planner={"separation": 0.7, "workspace_low": [-3, -3, 0.5]})
    assert (config.n_robots, config.planner.separation, config.planner.max_speed) == (5, 0.7, 4.0)
    assert config.planner.max_tilt == PRESETS["dense"].planner.max_tilt
    assert config.planner.workspace_low == (-3, -3, 0.5)
    world = {"quadrotor": {"drag_x": 0.1}, "goal_radius": 0.2}
    assert make_config("dense", world, n_robots=5).quadrotor.drag_x == 0.1


@pytest.mark.parametrize("number", [2, "2", 2.0, np.int64(2)])
def test_the_nearest_neighbours_can_be_set(number):
    assert make_config("paper", planner={"max_neighbours": number}).planner.max_neighbours == 2
    assert make_config("paper", planner={"max_neighbours": None}).planner.max_neighbours is None


def test_texts_are_read_as_what_they_stand_for():
    config = make_config("paper", radius="0.2", planner={"violation_weight": "1e5", "horizon": "8"})
    assert (config.radius, config.planner.violation_weight, config.planner.horizon) == (0.2, 1e5, 8)


def test_the_separation_follows_the_radius_unless_it_is_given():
    for preset, margin in (("paper", 0.0), ("dense", 0.04)):
        for radius in (0.12, 0.5):
            assert make_config(preset, radius=radius).planner.separation == pytest.approx(2 * radius + margin)
            assert make_config(preset, {"radius": radius}).planner.separation == pytest.approx(2 * radius + margin)
    assert make_config("paper", radius=0.5, planner={"separation": 1.2}).planner.separation == 1.2
    for make in (
        lambda: make_config("paper", radius=0.5, planner={"separation": 0.9}),
        lambda: make_config("paper", planner={"separation": 0.59}),
        lambda: SwarmConfig(radius=0.5, planner=PlannerConfig()),
    ):
        with pytest.raises(ValueError, match=r"^planner\.separation=0\.[569]+: it must be at least 2 \* radius"):
            make()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"planner": {"seperation": 1}}, "planner parameter 'seperation'.*Did you mean 'separation'"),
        ({"speed": 1}, "SwarmConfig parameter 'speed'"),
        ({"planner": {"dt": "fast"}}, r"planner\.dt='fast': it must be a valid number"),
        ({"planner": {"dt": 2}}, r"planner\.dt=2\.0: steps must not exceed 0\.65 s"),
        ({"planner": {"horizon": 9.5}}, r"planner\.horizon=9\.5: it must be a valid integer"),
        ({"planner": {"violation_weight": -1}}, r"planner\.violation_weight=-1: it must be greater than 0"),
        ({"planner": {"max_neighbours": 0}}, r"planner\.max_neighbours=0: it must be greater than 0"),
        ({"planner": {"workspace_low": [0, 0]}}, r"planner\.workspace_low=\[0, 0\]: it has too few entries"),
        ({"planner": 5}, "planner=5: it must be a mapping"),
        ({"radius": float("nan")}, "radius=nan: it must be a finite number"),
        ({"radius": -1}, "radius=-1: it must be greater than 0"),
        ({"collision_tolerance": 5}, r"collision_tolerance=5\.0: it must be less than 2 \* radius = 0\.6"),
        ({"memory": {"far": 1}}, "memory={'far': 1}: it must be a valid number"),
        ({"noise": -1}, "noise=-1: it must be a mapping"),
        ({"noise": {"pos": -1}}, r"noise\.pos=-1: it must be greater than or equal to 0"),
        ({"noise": {"vel": 1e300}}, r"noise\.vel=1e\+300: it must be less than or equal to 1000"),
        ({"radio": {"loss": 2.0}}, r"radio\.loss=2\.0: it must be less than or equal to 1"),
        ({"radio": {"delay": -1}}, r"radio\.delay=-1"),
        ({"space": {"spacing": -1}}, r"space\.spacing=-1"),
        ({"radio": {"delay": 10**9}}, r"radio\.delay=1000000000: it must be less than or equal to 1000"),
        ({"n_robots": 10**9}, "n_robots=1000000000: it must be less than or equal to 1000"),
        ({"space": {"spacing": 1e300}}, r"space\.spacing=1e\+300: it must be less than or equal to 10000"),
        ({"space": {"half_width": 1e300}}, r"space\.half_width=1e\+300: it must be less than"),
        ({"space": {"half_width": 0}}, r"space\.half_width=0: it must be greater than 0"),
        ({"space": {"heights": [2, 1]}}, r"space\.heights=\[2, 1\]: it must be the lowest value first"),
        ({"goal_radius": 1e300}, r"goal_radius=1e\+300: it must be less than or equal to 10000"),
        ({"radius": 10**400}, r"radius=10* \.\.\. 0*: it must be"),
        ({"radius": 10**5000}, "radius=<int>: it must be"),
        ({"planner": {"horizon": 10**9}}, r"planner\.horizon=1000000000: it must be less than or equal to 1000"),
        ({"planner": {"separation": 1e300}}, r"planner\.separation=1e\+300: it must be less than or equal to 10000"),
        ({"planner": {"max_climb_rate": 1e300}}, r"planner\.max_climb_rate=1e\+300: it must be less than"),
        ({"planner": {"max_tilt": 1e-300}}, r"planner\.max_tilt=1e-300: it must be greater than or equal to 0.000001"),
        ({"planner": {"max_yaw_rate": 1e-300}}, r"planner\.max_yaw_rate=1e-300: it must be 0, or at least 0.000001"),
        ({"quadrotor": {"roll_gain": 1e300}}, r"quadrotor\.roll_gain=1e\+300: it must be less than or equal to"),
        ({"quadrotor": {"gravity": 0}}, r"quadrotor\.gravity=0: it must be greater than 0"),
    ],
)
def test_nonsense_is_refused_in_one_line(values, message):
    for make in (lambda: make_config("paper", **values), lambda: make_config("paper", values)):
        with pytest.raises(ValueError, match=message) as caught:
            make()
        assert "\n" not in str(caught.value)
        assert type(caught.value) is ValueError


def test_what_is_given_twice_is_refused():
    with pytest.raises(ValueError, match=r"radius is given twice, as 0\.5 in `world` and as the argument 0\.4"):
        make_config("paper", {"radius": 0.5}, radius=0.4)
    with pytest.raises(ValueError, match=r"planner\.dt is given twice"):
        make_config("paper", {"planner": {"dt": 0.1}}, planner={"dt": 0.05})
    assert make_config("paper", {"planner": {"dt": 0.05}}, planner={"horizon": 20}).planner.dt == 0.05


@pytest.mark.parametrize("preset", ["papr", [], None])
def test_an_unknown_preset_is_refused(preset):
    with pytest.raises(ValueError, match="Unknown preset"):
        make_config(preset)
