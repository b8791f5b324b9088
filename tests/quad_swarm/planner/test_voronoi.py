"""Buffered Voronoi cells: what they are, what plans do in them, and robots that fly by them."""

import numpy as np
import pytest
from planning import QUADROTOR, crossing, hover

from quad_swarm.evaluation import Condition
from quad_swarm.evaluation.evaluation import fly_all
from quad_swarm.planner import PlannerConfig, Plans, Problems, VoronoiCells, make_planner, make_problem
from quad_swarm.world.presets import make_config

CONFIG = PlannerConfig(problem="voronoi")
SOLVERS = ["rti", "fatrop"]


def cells_of(problems: Problems, config: PlannerConfig = CONFIG, shaped: bool = False) -> Problems:
    return make_problem(config, QUADROTOR, problems.others.shape[1], shaped).prepare(problems)


def gaps(cells: Problems, points: np.ndarray) -> np.ndarray:
    """How far points, (B, N, 3), are from the planes of the bodies, (B, m, N)."""
    return (cells.shape[:, :, None] * (points[:, None] - cells.others)).sum(axis=-1) - cells.size[..., None]


def test_cells_are_half_of_the_way_less_half_of_the_separation():
    x = np.zeros((2, 9))
    x[:, :3], x[:, 3:6] = [[-1, 0, 1], [1, 1, 1.5]], [[1, 0, 0], [0, -1, 0]]
    stages = CONFIG.dt * np.arange(1, 11)[:, None]
    others = (x[:, None, :3] + stages * x[:, None, 3:6])[[1, 0], None]
    cells = cells_of(Problems(x, x[:, :3] * 3, others))
    middle = np.tile(x[:, :3].mean(axis=0), (2, 10, 1))
    buffered = CONFIG.separation / 2 + VoronoiCells.buffer
    np.testing.assert_allclose(gaps(cells, middle) + buffered, CONFIG.separation, atol=1e-9)
    np.testing.assert_allclose(cells.shape[0], -cells.shape[1], atol=1e-12)
    assert not np.ptp(cells.others, axis=2).any()


def test_points_of_two_cells_are_a_separation_apart():
    rng = np.random.default_rng(0)
    for _ in range(50):
        x = np.zeros((4, 9))
        x[:, :3] = rng.uniform(-2, 2, (4, 3))
        others = np.array([[j for j in range(4) if j != i] for i in range(4)])
        cells = cells_of(Problems(x, x[:, :3], np.repeat(x[others, None, :3], 10, axis=2)))
        points = rng.uniform(-3, 3, (4, 300, 1, 3))
        inside = [
            [point[0] for point in points[i] if (gaps(cells.part([i]), point[None]) >= CONFIG.separation).all()]
            for i in range(4)
        ]
        for i in range(4):
            for j in range(i):
                apart = np.linalg.norm(np.reshape(inside[i], (-1, 1, 3)) - np.reshape(inside[j], (1, -1, 3)), axis=-1)
                assert apart.min(initial=np.inf) >= CONFIG.separation


@pytest.mark.parametrize("downwash", [1.0, 2.0])
def test_the_planes_of_obstacles_touch_them_and_move_along(downwash):
    config = PlannerConfig(problem="voronoi", downwash=downwash)
    x = np.zeros((1, 9))
    x[0, 2] = 1.5
    where = np.array([2.0, 1.0, 0]) + 0.1 * np.arange(1, 11)[:, None] * [-0.5, 0, 0]
    pillar = Problems(x, x[:, :3], where[None, None], shape=np.array([[[1.0, 1, 0]]]), size=np.array([[0.25]]))
    cells = cells_of(pillar, config, True)
    assert cells.shape[0, 0, 2] == 0
    kept = config.separation + VoronoiCells.buffer + 0.25
    nearest = where - kept * np.array([2.0, 1, 0]) / np.hypot(2, 1)
    nearest[:, 2] = 0.7
    np.testing.assert_allclose(gaps(cells, nearest[None]), config.separation, atol=1e-6)


