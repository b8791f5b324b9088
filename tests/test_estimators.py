"""The gradient through the threshold, against enumeration, sampling and finite differences."""

from itertools import pairwise

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_maddpg.estimators import ESTIMATORS, expected, nested_sets, score, straight_through


def multilinear(seed: int, n_agents: int, k: int):
    """A critic that is an arbitrary function of an agent's bits, continued multilinearly between them."""
    table = th.as_tensor(np.random.default_rng(seed).normal(size=(n_agents, 2**k)))
    corners = th.as_tensor(np.array(list(np.ndindex(*(2,) * k))), dtype=th.float64)

    def q(own: th.Tensor) -> th.Tensor:
        weights = th.where(corners == 1, own.unsqueeze(-2), 1 - own.unsqueeze(-2)).prod(dim=-1)
        return (weights * table[:, None]).sum(dim=-1)

    return q


def by_enumeration(scores: th.Tensor, q) -> th.Tensor:
    """Cut [0, 1] at the scores; the bits are constant for a threshold within each piece."""
    total = th.zeros(scores.shape[:-1], dtype=scores.dtype)
    for index in np.ndindex(*scores.shape[:-1]):
        cuts = sorted({0.0, 1.0, *scores[index].tolist()})
        for low, high in pairwise(cuts):
            own = th.zeros(*scores.shape[:-1], 1, scores.shape[-1], dtype=scores.dtype)
            own[index] = (scores[index] > (low + high) / 2).to(scores.dtype)
            total[index] += (high - low) * q(own)[index].squeeze(-1)
    return total


def random_scores(seed: int, *shape: int) -> th.Tensor:
    return th.as_tensor(np.random.default_rng(seed).uniform(size=shape))


# Few values, so that scores tie with each other and with 0 and 1
SCORE = st.sampled_from([0.0, 0.25, 0.5, 1.0]) | st.floats(0, 1)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 5).flatmap(lambda k: st.lists(SCORE, min_size=k, max_size=k)), st.integers(0, 10**6))
def test_expected_is_the_sum_over_the_pieces_of_the_threshold(values, seed):
    scores = th.tensor([[values]], dtype=th.float64)
    q = multilinear(seed, 1, len(values))
    assert th.allclose(expected(scores, q), by_enumeration(scores, q), atol=1e-12)


def test_expected_works_on_a_batch_of_teams():
    scores, q = random_scores(0, 5, 4, 3), multilinear(1, 4, 3)
    assert th.allclose(expected(scores, q), by_enumeration(scores, q), atol=1e-12)


def test_expected_is_the_mean_over_sampled_thresholds():
    scores, q, n = random_scores(2, 1, 2, 3), multilinear(3, 2, 3), 40_000
    delta = th.as_tensor(np.random.default_rng(4).uniform(size=(n, 2, 1)))
    samples = q((scores > delta).to(scores.dtype).unsqueeze(-2)).squeeze(-1)
    standard_error = samples.std(dim=0) / n**0.5
    assert ((expected(scores, q)[0] - samples.mean(dim=0)).abs() < 4 * standard_error).all()


def test_expected_gradient_is_that_of_finite_differences():
    scores, q = random_scores(5, 3, 2, 4).requires_grad_(), multilinear(6, 2, 4)
    (gradient,) = th.autograd.grad(expected(scores, q).sum(), scores)
    step = 1e-6
    for index in np.ndindex(*scores.shape):
        above, below = scores.detach().clone(), scores.detach().clone()
        above[index] += step
        below[index] -= step
        difference = (by_enumeration(above, q).sum() - by_enumeration(below, q).sum()) / (2 * step)
        assert gradient[index].item() == pytest.approx(difference.item(), abs=1e-6)


