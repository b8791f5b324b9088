"""Training with relational networks: credit by pairs, other team sizes, teams that act by themselves."""

import copy

import gymnasium
import numpy as np
import pytest
import torch as th
from mpe2 import simple_spread_v3

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from reference import assert_close, drawn
from sb3_maddpg import MADDPG, check_team_env
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo import TeamEnv
from toys import SMALL, Neighbours

B = 6
SPREAD = {"own": list(range(10)), "neighbours": [[10, 11, 14, 15], [12, 13, 16, 17]]}


@pytest.mark.parametrize("priced", [False, True])
@pytest.mark.parametrize("pair_credit", [False, True])
def test_one_update_is_that_of_plain_sums_over_pairs(pair_credit, priced):
    env = Neighbours()
    cost = 0.4 if priced else 0.0
    if priced:
        env.action_cost = cost
    kwargs = {"net_arch": [8, 8], "optimizer_class": th.optim.SGD, "pair_credit": pair_credit}
    numbers = {"learning_rate": 0.02, "max_grad_norm": None, "policy_regularization": 0.0, "gamma": 0.9}
    numbers["use_action_cost"] = priced
    model = MADDPG("PairPolicy", env, **{**SMALL, **numbers, "policy_kwargs": kwargs}).learn(60)
    old, data = copy.deepcopy(model.policy), drawn(model, 32)
    model.train(1, batch_size=32)

    bits = old.actions.encode(data.actions)
    next_bits = old.actor_target.act(data.next_observations)
    rewards = data.pair_rewards.flatten(1) if pair_credit else data.rewards
    per = (lambda pairs: pairs) if pair_credit else (lambda pairs: pairs.unflatten(-1, (4, 3)).sum(dim=-1))
    rest = per(old.critic_target.of_pairs(data.next_observations, next_bits)[0] - cost * next_bits.flatten(1))
    dones = data.dones.repeat_interleave(3, dim=1) if pair_credit else data.dones
    targets = rewards + per(cost * bits.flatten(1)) + 0.9 * (1 - dones) * rest
    errors = per(old.critic.of_pairs(data.observations, bits)[0]) - targets.detach()
    critic, actor = copy.deepcopy(old.critic), copy.deepcopy(old.actor)
    for network, source, loss in ((critic, old.critic, errors.square().mean(dim=0).sum()), (actor, old.actor, None)):
        if loss is None:
            scores = old.actor(data.observations).flatten(1)
            gain = th.zeros_like(scores)
            for pair in range(12):
                for bit, sign in ((1.0, 1.0), (0.0, -1.0)):
                    joint = bits.flatten(1).clone()
                    joint[:, pair] = bit
                    value = critic.of_pairs(data.observations, joint.view_as(bits))[0, :, pair] - cost * bit
                    gain[:, pair] += sign * value.detach()
            loss = -(scores * gain).mean(dim=0).sum()
        gradients = th.autograd.grad(loss, list(source.parameters()))
        for parameter, gradient in zip(network.parameters(), gradients, strict=True):
            parameter.data -= 0.02 * gradient
    assert_close(model.critic, critic, atol=1e-6)
    assert_close(model.actor, actor, atol=1e-6)


@pytest.mark.parametrize("activation_fn", [th.nn.ReLU, th.nn.Tanh])
def test_parameters_fit_a_swarm_of_another_size(activation_fn, tmp_path):
    kwargs = {**SMALL, "policy_kwargs": {"net_arch": [8], "activation_fn": activation_fn, "pair_credit": True}}
    small = MADDPG("PairPolicy", gymnasium.make("QuadSwarm-v0", n_robots=3, max_steps=20), **kwargs).learn(60)
    small.save(tmp_path / "three")
    large = MADDPG("PairPolicy", gymnasium.make("QuadSwarm-v0", n_robots=5, max_steps=20), **kwargs)
    large.set_parameters(tmp_path / "three.zip")
    rng = np.random.default_rng(0)
    obs = th.as_tensor(rng.normal(size=(B, 3, 18)), dtype=th.float32)
    wide = th.zeros(B, 5, 30)
    wide[:, :3, :6] = obs[..., :6]
    layouts = [model.policy.observation_layout["neighbours"] for model in (small, large)]
    for mine, theirs in zip(*layouts, strict=False):
        wide[:, :3, theirs] = obs[..., mine]
    acts = th.as_tensor(rng.integers(0, 2, (B, 3, 2)), dtype=th.float32)
    wide_acts = th.zeros(B, 5, 4)
    wide_acts[:, :3, :2] = acts
    assert th.allclose(large.actor(wide)[:, :3, :2], small.actor(obs), atol=1e-6)
    values = large.critic(wide, wide_acts)[0].view(B, 5, 4)
    assert th.allclose(values[:, :3, :2], small.critic(obs, acts)[0].view(B, 3, 2), atol=1e-6)
    assert not values[:, :3, 2:].any()
    start, _ = large.env.reset(), large.learn(60)
    assert large.action_space.contains(large.predict(start[0])[0])


