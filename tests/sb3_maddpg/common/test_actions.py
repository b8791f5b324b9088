"""The joint action: encoding, what outputs mean, and whether exploration reaches the environment."""

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

from sb3_maddpg import MADDPG
from sb3_maddpg.common.actions import ActionKind, TeamActions
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import MixedActions, heads_of, joint_action_space
from toys import AGENT_SPACES, SMALL, Toy


@st.composite
def boxes(draw) -> spaces.Box:
    size = draw(st.integers(1, 3))
    numbers = st.floats(-100, 100, width=32)
    low = np.array(draw(st.lists(numbers, min_size=size, max_size=size)), np.float32)
    return spaces.Box(low, low + np.float32(draw(st.floats(0.125, 100, width=32))))


AGENTS = st.one_of(
    st.integers(1, 3).map(spaces.MultiBinary),
    st.integers(2, 5).map(spaces.Discrete),
    st.lists(st.integers(2, 4), min_size=1, max_size=3).map(spaces.MultiDiscrete),
    boxes(),
)
TEAMS = st.lists(AGENTS, min_size=1, max_size=5)
each_kind = pytest.mark.parametrize("kind", AGENT_SPACES)


def samples(agent_spaces, n: int) -> np.ndarray:
    """:return: joint actions of the environment, (n, length)"""
    space = joint_action_space(agent_spaces)
    space.seed(0)
    return np.array([space.sample() for _ in range(n)])


