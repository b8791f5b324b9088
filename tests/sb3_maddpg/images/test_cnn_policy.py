"""Agents that see images."""

import io

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import MADDPG, MATD3, CnnPolicy, TeamEnv, allow_in_files
from toys import SMALL, Toy

SIDE = 8


@allow_in_files
class SmallCNN(BaseFeaturesExtractor):
    """A few filters and a layer."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 8):
        super().__init__(observation_space, features_dim)
        channels = observation_space.shape[0]
        self.net = th.nn.Sequential(
            th.nn.Conv2d(channels, 2, 3), th.nn.Tanh(), th.nn.Flatten(), th.nn.LazyLinear(features_dim), th.nn.Tanh()
        )
        self.net(th.zeros(1, *observation_space.shape))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.net(observations)


class BrightSide(ParallelEnv):
    """Each agent sees a picture that is brighter on one side, and is rewarded for naming it."""

    metadata: dict = {"name": "bright_side"}  # noqa: RUF012
    possible_agents = ("a", "b")

    def __init__(self, channels_last: bool = True, side: int = SIDE):
        self.shape = (side, side, 1) if channels_last else (1, side, side)
        self.side = side
        self.rng = None

    def observation_space(self, agent):
        return spaces.Box(0, 255, self.shape, np.uint8)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def _draw(self):
        self.right = dict(zip(self.agents, self.rng.integers(2, size=len(self.agents)), strict=True))
        pictures = {}
        for agent, right in self.right.items():
            picture = self.rng.integers(0, 120, (self.side, self.side))
            half = slice(self.side // 2, None) if right else slice(self.side // 2)
            picture[:, half] += 100
            pictures[agent] = picture.astype(np.uint8).reshape(self.shape)
        return pictures

    def reset(self, seed=None, options=None):
        if seed is not None or self.rng is None:
            self.rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.steps = 0
        return self._draw(), {agent: {} for agent in self.agents}

    def step(self, actions):
        self.steps += 1
        agents = self.agents
        rewards = {agent: float(actions[agent] == self.right[agent]) for agent in agents}
        over = dict.fromkeys(agents, self.steps == 10)
        infos = {agent: {} for agent in agents}
        pictures = self._draw()
        if self.steps == 10:
            self.agents = []
        return pictures, rewards, dict.fromkeys(agents, False), over, infos


ARGUMENTS = {
    "learning_starts": 100,
    "batch_size": 64,
    "buffer_size": 3000,
    "learning_rate": 2e-3,
    "gamma": 0.0,
    "train_freq": 2,
    "seed": 0,
}
POLICY = {"features_extractor_class": SmallCNN, "net_arch": [16]}


def made(algorithm=MADDPG, env=None, **policy_kwargs) -> MADDPG:
    return algorithm("CnnPolicy", env or BrightSide(), **ARGUMENTS, policy_kwargs={**POLICY, **policy_kwargs})


def drawn(model, batch: int = 5) -> tuple[th.Tensor, th.Tensor]:
    th.manual_seed(0)
    obs = th.randint(0, 256, (batch, *model.observation_space.shape)).float()
    return obs, model.actor.act(obs, deterministic=False)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [MADDPG, MATD3])
def test_it_learns_to_see(algorithm):
    model = made(algorithm).learn(1600)
    env = TeamEnv(BrightSide())
    obs, _ = env.reset(seed=7)
    rewards = []
    while True:
        obs, reward, terminated, truncated, _ = env.step(model.predict(obs, deterministic=True)[0])
        rewards.append(reward)
        if terminated or truncated:
            if len(rewards) >= 200:
                break
            obs, _ = env.reset()
    assert np.mean(rewards) > 0.9


@pytest.mark.parametrize("state", [False, True])
def test_an_actor_sees_its_own_picture_and_critics_see_all(state):
    env = BrightSide()
    if state:
        env.state_space, env.state = spaces.Box(-1, 1, (3,)), lambda: np.zeros(3, np.float32)
    model = made(env=TeamEnv(env, state=state))
    obs, actions = drawn(model)
    logits, values = model.actor.logits(obs), model.critic(obs, actions)
    changed = obs.clone()
    changed[:, 0, : SIDE * SIDE] = 255 - changed[:, 0, : SIDE * SIDE]
    assert th.equal(model.actor.logits(changed)[:, 1], logits[:, 1])
    assert not th.allclose(model.actor.logits(changed)[:, 0], logits[:, 0])
    if state:  # in place of the agents' observations
        changed = obs.clone()
        changed[..., SIDE * SIDE :] += 1
    assert not th.isclose(model.critic(changed, actions), values).any()


@pytest.mark.parametrize("share", [False, True, "team"])
def test_alternatives_have_the_values_of_the_action_replaced(share):
    model = made(share_critic=share, share_actor=bool(share))
    obs, actions = drawn(model)
    own = th.randn(5, 2, 3, model.policy.actions.width)
    values = model.critic.forward_alternatives(obs, actions, own)
    for agent in range(2):
        for alternative in range(3):
            replaced = actions.clone()
            replaced[:, agent] = own[:, agent, alternative]
            expected = model.critic(obs, replaced)[0, :, 0 if share == "team" else agent]
            assert th.allclose(values[:, agent, alternative], expected, atol=1e-5)


def test_channels_may_come_first_or_last():
    last, first = made(), made(env=BrightSide(channels_last=False))
    first.policy.load_state_dict(last.policy.state_dict())
    picture = th.randint(0, 256, (4, 2, SIDE, SIDE, 2)).float()[..., :1]
    seen_last, seen_first = picture.flatten(2), picture.permute(0, 1, 4, 2, 3).flatten(2)
    assert th.allclose(last.actor.logits(seen_last), first.actor.logits(seen_first), atol=1e-6)


def test_files_and_exported_policies_act_alike(tmp_path):
    model = made().learn(200)
    obs, _ = drawn(model)
    obs = obs.numpy()
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    assert isinstance(loaded.policy, CnnPolicy)
    expected = model.predict(obs, deterministic=True)[0].reshape(5, 2)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0].reshape(5, 2), expected)
    agent = loaded.agent_policy("b")
    np.testing.assert_array_equal(agent.predict(obs[:, 1])[0].ravel(), expected[:, 1])
    agent.export(tmp_path / "b.pt")
    script = th.jit.load(io.BytesIO((tmp_path / "b.pt").read_bytes()))
    np.testing.assert_array_equal(script(th.as_tensor(obs[:, 1])).numpy().ravel(), expected[:, 1])


def test_the_default_is_stable_baselines3s_network():
    model = MADDPG("CnnPolicy", BrightSide(side=36), **ARGUMENTS, policy_kwargs={"net_arch": [8]})
    assert isinstance(model.actor.features.extractor, NatureCNN)
    model.learn(110)
    assert model._n_updates > 0


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="agents that observe images of the same size"):
        MADDPG("CnnPolicy", TeamEnv(Toy("mixed")), **ARGUMENTS)
    with pytest.raises(ValueError, match="NatureCNN cannot be created"):
        MADDPG("CnnPolicy", BrightSide(), **ARGUMENTS)  # too small for its filters
    with pytest.raises(ValueError, match="BaseFeaturesExtractor"):
        made(features_extractor_class=th.nn.Linear)
    with pytest.raises(ValueError, match="has 12 numbers, but the agents observe"):
        made(image_space=spaces.Box(0, 255, (2, 6, 1), np.uint8))
    with pytest.raises(ValueError, match="features_extractor_kwargs"):
        made(features_extractor_kwargs={"width": 3})
    floats = gymnasium.spaces.Box(0, 1, (SIDE, SIDE, 1))
    with pytest.raises(ValueError, match="normalize_images=False"):
        made(features_extractor_class=NatureCNN, image_space=floats)


class Pictures(ParallelEnv):
    """Agents that see different things; the reward tells which half of a picture is brighter."""

    metadata: dict = {"name": "pictures"}  # noqa: RUF012

    def __init__(self, *seen: spaces.Space):
        self.seen = dict(zip("abc", seen, strict=False))
        self.possible_agents = list(self.seen)
        self.state_space = spaces.Box(0, 255, (4, 4, 3), np.uint8)

    def observation_space(self, agent):
        return self.seen[agent]

    def action_space(self, agent):
        return spaces.Discrete(2)

    def state(self):
        return np.full((4, 4, 3), 255, np.uint8)

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        return {agent: self.seen[agent].sample() for agent in self.agents}, {}

    def step(self, actions):
        rewards = dict.fromkeys(self.agents, 0.0)
        ends = dict.fromkeys(self.agents, False)
        return {agent: self.seen[agent].sample() for agent in self.agents}, rewards, ends, ends, {}


PICTURE = spaces.Box(0, 255, (4, 4, 3), np.uint8)


@pytest.mark.parametrize("normalize_images", [True, False])
@pytest.mark.parametrize("share_critic", [False, "team"])
def test_mlp_policies_divide_images_of_bytes_like_stable_baselines3(normalize_images, share_critic):
    """Networks whose first layers hold their inputs apart would see 0 to 1 instead of 0 to 255, and nothing else."""
    part = spaces.Dict({"camera": PICTURE, "far": spaces.Box(0, 255, (5,), np.uint8), "own": spaces.Discrete(3)})
    env = TeamEnv(Pictures(PICTURE, spaces.Box(-1, 1, (2,)), part), state=True)
    kwargs = {"normalize_images": normalize_images, "share_critic": share_critic}
    model = MADDPG("MlpPolicy", env, policy_kwargs=kwargs, **_without_kwargs(SMALL))
    plain = MADDPG(
        "MlpPolicy", env, policy_kwargs={**kwargs, "image_columns": [[], [], [], []]}, **_without_kwargs(SMALL)
    )
    obs, _ = env.reset(seed=0)
    scaled = obs.copy()
    if normalize_images:
        scaled[0, :48] /= 255
        scaled[2, :48] /= 255  # its camera, in the order of Gymnasium's flatten
        scaled[:, 56:] /= 255  # the state
    assert scaled[:, 56:].max() == (1.0 if normalize_images else 255.0)
    batch, unscaled = th.as_tensor(scaled[None]), th.as_tensor(obs[None])
    rounding = 1e-6 if normalize_images else 1e-4  # of sums of hundreds that may almost cancel
    assert th.allclose(model.actor.logits(unscaled), plain.actor.logits(batch), atol=rounding)
    actions = model.actor(unscaled)
    assert th.allclose(model.critic(unscaled, actions), plain.critic(batch, actions), atol=10 * rounding)
    own = model.actor.actions.columns_of(0)
    alone = model.agent_policy("a").network(unscaled[:, 0, :48])[:, own]
    assert th.allclose(alone, model.actor.logits(unscaled)[:, 0, own], atol=rounding)


@pytest.mark.parametrize("normalize_images", [True, False])
def test_cnn_policies_divide_the_image_of_the_state_like_those_of_agents(normalize_images, tmp_path):
    image = spaces.Box(0, 255, (8, 8, 3), np.uint8)
    kwargs = {**POLICY, "normalize_images": normalize_images}
    arguments = {**_without_kwargs(SMALL), "policy_kwargs": kwargs}
    model = MADDPG("CnnPolicy", TeamEnv(Pictures(image, image), state=True), **arguments)
    obs = th.as_tensor(TeamEnv(Pictures(image, image), state=True).reset(seed=0)[0][None])
    assert obs[..., 192:].unique().tolist() == [255]
    assert model.critic.features(obs)[..., -24:].unique().tolist() == [1 if normalize_images else 255]
    model.learn(40)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    actions = model.actor(obs)
    assert th.equal(model.critic(obs, actions), loaded.critic(obs, actions))
    assert loaded.agent_policy("a").predict(np.zeros((8, 8, 3), np.uint8))[0] in (0, 1)


def test_normalised_images_are_not_divided_too():
    model = MADDPG("MlpPolicy", Pictures(PICTURE, PICTURE), **SMALL)
    with pytest.raises(ValueError, match="normalises images, which the policy also divides by 255"):
        model.set_env(VecNormalize(DummyVecEnv([lambda: TeamEnv(Pictures(PICTURE, PICTURE))])))


def test_mlp_policies_with_images_are_saved_and_loaded(tmp_path):
    env = Pictures(PICTURE, PICTURE)
    model = MADDPG("MlpPolicy", env, **SMALL).learn(40)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=env)
    obs = TeamEnv(env).reset(seed=0)[0]
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    assert th.equal(model.actor.logits(th.as_tensor(obs[None])), loaded.actor.logits(th.as_tensor(obs[None])))
    loaded.learn(20, reset_num_timesteps=False)


def test_pictures_without_an_axis_of_channels():
    grey = spaces.Box(0, 255, (40, 40), np.uint8)
    model = MADDPG("CnnPolicy", Pictures(grey, grey), **SMALL).learn(30)
    three = MADDPG("CnnPolicy", Pictures(*[spaces.Box(0, 255, (1, 40, 40), np.uint8)] * 2), **SMALL)
    three.policy.load_state_dict(model.policy.state_dict())
    picture = np.random.default_rng(0).integers(0, 256, (40, 40)).astype(np.uint8)
    action, _ = model.agent_policy("a").predict(picture)
    assert action == three.agent_policy("a").predict(picture[None])[0]
    assert spaces.Discrete(2).contains(action)


def _without_kwargs(arguments: dict) -> dict:
    return {name: value for name, value in arguments.items() if name != "policy_kwargs"}


@pytest.mark.slow
def test_a_team_s_single_value_is_fitted_to_the_team_s_reward():
    class Paid(Pictures):
        def step(self, actions):
            seen, rewards, *rest = super().step(actions)
            return seen, {agent: 3.0 * index for index, agent in enumerate(rewards)}, *rest

    image = spaces.Box(0, 255, (1, 40, 40), np.uint8)
    kwargs = {"share_critic": "team", "net_arch": [8]}
    arguments = {
        **_without_kwargs(SMALL),
        "gamma": 0.0,
        "learning_rate": 1e-2,
        "train_freq": 1,
        "policy_kwargs": kwargs,
    }
    model = MADDPG("CnnPolicy", Paid(image, image), **arguments).learn(150)
    obs = th.as_tensor(TeamEnv(Paid(image, image)).reset(seed=0)[0][None])
    values = model.critic(obs, model.actor.act(obs))
    assert values.shape == (1, 1, 1)
    assert values.item() == pytest.approx(1.5, abs=0.3), "the mean of 0 and 3"
