"""Teams of unlike vehicles: what is accepted, how they fly, and what is reported of them."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
import yaml

from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly
from quad_swarm.evaluation.recordings import Recording
from quad_swarm.planner import MixedPlanner, Planner
from quad_swarm.quadrotor import VEHICLE_PARAMETERS, QuadrotorParams
from quad_swarm.task.observation import make_observation
from quad_swarm.task.view import View
from quad_swarm.validation import read_assignments, replaced
from quad_swarm.vehicles import VEHICLES
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.kinds import VehicleConfig, bodies_of, make_planners
from quad_swarm.world.presets import SwarmConfig, for_scenario, make_config
from quad_swarm.world.swarm import Swarm

TEAM = [{"radius": 0.2, "quadrotor": "crazyflie21"}, {"radius": 0.3}, {"radius": 0.5, "quadrotor": "x500"}]
UNLIKE = {"vehicles": TEAM}


def flown(config: SwarmConfig, n_swarms: int = 2, steps: int = 50, scenario: str = "symmetric_swap", rule="full"):
    """Fly episodes and return the task and the reports."""
    policy, task, rngs = begin(Condition(rule, scenario, config), [first_episode(0) + k for k in range(n_swarms)])
    task.end_at_collision = False
    return task, [task.act(policy(task, rngs)).report for _ in range(steps)]


def distances(swarm: Swarm) -> np.ndarray:
    """Distances between centres, less the radii, plus twice the world's, (E, n, n)."""
    flat = np.array([1, 1, 1 / swarm.config.planner.downwash])
    apart = np.linalg.norm(flat * (swarm.pos[:, :, None] - swarm.pos[:, None]), axis=-1)
    found = apart - swarm.config.radii - swarm.config.radii[:, None] + 2 * swarm.config.radius
    found[:, np.eye(len(swarm.config.radii), dtype=bool)] = np.inf
    return found


def test_robots_without_vehicles_are_alike():
    config = make_config("paper")
    assert config.kinds == (config,)
    assert config.kind_of == (0, 0, 0, 0)
    assert config.excess is None
    assert config.radii.tolist() == [0.3] * 4
    assert isinstance(Swarm(config).planner, Planner)


def test_entries_repeat_and_leave_the_rest_as_in_the_world():
    config = make_config("paper", {"vehicles": TEAM, "quadrotor": {"drag_x": 0.1}}, n_robots=5)
    assert config.kind_of == (0, 1, 2, 0, 1)
    assert config.radii.tolist() == [0.2, 0.3, 0.5, 0.2, 0.3]
    assert [kind.radius for kind in config.kinds] == [0.2, 0.3, 0.5]
    assert config.kinds[config.kind_of[0]].quadrotor == VEHICLES["crazyflie21"]
    assert config.kinds[config.kind_of[1]].quadrotor.drag_x == 0.1
    assert config.excess[0, 2] == pytest.approx(0.1)
    assert config.excess[2, 2] == 0


def test_a_kind_is_the_world_of_a_team_of_its_own():
    for preset in ("paper", "flight"):
        alone = make_config(preset, radius=0.2, quadrotor="x500", planner={"max_tilt": 0.1, "max_speed": 1.0})
        vehicle = {"radius": 0.2, "quadrotor": "x500", "max_tilt": 0.1, "max_speed": 1.0}
        assert make_config(preset, {"vehicles": [vehicle, {}]}).kinds[0] == alone


def test_parameters_of_a_vehicle_replace_some_of_the_world(tmp_path):
    path = tmp_path / "mine.yml"
    mine = QuadrotorParams(drag_x=0.7)
    path.write_text(yaml.safe_dump({"parameters": {name: getattr(mine, name) for name in VEHICLE_PARAMETERS}}))
    vehicles = [{"quadrotor": {"drag_y": 0.2}}, {"quadrotor": str(path)}, {"quadrotor": Path(path)}, {}]
    config = make_config("paper", {"vehicles": vehicles}, quadrotor="x500")
    x500 = VEHICLES["x500"]
    assert config.kinds[config.kind_of[0]].quadrotor == dataclasses.replace(x500, drag_y=0.2)
    assert config.kinds[config.kind_of[1]].quadrotor == config.kinds[config.kind_of[2]].quadrotor == mine
    assert config.kinds[config.kind_of[3]].quadrotor == x500


