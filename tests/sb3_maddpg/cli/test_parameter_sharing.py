"""Stable-Baselines3's own algorithms on PettingZoo's environments: one policy for all agents."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.cli.parameter_sharing import AgentsVecEnv, SharedPolicy, shares_parameters
from sb3_maddpg.cli.runs import latest_model
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo_ids import register

SPREAD, TAG, SWARM = "mpe2/simple_spread_v3", "mpe2/simple_tag_v3", "quad_swarm/parallel_env"
PADDED = ["supersuit.pad_observations_v0", "supersuit.pad_action_space_v0"]
STACKED = {"wrappers": [{"supersuit.frame_stack_v2": {"stack_size": 2}}]}
LEAVING = """
from mpe2 import simple_spread_v3
from pettingzoo.utils import BaseParallelWrapper

class Leaving(BaseParallelWrapper):
    @property
    def agents(self):
        return self.env.agents[self.gone:]
    def reset(self, **kwargs):
        self.gone = 0
        return super().reset(**kwargs)
    def step(self, actions):
        found = super().step({**dict.fromkeys(self.env.agents, 0), **actions})
        self.gone = 1
        found[2]["agent_0"] = True
        return found

def parallel_env(**kwargs):
    return Leaving(simple_spread_v3.parallel_env(**kwargs))
"""


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    known = dict(gymnasium.registry)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    for env_id in (SPREAD, TAG, SWARM):
        register(env_id)
    yield
    gymnasium.registry.clear()
    gymnasium.registry.update(known)


def test_only_algorithms_for_single_agents_on_pettingzoo_share_a_policy():
    load_environments()
    assert shares_parameters(PPO, SPREAD)
    assert not shares_parameters(MATD3, SPREAD)
    assert not shares_parameters(PPO, "OwnBit-v0")


def test_every_agent_is_an_environment():
    env = AgentsVecEnv(SPREAD, 2, {"max_cycles": 3})
    assert (env.num_envs, env.observation_space.shape, env.action_space.n) == (6, (18,), 5)
    env.seed(7)
    first = env.reset()
    env.seed(7)
    assert np.array_equal(env.reset(), first)
    assert not np.array_equal(first[:3], first[3:])  # the copies are seeded one by one
    for step in range(3):
        observations, rewards, dones, infos = env.step(np.zeros(6))
        assert dones.tolist() == [step == 2] * 6
    assert rewards.shape == (6,)
    # Bootstrapped from what the agents saw last
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert infos[0]["terminal_observation"].shape == (18,)
    assert not np.array_equal(infos[0]["terminal_observation"], observations[0])
    assert env.get_attr("spec")[0].kwargs == {"entry": "mpe2.simple_spread_v3", "max_cycles": 3}
    assert env.env_method("action_space", "agent_0") == [env.action_space] * 2


def test_floats_become_binary_actions():
    env = AgentsVecEnv(SWARM, 2, {"max_steps": 4})
    assert env.action_space == spaces.MultiBinary(3)
    env.reset()
    _, rewards, _, _ = env.step(np.ones((8, 3), np.float32))
    assert np.isfinite(rewards).all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({}, "heterogeneous agents: the observation space of adversary_0 is .*add supersuit.pad_observations_v0"),
        ({"wrappers": PADDED, "state": True}, "state:True is for centralised critics"),
        ({"wrappers": PADDED, "info_mask": True}, "info_mask:True is for MADDPG, MATD3, MASAC and IDDPG"),
    ],
)
def test_teams_that_cannot_share_a_policy_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        AgentsVecEnv(TAG, 1, kwargs)
    assert AgentsVecEnv(TAG, 1, {"wrappers": PADDED, "info_mask": False}).num_envs == 4


MIXED = """
from gymnasium import spaces
from mpe2 import simple_tag_v3
from pettingzoo.utils import BaseParallelWrapper

class Mixed(BaseParallelWrapper):
    def action_space(self, agent):
        return {SPACE}

def parallel_env(**kwargs):
    return Mixed(simple_tag_v3.parallel_env(**kwargs))
"""


@pytest.mark.parametrize(
    "space",
    [
        "spaces.Box(-1, 1, (2,)) if agent == 'agent_0' else super().action_space(agent)",
        "spaces.MultiBinary(2 if agent == 'agent_0' else 3)",
        "spaces.MultiDiscrete([2] * (2 if agent == 'agent_0' else 3))",
    ],
)
def test_no_padding_is_recommended_where_none_helps(space, tmp_path, monkeypatch):
    name = f"mixed_{abs(hash(space))}"
    (tmp_path / f"{name}.py").write_text(MIXED.replace("{SPACE}", space))
    monkeypatch.syspath_prepend(tmp_path)
    register(name)
    with pytest.raises(ValueError, match="no wrapper makes these spaces alike, so train with --algo maddpg") as error:
        AgentsVecEnv(name, 1, {})
    assert "supersuit" not in str(error.value)


def test_agents_that_leave_see_zeros_until_the_episode_ends(tmp_path, monkeypatch):
    (tmp_path / "leaving.py").write_text(LEAVING)
    monkeypatch.syspath_prepend(tmp_path)
    register("leaving")
    env = AgentsVecEnv("leaving", 1, {"max_cycles": 4})
    env.reset()
    for step in range(8):
        observations, rewards, dones, infos = env.step(np.zeros(3))
        assert dones.tolist() == [step % 4 == 3] * 3
        assert (rewards[0] == 0) == (step % 4 > 0)
        assert observations[0].any() == (step % 4 in (0, 3))  # it has left, or the next episode has begun
        assert observations[1].any()
    # The one terminated long ago, the others are cut off
    assert [bool(info.get("TimeLimit.truncated")) for info in infos] == [False, True, True]


def test_agents_that_ended_earlier_count_as_successes_or_not(tmp_path, monkeypatch):
    says = """
    def step(self, actions):
        found = self.left(actions)
        found[4].pop("agent_0", None) if self.steps else found[4].update(agent_0={"is_success": False})
        found[4]["agent_1"] = {"is_success": True}
        found[4]["agent_2"] = {}
        self.steps += 1
        return found

