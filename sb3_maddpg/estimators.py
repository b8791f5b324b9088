r"""
The gradient through discrete actions.

**Binary actions.** Agent :math:`i` has probabilities :math:`f_1..f_k \in [0, 1]` and acts with the bits :math:`c_j =
1[f_j > \delta']`. One threshold :math:`\delta' \sim U(0, 1)` is drawn per agent and step and shared by its bits
(Serra-Gomez et al., IROS 2020, Sec. IV-C).

**Categorical actions.** Agent :math:`i` has logits :math:`l_{h1}..l_{hK}` for each of its H heads (one for
``Discrete``, one per sub-action of ``MultiDiscrete``) and draws from every head one category with the probabilities
softmax(l_h), independently.

Neither has a useful derivative: the slope of the expected value :math:`E[Q_i]` needs an estimator. Each has a function
for both kinds, ``objective = estimator(probabilities or logits, q, temperature)``:

- ``probabilities``, with gradient, (batch, n_agents, k). A padded bit, of an agent with fewer than the others, has
  probability 0. It is never set; its gradient is finite, and ends where the caller made the probability 0.
- ``logits``, with gradient, (batch, n_agents, H, K). A padded category has logit -inf; a padded head has a finite logit
  for category 0 only. Padding is never drawn and gets no gradient.
- ``q``: the critic with all agents' actions but the own ones fixed. It maps M alternatives for the own action,
  (batch, n_agents, M, k) or (batch, n_agents, M, H, K), to their values, (batch, n_agents, M).
- ``temperature``: of the relaxation, > 0. The lower, the nearer to the discrete action and the higher the variance.
  Estimators without a relaxation do not read it.
- ``objective``: what the actors ascend, (batch, n_agents).

Random numbers come from torch's global generator. To add one, write the two functions and name them in ``ESTIMATORS``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch as th
from torch.nn import functional as F

CriticOfOwnAction = Callable[[th.Tensor], th.Tensor]
EstimatorOfOneKind = Callable[[th.Tensor, CriticOfOwnAction, float], th.Tensor]


@dataclass(frozen=True)
class Estimator:
    """
    One estimator for both kinds of actions, see the module's docstring.

    :param binary: from probabilities, (batch, n_agents, k)
    :param categorical: from logits, (batch, n_agents, H, K)
    """

    binary: EstimatorOfOneKind
    categorical: EstimatorOfOneKind


def nested_sets(order: th.Tensor) -> th.Tensor:
    """
    All joint bits that one shared threshold can produce: the bits of the m highest probabilities, for m = 0..k.

    :param order: the numbers of the bits, highest probability first, (..., k)
    :return: bits, (..., k + 1, k) bool
    """
    sizes = th.arange(order.shape[-1] + 1, device=order.device)
    rank = th.empty_like(order).scatter_(-1, order, sizes[:-1].expand_as(order))
    return rank.unsqueeze(-2) < sizes.unsqueeze(-1)


def _value_of(q: CriticOfOwnAction, action: th.Tensor, dim: int) -> th.Tensor:
    """
    :param q: see the module's docstring
    :param action: one alternative, without the axis M
    :param dim: where that axis belongs
    :return: its value, (batch, n_agents)
    """
    return q(action.unsqueeze(dim)).squeeze(-1)


def _with_gradient_of(value: th.Tensor, source: th.Tensor) -> th.Tensor:
    """
    :param value: what comes out, to the last bit
    :param source: what the gradient flows to; nothing flows where it is -inf
    :return: (shape of both, broadcast)
    """
    source = source.masked_fill(source.isneginf(), 0.0)  # -inf - -inf would be NaN
    return value.detach() + (source - source.detach())


def _gumbel(logits: th.Tensor) -> th.Tensor:
    """:return: standard Gumbel noise, of the same shape"""
    return -th.empty_like(logits).exponential_().clamp_min(th.finfo(logits.dtype).tiny).log()


def _one_hot_of_largest(logits: th.Tensor) -> th.Tensor:
    """:return: 1 at the largest of each head, (..., K)"""
    return F.one_hot(logits.argmax(dim=-1), logits.shape[-1]).to(logits.dtype)


def _sampled_categorical(logits: th.Tensor) -> th.Tensor:
    """:return: one-hot samples of each head, (..., K), by the Gumbel-max trick"""
    with th.no_grad():
        return _one_hot_of_largest(logits + _gumbel(logits))


def _sampled_binary(probabilities: th.Tensor) -> th.Tensor:
    """:return: bits at one sampled threshold per agent, (..., k)"""
    return (probabilities > th.rand_like(probabilities[..., :1])).to(probabilities.dtype)


def _inside(x: th.Tensor) -> th.Tensor:
    """:return: x at least one machine epsilon away from 0 and from 1; no gradient where that moves it"""
    eps = th.finfo(x.dtype).eps
    return x.clamp(eps, 1 - eps)


def expected_binary(probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    r"""
    The exact expectation. With the probabilities sorted, :math:`f_{(1)} \ge ... \ge f_{(k)}`, and :math:`f_{(0)} = 1`,
    :math:`f_{(k+1)} = 0`, the threshold falls between two neighbours with a probability that is their difference:

    .. math:: E_{\delta'}[Q(c)] = \sum_{m=0}^{k} Q(c_{(m)}) (f_{(m)} - f_{(m+1)}),

    where :math:`c_{(m)}` are the bits of the m highest probabilities. The sum is piecewise linear in f, continuous also
    where probabilities tie, and needs no derivative of Q, which is only evaluated at bits as they occur in the replay
    buffer.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = k + 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    ordered, order = probabilities.sort(dim=-1, descending=True, stable=True)
    with th.no_grad():
        values = q(nested_sets(order).to(probabilities.dtype))
    one = th.ones_like(ordered[..., :1])
    bounds = th.cat([one, ordered, th.zeros_like(one)], dim=-1)
    weights = bounds[..., :-1] - bounds[..., 1:]
    return (values * weights).sum(dim=-1)


def expected_categorical(logits: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    r"""
    The expectation over one head at a time. For a single head it is exact,

    .. math:: E[Q(a)] = \sum_{a=1}^{K} \pi(a) Q(a).

    With several, joint actions are too many to sum over. Each head's own categories are, while the other heads keep one
    sample :math:`a_{-h}` of the policy. Since heads are drawn independently, the gradient

    .. math:: \sum_h \sum_a \nabla \pi_h(a) Q(a, a_{-h})

    is then an unbiased sample of :math:`\nabla E[Q]`; the value is the mean of the heads' expectations, an unbiased
    sample of :math:`E[Q]`. No derivative of Q is needed, which is only evaluated at one-hot actions.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = H * K
    :param temperature: unused
    :return: (batch, n_agents)
    """
    heads, categories = logits.shape[-2:]
    probabilities = logits.softmax(dim=-1)
    with th.no_grad():
        changed = th.eye(heads, dtype=th.bool, device=logits.device)[:, None, :, None]
        to = th.eye(categories, dtype=logits.dtype, device=logits.device)[None, :, None, :]
        sample = _sampled_categorical(logits)[..., None, None, :, :]
        alternatives = th.where(changed, to, sample)  # (batch, n_agents, H, K, H, K)
        values = q(alternatives.flatten(-4, -3)).unflatten(-1, (heads, categories))
    expectations = (values * probabilities).sum(dim=-1)
    return _with_gradient_of(expectations.mean(dim=-1), expectations.sum(dim=-1))


def straight_through_binary(probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    One sampled threshold per agent; the step function counts as the identity in the backward pass (Bengio et al. 2013,
    arXiv:1308.3432). Its value is an unbiased sample of the expectation; its gradient is biased unless Q is linear.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    return _value_of(q, _with_gradient_of(_sampled_binary(probabilities), probabilities), -2)


def straight_through_categorical(logits: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    Straight-through Gumbel-softmax (Jang et al. 2017, arXiv:1611.01144): a category is sampled as the largest of logits
    plus Gumbel noise; in the backward pass it counts as the softmax of the same sum. Biased, also for a linear Q.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: of the softmax in the backward pass
    :return: (batch, n_agents)
    """
    noisy = logits + _gumbel(logits)
    soft = (noisy / temperature).softmax(dim=-1)
    return _value_of(q, _with_gradient_of(_one_hot_of_largest(noisy), soft), -3)


def score_binary(probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    The probabilities stand in for the bits. The critic is evaluated between the bits it was trained on. What the
    deterministic policy gradient (Lillicrap et al. 2016, arXiv:1509.02971) is for continuous actions; exact where Q is
    linear.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    return _value_of(q, probabilities, -2)


def score_categorical(logits: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    The probabilities stand in for the one-hot action. The critic is evaluated between the actions it was trained on.
    Exact where Q is linear in each head.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    return _value_of(q, logits.softmax(dim=-1), -3)


def gumbel_softmax_binary(probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    r"""
    A relaxed sample, the binary concrete distribution (Maddison et al. 2017, arXiv:1611.00712):
    :math:`\sigma((\mathrm{logit} f_j + z) / T)` with logistic noise :math:`z = -\mathrm{logit} \delta'`. It exceeds 1/2
    just where :math:`f_j > \delta'`. An agent's bits share z like the threshold, so that for T to 0 the sample becomes
    the bits that the agent acts with.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: of the sigmoid
    :return: (batch, n_agents)
    """
    noise = -_inside(th.rand_like(probabilities[..., :1])).logit()
    relaxed = ((_inside(probabilities).logit() + noise) / temperature).sigmoid()
    return _value_of(q, th.where(probabilities > 0, relaxed, 0.0), -2)


def gumbel_softmax_categorical(logits: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    A relaxed sample, softmax((l + Gumbel noise) / T) (Jang et al. 2017, arXiv:1611.01144; Maddison et al. 2017,
    arXiv:1611.00712), as in the original MADDPG with T = 1 (Lowe et al. 2017, arXiv:1706.02275). The critic is
    evaluated between the actions it was trained on.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: of the softmax
    :return: (batch, n_agents)
    """
    return _value_of(q, ((logits + _gumbel(logits)) / temperature).softmax(dim=-1), -3)


def gapped_straight_through_binary(
    probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float, gap: float = 1.0
) -> th.Tensor:
    r"""
    ``gapped_straight_through_categorical`` for two classes: "set", with logit :math:`l = \mathrm{logit} f_j`, and "not
    set", with logit 0. After the moves their difference is max(l, gap) where the bit is set, else min(l, -gap). The
    bits come from one sampled threshold per agent.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: of the sigmoid in the backward pass
    :param gap: least distance between the two classes in the backward pass
    :return: (batch, n_agents)
    """
    bits, logits = _sampled_binary(probabilities), _inside(probabilities).logit()
    gapped = th.where(bits > 0, logits.clamp_min(gap), logits.clamp_max(-gap))
    soft = (_with_gradient_of(gapped, logits) / temperature).sigmoid()
    return _value_of(q, _with_gradient_of(bits, soft), -2)


def gapped_straight_through_categorical(
    logits: th.Tensor, q: CriticOfOwnAction, temperature: float, gap: float = 1.0
) -> th.Tensor:
    r"""
    Gapped straight-through (Fan et al. 2022, arXiv:2206.07235; for MADDPG Tilbury et al. 2023, arXiv:2302.11793): a
    category D is sampled; in the backward pass it counts as a softmax whose logits are moved, without noise, until D is
    the largest by a gap: D is raised to the maximum by :math:`m_1 = \max l - l_D`, each other category is lowered by
    :math:`m_2 = \max(0, l_a + gap - \max l)`. The moves count as constants. Less variance than with noise; biased.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: of the softmax in the backward pass
    :param gap: least distance of the sampled category to the others in the backward pass
    :return: (batch, n_agents)
    """
    sample = _sampled_categorical(logits)
    largest = logits.amax(dim=-1, keepdim=True)
    gapped = th.where(sample > 0, largest, logits.minimum(largest - gap))
    soft = (_with_gradient_of(gapped, logits) / temperature).softmax(dim=-1)
    return _value_of(q, _with_gradient_of(sample, soft), -3)


def rao_blackwell_binary(
    probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float, n_samples: int = 10
) -> th.Tensor:
    r"""
    ``rao_blackwell_categorical`` for bits, which come from one sampled threshold per agent. A bit c of probability p
    has been sampled because its threshold fell into an interval of length p; for :math:`u \sim U(0, 1)` the perturbed
    logit
    :math:`\mathrm{logit} f_j - \mathrm{logit} \delta_j`, given the bit, is

    .. math:: \pm \log(1 + (1/u - 1) / (1 - p)), \quad \text{positive where the bit is set.}

    Each bit has a noise of its own: the others' bits say nothing about it.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: of the sigmoid in the backward pass
    :param n_samples: of the noise, to average over
    :return: (batch, n_agents)
    """
    bits, inner = _sampled_binary(probabilities), _inside(probabilities)
    with th.no_grad():
        u = _inside(th.rand((n_samples, *probabilities.shape), dtype=probabilities.dtype, device=probabilities.device))
        other_bit = th.where(bits > 0, 1 - inner, inner)
        perturbed = (2 * bits - 1) * ((1 / u - 1) / other_bit).log1p()
    soft = (_with_gradient_of(perturbed, inner.logit()) / temperature).sigmoid().mean(dim=0)
    return _value_of(q, _with_gradient_of(bits, soft), -2)


def rao_blackwell_categorical(
    logits: th.Tensor, q: CriticOfOwnAction, temperature: float, n_samples: int = 10
) -> th.Tensor:
    r"""
    Gumbel-Rao Monte Carlo (Paulus et al. 2021, arXiv:2010.04838): ``straight_through_categorical``, its backward pass
    averaged over the Gumbel noise that would have sampled the same category D. Same mean, less variance, still one
    evaluation of the critic. With :math:`p` = softmax(l) and :math:`E_1..E_K` independent exponential variables, the
    perturbed logits given D are, up to a constant that softmax does not see,

    .. math:: -\log E_D \text{ for D, and } -\log(E_a / p_a + E_D) \text{ for the others:}

    the largest of all is a Gumbel variable, whichever D, and the others are Gumbel variables cut off there. The noise
    counts as independent of the logits in the backward pass: a derivative through it would change the mean.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: of the softmax in the backward pass
    :param n_samples: of the noise, to average over
    :return: (batch, n_agents)
    """
    sample = _sampled_categorical(logits)
    with th.no_grad():
        noise = _gumbel(logits.expand(n_samples, *logits.shape))
        largest = noise.masked_fill(sample == 0, -th.inf).amax(dim=-1, keepdim=True)
        cut_off = -th.logaddexp(-noise - logits.log_softmax(dim=-1), -largest)
        perturbed = th.where(sample > 0, largest, cut_off)
    soft = (_with_gradient_of(perturbed, logits) / temperature).softmax(dim=-1).mean(dim=0)
    return _value_of(q, _with_gradient_of(sample, soft), -3)


ESTIMATORS: dict[str, Estimator] = {
    "expected": Estimator(expected_binary, expected_categorical),
    "straight_through": Estimator(straight_through_binary, straight_through_categorical),
    "score": Estimator(score_binary, score_categorical),
    "gumbel_softmax": Estimator(gumbel_softmax_binary, gumbel_softmax_categorical),
    "gapped_straight_through": Estimator(gapped_straight_through_binary, gapped_straight_through_categorical),
    "rao_blackwell": Estimator(rao_blackwell_binary, rao_blackwell_categorical),
}
