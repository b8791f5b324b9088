"""Per-agent rewards and ends, sums of n rewards and the storage of the replay buffer."""

import copy
import io
import pickle
from unittest.mock import patch

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer, TeamReplayBuffer
from sb3_maddpg.common.buffer_files import read_buffer, write_buffer
from sb3_maddpg.common.buffers import SumTree
from sb3_maddpg.files.archive import Archive
from sb3_maddpg.team.spaces import MixedActions
from sb3_maddpg.team.toys import OwnBit

N, D, K = 3, 2, 2
BOX = spaces.Box(-9, 9, (N, D), np.float32)


def buffer(size: int = 8, n_envs: int = 1, space: spaces.Space = BOX, **kwargs) -> TeamReplayBuffer:
    return TeamReplayBuffer(size, space, spaces.MultiBinary(N * K), device="cpu", n_envs=n_envs, **kwargs)


def add(memory: TeamReplayBuffer, index: int, reward: float = 0.0, done: bool = False, **info) -> None:
    """A transition whose observations and bits tell its index."""
    obs = np.full((1, N, D), index, np.float32)
    bits = np.array([[int(bit) for bit in f"{index:06b}"]], np.int8)
    memory.add(obs, obs + 0.5, bits, np.array([reward]), np.array([done]), [info])


def transition(memory: TeamReplayBuffer, index: int):
    return memory._get_samples(np.array([index]))


def episodes(memory: TeamReplayBuffer, *steps: dict, start: int = 0) -> None:
    """Transitions of one environment, each of which starts with the observation the one before ended with."""
    for index, step in enumerate(steps, start):
        obs = np.full((1, N, D), 10 * index, np.float32)
        reward = np.array([10.0**index])
        memory.add(obs, obs + 10, np.zeros((1, N * K), np.int8), reward, np.array([step.get("done", False)]), [step])


OUT = {"agent_active": [True, False, True]}


def test_agents_get_their_own_rewards_and_ends_or_else_the_teams():
    memory = buffer()
    add(memory, 0, 5.0, agent_rewards=np.array([1.0, 2.0, 3.0]), agent_terminated=np.array([False, True, False]))
    add(memory, 1, 5.0, done=True)
    sample = memory._get_samples(np.arange(2))
    assert sample.rewards.tolist() == [[1, 2, 3], [5, 5, 5]]
    assert sample.dones.tolist() == [[0, 1, 0], [1, 1, 1]]


@pytest.mark.parametrize(("handled", "ends"), [(True, [0.0, 1.0, 0.0]), (False, [1.0, 1.0, 1.0])])
def test_a_time_limit_ends_no_agent_but_those_that_ended_themselves(handled, ends):
    memory = buffer(handle_timeout_termination=handled)
    add(memory, 0, done=True, **{"TimeLimit.truncated": True, "agent_terminated": [False, True, False]})
    assert transition(memory, 0).dones.tolist() == [ends]


def test_rewards_stay_with_their_transition_when_the_buffer_wraps_round():
    memory = buffer(size=4)
    for index in range(6):
        add(memory, index, agent_rewards=np.array([index, 10 * index, 100 * index]))
    sample = memory.sample(64)
    assert set(sample.observations[:, 0, 0].tolist()) == {2.0, 3.0, 4.0, 5.0}
    for obs, bits, reward, next_obs in zip(
        sample.observations, sample.actions, sample.rewards, sample.next_observations, strict=True
    ):
        index = int(obs[0, 0])
        assert reward.tolist() == [index, 10 * index, 100 * index]
        assert next_obs[0, 0] == index + 0.5
        assert "".join(str(bit) for bit in bits.tolist()) == f"{index:06b}"


def test_environments_are_not_mixed_up():
    memory = buffer(size=8, n_envs=2)
    for step in range(4):
        obs = np.array([step, 100 + step], np.float32)[:, None, None] * np.ones((2, N, D), np.float32)
        infos = [{"agent_rewards": np.full(N, step)}, {"agent_rewards": np.full(N, 100 + step)}]
        memory.add(obs, obs, np.zeros((2, N * K), np.int8), np.zeros(2), np.zeros(2, bool), infos)
    sample = memory.sample(64)
    assert (sample.rewards == sample.observations[:, :, 0]).all()
    assert sample.rewards.max() >= 100 > sample.rewards.min()


def test_optimize_memory_usage_gives_the_next_observation_without_storing_it():
    memory = buffer(size=8, optimize_memory_usage=True, handle_timeout_termination=False)
    assert not hasattr(memory, "next_observations")
    for index in range(6):
        obs = np.full((1, N, D), index, np.float32)
        memory.add(obs, obs + 1, np.zeros((1, N * K), np.int8), np.array([index]), np.array([False]), [{}])
    sample = memory.sample(64)
    assert (sample.next_observations == sample.observations + 1).all()
    assert (sample.rewards == sample.observations[:, :, 0]).all()


