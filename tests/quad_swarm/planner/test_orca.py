"""ORCA: its half-spaces, its examples, and robots that fly by it."""

import pickle

import numpy as np
import pytest
from planning import QUADROTOR, unit

import quad_swarm.planner.orca
from quad_swarm.evaluation import Condition
from quad_swarm.evaluation.evaluation import fly_all
from quad_swarm.native import BuildError
from quad_swarm.planner import OrcaSolver, PlannerConfig, Plans, Problems, make_planner, make_problem
from quad_swarm.planner.orca import avoid
from quad_swarm.planner.projection import project
from quad_swarm.world.presets import make_config

TAU, SOONEST = 2.0, 0.5
ROOM = {"workspace_low": (-20.0, -20.0, -20.0), "workspace_high": (20.0, 20.0, 20.0)}


def meetings(count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 4, (count, 1)) * unit(rng.normal(size=(count, 3))), rng.uniform(-2, 2, (count, 3))


def least_distance(between, relative):
    """The least distance before TAU of points that keep their velocity."""
    time = np.clip((between * relative).sum(axis=-1) / (relative**2).sum(axis=-1), 0, TAU)
    return np.linalg.norm(between - time[..., None] * relative, axis=-1)


def test_the_change_leads_to_the_border_of_the_velocity_obstacle_and_no_smaller_one_does():
    between, relative = meetings(2000)
    kept = np.full(2000, 0.7)
    apart = np.linalg.norm(between, axis=1) > kept
    normals, change = avoid(between, relative, kept, TAU, SOONEST)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    touching = relative + change[:, None] * normals
    np.testing.assert_allclose(least_distance(between, touching)[apart], 0.7, atol=1e-9)
    colliding = apart & (least_distance(between, relative) < 0.7)
    assert colliding.sum() > 50
    assert np.array_equal(colliding[apart], change[apart] > 0)
    rng = np.random.default_rng(1)
    for direction in unit(rng.normal(size=(200, 3))):
        smaller = relative + 0.999 * change[:, None] * direction
        assert (least_distance(between, smaller)[colliding] < 0.7).all()


def test_both_do_half_and_pass_on_their_right_if_they_are_exactly_head_on():
    problem = make_problem(PlannerConfig(separation=0.6, **ROOM), QUADROTOR, 1)
    solver = OrcaSolver(problem, TAU, margin=0.0, settling=SOONEST)
    x = np.zeros((2, 9))
    x[:, 0], x[:, 3] = [-1.5, 1.5], [1, -1]
    found, _ = solver.velocities(_observed(x, goals=-10 * x[:, [0, 1, 2]]))
    np.testing.assert_allclose(found[0], -found[1], atol=1e-9)
    assert found[0, 1] < -0.05  # to the right of +x
    relative = found[0] - found[1]
    assert least_distance(np.array([3.0, 0, 0]), relative) == pytest.approx(0.6, abs=1e-6)


def test_those_closer_than_allowed_part_in_the_given_time():
    between, relative = np.array([[0.3, 0, 0], [0.0, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, 0]])
    normals, change = avoid(between, relative, np.full(2, 0.6), TAU, SOONEST)
    after = between - SOONEST * (relative + change[:, None] * normals)
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), 0.6)


# What RVO2-3D, the library of the paper's authors, chooses for `_crowds`. In cases 2, 5 and 6, no velocity is allowed.
LIBRARY = [
    [0.29253, 1.33156, 0.51943],
    [-0.2998, 0.25825, -0.11065],
    [0.84256, -0.36007, 0.23997],
    [-0.30792, 0.21742, -0.89091],
    [-0.54681, 0.0719, -0.06992],
    [2.01866, -0.5966, 0.88833],
    [-0.36752, -0.74814, 0.12787],
    [0.07756, 0.51763, -0.3389],
]


def _crowds():
    """Eight robots at the origin among twelve others within a radius of 0.4 each, and the velocities they prefer."""
    rng = np.random.default_rng(5)
    drawn = [
        (rng.uniform(-1.4, 1.4, (12, 3)), rng.uniform(-1, 1, (12, 3)), rng.uniform(-1, 1, (2, 3))) for _ in range(8)
    ]
    positions, velocities, own = (np.array(one) for one in zip(*drawn, strict=True))
    return positions, velocities, own[:, 0], own[:, 1]


