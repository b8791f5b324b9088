"""The algorithm: one update against a plain reference, who learns from what, logs, repeatability, bad input."""

import copy
import json
import re
import zipfile
from contextlib import suppress

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from reference import SGD, assert_close, assert_moved, drawn, updated
from sb3_maddpg import IDDPG, MADDPG, MATD3
from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer
from sb3_maddpg.common.callbacks import MetricsCallback
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.toys import BINARY_TASKS, FollowTarget, OwnBit
from toys import SMALL, Neighbours, Toy

NAN, INF = float("nan"), float("inf")


def learned(env="OwnBit-v0", steps: int = 120, **kwargs) -> MADDPG:
    return MADDPG("MlpPolicy", env, **{**SMALL, **kwargs}).learn(steps)


def parameters(model: MADDPG) -> np.ndarray:
    return model.policy.parameters_to_vector()


@pytest.mark.slow
def test_processes_train_the_same_parameters():
    models = []
    for vec_env_cls in (DummyVecEnv, SubprocVecEnv):
        arguments = {"entry": "mpe2.simple_reference_v3", "max_cycles": 10}
        env = make_vec_env(parallel.make, 2, env_kwargs=arguments, vec_env_cls=vec_env_cls, seed=0)
        try:
            models.append(learned(env))
        finally:
            env.close()
    assert models[0].num_timesteps == 120
    assert np.array_equal(*map(parameters, models))


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("kind", ["heterogeneous", "mixed"])
def test_runs_with_every_estimator(estimator, kind):
    before = MADDPG("MlpPolicy", TeamEnv(Toy(kind)), **SMALL)
    after = learned(TeamEnv(Toy(kind)), estimator=estimator, temperature=lambda left: 0.5 + left)
    assert np.isfinite(parameters(after)).all()
    for name in ("actor", "critic", "actor_target", "critic_target"):
        old, new = getattr(before.policy, name).parameters(), getattr(after.policy, name).parameters()
        assert all(not th.equal(a, b) for a, b in zip(old, new, strict=True))


@pytest.mark.parametrize(
    ("priced", "n_steps", "clip"), [(False, 1, None), (False, 3, 0.05), (True, 1, 0.05), (True, 3, None)]
)
@pytest.mark.parametrize("kind", ["binary", "continuous", "categorical", "heterogeneous"])
def test_one_update_is_that_of_separate_agents(kind, clip, n_steps, priced):
    lr, tau, weight = 0.1, 0.3, 0.02
    env = TeamEnv(Toy(kind))
    if priced:
        env.action_cost = 0.7
    model = learned(
        env,
        60,
        learning_rate=lr,
        tau=tau,
        gamma=0.9,
        n_steps=n_steps,
        use_action_cost=priced,
        max_grad_norm=clip,
        policy_regularization=weight,
        policy_kwargs=SGD,
    )
    old = copy.deepcopy(model.policy)
    data = drawn(model, 32)
    model.train(1, batch_size=32)
    shape = (old.team.n_agents, old.actions.width)
    cost = np.full(shape, 0.7) if priced else None
    critic, actor = updated(old, data, old.actor_target.act(data.next_observations), lr, clip, weight, cost)
    assert_close(model.critic, critic)
    assert_close(model.actor, actor)
    assert_moved(model.critic_target, model.critic, old.critic_target, tau)
    assert_moved(model.actor_target, model.actor, old.actor_target, tau)


def test_a_price_is_on_the_scale_of_normalised_rewards():
    env = TeamEnv(Toy("heterogeneous"))
    env.action_cost = 0.7
    vec_env = VecNormalize(DummyVecEnv([lambda: env]))
    numbers = {"learning_rate": 0.1, "gamma": 0.9, "max_grad_norm": None, "policy_kwargs": SGD}
    model = learned(vec_env, 60, use_action_cost=True, **numbers)
    scale = np.sqrt(vec_env.ret_rms.var + vec_env.epsilon)
    assert abs(scale - 1) > 0.05
    old, data = copy.deepcopy(model.policy), drawn(model, 32)
    model.train(1, batch_size=32)
    cost = np.full((old.team.n_agents, old.actions.width), 0.7 / scale)
    reference = updated(old, data, old.actor_target.act(data.next_observations), 0.1, None, 1e-3, cost)
    assert_close(model.critic, reference[0])
    assert_close(model.actor, reference[1])


class Recorder(KVWriter):
    """Keeps every log dump."""

    def __init__(self):
        self.dumps: list[dict] = []

    def write(self, key_values, key_excluded, step=0):
        self.dumps.append(dict(key_values))

    def close(self):
        pass


def logged(env, steps: int) -> list[dict]:
    model, recorder = MADDPG("MlpPolicy", env, **SMALL), Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(steps, log_interval=1)
    return recorder.dumps


def test_logs_what_a_user_wants_to_see():
    last = logged("OwnBit-v0", 60)[-1]
    train = {"actor_loss", "critic_loss", "n_updates", "learning_rate", "probability_mean", "probability_std"}
    train |= {f"q_value/agent_{agent}" for agent in range(3)}
    assert {f"train/{name}" for name in train} | {"rollout/ep_rew_mean", "task/mean_action"} <= last.keys()
    assert 0.0 <= last["train/probability_mean"] <= 1.0
    assert last["train/learning_rate"] == 1e-2
    assert "train/exploration_noise" not in last
    last = logged("FollowTarget-v0", 60)[-1]
    assert "train/probability_mean" not in last
    assert last["train/exploration_noise"] == 0.1


