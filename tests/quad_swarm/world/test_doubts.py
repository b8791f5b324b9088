"""Fields that do not fit each other: what is warned of, and that the warnings' numbers are those of flights."""

import math
import subprocess
import sys
import warnings

import numpy as np
import pytest

from quad_swarm import QuadSwarmVectorEnv
from quad_swarm.evaluation.flight import Condition
from quad_swarm.task.request_task import make_task
from quad_swarm.vehicles import VEHICLES
from quad_swarm.world.doubts import DoubtfulWorld, axes, doubts, far_goals, standing_offset
from quad_swarm.world.presets import PRESETS, SwarmConfig, make_config
from quad_swarm.world.swarm import Swarm

SLOW = {"horizon": 60, "max_tilt": 0.03, "max_speed": 2}
HUGE = {"workspace_low": (-2000, -2000, 0.48), "workspace_high": (2000, 2000, 2.4)}


def flown(config: SwarmConfig, distance: float, steps: int) -> Swarm:
    """Two robots that fly side by side without seeing each other, or stand if the distance is 0."""
    swarm = Swarm(config)
    starts = np.array([[0, 0, 1.5], [0, 9, 1.5]])
    swarm.reset(0, starts, starts + np.array([distance, 0, 0]))
    for _ in range(steps):
        swarm.step(np.zeros((1, 2, 1), bool))
    return swarm


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_raise_no_doubts(preset):
    assert list(doubts(PRESETS[preset])) == []


@pytest.mark.parametrize("preset", ["paper", "dense", "flight"])
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_vehicles_raise_no_doubts(preset, vehicle):
    assert list(doubts(make_config(preset, quadrotor=vehicle))) == []


@pytest.mark.parametrize(
    ("planner", "quadrotor", "wind"),
    [({}, {}, 1.0), ({}, {}, 3.0), ({"goal_weight": 80}, {}, 2.0), ({"horizon": 20, "dt": 0.05}, {}, 1.5),
     ({}, {"drag_x": 0.1, "drag_y": 0.1}, 2.0)],
)  # fmt: skip
def test_robots_stand_in_the_wind_where_it_is_said(planner, quadrotor, wind):
    planner = {**planner, "workspace_low": (-9, -9, 0.48), "workspace_high": (9, 12, 2.4)}
    config = make_config("paper", n_robots=2, planner=planner, noise={"wind": wind}, world={"quadrotor": quadrotor})
    swarm = flown(config, 0, 150)
    offsets = np.linalg.norm(swarm.pos[0] - swarm.goal[0], axis=1)
    calm = make_config("paper", planner=planner, world={"quadrotor": quadrotor})
    both = [axis.offset(wind) for axis in axes(config.planner, config.quadrotor)]
    assert 0.95 * min(both) <= offsets.min() <= offsets.max() <= 1.05 * max(both)
    assert standing_offset(config) == max(both)
    assert standing_offset(calm) == 0


def test_who_is_blown_away_stands_nowhere():
    with pytest.warns(DoubtfulWorld, match=r"noise\.wind=8: .* hold their place in at most 7\.1 m/s"):
        config = make_config("paper", noise={"wind": 8})
    assert math.isinf(standing_offset(config))


