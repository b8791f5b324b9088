"""Gymnasium's vector environments under Stable-Baselines3: the same transitions as its own DummyVecEnv."""

import warnings
from copy import deepcopy

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import (
    ClipReward,
    MaxAndSkipObservation,
    NormalizeReward,
    OrderEnforcing,
    PassiveEnvChecker,
    RecordEpisodeStatistics,
    TimeLimit,
    TransformReward,
)
from known import OTHERS, Giver, Known, check_stored, train
from pettingzoo.classic import tictactoe_v3
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
)

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from sb3_maddpg import MADDPG, check_team_env
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv, unbatch
from toys import Toy

SAME_STEP = {"autoreset_mode": AutoresetMode.SAME_STEP}


def cartpoles(num_envs: int) -> GymnasiumVecEnv:
    envs = gymnasium.make_vec("CartPole-v1", num_envs, "sync", vector_kwargs=SAME_STEP, max_episode_steps=15)
    return GymnasiumVecEnv(envs)


def test_same_transitions_as_dummy_vec_env():
    """With time limits and failures, so that both ends of an episode occur."""
    mine = cartpoles(4)
    theirs = DummyVecEnv([lambda: gymnasium.make("CartPole-v1", max_episode_steps=15) for _ in range(4)])
    mine.seed(7)
    theirs.seed(7)
    assert np.array_equal(mine.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    ends = set()
    for step in range(120):
        # Upright for a while (time limit), then pushed over (failure).
        actions = np.full(4, step % 2) if step < 60 else rng.integers(0, 2, 4) * 0
        (obs, rewards, dones, infos), (obs2, rewards2, dones2, infos2) = mine.step(actions), theirs.step(actions)
        assert np.array_equal(obs, obs2)
        assert np.array_equal(rewards, rewards2)
        assert rewards.dtype == rewards2.dtype
        assert np.array_equal(dones, dones2)
        for info, info2, done in zip(infos, infos2, dones, strict=True):
            assert info["TimeLimit.truncated"] == info2["TimeLimit.truncated"]
            assert ("terminal_observation" in info) == ("terminal_observation" in info2) == done
            if done:
                assert np.array_equal(info["terminal_observation"], info2["terminal_observation"])
                ends.add(info["TimeLimit.truncated"])
    assert ends == {True, False}


def test_trains_an_sb3_algorithm_with_episode_statistics():
    env = VecMonitor(cartpoles(4))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, seed=0)
    model.learn(512)
    assert {info["l"] for info in model.ep_info_buffer} <= set(range(1, 16))
    assert len(model.ep_info_buffer) > 10


def test_attributes_and_methods_reach_the_vector_environment():
    env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=3, scenario="curriculum"))
    assert env.get_attr("n_curriculum_levels") == [4, 4, 4]
    assert env.has_attr("n_curriculum_levels")
    assert not env.has_attr("no_such_thing")
    env.env_method("set_curriculum_level", 2)
    assert env.envs.unwrapped.task.sampler.level == 2
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    with pytest.raises(ValueError, match="concerns all 3"):
        env.env_method("set_curriculum_level", 2, indices=[0])


def test_final_info_and_reset_info_are_kept_apart():
    env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2, max_steps=3))
    env.seed(1)
    env.reset()
    for _ in range(3):
        *_, dones, infos = env.step(np.ones((2, 12), dtype=np.int8))
    assert dones.all()
    for info in infos:
        assert info["TimeLimit.truncated"]
        assert info["metrics"]["comm/request_share"] == 1.0
        assert info["terminal_observation"].shape == (4, 24)
    assert all("is_success" not in info for info in env.step(np.ones((2, 12), dtype=np.int8))[3])


def test_seeds_repeat():
    def rollout() -> np.ndarray:
        env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2, max_steps=5))
        env.seed(3)
        first = env.reset()
        return np.array([first, *(env.step(np.zeros((2, 12)))[0] for _ in range(12))])

    assert np.array_equal(rollout(), rollout())


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_refuses_other_autoreset_modes(mode):
    envs = gymnasium.make_vec("CartPole-v1", 2, "sync", vector_kwargs={"autoreset_mode": mode})
    with pytest.raises(ValueError, match="SAME_STEP"):
        GymnasiumVecEnv(envs)


def test_agrees_with_single_environments_under_sb3():
    kwargs = {"scenario": "random", "max_steps": 6}
    many = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2, **kwargs))
    single = make_vec_env("QuadSwarm-v0", n_envs=2, env_kwargs=kwargs)
    many.seed(4)
    single.seed(4)
    assert np.array_equal(many.reset(), single.reset())
    for _ in range(15):
        actions = np.ones((2, 12), dtype=np.int8)
        for mine, theirs in zip(many.step(actions)[:3], single.step(actions)[:3], strict=True):
            assert np.array_equal(mine, theirs)