def test_metrics_are_means_over_the_steps_since_the_last_log():
    class Counting(OwnBit):
        def step(self, action):
            *rest, info = super().step(action)
            info["metrics"] = {"task/step": self._steps} if self._steps != 5 else {}
            return *rest, info

    assert [dump["task/step"] for dump in logged(Counting(), 30)] == pytest.approx([(sum(range(1, 11)) - 5) / 9] * 3)


def test_learning_in_two_parts_is_learning_in_one():
    whole = learned(steps=200)
    parts = learned(steps=100).learn(100, reset_num_timesteps=False)
    assert parts.num_timesteps == 200
    assert np.array_equal(parameters(whole), parameters(parts))


def test_arguments_are_left_as_they_are():
    """A second model of another team can be made with the same ones."""
    policy_kwargs, buffer_kwargs = {"net_arch": [8], "pair_credit": True}, {}
    for n_agents in (3, 4):
        arguments = {"policy_kwargs": policy_kwargs, "replay_buffer_kwargs": buffer_kwargs}
        model = MADDPG("PairPolicy", Neighbours(n_agents), **{**SMALL, **arguments})
        assert model.policy.team.n_agents == n_agents
        assert model.replay_buffer.n_pairs == n_agents - 1
    assert policy_kwargs == {"net_arch": [8], "pair_credit": True}
    assert buffer_kwargs == {}


def test_tasks_are_proper_environments():
    for task in (*BINARY_TASKS, FollowTarget):
        check_env(task(), warn=False)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"estimator": "expectd"}, "Unknown estimator 'expectd': did you mean 'expected'"),
        ({"action_noise": NormalActionNoise(np.zeros(9), np.ones(9))}, "Leave it out: binary actions explore"),
        ({"max_grad_norm": 0.0}, "max_grad_norm=0.0 must be positive"),
        ({"policy_kwargs": {"threshold": 1.5}}, "threshold=1.5"),
        ({"policy_kwargs": {"n_critics": 0}}, "n_critics=0"),
        (
            {"policy_kwargs": {"lr_schedule": 3}},
            r"policy_kwargs\['lr_schedule'\] is set by .*: leave it out and pass learn",
        ),
        (
            {"policy_kwargs": {"action_space": 3}},
            r"policy_kwargs\['action_space'\] is set by the algorithm: leave it out\.",
        ),
        ({"train_freq": 2.5}, r"train_freq=2\.5 must be an integer of at least 1"),
        ({"policy_kwargs": {"agent_names": ["a", "b"]}}, "2 names, a, b, for 3 agents"),
        ({"exploration_noise": -0.1}, r"exploration_noise=-0\.1 must be a standard deviation"),
        ({"exploration_noise": (0.1, 0.2, 0.3)}, "or two of them"),
        ({"temperature": 0.0}, r"temperature=0\.0 must be positive"),
        ({"n_steps": 0}, "n_steps=0 must be a whole number of steps, at least 1"),
        ({"tau": "fast"}, "tau='fast' must be a number above 0 and up to 1"),
        ({"gamma": 1.5}, "gamma=1.5 must be a number between 0 and 1"),
        ({"policy_delay": 0}, "policy_delay=0 must be a number of critic updates, an integer of at least 1"),
    ],
)
def test_a_bad_argument_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", "OwnBit-v0", **kwargs)


def test_rollouts_of_episodes_need_a_single_environment(tmp_path):
    episodes = {"train_freq": (2, "episode"), **{key: SMALL[key] for key in ("learning_starts", "batch_size")}}
    message = r'train_freq=\(2, "episode"\) needs a single environment, but there are 2: pass a number of steps'
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", make_vec_env("OwnBit-v0", 2), **episodes)
    model = MADDPG("MlpPolicy", "OwnBit-v0", **episodes)
    with pytest.raises(ValueError, match=message):
        model.set_env(make_vec_env("OwnBit-v0", 2))
    assert model.n_envs == 1
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        MADDPG.load(tmp_path / "model", env=make_vec_env("OwnBit-v0", 2))
    assert model.learn(40).num_timesteps == 40


def test_a_cost_of_another_shape_is_refused():
    env = OwnBit()
    env.action_cost = np.ones((3, 2))
    with pytest.raises(ValueError, match=r"shape \(3, 2\) cannot be broadcast to \(n_agents, width\) = \(3, 3\)"):
        MADDPG("MlpPolicy", env, use_action_cost=True)


@pytest.mark.parametrize("wrong", [NAN, 1e39, "x", [[1.0], [1.0, 2.0]], np.full((3, 3), 1j)])
def test_a_cost_that_is_no_number_is_refused(wrong):
    env = OwnBit()
    env.action_cost = wrong
    with pytest.raises(ValueError, match=r"action_cost=.* must be a finite number, .* width\) = \(3, 3\)"):
        MADDPG("MlpPolicy", env, use_action_cost=True)


