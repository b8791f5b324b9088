"""What an agent observes and does, in its own spaces, in the team's rows, and back."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_maddpg import MADDPG, SafeVecNormalize, TeamEnv, make_vec_env
from sb3_maddpg.team.agents import flat_observation
from toys import AGENT_SPACES, SMALL, Toy

SEEN: dict[str, spaces.Space] = {
    "dict": spaces.Dict({"place": spaces.Box(-1, 1, (2,)), "kind": spaces.Discrete(3, start=1)}),
    "category": spaces.Discrete(4),
    "image": spaces.Box(0, 255, (4, 5, 3), np.uint8),
    "tuple": spaces.Tuple([spaces.MultiBinary(2), spaces.MultiDiscrete([2, 3])]),
    "flat": spaces.Box(-1, 1, (3,)),
}


class Seers(ParallelEnv):
    """Agents that observe all kinds of spaces and act in all kinds; the second one leaves after two steps of four."""

    metadata = {"name": "seers", "render_modes": []}  # noqa: RUF012

    def __init__(self):
        self.possible_agents = list(SEEN)
        self.seen = deepcopy(SEEN)
        self.acts = dict(zip(SEEN, AGENT_SPACES["mixed"], strict=False))
        self.sent: list[dict] = []

    def observation_space(self, agent):
        return SEEN[agent]

    def action_space(self, agent):
        return self.acts[agent]

    def _observe(self):
        return {agent: self.seen[agent].sample() for agent in self.possible_agents}

    def reset(self, seed=None, options=None):
        self.agents, self.time = list(self.possible_agents), 0
        for k, agent in enumerate(SEEN):
            self.seen[agent].seed(None if seed is None else seed + k)
        return self._observe(), {}

    def step(self, actions):
        self.sent.append(actions)
        self.time += 1
        ends = {agent: self.time == 4 or (agent == "category" and self.time == 2) for agent in actions}
        self.agents = [agent for agent in actions if not ends[agent]]
        return self._observe(), dict.fromkeys(actions, 1.0), ends, dict.fromkeys(actions, False), {}


@pytest.fixture(scope="module")
def model() -> MADDPG:
    made = MADDPG("MlpPolicy", Seers(), **SMALL)
    th.manual_seed(3)
    with th.no_grad():
        for parameter in made.actor.parameters():
            parameter.normal_(std=0.7)
    return made


def test_an_agent_takes_what_it_observes(model, tmp_path):
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    joint = TeamEnv(Seers())
    matrix, _ = joint.reset(seed=4)
    expected = {}
    joint.step(model.predict(matrix, deterministic=True)[0])
    expected = joint.parallel_env.sent[0]
    observations, _ = Seers().reset(seed=4)
    for one in (model, loaded):
        for name, policy in one.agent_policies().items():
            assert policy.observation_space == SEEN[name]
            action, state = policy.predict(observations[name])
            assert state is None
            assert policy.action_space.contains(action)
            np.testing.assert_array_equal(action, expected[name])
            row = list(SEEN).index(name)
            again, _ = policy.predict(matrix[row, : policy.obs_dim])
            np.testing.assert_array_equal(again, action)


def test_a_team_takes_and_returns_dicts(model):
    env, team = Seers(), TeamEnv(Seers())
    observations, _ = env.reset(seed=5)
    matrix, _ = team.reset(seed=5)
    while env.agents:
        actions, state = model.predict({agent: observations[agent] for agent in env.agents}, deterministic=True)
        assert state is None
        assert actions.keys() == set(env.agents)
        assert all(env.action_space(agent).contains(action) for agent, action in actions.items())
        observations, *_ = env.step(actions)
        matrix, *_ = team.step(model.predict(matrix, deterministic=True)[0])
    assert len(env.sent) == 4
    for ours, theirs in zip(env.sent, team.parallel_env.sent, strict=True):
        assert ours.keys() == theirs.keys()
        for agent, action in ours.items():
            np.testing.assert_array_equal(action, theirs[agent])
            assert np.asarray(action).dtype == np.asarray(theirs[agent]).dtype


def test_dicts_that_do_not_fit_are_refused(model):
    good, _ = Seers().reset(seed=0)
    for wrong, message in (
        ({"somebody": 1}, "There is no agent 'somebody'"),
        ({**good, "category": 4}, r"An observation of category is one of Discrete\(4\), or flat and has shape \(4,\)"),
        ({**good, "dict": {"place": np.zeros(2)}}, r"An observation of dict is one of Dict\("),
        ({**good, "flat": np.full(3, np.nan)}, r"agent\(s\) flat holds NaN"),
        ({**good, "flat": np.zeros((2, 3))}, "observation of flat is a batch of 2"),
    ):
        with pytest.raises(ValueError, match=message):
            model.predict(wrong)


def test_batches_are_flat_or_of_images(model):
    policy = model.agent_policy("image")
    images = np.stack([SEEN["image"].sample() for _ in range(6)])
    batch, _ = policy.predict(images)
    assert len(batch) == 6
    np.testing.assert_array_equal(batch, policy.predict(images.reshape(6, -1))[0])
    np.testing.assert_array_equal(batch[2].ravel(), np.ravel(policy.predict(images[2])[0]))


def test_an_agent_may_draw_its_actions(model):
    policy = model.agent_policy("dict")
    observation = {"place": np.zeros(2), "kind": 2}
    th.manual_seed(0)
    drawn = {tuple(policy.predict(observation, deterministic=False)[0]) for _ in range(60)}
    assert len(drawn) > 1
    assert len({tuple(policy.predict(observation)[0]) for _ in range(5)}) == 1


def test_statistics_of_normalisation_are_applied_to_dicts():
    env = SafeVecNormalize(make_vec_env(Toy, env_kwargs={"kind": "categorical"}), norm_reward=False)
    model = MADDPG("MlpPolicy", env, **SMALL)
    model.learn(60)
    raw = Toy("categorical")
    observations, _ = raw.reset(seed=1)
    actions, _ = model.predict(observations, deterministic=True)
    assert actions == {name: policy.predict(observations[name])[0] for name, policy in model.agent_policies().items()}
    padded = np.zeros((1, 2, 3), np.float32)
    for row, observation in enumerate(observations.values()):
        padded[0, row, : len(observation)] = observation
    joint, _ = model.predict(env.normalize_obs(padded), deterministic=True)
    assert [actions["categorical_0"], actions["categorical_1"] - 2] == joint[0].tolist()


def test_flat_observations_are_numbers():
    space = SEEN["category"]
    assert flat_observation("a", space, 4, 2).tolist() == [0, 0, 1, 0]
    assert flat_observation("a", space, 4, [0, 1, 0, 0]).tolist() == [0, 1, 0, 0]
    with pytest.raises(ValueError, match="observations of several agents"):
        flat_observation("a", space, 4, {"a": 2, "b": 1})


def test_an_environment_is_named_or_created():
    model = MADDPG("MlpPolicy", "mpe2/simple_spread_v3", **SMALL)
    assert model.env.num_envs == 1
    meant = r"Unknown environment '{}'[.:] [Dd]id you mean 'mpe2/simple_spread_v3'\?$"
    with pytest.raises(ValueError, match=meant.format("mpe2/simple_sprad_v3")):
        MADDPG("MlpPolicy", "mpe2/simple_sprad_v3")
    with pytest.raises(ValueError, match=meant.format("mpe/simple_spread_v3")):
        make_vec_env("mpe/simple_spread_v3")