def test_a_seed_of_numpy_is_a_seed():
    one, other = cartpoles(2), cartpoles(2)
    one.seed(np.int64(3))
    other.seed(3)
    assert np.array_equal(one.reset(), other.reset())


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before step\(\)"):
        cartpoles(2).step(np.zeros(2, int))


@pytest.mark.parametrize("shape", [(3, 2), (2, 12, 1), (24,), (2, 11)])
def test_actions_of_another_shape_are_refused(shape):
    env = GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=2))
    env.reset()
    with pytest.raises(ValueError, match=r"actions have shape .*2 environments .*must have shape \(2, 12\)"):
        env.step(np.zeros(shape, np.int8))


def test_actions_too_large_for_single_precision_are_refused():
    env = GymnasiumVecEnv(gymnasium.make_vec("Pendulum-v1", 2, "sync", vector_kwargs=SAME_STEP))
    env.reset()
    with pytest.raises(ValueError, match=r"action of environment 1 is \[1e\+39\]: it must be finite"):
        env.step(np.array([[0.0], [1e39]]))


def test_actions_that_are_not_finite_are_refused():
    env = GymnasiumVecEnv(gymnasium.make_vec("Pendulum-v1", 2, "sync", vector_kwargs=SAME_STEP))
    env.reset()
    with pytest.raises(ValueError, match=r"action of environment 1 is \[nan\]"):
        env.step(np.array([[0.0], [np.nan]], np.float32))


def test_what_is_no_vector_environment_is_refused():
    with pytest.raises(ValueError, match=r"not a Gymnasium VectorEnv: .*make_vec"):
        GymnasiumVecEnv(gymnasium.make("CartPole-v1"))


def test_an_episode_that_ends_without_its_last_observation_is_refused():
    env = cartpoles(2)
    step = env.envs.step
    env.envs.step = lambda actions: (*step(actions)[:4], {})
    env.reset()
    with pytest.raises(ValueError, match=r"without info\['final_obs'\]"):
        [env.step(np.zeros(2, int)) for _ in range(20)]


def test_one_pettingzoo_environment_cannot_be_stepped_twice():
    env = Toy("binary")
    for envs in (DummyVecEnv([lambda: TeamEnv(env)] * 2), make_vec_env(TeamEnv, 2, env_kwargs={"env": env})):
        with pytest.raises(ValueError, match=r"Environments 0 and 1 step the same .*: create one for each"):
            MADDPG("MlpPolicy", envs)
    MADDPG("MlpPolicy", DummyVecEnv([lambda: TeamEnv(Toy("binary"))] * 2))


def test_no_environment_of_another_kind_is_stepped_twice():
    turns, own = tictactoe_v3.env(), OwnBit()
    for envs in (
        DummyVecEnv([lambda: TeamEnv(turns)] * 2),
        GymnasiumVecEnv(SyncVectorEnv([lambda: OrderEnforcing(own)] * 2, **SAME_STEP)),
    ):
        with pytest.raises(
            ValueError, match=r"Environments 0 and 1 step the same environment, .*: create one for each"
        ):
            MADDPG("MlpPolicy", envs)


def test_environments_of_different_teams_are_refused():
    envs = DummyVecEnv([lambda: TeamEnv(Toy("binary")), lambda: TeamEnv(renamed(Toy("binary")))])
    with pytest.raises(ValueError, match="Environments 0 and 1 are of different teams"):
        MADDPG("MlpPolicy", envs)


def renamed(env: Toy) -> Toy:
    env.possible_agents = env.possible_agents[::-1]
    return env


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (gymnasium.wrappers.NormalizeObservation, "changes the observations of the team.*action masks"),
        (gymnasium.wrappers.NormalizeReward, "NormalizeReward changes only the team's reward"),
        (lambda env: gymnasium.wrappers.TransformReward(env, np.negative), "TransformReward changes only the team's"),
    ],
)
def test_wrappers_that_would_have_no_effect_are_refused(wrap, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", wrap(TeamEnv(Toy("binary"))))
    MADDPG("MlpPolicy", gymnasium.wrappers.TimeLimit(TeamEnv(Toy("binary")), 5))


SMALL = {"learning_starts": 20, "batch_size": 16, "train_freq": 10, "buffer_size": 1000, "seed": 0}


class Shaped(gymnasium.Wrapper):
    """The most common style of changing a reward."""

    def step(self, action):
        obs, reward, *rest = self.env.step(action)
        return obs, reward - 0.5, *rest


class ShapedVec(VecEnvWrapper):
    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        return obs, rewards - 0.5, dones, infos


def toy():
    return TeamEnv(Toy("categorical"))


def of_one_kind(env: str):
    """Module-level, so that other processes can import them."""
    make = {"toy": toy, "own": OwnBit, "swarm": lambda: gymnasium.make("QuadSwarm-v0", n_robots=3, max_steps=5)}[env]
    return make


@pytest.mark.parametrize("of", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (Shaped, "team's reward of environment 0 arrived as"),
        (
            lambda env: ClipReward(env, -0.1, 0.1),
            "changes only the team's reward|team's reward of environment 0 arrived",
        ),
        (lambda env: TransformReward(env, lambda reward: 7 * reward), "only the team's reward|team's reward of env"),
        (NormalizeReward, "changes only the team's reward|team's reward of environment 0 arrived"),
        (lambda env: MaxAndSkipObservation(env, skip=4), "team's reward of environment 0 arrived as"),
    ],
)
@pytest.mark.parametrize("env", ["toy", "own"])
def test_rewards_that_a_wrapper_changed_arrive_or_are_refused(env, wrap, message, of):
    kwargs = {"start_method": "fork"} if of is SubprocVecEnv else {}
    make = of_one_kind(env)
    envs = of([lambda: wrap(make())], **kwargs)
    try:
        with pytest.raises(ValueError, match=message):
            MADDPG("MlpPolicy", envs, **SMALL).learn(40)
    finally:
        envs.close()


