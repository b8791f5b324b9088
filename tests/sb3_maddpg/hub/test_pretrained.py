"""Models that come with the package: they load, and fly as well as when they were shipped."""

import subprocess
import sys
from hashlib import sha256
from importlib.resources import files

import gymnasium
import numpy as np
import pytest

from quad_swarm.evaluation import Condition, run_episodes, summarise
from quad_swarm.world.presets import make_config
from sb3_maddpg import MADDPG, pretrained
from sb3_maddpg.files.model_files import refuse_pickled
from sb3_maddpg.hub.pretrained import pretrained_folder, pretrained_models

# Model -> world, and for numbers of robots the largest share of requests in the symmetric swap: 1.3 times its own.
SHIPPED = {
    "quad-swarm-any": ("dense", {8: 0.17, 12: 0.18}),
    "quad-swarm-dense": ("dense", {8: 0.122}),
    "quad-swarm-flight": ("flight", {8: 0.011}),
    "quad-swarm-flight-v2": ("flight-v2", {8: 0.0346}),
    "quad-swarm-flight-v3": ("flight-v3", {8: 0.001, 16: 0.003}),
    "quad-swarm-paper": ("paper", {4: 0.04}),
}


def test_every_shipped_model_is_tested():
    assert list(pretrained_models()) == sorted(SHIPPED)


def test_shipped_models_are_the_recorded_files_and_hold_no_pickle():
    sums = files("quad_swarm.models").joinpath("SHA256SUMS").read_text().splitlines()
    recorded = {name: digest for digest, name in (line.split() for line in sums)}
    paths = {f"{name}/model.zip": folder / "model.zip" for name, folder in pretrained_models().items()}
    assert {name: sha256(path.read_bytes()).hexdigest() for name, path in paths.items()} == recorded
    for path in paths.values():
        refuse_pickled(path, {})


@pytest.mark.slow
@pytest.mark.parametrize(("name", "n_robots"), [(name, n) for name, (_, most) in SHIPPED.items() for n in most])
def test_flies_safely_and_asks_seldom(name, n_robots):
    preset, most = SHIPPED[name]
    config = make_config(preset, n_robots=n_robots)
    path = str(pretrained_folder(name) / "model.zip")
    figures = {}
    for policy in (path, "none"):
        condition = Condition(policy, "symmetric_swap", config, linger=5)
        figures[policy] = summarise(run_episodes(condition, range(150)), config)
    predicts = config.predictor is not None
    assert (figures["none"]["collisions"] > 75) != predicts, "the world is a dangerous one without a predictor"
    assert figures[path]["collisions"] <= 3
    assert (0 if predicts else 0.005) < figures[path]["request_share"] < most[n_robots]


@pytest.mark.parametrize("name", SHIPPED)
def test_acts_in_its_environment_and_in_a_larger_team(name):
    model = pretrained(name)
    trained = next(iter(SHIPPED[name][1]))
    for n_robots in (trained, trained + 1):
        env = gymnasium.make("QuadSwarm-v0", **{**model.env_spec["kwargs"], "n_robots": n_robots})
        loaded = pretrained(name, env=env)
        obs, _ = env.reset(seed=0)
        bits, _ = loaded.predict(obs, deterministic=True)
        assert bits.shape == env.action_space.shape
        assert loaded.policy.threshold == model.policy.threshold
        for what in ("batch_size", "buffer_size", "gamma", "n_steps", "replay_buffer_class", "threshold_price"):
            assert getattr(loaded, what) == getattr(model, what), what
        assert type(loaded.replay_buffer) is model.replay_buffer_class
        for old, new in zip(model.actor.parameters(), loaded.actor.parameters(), strict=True):
            assert np.array_equal(old.detach(), new.detach())


def test_says_what_there_is_and_what_does_not_fit():
    with pytest.raises(ValueError, match="did you mean 'quad-swarm-paper'"):
        pretrained("quad_swarm_paper")
    with pytest.raises(ValueError, match="other observations"):
        pretrained("quad-swarm-paper", env=gymnasium.make("QuadSwarm-v0", observation="state"))


def test_belongs_to_a_recipe_a_command_and_results():
    for name in pretrained_models():
        assert {"model.zip", "config.yml", "command.txt", "metrics.json"} <= {
            p.name for p in pretrained_folder(name).iterdir()
        }


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_loads_without_the_zoo(name):
    code = f"""
import sys
sys.modules["rl_zoo3"] = None
from sb3_maddpg import MADDPG, pretrained
model = pretrained({name!r})
assert model.lr_schedule(1.0) == 1e-3 and model.lr_schedule(0.0) == 0.0
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_model_is_read_once(monkeypatch):
    paths, load = [], MADDPG.load.__func__

    def counted(cls, path, **kwargs):
        paths.append(path)
        return load(cls, path, **kwargs)

    monkeypatch.setattr(MADDPG, "load", classmethod(counted))
    model = pretrained("quad-swarm-paper")
    for n_robots in (4, 5):
        env = gymnasium.make("QuadSwarm-v0", **{**model.env_spec["kwargs"], "n_robots": n_robots})
        assert pretrained("quad-swarm-paper", env=env, batch_size=77).batch_size == 77
    assert len(paths) == 3