def test_an_environment_with_a_wrong_cost_is_not_set():
    env = OwnBit()
    env.action_cost = 0.4
    model = MADDPG("MlpPolicy", env, use_action_cost=True)
    before = model.get_env()
    for wrong, message in ((None, "no attribute `action_cost`"), (NAN, "action_cost=nan"), (np.ones(2), "broadcast")):
        other = OwnBit()
        other.action_cost = wrong
        with pytest.raises(ValueError, match=message):
            model.set_env(other)
        assert model.get_env() is before
        assert (model.action_cost, model.cost.price.unique().tolist()) == (0.4, [np.float32(0.4)])


def test_a_cost_is_known_only_if_wanted():
    env = OwnBit()
    env.action_cost = 0.4
    assert MADDPG("MlpPolicy", env).action_cost is None
    with pytest.raises(ValueError, match="no attribute `action_cost`"):
        MADDPG("MlpPolicy", OwnBit(), use_action_cost=True)


class Misshapen(gymnasium.Env):
    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


@pytest.mark.parametrize(
    ("observation_space", "action_space", "message"),
    [
        (spaces.Box(-1, 1, (6,)), spaces.MultiBinary(6), r"shape \(n_agents, obs_dim\).*stack"),
        (spaces.Discrete(4), spaces.MultiBinary(6), r"not Discrete\(4\)"),
        (spaces.Box(-1, 1, (4, 3)), spaces.MultiBinary(6), "6 numbers.*4 agents"),
        (spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary((2, 3)), r"MultiBinary\(\(2, 3\)\).*flatten"),
        (spaces.Box(-1, 1, (2, 3)), spaces.Discrete(4), r"A team action is a flat.*not Discrete\(4\)"),
    ],
)
def test_spaces_that_are_no_team_are_refused(observation_space, action_space, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", Misshapen(observation_space, action_space))


def test_stacked_frames_are_refused():
    env = VecFrameStack(DummyVecEnv([OwnBit]), 2)
    with pytest.raises(ValueError, match=r"supersuit\.frame_stack_v2"):
        MADDPG("MlpPolicy", env)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learning_rate", INF), ("learning_rate", -1), ("buffer_size", -5), ("batch_size", 0), ("gradient_steps", -5),
        ("policy_delay", 1.5), ("n_steps", 2.5), ("tau", 0), ("gamma", NAN), ("policy_regularization", NAN),
        ("max_grad_norm", NAN), ("temperature", NAN), ("exploration_noise", (0.1, NAN)), ("train_freq", 0),
        ("threshold_price", (1e-300, 1.0)), ("threshold_price", (1.0, INF)), ("threshold_price", (1.0, 1.0)),
        ("action_noise", 0.1), ("learning_starts", -1), ("train_freq", (1, "x")),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_refused_in_one_line(name, value):
    with pytest.raises(ValueError, match=rf"^{name}={re.escape(repr(value))} must be .*\.$") as refused:
        MADDPG("MlpPolicy", "OwnBit-v0", **{name: value})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"buffer_size": 100, "batch_size": 101}, r"batch_size=101 is larger than buffer_size=100.*Lower batch_size"),
        ({"buffer_size": 100, "batch_size": 10, "n_steps": 101}, "n_steps=101 is more than buffer_size=100 stores"),
        ({"policy_kwargs": {"net_arhc": [8]}}, "Unknown argument in policy_kwargs 'net_arhc': did you mean 'net_arch'"),
        ({"policy_kwargs": {"net_arch": [0]}}, r"net_arch=\[0\] must be a list of widths"),
        ({"policy_kwargs": {"net_arch": {"pi": [8]}}}, r"net_arch=.* must be a list of widths"),
        ({"policy_kwargs": {"random_thresholds": NAN}}, "random_thresholds=nan must be a fraction above 0"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", "OwnBit-v0", **kwargs)


def test_schedules_end_with_the_training_even_if_its_last_rollout_does_not():
    seen: list[float] = []

    def temperature(progress: float) -> float:
        seen.append(progress)
        return 1.0

    env = TeamEnv(Toy("heterogeneous"))
    numbers = {"exploration_noise": (0.5, 0.0), "learning_rate": lambda progress: 1e-3 * progress}
    model = learned(env, 70, **numbers, train_freq=50, temperature=temperature, estimator="gumbel_softmax")
    assert model.num_timesteps == 100
    assert model.noise_std == 0.0
    assert seen[-1] == 0.0
    assert model.actor.optimizer.param_groups[0]["lr"] == 0.0


@pytest.mark.parametrize(("name", "least"), [("learning_rate", "0"), ("temperature", "1e-06")])
@pytest.mark.parametrize("wrong", [NAN, INF, -1.0, "x", None])
def test_schedules_return_what_numbers_may_be(name, least, wrong):
    message = rf"schedule {name}=.* returned {wrong!r} for the remaining progress {{}}.*at least {least}"
    kwargs = {"estimator": "gumbel_softmax", "steps": 40}
    with pytest.raises(ValueError, match=message.format(r"1\.0")):
        learned(**kwargs, **{name: lambda progress: wrong})
    with pytest.raises(ValueError, match=message.format(r"0\.")):
        learned(**kwargs, **{name: lambda progress: 0.1 if progress == 1 else wrong})


@pytest.mark.parametrize(
    "noise",
    [
        NormalActionNoise(np.zeros(3), np.ones(3)),
        NormalActionNoise(np.zeros(6), np.full(6, NAN)),
        NormalActionNoise(np.zeros(6), np.full(6, -1.0)),
        NormalActionNoise(0, 1),
        VectorizedActionNoise(NormalActionNoise(np.zeros((2, 6)), np.ones((2, 6))), 2),
    ],
)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_that_cannot_be_added_to_actions_is_refused(noise, n_envs):
    env = make_vec_env(lambda: TeamEnv(Toy("continuous")), n_envs)
    with pytest.raises(ValueError, match=r"action_noise=.* 6 numbers of a joint action .*np\.full\(6, 0\.1\)"):
        MADDPG("MlpPolicy", env, action_noise=noise)


def test_noise_may_be_a_tensor():
    class Constant(NormalActionNoise):
        def __init__(self, form):
            super().__init__(np.zeros(6), np.ones(6))
            self.form = form

        def __call__(self):
            return self.form(np.full(6, 0.25, np.float32))

    models = [learned(TeamEnv(Toy("continuous")), 60, action_noise=Constant(form)) for form in (np.array, th.tensor)]
    assert np.array_equal(models[0].replay_buffer.actions, models[1].replay_buffer.actions)


def test_the_check_of_noise_leaves_the_noise_and_the_random_numbers_alone():
    env, zeros = TeamEnv(Toy("continuous")), np.zeros(6)
    plain = MADDPG("MlpPolicy", env, **SMALL)
    expected = np.random.random(3)  # noqa: NPY002 - what SB3's noise draws from
    noise = OrnsteinUhlenbeckActionNoise(zeros, zeros + 0.1)
    model = MADDPG("MlpPolicy", env, **SMALL, action_noise=noise)
    assert np.array_equal(np.random.random(3), expected)  # noqa: NPY002
    assert model.action_noise is noise
    assert not noise.noise_prev.any()
    assert np.array_equal(parameters(model), parameters(plain))


def test_noise_follows_the_number_of_environments(tmp_path):
    def make(n_envs: int):
        return make_vec_env(lambda: TeamEnv(Toy("continuous")), n_envs)

    noise = NormalActionNoise(np.zeros(6), np.full(6, 0.1))
    model = learned(make(2), 60, action_noise=noise)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=make(1))
    assert loaded.action_noise().shape == (1, 6)
    loaded.set_env(make(3))
    assert loaded.learn(60).action_noise().shape == (3, 6)