def test_optimize_memory_usage_has_sb3s_condition():
    with pytest.raises(ValueError, match="set handle_timeout_termination=False"):
        buffer(optimize_memory_usage=True)
    kwargs = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    model = MADDPG("MlpPolicy", OwnBit(), **kwargs, buffer_size=100, learning_starts=20, train_freq=10, batch_size=16)
    assert model.learn(150).num_timesteps == 150


def test_vec_normalize_scales_the_agents_rewards_like_the_teams():
    env = VecNormalize(DummyVecEnv([OwnBit]), norm_obs=False, clip_reward=100.0)
    model = MADDPG("MlpPolicy", env, buffer_size=100, batch_size=16, learning_starts=1000).learn(60)
    raw, scaled = (model.replay_buffer._get_samples(np.arange(50), env=e).rewards for e in (None, env))
    spread = float(np.sqrt(env.ret_rms.var + env.epsilon))
    assert spread > 1.1
    assert np.allclose(scaled, raw / spread, atol=1e-5)
    assert raw.std(dim=1).max() > 0


def test_the_samples_begin_as_sb3s_and_single_steps_cost_no_masks():
    memory = buffer(gamma=0.9)
    add(memory, 0, 1e30)  # large, not infinite
    sample = memory.sample(4)
    assert sample._fields[:6] == ("observations", "actions", "next_observations", "dones", "rewards", "discounts")
    assert (sample.discounts, sample.active, sample.next_active, sample.pair_rewards) == (0.9, None, None, None)
    assert all(value.is_contiguous() for value in sample if isinstance(value, th.Tensor))


@pytest.mark.parametrize("n_steps", [1, 3])
def test_masks_appear_once_an_agent_did_not_act(n_steps):
    memory = buffer(n_steps=n_steps)
    episodes(memory, {"agent_terminated": [False, True, False]})
    assert transition(memory, 0).active is None
    episodes(memory, {"agent_active": [True, False, True], "agent_terminated": [True, False, False]}, start=1)
    first, second = transition(memory, 0), transition(memory, 1)
    assert first.active.tolist() == [[1, 1, 1]]
    assert first.next_active.tolist() == ([[1, 0, 1]] if n_steps == 1 else [[0, 0, 1]])
    assert (second.active.tolist(), second.next_active.tolist()) == ([[1, 0, 1]], [[0, 0, 1]])
    memory.reset()
    episodes(memory, {})
    assert transition(memory, 0).active is None


@pytest.mark.parametrize("kwargs", [{}, {"optimize_memory_usage": True, "handle_timeout_termination": False}])
@pytest.mark.parametrize("said", [True, False])
def test_who_was_truncated_before_the_others(kwargs, said):
    memory = buffer(**kwargs)
    cut = {"agent_truncated": [0, 1, 0]} if said else {}
    episodes(memory, {}, cut, OUT, {**OUT, "done": True}, OUT)
    batch = [transition(memory, row) for row in range(4)]
    assert batch[0].next_truncated is None
    assert batch[1].next_truncated.tolist() == [[0, 1, 0]]
    assert batch[1].active.tolist() == batch[1].next_active.tolist() == [[1, 1, 1]]
    assert [sample.next_truncated for sample in batch[2:]] == [None, None]


@pytest.mark.parametrize("n_steps", [1, 2])
@pytest.mark.parametrize("said", [True, False])
@pytest.mark.parametrize("handled", [True, False])
def test_an_agents_own_time_limit_ends_it_as_one_of_the_team_would(handled, said, n_steps):
    memory = buffer(handle_timeout_termination=handled, n_steps=n_steps)
    cut = {"agent_truncated": [0, 1, 0]} if said else {}
    episodes(memory, {}, cut, OUT, {**OUT, "done": True})
    assert transition(memory, 1).dones.tolist() == [[0, 0 if handled else 1, 0]]
    assert transition(memory, 0).dones.tolist() == [[0, 0 if handled or n_steps == 1 else 1, 0]]


@pytest.mark.parametrize(
    "steps",
    [
        ({"agent_terminated": [0, 1, 0]}, OUT),
        ({"done": True, "TimeLimit.truncated": True}, OUT),
        ({"agent_truncated": [1, 1, 1], "done": True, "TimeLimit.truncated": True}, OUT),
        ({"agent_truncated": [1, 1, 0], "agent_terminated": [0, 0, 1], "done": True}, OUT),
        (OUT, {**OUT, "agent_truncated": [0, 1, 0]}),
    ],
)
def test_nobody_was_truncated_before_the_others(steps):
    memory = buffer()
    episodes(memory, *steps)
    assert transition(memory, 0).next_truncated is None