@pytest.mark.parametrize("preset", ["paper", "flight"])
def test_far_goals_are_approached_at_full_speed_with_the_cruise_distance_that_is_said(preset):
    calm = {"noise": {"wind": 0, "gust": 0, "vel": 0, "attitude": 0}, "n_robots": 2}
    config = make_config(preset, planner=HUGE, **calm)
    distance, warning = far_goals(config)
    cruise = float(warning.split("planner.cruise_distance=")[1].split(",")[0])
    assert cruise == 6.0, "one and a half times what robots fly within the horizon"
    steps = round(12 / config.planner.dt)
    near = flown(config, distance, steps)
    assert near.vel[0, :, 0].min() > 1.8, "half of the possible 4 m/s"
    with pytest.warns(DoubtfulWorld, match=r"planner\.goal_weight=8 is divided by the squared distance"):
        slow = flown(config, 6 * distance, steps)
    assert slow.vel[0, :, 0].max() < 1.2
    config = make_config(preset, planner={**HUGE, "cruise_distance": cruise}, **calm)
    assert math.isinf(far_goals(config)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error", DoubtfulWorld)
        fast = flown(config, 6 * distance, steps)
        farthest = flown(config, 1900.0, steps)
    assert fast.vel[0, :, 0].min() > 3.9
    np.testing.assert_allclose(fast.vel[0, :, 0], farthest.vel[0, :, 0], atol=0.01)


def test_a_cruise_distance_that_is_too_far_is_no_remedy():
    config = make_config("paper", planner={**HUGE, "cruise_distance": 100.0})
    assert far_goals(config)[0] == far_goals(make_config("paper"))[0]


FAR, NEAR = ({"position": (x, 0, 30), "radius": 0.3} for x in (30, 5))
HIGH = {"position": (0, 0, 9), "radius": 0.3, "shape": "sphere"}
PAST = {"position": (30, 30, 1), "radius": 0.3, "velocity": (-3, 0, 0)}


def test_obstacles_that_come_are_not_doubtful():
    with warnings.catch_warnings():
        warnings.simplefilter("error", DoubtfulWorld)
        make_config("paper", {"obstacles": {"listed": [NEAR, {**PAST, "velocity": (-3, -3, 0)}]}})


@pytest.mark.parametrize(
    ("preset", "world", "message"),
    [
        ("flight", {"goal_radius": 0.16}, r"goal_radius=0\.16: .* stand 0\.13 m"),
        ("flight", {"goal_radius": 0.08, "noise": {"wind": 0}}, r"goal_radius=0\.08: .*gust=0\.5.* moved away"),
        ("paper", {"radius": 0.05}, r"radius=0\.05: .* 0\.4 m in a step .* use continuous_collisions=true"),
        ("flight", {"goal_radius": 0.1}, r"goal_radius=0\.1: in noise\.wind=1 .* 0\.13 m .* goal_radius=0\.21"),
        ("paper", {"goal_radius": 30}, r"goal_radius=30 exceeds the distance of the goals"),
        ("paper", {"sensing": {"pos": 5}}, r"sensing\.pos=5 is in metres and too much for radius=0\.3"),
        ("dense", {"sensing": {"pos": 0.2}}, r"sensing\.pos=0\.2 is in metres .* use at most 0\.07"),
        ("paper", {"noise": {"pos": 0.5}}, r"noise\.pos=0\.5 is in metres"),
        ("dense", {"noise": {"pos": 0.05}}, r"noise\.pos=0\.05 is in metres .* use at most 0\.02"),
        ("flight", {"noise": {"attitude": 0.12}}, r"noise\.attitude=0\.12 is in rad: .* use at most 0\.06"),
        ("dense", {"sensing": {"vel": 0.6}}, r"sensing\.vel=0\.6 is in m/s: .* use at most 0\.2"),
        ("flight", {"sensing": {"attitude": 0.3}}, r"sensing\.attitude=0\.3 is in rad: .* use at most 0\.1"),
        ("flight", {"planner": {"max_climb_rate": 0.026}}, r"max_steps=200: .* vertically"),
        ("paper", {"space": {"circle_radius": [60, 70]}, "max_steps": 999}, r"goals are more than 41 m away"),
        ("flight", {"planner": {"separation": 0.62}}, r"separation=0\.62 leaves 0\.02 m .* use at least 0\.65"),
        ("flight", {"space": {"heights": [800, 801]}}, r"heights=\[800\.0, 801\.0\]: .* 801 m high; .* metres"),
        ("paper", {"planner": {"right_of_way": 30}}, r"right_of_way=30 is in metres and exceeds .*separation=0\.6"),
        ("paper", {"memory": 30}, r"memory=30: .* off by more than .* 0\.6 m"),
        ("paper", {"radio": {"delay": 50}}, r"radio\.delay=50 .* in steps of 0\.1 s.* at most 8 together"),
        ("flight", {"radio": {"delay": 18}}, r"radio\.delay=18 and radio\.jitter=1 .* 20 steps old"),
        ("paper", {"planner": {"dt": 0.02}}, r"planner\.horizon=10 .* 0\.2 s ahead.* use planner\.horizon=36"),
        ("paper", {"quadrotor": {"roll_time_constant": 2}}, r"quadrotor\.roll_time_constant=2 s.*planner\.horizon=60"),
        ("paper", {"planner": {"max_climb_rate": 100}}, r"max_climb_rate=100: .* faster than they would fall"),
        (
            "flight-v2",
            {"quadrotor": "crazyflie21", "planner": {"max_speed": 1}},
            r"max_speed=1: with planner\.max_tilt=0\.349, .* in 0\.28 s, .* tumble; use planner\.max_tilt=0\.17\.$",
        ),
        ("paper", {"planner": {"max_descent_rate": 9}}, r"max_descent_rate=9: .* faster than they would fall"),
        ("paper", {"planner": {"max_descent_speed": 0.026}}, r"max_steps=100: .* vertically"),
        ("paper", {"planner": {"max_yaw_rate": 30}}, r"max_yaw_rate=30 is in rad/s.*0\.524"),
        ("paper", {"planner": {"max_speed": 40}}, r"max_speed=40 is in m/s: .* reaches 7\.1 m/s"),
        ("paper", {"planner": {"max_speed": 0.01}}, r"max_steps=100: episodes of 10 s are too short"),
        ("paper", {"planner": {"max_climb_rate": 1e-6}}, r"max_steps=100: .* vertically"),
        ("paper", {"planner": {"goal_weight": 0}}, r"goal_weight=0: robots do not fly to their goals"),
        ("paper", {"space": {"half_width": 60}, "max_steps": 999}, r"more than 41 m away.*cruise_distance=6,"),
        ("paper", {"neighbourhood": {"range": 1}}, r"neighbourhood\.range=1: .* use at least 2\.4"),
        ("paper", {"obstacles": {"listed": [FAR]}}, r"obstacles\.listed\.0 .* stays 24\.9 m or more outside"),
        ("paper", {"obstacles": {"listed": [NEAR, HIGH]}}, r"obstacles\.listed\.1 .* 6\.3 m .* lengths are in met"),
        ("paper", {"obstacles": {"listed": [PAST]}}, r"obstacles\.listed\.0 .* stays \d"),
        ("paper", {"planner": {"separation": 3}, "space": {"spacing": 1}}, r"space\.spacing=1: .* use at least 2\.6"),
    ],
)  # fmt: skip
def test_what_is_doubtful_is_warned_of_in_one_line(preset, world, message):
    for make in (lambda: make_config(preset, world), lambda: make_config(preset, **world)):
        with pytest.warns(DoubtfulWorld) as caught:
            make()
        assert len(caught) == 1
        assert "\n" not in str(caught[0].message)
        with pytest.raises(DoubtfulWorld, match=message):
            raise caught[0].message


def test_what_is_recommended_is_not_doubtful():
    worlds = [
        ("flight", {"goal_radius": 0.21}), ("flight", {"goal_radius": 0.18}), ("paper", {"noise": {"wind": 2}}),
        ("flight", {"goal_radius": 0.1, "noise": {"wind": 0}}), ("paper", {"radius": 0.1}),
        ("paper", {"planner": {"dt": 0.02, "horizon": 36}, "max_steps": 500}),
        ("paper", {"radio": {"delay": 8}}), ("paper", {"neighbourhood": {"range": 2.4}}),
        ("paper", {"quadrotor": {"roll_time_constant": 2}, "planner": SLOW}),
        ("paper", {"planner": {"separation": 3}}), ("dense", {"sensing": {"pos": 0.07}}),
        ("dense", {"noise": {"pos": 0.02}}), ("flight", {"noise": {"attitude": 0.06}}),
        ("dense", {"sensing": {"vel": 0.2}}), ("flight", {"sensing": {"attitude": 0.1}}),
    ]  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for preset, world in worlds:
            make_config(preset, world)


def test_short_episodes_are_doubtful_wherever_they_are_asked_for():
    with pytest.warns(DoubtfulWorld, match="max_steps=3: episodes of 0.3 s are too short"):
        make_task(max_steps=3)
    with pytest.warns(DoubtfulWorld, match="max_steps=3: episodes of 0.3 s are too short"):
        Condition("none", "random", PRESETS["paper"], max_steps=3)


def test_a_command_says_it_once_in_one_line():
    code = "import warnings; from quad_swarm.evaluation.command import main; main(); warnings.resetwarnings(); main()"
    command = ["--policy", "none", "full", "--scenario", "random", "--episodes", "2", "--world", "memory=30"]
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0
    (line,) = (line for line in done.stderr.splitlines() if "memory" in line)
    assert "DoubtfulWorld: memory=30: " in line
    assert done.stdout.count("memory=30") == 2, "the tables are printed"


EXTREMES = {
    "planner": {"input_weight": (1e-300, 1e300), "goal_weight": (0, 1e300), "max_speed": (5e-324, 1e300),
                "max_vertical_speed": (5e-324, 1e300), "max_tilt": (1e-6, 1.3), "max_climb_rate": (1e-6, 1e4)},
    "quadrotor": {"drag_x": (0, 1e-300, 5), "gravity": (1e-300, 1e4), "roll_gain": (1e-300, 1),
                  "climb_gain": (1e-300, 9), "climb_time_constant": (0.1, 1e300), "roll_time_constant": (0.1, 1e300)},
    "noise": {"wind": (0, 1e3), "gust": (0, 1e3), "vel": (0, 1e3)},
    "neighbourhood": {"range": (0.8, 1e4)},
}  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.filterwarnings("error::RuntimeWarning", "ignore::quad_swarm.world.doubts.DoubtfulWorld")
def test_extreme_worlds_are_accepted_or_refused_in_one_line(seed):
    rng = np.random.default_rng(seed)
    accepted = 0
    for _ in range(200):
        world = {
            part: {name: float(rng.choice(values)) for name, values in fields.items() if rng.random() < 0.3}
            for part, fields in EXTREMES.items()
        }
        try:
            accepted += isinstance(make_config("paper", world), SwarmConfig)
        except ValueError as error:
            if "\n" in str(error):
                raise
    assert 20 < accepted < 200


@pytest.mark.parametrize("way", [lambda steps: {"max_steps": steps}, lambda steps: {"world": {"max_steps": steps}}])
def test_episodes_may_last_for_ever(way):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DoubtfulWorld)
        assert not make_task(**way(10**400)).swarm.state.any()