def test_one_bit_has_the_difference_of_its_values_as_gradient():
    scores, q = random_scores(7, 4, 2, 1).requires_grad_(), multilinear(8, 2, 1)
    off, on = (q(th.full((1, 2, 1, 1), bit, dtype=th.float64)).squeeze(-1) for bit in (0.0, 1.0))
    value = expected(scores, q)
    assert th.allclose(value, scores.squeeze(-1) * on + (1 - scores.squeeze(-1)) * off)
    (gradient,) = th.autograd.grad(value.sum(), scores)
    assert th.allclose(gradient.squeeze(-1), (on - off).expand(4, 2))


def test_expected_asks_only_about_bits_that_occur():
    asked = []

    def q(own: th.Tensor) -> th.Tensor:
        asked.append(own)
        return own.sum(dim=-1)

    scores = th.tensor([[[0.2, 0.9, 0.9]]], dtype=th.float64)
    assert expected(scores, q).item() == pytest.approx(2.0)
    (sets,) = asked
    assert sets.tolist() == [[[[0, 0, 0], [0, 1, 0], [0, 1, 1], [1, 1, 1]]]]


def test_nested_sets_grow_by_the_highest_score_left():
    scores = random_scores(9, 6, 3, 5)
    sets = nested_sets(scores)
    assert sets.sum(dim=-1).eq(th.arange(6)).all()
    for m in range(6):
        included, excluded = sets[..., m, :] == 1, sets[..., m, :] == 0
        lowest_in = scores.masked_fill(~included, 2.0).amin(dim=-1)
        highest_out = scores.masked_fill(~excluded, -1.0).amax(dim=-1)
        assert (lowest_in >= highest_out).all()


def test_straight_through_has_the_critics_gradient_at_sampled_bits():
    scores, q = random_scores(10, 200, 2, 3).requires_grad_(), multilinear(11, 2, 3)
    th.manual_seed(0)
    (gradient,) = th.autograd.grad(straight_through(scores, q).sum(), scores)
    th.manual_seed(0)
    bits = (scores > th.rand_like(scores[..., :1])).to(scores.dtype).detach().requires_grad_()
    (at_bits,) = th.autograd.grad(q(bits.unsqueeze(-2)).sum(), bits)
    assert th.allclose(gradient, at_bits)
    assert 0.1 < bits.mean() < 0.9


def test_straight_through_has_the_right_mean_and_a_gradient_that_is_biased_unless_the_critic_is_linear():
    n = 40_000
    scores = random_scores(12, 1, 1, 3).expand(n, 1, 3).clone().requires_grad_()
    q, weights = multilinear(13, 1, 3), th.tensor([0.3, -0.7, 0.2], dtype=th.float64)
    (exact,) = th.autograd.grad(expected(scores, q).sum(), scores)
    th.manual_seed(0)
    values = straight_through(scores, q)
    assert abs((values.mean() - expected(scores[:1], q)).item()) < 4 * values.std().item() / n**0.5
    (sampled,) = th.autograd.grad(values.sum(), scores)
    error = (sampled.mean(dim=0) - exact[0]).abs() / (sampled.std(dim=0) / n**0.5 + 1e-12)
    assert error.max() > 10  # standard errors
    for estimator in (straight_through, expected, score):
        linear = estimator(scores, lambda own: (own * weights).sum(dim=-1))
        (gradient,) = th.autograd.grad(linear.sum(), scores)
        assert th.allclose(gradient, weights.expand_as(gradient))


def test_score_asks_at_the_scores_themselves():
    scores, q = random_scores(14, 5, 2, 3), multilinear(15, 2, 3)
    assert th.equal(score(scores, q), q(scores.unsqueeze(-2)).squeeze(-1))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_gives_one_value_per_agent(name):
    scores, q = random_scores(16, 7, 2, 3).requires_grad_(), multilinear(17, 2, 3)
    objective = ESTIMATORS[name](scores, q)
    assert objective.shape == (7, 2)
    (gradient,) = th.autograd.grad(objective[:, 0].sum(), scores)
    assert gradient[:, 0].abs().sum() > 0
    assert gradient[:, 1].abs().sum() == 0
