"""What flows where in actors and critics, who shares what, and the policy built from them."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.policies import MADDPGPolicy, MLPActor, MLPCritic, TeamCritic, sharing_groups
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import TeamObservation
from sb3_maddpg.team.team import Team
from toys import Toy

N, D, K, B = 4, 5, 3, 6
GROUPS = {"separate": [0, 1, 2, 3], "shared": [0, 0, 0, 0], "grouped": [0, 1, 1, 0]}
each_sharing = pytest.mark.parametrize("groups", GROUPS.values(), ids=GROUPS)


def batch(seed: int = 0, columns: int = D) -> tuple[th.Tensor, th.Tensor]:
    rng = np.random.default_rng(seed)
    obs = th.as_tensor(rng.normal(size=(B, N, columns)), dtype=th.float32)
    return obs, th.as_tensor(rng.integers(0, 2, (B, N, K)), dtype=th.float32)


def team(state_dim: int = 0) -> Team:
    state = spaces.Box(-1, 1, (state_dim,)) if state_dim else None
    observation = TeamObservation({f"a{i}": spaces.Box(-1, 1, (D,)) for i in range(N)}, state)
    return Team.from_spaces(observation, spaces.MultiBinary(N * K))


def actor(groups=None) -> MLPActor:
    return MLPActor(team(), TeamActions(team().action_spaces), [16], groups=groups)


def critic(groups=None, state_dim: int = 0, net_arch=(16,), n_critics: int = 1) -> MLPCritic:
    built = team(state_dim)
    return MLPCritic(built, TeamActions(built.action_spaces), list(net_arch), nn.ReLU, groups, n_critics)


def team_critic(state_dim: int = 0, net_arch=(16,), n_critics: int = 1) -> TeamCritic:
    built = team(state_dim)
    return TeamCritic(built, TeamActions(built.action_spaces), list(net_arch), n_critics=n_critics)


def policy(action_space: spaces.Space | None = None, **kwargs) -> MADDPGPolicy:
    observation_space = spaces.Box(-np.inf, np.inf, (N, D), np.float32)
    return MADDPGPolicy(observation_space, action_space or spaces.MultiBinary(N * K), lambda _: 1e-3, **kwargs)


@pytest.mark.parametrize("factors", [None, [2], [3, 0]])
@pytest.mark.parametrize("net_arch", [[], [16, 16]])
@pytest.mark.parametrize("n_critics", [1, 2])
@pytest.mark.parametrize("state_dim", [0, 6])
@each_sharing
def test_alternatives_equal_substituted_actions(groups, net_arch, n_critics, state_dim, factors):
    built = critic(groups, state_dim, net_arch, n_critics)
    obs, actions = batch(columns=D + 2 * (state_dim > 0))
    agents = range(N) if factors is None else factors
    own = th.rand(B, len(agents), 5, K)
    values = built.forward_alternatives(obs, actions, own, None if factors is None else th.tensor(factors))
    assert values.shape == (B, len(agents), 5)
    for row, agent in enumerate(agents):
        for alternative in range(5):
            substituted = actions.clone()
            substituted[:, agent] = own[:, row, alternative]
            assert th.allclose(values[:, row, alternative], built(obs, substituted)[0, :, agent], atol=1e-5)


@pytest.mark.parametrize("factors", [None, [2], [3, 0]])
@pytest.mark.parametrize("net_arch", [[], [16, 16]])
@pytest.mark.parametrize("n_critics", [1, 2])
@pytest.mark.parametrize("state_dim", [0, 6])
def test_alternatives_of_a_team_critic_equal_substituted_actions(net_arch, n_critics, state_dim, factors):
    built = team_critic(state_dim, net_arch, n_critics)
    obs, actions = batch(columns=D + 2 * (state_dim > 0))
    agents = range(N) if factors is None else factors
    own = th.rand(B, len(agents), 5, K)
    values = built.forward_alternatives(obs, actions, own, None if factors is None else th.tensor(factors))
    assert values.shape == (B, len(agents), 5)
    assert built(obs, actions).shape == (n_critics, B, 1)
    for row, agent in enumerate(agents):
        for alternative in range(5):
            substituted = actions.clone()
            substituted[:, agent] = own[:, row, alternative]
            assert th.allclose(values[:, row, alternative], built(obs, substituted)[0, :, 0], atol=1e-5)


def test_a_team_critic_values_means_and_goes_on_with_the_last_agent():
    built = team_critic()
    of_agents = th.tensor([[1.0, 2.0, 3.0, 6.0], [0.0, 0.0, 0.0, 0.0]])
    assert built.heads.of_factors(of_agents).tolist() == [[3.0], [0.0]]
    assert built.heads.per_value((of_agents > 5).float()).tolist() == [[1.0], [0.0]]
    actions, cost = batch()[1], th.rand(N, K)
    spent = (actions * cost).sum(dim=(1, 2)) / N
    known = ActionCost(cost)
    assert th.allclose(known.of(actions, built)[:, 0], spent)
    # What each agent's own action takes from the value adds up to the same
    assert th.allclose(known.of_alternatives(actions.unsqueeze(2), None, built).sum(dim=(1, 2)), spent)
    assert built.heads.owners(th.tensor([0])).tolist() == list(range(N))


@pytest.mark.parametrize("n_critics", [1, 2])
def test_a_team_critic_that_is_not_finite_belongs_to_all(n_critics):
    built = policy(share_critic="team", n_critics=n_critics)
    with th.no_grad():
        built.critic.net.weights[0][-1, 0, 0] = th.nan
    assert "agent(s) agent_0, agent_1, agent_2, agent_3" in built.not_finite(built.state_dict())


@each_sharing
def test_an_actor_sees_its_own_observation_only(groups):
    built = actor(groups)
    obs, _ = batch(columns=D + 2)
    for agent in range(N):
        changed = obs.clone()
        changed[:, agent, :D] += 1.0
        moved = (built(changed) != built(obs)).any(dim=2).any(dim=0)
        assert moved.tolist() == [other == agent for other in range(N)]
    changed = obs.clone()
    changed[..., D:] += 1.0  # the global state
    assert th.equal(built(changed), built(obs))


@pytest.mark.parametrize("n_critics", [1, 2])
@each_sharing
def test_every_critic_sees_all_observations_and_actions(groups, n_critics):
    built = critic(groups, n_critics=n_critics, net_arch=[32])
    obs, actions = (x.requires_grad_() for x in batch())
    for values in built(obs, actions):
        for agent in range(N):
            for gradient in th.autograd.grad(values[:, agent].sum(), (obs, actions), retain_graph=True):
                assert (gradient.abs().sum(dim=0) > 0).all()


@each_sharing
def test_with_a_global_state_every_critic_reads_that_and_all_actions(groups):
    built = critic(groups, state_dim=6, net_arch=[32])
    obs, actions = (x.requires_grad_() for x in batch(columns=D + 2))
    for agent in range(N):
        of_obs, of_actions = th.autograd.grad(built(obs, actions)[0, :, agent].sum(), (obs, actions))
        assert (of_actions.abs().sum(dim=0) > 0).all()
        # Six numbers in four rows of two: the last row is padding
        read = of_obs[..., D:].abs().sum(dim=0).flatten() > 0
        assert read.tolist() == [True] * 6 + [False] * 2
    values = built(obs[:, :1].expand(-1, N, -1), actions[:, :1].expand(-1, N, -1))[0]
    assert (values.std(dim=1) > 0).all()  # who shares a network is told whose value to give


def test_an_actors_gradient_comes_through_its_own_action_only():
    acting, judging = actor(), critic()
    obs, actions = batch()
    objective = judging.forward_alternatives(obs, actions, acting(obs).unsqueeze(2))
    for agent in range(N):
        gradients = th.autograd.grad(objective[:, agent].sum(), list(acting.parameters()), retain_graph=True)
        reached = th.stack([gradient.abs().sum(dim=(1, 2)) for gradient in gradients]).sum(dim=0) > 0
        assert reached.tolist() == [other == agent for other in range(N)]


def test_sharing_permutes_with_the_agents():
    shared = policy(share_actor=True, share_critic=True)
    assert all(parameter.shape[0] == 1 for parameter in shared.parameters())
    obs, actions = batch()
    turned = th.arange(N).roll(1)
    assert th.allclose(shared.actor(obs)[:, turned], shared.actor(obs[:, turned]), atol=1e-6)
    assert th.allclose(
        shared.critic(obs, actions)[..., turned], shared.critic(obs[:, turned], actions[:, turned]), atol=1e-6
    )
    assert all(parameter.shape[0] == N for parameter in policy().parameters())


def test_agents_of_one_list_share_and_others_do_not():
    lists = [["agent_0", 3], ["agent_1", "agent_2"]]
    grouped = policy(share_actor=lists, share_critic=lists)
    assert all(parameter.shape[0] == 2 for parameter in grouped.parameters())
    obs, actions = batch()
    swapped = [3, 1, 2, 0]
    assert th.allclose(grouped.actor(obs)[:, swapped], grouped.actor(obs[:, swapped]), atol=1e-6)
    values, turned = grouped.critic(obs, actions), grouped.critic(obs[:, swapped], actions[:, swapped])
    assert th.allclose(values[..., [3, 0]], turned[..., [0, 3]], atol=1e-6)
    same = obs[:, :1].expand(-1, N, -1)
    assert not th.allclose(grouped.actor(same)[:, 0], grouped.actor(same)[:, 1])


def test_groups_by_name_and_number():
    assert sharing_groups(True, team(), "share_actor") == [0, 0, 0, 0]
    assert sharing_groups(False, team(), "share_actor") == [0, 1, 2, 3]
    groups = sharing_groups([["a2", 0], ["a3"]], team(), "share_actor")
    assert groups[0] == groups[2]
    assert sorted(set(groups)) == [0, 1, 2]
    assert sharing_groups([], team(), "share_actor") == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("share", "message"),
    [
        ([["mixed_0", "mixed_9"]], "There is no agent 'mixed_9'.*mixed_0, mixed_1"),
        ([[0, 6]], "There is no agent 6.*0 to 5"),
        ([["mixed_0", 1], [0]], "share_actor.* names an agent twice"),
        ([[2, 2]], "names an agent twice"),
        ("team", "share_actor='team' must be True, False or a list of lists"),
        (["mixed_0", "mixed_4"], r"share_actor=.*must be .* a list of lists .*, such as \[\['mixed_0', 'mixed_1'\]\];"),
        ({"all": ["mixed_0"]}, "share_actor={'all'.* a list of lists"),
        ([{"mixed_0": 1}], "a list of lists"),
        (True, "mixed_0 and mixed_1 have different spaces.*Pass lists of homogeneous agents, or False"),
        ([["mixed_0", "mixed_4"]], "mixed_0 and mixed_4 have different spaces"),
    ],
)
def test_sharing_that_cannot_be_is_refused(share, message):
    env = TeamEnv(Toy("mixed"))
    with pytest.raises(ValueError, match=message):
        MADDPGPolicy(env.observation_space, env.action_space, lambda _: 1e-3, share_actor=share)


def test_agents_with_equal_observations_but_unlike_actions_do_not_share():
    unlike = spaces.MultiDiscrete([3] * 2 + [4] * 2)
    for argument in ("share_actor", "share_critic"):
        with pytest.raises(ValueError, match=rf"{argument}=True: agent_0 and agent_2 have different spaces"):
            policy(unlike, **{argument: True})
        assert policy(unlike, **{argument: [[0, 1], [2, 3]]}).predict(batch()[0].numpy())[0].max() <= 3


def test_net_arch_for_actor_and_critic():
    parts = policy(net_arch={"pi": [7], "qf": [9, 11]})
    assert [weight.shape[1] for weight in parts.actor.net.weights] == [7, K]
    assert [weight.shape[1] for weight in parts.critic.net.weights] == [9, 11, 1]


@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.9])
def test_deterministic_bits_are_the_scores_above_the_threshold(threshold):
    built = policy(threshold=threshold)
    obs, _ = batch()
    bits, _ = built.predict(obs.numpy(), deterministic=True)
    assert bits.dtype == np.int8
    assert np.array_equal(bits, (built.actor(obs) > threshold).flatten(1).numpy())


def test_continuous_actions_reach_their_bounds_and_no_further():
    built = policy(spaces.Box(-3.0, 1.0, (N * 2,), np.float32))
    actions, _ = built.predict(1e4 * batch()[0].numpy())
    assert actions.min() == -3.0
    assert actions.max() == 1.0


def test_a_policy_survives_its_file(tmp_path):
    built = policy(threshold=0.2, net_arch=[8], share_actor=True, share_critic=[[0, 1]], n_critics=2)
    built.save(tmp_path / "policy.pt")
    loaded = MADDPGPolicy.load(tmp_path / "policy.pt")
    obs = batch()[0].numpy()
    assert loaded.threshold == 0.2
    assert loaded.critic.n_critics == 2
    assert np.array_equal(built.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize("threshold", [-0.1, 1.0, float("nan")])
def test_a_threshold_outside_the_scores_is_refused(threshold):
    with pytest.raises(ValueError, match="0 <= threshold < 1"):
        policy(threshold=threshold)


@pytest.mark.parametrize("kind", ["datetime64[s]", "timedelta64[s]", "U4", "S4", "complex64"])
def test_an_observation_of_other_things_than_numbers_is_refused(kind):
    for observation in (np.zeros((N, D), kind), 10**400, "x", [[0.0], [0.0, 1.0]], None, [[None] * D] * N):
        with pytest.raises(ValueError, match=r"observation=.* is not an array of numbers of shape \(4, 5\)"):
            policy().predict(observation)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_refused(value):
    obs = batch()[0].numpy()
    obs[1, 2, 3] = value
    for observation in (obs, obs[1]):
        with pytest.raises(ValueError, match=r"agent\(s\) agent_2 holds NaN or infinity"):
            policy().predict(observation)