def test_a_buffer_of_one_row_without_next_observations_is_refused():
    buffer = {"replay_buffer_kwargs": {"handle_timeout_termination": False}, "optimize_memory_usage": True}
    with pytest.raises(ValueError, match="buffer_size=1 must hold two transitions of each of the 1 environment"):
        MADDPG("MlpPolicy", OwnBit(), **{**SMALL, **buffer, "buffer_size": 1, "batch_size": 1})
    assert learned(OwnBit(), 40, **buffer, buffer_size=2, batch_size=1).replay_buffer.full


def test_numbers_of_numpy_are_numbers():
    numbers = {"exploration_noise": np.float32(0.25), "batch_size": np.int64(16), "gamma": np.float32(0.5)}
    model = learned(TeamEnv(Toy("continuous")), 60, **numbers)
    assert (model.noise_std, model.batch_size, model.gamma) == (0.25, 16, 0.5)
    assert learned(TeamEnv(Toy("continuous")), 60, exploration_noise=np.array([0.5, 0.5])).noise_std == 0.5


@pytest.mark.parametrize("price", [(1e-12, 1e12), (1e-12, 1e-11), (1.0, 1.00001)])
def test_extreme_prices_stay_finite(price):
    assert np.isfinite(parameters(learned(steps=60, threshold_price=price))).all()


@pytest.mark.parametrize("clip", [None, 0.5])
def test_a_training_that_diverges_stops_and_says_whose(clip):
    class Exploding(OwnBit):
        def step(self, action):
            obs, _, *ends, info = super().step(action)
            rewards = np.float32([1e25 if self._steps == 5 else 0, 0, 0])
            return obs, float(rewards.mean()), *ends, {**info, "agent_rewards": rewards}

    message = (
        r"diverged at step \d+ \(update \d+\): the loss of the critic of agent_0 is inf\. Lower learning_rate=0.01"
    )
    with pytest.raises(ValueError, match=message):
        learned(Exploding(), max_grad_norm=clip)


def test_parameters_that_are_not_finite_stop_the_training():
    model = learned(steps=60)
    with th.no_grad():
        model.actor.net.biases[0][1] = NAN
    model.policy_delay = 10**9  # so that no loss shows it
    model._target_actions = lambda next_obs: th.zeros(len(next_obs), 3, 3)
    message = r"diverged at step 60 .*: parameter actor\.net\.biases\.0, of agent\(s\) agent_1, holds NaN"
    with pytest.raises(ValueError, match=message):
        model.train(1, batch_size=16)