def test_command_lines_and_files_give_vehicles():
    text = "vehicles=[{radius: 0.2, quadrotor: crazyflie21}, {radius: 0.3}, {radius: 0.5, quadrotor: x500}]"
    config = make_config("paper", read_assignments("--world", [text]))
    assert config == make_config("paper", UNLIKE)
    assert replaced(SwarmConfig(), dataclasses.asdict(config)) == config
    copy = pickle.loads(pickle.dumps(config))
    assert copy == config
    assert copy.kinds == config.kinds


@pytest.mark.parametrize(
    ("vehicles", "message"),
    [
        (3, r"vehicles=3: it must be a list, \["),
        ([3], "vehicles.0=3: it must be a mapping"),
        ({"radius": 0.2}, r"it must be a list, \["),
        ([{}, {"radus": 0.2}], "Unknown vehicles.1 parameter 'radus'.* mean 'radius'"),
        ([{"radius": 0}], "vehicles.0.radius=0: it must be greater than 0"),
        ([{"radius": float("nan")}], "vehicles.0.radius=nan: it must be a finite number"),
        ([{"radius": True}], "vehicles.0.radius='True'"),
        ([{"max_speed": float("inf")}], "vehicles.0.max_speed=inf: it must be a finite number"),
        ([{}, {"max_tilt": 3}], "vehicles.1: max_tilt=3.0: it must be less than"),
        ([{}, {"max_tilt": 1.5}], "vehicles.1: planner.max_tilt=1.5: with the quadrotor's gains"),
        ([{}, {"max_yaw_rate": 40}], "vehicles.1: planner.max_yaw_rate=40 is in rad/s"),
        ([{"quadrotor": "x600"}], "Unknown vehicle 'x600'.* mean 'x500'"),
        ([{"quadrotor": {"mass": 1}}], "Unknown vehicles.0.quadrotor parameter 'mass'"),
        ([{"quadrotor": {"drag_x": -1}}], "vehicles.0.quadrotor.drag_x=-1: it must be greater"),
        ([{}, {"quadrotor": {"roll_time_constant": 0.01}}], "vehicles.1: planner.dt=0.1: steps must not exceed"),
        ([{}] * 5, "there are 5 for n_robots=4"),
    ],
)
def test_vehicles_that_are_none_are_refused(vehicles, message):
    with pytest.raises(ValueError, match=message):
        make_config("paper", {"vehicles": vehicles})


def test_what_is_wrong_with_the_world_is_no_vehicle_s_fault():
    with pytest.raises(ValueError, match=r"^clock_skew=0.5 is shorter than one of the substeps=1 of a step"):
        make_config("paper", UNLIKE, clock_skew=0.5)


def test_simulators_refuse_unlike_vehicles_but_not_unlike_radii():
    assert make_config("paper", {"vehicles": [{"radius": 0.2}, {}], "plant": "crazyflow"}).radii[0] == 0.2
    with pytest.raises(ValueError, match=r"vehicles.0.quadrotor: plant='crazyflow' flies vehicles that are all alike"):
        make_config("paper", UNLIKE, plant="crazyflow")


def test_spacings_follow_the_largest_robot():
    assert make_config("flight", UNLIKE).space.spacing == pytest.approx(1.2 + 0.2)
    assert make_config("paper", UNLIKE).space.spacing == make_config("paper", radius=0.5).space.spacing
    world = make_config("flight", UNLIKE)
    assert make_config(world, max_steps=150).space.spacing == world.space.spacing
    with pytest.raises(ValueError, match=r"vehicles.1: space.spacing=0.9: .*at least 2 \* radius = 1"):
        make_config("paper", {"vehicles": [{}, {"radius": 0.5}], "space": {"spacing": 0.9}})


