"""The gradient through discrete actions, against enumeration, sampling and finite differences."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_maddpg.common.estimators import (
    ESTIMATORS,
    CriticOfOwnAction,
    expected_binary,
    expected_categorical,
    gapped_straight_through_binary,
    gapped_straight_through_categorical,
    gumbel_softmax_binary,
    nested_sets,
    rao_blackwell_binary,
    rao_blackwell_categorical,
    score_binary,
    score_categorical,
    straight_through_binary,
    straight_through_categorical,
)

KINDS = ("binary", "categorical")
SAMPLES_AN_ACTION = ("straight_through", "gapped_straight_through", "rao_blackwell")
UNREAD = float("nan")  # for estimators that have no temperature
INF = float("inf")


def multilinear(seed: int, n_agents: int, k: int) -> CriticOfOwnAction:
    """A critic that is an arbitrary function of an agent's bits, continued multilinearly between them."""
    table = th.as_tensor(np.random.default_rng(seed).normal(size=(n_agents, 2**k)))
    corners = th.as_tensor(np.array(list(np.ndindex(*(2,) * k))), dtype=th.float64)

    def q(own: th.Tensor) -> th.Tensor:
        weights = th.where(corners == 1, own.unsqueeze(-2), 1 - own.unsqueeze(-2)).prod(dim=-1)
        return (weights * table[:, None]).sum(dim=-1)

    return q


def multilinear_in_heads(seed: int, n_agents: int, heads: int, categories: int) -> CriticOfOwnAction:
    """A critic that is an arbitrary function of an agent's categories, continued multilinearly between them."""
    table = th.as_tensor(np.random.default_rng(seed).normal(size=(n_agents, categories**heads)))

    def q(own: th.Tensor) -> th.Tensor:
        weights = own[..., 0, :]
        for head in range(1, heads):
            weights = (weights.unsqueeze(-1) * own[..., head, None, :]).flatten(-2)
        return (weights * table[:, None]).sum(dim=-1)

    return q


def linear(seed: int, *shape: int) -> tuple[CriticOfOwnAction, th.Tensor]:
    """
    :param shape: of one own action
    :return: a critic and its weights
    """
    weights = th.as_tensor(np.random.default_rng(seed).normal(size=shape))
    return lambda own: (own * weights).flatten(3).sum(dim=-1), weights


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


def by_enumeration_of_categories(logits: th.Tensor, q) -> th.Tensor:
    """Each joint action's probability, the product over heads, times its value."""
    batch, n_agents, heads, categories = logits.shape
    weights = logits.exp() / logits.exp().sum(dim=-1, keepdim=True)
    total = th.zeros(batch, n_agents, dtype=logits.dtype)
    for joint in np.ndindex(*(categories,) * heads):
        own = th.zeros(batch, n_agents, 1, heads, categories, dtype=logits.dtype)
        own[..., range(heads), joint] = 1.0
        total = total + weights[..., range(heads), joint].prod(dim=-1) * q(own).squeeze(-1)
    return total


def random_scores(seed: int, *shape: int) -> th.Tensor:
    return th.as_tensor(np.random.default_rng(seed).uniform(size=shape))


def random_logits(seed: int, *shape: int) -> th.Tensor:
    return th.as_tensor(np.random.default_rng(seed).normal(size=shape))


def repeated(parameters: list, n: int) -> th.Tensor:
    """:return: the scores or logits of one agent, (n, 1, ...), a leaf: each row has the gradient of one sample"""
    parameters = th.tensor(parameters, dtype=th.float64)
    return parameters.expand(n, 1, *parameters.shape).clone().requires_grad_()


def gradients(estimate: Callable, parameters: th.Tensor, q, temperature: float = 1.0, seed: int = 0) -> th.Tensor:
    """:return: of each sample, (n, number of parameters)"""
    th.manual_seed(seed)
    (gradient,) = th.autograd.grad(estimate(parameters, q, temperature).sum(), parameters)
    return gradient.flatten(1)


def standard_error(samples: th.Tensor) -> th.Tensor:
    return samples.std(dim=0) / len(samples) ** 0.5 + 1e-12


class Recorder:
    """A critic that keeps what it was asked about."""

    def __init__(self, q: CriticOfOwnAction):
        self.q = q
        self.asked: list[th.Tensor] = []

    def __call__(self, own: th.Tensor) -> th.Tensor:
        self.asked.append(own.detach())
        return self.q(own)