def test_an_episode_that_is_broken_off_truncates_nobody():
    for kwargs in ({}, {"optimize_memory_usage": True, "handle_timeout_termination": False}):
        memory = buffer(**kwargs)
        episodes(memory, {})
        episodes(memory, OUT, start=5)
        assert transition(memory, 0).next_truncated is None


def test_a_time_limit_of_the_team_in_the_step_of_an_agents_own():
    memory = buffer()
    episodes(memory, {"agent_truncated": [1, 0, 0], "done": True, "TimeLimit.truncated": True})
    assert transition(memory, 0).next_truncated.tolist() == [[1, 0, 0]]


@pytest.mark.parametrize(
    ("steps", "rewards", "discounts", "dones", "end"),
    [
        ([{}] * 4, [31, 31, 31], [0.125] * N, [0, 0, 0], 30),
        ([{}, {"agent_terminated": [0, 1, 0]}, OUT, OUT], [31, 6, 31], [0.125, 0.25, 0.125], [0, 1, 0], 30),
        ([{}, {"done": True}, {}, {}], [6, 6, 6], [0.25] * N, [1, 1, 1], 20),
        ([{}, {"done": True, "TimeLimit.truncated": True}, {}], [6, 6, 6], [0.25] * N, [0, 0, 0], 20),
        # An agent that drops out alive stops all, one that was out before does not
        ([{}, {}, OUT, {}], [6, 6, 6], [0.25] * N, [0, 0, 0], 20),
        ([OUT, {}, {}, {}], [31, 1, 31], [0.125, 0.5, 0.125], [0, 0, 0], 30),
        # The newest transition
        ([{}, {}], [6, 6, 6], [0.25] * N, [0, 0, 0], 20),
    ],
)
def test_where_windows_of_three_steps_stop(steps, rewards, discounts, dones, end):
    memory = buffer(n_steps=3, gamma=0.5)
    episodes(memory, *steps)
    sample = transition(memory, 0)
    for value, wanted in ((sample.rewards, rewards), (sample.discounts, discounts), (sample.dones, dones)):
        assert value.tolist() == [wanted]
    assert (sample.next_observations == end).all()


def test_windows_wrap_round_up_to_the_newest_transition():
    memory = buffer(size=4, n_steps=3, gamma=0.5)
    episodes(memory, *[{}] * 6)
    # In rows 0 to 3: transitions 4, 5, 2, 3
    sums = [transition(memory, row).rewards[0, 0].item() for row in range(4)]
    assert sums == [1e4 + 0.5e5, 1e5, 1e2 + 0.5e3 + 0.25e4, 1e3 + 0.5e4 + 0.25e5]
    assert transition(memory, 3).next_observations[0, 0, 0] == 60


def history(rng: np.random.Generator, length: int, obs: float) -> list[dict]:
    """What happened in an environment, step by step."""
    steps = []
    for _ in range(length):
        done, jump = rng.random(2) < (0.15, 0.05)
        info = {
            "TimeLimit.truncated": bool(done and rng.random() < 0.5),
            "agent_rewards": rng.normal(size=N).astype(np.float32),
            "agent_terminated": rng.random(N) < 0.15,
            "agent_active": rng.random(N) < 0.85,
            "pair_rewards": rng.normal(size=(N, 2)),
        }
        steps.append({"obs": obs, "next_obs": obs + 1, "done": bool(done), **info})
        obs += 1 + (done or jump)
    return steps


def by_the_book(steps: list[dict], first: int, n_steps: int, gamma: float) -> list:
    """One sample out of the transitions that the buffer still holds, in the words of its documentation."""
    start = last = steps[first]
    window, summing = [start], {agent for agent in range(N) if start["agent_active"][agent]}
    for step in steps[first + 1 : first + n_steps]:
        summing -= {agent for agent in summing if last["agent_terminated"][agent]}
        if last["done"] or last["next_obs"] != step["obs"] or not all(step["agent_active"][i] for i in summing):
            break
        window.append(last := step)
    rewards, pairs, discounts, dones = np.zeros(N), np.zeros((N, 2)), np.ones(N), np.zeros(N)
    for agent in range(N):
        for step in window:
            rewards[agent] += discounts[agent] * step["agent_rewards"][agent]
            pairs[agent] += discounts[agent] * step["pair_rewards"][agent]
            discounts[agent] *= gamma
            dones[agent] = step["agent_terminated"][agent]
            if dones[agent] or not start["agent_active"][agent]:
                break
    if last["done"] and not last["TimeLimit.truncated"]:
        dones[:] = 1
    next_active = last["agent_active"] & ~last["agent_terminated"]
    return [start["obs"], last["next_obs"], dones, rewards, discounts, start["agent_active"], next_active, pairs]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 12), st.integers(1, 30), st.integers(1, 6))