@pytest.mark.parametrize("normalized", [False, True])
def test_rewards_that_a_vec_env_wrapper_changed_are_refused(normalized):
    envs = ShapedVec(DummyVecEnv([toy]))
    if normalized:
        envs = VecNormalize(envs)
    with pytest.raises(ValueError, match="team's reward of environment 0 arrived as"):
        MADDPG("MlpPolicy", envs, **SMALL).learn(40)


def test_a_reward_that_every_agent_gets_arrives_as_it_was_changed():
    make = of_one_kind("swarm")
    model = MADDPG("MlpPolicy", Shaped(make()), **SMALL)
    model.learn(10)
    assert np.array_equal(
        model.replay_buffer.agent_rewards[:10], np.repeat(model.replay_buffer.rewards[:10], 3, 0).reshape(10, 1, 3)
    )
    assert model.replay_buffer.rewards[:10].max() < 1.3 - 0.4
    parts = {"policy_kwargs": {"pair_credit": True}}
    swarm = gymnasium.make("QuadSwarm-v0", n_robots=3, max_steps=5, observation="state+approach")
    with pytest.raises(ValueError, match="team's reward of environment 0 arrived as"):
        MADDPG("PairPolicy", Shaped(swarm), **SMALL, **parts).learn(10)


def test_a_team_s_own_way_of_adding_up_rewards_is_named():
    class Worst(OwnBit):
        named = False

        def step(self, action):
            obs, _, *ends, info = super().step(action)
            reward = float(info["agent_rewards"].min())
            return obs, reward, *ends, {**info, "team_reward": reward} if self.named else info

    MADDPG("MlpPolicy", Worst(), **SMALL).learn(40)  # in this process, it is seen what the environment gives
    with pytest.raises(ValueError, match="team's reward of environment 0 arrived as"):
        MADDPG("MlpPolicy", Shaped(Worst()), **SMALL).learn(40)
    envs = SubprocVecEnv([Worst], start_method="fork")
    try:
        with pytest.raises(ValueError, match=r"return it in info\['team_reward'\], too"):
            MADDPG("MlpPolicy", envs, **SMALL).learn(40)
        envs.set_attr("named", True)
        MADDPG("MlpPolicy", envs, **SMALL).learn(40)
    finally:
        envs.close()


class Skip(gymnasium.Wrapper):
    """Adds up rewards of two steps, of whose infos the last one remains."""

    def step(self, action):
        _, before, terminated, truncated, _ = returned = self.env.step(action)
        if terminated or truncated:
            return returned
        obs, reward, *rest = self.env.step(action)
        return obs, before + reward, *rest


class Equal(OwnBit):
    """Agents whose rewards never vary, or that only say when they end."""

    def __init__(self, rewards):
        super().__init__()
        self.rewards = rewards

    def step(self, action):
        obs, _, *ends, _ = super().step(action)
        flags = {"agent_terminated": np.array([self._steps == 3, False, False])}
        return obs, 1.0, *ends, {"agent_rewards": np.ones(3)} if self.rewards else flags


def test_steps_that_a_wrapper_skips_are_noticed_without_rewards():
    class Silent(gymnasium.Wrapper):
        def step(self, action):
            self.env.step(action)
            return self.env.step(action)

    with pytest.raises(ValueError, match="Environment 0 went from step 2 to step 4 of its episode"):
        MADDPG("MlpPolicy", Silent(toy()), **SMALL).learn(40)


