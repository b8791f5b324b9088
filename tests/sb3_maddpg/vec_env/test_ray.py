"""Environments in other processes: the same numbers, whatever dies."""

import os
import signal

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from sb3_maddpg import MADDPG
from sb3_maddpg.checkpoints.state import digest
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.ray import RayVecEnv
from sb3_maddpg.vec_env.states import Replayable

ray = pytest.importorskip("ray")
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::ResourceWarning")


@pytest.fixture(scope="module", autouse=True)
def on_this_machine():
    """One cluster for all tests."""
    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)
    yield
    ray.shutdown()


def swarms():
    from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv

    return GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=3, preset="flight", n_robots=3, max_steps=15))


def bits():
    return DummyVecEnv([lambda: Monitor(OwnBit()) for _ in range(2)])


def replayed_bits():
    return DummyVecEnv([lambda: Replayable(Monitor(OwnBit())) for _ in range(2)])


class Together(DummyVecEnv):
    """Two shards in this process, one after the other."""

    def __init__(self, make):
        self.shards = [make(), make()]
        first = self.shards[0]
        self.envs = [None] * (2 * first.num_envs)
        self.num_envs, self.each = 2 * first.num_envs, first.num_envs
        super(DummyVecEnv, self).__init__(self.num_envs, first.observation_space, first.action_space)

    def reset(self):
        for k, shard in enumerate(self.shards):
            part = slice(k * self.each, (k + 1) * self.each)
            shard._seeds, shard._options = self._seeds[part], self._options[part]
        self._reset_seeds()
        return np.concatenate([shard.reset() for shard in self.shards])

    def step_wait(self):
        parts = np.split(self.actions, 2)
        results = [shard.step(part) for shard, part in zip(self.shards, parts, strict=True)]
        obs, rewards, dones, infos = zip(*results, strict=True)
        return np.concatenate(obs), np.concatenate(rewards), np.concatenate(dones), [i for part in infos for i in part]

    def get_attr(self, attr_name, indices=None):
        return [value for shard in self.shards for value in shard.get_attr(attr_name)][
            : len(list(self._get_indices(indices)))
        ]


def flown(env, steps: int = 50, kill_at: tuple[int, ...] = ()):
    env.seed(3)
    env.action_space.seed(0)
    seen = [env.reset()]
    for step in range(steps):
        if step in kill_at:
            shard = env._shards[step % len(env._shards)]
            os.kill(ray.get(shard._actor.__ray_call__.remote(lambda self: os.getpid())), signal.SIGKILL)
        obs, rewards, dones, infos = env.step(np.array([env.action_space.sample() for _ in range(env.num_envs)]))
        ends = [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        seen += [obs, rewards, dones, *ends]
    return seen


@pytest.mark.slow
@pytest.mark.parametrize(("make", "local"), [(swarms, swarms), (bits, replayed_bits)])
@pytest.mark.parametrize("kill_at", [(), (0, 7, 8, 21, 33, 34, 49)])
def test_what_is_seen_is_what_the_shards_would_return_here(make, local, kill_at):
    env = RayVecEnv([make, make], snapshot_every=10)
    try:
        there = flown(env, kill_at=kill_at)
    finally:
        env.close()
    here = flown(Together(local))
    assert len(there) == len(here)
    assert all(np.array_equal(one, other) for one, other in zip(there, here, strict=True))
    assert any(one.dtype == bool and one.any() for one in there), "episodes end"


class WritesIntoActions(OwnBit):
    def step(self, action):
        returned = super().step(action)
        action[:] = 0
        return returned


@pytest.mark.slow
def test_environments_may_write_into_their_actions():
    actions = np.ones((1, 9), np.int8)
    env = RayVecEnv([lambda: DummyVecEnv([WritesIntoActions])])
    try:
        env.reset()
        _, _, _, infos = env.step(actions)
    finally:
        env.close()
    assert infos[0]["metrics"] == {"task/mean_action": 1.0}
    assert actions.all()


class WritesAgain(OwnBit):
    """Observes the step in an array that it writes into again."""

    seen = np.zeros((3, 3), np.float32)

    def reset(self, **kwargs):
        super().reset(**kwargs)
        self.seen[:] = 0
        return self.seen, {}

    def step(self, action):
        _, *rest = super().step(action)
        self.seen[:] = self._steps / 100
        return self.seen, *rest


@pytest.mark.slow
def test_last_observations_are_copied_behind_wrappers_of_a_shard():
    env = RayVecEnv([lambda: VecMonitor(DummyVecEnv([WritesAgain]))])
    last = []
    try:
        env.reset()
        for _ in range(40):
            _, _, dones, infos = env.step(np.ones((1, 9), np.int8))
            last += [info["terminal_observation"][0, 0] for info, done in zip(infos, dones, strict=True) if done]
    finally:
        env.close()
    assert len(last) >= 2
    assert min(last) > 0


@pytest.mark.slow
def test_what_is_learned_is_the_same_to_the_last_bit():
    digests = []
    for env in (RayVecEnv([swarms, swarms], snapshot_every=7), Together(swarms)):
        model = MADDPG(
            "MlpPolicy", VecMonitor(env), learning_starts=60, batch_size=16, train_freq=2, buffer_size=600, seed=1
        )
        model.learn(240)
        digests.append(digest(model))
        env.close() if isinstance(env, RayVecEnv) else None
    assert digests[0] == digests[1]


@pytest.mark.slow
def test_attributes_and_methods_reach_the_environments():
    env = RayVecEnv([bits, bits], snapshot_every=5)
    try:
        assert env.num_envs == 4
        assert env.has_attr("agent_names") == DummyVecEnv([OwnBit]).has_attr("agent_names")
        assert not env.has_attr("nothing_of_the_kind")
        env.set_attr("mark", 7, indices=[1, 2])
        assert env.get_attr("mark", indices=[1, 2]) == [7, 7]
        assert env.env_is_wrapped(Monitor) == [True] * 4
        assert env.env_method("has_wrapper_attr", "mark", indices=[2]) == [True]
    finally:
        env.close()


def broken():
    raise KeyError("cannot be made")


@pytest.mark.slow
def test_a_shard_that_cannot_be_made_is_told():
    with pytest.raises(ValueError, match=r"processes died during describe\(\) of a shard.*cannot be made"):
        RayVecEnv([broken])
    with pytest.raises(ValueError, match="0 shards"):
        RayVecEnv([])
    with pytest.raises(ValueError, match="different spaces"):
        RayVecEnv([bits, swarms])
