"""What users bring to training: what follows the documentation learns, the rest is refused in one line."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.noise import ActionNoise
from torch import nn

from sb3_maddpg import MADDPG, MADDPGPolicy, TeamReplayBuffer
from sb3_maddpg.common.estimators import ESTIMATORS, Estimator, expected_binary, expected_categorical
from sb3_maddpg.common.policies import Actor, Critic, MLPCritic
from sb3_maddpg.team.toys import FollowTarget, OwnBit

pytestmark = pytest.mark.filterwarnings("ignore:.* cannot be saved")  # classes of this file are not registered


def learned(env=OwnBit, policy="MlpPolicy", **kwargs) -> MADDPG:
    model = MADDPG(policy, env(), learning_starts=20, train_freq=10, batch_size=16, buffer_size=200, seed=0, **kwargs)
    return model.learn(60)


def test_an_estimator_of_the_user_learns_as_the_one_it_copies(monkeypatch):
    monkeypatch.setitem(ESTIMATORS, "mine", Estimator(expected_binary, expected_categorical))
    mine, shipped = (learned(estimator=name).policy.state_dict() for name in ("mine", "expected"))
    assert all(th.equal(mine[name], shipped[name]) for name in shipped)


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (expected_binary, r"ESTIMATORS\['mine'\]=<function .* must be an Estimator of two functions"),
        (None, r"ESTIMATORS\['mine'\]=None must be an Estimator"),
        (Estimator(None, expected_categorical), "'mine' failed .*'NoneType' object is not callable"),  # type: ignore[arg-type]
        (lambda p, q, t: None, r"estimator='mine' returned None: it must return a tensor of shape \(1, 3\)"),
        (lambda p, q, t: np.zeros((1, 3)), "estimator='mine' returned array"),
        (lambda p, q, t: expected_binary(p, q, t).mean(1), r"returned shape \(1,\): it must .* shape \(1, 3\)"),
        (lambda p, q, t: p, r"estimator='mine' returned shape \(1, 3, 3\): it must return .* shape \(1, 3\)"),
        (lambda p, q, t: expected_binary(p, q, t).detach(), "'mine' returned a tensor without a gradient"),
        (lambda p, q, t: {}["key"], "estimator='mine' failed .KeyError: 'key'"),
        (lambda p, q: None, "estimator='mine' failed .TypeError"),
    ],
)
def test_a_broken_estimator_is_refused_before_the_training(estimator, message, monkeypatch):
    whole = (
        Estimator(estimator, expected_categorical) if getattr(estimator, "__name__", "") == "<lambda>" else estimator
    )
    monkeypatch.setitem(ESTIMATORS, "mine", whole)
    with pytest.raises(ValueError, match=message) as refused:
        MADDPG("MlpPolicy", OwnBit(), estimator="mine")
    assert "\n" not in str(refused.value)


class Shared(Actor):
    """An actor with no more than CONTRIBUTING asks for."""

    def __init__(self, policy, actions):
        super().__init__(actions)
        self.columns = policy.team.obs_dim
        self.net = nn.Linear(self.columns, actions.width)

    def logits(self, obs):
        return self.net(obs[..., : self.columns])

    def single(self, agent):
        return self.net


class Narrow(Shared):
    def logits(self, obs):
        return super().logits(obs)[:, :1]


class Constant(Shared):
    def logits(self, obs):
        return super().logits(obs).detach()


class Alone(Shared):
    single = Actor.single


class NoModule(Shared):
    def single(self, agent):
        return self.net.weight


class Silent(MLPCritic):
    def forward(self, obs, actions):
        return None


class Flat(MLPCritic):
    def forward(self, obs, actions):
        return super().forward(obs, actions)[0]


class Closed(MLPCritic):
    forward_alternatives = Critic.forward_alternatives


class OneAlternative(MLPCritic):
    def forward_alternatives(self, obs, actions, own, factors=None):
        return super().forward_alternatives(obs, actions, own, factors)[..., :1]


def policy_with(actor=None, critic=None, networks=None) -> type[MADDPGPolicy]:
    class Mine(MADDPGPolicy):
        def _make_networks(self, actor_arch, critic_arch):
            made = super()._make_networks(actor_arch, critic_arch)
            if critic is not None:
                made[1].__class__ = critic
            if networks is not None:
                return networks(made)
            return (made[0] if actor is None else actor(self, made[0].actions)), made[1]

    return Mine


def test_a_policy_with_what_contributing_asks_for_learns():
    model = learned(policy=policy_with(Shared))
    assert model.agent_policy(0).predict(np.ones(model.policy.team.obs_dim, np.float32))[0].shape == (3,)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (policy_with(Narrow), r"policy=Mine: Narrow.logits returned shape \(1, 1, 3\): it must .* \(1, 3, 3\)"),
        (policy_with(Constant), "Constant.logits returned a tensor without a gradient"),
        (policy_with(Alone), r"Alone.single\(0\) failed \(NotImplementedError\)"),
        (policy_with(NoModule), r"NoModule.single\(0\) failed"),
        (policy_with(critic=Silent), "Silent.forward returned None"),
        (policy_with(critic=Flat), r"Flat.forward returned shape \(1, 3\): it must return .* \(1, 1, 3\)"),
        (policy_with(critic=Closed), r"Closed.forward_alternatives failed \(NotImplementedError\)"),
        (
            policy_with(critic=OneAlternative),
            r"OneAlternative.forward_alternatives returned shape \(1, 3, 1\): it must",
        ),
        (policy_with(networks=lambda made: None), "Mine._make_networks returned None instead of an Actor and a Critic"),
        (policy_with(networks=lambda made: made[::-1]), "instead of an Actor and a Critic"),
        (policy_with(networks=lambda made: made[:1]), "instead of an Actor and a Critic"),
    ],
)
def test_a_broken_policy_is_refused_before_the_training(policy, message):
    with pytest.raises(ValueError, match=message) as refused:
        MADDPG(policy, OwnBit())
    assert "\n" not in str(refused.value)


def test_the_trial_draws_no_random_numbers_that_training_would_miss():
    th.manual_seed(3)
    policy = MADDPG("MlpPolicy", OwnBit(), estimator="rao_blackwell", seed=3)
    after = th.rand(3)
    MADDPG("MlpPolicy", OwnBit(), estimator="expected", seed=3)
    assert th.equal(th.rand(3), after)
    assert policy.policy.training


class Passing(TeamReplayBuffer):
    def __init__(self, buffer_size, *args, **kwargs):
        super().__init__(buffer_size, *args, **kwargs)


class Empty(TeamReplayBuffer):
    def sample(self, batch_size, env=None):
        return None


class Closing(TeamReplayBuffer):
    def __init__(self, buffer_size, observation_space, action_space, device="auto", n_envs=1):
        super().__init__(buffer_size, observation_space, action_space, device, n_envs)


def test_a_replay_buffer_of_the_user_learns_or_is_refused():
    assert type(learned(replay_buffer_class=Passing).replay_buffer) is Passing
    with pytest.raises(ValueError, match=r"Empty.sample returned None: it must return TeamReplayBufferSamples"):
        learned(replay_buffer_class=Empty)
    with pytest.raises(
        ValueError, match=r"Closing does not accept gamma, n_steps, optimize_memory_usage, which the alg"
    ):
        MADDPG("MlpPolicy", OwnBit(), replay_buffer_class=Closing)


class Late(ActionNoise):
    """A noise that works when it is tried, and fails later."""

    def __init__(self, later):
        super().__init__()
        self.later, self.calls = later, 0

    def __call__(self):
        self.calls += 1
        return np.zeros(2) if self.calls < 5 else self.later()


@pytest.mark.parametrize(
    ("later", "problem"),
    [
        (lambda: np.full(2, np.nan), "it returned NaN or infinity"),
        (lambda: np.zeros(3), "could not be broadcast"),
        (lambda: {}["key"], "'key'"),
    ],
)
def test_a_noise_that_fails_during_training_is_named(later, problem):
    with pytest.raises(ValueError, match=rf"action_noise=<.*Late object .*{problem}.*it must return finite numbers"):
        learned(FollowTarget, action_noise=Late(later))
    assert learned(FollowTarget, action_noise=Late(lambda: np.ones(2))).num_timesteps == 60