def test_random_histories_give_what_the_documentation_says(seed, n_envs, rows, length, n_steps):
    rng = np.random.default_rng(seed)
    envs = [history(rng, length, 1000.0 * env) for env in range(n_envs)]
    memory = buffer(rows * n_envs, n_envs, n_steps=n_steps, gamma=0.9, n_pairs=2)
    for steps in zip(*envs, strict=True):
        obs, next_obs, done = (np.array([step[key] for step in steps]) for key in ("obs", "next_obs", "done"))
        obs, next_obs = (x[:, None, None] * np.ones((N, D)) for x in (obs, next_obs))
        memory.add(obs, next_obs, np.zeros((n_envs, N * K)), np.zeros(n_envs), done, list(steps))
    memory.all_active = False  # masks even where all happened to act
    kept = min(rows, length)
    first, env = (i.ravel() for i in np.meshgrid(np.arange(kept), np.arange(n_envs)))
    got = memory.samples_at((first + length - kept) % rows, env)
    discounts = th.full((len(env), N), got.discounts) if n_steps == 1 else got.discounts
    values = (got.observations[:, 0, 0], got.next_observations[:, 0, 0], got.dones, got.rewards, discounts)
    for index, (row, e) in enumerate(zip(first, env, strict=True)):
        wanted = by_the_book(envs[e][length - kept :], row, n_steps, 0.9)
        for value, want in zip((*values, got.active, got.next_active, got.pair_rewards), wanted, strict=True):
            np.testing.assert_allclose(value[index].numpy(), want, rtol=1e-4, atol=1e-5)


def test_rewards_are_normalised_before_they_are_summed():
    env = VecNormalize(DummyVecEnv([OwnBit]), norm_obs=False, clip_reward=2.0)
    env.ret_rms.var = np.array(100.0)
    memory = buffer(n_steps=3, gamma=0.5, n_pairs=1)
    episodes(memory, *[{"pair_rewards": np.full((N, 1), 20 * index)} for index in range(3)])
    sample = memory.samples_at(np.array([0]), np.array([0]), env)
    assert np.allclose(sample.rewards, 0.1 + 0.5 * 1 + 0.25 * 2)
    assert np.allclose(sample.pair_rewards, 0 + 0.5 * 2 + 0.25 * 2)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_rewards_of_a_pair_end_with_it(n_steps):
    memory = buffer(n_steps=n_steps, gamma=0.5, n_pairs=2, pairs_end=True)
    ended = np.zeros((3, N, 2), dtype=bool)
    ended[1, 0, 0] = ended[0, 1, 1] = True  # ends of pairs by step
    infos = [{"pair_rewards": np.full((N, 2), 1.0), "pair_terminated": each} for each in ended]
    episodes(memory, *infos)
    sample = memory.samples_at(np.array([0]), np.array([0]))
    rewards, goes_on = np.full((N, 2), 1.0 if n_steps == 1 else 1.75), np.ones((N, 2))
    rewards[1, 1], goes_on[1, 1] = 1.0, 0.0
    if n_steps == 3:
        rewards[0, 0], goes_on[0, 0] = 1.5, 0.0
    assert np.allclose(sample.pair_rewards[0], rewards)
    assert np.allclose(sample.pair_goes_on[0], goes_on)
    again, _ = through_file(memory)
    assert np.array_equal(again.pair_terminated, memory.pair_terminated)


def through_pickle(memory: TeamReplayBuffer) -> tuple[TeamReplayBuffer, int]:
    data = pickle.dumps(memory)
    return pickle.loads(data), len(data)


def through_file(memory: TeamReplayBuffer) -> tuple[TeamReplayBuffer, int]:
    file = io.BytesIO()
    write_buffer(memory, file)
    with patch("pickle.loads", side_effect=AssertionError), patch("pickle.load", side_effect=AssertionError):
        return read_buffer(Archive(file, "buffer"), "cpu"), len(file.getvalue())


