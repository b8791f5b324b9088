"""Stacked networks, what flows where in them, and the policy built from them."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.policies import MADDPGPolicy, StackedMLP, TeamActor, TeamCritic

N, D, K, B = 4, 5, 3, 6


def batch(seed: int = 0) -> tuple[th.Tensor, th.Tensor]:
    rng = np.random.default_rng(seed)
    obs = th.as_tensor(rng.normal(size=(B, N, D)), dtype=th.float32)
    return obs, th.as_tensor(rng.integers(0, 2, (B, N, K)), dtype=th.float32)


def policy(action_space: spaces.Space | None = None, **kwargs) -> MADDPGPolicy:
    observation_space = spaces.Box(-np.inf, np.inf, (N, D), np.float32)
    return MADDPGPolicy(observation_space, action_space or spaces.MultiBinary(N * K), lambda _: 1e-3, **kwargs)


@pytest.mark.parametrize("net_arch", [[], [8], [16, 8]])
@pytest.mark.parametrize("shared", [False, True])
def test_stacked_networks_equal_a_loop_of_separate_ones(net_arch, shared):
    stacked = StackedMLP(N, D, 2, net_arch, nn.ReLU, shared)
    x = th.randn(N, B, D)
    for agent in range(N):
        copy = 0 if shared else agent
        y = x[agent]
        for index, (weight, bias) in enumerate(zip(stacked.weights, stacked.biases, strict=True)):
            linear = nn.Linear(*weight.shape[1:])
            linear.weight.data, linear.bias.data = weight[copy].T, bias[copy, 0]
            y = linear(y if index == 0 else y.relu())
        assert th.allclose(stacked(x)[agent], y, atol=1e-6)


def test_stacked_networks_start_like_separate_ones():
    th.manual_seed(0)
    stacked, single = StackedMLP(200, 25, 40, []), nn.Linear(25, 200 * 40)
    for mine, theirs in ((stacked.weights[0], single.weight), (stacked.biases[0], single.bias)):
        assert mine.abs().max().item() == pytest.approx(theirs.abs().max().item(), rel=0.01)
        assert mine.std().item() == pytest.approx(theirs.std().item(), rel=0.03)
    assert not th.equal(stacked.weights[0][0], stacked.weights[0][1])


def test_gradients_are_clipped_agent_by_agent():
    net = StackedMLP(N, D, 2, [8])
    scale = th.tensor([100.0, 1.0, 1e-4, 0.0]).view(N, 1, 1)
    (net(th.randn(N, B, D)) * scale).sum().backward()
    before = [[parameter.grad[agent].clone() for parameter in net.parameters()] for agent in range(N)]
    net.clip_grad_norm_(0.5)
    for agent in range(N):
        norm = th.cat([gradient.flatten() for gradient in before[agent]]).norm().item()
        factor = min(1.0, 0.5 / (norm + 1e-6))
        for parameter, gradient in zip(net.parameters(), before[agent], strict=True):
            assert th.allclose(parameter.grad[agent], factor * gradient, atol=1e-7)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("net_arch", [[], [16], [16, 16]])
def test_alternatives_equal_substituted_actions(shared, net_arch):
    critic = TeamCritic(N, D, K, net_arch, shared=shared)
    obs, actions = batch()
    own = th.rand(B, N, 5, K)
    values = critic.forward_alternatives(obs, actions, own)
    assert values.shape == (B, N, 5)
    for agent in range(N):
        for alternative in range(5):
            substituted = actions.clone()
            substituted[:, agent] = own[:, agent, alternative]
            assert th.allclose(values[:, agent, alternative], critic(obs, substituted)[:, agent], atol=1e-6)


@pytest.mark.parametrize("shared", [False, True])
def test_an_actor_sees_its_own_observation_only(shared):
    actor = TeamActor(N, D, K, [16], shared=shared, threshold=0.5)
    obs, _ = batch()
    for agent in range(N):
        changed = obs.clone()
        changed[:, agent] += 1.0
        moved = (actor(changed) != actor(obs)).any(dim=2).any(dim=0)
        assert moved.tolist() == [other == agent for other in range(N)]


@pytest.mark.parametrize("shared", [False, True])
def test_every_critic_sees_all_observations_and_actions(shared):
    critic = TeamCritic(N, D, K, [32], shared=shared)
    obs, actions = (x.requires_grad_() for x in batch())
    for agent in range(N):
        for gradient in th.autograd.grad(critic(obs, actions)[:, agent].sum(), (obs, actions)):
            assert (gradient.abs().sum(dim=0) > 0).all()


def test_an_actors_gradient_comes_through_its_own_action_only():
    actor, critic = TeamActor(N, D, K, [16], threshold=0.5), TeamCritic(N, D, K, [16])
    obs, actions = batch()
    objective = critic.forward_alternatives(obs, actions, actor(obs).unsqueeze(2))
    for agent in range(N):
        gradients = th.autograd.grad(objective[:, agent].sum(), list(actor.parameters()), retain_graph=True)
        reached = th.stack([gradient.abs().sum(dim=(1, 2)) for gradient in gradients]).sum(dim=0) > 0
        assert reached.tolist() == [other == agent for other in range(N)]


def test_sharing_makes_one_set_of_parameters_and_permutes_with_the_agents():
    shared = policy(share_actor=True, share_critic=True)
    assert all(parameter.shape[0] == 1 for parameter in shared.parameters())
    obs, actions = batch()
    turned = th.arange(N).roll(1)
    assert th.allclose(shared.actor(obs)[:, turned], shared.actor(obs[:, turned]), atol=1e-6)
    assert th.allclose(
        shared.critic(obs, actions)[:, turned], shared.critic(obs[:, turned], actions[:, turned]), atol=1e-6
    )
    assert all(parameter.shape[0] == N for parameter in policy().parameters())


def test_net_arch_for_actor_and_critic():
    parts = policy(net_arch={"pi": [7], "qf": [9, 11]})
    assert [weight.shape[2] for weight in parts.actor.net.weights] == [7, K]
    assert [weight.shape[2] for weight in parts.critic.net.weights] == [9, 11, 1]


@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.9])
def test_deterministic_bits_are_the_scores_above_the_threshold(threshold):
    built = policy(threshold=threshold)
    obs, _ = batch()
    bits, _ = built.predict(obs.numpy(), deterministic=True)
    assert bits.dtype == np.int8
    assert np.array_equal(bits, (built.actor(obs) > threshold).flatten(1).numpy())


def test_exploring_bits_share_one_uniform_threshold_per_agent():
    built = policy()
    obs, _ = batch()
    many = obs[:1].expand(20_000, -1, -1)
    th.manual_seed(0)
    with th.no_grad():
        scores, bits = built.actor(obs)[0], built.actor.act(many, deterministic=False)
    # Each bit is set with the probability of its score ...
    error = (bits.mean(dim=0) - scores).abs()
    assert (error < 4 * (scores * (1 - scores) / 20_000).sqrt()).all()
    # ... an agent's bits are nested ...
    order = scores.argsort(dim=1, descending=True).expand_as(bits)
    assert (bits.gather(2, order).diff(dim=2) <= 0).all()
    # ... and those of different agents are independent
    first = bits[:, :, 0] - bits[:, :, 0].mean(dim=0)
    correlation = (first.T @ first / 20_000) / (first.std(dim=0)[:, None] * first.std(dim=0))
    assert (correlation - th.eye(N)).abs().max() < 0.05


def test_continuous_actions_are_bounded():
    built = policy(spaces.Box(-3.0, 1.0, (N * 2,), np.float32))
    actions, _ = built.predict(100 * batch()[0].numpy())
    assert actions.min() >= -3.0
    assert actions.max() <= 1.0
    assert actions.min() < -1.0


def test_a_policy_survives_its_file(tmp_path):
    built = policy(threshold=0.2, net_arch=[8], share_actor=True)
    built.save(tmp_path / "policy.pt")
    loaded = MADDPGPolicy.load(tmp_path / "policy.pt")
    obs = batch()[0].numpy()
    assert loaded.threshold == 0.2
    assert np.array_equal(built.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize("threshold", [-0.1, 1.0, float("nan")])
def test_a_threshold_outside_the_scores_is_refused(threshold):
    with pytest.raises(ValueError, match="0 <= threshold < 1"):
        policy(threshold=threshold)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_refused(value):
    obs = batch()[0].numpy()
    obs[1, 2, 3] = value
    with pytest.raises(ValueError, match=r"agent\(s\) \[2\]"):
        policy().predict(obs)
    with pytest.raises(ValueError, match=r"agent\(s\) \[2\]"):
        policy().predict(obs[1])
