"""Who learns from what: agents that take no part, padding, and the actors' step."""

import copy

import numpy as np
import pytest
import torch as th

from reference import SGD, assert_close, drawn, updated
from sb3_maddpg import MADDPG
from toys import SMALL, toy


def parameters(model: MADDPG) -> np.ndarray:
    return model.policy.parameters_to_vector()


def filled(policy_kwargs=SGD, kind: str = "heterogeneous", garbage: bool = False, **kwargs) -> MADDPG:
    """
    A model whose buffer holds a team of which agents 1 and 3 act now and then and agent 0 never does.

    :param garbage: what stands in place of their actions and rewards where they do not act
    """
    model = MADDPG("MlpPolicy", toy(kind), **{**SMALL, "policy_kwargs": policy_kwargs, "learning_rate": 0.1, **kwargs})
    rng = np.random.default_rng(0)
    n = model.policy.team.n_agents
    model.action_space.seed(0)
    for _ in range(100):
        obs, next_obs = rng.uniform(-1, 1, (2, 1, *model.observation_space.shape)).astype(np.float32)
        action = model.policy.actions.scale(model.action_space.sample()[None])
        active = rng.random(n) < [0, 0.6, 1, 0.6]
        rewards, terminated = rng.normal(size=n).astype(np.float32), active & (rng.random(n) < 0.3)
        if garbage:
            rewards[~active] = 1e3
            acts = np.repeat(active, [len(model.policy.actions.columns_of(i)) if i != 2 else 1 for i in range(n)])
            other = model.policy.actions.scale(model.action_space.sample()[None])
            action = np.where(acts, action, other)
        else:
            model.action_space.sample()
        info = {"agent_rewards": rewards, "agent_terminated": terminated, "agent_active": active}
        model.replay_buffer.add(obs, next_obs, action, np.zeros(1), np.zeros(1), [info])
    model._setup_learn(1)
    return model


def test_an_update_with_agents_that_do_not_act_is_that_of_the_reference():
    model = filled(max_grad_norm=None)
    old, data = copy.deepcopy(model.policy), drawn(model, 64)
    assert 0 < data.active[:, 1].sum() < 64
    model.train(1, batch_size=64)
    reference = updated(old, data, old.actor_target.act(data.next_observations), lr=0.1, weight=1e-3)
    assert_close(model.critic, reference[0])
    assert_close(model.actor, reference[1])


@pytest.mark.parametrize("n_steps", [1, 3])
def test_what_absent_agents_did_and_got_changes_nothing(n_steps):
    models = [filled(garbage=garbage, n_steps=n_steps) for garbage in (False, True)]
    buffers = [model.replay_buffer for model in models]
    assert not np.array_equal(buffers[0].actions, buffers[1].actions)
    for model in models:
        model.set_random_seed(1)
        model.train(5, batch_size=64)
    assert np.array_equal(*map(parameters, models))


def test_an_agent_that_never_acts_learns_nothing():
    model = filled()
    old = copy.deepcopy(model.policy)
    model.train(5, batch_size=64)
    for network, before in ((model.actor, old.actor), (model.critic, old.critic)):
        for new, was in zip(network.parameters(), before.parameters(), strict=True):
            assert th.equal(new[0], was[0])
            assert not any(th.equal(new[agent], was[agent]) for agent in (1, 2, 3))


def test_the_actors_step_uses_no_gradient_of_the_critic():
    model = filled()
    seen = []
    model.actor.optimizer.register_step_pre_hook(
        lambda *_: seen.append([parameter.grad.clone() for parameter in model.critic.parameters()])
    )
    model.critic.optimizer.register_step_pre_hook(
        lambda *_: seen.append([parameter.grad.clone() for parameter in model.critic.parameters()])
    )
    model.train(1, batch_size=64)
    critics, actors = seen
    assert any(gradient.any() for gradient in critics)
    assert all(th.equal(a, b) for a, b in zip(critics, actors, strict=True))
    assert all(parameter.requires_grad for parameter in model.critic.parameters())


def test_padding_of_observations_and_actions_is_never_learned():
    model = MADDPG("MlpPolicy", toy("mixed"), **SMALL)
    team, actions = model.policy.team, model.policy.actions
    nets = {name: getattr(model.policy, name).net for name in ("actor", "critic")}
    before = {name: [weights.clone() for weights in net.weights] for name, net in nets.items()}
    model.learn(100)
    moved = {
        name: [(new != old).any(dim=axis) for new, old, axis in zip(net.weights, before[name], (1, 2), strict=True)]
        for name, net in nets.items()
    }
    for agent, length in enumerate(team.obs_dims):
        assert moved["actor"][0][agent].tolist() == [column < length for column in range(team.obs_dim)]
        # What the network gives there is not used
        assert moved["actor"][1][agent].tolist() == actions.real[agent].tolist()
        reads = [column < length for length in team.obs_dims for column in range(team.obs_dim)]
        assert moved["critic"][0][agent].tolist() == reads + actions.real.flatten().tolist()