@pytest.mark.parametrize("kwargs", [{}, {"optimize_memory_usage": True, "handle_timeout_termination": False}])
@pytest.mark.parametrize("size", [8, 100_000])
@pytest.mark.parametrize("through", [through_pickle, through_file])
def test_a_saved_buffer_holds_what_is_filled_and_goes_on(kwargs, size, through):
    memory = buffer(size, **kwargs)
    for index in range(11):
        add(memory, index, agent_active=[True, index != 5, True])
    other, length = through(memory)
    assert length < 20_000
    for name in ("observations", "actions", "agent_rewards", "agent_active", "dones", "timeouts", "records"):
        assert np.array_equal(getattr(memory, name), getattr(other, name))
        assert np.shares_memory(getattr(other, name), other.records)
    assert (other.pos, other.full, other.all_active) == (memory.pos, memory.full, False)
    add(memory, 40, 7.0)
    add(other, 40, 7.0)
    for one, two in zip(transition(memory, other.pos - 1), transition(other, other.pos - 1), strict=True):
        assert one is two is None or np.array_equal(one, two)
    assert not np.shares_memory(copy.deepcopy(memory).records, memory.records)


def test_missing_keys_are_filled_in_environment_by_environment():
    memory = buffer(n_envs=3)
    obs = np.zeros((3, N, D), np.float32)
    infos = [{}, {"agent_rewards": [1, 2, 3], "agent_active": [True, True, False]}, {"agent_terminated": [1, 0, 0]}]
    memory.add(obs, obs, np.zeros((3, N * K)), np.array([7.0, 8.0, 9.0]), np.zeros(3), infos)
    assert memory.agent_rewards[0].tolist() == [[7] * N, [1, 2, 3], [9] * N]
    assert memory.agent_active[0].tolist() == [[1] * N, [1, 1, 0], [1] * N]
    assert memory.agent_terminated[0].tolist() == [[0] * N, [0] * N, [1, 0, 0]]


@pytest.mark.parametrize(
    ("kwargs", "info", "message"),
    [
        ({}, {"agent_rewards": np.zeros(2)}, r"info\['agent_rewards'\] has shape \(2,\).*3 agents"),
        ({}, {"agent_terminated": np.zeros(2)}, r"info\['agent_terminated'\] has shape \(2,\).*3 agents"),
        ({}, {"agent_rewards": {"agent_0": 1.0}}, r"has shape \(\), but there are 3 agents"),
        ({}, {"agent_rewards": [0.0, np.nan, 0.0]}, r"'agent_rewards'\] of agent 1 \(agent_1\) is nan.*clip the value"),
        ({}, {"reward": np.inf}, "The team's reward is inf"),
        ({}, {"agent_terminated": [0, 0.5, 0]}, r"agent_terminated'\] of agent 1 \(agent_1\) is 0.5 .*True or False"),
        ({}, {"agent_active": np.array([2, 0, 1])}, r"agent_active'\] of agent 0 .* is 2.0"),
        ({}, {"agent_truncated": [True, None, False]}, "agent_truncated'] of .*None.* does not hold numbers"),
        ({}, {"agent_truncated": [0, np.nan, 0]}, r"agent_truncated'\] of agent 1 .* is nan"),
        ({}, {"TimeLimit.truncated": 0.5}, r"TimeLimit.truncated'\] is 0.5"),
        ({}, {"done": 0.5}, r"The end of the episode is 0.5"),
        ({}, {"agent_rewards": np.ma.array([1.0, 2, 3], mask=[0, 1, 0])}, "does not hold numbers"),
        ({}, {"agent_rewards": np.array([1j, 0, 0])}, "does not hold numbers"),
        ({}, {"agent_rewards": th.ones(3, requires_grad=True)}, "does not hold numbers"),
        ({}, {"agent_rewards": np.arange(3).astype("datetime64[s]")}, "does not hold numbers"),
        ({}, {"agent_active": [[1], [1, 0], 1]}, "does not hold numbers"),
        ({"n_pairs": 2}, {}, r"'pair_rewards'\] is missing.*\(3, 2\).*leave n_pairs"),
        ({"n_pairs": 2}, {"pair_rewards": np.zeros((3, 3))}, r"shape \(3, 3\).*n_pairs=2.*\(3, 2\)"),
        ({"n_pairs": 1}, {"pair_rewards": [[0], [0], [-np.inf]]}, r"of agent 2 .* is -inf"),
        ({"n_steps": 0}, {}, "n_steps=0"),
        ({"gamma": 1.5}, {}, r"gamma=1\.5"),
        ({"n_pairs": -1}, {}, "n_pairs=-1"),
        ({"n_steps": 2, "optimize_memory_usage": True, "handle_timeout_termination": False}, {}, "Set n_steps=1"),
        ({"space": spaces.Dict()}, {}, "each flattened if it is a Dict"),
    ],
)
def test_what_cannot_be_used_is_refused(kwargs, info, message):
    with pytest.raises(ValueError, match=message):
        add(buffer(**kwargs), 0, **info)


