"""The settings of a world: what is accepted, and what is refused with its path, its value and what is allowed."""

import dataclasses
import json
import pickle
from pathlib import Path

import foreign
import numpy as np
import pytest

from quad_swarm import QuadSwarmEnv, QuadSwarmParallelEnv
from quad_swarm.planner import PROBLEMS, PlannerConfig
from quad_swarm.quadrotor import QuadrotorModel, QuadrotorParams
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import PRESET_VERSION, PRESETS, SwarmConfig, make_config, plant_of
from quad_swarm.world.swarm import Swarm

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
        ({"radio": {"range": 0}}, r"radio\.range=0: it must be greater than 0"),
        ({"radio": {"range": 0.5}}, r"radio\.range=0\.5: the radio must carry .*planner\.separation=0\.6"),
        ({"radio": {"half_distance": 0.5}}, r"radio\.half_distance=0\.5: .* half .*planner\.separation=0\.6"),
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


@pytest.mark.parametrize(
    "given", [lambda world: make_config("paper", world), lambda world: make_config("paper", **world)]
)
def test_the_spacing_follows_a_separation_that_exceeds_it(given):
    assert given({"radius": 0.6}).space.spacing == pytest.approx(1.6), "the margin of the preset, 0.4 m"
    assert given({"radius": "0.6"}).space.spacing == pytest.approx(1.6)
    assert given({"planner": {"separation": 3}}).space.spacing == pytest.approx(3.4)
    assert given({"radius": 0.6, "space": {"half_width": 5}}).space.spacing == pytest.approx(1.6)
    assert given({"radius": 0.6, "space": {"spacing": 1.3}}).space.spacing == 1.3
    assert given({"planner": {"separation": 1e4}}).space.spacing == 1e4, "the limit of lengths"
    assert given({"radius": 0.5}).space == PRESETS["paper"].space, "robots 1 m apart keep their separation of 1 m"
    assert given({"radius": 0.1}).space == PRESETS["paper"].space
    for world in ({"radius": 0.6, "space": {"spacing": 1}}, {"space": {"spacing": 0.5}}):
        with pytest.raises(ValueError, match=r"^space\.spacing=[01.5]+: .* at least 2 \* radius = [01]\.[26]"):
            given(world)
    with pytest.raises(ValueError, match=r"^space\.spacing=1:"):
        SwarmConfig(radius=0.6, planner=PlannerConfig(separation=1.2))


@pytest.mark.parametrize(
    ("space", "low", "high"),
    [
        ({"half_width": 4.7}, (-4.8, -4.8, 0.48), (4.8, 4.8, 2.4)),  # fits: nothing changes
        ({"half_width": 10}, (-10.3, -10.3, 0.48), (10.3, 10.3, 2.4)),  # a margin of 0.3 m as in the preset
        ({"heights": [4, 8]}, (-4.8, -4.8, 0.48), (4.8, 4.8, 8.3)),
        ({"heights": [0.2, 1]}, (-4.8, -4.8, -0.02), (4.8, 4.8, 2.4)),
        ({"circle_radius": [5, 6]}, (-6.45, -6.45, 0.48), (6.45, 6.45, 2.4)),
        ({"sector_radius": [2, 5]}, (-5.3, -5.3, 0.48), (5.3, 5.3, 2.4)),
        ({"circle_jitter": 2.0}, (-5.3, -5.3, -1.37), (5.3, 5.3, 4.25)),
    ],
)
def test_the_workspace_grows_with_a_room_that_exceeds_it(space, low, high):
    planner = make_config("paper", space=space).planner
    assert planner.workspace_low == pytest.approx(low)
    assert planner.workspace_high == pytest.approx(high)
    given = make_config("paper", space=space, planner={"workspace_high": (9, 9, 9)}).planner
    assert given.workspace_high == (9, 9, 9)
    assert given.workspace_low == pytest.approx(low)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"planner": {"max_tilt": 1.047}, "quadrotor": {"roll_gain": 2}}, r"max_tilt=1\.047: .* 120 degrees.* 0\.785"),
        ({"planner": {"max_tilt": 1.3}, "mismatch": 0.2}, r"planner\.max_tilt=1\.3: .* use at most 1\.161"),
        ({"planner": {"max_yaw_rate": 90}}, r"max_yaw_rate=90 is in rad/s: .* half a turn per step, 31\.41"),
        ({"planner": {"dt": 0.01}}, r"planner\.horizon=10 .* 0\.1 s ahead, .* use planner\.horizon=72"),
        (
            {"quadrotor": {"roll_time_constant": 237, "pitch_time_constant": 232, "climb_time_constant": 337}},
            r"quadrotor\.roll_time_constant=237 s.* time constants are in seconds",
        ),
        ({"space": {"heights": [-1e4, 1e4], "circle_jitter": 1e3}}, r"circle_jitter=1000\.0: .* it must be at most 0"),
        ({"space": {"circle_radius": [2, 9999], "circle_jitter": 5}}, r"circle_jitter=5\.0: .* it must be at most 1"),
        ({"space": {"sector_radius": [-2, 4]}}, r"sector_radius=\(-2\.0, 4\.0\): a radius must not be negative"),
    ],
)
def test_what_cannot_be_flown_is_refused_with_a_value_that_works(world, message):
    with pytest.raises(ValueError, match=message) as caught:
        make_config("paper", world)
    assert "\n" not in str(caught.value)