def test_absent_neighbours_and_normalised_observations_exclude_each_other():
    env = VecNormalize(DummyVecEnv([Neighbours]))
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=True\) shifts the zeros .* Set norm_obs=False"):
        MADDPG("PairPolicy", env, **SMALL)
    model = MADDPG("PairPolicy", VecNormalize(DummyVecEnv([Neighbours]), norm_obs=False), **SMALL)
    before = model.get_env()
    with pytest.raises(ValueError, match="shifts the zeros"):
        model.set_env(env)
    assert model.get_env() is before
    env = Neighbours()
    env.observation_layout["complete"] = True
    MADDPG("PairPolicy", VecNormalize(DummyVecEnv([lambda: env])), **SMALL).learn(30)


def test_a_model_for_a_team_of_another_size_has_its_networks_and_arguments():
    small = MADDPG("PairPolicy", Neighbours(3), **{**SMALL, "n_steps": 3, "gamma": 0.7}).learn(60)
    large = small.resized(Neighbours(5), batch_size=8)
    assert large.policy.team.n_agents == 5
    assert (large.n_steps, large.gamma, large.batch_size, large.num_timesteps) == (3, 0.7, 8, 0)
    assert large.replay_buffer.size() == 0
    assert np.array_equal(parameters(large), parameters(small))
    assert large.critic.optimizer.state_dict()["state"][0]["step"] == small._n_updates
    large.learn(40)
    buffer = {"replay_buffer_class": PrioritizedTeamReplayBuffer, "replay_buffer_kwargs": {"alpha": 0.5}}
    prioritized = MADDPG("PairPolicy", Neighbours(3), **SMALL, **buffer)
    assert prioritized.resized(Neighbours(5)).replay_buffer.alpha == 0.5
    assert type(prioritized.resized(Neighbours(5), replay_buffer_class=None).replay_buffer) is TeamReplayBuffer
    with pytest.raises(ValueError, match="fits a single team size"):
        learned().resized(OwnBit())


def test_an_expectation_that_no_memory_holds_is_refused():
    class Wide(FollowTarget):
        """One of very many categories each."""

        def __init__(self, categories: int):
            super().__init__()
            self.action_space = spaces.MultiDiscrete([categories] * self.n_agents)

    pattern = r"each of the 3000 categories .* agent agent_0 .* batch_size=1024 .* 69 GiB .* batch_size of at most 59\."
    with pytest.raises(ValueError, match=pattern):
        MADDPG("MlpPolicy", Wide(3000))
    MADDPG("MlpPolicy", Wide(3000), batch_size=59)
    MADDPG("MlpPolicy", Wide(3000), estimator="score")


def test_a_short_training_logs_its_episodes_once():
    written = []

    class Keep(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            written.append((step, key_values.get("rollout/ep_rew_mean")))

        def close(self):
            pass

    model = MADDPG("MlpPolicy", OwnBit(episode_length=10), **SMALL)
    model.set_logger(Logger(None, [Keep()]))
    model.learn(30)
    assert [step for step, _ in written] == [30]
    assert written[0][1] is not None
    model.learn(40)  # the fourth episode ends with it
    assert [step for step, _ in written] == [30, 40]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "x"}, "Unknown policy 'x'"),
        ({"policy": 5}, "policy=5 is neither"),
        ({"env": None}, "env=None: pass an environment"),
        ({"env": object}, "is not an environment"),
        ({"device": "None"}, "device='None' must be"),
        ({"device": 1.5}, "device=1.5 must be"),
        ({"seed": 0.5}, "seed=0.5 must be"),
        ({"seed": -1}, "seed=-1 must be"),
        ({"verbose": b"x"}, "verbose=b'x' must be"),
        ({"stats_window_size": ()}, r"stats_window_size=\(\) must be"),
        ({"tensorboard_log": 2}, "tensorboard_log=2 must be"),
        ({"policy_kwargs": [1]}, r"policy_kwargs=\[1\] must be a dict"),
        ({"replay_buffer_kwargs": {1: 2}}, "replay_buffer_kwargs={1: 2} must be a dict"),
        ({"replay_buffer_kwargs": {"alpha": 1}}, "Unknown argument in replay_buffer_kwargs 'alpha'"),
        ({"replay_buffer_kwargs": {"optimize_memory_usage": True}}, "Unknown argument in replay_buffer_kwargs"),
        ({"replay_buffer_kwargs": {"n_steps": 3}}, "'n_steps'. is an argument of the algorithm"),
        ({"replay_buffer_class": 2}, "replay_buffer_class=2 is not a class"),
        ({"estimator": {}}, "Unknown estimator '{}'"),
        ({"policy_kwargs": {"activation_fn": 0.5}}, "activation_fn=0.5 must be a class of torch.nn"),
        ({"policy_kwargs": {"optimizer_class": int}}, "optimizer_class=<class 'int'> must be a class of torch.optim"),
        (
            {"policy_kwargs": {"optimizer_class": th.optim.LBFGS}},
            "neither LBFGS, which needs a closure, nor SparseAdam",
        ),
        ({"policy_kwargs": {"optimizer_kwargs": 5}}, "optimizer_kwargs=5 must be a dict"),
        ({"policy_kwargs": {"optimizer_kwargs": {"x": 1}}}, "cannot be passed to Adam: .*'x'"),
        ({"policy_kwargs": {"share_actor": 0.5}}, "share_actor=0.5 must be True, False or a list of lists of agents"),
        (
            {"policy_kwargs": {"share_critic": "all"}},
            "share_critic='all' must be True, False or .*may also be \"team\"",
        ),
        ({"policy_kwargs": {"agent_names": 5}}, "agent_names=5 must be a list of names"),
        ({"policy_kwargs": {"n_critics": 10**400}}, r"n_critics=10* \.\.\. 0* is too large: it must be less than"),
        ({"policy_kwargs": {"n_critics": 10**9}}, "the networks need more memory"),
        ({"policy_kwargs": {"net_arch": [10**7, 10**7]}}, "the networks need more memory"),
        ({"buffer_size": 10**18}, "buffer_size=1000000000000000000 or the networks need more memory"),
        ({"buffer_size": 10**400}, r"buffer_size=10* \.\.\. 0* is too large: it must be less than 2\*\*63"),
        ({"train_freq": 10**400}, r"train_freq=10* \.\.\. 0* is too large"),
        ({"gradient_steps": 10**5000}, "gradient_steps=<int> is too large"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True drops"),
        ({"replay_buffer_kwargs": {"handle_timeout_termination": 5}}, "handle_timeout_termination=5 must be"),
    ],
)
def test_arguments_of_a_wrong_type_are_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        MADDPG(**{"policy": "MlpPolicy", "env": "OwnBit-v0", **SMALL, **arguments})


