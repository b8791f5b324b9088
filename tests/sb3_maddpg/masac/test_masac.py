import math

import numpy as np
import pytest
import torch as th

from sb3_maddpg import MASAC, PrioritizedTeamReplayBuffer, TeamEnv
from sb3_maddpg.team.toys import BINARY_TASKS, FollowTarget, OwnBit, OwnCategory, PricedBit
from toys import Toy

KINDS = ["continuous", "binary", "categorical", "heterogeneous"]


def made(kind: str = "continuous", **kwargs) -> MASAC:
    settings = {"learning_starts": 20, "batch_size": 16, "train_freq": 5, "seed": 0, **kwargs}
    return MASAC("MlpPolicy", TeamEnv(Toy(kind)), **settings)


@pytest.mark.slow
@pytest.mark.parametrize("task", [*BINARY_TASKS, OwnCategory, FollowTarget])
def test_it_solves_tasks_whose_best_return_is_known(task):
    steps = 2500 if task is PricedBit else 1000
    recipe = {"learning_rate": 3e-3, "learning_starts": 200, "batch_size": 256, "train_freq": 4, "gamma": 0.5}
    model = MASAC("MlpPolicy", task(), buffer_size=steps, seed=0, **recipe).learn(steps)
    assert task().play(model) > 0.97


@pytest.mark.parametrize("kind", KINDS)
def test_the_target_is_the_reward_and_the_soft_value_of_what_comes_next(kind):
    """One update of the critics, computed agent by agent."""
    model = made(
        kind, gamma=0.9, policy_kwargs={"optimizer_class": th.optim.SGD}, learning_rate=0.1, max_grad_norm=None
    )
    model.learn(60)
    state, torch_state = np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    batch = model._sample_replay_buffer(16)
    critic, target = model.critic, model.critic_target
    with th.no_grad():
        logits, entropy = model.actor.sample(batch.next_observations)
        actions = model.policy.actions.act(logits, deterministic=False)
        if batch.next_active is not None:
            actions, entropy = actions * batch.next_active.unsqueeze(2), entropy * batch.next_active
        ent_coef = model.actor.log_ent_coef.exp()
        values = target(batch.next_observations, actions)
    losses = 0.0
    for agent in range(model.policy.team.n_agents):
        soft = th.minimum(values[0, :, agent], values[1, :, agent]) + ent_coef[agent] * entropy[:, agent]
        goal = batch.rewards[:, agent] + 0.9 * (1 - batch.dones[:, agent]) * soft
        for one in critic(batch.observations, batch.actions):
            errors = (one[:, agent] - goal.detach()) ** 2
            acted = th.ones_like(errors) if batch.active is None else batch.active[:, agent]
            losses = losses + (errors * acted).sum() / acted.sum().clamp(min=1)
    gradients = th.autograd.grad(losses, list(critic.parameters()))
    expected = [
        weight.detach() - 0.1 * gradient for weight, gradient in zip(critic.parameters(), gradients, strict=True)
    ]
    np.random.set_state(state)  # noqa: NPY002
    th.set_rng_state(torch_state)
    model.train(1, batch_size=16)
    for weight, wanted in zip(critic.parameters(), expected, strict=True):
        assert th.allclose(weight, wanted, atol=1e-5)


@pytest.mark.parametrize(("target", "direction"), [(3.0, 1), (-20.0, -1)])
def test_the_coefficient_follows_the_entropy_towards_its_target(target, direction):
    model = made(target_entropy=target).learn(300)
    change = model.actor.log_ent_coef.detach() - math.log(0.1)
    assert (change * direction > 0.1).all()


def test_a_fixed_coefficient_stays():
    model = made(ent_coef=0.3).learn(200)
    assert model.actor.log_ent_coef.exp().tolist() == pytest.approx([0.3] * model.policy.team.n_agents)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ent_coef", ["auto_0.1", 0.05])
def test_a_loaded_model_continues_as_the_saved_one(kind, ent_coef, tmp_path):
    model = made(kind, ent_coef=ent_coef).learn(100)
    model.save(tmp_path / "model")
    loaded = MASAC.load(tmp_path / "model", env=TeamEnv(Toy(kind)))
    assert (loaded.ent_coef, loaded.algorithm) == (ent_coef, "MASAC")
    for one, other in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(one, other)
    # The next update is the same, too
    loaded.replay_buffer = model.replay_buffer
    loaded.set_logger(model.logger)
    for one in (model, loaded):
        np.random.seed(3)  # noqa: NPY002
        th.manual_seed(3)
        one.train(2, batch_size=16)
    for one, other in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(one, other)


@pytest.mark.parametrize("options", [{"n_steps": 3}, {"replay_buffer_class": PrioritizedTeamReplayBuffer}])
@pytest.mark.parametrize("share", [True, "team"])
def test_it_trains_with_what_other_algorithms_have(options, share):
    settings = {"learning_starts": 20, "batch_size": 16, "train_freq": 5, **options}
    model = MASAC("MlpPolicy", OwnBit(), policy_kwargs={"share_critic": share}, **settings).learn(120)
    assert model._n_updates > 0
    assert {"train/entropy", "train/ent_coef", "train/critic_loss"} <= set(model.logger.name_to_value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ent_coef": "automatic"}, "ent_coef"),
        ({"ent_coef": "auto_0"}, "ent_coef"),
        ({"ent_coef": -0.1}, "ent_coef"),
        ({"ent_coef": float("nan")}, "ent_coef"),
        ({"target_entropy": "high"}, "target_entropy"),
        ({"target_entropy": float("inf")}, "target_entropy"),
        ({"policy_kwargs": {"image_columns": [[[0, 2]]]}}, "image"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        made("binary", **arguments)