# The second agent has fewer bits, sub-actions and categories than the first
BIT_PADDING = th.tensor([[False, False, False], [False, True, False]])
CATEGORY_PADDING = th.tensor(
    [
        [[False, False, False, False], [False, False, True, True]],
        [[False, True, False, False], [False, True, True, True]],
    ]
)


def cases(kind: str, batch: int) -> tuple[th.Tensor, CriticOfOwnAction]:
    """:return: unpadded scores or logits of two agents, (batch, 2, 3) or (batch, 2, 2, 4), and a critic"""
    if kind == "binary":
        return random_scores(16, batch, 2, 3), multilinear(17, 2, 3)
    return random_logits(16, batch, 2, 2, 4), multilinear_in_heads(17, 2, 2, 4)


def padding(kind: str) -> tuple[th.Tensor, float]:
    """:return: where, and what is written there"""
    return (BIT_PADDING, 0.0) if kind == "binary" else (CATEGORY_PADDING, -INF)


# Every estimator


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_gives_one_value_per_agent(name, kind):
    parameters, q = cases(kind, 7)
    objective = getattr(ESTIMATORS[name], kind)(parameters.requires_grad_(), q, 0.7)
    assert objective.shape == (7, 2)
    (gradient,) = th.autograd.grad(objective[:, 0].sum(), parameters)
    assert gradient[:, 0].abs().sum() > 0
    assert gradient[:, 1].abs().sum() == 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("temperature", [0.05, 1.0, 20.0])
def test_padding_leaves_values_and_gradients_finite_and_gets_none(name, kind, temperature):
    raw, q = cases(kind, 50)
    where, filler = padding(kind)
    raw.requires_grad_()
    parameters = raw.masked_fill(where, filler)
    parameters.retain_grad()
    objective = getattr(ESTIMATORS[name], kind)(parameters, q, temperature)
    objective.sum().backward()
    assert objective.isfinite().all()
    assert parameters.grad.isfinite().all()
    assert (raw.grad[:, where] == 0).all()
    assert raw.grad[:, ~where].abs().sum() > 0
    if kind == "categorical":
        assert (parameters.grad[:, where] == 0).all()
        assert (raw.grad[:, 1, 1] == 0).all()  # a padded head has nothing to choose


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_what_the_critic_says_about_padding_is_of_no_weight(name, kind):
    raw, q = cases(kind, 500)
    where, filler = padding(kind)
    raw.requires_grad_()

    def q_with_prize(own: th.Tensor) -> th.Tensor:
        prized = own.masked_fill(~where.unsqueeze(1), 0.0)
        return q(own) + 100 * prized.flatten(3).sum(dim=-1)

    answers = []
    for critic in (q, q_with_prize):
        th.manual_seed(0)
        objective = getattr(ESTIMATORS[name], kind)(raw.masked_fill(where, filler), critic, 2.0)
        answers.append((objective, *th.autograd.grad(objective.sum(), raw)))
    for without, with_prize in zip(*answers, strict=True):
        assert th.allclose(without, with_prize, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_certain_actions_have_finite_values_and_gradients(name, dtype):
    scores = th.tensor([0.0, 1.0, 1e-30, 1 - 1e-7], dtype=dtype).expand(200, 1, 4).clone().requires_grad_()
    logits = th.tensor([[500.0, -500.0, 499.0], [0.0, -INF, -80.0]], dtype=dtype)
    logits = logits.expand(200, 1, 2, 3).clone().requires_grad_()
    for estimate, parameters in ((ESTIMATORS[name].binary, scores), (ESTIMATORS[name].categorical, logits)):
        objective = estimate(parameters, lambda own: own.flatten(3).square().sum(dim=-1), 0.5)
        (gradient,) = th.autograd.grad(objective.sum(), parameters)
        assert objective.dtype == dtype
        assert objective.isfinite().all()
        assert gradient.isfinite().all()


@pytest.mark.parametrize("name", SAMPLES_AN_ACTION)
def test_the_critic_is_asked_about_bits_of_one_shared_threshold(name):
    n, values = 20_000, [0.15, 0.9, 0.5]
    recorder = Recorder(linear(0, 3)[0])
    gradients(ESTIMATORS[name].binary, repeated(values, n), recorder, 0.5)
    (asked,) = recorder.asked
    bits = asked[:, 0, 0]
    assert ((bits == 0) | (bits == 1)).all()
    assert (bits[:, 1] >= bits[:, 2]).all()
    assert (bits[:, 2] >= bits[:, 0]).all()
    error = (bits.mean(dim=0) - th.tensor(values, dtype=th.float64)).abs()
    assert (error < 4 * standard_error(bits)).all()


@pytest.mark.parametrize("name", SAMPLES_AN_ACTION)
def test_the_critic_is_asked_about_categories_drawn_from_the_policy(name):
    n, values = 20_000, [[0.3, -0.8, 1.1, -INF], [0.2, -INF, -INF, 0.9]]
    recorder = Recorder(linear(0, 2, 4)[0])
    logits = repeated(values, n)
    gradients(ESTIMATORS[name].categorical, logits, recorder, 0.5)
    (asked,) = recorder.asked
    assert asked.shape == (n, 1, 1, 2, 4)
    actions = asked[:, 0, 0]
    assert ((actions == 0) | (actions == 1)).all()
    assert (actions.sum(dim=-1) == 1).all()
    joint = actions[:, 0, :, None] * actions[:, 1, None, :]
    head_0, head_1 = logits.detach()[0, 0].softmax(dim=-1)
    assert ((joint.mean(dim=0) - th.outer(head_0, head_1)).abs() < 4 * standard_error(joint)).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SAMPLES_AN_ACTION)