@pytest.mark.parametrize("vector", [DummyVecEnv, "sync"])
@pytest.mark.parametrize(("rewards", "message"), [(True, "arrived as 2"), (False, "went from step 2 to step 4")])
def test_steps_of_any_environment_that_a_wrapper_skips_are_noticed(rewards, message, vector):
    def make():
        return Skip(Equal(rewards))

    envs = DummyVecEnv([make]) if vector is DummyVecEnv else GymnasiumVecEnv(SyncVectorEnv([make], **SAME_STEP))
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", envs, **SMALL).learn(40)


class OtherInfo(gymnasium.Wrapper):
    def step(self, action):
        return *self.env.step(action)[:4], {"mine": 1}


class SkipInfos(gymnasium.Wrapper):
    """Skips steps without a word of what happened in them."""

    def step(self, action):
        for _ in range(4):
            returned = self.env.step(action)
            if returned[2] or returned[3]:
                break
        return returned


class OtherInfoVec(VecEnvWrapper):
    def __init__(self, venv, *lost):
        super().__init__(venv)
        self.lost = lost

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        *others, infos = self.venv.step_wait()
        return *others, [{name: info[name] for name in info if name not in self.lost} for info in infos]


@pytest.mark.parametrize(
    ("make", "lost"),
    [
        (lambda: OtherInfo(toy()), "agent_active, agent_rewards, agent_terminated"),
        (lambda: OtherInfo(Equal(True)), "agent_rewards"),
        (lambda: OtherInfo(Equal(False)), "agent_terminated"),
        (lambda: SkipInfos(Sometimes()), "agent_terminated"),
    ],
)
def test_what_an_environment_says_of_agents_arrives_or_is_refused(make, lost):
    with pytest.raises(ValueError, match=f"gave {lost} in `info`, which did not arrive"):
        MADDPG("MlpPolicy", make(), **SMALL).learn(40)
    with pytest.raises(ValueError, match=f"gave {lost} in `info`, which did not arrive"):
        check_team_env(make())


class Sometimes(OwnBit):
    """Speaks of agents only when one ends."""

    def step(self, action):
        *others, _ = super().step(action)
        return *others, {"agent_terminated": np.array([True, False, False])} if self._steps == 3 else {}


@pytest.mark.parametrize("of", [DummyVecEnv, SubprocVecEnv])
def test_infos_of_a_team_arrive_from_other_processes_or_are_refused(of):
    envs = of([toy], **({"start_method": "fork"} if of is SubprocVecEnv else {}))
    try:
        with pytest.raises(ValueError, match="gave agent_rewards in `info`, which did not arrive"):
            MADDPG("MlpPolicy", OtherInfoVec(envs, "agent_rewards"), **SMALL).learn(40)
        for lost, problem in (
            ("TimeLimit.truncated", "was truncated, but its `info` has no 'TimeLimit.truncated'"),
            ("terminal_observation", r"was truncated without info\['terminal_observation'\]"),
        ):
            with pytest.raises(ValueError, match=problem):
                MADDPG("MlpPolicy", OtherInfoVec(envs, lost), **SMALL).learn(40)
    finally:
        envs.close()


class Halved(VecEnvWrapper):
    """Halves observations, the last ones of episodes as well or not."""

    def __init__(self, venv, with_lasts):
        super().__init__(venv)
        self.with_lasts = with_lasts

    def reset(self):
        return self.venv.reset() / 2

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        for k in np.flatnonzero(dones if self.with_lasts else []):
            infos[k]["terminal_observation"] = infos[k]["terminal_observation"] / 2
        return obs / 2, rewards, dones, infos


@pytest.mark.parametrize("normalized", [False, True])
def test_last_observations_are_changed_like_others(normalized):
    def halved(with_lasts):
        envs = Halved(DummyVecEnv([toy, toy]), with_lasts)
        return VecNormalize(envs, norm_reward=False) if normalized else envs

    with pytest.warns(UserWarning, match="not the last ones of episodes"):
        MADDPG("MlpPolicy", halved(False), **SMALL).learn(80)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = MADDPG("MlpPolicy", halved(True), **SMALL).learn(80)
        MADDPG("MlpPolicy", DummyVecEnv([toy, toy]), **SMALL).learn(80)
    assert np.abs(model.replay_buffer.next_observations[:40]).max() <= 0.5


class PlainSpaces(VecEnvWrapper):
    """Declares the spaces anew, with the same bounds or others."""

    def __init__(self, venv, low: float | None = None):
        seen, acts = venv.observation_space, venv.action_space
        if low is None:
            super().__init__(venv, observation_space=spaces.Box(seen.low, seen.high))
        else:
            super().__init__(venv, action_space=spaces.Box(low, 1, acts.shape))

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