@settings(max_examples=60, deadline=None)
@given(TEAMS)
def test_coding_and_scaling_are_undone_by_their_inverses(agent_spaces):
    actions, joint = TeamActions(agent_spaces), samples(agent_spaces, 20)
    flat = actions.scale(joint)
    assert np.abs(flat[:, actions.is_continuous]).max(initial=0.0) <= 1 + 1e-4
    assert np.array_equal(flat[:, ~actions.is_continuous], joint[:, ~actions.is_continuous])
    assert np.allclose(actions.unscale(flat), joint, rtol=1e-4, atol=1e-4)
    encoded = actions.encode(th.as_tensor(flat))
    assert encoded.shape == (20, len(agent_spaces), actions.width)
    assert not encoded[:, ~actions.real].any()
    assert np.allclose(actions.decode(encoded).numpy(), flat, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(TEAMS, st.booleans(), st.floats(0.1, 50))
def test_what_networks_put_out_becomes_an_action_of_the_space(agent_spaces, deterministic, scale):
    actions, space = TeamActions(agent_spaces), joint_action_space(agent_spaces)
    logits = scale * th.randn(20, len(agent_spaces), actions.width)
    acted = actions.act(logits, deterministic)
    flat = actions.decode(acted)
    # Encoding what was decoded gives what critics saw
    assert th.allclose(actions.encode(flat), acted, atol=1e-6)
    joint = actions.unscale(flat.numpy())
    # A number may miss its bound by a rounding error, which predict() and the environment clip
    joint = np.clip(joint, space.low, space.high) if isinstance(space, spaces.Box) else joint
    assert all(space.contains(action.astype(space.dtype)) for action in joint)
    if isinstance(space, MixedActions):
        places = np.cumsum([len(np.ravel(part.sample())) for part in agent_spaces])[:-1]
        for part, own in zip(agent_spaces, np.split(joint[0], places), strict=True):
            own = own.astype(part.dtype)
            assert part.contains(own.reshape(part.shape) if part.shape else part.dtype.type(own[0]))


def test_codes_by_hand():
    agents = (spaces.MultiBinary(2), spaces.Box(-1, 3, (1,)), spaces.MultiDiscrete([3, 2]))
    actions = TeamActions(agents)
    flat = actions.scale(np.array([[1, 0, 2.0, 2, 1]]))
    assert flat.tolist() == [[1, 0, 0.5, 2, 1]]
    expected = [[1, 0, 0, 0, 0, 0], [0.5, 0, 0, 0, 0, 0], [0, 0, 1, 0, 1, 0]]
    assert actions.encode(th.as_tensor(flat)).tolist() == [expected]


@each_kind
def test_outputs_mean_scores_numbers_and_probabilities(kind):
    agent_spaces = AGENT_SPACES[kind]
    actions = TeamActions(agent_spaces)
    squashed = actions.squash(10 * th.randn(50, len(agent_spaces), actions.width))
    for agent, space in enumerate(agent_spaces):
        own = squashed[:, agent, actions.columns_of(agent)]
        if isinstance(space, spaces.Box):
            assert -1 <= own.min() < -0.5
            assert 0.5 < own.max() <= 1
            continue
        assert own.min() >= 0
        assert own.max() <= 1
        if not isinstance(space, spaces.MultiBinary):
            heads = own.unflatten(1, (1 if isinstance(space, spaces.Discrete) else len(space.nvec), -1))
            assert th.allclose(heads.sum(dim=-1), th.ones(50, heads.shape[1]))


@each_kind
def test_padding_changes_nothing_and_gets_no_gradient(kind):
    actions = TeamActions(AGENT_SPACES[kind])
    logits = th.randn(6, len(AGENT_SPACES[kind]), actions.width)
    padded = th.where(actions.real, logits, 1e3).requires_grad_()
    squashed = actions.squash(padded)
    assert th.equal(squashed, actions.squash(logits))
    assert th.equal(actions.act(padded), actions.act(logits))
    assert th.equal(actions.regularization(padded), actions.regularization(logits))
    assert not squashed[:, ~actions.real].any()
    assert not actions.act(padded, deterministic=False)[:, ~actions.real].any()
    (gradient,) = th.autograd.grad((squashed.square().sum() + actions.regularization(padded).sum()), padded)
    assert not gradient[:, ~actions.real].any()
    assert (gradient[:, actions.real] != 0).all()


@each_kind
def test_the_best_action_is_that_of_the_highest_score(kind):
    agent_spaces = AGENT_SPACES[kind]
    actions = TeamActions(agent_spaces, threshold=0.7)
    logits = th.randn(50, len(agent_spaces), actions.width)
    squashed, acted = actions.squash(logits), actions.act(logits)
    for agent, space in enumerate(agent_spaces):
        scores, own = (x[:, agent, actions.columns_of(agent)] for x in (squashed, acted))
        if isinstance(space, spaces.Box):
            assert th.equal(own, scores)
        elif isinstance(space, spaces.MultiBinary):
            assert th.equal(own, (scores > 0.7).float())
        else:
            n_heads = 1 if isinstance(space, spaces.Discrete) else len(space.nvec)
            scores, own = (x.unflatten(1, (n_heads, -1)) for x in (scores, own))
            assert th.equal(own, (scores == scores.amax(dim=-1, keepdim=True)).float())


@pytest.mark.parametrize("shared", [True, False])
def test_exploring_bits_are_drawn_with_their_scores(shared):
    n = 20_000
    actions = TeamActions([spaces.MultiBinary(3)] * 4, n_thresholds=1 if shared else 3)
    th.manual_seed(0)
    logits = th.randn(1, 4, 3)
    scores, bits = actions.squash(logits)[0], actions.act(logits.expand(n, -1, -1), deterministic=False)
    error = (bits.mean(dim=0) - scores).abs()
    assert (error < 4 * (scores * (1 - scores) / n).sqrt()).all()
    # With a shared threshold an agent's bits are nested, otherwise independent
    order = scores.argsort(dim=1, descending=True).expand_as(bits)
    nested = (bits.gather(2, order).diff(dim=2) <= 0).all()
    assert nested == shared
    correlation = th.corrcoef(bits.flatten(1).T)
    independent = th.ones(12, 12) - (th.block_diag(*[th.ones(3, 3)] * 4) if shared else th.eye(12))
    assert (correlation * independent).abs().max() < 0.05


def test_parts_of_an_agents_bits_may_have_thresholds_of_their_own():
    actions = TeamActions([spaces.MultiBinary(4)], n_thresholds=2)
    bits = actions.act(th.zeros(1000, 1, 4), deterministic=False)[:, 0]
    assert th.equal(bits[:, 0], bits[:, 1])
    assert th.equal(bits[:, 2], bits[:, 3])
    assert not th.equal(bits[:, 0], bits[:, 2])


def test_exploring_categories_are_drawn_with_their_probabilities():
    n = 20_000
    agent_spaces = AGENT_SPACES["heads"]
    actions = TeamActions(agent_spaces)
    th.manual_seed(0)
    logits = th.randn(1, len(agent_spaces), actions.width)
    probabilities, drawn = actions.squash(logits)[0], actions.act(logits.expand(n, -1, -1), deterministic=False)
    error = (drawn.mean(dim=0) - probabilities).abs()
    assert (error <= 4 * (probabilities * (1 - probabilities) / n).sqrt()).all()
    flat = actions.decode(drawn)
    assert (th.corrcoef(flat.T) - th.eye(4)).abs().max() < 0.05


def played(kind: str, steps: int = 1500, **kwargs) -> tuple[MADDPG, np.ndarray, np.ndarray]:
    """
    Collect without learning.

    :return: the model, what the environment was sent, and the policy's own actions there, both scaled, (steps, length)
    """
    env = TeamEnv(Toy(kind))
    arguments = {**SMALL, "buffer_size": steps, "learning_starts": 0, "gradient_steps": 0, **kwargs}
    model = MADDPG("MlpPolicy", env, **arguments).learn(steps)
    sent = np.array([np.concatenate([np.ravel(part) for part in joint.values()]) for joint in env.parallel_env.sent])
    with th.no_grad():
        best = model.policy.flat_actions(th.as_tensor(model.replay_buffer.observations[:, 0]), deterministic=True)
    return model, model.policy.actions.scale(sent), best.numpy()


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.1, (0.2, 0.05), (0.0, 0.1)])
def test_numbers_reach_the_environment_with_noise_of_the_given_size(noise):
    model, sent, best = played("continuous", exploration_noise=noise)
    first, last = np.broadcast_to(noise, 2)
    fifths = zip(np.split(sent - best, 5), np.split(np.linspace(first, last, len(sent)), 5), strict=True)
    for deviations, expected in fifths:
        assert np.mean(deviations**2) ** 0.5 == pytest.approx(np.mean(expected**2) ** 0.5, rel=0.07)
    assert np.abs((sent - best).mean(axis=0)).max() < 0.02
    assert np.allclose(np.corrcoef((sent - best).T), np.eye(6), atol=0.12)
    assert np.allclose(model.replay_buffer.actions[:, 0], sent, atol=1e-5)
    assert model.noise_std == pytest.approx(last, abs=1e-3)