def test_a_sampled_actions_value_is_unbiased(name, kind):
    n = 20_000
    if kind == "binary":
        parameters, q = repeated([0.3, 0.8, 0.55], n), multilinear(13, 1, 3)
        exact = by_enumeration(parameters.detach()[:1], q)
    else:
        parameters, q = repeated([[0.3, -0.8, 1.1], [0.2, 0.9, -INF]], n), multilinear_in_heads(13, 1, 2, 3)
        exact = by_enumeration_of_categories(parameters.detach()[:1], q)
    th.manual_seed(0)
    values = getattr(ESTIMATORS[name], kind)(parameters, q, 0.5).detach()
    assert ((values.mean() - exact).abs() < 4 * standard_error(values)).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_for_a_linear_critic_the_mean_gradient_points_uphill(name, kind):
    if kind == "binary":
        parameters, (q, exact) = repeated([0.3, 0.8, 0.55, 0.1], 20_000), linear(18, 4)
    else:
        parameters, (q, weights) = repeated([[0.3, -0.8, 1.1, -INF], [0.2, 0.9, 0.0, -0.4]], 20_000), linear(18, 2, 4)
        p = parameters.detach()[0, 0].softmax(dim=-1)
        exact = (p * (weights - (p * weights).sum(dim=-1, keepdim=True))).flatten()
    sampled = gradients(getattr(ESTIMATORS[name], kind), parameters, q, 0.7)
    mean = sampled.mean(dim=0)
    unbiased = name in ("expected", "score") or (name, kind) == ("straight_through", "binary")
    assert th.allclose(mean, exact) == unbiased
    if unbiased:
        assert th.allclose(sampled, exact.expand_as(sampled))
    certain = mean.abs() > 4 * standard_error(sampled)
    assert (mean.sign() == exact.sign())[certain].all()
    assert certain.sum() >= 4
    assert th.cosine_similarity(mean, exact, dim=0) > 0.98


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((name, "binary") for name in ("gumbel_softmax", "gapped_straight_through", "rao_blackwell")),
        *((name, "categorical") for name in ("gumbel_softmax", *SAMPLES_AN_ACTION)),
    ],
)
def test_a_higher_temperature_has_less_variance(name, kind):
    if kind == "binary":
        parameters, q = repeated([0.3, 0.8, 0.55], 5000), linear(19, 3)[0]
    else:
        parameters, q = repeated([[0.3, -0.8, 1.1, -INF], [0.2, 0.9, 0.0, -0.4]], 5000), linear(19, 2, 4)[0]
    samples = [
        gradients(getattr(ESTIMATORS[name], kind), parameters, q, temperature) for temperature in (0.4, 1.0, 4.0)
    ]
    for low, high in pairwise(samples):
        assert high.var(dim=0).sum() < 0.7 * low.var(dim=0).sum()