@pytest.mark.parametrize("values", [np.full((1, N, D), 1j), np.full((1, N, D), None), np.full((1, N, D), "x")])
def test_observations_that_are_no_real_numbers_are_refused(values):
    memory = buffer()
    with pytest.raises(ValueError, match=r"The next observation is an array of .*: it must hold real numbers"):
        memory.add(np.zeros((1, N, D)), values, np.zeros((1, N * K)), np.zeros(1), np.zeros(1), [{}])
    assert memory.size() == 0


def test_an_empty_buffer_has_no_samples():
    for memory in (buffer(), prioritized()):
        with pytest.raises(ValueError, match="The replay buffer is empty: add transitions first"):
            memory.sample(4)


def prioritized(size: int = 8, n_envs: int = 1, **kwargs) -> PrioritizedTeamReplayBuffer:
    space = spaces.MultiBinary(N * K)
    return PrioritizedTeamReplayBuffer(size, BOX, space, device="cpu", n_envs=n_envs, **kwargs)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=40).filter(any), st.floats(0, 1, exclude_max=True))
def test_a_sum_tree_finds_the_number_at_a_share_of_the_total(numbers, share):
    tree = SumTree(len(numbers))
    tree.set(np.arange(len(numbers)), np.array(numbers))
    assert tree.sums[1] == pytest.approx(sum(numbers))
    (found,), (part,) = tree.find(np.array([share]))
    running = np.cumsum([0.0, *numbers])
    slack = 1e-9 * running[-1]
    assert running[found] - slack <= share * running[-1] <= running[found + 1] + slack
    assert numbers[found] > 0
    assert part == pytest.approx(numbers[found] / running[-1])


def test_what_the_critic_was_wrong_about_is_replayed_in_proportion():
    memory = prioritized(alpha=0.5, beta=1.0, epsilon=1e-9)
    for index in range(4):
        add(memory, index)
    assert np.bincount(memory.sample(400).indices).tolist() == [100, 100, 100, 100]
    memory.update_priorities(np.arange(4), np.array([1.0, 4.0, 0.0, 25.0]))
    sample = memory.sample(8000)
    assert np.bincount(sample.indices, minlength=4) == pytest.approx([1000, 2000, 0, 5000], abs=2)
    assert (sample.observations[:, 0, 0].numpy() == sample.indices).all()
    assert {index: round(float(sample.weights[sample.indices == index][0]), 3) for index in (0, 1, 3)} == {
        0: 1.0,
        1: 0.5,
        3: 0.2,
    }
    add(memory, 4)
    assert np.mean(memory.sample(1300).indices == 4) == pytest.approx(5 / 13, abs=0.01)  # like the largest so far


def test_weights_make_a_prioritized_mean_that_of_all():
    memory = prioritized(size=64, n_envs=1, alpha=0.7, beta=1.0)
    for index in range(64):
        add(memory, index % 64, float(index))
    memory.update_priorities(np.arange(64), np.arange(64.0) % 7)
    sample = memory.sample(100_000)
    mean = (sample.weights * sample.rewards[:, 0]).sum() / sample.weights.sum()
    assert float(mean) == pytest.approx(31.5, abs=0.3)


def test_priorities_are_of_the_transition_that_took_the_place_of_another():
    memory = prioritized(size=8, n_envs=2, alpha=1.0, epsilon=1e-6)
    obs = np.zeros((2, N, D), np.float32)
    for step in range(6):
        if step == 4:
            memory.update_priorities(np.arange(8), np.zeros(8))
        memory.add(obs, obs, np.zeros((2, N * K), np.int8), np.full(2, step), np.zeros(2), [{}, {}])
    assert set(memory.sample(64).rewards[:, 0].tolist()) == {4.0, 5.0}


def test_a_row_without_its_observation_is_not_replayed():
    memory = prioritized(size=4, optimize_memory_usage=True, handle_timeout_termination=False)
    for index in range(6):
        add(memory, index)
    sample = memory.sample(64)
    assert set(sample.observations[:, 0, 0].tolist()) == {3.0, 4.0, 5.0}
    memory.reset()
    add(memory, 7)
    assert set(memory.sample(8).observations[:, 0, 0].tolist()) == {7.0}


@pytest.mark.parametrize("through", [through_pickle, through_file])
def test_priorities_are_saved_with_the_buffer(through):
    memory = prioritized()
    with pytest.raises(ValueError, match="buffer is empty"):
        memory.sample(1)
    for index in range(3):
        add(memory, index)
    memory.update_priorities(np.arange(3), np.array([0.0, 9.0, 3.0]))
    add(memory, 3)
    again, _ = through(memory)
    assert np.array_equal(again.priorities.sums, memory.priorities.sums)
    set_random_seed(0)
    first = memory.sample(32).indices
    set_random_seed(0)
    assert again.sample(32).indices.tolist() == first.tolist()


