r"""
Gradient estimators for discrete actions.

**Binary actions.** Agent :math:`i` has probabilities :math:`f_1..f_k \in [0, 1]` and acts with the bits :math:`c_j =
1[f_j > \delta']`. One threshold :math:`\delta' \sim U(0, 1)` is drawn per agent and step and shared by its bits
(Serra-Gomez et al., IROS 2020, Sec. IV-C).

**Categorical actions.** Agent :math:`i` has logits :math:`l_{h1}..l_{hK}` for each of its H heads (one for
``Discrete``, one per sub-action of ``MultiDiscrete``). It samples one category per head with the probabilities
softmax(l_h), independently of the other heads.

Neither kind of action has a useful derivative, so the gradient of the expected value :math:`E[Q_i]` needs an estimator.
Each estimator has one function per kind, ``objective = estimator(probabilities or logits, q, temperature)``:

- ``probabilities``: of bits, with gradient, (batch, n_agents, k). Padded bits, of agents with fewer bits than others,
  have probability 0. They are never set. Their gradients are finite and end where the caller set the probability to 0.
- ``logits``: of categories, with gradient, (batch, n_agents, H, K). A padded category has logit -inf; a padded head has
  a finite logit for category 0 only. Padding is never sampled and gets no gradient.
- ``q``: the critic as a function of each agent's own action, with the other agents' actions fixed. It maps M
  alternatives, (batch, n_agents, M, k) or (batch, n_agents, M, H, K), to their values, (batch, n_agents, M).
- ``temperature``: of the relaxation, > 0. A lower temperature brings the relaxation closer to the discrete action but
  increases the variance. Estimators without a relaxation ignore it.
- ``objective``: what the actors maximise, (batch, n_agents).

Random numbers come from torch's global generator. To add an estimator, write both functions and add them to
``ESTIMATORS``.
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
    Gradient estimator for both kinds of discrete actions, see the module's docstring.

    :param binary: function of probabilities, (batch, n_agents, k)
    :param categorical: function of logits, (batch, n_agents, H, K)
    """

    binary: EstimatorOfOneKind
    categorical: EstimatorOfOneKind


def nested_sets(order: th.Tensor) -> th.Tensor:
    """
    Return all settings of an agent's bits that one shared threshold can produce: the m bits with the highest
    probabilities are set, for m = 0..k.

    :param order: indices of the bits, highest probability first, (..., k)
    :return: the bits, (..., k + 1, k) bool
    """
    sizes = th.arange(order.shape[-1] + 1, device=order.device)
    rank = th.empty_like(order).scatter_(-1, order, sizes[:-1].expand_as(order))
    return rank.unsqueeze(-2) < sizes.unsqueeze(-1)


def _value_of(q: CriticOfOwnAction, action: th.Tensor, dim: int) -> th.Tensor:
    """
    :param q: see the module's docstring
    :param action: one alternative, without the axis M
    :param dim: position of that axis
    :return: the action's value, (batch, n_agents)
    """
    return q(action.unsqueeze(dim)).squeeze(-1)


def _with_gradient_of(value: th.Tensor, source: th.Tensor) -> th.Tensor:
    """
    :param value: the exact value of the result
    :param source: receives the gradient, except where it is -inf
    :return: the value with the gradient of the source, in their broadcast shape
    """
    source = source.masked_fill(source.isneginf(), 0.0)  # -inf - -inf would be NaN
    return value.detach() + (source - source.detach())


def _gumbel(logits: th.Tensor) -> th.Tensor:
    """:return: standard Gumbel noise, of the same shape"""
    return -th.empty_like(logits).exponential_().clamp_min(th.finfo(logits.dtype).tiny).log()


def _one_hot_of_largest(logits: th.Tensor) -> th.Tensor:
    """:return: 1 for the largest logit of each head, else 0, (..., K)"""
    return F.one_hot(logits.argmax(dim=-1), logits.shape[-1]).to(logits.dtype)


def _sampled_categorical(logits: th.Tensor) -> th.Tensor:
    """:return: one-hot samples of each head, (..., K), by the Gumbel-max trick"""
    with th.no_grad():
        return _one_hot_of_largest(logits + _gumbel(logits))


def _sampled_binary(probabilities: th.Tensor) -> th.Tensor:
    """:return: bits for one sampled threshold per agent, (..., k)"""
    return (probabilities > th.rand_like(probabilities[..., :1])).to(probabilities.dtype)


def _inside(x: th.Tensor) -> th.Tensor:
    """:return: x, clamped to be at least one machine epsilon away from 0 and 1; clamped values get no gradient"""
    eps = th.finfo(x.dtype).eps
    return x.clamp(eps, 1 - eps)