def test_what_is_recommended_is_accepted():
    make_config("paper", planner={"max_tilt": 0.785}, world={"quadrotor": {"roll_gain": 2, "pitch_gain": 2}})
    make_config("paper", planner={"max_tilt": 1.161}, world={"mismatch": 0.2})
    with pytest.warns(DoubtfulWorld):
        make_config("paper", planner={"max_yaw_rate": 31.41})
    make_config("paper", planner={"dt": 0.01, "horizon": 72}, world={"max_steps": 1000})


GOALS = np.array([[-2.0, 0, 1.5], [2.0, 0, 1.5]])
FLIGHTS = [
    (GOALS, [[7, 0, 1.5], [-2, 0, 1.5]], r"goals\[0\]=\[7\.0, 0\.0, 1\.5\] is 2\.2 m outside the workspace"),
    (GOALS, [[2, 0, 1.5], [-2, 0, 0]], r"goals\[1\]=.* is 0\.48 m outside"),
    ([[-900, 0, 1], [2, 0, 1]], GOALS, r"starts\[0\]=.* is 895 m outside"),
    ([[0, 0, 1], [0, 0, 1]], GOALS, r"starts\[0\] and starts\[1\] are 0 m apart.* at least 0\.6 m apart"),
    ([[0, 0, 1], [0, 0.59, 1]], GOALS, r"starts\[0\] and starts\[1\] are 0\.59 m apart"),
    (GOALS, [[0, 0, 1], [0, 0, 1]], r"goals\[0\] and goals\[1\] are 0 m apart.* at least 0\.6 m apart"),
    (GOALS, [[0, 0, 1], [0, 0.5, 1]], r"goals\[0\] and goals\[1\] are 0\.5 m apart"),
    (GOALS, [[0, 0, 1]], r"goals must be 2 finite points, shape \(2, 3\)"),
    (GOALS, [[0, 0, 1], [0, np.nan, 1]], "goals must be 2 finite points"),
    (GOALS, [[0, 0, 1], [0, "x", 1]], "goals must be 2 finite points"),
    (GOALS, np.ma.array(GOALS, mask=[[0, 0, 0], [0, 1, 0]]), "goals must be 2 finite points"),
    (np.array(GOALS) + 1j, GOALS, "starts must be 2 finite points"),
    (GOALS, [[0, 0, 1], [0, 1e5, 1]], "goals must be 2 finite points.* within 10000 m"),
]