def test_velocities_are_those_of_the_authors_library(monkeypatch):
    positions, velocities, own, preferred = _crowds()
    config = PlannerConfig(separation=0.8, max_vertical_speed=50, max_speed=50, max_climb_rate=50, **ROOM)
    solver = OrcaSolver(make_problem(config, QUADROTOR, 12), TAU, margin=0.0, speed=50, settling=SOONEST)
    x = np.zeros((8, 9))
    x[:, 3:6] = own
    times = config.dt * np.arange(1, config.horizon + 1)[:, None]
    others = positions[:, :, None] + times * velocities[:, :, None]
    monkeypatch.setattr(solver, "preferred", lambda problems: preferred)
    found, _ = solver.velocities(Problems(x, np.zeros((8, 3)), others))
    np.testing.assert_allclose(found, LIBRARY, atol=2e-5)


def test_velocities_obey_all_half_spaces_if_any_does():
    positions, velocities, own, preferred = _crowds()
    normals, change = avoid(positions, own[:, None] - velocities, np.full((8, 12), 0.8), TAU, SOONEST)
    offsets = (normals * own[:, None]).sum(axis=-1) + change / 2
    gaps = (normals @ np.array(LIBRARY)[..., None])[..., 0] - offsets
    feasible = gaps.min(axis=1) > -1e-3
    assert np.array_equal(np.flatnonzero(~feasible), [2, 5, 6])
    found, _ = project(preferred[feasible], normals[feasible], offsets[feasible])
    np.testing.assert_allclose(found, np.array(LIBRARY)[feasible], atol=2e-5)


def _observed(x: np.ndarray, goals: np.ndarray, dt: float = 0.1, stages: int = 10) -> Problems:
    """The problems of robots that see all others and believe that they keep their velocities."""
    n = len(x)
    others = np.array([[j for j in range(n) if j != i] for i in range(n)])
    ahead = x[:, None, :3] + dt * np.arange(1, stages + 1)[:, None] * x[:, None, 3:6]
    return Problems(x, goals, ahead[others])


@pytest.mark.parametrize("flat", [True, False], ids=["circle", "sphere"])
def test_points_that_swap_across_a_circle_or_a_sphere_never_touch(flat):
    """The examples of the library: vehicles with any velocity at once."""
    rng, n = np.random.default_rng(0), 24
    if flat:
        starts = 6 * np.column_stack([f(2 * np.pi * np.arange(n) / n) for f in (np.cos, np.sin, np.zeros_like)])
    else:
        starts = 6 * unit(rng.normal(size=(40, 3)))
        starts = starts[[k for k in range(40) if not (np.linalg.norm(starts[:k] - starts[k], axis=1) < 1.1).any()]]
    config = PlannerConfig(separation=0.6, max_speed=1, max_climb_rate=1, max_vertical_speed=1, **ROOM)
    solver = OrcaSolver(make_problem(config, QUADROTOR, len(starts) - 1), 5.0, 0.0, settling=config.dt)
    x, closest = np.zeros((len(starts), 9)), np.inf
    x[:, :3] = starts + 1e-3 * rng.normal(size=starts.shape)
    for _ in range(600):
        x[:, 3:6], _ = solver.velocities(_observed(x, -starts))
        x[:, :3] += config.dt * x[:, 3:6]
        gaps = np.linalg.norm(x[:, None, :3] - x[:, :3], axis=-1) + 10 * np.eye(len(x))
        closest = min(closest, gaps.min())
        if np.linalg.norm(x[:, :3] + starts, axis=1).max() < 0.1:
            break
    else:
        pytest.fail("not everyone arrived")
    assert closest > 0.6 - 1e-3


def test_robots_do_all_of_what_avoids_an_obstacle_and_half_of_what_avoids_a_robot():
    config = PlannerConfig(**ROOM)
    solver = OrcaSolver(make_problem(config, QUADROTOR, 1, True), TAU, margin=0.0)
    x = np.zeros((1, 9))
    x[0, 3] = 1.0
    stands = np.tile([1.5, 0.1, 0.0], (1, 1, 10, 1))
    changes = []
    for size in (0.0, 1e-9):
        body = Problems(x, np.zeros((1, 3)), stands, shape=np.ones((1, 1, 3)), size=np.full((1, 1), size))
        normals, offsets = solver.half_spaces(body)
        changes.append((offsets - normals @ x[0, 3:6])[0, 0])
    assert changes[1] == pytest.approx(2 * changes[0], abs=1e-6)
    pillar = Problems(x, np.zeros((1, 3)), stands, shape=np.array([[[1.0, 1, 0]]]), size=np.full((1, 1), 0.2))
    normals, _ = solver.half_spaces(pillar)
    assert normals[0, 0, 2] == 0


