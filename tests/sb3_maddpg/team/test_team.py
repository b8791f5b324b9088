"""Spaces of a team: what they hold, what survives Stable-Baselines3's wrappers, and how a team is read out of them."""

import copy
import pickle
import warnings

import numpy as np
import pytest
from gymnasium import spaces
from mpe2 import simple_speaker_listener_v4, simple_tag_v3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import MixedActions, TeamObservation, heads_of, joint_action_space
from sb3_maddpg.team.team import Team

LONG = spaces.Box(np.array([1.0, -2.0, 0.0]), np.array([3.0, -1.0, 4.0]), dtype=np.float64)
SHORT = spaces.Box(-5.0, 5.0, (2,), np.float32)
MIXED = (
    spaces.Discrete(4, start=2),
    spaces.Box(-2.0, 1.0, (2,), np.float64),
    spaces.MultiBinary((2, 2)),
    spaces.MultiDiscrete([3, 5], start=[1, -1]),
)


def test_rows_are_padded_and_the_state_follows_row_after_row():
    space = TeamObservation({"a": LONG, "b": SHORT}, state=spaces.Box(-9.0, 7.0, (3,)))
    assert (space.shape, space.dtype) == ((2, 5), np.float32)
    assert (space.obs_dims, space.obs_dim, space.state_dim) == ((3, 2), 3, 3)
    # Zero, which stands for an agent that is gone, is within bounds that leave it out; padding is zero
    assert space.low.tolist() == [[0, -2, 0, -9, -9], [-5, -5, 0, -9, 0]]
    assert space.high.tolist() == [[3, 0, 4, 7, 7], [5, 5, 0, 7, 0]]
    assert space.contains(np.zeros((2, 5), np.float32))
    assert not TeamObservation({"a": LONG, "b": SHORT}).contains(np.ones((2, 3), np.float32))


def test_spaces_in_double_precision_are_taken_without_a_warning():
    huge = spaces.Box(-1e300, 1e300, (2,), np.float64)
    thirds = spaces.Box(-1 / 3, 1 / 3, (2,), np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isinf(TeamObservation({"a": huge, "b": thirds}, state=huge).high[0]).all()
        MixedActions([thirds, spaces.Discrete(2)])
        joint = joint_action_space([thirds, thirds])
        Team.from_spaces(spaces.Box(-1, 1, (2, 3)), spaces.Box(-1 / 3, 1 / 3, (4,), np.float64))
    assert joint.high.tolist() == [np.float32(1 / 3)] * 4


@pytest.mark.parametrize(
    "observations",
    [
        spaces.Dict({"a": LONG}),
        spaces.Box(np.arange(40.0), np.arange(40.0) + 1, dtype=np.float64),
        {"low": np.zeros((9, 9))},
    ],
)
def test_a_long_space_is_shown_in_one_short_line(observations):
    """Arrays print themselves in many lines."""
    with pytest.raises(InvalidEnvironmentError, match="A team observation is a Box of shape") as refused:
        Team.from_spaces(observations, spaces.MultiBinary(4))
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 600


@pytest.mark.parametrize(
    ("agent_spaces", "joint"),
    [
        ([spaces.MultiBinary(3)] * 2, spaces.MultiBinary(6)),
        ([spaces.MultiBinary((2, 2)), spaces.MultiBinary(4)], None),
        ([spaces.Discrete(3, start=1), spaces.Discrete(5)], spaces.MultiDiscrete([3, 5])),
        ([spaces.MultiDiscrete([2, 3]), spaces.MultiDiscrete([4, 5])], spaces.MultiDiscrete([2, 3, 4, 5])),
        ([spaces.Discrete(2), spaces.MultiDiscrete([7])], spaces.MultiDiscrete([2, 7])),
        (
            [spaces.Box(-1, 2, (2,)), spaces.Box(0, 3, (2,))],
            spaces.Box(np.float32([-1, -1, 0, 0]), np.float32([2, 2, 3, 3])),
        ),
        # A plain Box would lose the agents' shapes and data types
        ([spaces.Box(-1, 2, (2, 1)), spaces.Box(0, 3, (2,))], None),
        ([spaces.Box(0, 9, (2,), np.int64)] * 2, None),
        ([spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (3,))], None),
        ([spaces.MultiBinary(2), spaces.MultiDiscrete([2, 2])], None),
        (MIXED, None),
    ],
)
def test_joint_action_space(agent_spaces, joint):
    assert joint_action_space(agent_spaces) == (MixedActions(agent_spaces) if joint is None else joint)
    # What comes out again acts as the agents do: counted from zero, flat
    observation = spaces.Box(-1, 1, (len(agent_spaces), 1))
    split = Team.from_spaces(observation, joint_action_space(agent_spaces)).action_spaces
    assert [heads_of(space) for space in split] == [heads_of(space) for space in agent_spaces]


