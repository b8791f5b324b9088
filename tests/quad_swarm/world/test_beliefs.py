"""What robots believe: plans that were asked for, plans that are remembered, constant velocities."""

import numpy as np
import pytest

from quad_swarm.native.pairs import advance
from quad_swarm.world.beliefs import (
    Beliefs,
    BeliefSource,
    answered,
    other_indices,
    resampled,
)

N, DT = 4, 0.1


def straight_plans(pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
    """Plans made one step ago by robots that now are at ``pos`` and fly straight: stages 0..N."""
    times = DT * np.arange(-1, N)
    return pos[:, :, None] + times[:, None] * vel[:, :, None]


def constant_velocity(pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
    return pos + DT * np.arange(1, N + 1)[:, None] * vel


def update(
    beliefs: Beliefs, asked: np.ndarray, pos: np.ndarray, vel: np.ndarray, plans: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`Beliefs.update` with what everybody sees and planned."""
    others = other_indices(pos.shape[1])
    received = answered(asked, advance(plans), others)
    return beliefs.update(asked, pos[:, others], vel[:, others], received)


def test_other_indices():
    assert other_indices(3).tolist() == [[1, 2], [0, 2], [0, 1]]


def test_resampled_goes_on_straight_at_both_ends():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 2, 0]])
    assert resampled(line, np.array(0.0)).tolist() == line.tolist()
    assert resampled(line, np.array(0.5)).tolist() == [[0.5, 0, 0], [1.5, 1, 0], [2.5, 3, 0]]
    assert resampled(line, np.array(-0.5)).tolist() == [[-0.5, 0, 0], [0.5, 0, 0], [1.5, 1, 0]]


def test_of_two_answers_the_one_made_later_is_kept():
    beliefs = Beliefs(1, 2, N, DT, memory=0.3)
    pos, vel = np.array([[[[3.0, 0, 1]], [[0.0, 0, 1]]]]), np.zeros((1, 2, 1, 3))
    asked = np.ones((1, 2, 1), bool)
    still = np.repeat(pos.reshape(2, 1, 3), N + 1, axis=1)
    beliefs.update(asked, pos, vel, still, np.array([1, 1]))
    moving = still + np.array([0, 0.1, 0])
    believed, source = beliefs.update(asked, pos, vel, moving, np.array([3, 2]))
    assert source.ravel().tolist() == [BeliefSource.REMEMBERED, BeliefSource.REQUESTED]
    assert believed[0, 0, 0].tolist() == still[0, 1:].tolist()
    assert believed[0, 1, 0].tolist() == moving[1, 1:].tolist()


def test_a_requested_plan_is_shifted_to_now():
    beliefs = Beliefs(1, 2, N, DT, memory=0.0)
    pos = np.array([[[0.0, 0, 1], [3, 0, 1]]])
    vel = np.array([[[1.0, 0, 0], [0, 2, 0]]])
    plans = straight_plans(pos, np.array([[[0.0, 0, 0], [0, -1, 0]]]))  # robot 1 plans something else than it does now
    believed, source = update(beliefs, np.array([[[True], [False]]]), pos, vel, plans)
    assert source.ravel().tolist() == [BeliefSource.REQUESTED, BeliefSource.CONSTANT_VELOCITY]
    # Stage k of the belief is stage k + 1 of the plan of one step ago.
    np.testing.assert_allclose(believed[0, 0, 0, : N - 1], plans[0, 1, 2:])
    np.testing.assert_allclose(believed[0, 1, 0], constant_velocity(pos[0, 0], vel[0, 0]))


@pytest.mark.parametrize(("memory", "remembers"), [(0.0, False), (0.3, True)])
def test_memory_is_a_switch(memory, remembers):
    beliefs = Beliefs(1, 2, N, DT, memory)
    pos, vel = np.array([[[0.0, 0, 1], [3, 0, 1]]]), np.zeros((1, 2, 3))
    turning = np.array([[[0.0, 0, 0], [0, 1, 0]]])
    asked, silent = np.ones((1, 2, 1), bool), np.zeros((1, 2, 1), bool)
    update(beliefs, asked, pos, vel, straight_plans(pos, turning))
    pos = pos + DT * turning
    believed, source = update(beliefs, silent, pos, vel, straight_plans(pos, turning))
    if remembers:
        assert (source == BeliefSource.REMEMBERED).all()
        np.testing.assert_allclose(believed[0, 0, 0], constant_velocity(pos[0, 1], turning[0, 1]))
    else:
        assert (source == BeliefSource.CONSTANT_VELOCITY).all()


def test_memory_ends_when_the_plan_no_longer_fits_and_when_it_is_old():
    pos, vel = np.array([[[0.0, 0, 1], [3, 0, 1]]]), np.zeros((1, 2, 3))
    asked, silent = np.ones((1, 2, 1), bool), np.zeros((1, 2, 1), bool)

    beliefs = Beliefs(1, 2, N, DT, memory=0.3)
    update(beliefs, asked, pos, vel, straight_plans(pos, vel))
    _, source = update(beliefs, silent, pos + np.array([[[0, 0, 0], [0.2, 0, 0]]]), vel, straight_plans(pos, vel))
    assert (source == BeliefSource.REMEMBERED).all()
    _, source = update(beliefs, silent, pos + np.array([[[0, 0, 0], [0.4, 0, 0]]]), vel, straight_plans(pos, vel))
    assert source.ravel().tolist() == [BeliefSource.CONSTANT_VELOCITY, BeliefSource.REMEMBERED]

    beliefs = Beliefs(1, 2, N, DT, memory=0.3)
    update(beliefs, asked, pos, vel, straight_plans(pos, vel))
    sources = [update(beliefs, silent, pos, vel, straight_plans(pos, vel))[1][0, 0, 0] for _ in range(N)]
    assert sources == [BeliefSource.REMEMBERED] * (N - 2) + [BeliefSource.CONSTANT_VELOCITY] * 2


def test_forget_and_keep_touch_only_the_given_swarms():
    pos, vel = np.tile([[[0.0, 0, 1], [3, 0, 1]]], (3, 1, 1)), np.zeros((3, 2, 3))
    asked, silent = np.ones((3, 2, 1), bool), np.zeros((3, 2, 1), bool)
    beliefs = Beliefs(3, 2, N, DT, memory=0.3)
    update(beliefs, asked, pos, vel, straight_plans(pos, vel))
    beliefs.forget(np.array([1]))
    beliefs.keep(np.array([False, True, True]))
    _, source = update(beliefs, silent[1:], pos[1:], vel[1:], straight_plans(pos[1:], vel[1:]))
    assert (source[0] == BeliefSource.CONSTANT_VELOCITY).all()
    assert (source[1] == BeliefSource.REMEMBERED).all()


def test_refuses_a_negative_memory():
    with pytest.raises(ValueError, match=r"memory=-0\.1"):
        Beliefs(1, 2, N, DT, memory=-0.1)