def test_vectorised_wrappers_keep_the_spaces_of_a_team():
    with pytest.raises(ValueError, match="The wrappers PlainSpaces change the observations of the team"):
        MADDPG("MlpPolicy", PlainSpaces(DummyVecEnv([toy])), **SMALL)
    with pytest.raises(ValueError, match="change the actions of the team"):
        MADDPG("MlpPolicy", PlainSpaces(DummyVecEnv([lambda: TeamEnv(Toy("continuous"))]), -0.5), **SMALL)
    vector = gymnasium.wrappers.vector.RescaleAction(
        SyncVectorEnv([lambda: TeamEnv(Toy("continuous"))], **SAME_STEP), np.float32(-0.5), np.float32(0.5)
    )
    with pytest.raises(ValueError, match="change the actions of the team"):
        MADDPG("MlpPolicy", GymnasiumVecEnv(vector), **SMALL)


def test_rewards_that_are_added_up_arrive_if_agents_have_none():
    class Team(OwnBit):
        def step(self, action):
            obs, _, *ends, _ = super().step(action)
            return obs, float(self._steps), *ends, {}

    buffer = MADDPG("MlpPolicy", Skip(Team()), **SMALL).learn(40).replay_buffer
    assert buffer.agent_rewards[:4, 0].tolist() == [[3] * 3, [7] * 3, [11] * 3, [15] * 3]


def test_the_environment_s_own_words_for_other_things_are_no_hindrance():
    class Words(OwnBit):
        def step(self, action):
            obs, reward, *ends, info = super().step(action)
            return obs, reward, *ends, {**info, "team_reward": 1e9, "episode_step": 4 * self._steps}

    model = MADDPG("MlpPolicy", Words(), **SMALL).learn(40)
    assert np.allclose(model.replay_buffer.agent_rewards[:40].mean(axis=2), model.replay_buffer.rewards[:40], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda info: {"agent_rewards": ["x", "y", "z"]}, "agent_rewards.*does not hold numbers"),
        (lambda info: {"agent_rewards": np.array([1, 2, np.nan])}, "(?i)agent_1|agent_2|nan"),
    ],
)
def test_what_is_no_reward_is_named_as_such(change, message):
    class Odd(OwnBit):
        def step(self, action):
            obs, reward, *ends, info = super().step(action)
            return obs, np.nan if "nan" in message else reward, *ends, change(info)

    with pytest.raises(ValueError, match=message) as raised:
        MADDPG("MlpPolicy", Odd(), **SMALL).learn(40)
    assert "wrapper" not in str(raised.value)


class Rescaled(gymnasium.ActionWrapper):
    """Of ``Box`` actions alone, whatever the agents had."""

    def __init__(self, env):
        super().__init__(env)
        length = len(env.action_space.sample())
        self.action_space = spaces.Box(-1, 1, (length,), np.float32)

    def action(self, action):
        return np.zeros(len(action))


@pytest.mark.parametrize("of", [DummyVecEnv, SubprocVecEnv, "sync", "async"])
@pytest.mark.parametrize("kind", ["heterogeneous", "continuous", "binary"])
def test_actions_are_not_divided_among_the_agents_anew(kind, of):
    def make():
        return Rescaled(TeamEnv(Toy(kind)))

    if isinstance(of, str):
        vector = {"sync": SyncVectorEnv, "async": AsyncVectorEnv}[of]
        envs = GymnasiumVecEnv(vector([make], **SAME_STEP))
    else:
        envs = of([make], **({"start_method": "fork"} if of is SubprocVecEnv else {}))
    try:
        with pytest.raises(ValueError, match="changes the actions of the team"):
            MADDPG("MlpPolicy", envs, **SMALL)
    finally:
        envs.close()


def test_wrappers_that_change_nothing_of_a_team_train(tmp_path):
    env = TimeLimit(RecordEpisodeStatistics(OrderEnforcing(PassiveEnvChecker(toy()))), 7)
    envs = VecCheckNan(VecMonitor(DummyVecEnv([lambda: Monitor(env, str(tmp_path / "run"))])))
    model = MADDPG("MlpPolicy", envs, **SMALL).learn(40)
    assert np.allclose(model.replay_buffer.agent_rewards[:40].mean(axis=2), model.replay_buffer.rewards[:40], atol=1e-6)
    assert np.flatnonzero(model.replay_buffer.dones[:40, 0]).tolist() == [6, 13, 20, 27, 34]


class Counting(gymnasium.Env):
    """
    Observes episode and step. Everything it returns is in arrays that it writes into again, also in ``reset``.

    :param dtype: of the observation
    :param spoil: value of the observation in the third step of an episode
    """

    def __init__(self, dtype=np.float32, spoil=None):
        self.observation_space = spaces.Box(0, 200, (2, 2), dtype)
        self.action_space = spaces.MultiBinary(2)
        self.spoil, self.episode = spoil, 0
        self.obs = np.zeros((2, 2), dtype)
        self.info = {
            "agent_rewards": np.zeros(2),
            "agent_terminated": np.zeros(2, bool),
            "agent_active": np.ones(2, bool),
        }

    def look(self):
        self.obs[:] = self.episode, self.t
        if self.spoil is not None and self.t == 3:
            return np.where(self.obs < 0, 0, self.spoil)
        return self.obs

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        self.info["agent_rewards"][:] = 0
        self.info["agent_terminated"][:] = False
        self.info["agent_active"][:] = True
        return self.look(), {}

    def step(self, action):
        self.t += 1
        self.info["agent_rewards"][:] = self.t
        self.info["agent_terminated"][0] = self.t >= 6
        self.info["agent_active"][0] = self.t <= 6
        return self.look(), float(self.t), False, self.t == 7, self.info