def test_doubts_name_the_vehicle():
    with pytest.warns(DoubtfulWorld, match=r"vehicles.1: planner.max_speed=100 is in m/s"):
        make_config("paper", {"vehicles": [{}, {"max_speed": 100}, {"max_speed": 100}]})


def test_starts_goals_and_obstacles_are_checked_with_each_robot_s_radius():
    config = make_config("paper", UNLIKE)
    goals = np.array([[0.0, -3, 1], [0, 3, 1], [2, 0, 1], [-3, 0, 1]])
    starts = goals + np.array([0, 0, 0.5])
    starts[0] = [3, 3, 1]
    for gap, refused in ((0.85, False), (0.75, True)):  # robots 1 and 2 touch at 0.8 m
        starts[1], starts[2] = [0, 0, 1], [gap, 0, 1]
        if refused:
            with pytest.raises(ValueError, match=r"starts\[1\] and starts\[2\] are 0.75 m apart.*at least 0.8 m"):
                config.check_flight(starts, goals)
        else:
            config.check_flight(starts, goals)
    # Robots keep 0.6 m and 0.18 m of repulsion, and are at goals 0.3 m away
    small = dict(zip("ab", (0.45, 0.35), strict=True))
    starts[1], starts[2] = [0, 0, 1], [1.5, 0, 1]
    for gap in small.values():  # robots 0 and 3
        goals[0], goals[3] = [-3, 0, 1], [-3, gap, 1]
        if gap < 0.4:
            with pytest.raises(ValueError, match=r"goals\[0\] and goals\[3\] are 0.35 m apart.*at least 0.4 m"):
                config.check_flight(starts, goals)
        else:
            config.check_flight(starts, goals)
    obstacle = {"position": [-3, -0.9, 0], "radius": 0.3}
    world = make_config("paper", {**UNLIKE, "obstacles": {"listed": [obstacle]}})
    goals[3] = [3, -3, 1]
    world.check_flight(starts, goals, world.obstacles.listed)
    starts[[0, 2, 3]] = [1.5, 0, 1], [-3, -0.15, 1], [3, -3, 1.5]  # 0.45 m from the surface
    with pytest.raises(ValueError, match=r"starts\[2\].* is 0.45 m from the surface"):
        world.check_flight(starts, goals, world.obstacles.listed)


@pytest.mark.parametrize("preset", ["paper", "flight"])
@pytest.mark.parametrize("world", [{}, {"neighbourhood": {"max_others": 2}}, {"obstacles": {"number": [2, 2]}}])
def test_a_team_of_one_kind_flies_as_the_world_of_that_kind(preset, world):
    alike = make_config(preset, world, radius=0.35, n_robots=4)
    task, reports = flown(alike, steps=15)
    kind = make_config(preset, {**world, "vehicles": [{"radius": 0.35}] * 2}, n_robots=4)
    same, others = flown(kind, steps=15)
    assert np.array_equal(same.swarm.state, task.swarm.state)
    for one, other in zip(reports, others, strict=True):
        np.testing.assert_allclose(other.min_separation, one.min_separation - 0.1, rtol=1e-12)
        assert np.array_equal(one.colliding, other.colliding)


@pytest.mark.parametrize(
    "world",
    [
        {},
        {"neighbourhood": {"max_others": 2}},
        {"neighbourhood": {"range": 2.0}},
        {"planner": {"downwash": 2.0}},
        {"obstacles": {"number": [2, 3]}},
    ],
)
def test_reports_are_those_of_the_states(world):
    config = make_config("flight", {**UNLIKE, **world}, n_robots=5)
    config, contact = for_scenario(config, "symmetric_swap"), 2 * config.radius - config.collision_tolerance
    policy, task, rngs = begin(Condition("none", "symmetric_swap", config), [first_episode(0), first_episode(0) + 1])
    task.end_at_collision = False
    for _ in range(40):
        report = task.act(policy(task, rngs)).report
        apart = distances(task.swarm)
        np.testing.assert_allclose(report.min_separation, apart.min(axis=(1, 2)), atol=1e-9)
        assert (report.min_separation_continuous <= report.min_separation).all()
        others = np.broadcast_to(report.others, report.separation.shape)
        seen = np.take_along_axis(apart, np.maximum(others, 0), axis=2)
        np.testing.assert_allclose(report.separation, np.where(others < 0, np.inf, seen), atol=1e-9)
        assert np.array_equal(report.colliding, report.separation < contact)
        if report.obstacles is not None:
            there = task.swarm.obstacles
            away = there.factors[:, None] * (task.swarm.pos[:, :, None] - there.position[:, None])
            gaps = np.linalg.norm(away, axis=-1) - there.radius[:, None] - config.radii[:, None]
            gaps[np.broadcast_to(~there.present[:, None], gaps.shape)] = np.inf
            np.testing.assert_allclose(report.obstacles.distance, gaps, atol=1e-9)


