"""Models for robots: for which world, and what cannot be exported. `robot.test_files` reads what is written."""

import gymnasium
import numpy as np
import pytest

from quad_swarm.evaluation.export import export, main
from quad_swarm.evaluation.policies import fitted, load_model
from quad_swarm.robot import files
from quad_swarm.robot.files import load
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm
from sb3_maddpg import MADDPG
from sb3_maddpg.hub.pretrained import pretrained_folder

pytest.importorskip("onnxruntime")
MODEL = str(pretrained_folder("quad-swarm-flight") / "model.zip")


@pytest.mark.slow
def test_the_command_writes_the_preset_of_the_training(tmp_path, capsys):
    assert main([MODEL, "--n-robots", "2", "--world", "noise.wind=0", "--out", str(tmp_path / "robots")]) == 0
    assert "2 robots in 'flight', 63 columns, 2 bits" in capsys.readouterr().out
    assert load(tmp_path / "robots").config == make_config("flight", {"noise": {"wind": 0.0}}, n_robots=2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none", "--out", "x"], "'none' is no model"),
        ([MODEL, "--world", "neighbourhood.max_others=2", "--out", "x"], "perceives all others"),
    ],
)
def test_the_command_refuses_what_cannot_be_exported(words, message):
    with pytest.raises(ValueError, match=message):
        main(words)


@pytest.mark.parametrize("share", [False, [["robot_0", "robot_1"], ["robot_2"]]])
def test_teams_whose_robots_have_different_actors_are_refused(share, tmp_path):
    env = gymnasium.make("QuadSwarm-v0", preset="paper", n_robots=3)
    path = tmp_path / "model.zip"
    MADDPG("MlpPolicy", env, policy_kwargs={"net_arch": [8], "share_actor": share}, buffer_size=2000).save(path)
    with pytest.raises(ValueError, match="its robots have different actors"):
        export(str(path), make_config("paper", n_robots=3), tmp_path / "robots")
    assert not (tmp_path / "robots").exists()


def test_an_export_that_fails_leaves_nothing(tmp_path, monkeypatch):
    def broken(*args):
        raise ValueError("the disc is full")

    monkeypatch.setattr(files, "write", broken)
    with pytest.raises(ValueError, match="disc is full"):
        export(MODEL, make_config("flight", n_robots=2), tmp_path / "robots")
    assert not list(tmp_path.iterdir())


def test_an_export_is_not_replaced_by_one_for_another_world(tmp_path):
    export(MODEL, make_config("flight", n_robots=2), tmp_path)
    before = (tmp_path / files.DESCRIPTION).read_bytes()
    with pytest.raises(ValueError, match=r"another world, with radius=0\.3 instead of 0\.15: choose"):
        export(MODEL, make_config("flight", n_robots=2, radius=0.15), tmp_path)
    assert (tmp_path / files.DESCRIPTION).read_bytes() == before
    (tmp_path / files.DESCRIPTION).write_text("damaged")
    export(MODEL, make_config("flight", n_robots=2, radius=0.15), tmp_path)
    assert load(tmp_path).config.radius == 0.15


@pytest.mark.slow
def test_programs_answer_as_the_model_without_what_critics_see(tmp_path):
    config = make_config("flight", n_robots=3)
    actor, model = export(MODEL, config, tmp_path).actor(), load_model(MODEL, "sb3_maddpg:MADDPG")
    predictor, observation, n_bits = fitted(model, MODEL, config)
    swarm, rng = Swarm(config), np.random.default_rng(0)
    _, starts, goals, _ = ScenarioSampler("symmetric_swap", 3, config.space, config).sample(rng)
    swarm.reset(0, starts, goals, noise_seed=1)
    asked = 0
    for _ in range(20):
        bits = predictor.predict(observation(swarm), deterministic=True)[0].reshape(3, 2, n_bits) > 0
        mine = actor._run(actor.observation(swarm)[0]).reshape(3, 2, n_bits) > 0
        assert np.array_equal(mine, bits)
        asked += bits.sum()
        swarm.step(bits[None, ..., 0])
    assert asked
