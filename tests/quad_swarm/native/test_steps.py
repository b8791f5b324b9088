"""What is measured and counted of a step: compiled and by NumPy to the same bits, and what it means."""

import numpy as np
import pytest

from quad_swarm.native import pairs, steps


def random_step(rng: np.random.Generator, shape: tuple[int, ...], empty: bool) -> steps.Counted:
    """What is counted of a step, in which there may be empty slots."""
    n_swarms, n, _ = shape
    return steps.Counted(
        rng.integers(0, 9, n_swarms),
        *(rng.random((3, n_swarms)) < 0.2),
        at_goal=rng.random((n_swarms, n)) < 0.8,
        belief_source=rng.integers(0, 3, shape),
        plan_age=rng.integers(0, 9, shape),
        plan_status=rng.integers(0, 4, (n_swarms, n)),
        others=rng.integers(-1, n, shape) if empty else None,
        moved=rng.random(n_swarms),
        min_separation=rng.random(n_swarms),
        min_separation_continuous=rng.random(n_swarms),
    )


def everything(n_swarms: int, n: int, order: str = "C") -> list[np.ndarray]:
    """What is made of six random steps, whose arrays have a memory order."""
    rng = np.random.default_rng(0)
    statistics = np.zeros(n_swarms, dtype=steps.STATISTICS)
    statistics["min_separation"] = statistics["min_separation_continuous"] = np.inf
    found = []
    for k in range(6):
        step = random_step(rng, (n_swarms, n, n - 1), empty=bool(k % 2))
        before = steps.Counted(*(None if one is None else np.array(one, order=order) for one in step))
        given = steps.Counted(*(None if one is None else np.array(one, order=order) for one in step))
        steps.count(statistics, given, failed=2, seconds=0.1)
        assert all(one is None or np.array_equal(one, other) for one, other in zip(given, before, strict=True))
        path = np.array(rng.normal(size=(2 + k, n_swarms, n, 3)).cumsum(axis=0), order=order)
        goals = np.array(rng.normal(size=(n_swarms, n, 3)), order=order)
        others = np.array(rng.integers(0, n, (n_swarms, n, 2)), order=order) if k % 2 else None
        found += steps.measure(path, goals, 0.5, 1.0, others)
    return [*found, *(statistics[name] for name in steps.STATISTICS.names)]


@pytest.mark.parametrize("sizes", [(0, 3), (1, 1), (1, 2), (3, 4), (20, 8)])
def test_compiled_and_numpy_agree_to_the_last_bit(sizes, monkeypatch):
    compiled = everything(*sizes)
    monkeypatch.setattr(pairs, "compiled", lambda: None)
    for mine, reference in zip(compiled, everything(*sizes), strict=True):
        assert mine.dtype == reference.dtype
        assert np.array_equal(mine, reference)


def test_what_is_given_may_lie_anyhow(either):
    for mine, reference in zip(everything(2, 4, "F"), everything(2, 4), strict=True):
        assert np.array_equal(mine, reference)


def test_contact_and_arrival_are_measured(either):
    before = np.array([[[0.0, 0, 0], [2, 0.4, 0]]])
    after = np.array([[[2.0, 0, 0], [0, 0.4, 0]]])
    goals = np.array([[[2.0, 0, 0.9], [5, 0, 0]]])
    measured = steps.measure(np.array([before, after]), goals, contact=0.5, goal_radius=1.0)
    assert measured.separation[0, 0, 0] == measured.min_separation[0] == pytest.approx(np.hypot(2, 0.4))
    assert measured.separation_continuous[0, 0, 0] == measured.min_separation_continuous[0] == pytest.approx(0.4)
    assert not measured.colliding.any()
    assert measured.colliding_continuous.all()
    assert measured.moved.tolist() == [[2.0, 2.0]]
    assert measured.at_goal.tolist() == [[True, False]]


@pytest.mark.parametrize("n_swarms", [0, 1, 3])
@pytest.mark.parametrize("height", [1.0, 2.0])
def test_what_is_taken_off_separations_changes_nothing_else(n_swarms, height, either):
    rng, n = np.random.default_rng(1), 4
    path, goals = rng.normal(size=(3, n_swarms, n, 3)), rng.normal(size=(n_swarms, n, 3))
    excess = rng.normal(size=(n, n))
    excess += excess.T
    np.fill_diagonal(excess, 0.0)
    everybody = np.broadcast_to(np.arange(n), (n_swarms, n, n))
    plain, less = (steps.measure(path, goals, 0.5, 1.0, everybody, height, one) for one in (None, excess))
    assert np.array_equal(less.separation, plain.separation - excess)
    assert np.array_equal(less.separation_continuous, plain.separation_continuous - excess)
    assert np.array_equal(less.min_separation, (plain.separation - excess).min(axis=(1, 2)))
    assert np.array_equal(less.min_separation_continuous, (plain.separation_continuous - excess).min(axis=(1, 2)))
    assert np.array_equal(less.colliding, less.separation < 0.5)
    assert np.array_equal(less.colliding_continuous, less.separation_continuous < 0.5)
    assert np.array_equal(less.moved, plain.moved)
    assert np.array_equal(less.at_goal, plain.at_goal)
    whole = steps.measure(path, goals, 0.5, 1.0, None, height, excess)
    off = ~np.eye(n, dtype=bool)
    assert np.array_equal(whole.separation, less.separation[:, off].reshape(n_swarms, n, n - 1))
