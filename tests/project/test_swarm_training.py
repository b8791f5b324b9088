"""The two packages together: training on the swarm, from recipes and by hand, and judging what was trained."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import quad_swarm
from quad_swarm.evaluation.command import main as evaluate
from sb3_maddpg import MADDPG
from sb3_maddpg.cli.main import main as zoo
from studies.swarm.training_time import measure

ROOT = Path(__file__).parents[2]

SMALL = {
    "learning_starts": 30,
    "train_freq": 20,
    "batch_size": 32,
    "buffer_size": 2000,
    "policy_kwargs": {"net_arch": [8]},
}
TEAM = {"scale_observation": True, "scenario": "random", "n_robots": 3}


def evaluate_rows(tmp_path, *arguments: str) -> list[dict]:
    target = tmp_path / "rows.json"
    assert evaluate([*arguments, "--scenario", "random", "--episodes", "2", "--json", str(target)]) == 0
    return json.loads(target.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_learns_in_several_environments_and_is_judged_by_its_own_observation(vec_env_cls, tmp_path):
    # With its module's name, so that fresh processes know the id too.
    env = make_vec_env("quad_swarm:QuadSwarm-v0", 2, env_kwargs=TEAM, vec_env_cls=vec_env_cls)
    model = MADDPG("MlpPolicy", env, seed=0, **SMALL)
    model.learn(120)
    env.close()
    assert model._n_updates > 0
    model.save(tmp_path / "model")
    (row,) = evaluate_rows(tmp_path, "--policy", str(tmp_path / "model.zip"), "--n-robots", "3")
    # Flown by hand with the arguments that the model carries.
    loaded = MADDPG.load(tmp_path / "model")
    assert loaded.env_spec == {"id": "QuadSwarm-v0", "kwargs": TEAM}
    requests = steps = 0
    for seed in (10**9, 10**9 + 1):
        team = quad_swarm.QuadSwarmEnv(**loaded.env_spec["kwargs"])
        observation, _ = team.reset(seed=seed)
        while True:
            bits, _ = loaded.predict(observation, deterministic=True)
            observation, _, _, _, info = team.step(bits)
            requests, steps = requests + info["n_requests"], steps + 1
            if info["at_goal"].all():
                break
    assert row["requests_per_step"] == requests / steps


@pytest.mark.parametrize("algo", ["maddpg", "ppo"])
def test_recipes_can_step_many_swarms_in_one_call(algo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = {"learning_starts": 30, "train_freq": 10} if algo == "maddpg" else {"n_steps": 16, "batch_size": 32}
    recipe = {
        "n_timesteps": 160,
        "n_envs": 4,
        "vec_env": "gymnasium",
        "policy": "MlpPolicy",
        "env_kwargs": {"scenario": "curriculum", "scale_observation": True, "max_steps": 12},
        "eval_env_kwargs": {"scenario": "mixed"},
        "callback": [{"sb3_maddpg.callbacks.CurriculumCallback": {"success_threshold": 0.01, "window": 1}}],
        **own,
    }
    (tmp_path / "recipe.yml").write_text(yaml.safe_dump({"QuadSwarm-v0": recipe}))
    argv = ["train", "--algo", algo, "--env", "QuadSwarm-v0", "--conf-file", "recipe.yml", "--verbose", "0"]
    assert zoo([*argv, "--eval-freq", "80", "--eval-episodes", "1", "--n-eval-envs", "1"]) == 0
    run = tmp_path / "logs" / algo / "QuadSwarm-v0_1"
    assert yaml.unsafe_load((run / "QuadSwarm-v0" / "config.yml").read_text())["vec_env"] == "gymnasium"
    model = (MADDPG if algo == "maddpg" else PPO).load(run / "QuadSwarm-v0.zip")
    assert model.num_timesteps >= 160
    assert model.env_spec["kwargs"] == recipe["env_kwargs"]
    judge = ["evaluate", "--algo", algo, "--env", "QuadSwarm-v0", "--policy", "none", "latest:logs", "--trust"]
    assert zoo([*judge, "--scenario", "random", "--episodes", "1"]) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vec_env": "ray"}, "only 'gymnasium' is known"),
        ({"vec_env": "gymnasium", "frame_stack": 2}, "cannot be combined with frame_stack"),
        ({"env_kwargs": {"presett": "paper"}}, "Unknown argument of QuadSwarm-v0 'presett': did you mean 'preset'?"),
        ({"env_kwargs": {"preset": "papier"}}, "Did you mean 'paper'"),
        ({"callback": [{"sb3_maddpg.callbacks.CurriculumCallback": {"window": 0}}]}, "window=0"),
    ],
)
def test_recipes_with_mistakes_are_refused(change, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    recipe = {"n_timesteps": 10, "policy": "MlpPolicy", **change}
    (tmp_path / "recipe.yml").write_text(yaml.safe_dump({"QuadSwarm-v0": recipe}))
    argv = ["train", "--env", "QuadSwarm-v0", "--conf-file", "recipe.yml", "--verbose", "0", "--eval-freq", "-1"]
    assert zoo(argv) in (1, 2)
    assert message in capsys.readouterr().err


def test_a_model_for_another_number_of_robots_is_refused(tmp_path, capsys):
    MADDPG("MlpPolicy", quad_swarm.QuadSwarmEnv(n_robots=3), **SMALL).save(tmp_path / "three")
    assert evaluate(["--policy", str(tmp_path / "three.zip"), "--scenario", "random"]) == 1
    assert "was trained for 3 robots" in capsys.readouterr().err
    with pytest.raises(ValueError, match="env_spec"):
        MADDPG.load(tmp_path / "three", env=quad_swarm.QuadSwarmEnv(n_robots=4))


def test_a_truncated_model_is_refused(tmp_path, capsys):
    path = tmp_path / "model.zip"
    MADDPG("MlpPolicy", quad_swarm.QuadSwarmEnv(), **SMALL).save(path)
    path.write_bytes(path.read_bytes()[:-500])
    assert evaluate(["--policy", str(path), "--scenario", "random"]) == 1
    assert "Is the file complete" in capsys.readouterr().err


def test_ppo_is_judged_too(tmp_path):
    env = quad_swarm.QuadSwarmEnv()
    PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0).learn(8).save(tmp_path / "ppo")
    model = str(tmp_path / "ppo.zip")
    ppo, full = evaluate_rows(tmp_path, "--policy", model, "full", "--algo", "stable_baselines3:PPO")
    assert 0 < ppo["request_share"] < full["request_share"] == 1


def test_not_a_number_is_named(tmp_path):
    model = MADDPG("MlpPolicy", quad_swarm.QuadSwarmEnv(), **SMALL)
    observation = np.zeros((4, 24), dtype=np.float32)
    observation[2, 5] = np.nan
    with pytest.raises(ValueError, match=r"agent\(s\) robot_2"):
        model.predict(observation)


@pytest.mark.parametrize("recipe", sorted((ROOT / "zoo_configs").glob("quad_swarm_*.yml")), ids=lambda path: path.stem)
def test_where_the_time_of_a_recipe_goes(recipe):
    row = measure(str(recipe), 128)
    assert row["steps"] >= 128
    shares = {key: row[key] for key in row if key.startswith("share_")}
    assert set(shares) == {"share_planner", "share_learner", "share_acting", "share_rest"}
    assert shares["share_planner"] > 0
    assert sum(shares.values()) == pytest.approx(1)