@pytest.mark.parametrize(
    "arguments",
    [
        {"total_timesteps": "x"},
        {"total_timesteps": np.nan},
        {"total_timesteps": 1e300},
        {"callback": 2},
        {"callback": MetricsCallback},
        {"log_interval": 0},
        {"log_interval": -1},
    ],
)
def test_learn_names_an_argument_of_a_wrong_type(arguments):
    model = MADDPG("MlpPolicy", "OwnBit-v0", **SMALL)
    with pytest.raises(ValueError, match=f"{next(iter(arguments))}=.* must be"):
        model.learn(**{"total_timesteps": 10, **arguments})


def test_steps_and_folders_may_come_in_other_types(tmp_path):
    model = MADDPG("MlpPolicy", "OwnBit-v0", **SMALL, tensorboard_log=tmp_path)
    assert model.learn("25", log_interval="1").num_timesteps == 25
    assert model.tensorboard_log == str(tmp_path)
    model.save(tmp_path / "model")
    assert MADDPG.load(tmp_path / "model").num_timesteps == 25


class Clock(OwnBit):
    """Observes the number of its episode and the step; fails, or is stopped, where it is told to."""

    fail_at: tuple[str, int] | None = None

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 1000, (3, 2), np.float32)
        self.episode, self.calls = 0, 0

    def look(self):
        return np.tile(np.float32([self.episode, self._steps]), (3, 1))

    def reset(self, **kwargs):
        super().reset(**kwargs)
        self.fail("reset")
        self.episode += 1
        return self.look(), {}

    def step(self, action):
        self.fail("before")
        _, *rest = super().step(action)
        self.calls += 1
        self.fail("after")
        return self.look(), *rest

    def fail(self, where):
        if self.fail_at == (where, self.calls):
            self.fail_at = None
            raise RuntimeError("fails once")


class StopAt(BaseCallback):
    """Ends the training in a step, by returning False or by raising."""

    def __init__(self, at, error=None):
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self):
        if self.num_timesteps < self.at:
            return True
        if self.error is not None:
            raise self.error
        return False