@pytest.mark.parametrize(("starts", "goals", "message"), FLIGHTS)
def test_flights_that_do_not_fit_the_world_are_refused_at_every_entrance(starts, goals, message):
    config = make_config("paper", n_robots=2)
    options = {"starts": starts, "goals": goals}
    for fly in (
        lambda: config.check_flight(starts, goals),
        lambda: Swarm(config).reset(0, starts, goals),
        lambda: QuadSwarmEnv(n_robots=2).reset(options=options),
        lambda: QuadSwarmParallelEnv(n_robots=2).reset(options=options),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            fly()
        assert "\n" not in str(caught.value)


def test_what_robots_can_reach_from_the_border_is_accepted():
    config = make_config("paper", n_robots=2)
    beside = [[4.94, 0, 1.5], [-2, 0, 0.4]]  # at most half of the goal radius outside
    swarm = Swarm(config)
    swarm.reset(0, GOALS, beside)
    for _ in range(100):
        report = swarm.step(np.ones((1, 2, 1), bool))
    assert report.at_goal.all()
    for close in (0.6, 0.62):  # robots are pushed apart, but not by more than the goal radius
        swarm.reset(0, GOALS, [[0, 0, 1], [close, 0, 1]])
        for _ in range(100):
            report = swarm.step(np.ones((1, 2, 1), bool))
        assert report.at_goal.all()


def test_a_state_outside_is_no_reset():
    """Robots may leave the workspace in flight, and their states are restored as they are."""
    env = QuadSwarmEnv(n_robots=2)
    env.reset(seed=0)
    env.task.swarm.state[0, 0, 0] = 7.0
    other = QuadSwarmEnv(n_robots=2)
    other.load_state_dict(env.state_dict())
    assert other.task.swarm.state[0, 0, 0] == 7.0


@pytest.fixture
def fleet(monkeypatch):
    """Vehicles from outside."""
    for name, kind in {"boat": foreign.Boat, "stepper": foreign.Stepper, "thrifty": foreign.Thrifty}.items():
        monkeypatch.setitem(PROBLEMS, name, kind)


@pytest.mark.parametrize("planner", [{"problem": "boat"}, PlannerConfig(problem="boat")])
def test_vehicles_from_outside_are_not_judged_as_quadrotors(planner, fleet, recwarn):
    config = make_config("flight", planner=planner, quadrotor={"roll_time_constant": 5.0}, max_steps=3)
    assert (config.mismatch, config.flies_quadrotors) == (0.0, False)
    assert not [one for one in recwarn if issubclass(one.category, DoubtfulWorld)]
    costs = make_config("flight", planner={"problem": "thrifty"})
    assert (costs.mismatch, costs.flies_quadrotors) == (0.1, True)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"planner": {"problem": "bote"}}, "Unknown problem 'bote'; known: .*Did you mean 'boat'"),
        ({"planner": {"problem": "boat"}, "mismatch": 0.1}, "mismatch=0.1: .*'boat' has no such parameters"),
        ({"planner": {"problem": "stepper"}, "substeps": 5}, "substeps: Stepper says how its vehicles move in a whole"),
        ({"planner": {"problem": "stepper"}, "noise": {"wind": 1}}, "noise.wind or noise.gust: Stepper .*`derivative`"),
        ({"planner": {"problem": 3}}, "planner.problem=3"),
    ],
)
def test_worlds_that_a_vehicle_from_outside_cannot_fly_in_are_refused(world, message, fleet):
    with pytest.raises(ValueError, match=message):
        make_config("paper", world)


def test_the_planner_s_model_is_what_flies(fleet):
    state, u = np.zeros((1, 2, 9)), np.ones((1, 2, 4))
    plant = plant_of(make_config("paper", planner={"problem": "boat"}), 0.02, 1, 2)
    after = plant.step(state, u, np.zeros((1, 2, 2)), None)
    np.testing.assert_allclose(after[..., 3:5], (1 - np.exp(-0.4 * 0.02)) / 0.4, rtol=1e-6)
    assert not after[..., 5:].any()


def test_the_model_flies_each_robot_with_its_own_parameters():
    kinds = [QuadrotorParams(), QuadrotorParams(drag_x=1.0, gravity=9.0)]
    config = make_config("paper", {"vehicles": [{}, {"quadrotor": kinds[1]}]}, n_robots=3)
    rng = np.random.default_rng(0)
    x, u, air = rng.normal(size=(3, 3, 9)) / 4, rng.normal(size=(3, 3, 4)) / 4, rng.normal(size=(3, 3, 2))
    factors = rng.uniform(0.9, 1.1, (3, 3, 8))
    plant = plant_of(config, 0.02, 3, 3)
    for varied in (None, factors):
        flown = plant.step(x, u, air, varied)
        for robot, kind in enumerate((0, 1, 0)):
            some = None if varied is None else varied[:, robot]
            alone = QuadrotorModel(kinds[kind], 0.02).step(x[:, robot], u[:, robot], air[:, robot], some)
            assert np.array_equal(flown[:, robot], alone)


def test_vehicles_from_outside_may_differ_in_their_limits(fleet):
    config = make_config("paper", {"planner": {"problem": "boat"}, "vehicles": [{}, {"max_tilt": 0.1}]})
    swarm = Swarm(config)
    starts = np.array([[0.0, -3, 1.5], [0, 3, 1.5], [3, 0, 1.5], [-3, 0, 1.5]])
    swarm.reset(0, starts, starts * [-1, -1, 1])
    for _ in range(20):
        swarm.step(np.zeros((1, 4, 3), bool))
    assert np.isfinite(swarm.state).all()
    assert (np.abs(swarm.state[0, :, :3] - starts).max(axis=1) > 0.1).all()
    assert not swarm.state[..., 5:].any()