@pytest.mark.parametrize(
    "estimate",
    [expected_binary, straight_through_binary, score_binary, expected_categorical, score_categorical],
    ids=lambda estimate: estimate.__name__,
)
def test_estimators_without_relaxation_do_not_read_the_temperature(estimate):
    parameters, q = cases("binary" if estimate.__name__.endswith("binary") else "categorical", 5)
    samples = [gradients(estimate, parameters.requires_grad_(), q, temperature) for temperature in (UNREAD, 0.1, 9.0)]
    assert th.equal(samples[0], samples[1])
    assert th.equal(samples[0], samples[2])


# Expected, bits. Few values, so that scores tie with each other and with 0 and 1
SCORE = st.sampled_from([0.0, 0.25, 0.5, 1.0]) | st.floats(0, 1)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 5).flatmap(lambda k: st.lists(SCORE, min_size=k, max_size=k)), st.integers(0, 10**6))
def test_expected_is_the_sum_over_the_pieces_of_the_threshold(values, seed):
    scores = th.tensor([[values]], dtype=th.float64)
    q = multilinear(seed, 1, len(values))
    assert th.allclose(expected_binary(scores, q, UNREAD), by_enumeration(scores, q), atol=1e-12)


def test_expected_works_on_a_batch_of_teams():
    scores, q = random_scores(0, 5, 4, 3), multilinear(1, 4, 3)
    assert th.allclose(expected_binary(scores, q, UNREAD), by_enumeration(scores, q), atol=1e-12)


def test_expected_is_the_mean_over_sampled_thresholds():
    scores, q, n = random_scores(2, 1, 2, 3), multilinear(3, 2, 3), 40_000
    delta = th.as_tensor(np.random.default_rng(4).uniform(size=(n, 2, 1)))
    samples = q((scores > delta).to(scores.dtype).unsqueeze(-2)).squeeze(-1)
    error = (expected_binary(scores, q, UNREAD)[0] - samples.mean(dim=0)).abs()
    assert (error < 4 * standard_error(samples)).all()


def test_expected_gradient_is_that_of_finite_differences():
    scores, q = random_scores(5, 3, 2, 4).requires_grad_(), multilinear(6, 2, 4)
    (gradient,) = th.autograd.grad(expected_binary(scores, q, UNREAD).sum(), scores)
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
    value = expected_binary(scores, q, UNREAD)
    assert th.allclose(value, scores.squeeze(-1) * on + (1 - scores.squeeze(-1)) * off)
    (gradient,) = th.autograd.grad(value.sum(), scores)
    assert th.allclose(gradient.squeeze(-1), (on - off).expand(4, 2))


def test_expected_asks_only_about_bits_that_occur():
    recorder = Recorder(lambda own: own.sum(dim=-1))
    scores = th.tensor([[[0.2, 0.9, 0.9]]], dtype=th.float64)
    assert expected_binary(scores, recorder, UNREAD).item() == pytest.approx(2.0)
    (sets,) = recorder.asked
    assert sets.tolist() == [[[[0, 0, 0], [0, 1, 0], [0, 1, 1], [1, 1, 1]]]]


def test_nested_sets_grow_by_the_highest_score_left():
    scores = random_scores(9, 6, 3, 5)
    sets = nested_sets(scores.argsort(dim=-1, descending=True))
    assert sets.sum(dim=-1).eq(th.arange(6)).all()
    for m in range(6):
        included, excluded = sets[..., m, :], ~sets[..., m, :]
        lowest_in = scores.masked_fill(~included, 2.0).amin(dim=-1)
        highest_out = scores.masked_fill(~excluded, -1.0).amax(dim=-1)
        assert (lowest_in >= highest_out).all()


# Expected, categories
LOGIT = st.sampled_from([-INF, 0.0, 1.0]) | st.floats(-20, 20)


@settings(max_examples=100, deadline=None)
@given(st.lists(LOGIT, min_size=1, max_size=5).filter(lambda logits: max(logits) > -INF), st.integers(0, 10**6))
def test_expected_is_the_sum_over_the_categories_of_one_head(values, seed):
    logits = th.tensor([[[values]]], dtype=th.float64, requires_grad=True)
    q = multilinear_in_heads(seed, 1, 1, len(values))
    objective, exact = expected_categorical(logits, q, UNREAD), by_enumeration_of_categories(logits, q)
    assert th.allclose(objective, exact, atol=1e-12)
    pair = [th.autograd.grad(value.sum(), logits)[0] for value in (objective, exact)]
    assert th.allclose(*pair, atol=1e-12)