@pytest.mark.parametrize("optimize_memory_usage", [False, True])
@pytest.mark.parametrize(
    ("callback", "fail_at"),
    [
        (StopAt(14), None),
        (StopAt(14, KeyError("key")), None),
        (StopAt(14, KeyboardInterrupt()), None),
        (StopTrainingOnMaxEpisodes(1), None),
        (None, ("before", 14)),
        (None, ("after", 14)),
        (None, ("reset", 10)),
    ],
)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_an_episode_that_was_broken_off_leaves_no_transition(callback, fail_at, n_envs, optimize_memory_usage):
    envs = DummyVecEnv([Clock for _ in range(n_envs)])
    arguments = {**SMALL, "learning_starts": 1000}
    if optimize_memory_usage:
        arguments |= {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    model = MADDPG("MlpPolicy", envs, **arguments)
    envs.envs[0].unwrapped.fail_at = fail_at
    with suppress(RuntimeError, KeyError, KeyboardInterrupt):
        model.learn(60, callback=callback)
    model.learn(60, reset_num_timesteps=False)
    buffer = model.replay_buffer
    rows = np.arange(buffer.size() - 1)
    now = buffer.observations[rows, :, 0]
    then = buffer.observations[rows + 1, :, 0] if optimize_memory_usage else buffer.next_observations[rows, :, 0]
    goes_on = (now[..., 0] == then[..., 0]) & (now[..., 1] + 1 == then[..., 1])
    if optimize_memory_usage:
        goes_on |= buffer.dones[rows] > 0
    assert goes_on.all()
    assert len(rows) >= 50 / n_envs


def test_a_training_that_was_not_broken_off_goes_on_in_its_episode():
    env = Clock()
    model = MADDPG("MlpPolicy", env, **{**SMALL, "learning_starts": 1000}).learn(15)
    model.learn(15, reset_num_timesteps=False)
    before, after = model.replay_buffer.next_observations[14, 0, 0], model.replay_buffer.observations[15, 0, 0]
    assert before.tolist() == after.tolist()
    assert before[1] == 5


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_pytorch_s_default_of_double_precision_changes_nothing(estimator, tmp_path):
    models = []
    for default in (th.float32, th.float64):
        th.set_default_dtype(default)
        try:
            model = learned(Toy("mixed"), 60, estimator=estimator)
            robot = model.agent_policy(0)
            robot.export(tmp_path / "robot.pt")
            model.save(tmp_path / "model")
            loaded = MADDPG.load(tmp_path / "model")
            obs = np.zeros(model.observation_space.shape)
            assert np.array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
            models.append((parameters(model), robot.predict(np.zeros(robot.obs_dim))[0]))
            assert th.get_default_dtype() is default
        finally:
            th.set_default_dtype(th.float32)
    (parameters_32, action_32), (parameters_64, action_64) = models
    assert parameters_64.dtype == np.float32
    assert np.array_equal(parameters_32, parameters_64)
    assert np.array_equal(action_32, action_64)


class Ends(ParallelEnv):
    """
    Agent a leaves in step 3, b in step 5; the reward is 1 per step, and they see the step.

    :param a: how a ends, "terminated" or "truncated"
    :param whole: both are truncated in step 5 only
    """

    metadata = {"name": "ends"}  # noqa: RUF012

    def __init__(self, a: str, whole: bool = False):
        self.possible_agents, self.a, self.whole = ["a", "b"], a, whole

    def observation_space(self, agent):
        return spaces.Box(0, 1, (6,))

    def action_space(self, agent):
        return spaces.Discrete(1)

    def look(self, agents):
        return {agent: np.eye(6, dtype=np.float32)[self.t] for agent in agents}

    def reset(self, seed=None, options=None):
        self.agents, self.t = ["a", "b"], 0
        return self.look(self.agents), {}

    def step(self, actions):
        self.t += 1
        acted = self.agents
        last = {"a": 5 if self.whole else 3, "b": 5}
        out = {agent: self.t == last[agent] for agent in acted}
        gone = {agent: out[agent] and not self.whole and (agent == "b" or self.a == "terminated") for agent in acted}
        self.agents = [agent for agent in acted if not out[agent]]
        cut = {agent: out[agent] and not gone[agent] for agent in acted}
        return self.look(acted), dict.fromkeys(acted, 1.0), gone, cut, {}


class EndsForGymnasium(gymnasium.Wrapper):
    """The same team, told by a Gymnasium environment's infos alone, which do not say who was truncated."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        names = ("agent_rewards", "agent_terminated", "agent_active", "team_reward")
        return obs, reward, terminated, truncated, {name: info[name] for name in names}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "a", "kwargs", "expected"),
    [
        (MADDPG, "terminated", {}, 4.0951),
        (MADDPG, "truncated", {}, 4.0951),
        (MADDPG, "truncated", {"n_steps": 3}, 4.0951),
        (MADDPG, "truncated", {"replay_buffer_class": PrioritizedTeamReplayBuffer}, 4.0951),
        (MADDPG, "truncated", {"policy_kwargs": {"share_critic": "team"}}, (2.71 + 4.0951) / 2),
        (MATD3, "truncated", {"target_policy_noise": 0.0}, 4.0951),
        (IDDPG, "truncated", {}, 4.0951),
    ],
)
def test_who_goes_on_is_worth_what_it_gets(algorithm, a, kwargs, expected):
    """1 + 0.9 + ... over five steps, whether the other one terminates or is truncated after three."""
    arguments = {"gamma": 0.9, "learning_rate": 5e-3, "tau": 0.1, "learning_starts": 100, "train_freq": 2, "seed": 0}
    env = parallel.TeamEnv(Ends(a))
    env = env if algorithm is MATD3 else EndsForGymnasium(env)
    kwargs = {**kwargs, "policy_kwargs": {"net_arch": [32, 32], **kwargs.get("policy_kwargs", {})}}
    model = algorithm("MlpPolicy", env, batch_size=64, **arguments, **kwargs).learn(1600)
    obs = th.as_tensor(parallel.TeamEnv(Ends(a)).reset()[0][None])
    assert model.critic(obs, model.actor.act(obs))[0, 0, -1].item() == pytest.approx(expected, abs=0.15)


def test_a_team_that_is_truncated_as_a_whole_goes_on_as_a_whole():
    model = MADDPG("MlpPolicy", Ends("truncated", whole=True), **SMALL).learn(30)
    batch = model.replay_buffer.sample(64)
    assert batch.active is batch.next_active is batch.next_truncated is None


def test_an_agent_that_is_truncated_counts_in_its_own_target_only():
    model = MADDPG("MlpPolicy", Toy("continuous"), **SMALL)
    obs, actions = th.rand(4, 3, 4) - 0.5, th.rand(4, 3, 2) - 0.5
    truncated = th.tensor([[0.0, 1, 0], [0, 0, 0], [1, 1, 0], [0, 0, 0]])
    found = model._next_q_values(obs, actions, truncated, ActionCost())
    for row in range(4):
        for agent in range(3):
            keeps = 1 - truncated[row]
            keeps[agent] = 1
            alone = model.critic_target(obs[[row]], actions[[row]] * keeps[None, :, None])[0, 0, agent]
            assert found[row, agent].item() == pytest.approx(alone.item(), abs=1e-6)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_an_evaluation_in_the_training_environment_leaves_no_transition(n_steps):
    model = MADDPG("MlpPolicy", Clock(), **{**SMALL, "learning_starts": 1000}, n_steps=n_steps).learn(15)
    evaluate_policy(model, model.get_env(), 1, warn=False)
    model.learn(15, reset_num_timesteps=False)
    buffer = model.replay_buffer
    now, then = buffer.observations[:30, 0, 0], buffer.next_observations[:30, 0, 0]
    assert (now + np.float32([0, 1]) == then).all()
    assert then[14, 1] == 5
    assert now[15, 1] == 0
    if n_steps > 1:
        assert buffer.cuts[14, 0] == 1


class Rounds(gymnasium.Env):
    """Observations tell episode and step."""

    observation_space = spaces.Box(0, 1e6, (2, 2), np.float32)
    action_space = spaces.MultiBinary(2)
    episode = 0

    def observe(self):
        return np.array([[self.episode, self.steps]] * 2, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        return self.observe(), 1.0, False, self.steps == 7, {}


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("use", ["evaluate", "reset", "step", "vec_env", "nothing"])
def test_environments_used_between_two_trainings_leave_no_transition(use, n_envs):
    envs = [Rounds() for _ in range(n_envs)]
    vec_env = DummyVecEnv([lambda env=env: env for env in envs])
    model = MADDPG("MlpPolicy", envs[0] if n_envs == 1 else vec_env, **{**SMALL, "learning_starts": 1000})
    model.learn(10 * n_envs)
    if use == "evaluate":
        evaluate_policy(model, envs[-1], 1, warn=False)
    elif use == "reset":
        envs[-1].reset()
    elif use == "step":
        envs[-1].step(np.zeros(2, np.int8))
    elif use == "vec_env":
        model.get_env().step(np.zeros((n_envs, 2), np.int8))
    model.learn(10 * n_envs, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert (buffer.observations[:20, :, 0] + np.float32([0, 1]) == buffer.next_observations[:20, :, 0]).all()
    goes_on = np.array_equal(buffer.next_observations[9], buffer.observations[10])
    assert goes_on == (use == "nothing"), "an episode goes on unless somebody else has taken part"


@pytest.mark.parametrize("make", [Rounds, lambda: Toy("categorical"), lambda: TeamEnv(Toy("categorical"))])
def test_evaluations_take_an_environment_of_their_own(make):
    env = make()
    evaluated = TeamEnv(env) if isinstance(env, ParallelEnv) else env
    callback = CallbackList([EveryNTimesteps(50, EvalCallback(evaluated, verbose=0))])
    model = MADDPG("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match="EvalCallback evaluates the model in the environment that it is trained in"):
        model.learn(20, callback=callback)
    other = make()
    model.learn(20, callback=EvalCallback(TeamEnv(other) if isinstance(other, ParallelEnv) else other, eval_freq=9))


def test_a_callback_that_resets_the_training_environment_is_refused():
    class Evaluate(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 14:
                evaluate_policy(self.model, self.training_env, 1, warn=False)
            return True

    with pytest.raises(ValueError, match="callback has reset the training environment"):
        MADDPG("MlpPolicy", Clock()).learn(60, callback=Evaluate())


def test_a_callback_that_sets_another_environment_is_refused():
    class Replace(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 14:
                self.model.set_env(Clock())
            return True

    with pytest.raises(ValueError, match="callback has reset the training environment"):
        MADDPG("MlpPolicy", Clock()).learn(60, callback=Replace())


def test_seeds_for_the_next_reset_do_not_end_an_episode():
    model = MADDPG("MlpPolicy", Clock(), **{**SMALL, "learning_starts": 1000}).learn(15)
    model.get_env().seed(5)
    model.learn(15, reset_num_timesteps=False)
    before, after = model.replay_buffer.next_observations[14, 0, 0], model.replay_buffer.observations[15, 0, 0]
    assert before.tolist() == after.tolist()
    assert before[1] == 5


def test_a_replay_buffer_whose_neighbours_change_is_not_that_of_others_that_do_not(tmp_path):
    model = MADDPG("MlpPolicy", OwnBit(), learning_starts=20, batch_size=8, buffer_size=60).learn(40)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    with zipfile.ZipFile(tmp_path / "buffer.pkl") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    state = json.loads(members["buffer.json"])
    state["arguments"]["pairs_end"] = True
    with zipfile.ZipFile(tmp_path / "other.pkl", "w") as archive:
        for name, content in {**members, "buffer.json": json.dumps(state)}.items():
            archive.writestr(name, content)
    with pytest.raises(ValueError, match="holds neighbours that change: True, but the model needs"):
        model.load_replay_buffer(tmp_path / "other.pkl")