def expected_binary(probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    r"""
    Exact expectation. With the probabilities sorted, :math:`f_{(1)} \ge ... \ge f_{(k)}`, and :math:`f_{(0)} = 1`,
    :math:`f_{(k+1)} = 0`, the probability that the threshold falls between two consecutive ones is their difference:

    .. math:: E_{\delta'}[Q(c)] = \sum_{m=0}^{k} Q(c_{(m)}) (f_{(m)} - f_{(m+1)}),

    where :math:`c_{(m)}` sets the m bits with the highest probabilities. The sum is piecewise linear in f and
    continuous, even where probabilities tie. It needs no derivative of Q and evaluates Q only at bits as they occur in
    the replay buffer.

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
    Expectation over one head at a time. For a single head it is exact,

    .. math:: E[Q(a)] = \sum_{a=1}^{K} \pi(a) Q(a).

    With several heads, there are too many joint actions to sum over. The sum then runs over each head's own categories,
    while the other heads keep one sample :math:`a_{-h}` of the policy. Since heads are sampled independently, the
    gradient

    .. math:: \sum_h \sum_a \nabla \pi_h(a) Q(a, a_{-h})

    is then an unbiased sample of :math:`\nabla E[Q]`; the value is the mean of the heads' expectations, an unbiased
    sample of :math:`E[Q]`. It needs no derivative of Q and evaluates Q only at one-hot actions.

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
    Straight-through estimator: samples one threshold per agent and treats the step function as the identity in the
    backward pass (Bengio et al. 2013, arXiv:1308.3432). The value is an unbiased sample of the expectation; the
    gradient is biased unless Q is linear.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    return _value_of(q, _with_gradient_of(_sampled_binary(probabilities), probabilities), -2)


def straight_through_categorical(logits: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    Straight-through Gumbel-softmax (Jang et al. 2017, arXiv:1611.01144): samples the category with the largest sum of
    logit and Gumbel noise, and treats it as the softmax of these sums in the backward pass. The gradient is biased,
    even for a linear Q.

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
    Passes the probabilities to the critic in place of the bits, like the deterministic policy gradient for continuous
    actions (Lillicrap et al. 2016, arXiv:1509.02971). It is exact if Q is linear, but evaluates the critic between the
    bits it was trained on.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    return _value_of(q, probabilities, -2)


def score_categorical(logits: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    """
    Passes the probabilities to the critic in place of the one-hot action. It is exact if Q is linear in each head, but
    evaluates the critic between the actions it was trained on.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: unused
    :return: (batch, n_agents)
    """
    return _value_of(q, logits.softmax(dim=-1), -3)


def gumbel_softmax_binary(probabilities: th.Tensor, q: CriticOfOwnAction, temperature: float) -> th.Tensor:
    r"""
    Relaxed sample of the binary concrete distribution (Maddison et al. 2017, arXiv:1611.00712):
    :math:`\sigma((\mathrm{logit} f_j + z) / T)` with logistic noise :math:`z = -\mathrm{logit} \delta'`. It exceeds 1/2
    if and only if :math:`f_j > \delta'`. An agent's bits share z as they share the threshold, so that the sample tends
    to the agent's bits as T tends to 0.

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
    Relaxed sample, softmax((l + Gumbel noise) / T) (Jang et al. 2017, arXiv:1611.01144; Maddison et al. 2017,
    arXiv:1611.00712), as in the original MADDPG with T = 1 (Lowe et al. 2017, arXiv:1706.02275). It evaluates the
    critic between the actions it was trained on.

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
    set", with logit 0. After the shifts, their difference is max(l, gap) if the bit is set, else min(l, -gap). The bits
    come from one sampled threshold per agent.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: of the sigmoid in the backward pass
    :param gap: minimum distance between the two logits in the backward pass
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
    Gapped straight-through estimator (Fan et al. 2022, arXiv:2206.07235; for MADDPG Tilbury et al. 2023,
    arXiv:2302.11793): samples a category D and treats it as a softmax of shifted logits in the backward pass. The
    shifts make D the largest by a gap: they raise D to the maximum by :math:`m_1 = \max l - l_D` and lower each other
    category by :math:`m_2 = \max(0, l_a + gap - \max l)`. They count as constants. The gradient is biased, but has less
    variance than with Gumbel noise.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: of the softmax in the backward pass
    :param gap: minimum distance between the sampled category's logit and the others in the backward pass
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
    ``rao_blackwell_categorical`` for bits, which come from one sampled threshold per agent. A bit of probability p is
    sampled if its threshold falls into an interval of length p. For :math:`u \sim U(0, 1)`, the perturbed logit
    :math:`\mathrm{logit} f_j - \mathrm{logit} \delta_j`, given the bit, is

    .. math:: \pm \log(1 + (1/u - 1) / (1 - p)), \quad \text{positive if the bit is set.}

    Each bit has independent noise, which does not depend on the other bits.

    :param probabilities: (batch, n_agents, k)
    :param q: see the module's docstring, M = 1
    :param temperature: of the sigmoid in the backward pass
    :param n_samples: number of noise samples to average over
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
    Gumbel-Rao Monte Carlo estimator (Paulus et al. 2021, arXiv:2010.04838): ``straight_through_categorical`` with its
    backward pass averaged over the Gumbel noise that would have sampled the same category D. It has the same mean and
    less variance, and still evaluates the critic once. With :math:`p` = softmax(l) and :math:`E_1..E_K` independent
    exponential variables, the perturbed logits given D are, up to a constant that does not change the softmax,

    .. math:: -\log E_D \text{ for D, and } -\log(E_a / p_a + E_D) \text{ for the others.}

    The largest of all is a Gumbel variable, whatever D is, and the others are Gumbel variables truncated there. The
    noise counts as independent of the logits in the backward pass, because a derivative through it would change the
    mean.

    :param logits: (batch, n_agents, H, K)
    :param q: see the module's docstring, M = 1
    :param temperature: of the softmax in the backward pass
    :param n_samples: number of noise samples to average over
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
