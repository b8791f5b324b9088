"""The algorithm: every kind of environment, one update against a plain reference, logs, repeatability, bad input."""

import copy

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_maddpg import MADDPG
from sb3_maddpg.estimators import ESTIMATORS
from sb3_maddpg.team_tasks import FollowTarget, OtherBit, OwnBit, PricedBit

SMALL = {
    "learning_starts": 20,
    "batch_size": 16,
    "train_freq": 5,
    "buffer_size": 1000,
    "policy_kwargs": {"net_arch": [8]},
}


def learned(env="OwnBit-v0", steps: int = 120, **kwargs) -> MADDPG:
    return MADDPG("MlpPolicy", env, **{**SMALL, "seed": 0, **kwargs}).learn(steps)


def parameters(model: MADDPG) -> np.ndarray:
    return model.policy.parameters_to_vector()


@pytest.mark.parametrize("task", ["OwnBit-v0", "FollowTarget-v0"])
@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_runs_in_vectorised_environments(task, n_envs, vec_env_cls):
    # With the module, so that other processes import it
    env = make_vec_env(f"sb3_maddpg.team_tasks:{task}", n_envs, vec_env_cls=vec_env_cls)
    model = learned(env, 120)
    assert model._n_updates > 0
    assert model.num_timesteps == 120
    assert model.env_spec == {"id": task, "kwargs": {}}
    actions, _ = model.predict(env.reset(), deterministic=True)
    assert all(model.action_space.contains(action) for action in actions)
    env.close()


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("share", [False, True])
def test_runs_with_every_estimator_and_with_shared_networks(estimator, share):
    policy_kwargs = {"share_actor": share, "share_critic": share, "net_arch": [8]}
    before = MADDPG("MlpPolicy", "OwnBit-v0", **{**SMALL, "policy_kwargs": policy_kwargs, "seed": 0})
    after = learned(estimator=estimator, policy_kwargs=policy_kwargs)
    for name in ("actor", "critic", "actor_target", "critic_target"):
        old, new = getattr(before.policy, name).parameters(), getattr(after.policy, name).parameters()
        assert all(not th.equal(a, b) for a, b in zip(old, new, strict=True))
        assert all(parameter.isfinite().all() for parameter in getattr(after.policy, name).parameters())


def test_tasks_are_proper_environments():
    for task in (OwnBit, OtherBit, PricedBit, FollowTarget):
        check_env(task(), warn=False)


@pytest.mark.parametrize("clip", [None, 0.05])
@pytest.mark.parametrize("task", ["PricedBit-v0", "FollowTarget-v0"])
def test_one_update_is_that_of_separate_agents(task, clip):
    """Against a loop over agents, each with its own loss, norm and step of gradient descent."""
    lr, tau, gamma, weight = 0.1, 0.3, 0.9, 0.02
    model = learned(
        task,
        60,
        learning_rate=lr,
        tau=tau,
        gamma=gamma,
        max_grad_norm=clip,
        policy_regularization=weight,
        policy_kwargs={"net_arch": [8], "optimizer_class": th.optim.SGD},
    )
    old = copy.deepcopy(model.policy)
    state = np.random.get_state()  # noqa: NPY002
    data = model.replay_buffer.sample(32)
    np.random.set_state(state)  # noqa: NPY002
    model.train(1, batch_size=32)

    obs, actions = data.observations, data.actions.float().view(32, model.n_agents, -1)
    target = old.critic_target(data.next_observations, old.actor_target.act(data.next_observations))
    target = (data.rewards + gamma * (1 - data.dones) * target).detach()

    def descended(network, losses):
        """The network after each agent's parameters took their own step."""
        result = copy.deepcopy(network)
        for agent, loss in enumerate(losses):
            gradients = th.autograd.grad(loss, list(network.parameters()), retain_graph=True)
            gradients = [gradient[agent] for gradient in gradients]
            norm = th.cat([gradient.flatten() for gradient in gradients]).norm()
            factor = 1.0 if clip is None else min(1.0, clip / norm.item())
            for parameter, gradient in zip(result.parameters(), gradients, strict=True):
                parameter.data[agent] -= lr * factor * gradient
        return result

    agents = range(model.n_agents)
    current = old.critic(obs, actions)
    critic = descended(old.critic, [((current[:, i] - target[:, i]) ** 2).mean() for i in agents])

    logits = old.actor.logits(obs)
    losses = []
    for i in agents:
        own = old.actor.squash(logits)[:, i]
        joint = actions.clone()
        if task == "FollowTarget-v0":
            joint[:, i] = own
            value = critic(obs, joint)[:, i]
        else:  # the threshold falls between two neighbouring scores
            ranked, order = own.sort(dim=1, descending=True)
            joint[:, i] = 0
            value = critic(obs, joint)[:, i].detach() * (1 - ranked[:, 0])
            for m in range(own.shape[1]):
                joint = joint.clone()
                joint[th.arange(32), i, order[:, m]] = 1
                lower = ranked[:, m + 1] if m + 1 < own.shape[1] else 0.0
                value = value + critic(obs, joint)[:, i].detach() * (ranked[:, m] - lower)
        losses.append(weight * (logits[:, i] ** 2).mean() - value.mean())
    actor = descended(old.actor, losses)

    for mine, reference, moving, before in (
        (model.critic, critic, model.critic_target, old.critic_target),
        (model.actor, actor, model.actor_target, old.actor_target),
    ):
        for a, b, c, d in zip(*(net.parameters() for net in (mine, reference, moving, before)), strict=True):
            assert th.allclose(a, b, atol=1e-5)
            assert th.allclose(c, tau * a + (1 - tau) * d, atol=1e-6)


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
    train = {"actor_loss", "critic_loss", "n_updates", "learning_rate", "score_mean", "score_std"}
    train |= {f"q_value_{agent}" for agent in range(3)}
    assert {f"train/{name}" for name in train} | {"rollout/ep_rew_mean", "task/mean_action"} <= last.keys()
    assert 0.0 <= last["train/score_mean"] <= 1.0
    assert last["train/learning_rate"] == 1e-2
    assert "train/score_mean" not in logged("FollowTarget-v0", 60)[-1]