def test_plans_track_the_velocity_with_the_model_within_the_limits():
    config = PlannerConfig(horizon=30, dt=0.1)
    planner = make_planner(config, QUADROTOR, 1, "orca")
    x = np.zeros((3, 9))
    x[:, 2] = 1.5
    x[1, 3:5] = [2.0, -1.0]
    goal = np.array([[3.0, 0, 1.5], [-4, 2, 1.0], [0, 0, 1.5]])
    problems = Problems(x, goal, np.zeros((3, 0, 30, 3)))
    plans = planner.plan(problems, Plans.hover(x, 30))
    assert (plans.status == 0).all()
    assert (np.abs(plans.u).max(axis=(0, 1)) <= [config.max_tilt, config.max_tilt, config.max_climb_rate, 0]).all()
    np.testing.assert_allclose(plans.x, planner.model.rollout(x, plans.u), atol=1e-12)
    wanted, _ = planner.solver.velocities(problems)
    np.testing.assert_allclose(plans.x[:, -1, 3:6], wanted, atol=0.05)
    assert not plans.u[2].any()


def test_robots_turn_to_their_heading():
    config = PlannerConfig(max_yaw_rate=1.5)
    planner = make_planner(config, QUADROTOR, 1, "orca")
    x = np.zeros((1, 9))
    x[0, [2, 8]] = 1.5, np.radians(170)
    plans = Plans.hover(x, 10)
    for _ in range(60):
        plans = planner.plan(
            Problems(x, x[:, :3] + [2, 0, 0], np.zeros((1, 0, 10, 3)), heading=np.array([-3.0])), plans
        )
        x = plans.x[:, 1]
    assert x[0, 8] == pytest.approx(2 * np.pi - 3.0, abs=0.02)


def test_plans_are_the_same_without_a_compiler_and_in_another_process(monkeypatch):
    config = PlannerConfig()
    x = np.zeros((2, 9))
    x[:, :3], x[:, 3] = [[-1, 0, 1.5], [1, 0.1, 1.5]], [1, -1]
    problems = _observed(x, -x[:, :3])
    planner = make_planner(config, QUADROTOR, 2, "orca")
    expected = planner.plan(problems, Plans.hover(x, 10))
    copied = pickle.loads(pickle.dumps(planner)).plan(problems, Plans.hover(x, 10))
    assert np.array_equal(copied.u, expected.u)

    def fails(function):
        raise BuildError("no compiler")

    monkeypatch.setattr(quad_swarm.planner.orca, "RowFunction", fails)
    without = make_planner(config, QUADROTOR, 2, "orca").plan(problems, Plans.hover(x, 10))
    np.testing.assert_allclose(without.u, expected.u, atol=1e-12)


def test_one_robot_with_numbers_that_are_not_finite_brakes_alone():
    x = np.zeros((2, 9))
    x[:, :3] = [[-1, 0, 1.5], [1, 0.1, 1.5]]
    problems = _observed(x, -x[:, :3])
    planner = make_planner(PlannerConfig(), QUADROTOR, 2, "orca")
    expected = planner.plan(problems, Plans.hover(x, 10))
    planner.checks = False
    problems.others[1, 0, 0, 0] = np.nan
    plans = planner.plan(problems, Plans.hover(x, 10))
    assert plans.status[0] == 0
    assert plans.status[1] > 1
    np.testing.assert_allclose(plans.u[0], expected.u[0], atol=1e-9)


@pytest.mark.parametrize(
    "wrong", [{"horizon": 0}, {"margin": -0.1}, {"speed": np.nan}, {"settling": np.inf}, {"bandwidth": -1}]
)
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        OrcaSolver(make_problem(PlannerConfig(), QUADROTOR, 1), **wrong)


def test_the_problem_and_the_solver_are_for_each_other():
    assert make_planner(PlannerConfig(problem="orca"), QUADROTOR, 2).solver.name == "orca"
    with pytest.raises(ValueError, match="only"):
        make_planner(PlannerConfig(problem="orca"), QUADROTOR, 2, "rti")
    with pytest.raises(ValueError, match="leave one of them out"):
        make_planner(PlannerConfig(problem="voronoi"), QUADROTOR, 2, "orca")


@pytest.mark.parametrize("preset", ["paper", "flight"])
def test_swarms_without_messages_arrive_without_collisions(preset):
    config = make_config(preset, n_robots=6, planner={"problem": "orca"})
    (rows,) = fly_all([Condition("none", "symmetric_swap", config)], 4).values()
    assert all(row["arrived"] and not row["collided"] for row in rows)
    assert not sum(row["requests"] + row["planner_failures"] for row in rows)