@pytest.mark.parametrize("algorithm", [MADDPG, MATD3])
@pytest.mark.parametrize("continuous", [False, True])
def test_a_team_that_acts_by_itself(algorithm, continuous, tmp_path):
    env = TeamEnv(simple_spread_v3.parallel_env(max_cycles=10, continuous_actions=continuous))
    kwargs = {**SMALL, "policy_kwargs": {"net_arch": [8], "observation_layout": SPREAD}}
    model = algorithm("PairPolicy", env, **kwargs).learn(60)
    before = algorithm("PairPolicy", env, **kwargs)
    for (name, old), new in zip(before.policy.named_parameters(), model.policy.parameters(), strict=True):
        assert new.isfinite().all()
        # An actor that acts by itself has no use for what tells neighbours apart
        assert th.equal(old, new) == (name in ("actor.net.of_pair.weight", "actor_target.net.of_pair.weight"))
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    obs = np.random.default_rng(0).normal(size=(B, 3, 18)).astype(np.float32)
    actions, _ = loaded.predict(obs, deterministic=True)
    assert np.array_equal(actions, model.predict(obs, deterministic=True)[0])
    assert all(model.action_space.contains(action) for action in actions)


@pytest.mark.slow
@pytest.mark.parametrize(("n_choices", "pair_credit"), [(2, False), (2, True), (3, True)])
def test_what_holds_for_every_neighbour_is_learned_from_all_of_them(n_choices, pair_credit):
    recipe = {"learning_rate": 1e-2, "learning_starts": 100, "batch_size": 64, "train_freq": 4, "gamma": 0.5, "seed": 0}
    env = Neighbours(n_choices=n_choices)
    model = MADDPG("PairPolicy", env, **recipe, policy_kwargs={"pair_credit": pair_credit}).learn(400)
    assert env.play(model) > 0.93
    if not pair_credit:
        assert env.play(MADDPG("MlpPolicy", env, **recipe).learn(400)) < 0.7
        return
    obs, asking = env.draw(np.random.default_rng(1), 200), np.ones((200, 12))
    values = model.critic(th.as_tensor(obs), model.policy.actions.encode(th.as_tensor(asking))).detach().numpy()
    assert np.corrcoef(values.ravel(), env.pair_rewards(obs, asking).ravel())[0, 1] > 0.9


@pytest.mark.parametrize("n_steps", [1, 3])
def test_the_value_of_a_pair_ends_with_it(n_steps):
    """If neighbours change, the target of a pair does not depend on a later neighbour in the same position."""
    world = {"neighbourhood": {"max_others": 2, "range": 2.0}}
    kwargs = {"n_robots": 6, "preset": "dense", "scenario": "random_swap", "reward": {"near_miss": 1.0}}
    env = gymnasium.make("QuadSwarm-v0", observation="state+critic", world=world, **kwargs)
    policy_kwargs = {"net_arch": [8, 8], "optimizer_class": th.optim.SGD, "pair_credit": True}
    numbers = {"learning_rate": 0.02, "max_grad_norm": None, "policy_regularization": 0.0, "gamma": 0.9}
    model = MADDPG("PairPolicy", env, **{**SMALL, **numbers, "n_steps": n_steps, "policy_kwargs": policy_kwargs})
    model.learn(80)
    old, data = copy.deepcopy(model.policy), drawn(model, 32)
    assert 0 < data.pair_goes_on.mean() < 1
    model.train(1, batch_size=32)
    bits = old.actions.encode(data.actions)
    rest = old.critic_target.of_pairs(data.next_observations, old.actor_target.act(data.next_observations))[0]
    discounts = data.discounts if n_steps == 1 else data.discounts.repeat_interleave(2, dim=1)
    dones = data.dones.repeat_interleave(2, dim=1)
    targets = data.pair_rewards.flatten(1) + discounts * (1 - dones) * data.pair_goes_on.flatten(1) * rest
    errors = old.critic.of_pairs(data.observations, bits)[0] - targets.detach()
    critic = copy.deepcopy(old.critic)
    gradients = th.autograd.grad(errors.square().mean(dim=0).sum(), list(old.critic.parameters()))
    for parameter, gradient in zip(critic.parameters(), gradients, strict=True):
        parameter.data -= 0.02 * gradient
    assert_close(model.critic, critic, atol=1e-5)


def test_a_team_whose_neighbours_change_keeps_the_convention():
    world = {"neighbourhood": {"max_others": 2, "range": 2.5}}
    for observation in ("paper", "state+mask", "state+told+critic"):
        check_team_env(gymnasium.make("QuadSwarm-v0", observation=observation, world=world, announcements=True))