def test_metrics_are_means_over_the_steps_since_the_last_log():
    class Counting(OwnBit):
        def step(self, action):
            *rest, info = super().step(action)
            info["metrics"] = {"task/step": self._steps} if self._steps != 5 else {}
            return *rest, info

    assert [dump["task/step"] for dump in logged(Counting(), 30)] == pytest.approx([(sum(range(1, 11)) - 5) / 9] * 3)


def test_same_seed_same_parameters_element_by_element():
    assert np.array_equal(parameters(learned(seed=3)), parameters(learned(seed=3)))
    assert not np.array_equal(parameters(learned(seed=3)), parameters(learned(seed=4)))


def test_learning_in_two_parts_is_learning_in_one():
    whole = learned(steps=200)
    parts = learned(steps=100).learn(100, reset_num_timesteps=False)
    assert parts.num_timesteps == 200
    assert np.array_equal(parameters(whole), parameters(parts))


def test_vec_normalize_and_evaluation():
    env = VecNormalize(make_vec_env("PricedBit-v0", 2))
    model = learned(env, 200)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=4)
    assert np.isfinite(mean)


def test_action_noise_moves_continuous_actions():
    noise = NormalActionNoise(np.zeros(2), 0.5 * np.ones(2))
    quiet, noisy = learned("FollowTarget-v0"), learned("FollowTarget-v0", action_noise=noise)
    spread = [np.abs(np.diff(model.replay_buffer.actions[25:120, 0], axis=0)).mean() for model in (quiet, noisy)]
    assert spread[1] > spread[0]
    assert np.abs(noisy.replay_buffer.actions).max() <= 1.0


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"estimator": "expectd"}, "Unknown estimator 'expectd': did you mean 'expected'"),
        ({"action_noise": NormalActionNoise(np.zeros(9), np.ones(9))}, "Leave it out: bits explore"),
        ({"max_grad_norm": 0.0}, "max_grad_norm=0.0 must be positive"),
        ({"policy_kwargs": {"threshold": 1.5}}, "threshold=1.5"),
    ],
)
def test_a_bad_argument_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", "OwnBit-v0", **kwargs)


class Misshapen(gymnasium.Env):
    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


@pytest.mark.parametrize(
    ("observation_space", "action_space", "message"),
    [
        (spaces.Box(-1, 1, (6,)), spaces.MultiBinary(6), r"shape \(n_agents, obs_dim\).*Stack"),
        (spaces.Discrete(4), spaces.MultiBinary(6), r"not Discrete\(4\)"),
        (spaces.Box(-1, 1, (4, 3)), spaces.MultiBinary(6), "6 numbers.*4 agents"),
        (spaces.Box(-1, 1, (2, 3)), spaces.MultiBinary((2, 3)), r"MultiBinary\(\(2, 3\)\).*Flatten"),
    ],
)
def test_spaces_that_are_no_team_are_refused(observation_space, action_space, message):
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", Misshapen(observation_space, action_space))