class CountingVector(VectorEnv):
    """Several ``Counting`` in one observation array, as environments without copies have it."""

    def __init__(self, num_envs, **kwargs):
        self.envs, self.num_envs = [Counting() for _ in range(num_envs)], num_envs
        self.metadata = SAME_STEP
        self.single_observation_space, self.single_action_space = self.envs[0].observation_space, spaces.MultiBinary(2)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.obs = np.zeros((num_envs, 2, 2), np.float32)

    def reset(self, *, seed=None, options=None):
        self.obs[:] = [env.reset()[0] for env in self.envs]
        return self.obs, {}

    def step(self, actions):
        obs, rewards, _, ends, infos = zip(*[env.step(None) for env in self.envs], strict=True)
        batch = {name: np.stack([info[name] for info in infos]) for name in infos[0]}
        batch |= {
            "final_obs": np.stack(obs),
            "_final_obs": np.array(ends),
            "final_info": dict(batch),
            "_final_info": np.array(ends),
        }
        self.obs[:] = [env.reset()[0] if end else one for env, one, end in zip(self.envs, obs, ends, strict=True)]
        return self.obs, np.array(rewards), np.zeros(len(obs), bool), np.array(ends), batch


def check_counted(model, n_envs: int) -> None:
    """Every row is what ``Counting`` gave."""
    buffer, steps = model.replay_buffer, np.arange(21) % 7
    for env in range(n_envs):
        assert buffer.observations[:21, env, 0, 1].tolist() == steps.tolist()
        assert buffer.next_observations[:21, env, 0, 1].tolist() == (steps + 1).tolist()
        assert (buffer.observations[:21, env, :, 0] == buffer.next_observations[:21, env, :, 0]).all()
        assert buffer.agent_rewards[:21, env, 1].tolist() == (steps + 1).tolist()
        assert buffer.agent_terminated[:21, env, 0].tolist() == (steps >= 5).tolist()
        assert buffer.agent_active[:21, env, 0].tolist() == (steps <= 5).tolist()


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("vector", ["DummyVecEnv", "CountingVector", "SyncVectorEnv"])
def test_arrays_that_environments_write_into_again_arrive_as_they_were(vector, n_envs):
    if vector == "DummyVecEnv":
        envs = DummyVecEnv([Counting for _ in range(n_envs)])
    elif vector == "CountingVector":
        envs = GymnasiumVecEnv(CountingVector(n_envs))
    else:
        envs = GymnasiumVecEnv(SyncVectorEnv([SameButCopied] * n_envs, copy=False, **SAME_STEP))
    model = MADDPG("MlpPolicy", envs, **SMALL).learn(21 * n_envs)
    check_counted(model, n_envs)


class SameButCopied(Counting):
    """Gymnasium's vector environments themselves need environments that return copies."""

    def step(self, action):
        obs, *rest, info = super().step(action)
        return obs.copy(), *rest, deepcopy(info)


class SameButInfos(Counting):
    def step(self, action):
        *rest, info = super().step(action)
        return *rest, deepcopy(info)


@pytest.mark.parametrize("env", [Counting, SameButInfos])
def test_arrays_that_are_written_into_in_another_process_are_noticed(env):
    envs = SubprocVecEnv([env], start_method="fork")
    try:
        with pytest.raises(ValueError, match=r"writes into (an array|arrays) that it has returned"):
            MADDPG("MlpPolicy", envs, **SMALL).learn(60)
    finally:
        envs.close()


@pytest.mark.parametrize("of", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.int64])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.5, 2.0**70])
def test_integer_observations_hold_integers(value, dtype, of):
    envs = of([lambda: Counting(dtype, value)], **({"start_method": "fork"} if of is SubprocVecEnv else {}))
    try:
        with pytest.raises(ValueError, match=r"bservation of agent 0 .*is (nan|inf|1e\+300|0.5|1.18.*e.21)"):
            MADDPG("MlpPolicy", envs, **SMALL).learn(10)
    finally:
        envs.close()


@pytest.mark.parametrize("value", [300, -7, 300.0])
def test_integer_observations_do_not_wrap_around(value):
    with pytest.raises(ValueError, match=rf"observation of agent 0 is {value} in column 0, no integer of uint8"):
        MADDPG("MlpPolicy", Counting(np.uint8, value), **SMALL).learn(10)
    MADDPG("MlpPolicy", Counting(np.uint8, 7.0), **SMALL).learn(10)


