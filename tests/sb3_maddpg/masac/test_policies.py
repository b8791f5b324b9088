import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_maddpg import MADDPG, TeamEnv
from sb3_maddpg.masac.masac import MASAC
from sb3_maddpg.masac.policies import SoftActor
from toys import AGENT_SPACES, Toy


def actor(kind: str) -> SoftActor:
    th.manual_seed(0)
    return MASAC("MlpPolicy", TeamEnv(Toy(kind)), seed=1, policy_kwargs={"net_arch": [8]}).actor


def observations(of: SoftActor, n: int = 4) -> th.Tensor:
    return th.rand(n, of.team.n_agents, of.team.obs_dim)


def test_the_entropy_of_continuous_actions_is_that_of_a_squashed_gaussian():
    """Against torch.distributions, with the change of variables of tanh(x / 2)."""
    of = actor("continuous")
    obs = observations(of, 20_000)[:1].expand(20_000, -1, -1)
    drawn, entropy = of.sample(obs)
    mean, log_std = of._outputs(obs[:1])
    gaussian = th.distributions.Normal(mean, log_std.exp())
    halved = th.distributions.AffineTransform(0.0, 0.5)
    squashed = th.distributions.TransformedDistribution(
        gaussian, [halved, th.distributions.TanhTransform(cache_size=1)]
    )
    expected = -squashed.log_prob((0.5 * drawn).tanh()).sum(dim=-1)
    assert th.allclose(entropy, expected, atol=1e-3)
    # The draws have this mean and spread
    assert th.allclose(drawn.mean(dim=0), mean[0], atol=0.05)
    assert th.allclose(drawn.std(dim=0), log_std.exp()[0], atol=0.05)


@pytest.mark.parametrize("kind", ["categorical", "binary"])
def test_the_entropy_of_choices_is_exact(kind):
    of = actor(kind)
    obs = observations(of)
    logits, entropy = of.sample(obs)
    for row in range(len(obs)):
        for agent, space in enumerate(of.actions.action_spaces):
            own = logits[row, agent]
            if isinstance(space, spaces.MultiBinary):
                expected = th.distributions.Bernoulli(logits=own[: space.n]).entropy().sum()
            else:
                sizes = [space.n] if isinstance(space, spaces.Discrete) else space.nvec.tolist()
                heads = own.unflatten(-1, (-1, max(sizes))) if len(sizes) > 1 else own.unsqueeze(0)
                expected = sum(
                    th.distributions.Categorical(logits=head[:size]).entropy()
                    for head, size in zip(heads, sizes, strict=False)
                )
            assert entropy[row, agent].item() == pytest.approx(expected.item(), abs=1e-5)


@pytest.mark.parametrize("kind", ["continuous", "binary", "categorical", "heterogeneous"])
def test_gradients_of_the_entropy_are_finite_also_where_a_choice_is_certain(kind):
    of = actor(kind)
    with th.no_grad():
        for weight in of.net.parameters():
            weight.mul_(1e3)
    _, entropy = of.sample(observations(of) * 1e2)
    entropy.sum().backward()
    assert all(weight.grad is not None and weight.grad.isfinite().all() for weight in of.net.parameters())


@pytest.mark.parametrize("kind", ["continuous", "binary", "categorical", "heterogeneous"])
def test_an_agent_alone_acts_as_in_its_team(kind):
    model = MASAC("MlpPolicy", TeamEnv(Toy(kind)), learning_starts=20, batch_size=8, train_freq=5, seed=0).learn(60)
    team = model.policy.team
    obs = th.rand(team.n_agents, team.obs_dim).numpy()
    obs[np.arange(team.obs_dim) >= np.array(team.obs_dims)[:, None]] = 0.0  # padding
    joint, _ = model.predict(obs, deterministic=True)
    own = [model.agent_policy(name).predict(obs[row, : team.obs_dims[row]])[0] for row, name in enumerate(team.names)]
    # Categories of the joint action count from 0
    own = [np.ravel(one - getattr(space, "start", 0)) for one, space in zip(own, AGENT_SPACES[kind], strict=True)]
    assert np.concatenate(own) == pytest.approx(joint, abs=1e-5)


def test_exploration_draws_from_the_policy():
    model = MASAC("MlpPolicy", TeamEnv(Toy("continuous")), seed=0)
    obs = np.zeros(model.observation_space.shape, np.float32)
    drawn = np.array([model.predict(obs)[0] for _ in range(200)])
    best = model.predict(obs, deterministic=True)[0]
    assert drawn.std(axis=0).min() > 0.1
    assert math.isclose(np.abs(model.predict(obs, deterministic=True)[0] - best).max(), 0.0)


def test_a_policy_of_another_algorithm_is_refused():
    with pytest.raises(ValueError, match="MASAC needs SoftActor"):
        MASAC(MADDPG.policy_aliases["MlpPolicy"], TeamEnv(Toy("binary")))