def test_mixed_actions_are_uniform_in_each_agents_own_space():
    space = MixedActions(MIXED)
    assert space.low.tolist() == [0, -2, -2, 0, 0, 0, 0, 0, 0]
    assert space.high.tolist() == [3, 1, 1, 1, 1, 1, 1, 2, 4]
    space.seed(3)
    drawn = np.stack([space.sample() for _ in range(4000)])
    assert drawn.dtype == np.float32
    assert space.contains(drawn[0])
    for column, n_values in ((0, 4), (3, 2), (6, 2), (7, 3), (8, 5)):
        values, counts = np.unique(drawn[:, column], return_counts=True)
        assert values.tolist() == list(range(n_values))
        # Five standard deviations of a binomial count
        assert np.abs(counts / 4000 - 1 / n_values).max() < 5 * np.sqrt(0.25 / 4000)
    assert np.allclose(np.quantile(drawn[:, 1:3], [0.25, 0.5, 0.75]), [-1.25, -0.5, 0.25], atol=0.1)
    space.seed(3)
    assert np.array_equal(drawn[:10], [space.sample() for _ in range(10)])


def test_equality_looks_at_the_agents():
    space = TeamObservation({"a": LONG, "b": SHORT})
    assert space == TeamObservation({"a": LONG, "b": SHORT})
    assert space != TeamObservation({"a": LONG, "c": SHORT})
    # The same bounds, but the last column is padding here and an observation there
    padded = spaces.Box(np.float32([-5, -5, 0]), np.float32([5, 5, 0]))
    assert np.array_equal(space.low, TeamObservation({"a": LONG, "b": padded}).low)
    assert space != TeamObservation({"a": LONG, "b": padded})
    # A model trained on plain boxes takes a team of the same bounds, whichever side asks
    plain = spaces.Box(space.low, space.high, dtype=np.float32)
    assert (space == plain) is (plain == space) is True

    mixed = MixedActions(MIXED)
    assert mixed == MixedActions(list(MIXED))
    assert mixed != MixedActions((spaces.Discrete(4), *MIXED[1:]))
    flat = spaces.Box(mixed.low, mixed.high, dtype=np.float32)
    assert (mixed == flat) is (flat == mixed) is False


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda space: pickle.loads(pickle.dumps(space))])
def test_copies_are_whole(copied):
    observation = TeamObservation({"a": LONG, "b": SHORT}, state=SHORT)
    action = MixedActions(MIXED)
    again = copied(observation), copied(action)
    assert again == (observation, action)
    assert repr(again) == repr((observation, action))
    assert "state: 2" in repr(again)
    assert Team.from_spaces(again[0], joint_action_space(MIXED[:2])) == Team.from_spaces(
        observation, joint_action_space(MIXED[:2])
    )
    action.seed(1)
    again[1].seed(1)
    assert np.array_equal(action.sample(), again[1].sample())


