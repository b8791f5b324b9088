"""Trainings from the command line: folders, logs, schedules."""

import errno
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from stable_baselines3.common.logger import configure

from sb3_maddpg import MADDPG
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.runs import claim_folder
from sb3_maddpg.team.toys import OwnBit

RECIPE = {
    "n_timesteps": 400,
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "learning_starts": 50,
    "train_freq": 10,
    "batch_size": 16,
    "buffer_size": 1000,
    "learning_rate": "lin_0.01",
}
WITHOUT_RL_ZOO3 = """
import sys
import tempfile
sys.modules["rl_zoo3"] = None
from sb3_maddpg import MADDPG
model = MADDPG.load(sys.argv[1])
print(model.learning_rate(0.5), model.lr_schedule(0.25))
"""


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def train(*argv: str, env: str = "OwnBit-v0", **changes) -> int:
    Path("recipe.yml").write_text(yaml.safe_dump({env: {**RECIPE, **changes}}))
    return main(["train", "--env", env, "--conf-file", "recipe.yml", "--eval-freq", "-1", "--seed", "1", *argv])


def test_a_folder_has_one_owner(tmp_path):
    with ThreadPoolExecutor(4) as pool:
        claimed = list(pool.map(lambda _: claim_folder(str(tmp_path / "logs" / "run"), 1), range(100)))
    assert len(set(claimed)) == 100
    assert sorted(os.listdir(tmp_path / "logs")) == sorted(f"run_{number}" for number in range(1, 101))
    assert claim_folder(str(tmp_path / "logs" / "run"), 5, "_unique").name == "run_5_unique"


def test_trainings_that_start_together_keep_their_own_files(monkeypatch):
    # Both have looked for the newest run before either made its folder
    monkeypatch.setattr("sb3_maddpg.cli.training.latest_number", lambda path, name: 0)
    for _ in range(2):
        assert train("-tb", "tb", "-n", "60", "--verbose", "0") == 0
    assert sorted(os.listdir("logs/maddpg")) == ["OwnBit-v0_1", "OwnBit-v0_2"]
    assert sorted(os.listdir("tb/OwnBit-v0")) == ["MADDPG_1", "MADDPG_2"]
    assert all((run / "OwnBit-v0.zip").is_file() for run in Path("logs/maddpg").iterdir())


def test_a_folder_that_cannot_be_made_is_one_line(capsys):
    Path("logs").write_text("a file")
    assert train("--verbose", "0") == 1
    error = capsys.readouterr().err
    assert error.startswith("error: logs")
    assert error.count("\n") == 1


def test_a_full_disk_is_named_with_the_remedy(monkeypatch, capsys):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)  # of evaluations
    assert train("--eval-freq", "100", "--verbose", "0") == 1
    run = "logs/maddpg/OwnBit-v0_1"
    remedy = f"error: {run}: No space left on device: free space, then continue with `train --resume {run}`"
    assert remedy in capsys.readouterr().err
    assert train("--eval-freq", "100", "--verbose", "0", "--checkpoint-every", "0") == 1
    assert "OwnBit-v0_2: No space left on device: free space (" in capsys.readouterr().err


@pytest.mark.slow
def test_tables_come_at_a_readable_rate_and_short_trainings_log_their_rewards(capsys):
    assert train() == 0  # 400 steps
    assert capsys.readouterr().out.count("ep_rew_mean") == 1
    assert train("-n", "3500") == 0
    assert capsys.readouterr().out.count("ep_rew_mean") == 4  # after each thousand, and at the end
    assert train("-n", "400", "--log-interval", "1") == 0
    assert capsys.readouterr().out.count("ep_rew_mean") > 4  # by episodes


def test_a_training_that_ends_before_it_learns_says_so(capsys):
    assert train("-n", "50") == 0
    assert "Nothing was learned: learning_starts=50, and there were 50 steps" in capsys.readouterr().out
    assert train("-n", "60") == 0
    assert "Nothing was learned" not in capsys.readouterr().out