def test_robots_are_ellipsoids_with_downwash():
    config = PlannerConfig(problem="voronoi", downwash=2.0)
    x = np.zeros((1, 9))
    above = np.tile([0.0, 0, 2.0], (1, 1, 10, 1))
    shape = np.array([[[1.0, 1, 0.5]]])
    cells = cells_of(Problems(x, x[:, :3], above, shape=shape, size=np.zeros((1, 1))), config, True)
    # In its metric, the other is 1 m away
    edge = np.tile([0.0, 0, 2 * (0.5 - 0.3 - VoronoiCells.buffer)], (1, 10, 1))
    np.testing.assert_allclose(gaps(cells, edge), config.separation, atol=1e-9)


def test_a_robot_that_is_stuck_makes_a_detour_to_the_right():
    x = np.zeros((2, 9))
    x[:, 0] = [-0.3, -2.0]
    ahead = np.tile([0.35, 0, 0], (2, 1, 10, 1))
    cells = cells_of(Problems(x, np.array([[5.0, 0, 0]] * 2), ahead))
    np.testing.assert_allclose(cells.goal, [[-0.3, -VoronoiCells.detour, 0], [5, 0, 0]])


@pytest.mark.parametrize("solver", SOLVERS)
def test_plans_stay_in_their_cells(solver):
    problems = crossing(60, CONFIG)
    cells = cells_of(problems)
    stands = problems._replace(x=problems.x * ([1] * 3 + [0] * 6))  # who moves fast may not be able to
    planner = make_planner(CONFIG, QUADROTOR, 3, solver)
    plans = planner.plan(stands, hover(stands, CONFIG))
    assert (plans.status == 0).all()
    cells = cells_of(stands)
    violated = CONFIG.separation - gaps(cells, plans.x[:, 1:, :3])
    started = CONFIG.separation - gaps(cells, np.repeat(stands.x[:, None, :3], 10, axis=1))
    inside = started.max(axis=(1, 2)) < 0
    assert inside.sum() > 20
    assert violated[inside].max() < 0.01
    moved = np.linalg.norm(plans.x[:, -1, :3] - stands.x[:, :3], axis=1)
    assert np.median(moved) > 0.05


def test_both_solvers_find_the_same_plans():
    problems = crossing(30, CONFIG)
    rti, fatrop = (make_planner(CONFIG, QUADROTOR, 3, name).plan(problems, hover(problems, CONFIG)) for name in SOLVERS)
    apart = np.linalg.norm(rti.x[..., :3] - fatrop.x[..., :3], axis=-1).max(axis=1)
    assert np.median(apart) < 5e-3
    assert np.quantile(apart, 0.9) < 0.05


def test_robots_in_one_place_and_alone_have_plans():
    x = np.zeros((2, 9))
    x[:, 2] = 1.5
    same = Problems(x, np.array([[2.0, 0, 1.5]] * 2), np.tile([0.0, 0, 1.5], (2, 1, 10, 1)))
    plans = make_planner(CONFIG, QUADROTOR, 2).plan(same, Plans.hover(x, 10))
    assert np.isfinite(plans.x).all()
    alone = Problems(x, same.goal, np.zeros((2, 0, 10, 3)))
    plans = make_planner(CONFIG, QUADROTOR, 1).plan(alone, Plans.hover(x, 10))
    assert (plans.x[:, -1, 0] > 0.3).all()


def test_what_others_send_changes_nothing():
    """Only where they are now, and how fast they are, matters."""
    problems = crossing(10, CONFIG)
    known = problems._replace(announced=np.ones((10, 2), dtype=bool))
    turned = problems.others.copy()
    turned[:, :, 2:] += 1.0
    planner = make_planner(PlannerConfig(problem="voronoi", right_of_way=0.3), QUADROTOR, 3)
    expected = planner.plan(problems, hover(problems, CONFIG))
    found = planner.plan(known._replace(others=turned), hover(problems, CONFIG))
    assert np.array_equal(found.u, expected.u)


@pytest.mark.parametrize("preset", ["paper", "flight"])
def test_swarms_without_messages_have_no_collisions(preset):
    planner = {"problem": "voronoi", "horizon": 7 if preset == "paper" else 14}
    config = make_config(preset, n_robots=5, planner=planner)
    (rows,) = fly_all([Condition("none", "symmetric_swap", config, 300)], 3).values()
    assert not any(row["collided"] for row in rows)
    assert any(row["arrived"] for row in rows)
    assert not sum(row["planner_failures"] for row in rows)