@pytest.mark.slow
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_vector_environments_and_their_wrappers_keep_the_spaces(vec_env_cls):
    def make() -> TeamEnv:
        return TeamEnv(simple_speaker_listener_v4.parallel_env(continuous_actions=True), state=True)

    env = make_vec_env(make, n_envs=2, vec_env_cls=vec_env_cls, seed=0)  # a Monitor around each
    try:
        wrapped = VecNormalize(env)
        assert type(wrapped.observation_space) is TeamObservation
        assert type(wrapped.action_space) is MixedActions
        single = make()
        check_for_correct_spaces(wrapped, single.observation_space, single.action_space)
        team = Team.from_spaces(wrapped.observation_space, wrapped.action_space)
        assert (team.names, team.obs_dims, team.state_dim) == (("speaker_0", "listener_0"), (3, 11), 14)
        assert wrapped.reset().shape == (2, 2, 18)
        wrapped.step(np.stack([wrapped.action_space.sample() for _ in range(2)]))
    finally:
        env.close()


def test_agents_are_found_by_name_and_number():
    env = TeamEnv(simple_tag_v3.parallel_env())
    team = Team.from_spaces(env.observation_space, env.action_space)
    assert [team.index(agent) for agent in ("adversary_1", "agent_0", 2, np.int64(3))] == [1, 3, 2, 3]
    for wrong in ("adversary_3", "1", 4, -1):
        with pytest.raises(ValueError, match=f"no agent {wrong!r}.*adversary_0, .*or 0 to 3"):
            team.index(wrong)
    numbered = Team.from_spaces(spaces.Box(-1, 1, (3, 3)), spaces.MultiBinary(3), names=["1", "-2", "0"])
    assert [numbered.index(agent) for agent in (1, -2, np.int64(0), "1")] == [0, 1, 2, 0]
    for wrong in (2, -1, "2", 10**5000):
        with pytest.raises(ValueError, match=r"no agent .*: the agents are 1, -2, 0\."):
            numbered.index(wrong)
    plain = Team.from_spaces(spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary(4))
    assert (plain.names, plain.obs_dims, plain.obs_dim) == (("agent_0", "agent_1"), (3, 3), 3)
    assert plain.action_spaces == (spaces.MultiBinary(2),) * 2


@pytest.mark.parametrize(
    ("observation", "action", "message"),
    [
        (spaces.Dict({"a": SHORT}), spaces.MultiBinary(4), "each flattened if it is a Dict"),
        (SHORT, spaces.MultiBinary(4), r"\(n_agents, obs_dim\)"),
        (spaces.Box(-1, 1, (2, 3)), spaces.Discrete(4), "A team action is a flat"),
        (spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary((2, 2)), "A team action is a flat"),
        (spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary(5), "5 numbers cannot be divided evenly among 2"),
        (spaces.Box(-1, 1, (2, 3)), spaces.MultiDiscrete([3, 3], start=[0, 1]), r"start=\[0, 1\].*add it in step"),
        (
            spaces.Box(-1, 1, (2, 3)),
            spaces.Box(-np.inf, 1, (2,)),
            "'agent_0' has the action space .*bounds are infinite",
        ),
        (spaces.Box(-1, 1, (2, 3)), spaces.Box(-3e38, 3e38, (2,)), "'agent_0' .*too large for single precision"),
        (spaces.Box(-1, 1, (0, 3)), spaces.MultiBinary(4), "at least one agent"),
        (spaces.Box(-1, 1, (2, 0)), spaces.MultiBinary(4), "at least one column"),
        (spaces.Box(-1, 1, (2, 3)), MixedActions(MIXED), "has 4 agents, but the observation has 2 rows"),
    ],
)
def test_what_is_no_team_is_refused(observation, action, message):
    with pytest.raises(ValueError, match=message):
        Team.from_spaces(observation, action)


def test_names_that_do_not_fit_are_refused():
    given = spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary(4)
    with pytest.raises(ValueError, match="3 names, a, b, c, for 2 agents"):
        Team.from_spaces(*given, names=["a", "b", "c"])
    with pytest.raises(ValueError, match="occurs twice: a, a"):
        Team.from_spaces(*given, names=["a", "a"])


@pytest.mark.parametrize("agent", [0.5, True, None, {1: 2}, "x", -1, 9])
def test_an_agent_that_is_none_is_refused(agent):
    team = Team.from_spaces(spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary(4))
    with pytest.raises(ValueError, match="There is no agent"):
        team.index(agent)
