"""What is computed for pairs: compiled and by NumPy to the same bits, and what it means."""

from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest

from quad_swarm.native import pairs

DT = 0.1


def scene(n_swarms: int, n: int, horizon: int, seed: int = 0) -> SimpleNamespace:
    """Robots near each other, about half of which remember a plan of each other."""
    rng = np.random.default_rng(seed)
    shape = (n_swarms, n, n - 1)
    pos, vel = rng.normal(size=(*shape, 3)), rng.normal(size=(*shape, 3))
    remembered = pos[..., None, :] + 0.1 * rng.normal(size=(*shape, horizon + 1, 3)).cumsum(axis=-2)
    remembered[..., 1, :] = pos + 0.02 * rng.normal(size=pos.shape)
    return SimpleNamespace(
        pos=pos,
        vel=vel,
        remembered=remembered,
        age=rng.integers(0, horizon + 2, shape),
        remembers=rng.random(shape) < 0.5,
        arriving=(arriving := rng.random(shape) < 0.4),
        received=rng.normal(size=(arriving.sum(), horizon + 1, 3)),
        ages=rng.integers(1, horizon + 2, arriving.sum()),
        x=rng.normal(size=(n_swarms * n, 9)),
        own=rng.normal(size=(n_swarms, n, 3)),
        plan=rng.normal(size=(n_swarms, n, horizon, 3)).cumsum(axis=-2),
        later=rng.random((n_swarms, n)),
        vels=rng.normal(size=(n_swarms, n, 3)),
        centres=rng.normal(size=(n_swarms, 3, horizon, 3)),
        factors=rng.choice([0.0, 0.5, 1.0], (n_swarms, 3, 3)),
        radius=rng.random((n_swarms, 3)),
        present=rng.random((n_swarms, 3)) < 0.7,
        path=rng.normal(size=(1, n_swarms, n, 3)) + 0.2 * rng.normal(size=(4, n_swarms, n, 3)).cumsum(axis=0),
    )


