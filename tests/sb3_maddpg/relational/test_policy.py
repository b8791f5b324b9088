"""Relational networks: symmetry, who sees whom, values of pairs, and layouts that do not fit."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from sb3_maddpg import MADDPG
from sb3_maddpg.relational.policy import PairPolicy
from sb3_maddpg.team.toys import OwnBit

N, M, B = 5, 4, 6
# Columns of a neighbour lie apart, as in the swarm
LAYOUT = {"own": [0, 1], "neighbours": [[2 + j, 6 + j] for j in range(M)], "acts_on_neighbours": True}
BY_ITSELF = {**LAYOUT, "acts_on_neighbours": False}
ACTIONS = {
    "binary": spaces.MultiBinary(N * M * 2),
    "continuous": spaces.Box(-1, 1, (N * M,)),
    "categorical": spaces.MultiDiscrete([3] * (N * M * 2)),
}
each_mode = pytest.mark.parametrize("layout", [LAYOUT, BY_ITSELF], ids=["on neighbours", "by itself"])
each_action = pytest.mark.parametrize("space", ACTIONS.values(), ids=ACTIONS)


def policy(space=ACTIONS["binary"], layout=LAYOUT, columns: int = 10, **kwargs) -> PairPolicy:
    observation_space = spaces.Box(-np.inf, np.inf, (N, columns), np.float32)
    return PairPolicy(
        observation_space, space, lambda _: 1e-3, observation_layout=layout, **{"net_arch": [8, 8], **kwargs}
    )  # fmt: skip


def batch(built: PairPolicy, columns: int = 10) -> tuple[th.Tensor, th.Tensor]:
    th.manual_seed(0)
    logits = th.randn(B, N, built.actions.width)
    return th.randn(B, N, columns), built.actions.act(logits, deterministic=False)


def others(agent: int) -> list[int]:
    return [other for other in range(N) if other != agent]


def renamed(names: list[int], rows: th.Tensor, slots: list[th.Tensor]) -> tuple[th.Tensor, list[th.Tensor]]:
    """
    The same team with agents in another order.

    :param names: agent i is now the former agent names[i]
    :param rows: (batch, n_agents, ...)
    :param slots: something about each neighbour, (batch, n_agents, n_neighbours, ...)
    """
    moved = [slot[:, names] for slot in slots]
    for agent, name in enumerate(names):
        order = [others(name).index(names[other]) for other in others(agent)]
        for new in moved:
            new[:, agent] = new[:, agent, order]
    return rows[:, names], moved


@each_action
@each_mode
def test_the_order_of_agents_does_not_matter(layout, space):
    built = policy(space, layout, n_critics=2)
    obs, actions = batch(built)
    names = [3, 0, 4, 2, 1]
    _, (neighbours, parts) = renamed(
        names, obs, [obs[..., LAYOUT["neighbours"]], actions.unflatten(-1, (M, -1))]
    )  # fmt: skip
    moved_obs = th.zeros_like(obs)
    moved_obs[..., :2], moved_obs[..., LAYOUT["neighbours"]] = obs[:, names, :2], neighbours
    moved_actions = parts.flatten(2) if layout is LAYOUT else actions[:, names]
    scores, values = built.actor(obs), built.critic.of_pairs(obs, actions).unflatten(-1, (N, M))
    if layout is LAYOUT:
        _, (scores,) = renamed(names, obs, [scores.unflatten(-1, (M, -1))])
        scores = scores.flatten(2)
    else:
        scores = scores[:, names]
    assert th.allclose(built.actor(moved_obs), scores, atol=1e-6)
    moved_values = built.critic.of_pairs(moved_obs, moved_actions).unflatten(-1, (N, M))
    for mine, theirs in zip(moved_values, values, strict=True):
        assert th.allclose(mine, renamed(names, obs, [theirs])[1][0], atol=1e-6)


@each_mode
def test_an_actor_sees_its_own_observation_only(layout):
    built = policy(layout=layout, columns=12)
    obs, _ = batch(built, 12)
    for agent in range(N):
        changed = obs.clone()
        changed[:, agent, :10] += 1.0
        moved = (built.actor(changed) != built.actor(obs)).any(dim=2).any(dim=0)
        assert moved.tolist() == [other == agent for other in range(N)]
    changed = obs.clone()
    changed[..., 10:] += 1.0  # what the layout does not name
    assert th.equal(built.actor(changed), built.actor(obs))


@each_mode
def test_a_critic_reads_the_agents_view_and_of_others_what_they_are_and_do_to_it(layout):
    built = policy(layout=layout)
    obs, actions = batch(built)
    obs, actions = obs.requires_grad_(), actions.requires_grad_()
    for agent in range(N):
        value = built.critic(obs, actions)[0, :, agent].sum()
        of_obs, of_actions = (g.abs().sum(dim=0) > 0 for g in th.autograd.grad(value, (obs, actions)))
        for other in range(N):
            assert of_obs[other].tolist() == [True, True] + [other == agent] * 8
            towards = others(other).index(agent) if other != agent else None
            read = [layout is BY_ITSELF or towards in (None, slot) for slot in range(M)]
            assert of_actions[other].tolist() == np.repeat(read, 2).tolist()


def test_what_a_neighbour_does_counts_only_where_it_sees_the_agent():
    who = [[1, 2, 3, 4], [0, 2, 3, 4], [0, 1, 3, 4], [0, 1, 2, 4], [0, 1, 2, 3]]
    space = spaces.MultiBinary(N * 2)
    layout = {"own": [0, 1], "neighbours": [[2, 6], [3, 7]], "acts_on_neighbours": True}
    ring = {**layout, "who": [[(i + 1) % N, (i + 2) % N] for i in range(N)]}  # nobody is seen back but ...
    ring["who"][1] = [0, 2]  # ... agent 0 by agent 1
    assert (
        policy(layout={**LAYOUT, "who": who}).critic.views.reverse_indices.tolist()
        == policy().critic.views.reverse_indices.tolist()
    )
    built = policy(space, ring)
    obs, actions = batch(built)
    actions.requires_grad_()
    (gradient,) = th.autograd.grad(built.critic.of_pairs(obs, actions)[0, :, :2].sum(), actions)
    assert (gradient.abs().sum(dim=0) > 0).tolist() == [[True, True], [True, False]] + [[False, False]] * 3


CHANGING = {**LAYOUT, "who_columns": [10 + j for j in range(M)]}


@each_action
@pytest.mark.parametrize("layout", [CHANGING, {**CHANGING, "acts_on_neighbours": False}], ids=["on", "by itself"])
def test_neighbours_that_are_named_in_columns_may_stand_anywhere(layout, space):
    fixed = policy(space, {key: value for key, value in layout.items() if key != "who_columns"})
    named = policy(space, layout, columns=10 + M)
    named.load_state_dict(fixed.state_dict())
    obs, actions = batch(fixed)
    who = th.tensor([others(agent) for agent in range(N)]).expand(B, -1, -1)
    order = th.rand(B, N, M).argsort(dim=-1)
    place = th.tensor(LAYOUT["neighbours"])
    moved = th.cat([obs, who.gather(2, order) + 1.0], dim=-1)
    for column in range(2):
        moved[..., place[:, column]] = obs[..., place[:, column]].gather(2, order)
    moved_actions = actions
    if layout["acts_on_neighbours"]:
        parts = actions.unflatten(-1, (M, -1))
        moved_actions = parts.gather(2, order.unsqueeze(-1).expand_as(parts)).flatten(2)
    expected = fixed.critic.of_pairs(obs, actions)[0].unflatten(-1, (N, M)).gather(2, order)
    got = named.critic.of_pairs(moved, moved_actions)[0].unflatten(-1, (N, M))
    assert th.allclose(got, expected, atol=1e-6)
    # The value of an absent neighbour is zero for all actions
    moved[:, 0, [*place[1], 10 + 1]] = 0.0
    assert not named.critic.of_pairs(moved, moved_actions)[0].unflatten(-1, (N, M))[:, 0, 1].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"complete": True}, "cannot be combined with .* complete=True"),
        ({"who": [others(agent) for agent in range(N)]}, "cannot be combined with `who`"),
        ({"who_columns": [10, 11]}, "every neighbour needs the same number of columns"),
        ({"who_columns": [10, 11, 12, 99]}, "each from 0 to 13"),
    ],
)
def test_refuses_columns_of_numbers_that_do_not_fit(change, message):
    with pytest.raises(ValueError, match=message):
        policy(layout={**CHANGING, **change}, columns=10 + M)


def test_numbers_of_neighbours_reach_critics_alone():
    built = policy(layout=CHANGING, columns=10 + M)
    obs, _ = batch(built, 10 + M)
    other = obs.clone()
    other[..., 10:] = 0.0
    assert th.equal(built.actor(obs), built.actor(other))


def test_what_a_neighbour_does_counts_only_while_it_sees_the_agent():
    built = policy(layout=CHANGING, columns=10 + M)
    obs, actions = batch(built, 10 + M)
    actions.requires_grad_()
    obs[..., 10:] = 0.0
    obs[:, 0, 10:12] = th.tensor([3.0, 2.0])  # agent 0 perceives 2 and 1; it is the last neighbour of 1
    obs[:, 1, 10 + M - 1] = 1.0
    obs[:, 0, [4, 5, 8, 9]] = 0.0  # its other positions are empty
    (gradient,) = th.autograd.grad(built.critic.of_pairs(obs, actions)[0, :, :M].sum(), actions)
    acting = (gradient.abs().sum(dim=0) > 0).unflatten(-1, (M, -1)).any(dim=-1)
    assert acting[0].tolist() == [True, True, False, False]
    assert acting[1].tolist() == [False] * (M - 1) + [True]
    assert not acting[2:].any()


@each_action
@each_mode
def test_alternatives_equal_substituted_actions_and_pairs_sum_to_the_agents_value(layout, space):
    built = policy(space, layout, n_critics=2)
    obs, actions = batch(built)
    obs[:, 1, LAYOUT["neighbours"][2]] = 0.0
    critic = built.critic
    parts = critic.of_pairs(obs, actions)
    assert parts.shape == (2, B, N * M)
    assert not parts[:, :, M + 2].any()  # nobody is there
    assert th.allclose(critic(obs, actions), parts.unflatten(-1, (N, M)).sum(dim=-1))
    factors = critic.factored(actions)
    own = th.rand(B, factors.shape[1], 3, factors.shape[2])
    values = critic.forward_alternatives(obs, actions, own)
    for factor in range(factors.shape[1]):
        for alternative in range(3):
            substituted = factors.clone()
            substituted[:, factor] = own[:, factor, alternative]
            joint = critic.of_pairs(obs, substituted.reshape(actions.shape))[0]
            expected = joint[:, factor] if layout is LAYOUT else joint.unflatten(-1, (N, M)).sum(dim=-1)[:, factor]
            assert th.allclose(values[:, factor, alternative], expected, atol=1e-5)


@pytest.mark.parametrize("shared", [False, True])
def test_neighbours_are_explored_one_by_one_unless_told_otherwise(shared):
    built = policy(spaces.MultiBinary(N * M), shared_threshold=shared)
    obs = th.randn(1, N, 10)
    bits = built.actor.act(obs.expand(5000, -1, -1), deterministic=False)
    order = built.actor(obs).argsort(dim=2, descending=True).expand_as(bits)
    assert (bits.gather(2, order).diff(dim=2) <= 0).all() == shared


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (None, "PairPolicy needs to know .*`observation_layout`"),
        ({"own": [0]}, r"has entries \['own'\], but needs `own` and `neighbours`"),
        ({**LAYOUT, "owns": [0]}, "`action_mask` and `complete`\\."),
        ([1], r"observation_layout=\[1\] must be a dict"),
        ({1: 2}, r"has entries \['1'\], but needs"),
        ({**LAYOUT, "own": "ab"}, "own='ab' must be a list of integers"),
        ({**LAYOUT, "own": 0}, "own=0 must be a list of integers"),
        ({**LAYOUT, "own": [0.5]}, r"own=\[0\.5\] must be a list of integers"),
        ({**LAYOUT, "own": [True]}, r"own=\[True\] must be a list of integers"),
        ({**LAYOUT, "neighbours": [2]}, r"neighbours=\[2\] must be a list of lists of integers"),
        ({**LAYOUT, "who": 3}, "who=3 must be a list of lists of integers"),
        ({**LAYOUT, "complete": "no"}, "complete='no' must be True or False"),
        ({**LAYOUT, "own": [10]}, "each from 0 to 9"),
        ({**LAYOUT, "neighbours": [[2], [3], [4], [5, 6]]}, "the same number of columns"),
        ({**LAYOUT, "neighbours": []}, "the same number of columns"),
        ({**LAYOUT, "neighbours": [[2], [3]]}, r"2 neighbours, but the 5 agents have \[4, 4, 4, 4, 4\]"),
        ({**LAYOUT, "who": [[0, 1, 2, 3]] * 5}, "must name other agents, by indices from 0 to 4"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused(layout, message):
    with pytest.raises(ValueError, match=message):
        policy(layout=layout)


def test_a_layout_of_arrays_and_ranges_is_read():
    layout = {**LAYOUT, "own": range(2), "neighbours": np.array(LAYOUT["neighbours"])}
    built = policy(layout=layout)
    obs, _ = batch(built)
    expected = policy()
    expected.load_state_dict(built.state_dict())
    assert th.equal(built.actor(obs), expected.actor(obs))


@pytest.mark.parametrize("pair_credit", [False, True])
@pytest.mark.parametrize("layout", [3, {"own": [0]}, {"own": [0], "neighbours": 2}])
def test_the_layout_of_an_environment_is_checked(layout, pair_credit):
    env = OwnBit()
    env.observation_layout = layout
    with pytest.raises(ValueError, match="observation_layout"):
        MADDPG("PairPolicy", env, policy_kwargs={"pair_credit": pair_credit})


@pytest.mark.parametrize("space", [ACTIONS["continuous"], ACTIONS["categorical"]])
def test_only_binary_actions_on_neighbours_are_masked(space):
    with pytest.raises(ValueError, match="`action_mask` is for MultiBinary actions on neighbours"):
        policy(space, {**LAYOUT, "action_mask": [6, 7, 8, 9]})
    with pytest.raises(ValueError, match="acts_on_neighbours=False"):
        policy(layout={**BY_ITSELF, "action_mask": [6, 7, 8, 9]})
    for columns in ([6, 7, 8], [6, 7, 8, 10]):
        with pytest.raises(ValueError, match="each from 0 to 9"):
            policy(layout={**LAYOUT, "action_mask": columns})


def test_spaces_that_do_not_fit_are_refused():
    for space in (spaces.MultiBinary(N * 3), spaces.MultiDiscrete([3, 3, 3, 2] * N)):
        with pytest.raises(ValueError, match=r"act on 4 neighbours, but .* cannot be split into as many equal parts"):
            policy(space)
    with pytest.raises(ValueError, match=r"net_arch=\[\]: PairPolicy needs at least one hidden layer"):
        policy(net_arch=[])
    with pytest.raises(ValueError, match="agent_0 and agent_4 have different spaces: use MlpPolicy"):
        policy(spaces.MultiDiscrete([3] * 4 * (N - 1) + [2] * 4))


def test_parameters_that_are_put_in_place_are_used():
    critic = policy(n_critics=2).critic
    obs, actions = batch(policy())
    zeros = {name: th.zeros_like(parameter) for name, parameter in critic.named_parameters()}
    assert not th.func.functional_call(critic, zeros, (obs, actions)).any()
    for index in range(2):  # a network in another's place
        critic.modules_of_nets[index] = deepcopy(critic.modules_of_nets[0])
    first, second = critic(obs, actions)
    assert th.equal(first, second)


def test_what_is_masked_is_never_done_and_teaches_the_actor_nothing():
    masked = {**LAYOUT, "action_mask": [6, 7, 8, 9]}
    built = policy(layout=masked)
    obs, _ = batch(built)
    allowed = (obs[..., 6:10] > 0).repeat_interleave(2, dim=-1)
    assert 0.2 < allowed.float().mean() < 0.8
    logits = built.actor.logits(obs)
    assert not logits.sigmoid()[~allowed].any()
    plain = policy(layout=LAYOUT)
    plain.load_state_dict(built.state_dict())
    assert th.equal(plain.actor.logits(obs)[allowed], logits[allowed]), "what is allowed is as without a mask"
    for deterministic in (True, False):
        assert not built.actions.act(logits, deterministic=deterministic)[~allowed].any()
    gradients = th.autograd.grad((logits * ~allowed).sum(), list(built.actor.parameters()))
    assert not any(gradient.any() for gradient in gradients)
    alone = built.actor.single(0)
    assert th.equal(alone(obs[:, 0]), logits[:, 0])