def restored(memory: TeamReplayBuffer, counters: dict, **arrays: np.ndarray) -> TeamReplayBuffer:
    """:return: a buffer with the contents of another and a few others"""
    arguments, own_counters, own_arrays = memory.contents()
    again = type(memory)(**arguments, device="cpu")
    again.restore(own_counters | counters, own_arrays | arrays)
    return again


@pytest.mark.parametrize(
    ("counters", "message"),
    [
        ({"n_added": 2}, "n_added is 2, but it holds 3 rows"),
        ({"new_rows": 10**10}, "new_rows is 10000000000, but it holds 3 rows"),
        ({"largest_priority": 0.0}, r"largest_priority is 0.0: .* positive and finite sum"),
        ({"largest_priority": 1e308}, r"largest_priority is 1e\+308: .* positive and finite sum"),
    ],
)
def test_counters_that_no_buffer_has_are_refused(counters, message):
    memory = prioritized()
    for index in range(3):
        add(memory, index)
    memory.sample(2)
    assert restored(memory, {}).sample(2).weights.isfinite().all()
    with pytest.raises(ValueError, match=message):
        restored(memory, counters)
    for wrong in (0.0, 1e308):
        with pytest.raises(ValueError, match=r"priorities add up to (0\.0|inf)"):
            restored(memory, {}, priorities=np.full(3, wrong))


CHOICES = MixedActions([spaces.Discrete(3), spaces.MultiBinary(1), spaces.Box(-5, 5, (1,))])


@pytest.mark.parametrize(
    ("column", "wrong", "message"),
    [
        (0, 3, r"agent 0 \(agent_0\) lie between 0.0 and 3.0 in column 0: they must be integers from 0 to 2"),
        (0, -1, "integers from 0 to 2"),
        (0, 0.5, "integers from 0 to 2"),
        (1, 2, r"agent 1 \(agent_1\) .* integers from 0 to 1"),
        (2, 1e30, r"agent 2 \(agent_2\) .* numbers from -1 to 1"),
    ],
)
def test_actions_outside_of_their_space_are_not_restored(column, wrong, message):
    memory = TeamReplayBuffer(4, BOX, CHOICES, device="cpu")
    for action in ([0, 0, -1.0], [2, 1, 1.00001]):
        obs = np.zeros((1, N, D), np.float32)
        memory.add(obs, obs, np.array([action]), np.zeros(1), np.zeros(1), [{}])
    assert np.array_equal(restored(memory, {}).actions, memory.actions)
    actions = memory.contents()[2]["actions"].copy()
    actions[1, 0, column] = wrong
    with pytest.raises(ValueError, match=message):
        restored(memory, {}, actions=actions)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"alpha": -1.0}, r"alpha=-1.0 must be a number between 0 and 1"),
        ({"beta": 2.0}, r"beta=2.0 must be a number between 0 and 1"),
        ({"epsilon": 0.0}, r"epsilon=0.0 must be positive"),
    ],
)
def test_exponents_out_of_range_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        prioritized(**kwargs)


def test_training_sets_priorities_to_the_critics_errors():
    env = OwnBit()
    model = MADDPG(
        "MlpPolicy",
        env,
        replay_buffer_class=PrioritizedTeamReplayBuffer,
        replay_buffer_kwargs={"alpha": 1.0, "beta": 0.4},
        buffer_size=256,
        learning_starts=64,
        batch_size=64,
        train_freq=8,
        seed=0,
    )
    model.learn(512)
    memory = model.replay_buffer
    weights = memory.sample(64).weights
    leaves = memory.priorities.sums[1 << memory.priorities.depth :][:256]
    assert (leaves > 0).all()
    assert len(np.unique(leaves)) > 100
    assert 0 < float(weights.min()) < float(weights.max()) <= 1.0


