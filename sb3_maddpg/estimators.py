r"""
The gradient through the threshold.

Agent :math:`i` has scores :math:`f_1..f_k \in [0, 1]` and acts with the bits :math:`c_j = 1[f_j > \delta']`. One
threshold :math:`\delta' \sim U(0, 1)` is drawn per agent and step and shared by its bits (Serra-Gomez et al., IROS
2020, Sec. IV-C). The step function has no useful derivative: :math:`E_{\delta'}[Q_i(c)]` needs an estimator.

Every estimator has the signature ``estimator(scores, q) -> objective``:

- ``scores``: the actors' scores, (batch, n_agents, k), with gradient;
- ``q``: the critic with all agents' actions but the own ones fixed. It maps alternatives for the own action,
  (batch, n_agents, M, k), to their values, (batch, n_agents, M);
- ``objective``: what the actors ascend, (batch, n_agents).

To add one, write such a function and name it in ``ESTIMATORS``.
"""

from collections.abc import Callable

import torch as th

CriticOfOwnAction = Callable[[th.Tensor], th.Tensor]
Estimator = Callable[[th.Tensor, CriticOfOwnAction], th.Tensor]


def nested_sets(scores: th.Tensor) -> th.Tensor:
    """
    All joint bits that one shared threshold can produce: the bits of the m highest scores, for m = 0..k.

    :param scores: (..., k)
    :return: bits, (..., k + 1, k)
    """
    k = scores.shape[-1]
    rank = scores.argsort(dim=-1, descending=True, stable=True).argsort(dim=-1)
    sizes = th.arange(k + 1, device=scores.device)
    return (rank.unsqueeze(-2) < sizes.unsqueeze(-1)).to(scores.dtype)


def expected(scores: th.Tensor, q: CriticOfOwnAction) -> th.Tensor:
    r"""
    The exact expectation. With the scores sorted, :math:`f_{(1)} \ge ... \ge f_{(k)}`, and :math:`f_{(0)} = 1`,
    :math:`f_{(k+1)} = 0`, the threshold falls between two neighbours with a probability that is their difference:

    .. math:: E_{\delta'}[Q(c)] = \sum_{m=0}^{k} Q(c_{(m)}) (f_{(m)} - f_{(m+1)}),

    where :math:`c_{(m)}` are the bits of the m highest scores. The sum is piecewise linear in f, continuous also where
    scores tie, and needs no derivative of Q, which is only asked about bits as they occur in the replay buffer.

    :param scores: (batch, n_agents, k)
    :param q: see the module's docstring
    :return: (batch, n_agents)
    """
    with th.no_grad():
        values = q(nested_sets(scores))
    ordered = scores.sort(dim=-1, descending=True, stable=True).values
    one = th.ones_like(ordered[..., :1])
    bounds = th.cat([one, ordered, th.zeros_like(one)], dim=-1)
    probabilities = bounds[..., :-1] - bounds[..., 1:]
    return (values * probabilities).sum(dim=-1)


def straight_through(scores: th.Tensor, q: CriticOfOwnAction) -> th.Tensor:
    """
    One sampled threshold per agent; the step function counts as the identity in the backward pass (Bengio et al. 2013,
    arXiv:1308.3432). Its value is an unbiased sample of ``expected``; its gradient is biased unless Q is linear.

    :param scores: (batch, n_agents, k)
    :param q: see the module's docstring
    :return: (batch, n_agents)
    """
    bits = (scores > th.rand_like(scores[..., :1])).to(scores.dtype)
    return q((bits + scores - scores.detach()).unsqueeze(-2)).squeeze(-1)


def score(scores: th.Tensor, q: CriticOfOwnAction) -> th.Tensor:
    """
    The scores stand in for the bits. The critic is asked between the bits it was trained on. For actors with a
    continuous action this is the deterministic policy gradient (Lillicrap et al. 2016), and exact.

    :param scores: (batch, n_agents, k)
    :param q: see the module's docstring
    :return: (batch, n_agents)
    """
    return q(scores.unsqueeze(-2)).squeeze(-1)


ESTIMATORS: dict[str, Estimator] = {
    "expected": expected,
    "straight_through": straight_through,
    "score": score,
}