def test_expected_categories_works_on_a_batch_of_teams():
    logits, q = random_logits(0, 5, 4, 1, 3).requires_grad_(), multilinear_in_heads(1, 4, 1, 3)
    objective, exact = expected_categorical(logits, q, UNREAD), by_enumeration_of_categories(logits, q)
    assert th.allclose(objective, exact)
    assert th.allclose(*(th.autograd.grad(value.sum(), logits)[0] for value in (objective, exact)))


@pytest.mark.parametrize("heads", [2, 3])
def test_expected_over_several_heads_is_unbiased(heads):
    n, values = 40_000, [[0.3, -0.8, 1.1], [0.2, 0.9, -INF], [0.0, -INF, -INF]][:heads]
    logits, q = repeated(values, n), multilinear_in_heads(20, 1, heads, 3)
    single = repeated(values, 1)
    exact = by_enumeration_of_categories(single, q)
    (exact_gradient,) = th.autograd.grad(exact.sum(), single)
    th.manual_seed(0)
    samples = expected_categorical(logits, q, UNREAD).detach()
    sampled = gradients(expected_categorical, logits, q, UNREAD)
    assert ((samples.mean() - exact).abs() < 4 * standard_error(samples)).all()
    assert ((sampled.mean(dim=0) - exact_gradient.flatten()).abs() < 4 * standard_error(sampled)).all()
    assert samples.std() > 0.01


def test_expected_varies_one_head_at_a_time():
    recorder = Recorder(multilinear_in_heads(21, 1, 2, 3))
    expected_categorical(random_logits(22, 50, 1, 2, 3), recorder, UNREAD)
    (asked,) = recorder.asked
    assert asked.shape == (50, 1, 6, 2, 3)
    assert not asked.requires_grad
    assert th.equal(asked[:, :, :3, 0], th.eye(3, dtype=th.float64).expand(50, 1, 3, 3))
    assert th.equal(asked[:, :, 3:, 1], th.eye(3, dtype=th.float64).expand(50, 1, 3, 3))
    for kept in (asked[:, :, :3, 1], asked[:, :, 3:, 0]):
        assert th.equal(kept, kept[:, :, :1].expand_as(kept))
        assert (kept.sum(dim=-1) == 1).all()
        assert (kept.sum(dim=(0, 1, 2)) > 0).all()


# Straight-through and score


def test_straight_through_has_the_critics_gradient_at_sampled_bits():
    scores, q = random_scores(10, 200, 2, 3).requires_grad_(), multilinear(11, 2, 3)
    gradient = gradients(straight_through_binary, scores, q)
    th.manual_seed(0)
    bits = (scores > th.rand_like(scores[..., :1])).to(scores.dtype).detach().requires_grad_()
    (at_bits,) = th.autograd.grad(q(bits.unsqueeze(-2)).sum(), bits)
    assert th.allclose(gradient, at_bits.flatten(1))
    assert 0.1 < bits.mean() < 0.9


def test_straight_through_has_a_gradient_that_is_biased_unless_the_critic_is_linear():
    scores, q = repeated(random_scores(12, 3).tolist(), 40_000), multilinear(13, 1, 3)
    exact = gradients(expected_binary, scores, q, UNREAD)[0]
    sampled = gradients(straight_through_binary, scores, q, UNREAD)
    assert ((sampled.mean(dim=0) - exact).abs() / standard_error(sampled)).max() > 10


def test_straight_through_of_categories_has_the_slope_of_the_softmax_it_samples_from():
    logits, (q, weights) = repeated([[0.3, -0.8, 1.1]], 20_000), linear(23, 1, 3)
    th.manual_seed(0)
    soft = ((logits + -th.empty_like(logits).exponential_().log()) / 0.6).softmax(dim=-1)
    (wanted,) = th.autograd.grad((soft * weights).sum(), logits)
    assert th.allclose(gradients(straight_through_categorical, logits, q, 0.6), wanted.flatten(1))


def test_score_asks_at_the_scores_themselves():
    scores, q = random_scores(14, 5, 2, 3), multilinear(15, 2, 3)
    assert th.equal(score_binary(scores, q, UNREAD), q(scores.unsqueeze(-2)).squeeze(-1))


def test_score_asks_at_the_probabilities_which_is_exact_for_a_critic_linear_in_each_head():
    logits, q = random_logits(14, 5, 2, 2, 3).requires_grad_(), multilinear_in_heads(15, 2, 2, 3)
    objective, exact = score_categorical(logits, q, UNREAD), by_enumeration_of_categories(logits, q)
    assert th.allclose(objective, exact)
    assert th.allclose(*(th.autograd.grad(value.sum(), logits)[0] for value in (objective, exact)))