class Changed(VecEnvWrapper):
    """Hands on what a function makes of a step."""

    def __init__(self, envs, change):
        super().__init__(envs)
        self.change = change

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.change(*self.venv.step_wait())


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda obs, rewards, *rest: (obs, 7 * rewards - 3, *rest), "rewards"),
        (lambda obs, *rest: (obs / 2 - 3, *rest), "observations"),
    ],
)
@pytest.mark.parametrize("norm_reward", [False, True])
def test_nothing_changes_outside_of_vec_normalize(change, what, norm_reward):
    def normalized():
        return VecNormalize(DummyVecEnv([toy, toy]), norm_reward=norm_reward)

    with pytest.raises(ValueError, match=f"outside of VecNormalize changes {what}.*put VecNormalize outermost"):
        MADDPG("MlpPolicy", Changed(normalized(), change), **SMALL).learn(40)
    MADDPG("MlpPolicy", VecMonitor(VecCheckNan(normalized())), **SMALL).learn(60)


@pytest.mark.parametrize("make", [toy, OwnBit])
@pytest.mark.parametrize("of", [DummyVecEnv, SubprocVecEnv])
def test_an_end_that_a_wrapper_drops_is_noticed(of, make):
    envs = of([make], **({"start_method": "fork"} if of is SubprocVecEnv else {}))
    changed = Changed(envs, lambda obs, rewards, dones, infos: (obs, rewards, np.zeros_like(dones), infos))
    try:
        with pytest.raises(ValueError, match="Environment 0 was reset, but a wrapper reports no end"):
            MADDPG("MlpPolicy", changed, **SMALL).learn(60)
    finally:
        envs.close()


class Endings(gymnasium.Wrapper):
    """Ends by termination of all agents; says that it was truncated, or the other way round."""

    def __init__(self, env, to_truncated):
        super().__init__(env)
        self.to_truncated = to_truncated

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        over = terminated or truncated
        if self.to_truncated:
            return obs, reward, False, over, {**info, "agent_terminated": np.full(3, over)}
        return obs, reward, over, False, info


def test_ends_are_those_that_arrive_or_are_refused():
    with pytest.raises(ValueError, match="was truncated, but all agents terminated in its last step"):
        MADDPG("MlpPolicy", Endings(OwnBit(), True), **SMALL).learn(60)
    buffer = MADDPG("MlpPolicy", Endings(OwnBit(), False), **SMALL).learn(60).replay_buffer
    assert buffer.dones[:60].sum() > 2
    assert buffer.timeouts[:60].sum() == 0


def test_attributes_reach_the_environment_behind_the_border():
    envs = DummyVecEnv([OwnBit])
    MADDPG("MlpPolicy", envs, **SMALL)
    envs.set_attr("level", 3)
    assert envs.envs[0].unwrapped.level == 3
    assert envs.envs[0].level == 3
    assert envs.get_attr("level") == [3]
    assert deepcopy(envs.envs[0]).level == 3


class OwnDummy(DummyVecEnv):
    """A subclass that steps its environments as DummyVecEnv does."""


@pytest.mark.parametrize("value", [np.nan, 300])
@pytest.mark.parametrize("of", [OwnDummy, "sync"])
def test_integer_observations_are_checked_in_all_that_is_stepped_here(of, value):
    def make():
        return Counting(np.uint8, value)

    envs = of([make]) if of is OwnDummy else GymnasiumVecEnv(SyncVectorEnv([make], **SAME_STEP))
    with pytest.raises(ValueError, match=f"observation of agent 0 is {value}.* in column 0, no integer of uint8"):
        MADDPG("MlpPolicy", envs, **SMALL).learn(10)


def test_casts_in_other_processes_are_warned_of():
    envs = GymnasiumVecEnv(AsyncVectorEnv([lambda: Counting(np.uint8)], **SAME_STEP))
    try:
        with pytest.warns(UserWarning, match="AsyncVectorEnv casts observations to uint8"):
            MADDPG("MlpPolicy", envs, **SMALL)
    finally:
        envs.close()


class GoesOn(Counting):
    """Each episode begins where the last one ended."""

    def look(self):
        return np.full((2, 2), getattr(self, "steps", 0) % 200, np.float32)

    def step(self, action):
        self.steps = getattr(self, "steps", 0) + 1
        return super().step(action)


def test_episodes_may_begin_where_the_last_one_ended():
    buffer = MADDPG("MlpPolicy", GoesOn(), **SMALL).learn(60).replay_buffer
    assert buffer.observations[:60, 0, 0, 0].tolist() == list(range(60))
    assert buffer.next_observations[:60, 0, 0, 0].tolist() == list(range(1, 61))


