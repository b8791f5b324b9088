"""States of environments and of what wraps them. That runs go on from them is in checkpoints/test_resume.py."""

import json

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_maddpg.errors import NoStateError
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.team.spaces import MixedActions
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.states import (
    Replayable,
    load_vec_env_state,
    plain_values,
    set_plain_values,
    set_space_generators,
    space_generators,
    vec_env_state,
)


def vectorized() -> VecMonitor:
    return VecMonitor(DummyVecEnv([lambda: Monitor(Replayable(gymnasium.make("CartPole-v1")))] * 2))


def stepped(env, actions) -> list:
    return [env.step(action) for action in actions]


def test_a_state_goes_through_json_and_brings_back_the_open_episodes():
    env, actions = vectorized(), np.random.default_rng(0).integers(0, 2, (80, 2))
    env.seed(3)
    env.reset()
    stepped(env, actions[:40])
    arrays: dict = {}
    text = json.dumps(encode(vec_env_state(env), "state", arrays))
    expected = stepped(env, actions[40:])
    other = vectorized()
    other.reset()
    load_vec_env_state(other, decode(json.loads(text), "state", arrays))
    for one, two in zip(expected, stepped(other, actions[40:]), strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(one[:3], two[:3], strict=True))
        for a, b in zip(one[3], two[3], strict=True):
            assert ("episode" in a) == ("episode" in b)
            if "episode" in a:
                assert (a["episode"]["r"], a["episode"]["l"]) == (b["episode"]["r"], b["episode"]["l"])
    assert any("episode" in info for step in expected for info in step[3])


def test_a_replayable_environment_draws_episodes_from_its_seed():
    env, other = Replayable(gymnasium.make("CartPole-v1")), Replayable(gymnasium.make("CartPole-v1"))
    first = [env.reset(seed=1)[0], env.reset()[0], env.reset()[0]]
    again = [other.reset(seed=1)[0], other.reset()[0], other.reset()[0]]
    assert np.array_equal(first, again)
    assert not np.array_equal(first[1], first[2])
    fresh = Replayable(gymnasium.make("CartPole-v1"))
    fresh.load_state_dict(Replayable(gymnasium.make("CartPole-v1")).state_dict())  # before any reset


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: DummyVecEnv([OwnBit]), lambda: SubprocVecEnv([OwnBit])])
def test_says_what_tells_no_state(make):
    env = make()
    with pytest.raises(NoStateError, match=r"OwnBit has no state_dict\(\)|SubprocVecEnv runs its environments"):
        vec_env_state(env)
    env.close()


def test_a_state_of_other_wrappers_is_refused():
    env = vectorized()
    env.reset()
    with pytest.raises(ValueError, match="The state belongs to a VecMonitor, but this is a DummyVecEnv"):
        load_vec_env_state(env.venv, vec_env_state(env))


def test_plain_values_are_those_that_can_be_written():
    callback = EvalCallback(DummyVecEnv([OwnBit]))
    values = plain_values(callback)
    assert {"best_mean_reward", "n_calls", "evaluations_results", "eval_freq"} <= set(values)
    assert not {"eval_env", "callback", "locals", "logger", "model"} & set(values)


def test_where_files_are_written_is_no_state(tmp_path):
    before = EvalCallback(DummyVecEnv([OwnBit]), log_path=str(tmp_path), best_model_save_path=str(tmp_path))
    values = plain_values(before)
    moved = EvalCallback(DummyVecEnv([OwnBit]), log_path="moved", best_model_save_path="moved")
    paths = {"log_path": "elsewhere", "best_model_save_path": "elsewhere"}  # as in older checkpoints
    set_plain_values(moved, {**values, **paths, "n_calls": 7})
    assert (moved.log_path, moved.best_model_save_path, moved.n_calls) == ("moved/evaluations", "moved", 7)


@pytest.mark.parametrize(
    ("name", "value"),
    [("on_step", "x"), ("_on_training_end", None), ("logger", 1), ("training_env", 2), ("n_calls", "x")],
)
def test_plain_values_replace_neither_methods_nor_values_of_another_kind(name, value):
    callback = EvalCallback(DummyVecEnv([OwnBit]))
    before = vars(callback).copy()
    if name in ("logger", "training_env"):  # saved elsewhere
        set_plain_values(callback, {name: value})
    else:
        with pytest.raises(ValueError, match=rf"{value!r} cannot be the {name} of a EvalCallback"):
            set_plain_values(callback, {name: value})
    assert vars(callback) == before


def test_values_that_training_sets_later_or_that_were_none_are_restored():
    callback = EvalCallback(DummyVecEnv([OwnBit]))
    set_plain_values(callback, {"set_later": 3, "log_path": "x", "parent": None, "best_mean_reward": np.float64(1)})
    assert (callback.set_later, callback.best_mean_reward) == (3, 1)


def test_generators_of_spaces_and_of_their_parts_go_on():
    space, other = (MixedActions([spaces.Discrete(9), spaces.Box(-1, 1, (3,))]) for _ in range(2))
    assert space_generators(space) == [None, None, None]
    space.seed(0)
    space.sample()
    states = space_generators(space)
    expected = space.sample()
    set_space_generators(other, states)
    assert np.array_equal(other.sample(), expected)


@pytest.mark.parametrize(
    ("bits", "name", "value"),
    [
        (np.random.PCG64, "has_uint32", 2),
        (np.random.PCG64, "bit_generator", "MT19937"),
        (np.random.MT19937, "pos", 2**31 - 700),
        (np.random.MT19937, "pos", 625),
        (np.random.MT19937, "pos", -5),
        (np.random.Philox, "buffer_pos", -(2**30)),
        (np.random.Philox, "buffer_pos", 5),
        (np.random.SFC64, "uinteger", 2**32),
    ],
)
def test_states_of_generators_that_numpy_would_not_check_are_refused(bits, name, value):
    space = spaces.Discrete(3)
    space._np_random = np.random.Generator(bits(5))
    (state,) = space_generators(space)
    expected = [space.sample() for _ in range(5)]
    set_space_generators(space, [state])
    assert [space.sample() for _ in range(5)] == expected
    (state["state"] if name in state["state"] else state)[name] = value
    with pytest.raises(ValueError, match=f"not a state of the random number generator {bits.__name__}"):
        set_space_generators(space, [state])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("generator", {"bit_generator": "MT19937"}, "not a state of the random number generator PCG64"),
        ("seed", -1, "No episode begins with seed=-1"),
        ("seed", 1e30, "No episode begins with seed=1e"),
        ("options", [1], r"options=\[1\]"),
        ("actions", np.zeros((3, 5), np.int8), "are no actions of MultiBinary"),
        ("actions", [[0, 1]], "are no actions of MultiBinary"),
        ("actions", np.zeros((10**6, 9), np.int8), "has 1000000 actions, but its episode ends before"),
    ],
)
def test_a_replay_that_no_episode_has_is_refused(name, value, message):
    env = Replayable(OwnBit())
    env.reset(seed=1)
    env.step(np.zeros(9, np.int8))
    state = env.state_dict()
    Replayable(OwnBit()).load_state_dict(state)
    with pytest.raises(ValueError, match=message):
        Replayable(OwnBit()).load_state_dict({**state, name: value})


@pytest.mark.parametrize("value", [10**30, -(2**63), True, "1", None])
def test_a_counter_is_an_integer_that_fits_into_memory(value):
    callback = EvalCallback(DummyVecEnv([OwnBit]))
    with pytest.raises(ValueError, match="cannot be the n_eval_episodes of a EvalCallback"):
        set_plain_values(callback, {"n_eval_episodes": value})