# Gumbel-softmax


@pytest.mark.parametrize("kind", KINDS)
def test_the_relaxed_sample_is_an_action_when_cold_and_the_middle_when_hot(kind):
    parameters, q = cases(kind, 500)
    where, filler = padding(kind)
    parameters = parameters.masked_fill(where, filler)
    relaxed = []
    for temperature in (1e-3, 0.5, 5.0, 1e4):
        recorder = Recorder(q)
        th.manual_seed(0)
        getattr(ESTIMATORS["gumbel_softmax"], kind)(parameters, recorder, temperature)
        relaxed.append(recorder.asked[0].squeeze(2))
    uniform = (~where).to(th.float64) / (2 if kind == "binary" else (~where).sum(dim=-1, keepdim=True))
    distances = [(sample - uniform).abs().mean().item() for sample in relaxed]
    assert distances == sorted(distances, reverse=True)
    assert distances[-1] < 1e-3
    assert th.minimum(relaxed[0], 1 - relaxed[0]).mean() < 1e-2
    if kind == "categorical":
        for sample in relaxed:
            assert th.allclose(sample.sum(dim=-1), th.ones(500, 2, 2, dtype=th.float64))


def test_the_relaxed_bits_are_halved_by_the_same_shared_threshold():
    scores = random_scores(24, 500, 2, 3)
    recorder = Recorder(multilinear(25, 2, 3))
    th.manual_seed(0)
    gumbel_softmax_binary(scores, recorder, 0.7)
    th.manual_seed(0)
    bits = scores > th.rand_like(scores[..., :1])
    assert th.equal(recorder.asked[0].squeeze(2) > 0.5, bits)


# Gapped straight-through


@pytest.mark.parametrize("gap", [0.5, 1.0, 3.0])
def test_the_gapped_softmax_is_the_papers_and_has_the_sampled_category_ahead_by_the_gap(gap):
    """The softmax s in the backward pass is read off the slopes: for the critic a_i it is s_i (1[i = j] - s_j) / T."""
    temperature, logits = 0.7, repeated([[0.3, -0.8, 1.1]], 500)
    estimate = partial(gapped_straight_through_categorical, gap=gap)
    recorders = [Recorder(lambda own, i=i: own[..., 0, i]) for i in range(3)]
    slopes = th.stack([gradients(estimate, logits, q, temperature) for q in recorders], dim=1) * temperature
    (sample,) = {tuple(recorder.asked[0].flatten().tolist()) for recorder in recorders}
    sample = th.tensor(sample).view(500, 3).argmax(dim=-1)
    others = [(1, 2), (0, 2), (0, 1)]
    soft = th.stack(
        [(-slopes[:, i, j] * slopes[:, i, k] / slopes[:, j, k]).sqrt() for i, (j, k) in enumerate(others)], dim=-1
    )
    assert th.allclose(soft.sum(dim=-1), th.ones(500, dtype=th.float64))
    assert th.equal(soft.argmax(dim=-1), sample)
    top = soft.log().topk(2, dim=-1).values
    assert (temperature * (top[:, 0] - top[:, 1]) > gap - 1e-9).all()
    assert set(sample.tolist()) == {0, 1, 2}
    for category in range(3):
        before = np.array([0.3, -0.8, 1.1])
        drawn = np.arange(3) == category
        m1 = (1.1 - before) * drawn
        m2 = np.maximum(0.0, before + gap - 1.1) * ~drawn
        wanted = (th.as_tensor(before + m1 - m2) / temperature).softmax(dim=-1)
        assert th.allclose(soft[sample == category], wanted)


def test_gapped_bits_are_those_of_two_categories():
    """:math:`df = f (1 - f) dl`, and the two categories' logits differ by l."""
    score, temperature = 0.3, 0.6
    logit = float(np.log(score / (1 - score)))
    scores, logits = repeated([score], 4000), repeated([[logit, 0.0]], 4000)
    asked_bits, asked = Recorder(lambda own: own[..., 0]), Recorder(lambda own: own[..., 0, 0])
    by_bit = gradients(gapped_straight_through_binary, scores, asked_bits, temperature)[:, 0] * score * (1 - score)
    by_category = gradients(gapped_straight_through_categorical, logits, asked, temperature)[:, 0]
    for outcome in (0.0, 1.0):
        bit = by_bit[asked_bits.asked[0].flatten() == outcome]
        category = by_category[asked.asked[0][..., 0].flatten() == outcome]
        assert min(len(bit), len(category)) > 1000
        assert th.allclose(bit, category[:1])
        assert th.allclose(category, category[:1])


