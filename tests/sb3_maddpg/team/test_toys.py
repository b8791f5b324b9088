"""Team tasks: their closed forms, and what they refuse. That agents learn them is shown in test_learning.py."""

import gymnasium
import numpy as np
import pytest

from sb3_maddpg.team import toys as team_tasks

TASKS = (*team_tasks.BINARY_TASKS, team_tasks.FollowTarget, team_tasks.OwnCategory)


class AtRandom:
    """Uniformly random actions through SB3's ``predict``."""

    def __init__(self, env: gymnasium.Env):
        self.space = env.action_space
        self.space.seed(1)  # another stream than that of the observations

    def predict(self, obs: np.ndarray, deterministic: bool):
        return np.stack([self.space.sample() for _ in obs]), None


@pytest.mark.parametrize("task", TASKS)
def test_random_actions_score_zero(task):
    env = task()
    assert env.play(AtRandom(env), n_steps=20_000) == pytest.approx(0, abs=0.03)


@pytest.mark.parametrize("task", TASKS)
def test_episodes_are_truncated_and_repeat_with_their_seed(task):
    env, other = task(episode_length=3), task(episode_length=3)
    assert np.array_equal(env.reset(seed=np.int64(5))[0], other.reset(seed=5)[0])
    env.action_space.seed(0)
    steps = [env.step(env.action_space.sample()) for _ in range(3)]
    assert [step[2:4] for step in steps] == [(False, False), (False, False), (False, True)]


@pytest.mark.parametrize("length", [0, -1, 2.5])
def test_an_episode_has_at_least_one_step(length):
    with pytest.raises(ValueError, match=f"episode_length={length} must be an integer of at least 1"):
        team_tasks.OwnBit(episode_length=length)


def test_steps_before_a_reset_and_seeds_that_are_none_are_refused():
    env = team_tasks.OwnBit()
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\)"):
        env.step(env.action_space.sample())
    with pytest.raises(ValueError, match="seed=-1 must be an integer of at least 0"):
        env.reset(seed=-1)