def test_much_noise_is_clipped_at_the_bounds():
    model, sent, _ = played("continuous", 200, exploration_noise=5.0)
    assert np.abs(sent).max() == pytest.approx(1.0, abs=1e-6)
    assert (np.abs(sent) > 0.999).mean() > 0.7
    assert np.abs(model.replay_buffer.actions).max() == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["binary", "mixed"])
def test_bits_and_categories_reach_the_environment_as_they_are_drawn(kind):
    model, sent, best = played(kind, 1000)
    actions = model.policy.actions
    with th.no_grad():
        expected = model.actor(th.as_tensor(model.replay_buffer.observations[:, 0]))
    deviation = (actions.encode(th.as_tensor(sent)) - expected).sum(dim=0) / (expected * (1 - expected)).sum(
        dim=0
    ).sqrt()
    assert deviation[actions.discrete_columns].abs().max() < 4.5
    assert (sent != best).any(axis=0).all()
    assert np.allclose(model.replay_buffer.actions[:, 0], sent, atol=1e-5)


@pytest.mark.parametrize("kind", ["continuous", "heterogeneous"])
def test_action_noise_takes_the_place_of_exploration_noise(kind):
    length = len(joint_action_space(AGENT_SPACES[kind]).sample())
    shift = NormalActionNoise(np.full(length, 0.25), np.zeros(length))
    model, sent, best = played(kind, 100, action_noise=shift, exploration_noise=0.4)
    numbers = model.policy.actions.is_continuous
    assert np.allclose(sent[:, numbers], best[:, numbers] + 0.25, atol=1e-5)
    assert set(sent[:, ~numbers].ravel()) <= {0.0, 1.0, 2.0, 3.0}
    correlated = OrnsteinUhlenbeckActionNoise(np.zeros(length), np.full(length, 0.1), theta=1.0)
    _, sent, best = played(kind, 400, action_noise=correlated)
    noise = (sent - best)[:, numbers][:, 0]
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] > 0.7


@pytest.mark.slow
def test_warm_up_is_uniform():
    model, sent, _ = played("mixed", 2000, learning_starts=2000)
    assert np.allclose(model.replay_buffer.actions[:, 0], sent, atol=1e-5)
    sizes = [size for space in AGENT_SPACES["mixed"] for size in heads_of(space)]
    for column, size in zip(sent.T, sizes, strict=True):
        if size:
            frequencies = np.bincount(column.astype(int), minlength=size) / len(column)
            assert frequencies == pytest.approx(np.full(size, 1 / size), abs=0.05)
        else:
            assert np.quantile(column, [0, 0.25, 0.5, 0.75, 1]) == pytest.approx([-1, -0.5, 0, 0.5, 1], abs=0.08)


def test_kinds_of_actions_are_submodules():
    """So that one can be replaced, and no other list keeps the old one."""
    actions = TeamActions(AGENT_SPACES["mixed"])
    assert [child for _, child in actions.named_children()] == [actions.kinds]
    assert list(actions.kinds) == [module for module in actions.modules() if isinstance(module, ActionKind)]


@pytest.mark.parametrize("kind", [spaces.Box, MixedActions])
def test_a_number_without_a_range_is_left_as_it_is(kind):
    low, high = np.float32([0, 2, -1, 2]), np.float32([1, 2, 1, 2])
    space = spaces.Box(low, high)
    if kind is MixedActions:
        space = MixedActions([spaces.Box(low[:2], high[:2]), spaces.Box(low[2:], high[2:])])

    class Fixed(gymnasium.Env):
        observation_space, action_space = spaces.Box(-1, 1, (2, 3)), space

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.observation_space.sample(), {}

        def step(self, action):
            assert (action[[1, 3]] == 2).all()
            return self.observation_space.sample(), float(action[0]), False, False, {}

    model = MADDPG("MlpPolicy", Fixed(), **SMALL).learn(60)
    assert np.isfinite(model.policy.parameters_to_vector()).all()
    obs = Fixed.observation_space.sample()
    action, _ = model.predict(obs, deterministic=True)
    assert (action[[1, 3]] == 2).all()
    assert model.agent_policy(0).predict(obs[0])[0][1] == 2


def test_a_range_that_is_not_finite_is_refused():
    team = MixedActions([spaces.Box(-1, 1, (1,)), spaces.Box(np.float32([-3e38]), np.float32([3e38]))])
    with pytest.raises(ValueError, match=r"'agent_1' has the action space .* finite"):
        MADDPGPolicy(spaces.Box(-1, 1, (2, 3)), team, lambda _: 1e-3)