def changed(slot, change) -> Known:
    """The known team, one part of whose returned values is something else."""
    return Known(Giver(slot, change))


@pytest.mark.parametrize(
    ("slot", "change", "message"),
    [
        ("obs", lambda obs: obs[0], r"has shape \(3,\), but its space is Box"),
        ("obs", lambda obs: np.ma.array(obs, mask=obs == 2), "must hold real numbers"),
        ("obs", lambda obs: obs.astype("datetime64[s]"), "must hold real numbers"),
        ("obs", lambda obs: obs * 1j, "must hold real numbers"),
        ("obs", lambda obs: None, "is None: it must hold real numbers"),
        ("reward", lambda reward: np.array([[reward]]), r"returned the reward array\(.*it must be a number"),
        ("reward", lambda reward: reward + 1j, "returned the reward .*it must be a number"),
        ("reward", lambda reward: 10**400, "returned the reward 1000.*it must be a number"),
        ("terminated", str, "terminated='False'.*must be True or False"),
        ("terminated", lambda ends: np.nan, "terminated=nan.*must be True or False"),
        ("truncated", lambda ends: np.array([ends, ends]), "truncated=array.*must be True or False"),
        ("truncated", lambda ends: None, "truncated=None.*must be True or False"),
        ("info", list, "must return five values, observation, reward, terminated, truncated, and a dict of infos"),
    ],
)
def test_what_environments_must_not_return_is_refused(slot, change, message):
    for env in (changed(slot, change), DummyVecEnv([lambda: Monitor(changed(slot, change))])):
        with pytest.raises(ValueError, match=message):
            train(env)


@pytest.mark.parametrize("slot", ["obs", "reward", "truncated", "agent_rewards", "agent_truncated", "metrics"])
@pytest.mark.parametrize("change", [np.array, lambda value: np.asarray(value).tolist(), th.as_tensor])
@pytest.mark.parametrize("together", [DummyVecEnv, SyncVectorEnv])
def test_environments_may_write_into_the_same_arrays_lists_and_tensors(slot, change, together):
    kept, change = {}, dict if slot == "metrics" else change
    makers = [lambda k=k: Known(Giver(slot, change, "shared", kept), first=OTHERS * k) for k in range(2)]
    env = DummyVecEnv(makers) if together is DummyVecEnv else GymnasiumVecEnv(SyncVectorEnv(makers, **SAME_STEP))
    check_stored(train(env), firsts=(0, OTHERS))


class Rewritten(VecEnvWrapper):
    """A wrapper that changes what ``step`` returned: observations, rewards, dones and infos, in a list."""

    def __init__(self, venv, change):
        super().__init__(venv)
        self.change = change

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        returned = list(self.venv.step_wait())
        self.change(returned)
        return tuple(returned)


def put(index, change):
    def put_into(returned):
        returned[index] = change(returned[index])

    return put_into


def lose_terminal_observations(returned):
    for info in returned[3]:
        info.pop("terminal_observation", None)


def turn_terminal_observations(returned):
    for info in returned[3]:
        if "terminal_observation" in info:
            info["terminal_observation"] = info["terminal_observation"].T


@pytest.mark.parametrize("normalizes", [False, True])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(0, lambda obs: obs.tolist()), r"returned the observations \[\["),
        (put(1, lambda rewards: rewards[:, None]), "returned the rewards array"),
        (put(2, lambda dones: dones * 0.5), "returned the dones array.*must be True or False"),
        (put(2, lambda dones: dones.tolist()), "returned the dones "),
        (put(3, lambda infos: infos[1:]), r"returned the infos \[\]: they must be a list of 1 dict"),
        (put(3, lambda infos: None), "returned the infos None"),
        (lose_terminal_observations, r"was truncated without info\['terminal_observation'\]"),
    ],
)
def test_what_vectorised_environments_must_not_return_is_refused(change, message, normalizes):
    env = Rewritten(DummyVecEnv([lambda: changed("", None)]), change)
    with pytest.raises(ValueError, match=message):
        train(VecNormalize(env, norm_obs=False) if normalizes else env)


def test_a_last_observation_of_another_shape_is_refused():
    env = Rewritten(DummyVecEnv([lambda: changed("", None)]), turn_terminal_observations)
    with pytest.raises(ValueError, match=r"'terminal_observation'\] of environment 0 has shape \(3, 2\)"):
        train(env)


@pytest.mark.parametrize("normalizes", [False, True])
def test_dones_may_be_integers(normalizes):
    env = Rewritten(DummyVecEnv([lambda: changed("", None)]), put(2, lambda dones: dones.astype(int)))
    check_stored(train(VecNormalize(env) if normalizes else env))


def test_names_of_infos_need_not_be_text():
    assert unbatch({1: np.array([2.0, 3.0]), "_1": np.array([True, False])}, 2) == [{1: 2.0}, {}]
