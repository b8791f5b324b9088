"""What TensorBoard shows beside the curves."""

import gymnasium
import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from quad_swarm.evaluation.flight import Condition, run_episodes
from quad_swarm.figures import dashboard
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import without_obstacles
from sb3_maddpg import MADDPG, DashboardCallback, pretrained
from sb3_maddpg.cli.main import main
from sb3_maddpg.common.callbacks import hyperparameters
from sb3_maddpg.hub.pretrained import pretrained_folder
from sb3_maddpg.team.toys import OwnBit


def events(folder) -> EventAccumulator:
    (file,) = folder.rglob("events.*")
    return EventAccumulator(str(file)).Reload()


@pytest.mark.slow
def test_the_zoo_logs_pictures_hyperparameters_and_the_swarms_layout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recipe = {"n_timesteps": 60, "policy": "MlpPolicy", "learning_starts": 20, "train_freq": 10, "batch_size": 16}
    recipe["env_kwargs"] = {"n_robots": 3, "max_steps": 10}
    (tmp_path / "recipe.yml").write_text(yaml.safe_dump({"QuadSwarm-v0": recipe}))
    argv = ["train", "--env", "QuadSwarm-v0", "--conf-file", "recipe.yml", "--tensorboard-log", "tb", "--verbose", "0"]
    assert main([*argv, "--eval-freq", "30", "--eval-episodes", "1", "--log-interval", "1"]) == 0
    seen = events(tmp_path / "tb")
    for tag in (*(f"eval/flight/{name}" for name in without_obstacles()), "symmetric_swap/requests_by_pair"):
        assert [picture.step for picture in seen.Images(tag)] == [30, 60]
        assert all(len(picture.encoded_image_string) > 2000 for picture in seen.Images(tag))
    assert 0 <= seen.Scalars("symmetric_swap/request_share")[-1].value <= 1
    assert {"_hparams_/experiment", "_hparams_/session_start_info"} <= set(seen.summary_metadata)
    (layout,) = seen.Tensors("custom_scalars__config__")
    shown = layout.tensor_proto.string_val[0]
    assert all(word in shown for word in (b"Safety", b"Communication", b"Learning", b"symmetric_swap/request_share"))
    logged = set(seen.Tags()["scalars"])
    charts = [tags for group in dashboard.LAYOUT.values() for _, tags in group.values()]
    assert all(len(tags) == 1 and logged >= set(tags) for tags in charts), "two tags of a run have one colour"
    first = {tag for charts in list(dashboard.LAYOUT.values())[:-1] for _, tags in charts.values() for tag in tags}
    assert not first & {"planner/failure_rate", "reward/requests", "time/fps"}, "flat where all goes well"


def test_pairs_are_counted_as_episodes_are():
    path = str(pretrained_folder("quad-swarm-paper") / "model.zip")
    model = pretrained("quad-swarm-paper", device="cpu")
    condition = Condition(path, "symmetric_swap", make_config("paper"), linger=5)
    asked, possible, steps, collisions = dashboard.requests_by_pair(condition, model)
    first = dashboard.first_episode(dashboard.SET)
    rows = run_episodes(condition, range(first, first + dashboard.EPISODES))
    assert asked.sum() == sum(row["requests"] for row in rows) > 0
    assert steps == sum(row["steps_counted"] for row in rows)
    assert possible == sum(row["possible_requests"] for row in rows)
    assert collisions == sum(row["collided"] for row in rows)
    assert not np.diag(asked).any()


@pytest.mark.slow
def test_scenarios_with_obstacles_are_drawn_if_they_are_trained(monkeypatch):
    monkeypatch.setattr(dashboard, "EPISODES", 1)
    known = {"preset": "flight", "n_robots": 3, "max_steps": 10, "scenario": "forest"}
    model = MADDPG("MlpPolicy", gymnasium.make("QuadSwarm-v0", **known), seed=0)
    drawn = {tag for tag in dashboard.draw(model, known) if tag.startswith("eval/flight/")}
    assert drawn == {f"eval/flight/{name}" for name in ("forest", *without_obstacles())}


@pytest.mark.parametrize("algorithm", [MADDPG, PPO])
def test_with_the_api_alone(algorithm, tmp_path):
    drawn = []

    def draw(model):
        drawn.append(model.num_timesteps)
        return {"team/picture": Figure(), "team/number": 3.0}

    small = (
        {"batch_size": 16, "n_steps": 16}
        if algorithm is PPO
        else {"learning_starts": 10, "batch_size": 8, "train_freq": 8}
    )
    model = algorithm("MlpPolicy", OwnBit(), tensorboard_log=str(tmp_path), seed=0, **small)
    callback = DashboardCallback(draw)
    model.learn(64, callback=EvalCallback(OwnBit(), callback_after_eval=callback, eval_freq=32, n_eval_episodes=1))
    assert drawn == [32, 64]
    seen = events(tmp_path)
    assert [picture.step for picture in seen.Images("team/picture")] == drawn
    assert [number.value for number in seen.Scalars("team/number")] == [3.0, 3.0]
    known = hyperparameters(model)
    assert known["algo"] == algorithm.__name__
    assert known["gamma"] == 0.99 if algorithm is PPO else known["gamma"] == model.gamma
    assert known["batch_size"] == small["batch_size"]


def test_without_tensorboard_nothing_is_drawn():
    model = MADDPG("MlpPolicy", OwnBit(), learning_starts=10, batch_size=8, train_freq=8)
    evaluation = EvalCallback(
        OwnBit(), callback_after_eval=DashboardCallback(lambda model: 1 / 0), eval_freq=16, n_eval_episodes=1
    )
    model.learn(32, callback=evaluation)
    assert model.num_timesteps == 32