def parallel_env"""
    text = LEAVING.replace("def step", "def left").replace("self.gone = 0", "self.gone = self.steps = 0")
    (tmp_path / "saying.py").write_text(text.replace("\ndef parallel_env", says))
    monkeypatch.syspath_prepend(tmp_path)
    register("saying")
    env = AgentsVecEnv("saying", 1, {"max_cycles": 4})
    env.reset()
    for _ in range(2):
        for _ in range(4):
            *_, infos = env.step(np.zeros(3))
        assert [info.get("is_success") for info in infos] == [False, True, None]
    model = PPO("MlpPolicy", env, n_steps=40, batch_size=40).learn(120)
    assert sorted(set(model.ep_success_buffer)) == [False, True]
    assert np.mean(model.ep_success_buffer) == 0.5


@pytest.mark.parametrize(
    ("algo", "env_id", "kwargs", "params"),
    [
        ("ppo", SPREAD, STACKED, {"n_steps": 20, "batch_size": 60}),
        ("a2c", SPREAD, {"continuous_actions": True}, {"n_steps": 10, "policy_kwargs": "dict(activation_fn=nn.ReLU)"}),
        ("dqn", SPREAD, {}, {"learning_starts": 30, "buffer_size": 300}),
        ("sac", SPREAD, {"continuous_actions": True}, {"learning_starts": 100, "buffer_size": 300, "train_freq": 20}),
        ("ppo", SWARM, {"max_steps": 10}, {"n_steps": 20, "batch_size": 80}),
    ],
)
def test_an_algorithm_for_single_agents_is_trained_and_watched(capsys, algo, env_id, kwargs, params):
    recipe = {"n_timesteps": 240, "n_envs": 2, "policy": "MlpPolicy", "env_kwargs": kwargs, **params}
    Path("r.yml").write_text(yaml.safe_dump({env_id: recipe}))
    argv = ["--algo", algo, "--env", env_id]
    evaluation = ["--eval-freq", "120", "--eval-episodes", "1"]
    assert main(["train", *argv, "--conf-file", "r.yml", *evaluation, "--verbose", "0", "--seed", "0"]) == 0
    path = latest_model("latest:logs", algo, env_id)
    n_agents = 4 if env_id == SWARM else 3
    with np.load(Path(path).parent / "evaluations.npz") as found:
        assert found["timesteps"][0] == 120  # agents' steps
        assert found["results"].shape[1] == n_agents  # an episode of all agents
    capsys.readouterr()
    assert main(["enjoy", *argv, "-n", "60", "--no-render"]) == 1
    assert "holds pickled values" in capsys.readouterr().err
    assert main(["enjoy", *argv, "-n", "60", "--no-render", "--trust"]) == 0
    assert "Mean episode length: " in capsys.readouterr().out
    if algo == "a2c":
        assert main(["record", *argv, "-n", "5", "--trust"]) == 0
        (video,) = Path("logs").rglob("*.mp4")
        assert video.stat().st_size > 500
        model = A2C.load(path)
        assert model.env_spec["kwargs"] == {"entry": "mpe2.simple_spread_v3", "continuous_actions": True}
        mean, _ = evaluate_policy(SharedPolicy(model), gymnasium.make(SPREAD, continuous_actions=True), 1, warn=False)
        assert np.isfinite(mean)


def test_wrappers_for_single_agents_are_refused(capsys):
    Path("r.yml").write_text(yaml.safe_dump({SPREAD: {"n_timesteps": 9, "policy": "MlpPolicy", "frame_stack": 2}}))
    assert main(["train", "--algo", "ppo", "--env", SPREAD, "--conf-file", "r.yml"]) == 2
    assert "frame_stack in the recipe: ppo shares its policy" in capsys.readouterr().err


@pytest.mark.parametrize("env_id", [SPREAD, TAG, SWARM])
def test_the_packaged_recipes_for_ppo_train(env_id):
    small = ["-params", "n_envs:1", "n_steps:25", "batch_size:25"]
    argv = ["train", "--algo", "ppo", "--env", env_id, "-n", "50", *small, "--eval-freq", "-1", "--verbose", "0"]
    assert main(argv) == 0
    assert PPO.load(latest_model("latest:logs", "ppo", env_id)).num_timesteps >= 50


@pytest.mark.parametrize("env_id", [SPREAD, SWARM])
def test_wrappers_of_supersuit_in_recipes_for_a_team(env_id):
    stack = {"supersuit.frame_stack_v2": {"stack_size": 3}}
    plain = gymnasium.make(env_id).observation_space.obs_dims
    env = gymnasium.make(env_id, wrappers=[stack, "supersuit.clip_reward_v0", "supersuit.agent_indicator_v0"])
    assert env.observation_space.obs_dims == tuple(3 * size + len(plain) for size in plain)
    env.reset(seed=0)
    observation, reward, *_ = env.step(env.action_space.sample())
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