@pytest.mark.parametrize("optimized", [False, True])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("what", ["observation", "next observation", "action", "agent_rewards", "pair_rewards"])
def test_nothing_that_is_not_finite_is_stored(what, wrong, optimized):
    kwargs = {"optimize_memory_usage": True, "handle_timeout_termination": False} if optimized else {}
    space = spaces.Box(-9, 9, (N, D), np.float64)
    memory = TeamReplayBuffer(4, space, spaces.MultiBinary(N * K), "cpu", n_envs=2, n_pairs=2, **kwargs)
    given = {
        "observation": np.ones((2, N, D)),
        "next observation": np.ones((2, N, D)),
        "action": np.ones((2, N * K), np.float32),
        "agent_rewards": np.ones((2, N)),
        "pair_rewards": np.ones((2, N, 2)),
    }

    def add_all() -> None:
        infos = [{key: given[key][env] for key in ("agent_rewards", "pair_rewards")} for env in range(2)]
        obs, next_obs, action = (given[name] for name in ("observation", "next observation", "action"))
        memory.add(obs, next_obs, action, np.zeros(2), np.zeros(2, bool), infos)

    for _ in range(5):
        add_all()
    before, pos = memory.records.copy(), memory.pos
    with np.errstate(over="ignore"):
        given[what].reshape(2, N, -1)[1, 2, 1 if what != "agent_rewards" else 0] = wrong
        with pytest.raises(
            ValueError, match=rf"{what}.* of agent 2 \(agent_2\) is .*in environment 1 at step 6 .*finite"
        ):
            add_all()
    assert np.array_equal(memory.records, before)
    assert (memory.pos, memory.n_added) == (pos, 5)


class Diverging(OwnBit):
    """One number of an observation is not finite: after reset(), in the middle, or the last one of the episode."""

    def __init__(self, kind: str, when: int, wrong: float):
        super().__init__(episode_length=5)
        length = self.n_agents * self.action_dim
        boxes = {"binary": self.action_space, "continuous": spaces.Box(-1, 1, (length,))}
        self.action_space = boxes.get(kind, spaces.MultiDiscrete([2] * length))
        self.when, self.wrong = when, wrong

    def spoilt(self, obs: np.ndarray) -> np.ndarray:
        if self._steps == self.when:
            obs = obs.copy()
            obs[1, 2] = self.wrong
        return obs

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        return self.spoilt(obs), info

    def step(self, action):
        obs, *rest = super().step(action)
        return self.spoilt(obs), *rest


@pytest.mark.parametrize("kind", ["binary", "categorical", "continuous"])
@pytest.mark.parametrize(
    ("when", "learning_starts", "wrong"), [(5, 4, np.nan), (2, 0, np.nan), (2, 100, np.inf), (0, 100, np.nan)]
)
def test_observations_that_are_not_finite_never_reach_the_networks(kind, when, learning_starts, wrong):
    model = MADDPG(
        "MlpPolicy", Diverging(kind, when, wrong), learning_starts=learning_starts, batch_size=4, train_freq=1, seed=0
    )
    with pytest.raises(ValueError, match=r"agent.*agent_1.*(finite|NaN or infinity)"):
        model.learn(20)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
    assert np.isfinite(model.replay_buffer.observations).all()
    assert np.isfinite(model.replay_buffer.next_observations).all()


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ({"obs": (2, N, D)}, r"observation has shape \(2, 3, 2\).* 1 environment.*must be \(1, 3, 2\)"),
        ({"next_obs": (1, 2, D)}, r"next observation has shape \(1, 2, 2\).*of 3 agents"),
        ({"action": (1, 5)}, r"action has shape \(1, 5\).*must be \(1, 6\)"),
    ],
)
def test_transitions_of_another_team_are_refused(shapes, message):
    given = {"obs": (1, N, D), "next_obs": (1, N, D), "action": (1, N * K), **shapes}
    arrays = {name: np.zeros(shape, np.float32) for name, shape in given.items()}
    with pytest.raises(ValueError, match=message):
        buffer().add(**arrays, reward=np.zeros(1), done=np.zeros(1, bool), infos=[{}])


@pytest.mark.parametrize("name", ["buffer_size", "n_envs", "n_steps"])
@pytest.mark.parametrize("wrong", [0, -5, 2.5])
def test_sizes_that_are_no_positive_integers_are_refused(name, wrong):
    kwargs = {"buffer_size": 8, name: wrong}
    with pytest.raises(ValueError, match=rf"{name}={wrong} must be an integer of at least 1"):
        TeamReplayBuffer(observation_space=BOX, action_space=spaces.MultiBinary(N * K), **kwargs)


def test_errors_of_critics_that_diverged_are_no_priorities():
    memory = prioritized()
    add(memory, 0)
    with pytest.raises(ValueError, match="critics' error is nan: the critics diverged"):
        memory.update_priorities(np.array([0]), np.array([np.nan]))
    assert memory.largest_priority == 1.0


def test_arrays_of_the_buffer_are_views_of_its_records():
    memory = buffer(n_pairs=1)
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "pair_rewards"):
        assert np.shares_memory(getattr(memory, name), memory.records), name


@pytest.mark.parametrize("name", ["alpha", "beta", "epsilon", "gamma"])
def test_priorities_and_discounts_are_numbers(name):
    for value in ("x", None, [1]):
        with pytest.raises(ValueError, match=f"{name}=.* must be "):
            PrioritizedTeamReplayBuffer(10, spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary(4), **{name: value})