def test_contact_between_steps_is_that_of_the_two_radii():
    config = make_config("paper", {**UNLIKE, "continuous_collisions": True})
    swarm = Swarm(config)
    for gap, collides in ((0.79, True), (0.81, False)):
        starts = np.array([[-3.0, -3, 1], [0, 0, 1], [0, gap, 1], [3, 3, 1]])
        swarm.reset(0, starts, starts, checked=True)
        swarm.state[0, 2, 3] = 0.0
        report = swarm.step(np.zeros((1, 4, 3), bool))
        assert report.collision_continuous[0] == collides


@pytest.mark.parametrize("preset", ["paper", "flight"])
@pytest.mark.parametrize("world", [{}, {"neighbourhood": {"max_others": 2}}])
def test_a_swarm_flies_alone_as_in_a_batch(preset, world):
    config = make_config(preset, {**UNLIKE, **world})
    batch, reports = flown(config, 3, 25, rule="cpa:1.2s:3|stale:4")
    alone, others = flown(config, 1, 25, rule="cpa:1.2s:3|stale:4")
    assert np.array_equal(alone.swarm.state[0], batch.swarm.state[0])
    for one, other in zip(others, reports, strict=True):
        for name in ("separation", "min_separation", "colliding", "plan_status", "iterations"):
            assert getattr(one, name)[0].tobytes() == getattr(other, name)[0].tobytes(), name


def test_copies_and_restored_states_fly_on_alike():
    task, _ = flown(make_config("flight", {**UNLIKE, "neighbourhood": {"max_others": 3}}), 2, 10)
    requests = np.ones((2, 8, 3), bool)
    fork, other = task.swarm.fork(), Swarm(task.swarm.config, 2)
    other.load_state_dict(task.swarm.state_dict())
    for _ in range(3):
        states = [swarm.step(requests) and swarm.state.copy() for swarm in (task.swarm, fork, other)]
        assert np.array_equal(states[0], states[1])
        assert np.array_equal(states[0], states[2])


def test_each_robot_flies_its_own_vehicle_and_keeps_its_own_limits():
    vehicles = [{"max_tilt": 0.05}, {"quadrotor": {"drag_x": 2.0, "drag_y": 2.0}}, {"max_climb_rate": 0.2}, {}]
    task, _ = flown(make_config("paper", {"vehicles": vehicles}), 1, 12, "random")
    assert isinstance(task.swarm.planner, MixedPlanner)
    u = np.abs(task.swarm._plans.u)
    assert u[0, :, :2].max() <= 0.05 + 1e-6
    assert u[2, :, 2].max() <= 0.2 + 1e-6
    assert u[3, :, :2].max() > 0.05
    speed = np.linalg.norm(task.swarm.vel[0], axis=-1)
    assert speed[1] < speed[3]


