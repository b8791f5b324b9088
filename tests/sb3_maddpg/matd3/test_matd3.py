"""Twin critics, delayed policies and smoothed targets."""

import copy
import inspect

import numpy as np
import pytest
import torch as th

from reference import SGD, assert_close, assert_moved, drawn, updated
from sb3_maddpg import MADDPG
from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo import TeamEnv
from toys import SMALL, Toy


def made(kind: str, **kwargs) -> MATD3:
    return MATD3("MlpPolicy", TeamEnv(Toy(kind)), **{**SMALL, "policy_kwargs": SGD, "learning_rate": 0.1, **kwargs})


@pytest.mark.parametrize(("priced", "n_steps", "clip"), [(False, 1, None), (True, 3, 0.05)])
@pytest.mark.parametrize("kind", ["binary", "continuous", "categorical", "heterogeneous"])
def test_one_update_is_that_of_separate_agents_with_twin_critics(kind, priced, n_steps, clip):
    model = made(
        kind,
        policy_delay=1,
        target_policy_noise=0.0,
        policy_regularization=0.02,
        tau=0.3,
        gamma=0.9,
        n_steps=n_steps,
        max_grad_norm=clip,
    )
    n_agents, width = model.policy.team.n_agents, model.policy.actions.width
    cost = np.full((n_agents, width), 0.7, np.float32) if priced else None
    model.cost = ActionCost(None if cost is None else th.as_tensor(cost))
    model.learn(60)
    old, data = copy.deepcopy(model.policy), drawn(model, 32)
    th.manual_seed(5)
    next_actions = old.actor_target.act(data.next_observations, deterministic=False)
    th.manual_seed(5)
    model.train(1, batch_size=32)
    critic, actor = updated(old, data, next_actions, 0.1, clip, 0.02, cost)
    assert_close(model.critic, critic)
    assert_close(model.actor, actor)
    assert_moved(model.critic_target, model.critic, old.critic_target, 0.3)
    assert_moved(model.actor_target, model.actor, old.actor_target, 0.3)


def test_the_target_is_the_smaller_of_two_unlike_values():
    model = made("continuous").learn(100)
    data = drawn(model, 256)
    values = model.critic_target(data.next_observations, model.actor_target.act(data.next_observations))
    assert values.shape == (2, 256, 3)
    first_is_smaller = (values[0] < values[1]).float().mean().item()
    assert 0.0 < first_is_smaller < 1.0


def test_policy_and_targets_wait_for_the_critics():
    model = made("continuous", policy_delay=3, gradient_steps=0).learn(60)
    parts = ("actor", "actor_target", "critic_target", "critic")
    for update in range(1, 7):
        before = copy.deepcopy(model.policy)
        model.train(1, batch_size=16)
        for part in parts:
            pairs = zip(getattr(before, part).parameters(), getattr(model.policy, part).parameters(), strict=True)
            moved = not all(th.equal(old, new) for old, new in pairs)
            assert moved == (part == "critic" or update % 3 == 0), (part, update)


def test_target_numbers_are_smoothed_by_clipped_noise():
    model = made("continuous", target_policy_noise=0.2, target_noise_clip=0.3)
    th.manual_seed(0)
    obs = th.rand(1, *model.observation_space.shape).expand(20_000, -1, -1)
    best = model.actor_target.act(obs)
    noise = model._target_actions(obs) - best
    inside = best.abs() < 0.7
    assert inside.any()
    noise = noise[inside]
    assert noise.abs().max().item() == pytest.approx(0.3, abs=1e-6)
    # A normal distribution of spread 0.2 cut off at 1.5 of its spreads, the rest at the ends
    assert (noise.abs() > 0.3 - 1e-6).float().mean().item() == pytest.approx(0.1336, abs=0.01)
    assert noise[noise.abs() < 0.1].abs().mean().item() == pytest.approx(0.0490, abs=0.002)
    assert noise.mean().item() == pytest.approx(0.0, abs=0.01)


def test_smoothed_targets_stay_within_the_bounds():
    model = made("continuous", target_policy_noise=5.0, target_noise_clip=5.0)
    obs = th.rand(100, *model.observation_space.shape)
    actions = model._target_actions(obs)
    assert actions.abs().max() == 1.0
    assert (actions != model.actor_target.act(obs)).float().mean() > 0.9


@pytest.mark.parametrize("kind", ["binary", "categorical", "heads", "mixed"])
def test_target_bits_and_categories_are_drawn_as_in_exploration(kind):
    n = 5000
    model = made(kind)
    actions, discrete = model.policy.actions, ~model.policy.actions.continuous_columns
    th.manual_seed(0)
    obs = th.rand(1, *model.observation_space.shape)
    probabilities = model.actor_target(obs)[0]
    drawn_actions = model._target_actions(obs.expand(n, -1, -1))
    error = (drawn_actions.mean(dim=0) - probabilities).abs()
    allowed = 4.5 * (probabilities * (1 - probabilities)).clamp(min=0).sqrt() / n**0.5
    assert (error <= allowed + 1e-6)[discrete].all()
    assert not drawn_actions[:, ~actions.real].any()
    if kind == "mixed":
        assert (drawn_actions.std(dim=0) > 0)[actions.continuous_columns].all()


def test_with_one_critic_no_delay_and_no_noise_it_is_maddpg():
    kwargs = {**SMALL, "policy_kwargs": {"net_arch": [8], "n_critics": 1}}
    vectors = []
    for algorithm, further in ((MADDPG, {}), (MATD3, {"policy_delay": 1, "target_policy_noise": 0.0})):
        model = algorithm("MlpPolicy", TeamEnv(Toy("continuous")), **kwargs, **further).learn(100)
        vectors.append(model.policy.parameters_to_vector())
    assert np.array_equal(*vectors)


def test_takes_the_arguments_of_maddpg_in_the_same_order():
    of_maddpg, of_matd3 = (list(inspect.signature(algorithm).parameters) for algorithm in (MADDPG, MATD3))
    assert of_matd3[: len(of_maddpg)] == of_maddpg
    assert of_matd3[len(of_maddpg) :] == ["target_policy_noise", "target_noise_clip"]
    model = MATD3("MlpPolicy", TeamEnv(Toy("continuous")), 1e-3, 50_000)
    assert (model.learning_rate, model.buffer_size, model.policy_delay) == (1e-3, 50_000, 2)


def test_defaults_are_those_of_td3():
    model = MATD3("MlpPolicy", TeamEnv(Toy("continuous")))
    assert (model.policy_delay, model.target_policy_noise, model.target_noise_clip) == (2, 0.2, 0.5)
    assert model.policy.n_critics == 2
    first, second = model.critic.net.weights[0].chunk(2)
    assert not th.allclose(first, second)
    assert all(th.equal(a, b) for a, b in zip(model.critic.parameters(), model.critic_target.parameters(), strict=True))


@pytest.mark.parametrize("name", ["target_policy_noise", "target_noise_clip"])
def test_negative_noise_is_refused(name):
    with pytest.raises(ValueError, match=rf"{name}=-0\.1.* must not be negative"):
        made("continuous", **{name: -0.1})