def test_a_vehicle_tumbles_whose_planner_tilts_it_faster_than_it_follows():
    pytest.importorskip("mujoco", reason="the extra `plants` is not installed")
    # What `identify --plant crazyflow:cf2x_L250` finds
    brushed = {"drag_x": 0.458, "drag_y": 0.458, "roll_gain": 1.005, "pitch_gain": 1.005, "climb_gain": 0.911}
    brushed |= {"roll_time_constant": 0.1445, "pitch_time_constant": 0.1445, "climb_time_constant": 0.3388}
    space = {"half_width": 1.8, "circle_radius": (1.5, 1.8), "sector_radius": (1, 1.8), "heights": (0.8, 1.7)}
    room = {"workspace_low": (-1.9, -1.9, 0.5), "workspace_high": (1.9, 1.9, 2), "max_speed": 1.0, "downwash": 3.0}
    tilts = []
    for gently in ({}, {"max_tilt": 0.17}):
        world = {"quadrotor": brushed, "radius": 0.15, "planner": room | gently, "space": space}
        config = make_config("flight-v2", world, n_robots=4, plant="crazyflow:cf2x_L250")
        assert any("tumble" in one for one in doubts(config)) is not bool(gently)
        given = world | {"plant": "crazyflow:cf2x_L250"}
        env = QuadSwarmVectorEnv(8, preset="flight-v2", n_robots=4, world=given, scenario="symmetric_swap")
        env.reset(seed=0)
        largest, everybody = 0.0, np.ones((8, 12), np.int8)
        for _ in range(90):
            env.step(everybody)
            largest = max(largest, float(np.abs(env.task.swarm.state[..., 6:8]).max()))
        tilts.append(largest)
    assert tilts[0] > 1.2 > 0.7 > tilts[1]