def neighbourhoods(s: SimpleNamespace) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the neighbours along the paths of a scene."""
    _, n_swarms, n, _ = s.path.shape
    m = max((n - 1) // 2, 1)
    others = np.broadcast_to(np.arange(n)[:, None], (n_swarms, n, m)).astype(np.int64)
    present, steps = np.zeros(others.shape, dtype=bool), []
    for pos, limit in zip(s.path, (np.inf, 1.0, 2.0, 1.5), strict=True):
        others, present, reverse = pairs.neighbours(pos, s.vels, others, present, limit, 0.5 * (limit < 2))
        steps.append((others, present, reverse))
    return steps


def everything(s: SimpleNamespace) -> dict[str, list[np.ndarray]]:
    """What all functions make of a scene."""
    belief = (s.pos, s.vel, s.remembered, s.remembers)
    resampled = pairs.believe(*belief, DT)
    others = resampled.reshape(s.x.shape[0], *resampled.shape[2:]).copy()
    pairs.resample(resampled, s.later)
    n_swarms, *_, horizon, _ = s.remembered.shape
    n_paths = s.age[:1].size
    paths = s.remembered[..., 1:, :].reshape(n_swarms, n_paths, horizon - 1, 3), s.age.reshape(n_swarms, n_paths) / 9
    near = neighbourhoods(s)
    answers = []
    for k, ages in enumerate((s.ages, 2, s.ages[:0])):
        arriving = s.arriving if k < 2 else np.zeros_like(s.arriving)
        known = pairs.Known(s.pos, s.vel, s.remembers, s.age, np.array(s.remembered, order="C"))
        plans = s.received[: arriving.sum()]
        found = pairs.receive(known, arriving, plans, ages, DT, memory=k != 1, predicts=k < 2)
        answers += [one for one in (*found, known.remembered) if one is not None]
    return {
        "receive": answers,
        "remember": list(pairs.remember(s.remembered, s.age, s.pos, 0.03)),
        "believe": [pairs.believe(*belief, DT), pairs.believe(*belief, DT, [2, 0])],
        "approach": list(pairs.approach(s.own, s.plan, *belief, DT)),
        "nearest_obstacle": list(pairs.nearest_obstacle(*paths, s.centres, s.factors, s.radius, s.present)),
        "resample": [resampled],
        "neighbours": [array for step in near for array in step],
        "keep_right": list(pairs.keep_right(s.x, others, s.remembers.reshape(others.shape[:2]), 0.3, DT, 1.0, 0.5)),
    }


@pytest.mark.parametrize("sizes", [(0, 3, 4), (1, 1, 4), (1, 2, 3), (3, 4, 7), (20, 8, 20)])
def test_compiled_and_numpy_agree_to_the_last_bit(sizes, monkeypatch):
    compiled = everything(scene(*sizes))
    monkeypatch.setattr(pairs, "compiled", lambda: None)
    for name, arrays in everything(scene(*sizes)).items():
        for mine, reference in zip(compiled[name], arrays, strict=True):
            assert mine.dtype == reference.dtype, name
            assert np.array_equal(mine, reference), name


def test_what_is_given_stays_as_it_is_and_may_lie_anyhow(either):
    s = scene(2, 4, 5)
    expected = everything(s)
    strided = SimpleNamespace(**{key: np.asfortranarray(value) for key, value in vars(s).items()})
    before = deepcopy(vars(strided))
    for name, arrays in everything(strided).items():
        for mine, reference in zip(arrays, expected[name], strict=True):
            assert np.array_equal(mine, reference), name
    assert all(np.array_equal(value, before[key]) for key, value in vars(strided).items())


def test_advance_goes_on_straight():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 1, 0]])
    assert pairs.advance(line).tolist() == [[1, 0, 0], [2, 1, 0], [3, 2, 0]]


def test_plans_are_remembered_while_they_fit_and_are_young(either):
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 1, 0]])
    seen = np.array([[1.0, 0, 0.1], [1.0, 0, 0.3], [1.0, 0, 0]])
    later, age, error, remembers = pairs.remember(np.tile(line, (3, 1, 1)), np.array([0, 0, 1]), seen, 0.2)
    assert later[0].tolist() == [[1, 0, 0], [2, 1, 0], [3, 2, 0]]
    assert age.tolist() == [1, 1, 2]
    assert error == pytest.approx([0.1, 0.3, 0.0])
    assert remembers.tolist() == [True, False, False]


def test_constant_velocities_start_one_step_ahead(either):
    pos, vel = np.zeros((1, 1, 1, 3)), np.array([[[[1.0, 0, -2]]]])
    believed = pairs.believe(pos, vel, np.zeros((1, 1, 1, 3, 3)), np.zeros((1, 1, 1), bool), 0.5)
    assert believed[0, 0, 0].tolist() == [[0.5, 0, -1], [1, 0, -2]]


def test_the_first_of_equally_close_stages_is_named(either):
    pos, vel = np.array([[[[2.0, 0, 0]]]]), np.zeros((1, 1, 1, 3))
    plan = np.array([[[[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0.5, 0, 0]]]])
    never = np.zeros((1, 1, 1), bool)
    least, stage, last = pairs.approach(np.zeros((1, 1, 3)), plan, pos, vel, np.zeros((1, 1, 1, 5, 3)), never, DT)
    assert (least.item(), stage.item(), last.item()) == (1.0, 1, 1.5)


def test_the_nearest_obstacle_is_that_whose_surface_is(either):
    """A ball of 1 m, 3 m away, is farther than a pillar of 2 m, 3.5 m away, whose height does not count; the third is
    not there."""
    path = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0, 0]])[None, None]
    centres = np.array([[-3.0, 0, 0], [4.0, 0, 9], [0.5, 0, 0]])[None, :, None] * np.ones((3, 1))
    factors, radius = np.array([[[1.0, 1, 1], [1, 1, 0], [1, 1, 1]]]), np.array([[1.0, 2.0, 1.0]])
    present = np.array([[True, True, False]])
    gap, stage, towards = pairs.nearest_obstacle(path, np.array([[0.25]]), centres, factors, radius, present)
    assert (gap.item(), stage.item(), towards.tolist()) == (1.25, 1, [[[1.0, 0.0, 0.0]]])
    gap, stage, towards = pairs.nearest_obstacle(path, np.array([[0.25]]), centres, factors, radius, present & False)
    assert (gap.item(), stage.item(), towards.tolist()) == (np.inf, 0, [[[0.0, 0.0, 0.0]]])