def test_a_training_in_which_no_episode_ends_says_so(capsys):
    learned = MADDPG("MlpPolicy", OwnBit(), learning_starts=1, train_freq=1, batch_size=4, buffer_size=100, verbose=1)
    learned.learn(2)
    assert "No episode ended in 2 steps" in capsys.readouterr().out
    learned.learn(200)
    assert "No episode ended" not in capsys.readouterr().out


def test_a_progress_bar_stands_alone(capsys):
    assert train("--progress", "-tb", "tb") == 0
    out = capsys.readouterr().out
    assert "ep_rew_mean" not in out
    assert "Mean reward: " in out
    assert list(Path("tb").rglob("events*"))


@pytest.mark.slow
def test_a_model_loads_where_rl_zoo3_is_not_installed():
    assert train("--verbose", "0") == 0
    path = "logs/maddpg/OwnBit-v0_1/OwnBit-v0.zip"
    command = [sys.executable, "-c", WITHOUT_RL_ZOO3, path]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert list(map(float, shown.split())) == pytest.approx([0.005, 0.0025])
    # Up to rounding what rl_zoo3's schedule says
    schedule = MADDPG.load(path).learning_rate
    assert all(schedule(k / 997) == pytest.approx(k / 997 * 0.01, rel=1e-12, abs=1e-15) for k in range(998))


def test_a_team_of_another_size_goes_on_with_the_trained_networks(capsys):
    gymnasium.register("Neighbours-v0", entry_point="toys:Neighbours")
    recipe = {"n_timesteps": 60, "policy": "PairPolicy", "learning_starts": 20, "buffer_size": 1000, "batch_size": 16}
    Path("recipe.yml").write_text(
        yaml.safe_dump({"Neighbours-v0": {**recipe, "policy_kwargs": {"net_arch": [8]}, "train_freq": 5}})
    )
    try:
        argv = ["train", "--env", "Neighbours-v0", "--conf-file", "recipe.yml", "--eval-freq", "-1", "--verbose", "0"]
        assert main([*argv, "--env-kwargs", "n_agents:3"]) == 0
        small = "logs/maddpg/Neighbours-v0_1/Neighbours-v0.zip"
        # No update before the end, so that the networks are those of the small team
        further = ["--env-kwargs", "n_agents:5", "-i", small, "-params", "learning_starts:60", "gamma:0.5"]
        assert main([*argv, *further]) == 0
    finally:
        del gymnasium.registry["Neighbours-v0"]
    assert "a team of 5 instead of 3, from step 0" in capsys.readouterr().out
    trained, resized = (MADDPG.load(path) for path in (small, "logs/maddpg/Neighbours-v0_2/Neighbours-v0.zip"))
    assert (resized.policy.team.n_agents, resized.num_timesteps, resized.gamma) == (5, 60, 0.5)
    assert resized.policy.net_arch == [8]
    assert (resized.policy.parameters_to_vector() == trained.policy.parameters_to_vector()).all()


def test_trainings_leave_no_empty_folders_among_the_temporary_files(tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert train("--verbose", "0") == 0
    model = MADDPG("MlpPolicy", OwnBit(), learning_starts=20, batch_size=8, verbose=1)
    model.learn(40).learn(20, reset_num_timesteps=False)
    assert not list((tmp_path / "temporary").glob("SB3-*"))
    own = configure(str(tmp_path / "SB3-own"), ["csv"])
    model.set_logger(own)
    model.learn(40)
    assert (tmp_path / "SB3-own/progress.csv").exists()


@pytest.mark.parametrize("changes", [{"gamma": 7.0}, {"policy": "Nope"}, {"env_kwargs": {"nothing": 1}}])
def test_a_training_that_is_refused_leaves_no_run(changes, capsys):
    assert train(**changes) == 2
    assert "error: " in capsys.readouterr().err
    assert not any(Path("logs").rglob("*.csv"))
    assert not any(Path("logs").rglob("OwnBit*"))
    assert train() == 0
    assert Path("logs/maddpg/OwnBit-v0_1/OwnBit-v0.zip").is_file()
