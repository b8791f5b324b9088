"""One update of MADDPG in plain words: a loop over agents, each with its own losses, norms and steps."""

import copy
from collections.abc import Callable

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_maddpg import MADDPG
from sb3_maddpg.common.policies import MADDPGPolicy

SGD = {"net_arch": [8], "optimizer_class": th.optim.SGD}


def drawn(model: MADDPG, batch_size: int):
    """:return: what ``train`` is going to draw from the replay buffer"""
    state = np.random.get_state()  # noqa: NPY002
    data = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
    np.random.set_state(state)  # noqa: NPY002
    return data


def mean(values: th.Tensor, active: th.Tensor | None) -> th.Tensor:
    return values.mean() if active is None else values[active > 0].sum() / (active > 0).sum().clamp(min=1)


def descended(network, losses: list[list[th.Tensor]], lr: float, clip: float | None):
    """
    :param losses: of each agent, one for each of its networks
    :return: the network after each set of parameters took its own step
    """
    result = copy.deepcopy(network)
    n_agents = len(losses)
    for agent, own in enumerate(losses):
        for which, loss in enumerate(own):
            slot = agent + which * n_agents
            gradients = th.autograd.grad(loss, list(network.parameters()), retain_graph=True)
            gradients = [gradient[slot] for gradient in gradients]
            norm = th.cat([gradient.flatten() for gradient in gradients]).norm()
            factor = 1.0 if clip is None else min(1.0, clip / norm.item())
            for parameter, gradient in zip(result.parameters(), gradients, strict=True):
                parameter.data[slot] -= lr * factor * gradient
    return result


def objective(space: spaces.Space, logits: th.Tensor, q: Callable[[th.Tensor], th.Tensor]) -> th.Tensor:
    """
    The expected value of an agent's action, enumerated.

    :param logits: (batch, number of columns)
    :param q: value of an action, (batch, number of columns) -> (batch,)
    """
    if isinstance(space, spaces.Box):
        return q(2 * logits.sigmoid() - 1)
    if isinstance(space, spaces.MultiBinary):  # the threshold falls between two neighbouring scores
        scores, order = logits.sigmoid().sort(dim=1, descending=True)
        bits = th.zeros_like(scores)
        value = q(bits).detach() * (1 - scores[:, 0])
        for m in range(scores.shape[1]):
            bits = bits.clone()
            bits[th.arange(len(bits)), order[:, m]] = 1
            lower = scores[:, m + 1] if m + 1 < scores.shape[1] else 0.0
            value = value + q(bits).detach() * (scores[:, m] - lower)
        return value
    probabilities = logits.softmax(dim=1)
    one_hot = th.eye(logits.shape[1])
    return sum(probabilities[:, c] * q(one_hot[c].expand_as(logits)).detach() for c in range(logits.shape[1]))


def updated(
    old: MADDPGPolicy,
    data,
    next_actions: th.Tensor,
    lr: float,
    clip: float | None = None,
    weight: float = 0.0,
    cost: np.ndarray | None = None,
) -> tuple:
    """
    :param next_actions: of the target policy, (batch, n_agents, width)
    :param cost: (n_agents, width)
    :return: critic and actor after one step of gradient descent, for agents that share nothing
    """
    team, obs = old.team, data.observations
    agents = range(team.n_agents)
    actions = old.actions.encode(data.actions)
    active = [None if data.active is None else data.active[:, i] for i in agents]
    if data.active is not None:
        actions = actions * data.active[..., None]
        next_actions = next_actions * data.next_active[..., None]
    of = th.as_tensor(np.zeros(actions.shape[1:]) if cost is None else cost).float()

    values = old.critic(obs, actions)
    next_values = old.critic_target(data.next_observations, next_actions)
    losses = []
    for i in agents:
        rest = next_values[:, :, i].min(dim=0).values - (next_actions[:, i] * of[i]).sum(dim=1)
        discount = data.discounts if isinstance(data.discounts, float) else data.discounts[:, i]
        target = data.rewards[:, i] + (actions[:, i] * of[i]).sum(dim=1) + (1 - data.dones[:, i]) * discount * rest
        losses.append([mean((value - target.detach()) ** 2, active[i]) for value in values[:, :, i]])
    critic = descended(old.critic, losses, lr, clip)

    logits = old.actor.logits(obs)
    losses = []
    for i in agents:
        space = team.action_spaces[i]
        width = len(old.actions.columns_of(i))

        def q(own: th.Tensor, i: int = i, width: int = width) -> th.Tensor:
            joint = actions.clone()
            joint[:, i] = 0
            joint[:, i, :width] = own
            return critic(obs, joint)[0, :, i] - (joint[:, i] * of[i]).sum(dim=1)

        own = logits[:, i, :width]
        losses.append([mean(weight * (own**2).mean(dim=1) - objective(space, own, q), active[i])])
    return critic, descended(old.actor, losses, lr, clip)


def assert_close(network, reference, atol: float = 1e-5) -> None:
    for mine, theirs in zip(network.parameters(), reference.parameters(), strict=True):
        assert th.allclose(mine, theirs, atol=atol)


def assert_moved(target, network, before, tau: float) -> None:
    """Whether the target network went towards the network."""
    for new, goal, old in zip(target.parameters(), network.parameters(), before.parameters(), strict=True):
        assert th.allclose(new, tau * goal + (1 - tau) * old, atol=1e-6)