def test_what_robots_perceive_counts_from_surface_to_surface():
    config = make_config("paper", UNLIKE, planner={"downwash": 1.0})
    task, _ = flown(config, 2, 6)
    view = View(task.swarm)
    apart = np.take_along_axis(distances(task.swarm), np.array([[[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]]), axis=2)
    np.testing.assert_allclose(view.distance, apart, atol=1e-9)
    assert (view.approach(3.0)[0] <= view.distance + 1e-9).all()
    observation = make_observation(config, "state+radius")
    gaps, own, other = (
        [k for k, column in enumerate(observation.columns) if column.name.endswith(name)]
        for name in ("state.now_gap_1", "radius.own_radius", "radius.other_radius")
    )
    rows = observation(task.swarm)
    np.testing.assert_allclose(rows[..., gaps], np.tanh(apart - 2 * config.radius), atol=1e-6)
    np.testing.assert_allclose(rows[..., own], np.broadcast_to(config.radii[:, None], (2, 4, 3)))
    np.testing.assert_allclose(rows[0][..., other][0], [0.3, 0.5, 0.2])


def test_empty_slots_show_a_robot_far_away():
    config = make_config("flight", {"vehicles": [{"radius": 0.1}, {"radius": 1.5}], "neighbourhood": {"range": 3.4}})
    swarm = Swarm(config)
    others = np.array([[[1, 0], [1, 1]]])
    found = bodies_of(dataclasses.replace(config, n_robots=2), others=others)
    assert found.larger[0].tolist() == [[1.4, 0.0], [0.0, 0.0]]
    assert found.excess[0, 0].tolist() == [pytest.approx(1.0), 0.0]
    assert swarm.bodies.larger.shape == (1, 8, 7)


def test_robots_of_a_kind_share_a_planner():
    planners = make_planners(make_config("paper", UNLIKE, n_robots=5))
    assert planners[0] is planners[3]
    assert len({id(one) for one in planners}) == 3


def test_flights_and_recordings_of_unlike_robots_know_who_collided():
    config = make_config("flight", {**UNLIKE, "obstacles": {"number": [2, 2]}}, n_robots=4)
    flight = fly(Condition("none", "symmetric_swap", config), 0, 0)
    recorded = Recording.of(flight).flight()
    assert recorded.config == config
    np.testing.assert_allclose(recorded.separation, flight.separation)
    apart = flight.separation.min(axis=(1, 2))
    assert (flight.min_separation[1:] <= apart[1:] + 1e-9).all()
    np.testing.assert_allclose(recorded.min_separation, flight.min_separation, atol=0.01)
    np.testing.assert_allclose(recorded.min_obstacle_distance, flight.min_obstacle_distance, atol=0.01)


def test_rewards_of_near_misses_count_from_surface_to_surface():
    config = make_config("paper", UNLIKE)
    swarm = Swarm(config)
    starts = np.array([[-3.0, -3, 1], [0, 0, 1], [0, 1.1, 1], [3, 3, 1]])
    swarm.reset(0, starts, starts, checked=True)
    planned = swarm.planned_separation(3, swarm.neighbours.numbers())
    assert planned.shape == (1, 4, 3, 3)
    np.testing.assert_allclose(planned[0, 1, 1], 1.1 - 0.2)
    np.testing.assert_allclose(planned[0, 2, 1], 1.1 - 0.2)


def test_vehicles_of_the_same_values_are_one_kind():
    config = make_config("paper", {"vehicles": [{"radius": 0.3}, {"max_speed": 4.0}, {}]})
    assert len(config.kinds) == 1
    assert isinstance(Swarm(config).planner, Planner)
    assert VehicleConfig() == config.vehicles[2]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "flight"])
@pytest.mark.parametrize("scenario", ["symmetric_swap", "random"])
def test_unlike_robots_that_know_all_plans_keep_apart(preset, scenario):
    config = make_config(preset, UNLIKE)
    policy, task, rngs = begin(Condition("full", scenario, config), [first_episode(0) + k for k in range(40)])
    task.end_at_collision = False
    least = np.inf
    for _ in range(config.max_steps):
        report = task.act(policy(task, rngs)).report
        found = report.min_separation_continuous if config.continuous_collisions else report.min_separation
        least = min(least, found.min())
    # The soft constraint of the paper's planner is at contact and gives way by a millimetre or two
    assert least > 2 * config.radius - (0.003 if preset == "paper" else config.collision_tolerance)
    assert task.statistics.success.mean() > 0.9
