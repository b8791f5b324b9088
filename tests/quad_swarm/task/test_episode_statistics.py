"""What is counted of an episode, and until when."""

import copy
import pickle

import numpy as np
import pytest

from quad_swarm.planner import PlanStatus
from quad_swarm.task.episode_statistics import EpisodeStatistics, exchange_bytes
from quad_swarm.task.request_task import RequestTask, make_task
from quad_swarm.world.messages import REQUEST_BYTES, pack_plan

ALL = np.ones((1, 2, 1), bool)
APART = np.array([[-1.0, 0, 1], [1.0, 0, 1]])


def begun(starts, goals) -> RequestTask:
    """Two robots whose episode goes on after a collision."""
    task = make_task(n_robots=2)
    task.end_at_collision = False
    task.place(0, "given", np.asarray(starts), np.asarray(goals), np.random.default_rng(0), checked=True)
    return task


def put(task: RequestTask, positions) -> None:
    """Move the robots there, at rest."""
    task.swarm.reset(0, np.asarray(positions), task.swarm.goal[0], checked=True)


def test_requests_stop_counting_at_a_collision_while_separations_go_on():
    task = begun(APART, [[0.0, 3, 1], [0, -3, 1]])
    statistics = task.statistics
    for _ in range(3):
        task.step(ALL)
    assert not statistics.collided[0]
    put(task, [[-0.25, 0, 1], [0.25, 0, 1]])
    task.step(ALL)
    assert statistics.collided[0]
    path = statistics.path_length[0]
    assert (statistics.steps_counted[0], statistics.requests[0]) == (4, 8), "the step of the collision counts"
    deep = statistics.min_separation[0]
    put(task, [[-0.1, 0, 1], [0.1, 0, 1]])
    for _ in range(2):
        task.step(ALL)
    assert (statistics.steps[0], statistics.steps_counted[0]) == (6, 4)
    assert (statistics.requests_flown[0], statistics.requests[0]) == (12, 8)
    assert statistics.path_length[0] == path > 0
    assert statistics.min_separation[0] < 0.3 < deep
    assert statistics.min_separation_continuous[0] <= statistics.min_separation[0]


def test_who_collides_first_reaches_the_goals_but_has_not_arrived():
    task = begun([[-0.25, 0, 1], [0.25, 0, 1]], APART)
    statistics = task.statistics
    task.step(ALL)
    assert statistics.collided[0]
    put(task, APART)
    task.step(ALL)
    assert (statistics.reached[0], statistics.arrived[0], statistics.success[0]) == (True, False, False)
    assert statistics.metrics()["swarm/arrival_rate"] == 0.0


def test_who_arrives_first_and_collides_later_has_arrived_without_success():
    task = begun(APART, APART)
    statistics = task.statistics
    task.step(ALL)
    assert (statistics.reached[0], statistics.arrived[0], statistics.success[0]) == (True, True, True)
    put(task, [[-0.1, 0, 1], [0.1, 0, 1]])
    task.step(ALL)
    assert (statistics.arrived[0], statistics.collided[0], statistics.success[0]) == (True, True, False)
    assert statistics.requests[0] == 2, "nothing counts after the arrival"


def test_all_robots_have_to_be_at_their_goals_at_once():
    task = begun([[-1.0, 0, 1], [2.0, 0, 1]], APART)
    task.step(ALL)
    assert not task.statistics.reached[0]


def test_swarms_are_counted_by_themselves():
    task = make_task(n_swarms=3, n_robots=2)
    for k in range(3):
        task.place(k, "given", APART, APART[::-1], np.random.default_rng(0))
    requests = np.array([[[True], [True]], [[True], [False]], [[False], [False]]])
    for _ in range(4):
        task.step(requests)
    statistics = task.statistics
    assert statistics.requests.tolist() == [8, 4, 0]
    assert statistics.metrics()["comm/request_share"].tolist() == [1.0, 0.5, 0.0]
    statistics.reset(1)
    task.step(requests)
    assert statistics.requests.tolist() == [10, 1, 0]
    assert statistics.steps.tolist() == [5, 1, 5]
    row = statistics.row(1)
    statistics.keep(np.array([False, True, True]))
    assert statistics.row(0) == row
    assert row.keys() == EpisodeStatistics(1, task.swarm.config).row(0).keys()
    assert all(type(value) in (int, float, bool) for value in row.values()), "rows are written as JSON"


def test_plans_without_a_solve_are_failures():
    task = begun(APART, APART[::-1])
    task.swarm.planner.solver.max_iterations = 1
    for _ in range(3):
        assert (task.step(ALL).report.plan_status >= PlanStatus.SHIFTED).all()
    assert task.statistics.planner_failures[0] == 6
    metrics = task.statistics.metrics()
    assert metrics["planner/failure_rate"] == 1.0
    seconds = task.statistics.solve_seconds[0]
    assert metrics["planner/solve_us"] == pytest.approx(1e6 * seconds / 6)
    assert seconds > 0


def test_what_communication_costs():
    task = make_task(n_robots=2, planner={"dt": 0.05})
    task.place(0, "given", APART, [[0.0, 3, 1], [0, -3, 1]], np.random.default_rng(0))
    one = np.array([[[True], [False]]])
    for requests in (ALL, ALL, one, ~ALL):
        task.step(requests)
    metrics = task.statistics.metrics()
    size = exchange_bytes(task.swarm.config)
    assert size == REQUEST_BYTES + len(pack_plan(0, 1, 0, np.zeros((11, 3))))
    assert metrics["comm/bytes_per_second"][0] == pytest.approx(size * 5 / (2 * 4 * 0.05))
    assert metrics["comm/peak_requests"][0] == 2
    # One step old when they are asked for; remembered plans are older.
    ages = [1, 1, 1, 1, 1, 2, 2, 3]
    assert metrics["comm/plan_age"][0] == pytest.approx(0.05 * np.mean(ages))


def test_contact_between_steps_is_told_from_contact_at_them():
    task = begun([[-1.0, 0.1, 1], [1.0, -0.1, 1]], APART[::-1])
    task.swarm.state[0, :, 3] = [20.0, -20.0]
    task.step(ALL)
    assert task.statistics.collided_continuous[0]
    assert not task.statistics.collided_at_steps[0]
    assert not task.statistics.collided[0]
    put(task, [[-0.1, 0, 1], [0.1, 0, 1]])
    task.step(ALL)
    assert task.statistics.collided_at_steps[0]


@pytest.mark.parametrize("world", [{}, {"obstacles": {"number": [1, 2]}}])
def test_copies_have_the_same_metrics(world):
    task = make_task(n_robots=2, scenario="symmetric_swap", world=world)
    task.reset(0, np.random.default_rng(0))
    task.step(ALL)
    expected = task.statistics.metrics()
    assert ("swarm/min_obstacle_distance" in expected) == bool(world)
    for statistics in (copy.deepcopy(task.statistics), pickle.loads(pickle.dumps(task.statistics))):
        metrics = statistics.metrics()
        assert metrics.keys() == expected.keys()
        assert all(np.array_equal(metrics[name], expected[name]) for name in expected)