def test_gapped_has_less_variance_than_straight_through():
    logits, q = repeated([[0.3, -0.8, 1.1], [0.2, 0.9, -INF]], 5000), linear(26, 2, 3)[0]
    gapped = gradients(gapped_straight_through_categorical, logits, q, 0.7).var(dim=0).sum()
    assert gapped < 0.5 * gradients(straight_through_categorical, logits, q, 0.7).var(dim=0).sum()


# Rao-Blackwell


@pytest.mark.parametrize("n_samples", [1, 10])
@pytest.mark.parametrize("temperature", [0.5, 1.5])
def test_rao_blackwell_has_the_mean_of_straight_through_for_any_critic(n_samples, temperature):
    logits, q = repeated([[0.3, -0.8, 1.1, -INF], [0.2, 0.9, 0.0, -0.4]], 40_000), multilinear_in_heads(27, 1, 2, 4)
    averaged = gradients(partial(rao_blackwell_categorical, n_samples=n_samples), logits, q, temperature, seed=1)
    sampled = gradients(straight_through_categorical, logits, q, temperature, seed=2)
    error = (standard_error(averaged).square() + standard_error(sampled).square()).sqrt()
    assert ((averaged.mean(dim=0) - sampled.mean(dim=0)).abs() < 4 * error).all()


@pytest.mark.parametrize("temperature", [0.3, 0.7, 1.5])
def test_rao_blackwell_has_less_variance_than_straight_through(temperature):
    logits, q = repeated([[0.3, -0.8, 1.1, -INF], [0.2, 0.9, 0.0, -0.4]], 5000), linear(28, 2, 4)[0]
    averaged = gradients(rao_blackwell_categorical, logits, q, temperature).var(dim=0).sum()
    assert averaged < 0.5 * gradients(straight_through_categorical, logits, q, temperature).var(dim=0).sum()


def test_the_noise_given_a_category_is_that_of_the_samples_with_this_category():
    """Straight-through's slopes, sorted by what was sampled, have the means that Rao-Blackwell averages to."""
    logits, n = repeated([[0.3, -0.8, 1.1]], 60_000), 60_000
    by_category = []
    for estimate in (partial(rao_blackwell_categorical, n_samples=3), straight_through_categorical):
        recorder = Recorder(linear(29, 1, 3)[0])
        slopes = gradients(estimate, logits, recorder, 0.5, seed=3)
        sample = recorder.asked[0].view(n, 3).argmax(dim=-1)
        by_category.append([slopes[sample == category] for category in range(3)])
    for averaged, sampled in zip(*by_category, strict=True):
        error = (standard_error(averaged).square() + standard_error(sampled).square()).sqrt()
        assert ((averaged.mean(dim=0) - sampled.mean(dim=0)).abs() < 4 * error).all()


def test_the_noise_given_a_bit_is_that_of_thresholds_that_give_this_bit():
    score, temperature = 0.3, 0.6
    recorder = Recorder(lambda own: own[..., 0])
    slopes = gradients(rao_blackwell_binary, repeated([score], 20_000), recorder, temperature)[:, 0]
    logit = float(np.log(score / (1 - score)))
    for bit, low, high in ((1.0, 0.0, score), (0.0, score, 1.0)):
        delta = np.linspace(low, high, 200_001)[:-1] + (high - low) / 400_000
        soft = 1 / (1 + np.exp(-(logit - np.log(delta / (1 - delta))) / temperature))
        wanted = (soft * (1 - soft)).mean() / (temperature * score * (1 - score))
        sampled = slopes[recorder.asked[0].flatten() == bit]
        assert abs(sampled.mean() - wanted) < 4 * standard_error(sampled)


def test_rao_blackwell_of_bits_has_less_variance_with_more_samples():
    scores, q = repeated([0.3, 0.8, 0.55], 5000), linear(30, 3)[0]
    one = gradients(partial(rao_blackwell_binary, n_samples=1), scores, q, 0.5).var(dim=0).sum()
    assert gradients(rao_blackwell_binary, scores, q, 0.5).var(dim=0).sum() < 0.5 * one
