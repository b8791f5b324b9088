"""The command line, with a package of its own that brings an environment, a callback and an evaluator."""

import argparse
import importlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
import yaml

from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.options import StoreValues

PACKAGE = """
import json, sys
import gymnasium
from stable_baselines3.common.callbacks import BaseCallback
from sb3_maddpg.team.toys import OwnBit

MADE = []  # arguments of every environment, in order
PROGRESS = []

class Arena(OwnBit):
    def __init__(self, flavour="plain", spice=0, render_mode=None):
        super().__init__(render_mode=render_mode)
        MADE.append({"flavour": flavour, "spice": spice, "render_mode": render_mode})

class Watch(BaseCallback):
    def __init__(self, interrupt_at=-1):
        super().__init__()
        self.interrupt_at = interrupt_at
    def _on_step(self):
        PROGRESS.append(self.model._current_progress_remaining)
        if self.num_timesteps == self.interrupt_at:
            raise KeyboardInterrupt
        return True

def evaluate(argv):
    print(json.dumps(argv))
    return 3

if "Arena-v0" not in gymnasium.registry:
    gymnasium.register("Arena-v0", entry_point="arena:Arena")
"""
RECIPE = {
    "n_timesteps": 200,
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "learning_starts": 100,
    "train_freq": 10,
    "batch_size": 16,
    "buffer_size": 1000,
    "learning_rate": "lin_0.01",
    "noise_type": None,
    "env_kwargs": {"flavour": "sweet", "spice": 1},
    "eval_env_kwargs": {"flavour": "sour"},
    "callback": ["arena.Watch"],
}


@pytest.fixture
def arena(tmp_path, monkeypatch):
    """An installed package, as far as Python can tell."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "arena.py").write_text(PACKAGE)
    info = tmp_path / "site" / "arena-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: arena\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[sb3_maddpg.environments]\narena = arena\n[sb3_maddpg.evaluators]\nArena-v0 = arena:evaluate\n"
    )
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.chdir(tmp_path)
    sys.modules.pop("arena", None)
    yield importlib.import_module("arena")
    sys.modules.pop("arena", None)


def write(recipe: dict, env: str = "Arena-v0") -> str:
    with open("recipe.yml", "w") as file:
        yaml.safe_dump({env: recipe}, file)
    return "recipe.yml"


def train(*argv: str, recipe: dict | None = None) -> int:
    conf = write({**RECIPE, **(recipe or {})})
    return main(["train", "--env", "Arena-v0", "--conf-file", conf, "--verbose", "0", "--seed", "1", *argv])


def test_arguments_of_the_environment_reach_training_and_evaluation(arena, tmp_path, capsys):
    assert train("--env-kwargs", "spice:7", "--eval-freq", "100", "--eval-episodes", "1") == 0
    assert {(made["flavour"], made["spice"]) for made in arena.MADE} == {("sweet", 7), ("sour", 7)}
    run = tmp_path / "logs" / "maddpg" / "Arena-v0_1"
    assert {"Arena-v0.zip", "best_model.zip", "0.monitor.csv"} <= {path.name for path in run.iterdir()}
    assert yaml.safe_load((run / "Arena-v0" / "config.yml").read_text())["env_kwargs"] == {
        "flavour": "sweet",
        "spice": 7,
    }
    assert MADDPG.load(run / "Arena-v0.zip").env_spec == {"id": "Arena-v0", "kwargs": {"flavour": "sweet", "spice": 7}}
    assert "logs/maddpg/Arena-v0_1/Arena-v0.zip" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["preset:dense", "n_robots:8"], {"preset": "dense", "n_robots": 8}),
        (["preset:'dense'", "flag:False", "none:None"], {"preset": "dense", "flag": False, "none": None}),
        (["observation:state+memory", "rate:lin_0.01"], {"observation": "state+memory", "rate": "lin_0.01"}),
        (
            ["scenario:{'random': 1}", "policy_kwargs:dict(net_arch=[8])"],
            {"scenario": {"random": 1}, "policy_kwargs": {"net_arch": [8]}},
        ),
        (["scenario:all", "path:a:b"], {"scenario": "all", "path": "a:b"}),
    ],
)
def test_arguments_are_words_or_python(words, meant):
    parser = argparse.ArgumentParser()
    parser.add_argument("--env-kwargs", nargs="+", action=StoreValues)
    assert parser.parse_args(["--env-kwargs", *words]).env_kwargs == meant


@pytest.mark.parametrize("word", ["preset", "preset:", "n:1/0"])
def test_an_argument_without_a_value_is_refused(arena, capsys, word):
    assert train("--env-kwargs", word) == 2
    error = capsys.readouterr().err
    assert f"--env-kwargs {word!r}: " in error
    assert error.endswith("Write key:value. (--debug shows the traceback)\n")


def test_resuming_goes_on_where_training_ended(arena):
    assert train("--eval-freq", "-1", "--save-replay-buffer") == 0
    assert arena.PROGRESS[0] == pytest.approx(1.0, abs=0.01)
    arena.PROGRESS.clear()
    assert train("--eval-freq", "-1", "--save-replay-buffer", "-i", "logs/maddpg/Arena-v0_1/Arena-v0.zip") == 0
    model = MADDPG.load("logs/maddpg/Arena-v0_2/Arena-v0.zip")
    assert model.num_timesteps == 400
    # 100 steps of warm-up, once, then an update every 10 steps
    assert model._n_updates == 30
    # The schedule goes on instead of starting again
    assert arena.PROGRESS[1] == pytest.approx(0.5, abs=0.01)
    model.load_replay_buffer("logs/maddpg/Arena-v0_2/replay_buffer.pkl")
    assert model.replay_buffer.size() == 400


def test_an_interrupted_training_is_saved(arena):
    recipe = {"callback": [{"arena.Watch": {"interrupt_at": 150}}]}
    assert train("--eval-freq", "-1", "--progress", recipe=recipe) == 130
    assert MADDPG.load("logs/maddpg/Arena-v0_1/Arena-v0.zip").num_timesteps == 150


def test_a_recipe_names_its_replay_buffer_by_a_dotted_path(arena):
    name = "sb3_maddpg.PrioritizedTeamReplayBuffer"
    assert train(recipe={"replay_buffer_class": name, "replay_buffer_kwargs": {"alpha": 0.3}}) == 0
    run = Path("logs/maddpg/Arena-v0_1")
    assert yaml.safe_load((run / "Arena-v0" / "config.yml").read_text())["replay_buffer_class"] == name
    model = MADDPG.load(run / "Arena-v0.zip", env=gymnasium.make("Arena-v0"))
    assert type(model.replay_buffer) is PrioritizedTeamReplayBuffer
    assert model.replay_buffer.alpha == 0.3


@pytest.mark.parametrize(
    ("recipe", "argv", "message"),
    [
        ({"replay_buffer_class": "sb3_maddpg.Prior"}, [], "no attribute 'Prior'). Use the dotted path of a class"),
        ({"estimatr": "score"}, [], "Unknown key in the recipe for maddpg 'estimatr': did you mean 'estimator'?"),
        ({}, ["-params", "taau:0.1"], "did you mean 'tau'?"),
        ({"policy_kwargs": {"net_arc": [8]}}, [], "did you mean 'net_arch'?"),
        ({"estimator": "expect"}, [], "did you mean 'expected'?"),
        ({"estimatr": "score"}, ["--algo", "matd3"], "Unknown key in the recipe for matd3 'estimatr': did you mean"),
        ({"target_policy_nois": 0.1}, ["--algo", "matd3"], "did you mean 'target_policy_noise'?"),
        ({"policy": "PairPolicy", "policy_kwargs": {"pair_credt": True}}, [], "did you mean 'pair_credit'?"),
    ],
)
def test_a_name_that_nothing_reads_is_refused(arena, capsys, recipe, argv, message):
    assert train(*argv, "--eval-freq", "-1", recipe=recipe) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_debug_shows_where_an_error_came_from(arena):
    with pytest.raises(ValueError, match="estimatr"):
        train("--debug", recipe={"estimatr": "score"})


def test_watching_and_recording_use_the_training_environment(arena, tmp_path, capsys):
    assert train("--env-kwargs", "spice:7", "--eval-freq", "-1") == 0
    for command in ("enjoy", "record"):
        arena.MADE.clear()
        assert main([command, "--env", "Arena-v0", "-n", "25", "--env-kwargs", "flavour:'salty'"]) == 0
        assert {(made["flavour"], made["spice"]) for made in arena.MADE} == {("salty", 7)}
    assert "2 Episodes" in capsys.readouterr().out
    (video,) = (tmp_path / "logs").rglob("*.mp4")
    assert video.stat().st_size > 500
    assert main(["enjoy", "--env", "Arena-v1"]) == 2
    assert "did you mean 'Arena-v0'" in capsys.readouterr().err


def test_record_tells_what_it_needs_before_it_begins(arena, monkeypatch, capsys):
    monkeypatch.setattr("sb3_maddpg.cli.show.find_spec", lambda name: None)
    assert main(["record", "--env", "Arena-v0"]) == 1
    assert "pip install -e '.[render]'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["enjoy", "record"])
def test_ctrl_c_while_watching_ends_with_the_usual_status(arena, capsys, command):
    assert train("--eval-freq", "-1") == 0
    step, taken = arena.Arena.step, []

    def interrupted(self, action):
        taken.append(action)
        if len(taken) == 15:
            signal.raise_signal(signal.SIGINT)
        return step(self, action)

    arena.Arena.step = interrupted
    assert main([command, "--env", "Arena-v0", "-n", "1000"]) == 130
    assert len(taken) == 15
    assert capsys.readouterr().err.endswith("Interrupted.\n")


def test_evaluation_is_handed_to_the_environments_evaluator(arena, capsys):
    runs = Path("logs/maddpg")
    for run, name in ((2, "Arena-v0.zip"), (2, "best_model.zip"), (10, "best_model.zip"), (11, "0.monitor.csv")):
        (runs / f"Arena-v0_{run}").mkdir(parents=True, exist_ok=True)
        (runs / f"Arena-v0_{run}" / name).touch()
    newest = "logs/maddpg/Arena-v0_10"
    assert main(["evaluate", "--env", "Arena-v0", "--policy", "none", "latest:logs", "--seed", "4"]) == 3
    assert json.loads(capsys.readouterr().out) == ["--policy", "none", f"{newest}/best_model.zip", "--seed", "4"]
    Path(newest, "Arena-v0.zip").touch()
    assert main(["evaluate", "--env", "Arena-v0", "latest:logs"]) == 3
    assert json.loads(capsys.readouterr().out) == [f"{newest}/Arena-v0.zip"]
    assert main(["evaluate", "--env", "Arena-v0", "--algo", "ppo", "none"]) == 3
    assert json.loads(capsys.readouterr().out) == ["none", "--algo", "stable_baselines3.ppo.ppo:PPO"]
    assert main(["evaluate", "--env", "Arena-v0", "--algo", "matd3", "none"]) == 3
    assert json.loads(capsys.readouterr().out) == ["none", "--algo", "sb3_maddpg.matd3.matd3:MATD3"]


@pytest.mark.parametrize(
    ("algo", "loader"),
    [
        ("sb3_maddpg:MADDPG", "sb3_maddpg:MADDPG"),  # the default of the command behind it
        ("stable_baselines3:PPO", "stable_baselines3:PPO"),
        ("my_loader:Outer.Inner", "my_loader:Outer.Inner"),
    ],
)
def test_the_class_that_loads_models_may_be_any(algo, loader, arena, tmp_path, capsys):
    (tmp_path / "my_loader.py").write_text("class Outer:\n    class Inner:\n        pass\n")
    assert main(["evaluate", "--env", "Arena-v0", "--algo", algo, "none"]) == 3
    assert json.loads(capsys.readouterr().out) == ["none", "--algo", loader]


@pytest.mark.parametrize("algo", ["sb3_maddpg:Nope", "no_such_module:Nope", "sb3_maddpg:", ":MADDPG"])
def test_a_class_that_does_not_exist_is_named(algo, arena, capsys):
    assert main(["evaluate", "--env", "Arena-v0", "--algo", algo, "none"]) == 2
    assert f"--algo '{algo}' is not an importable MODULE:CLASS" in capsys.readouterr().err


def test_examples_of_a_command_are_those_of_what_is_installed(arena, monkeypatch, capsys):
    for shown in ("  sb3-maddpg evaluate --env Arena-v0 --policy latest:logs\n", "  sb3-maddpg evaluate spicy\n"):
        assert main(["evaluate", "--env", "Arena-v0", "--help"]) == 3
        assert shown in capsys.readouterr().out
        monkeypatch.setattr(arena, "EXAMPLES", "  sb3-maddpg evaluate spicy\n", raising=False)


def test_an_environment_is_chosen_where_several_have_evaluators(arena, capsys):
    assert main(["evaluate", "none"]) == 2
    assert "--env is missing: choose one of Arena-v0, QuadSwarm-v0." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--env", "Arena-v0", "latest:logs"], "no trained model of maddpg for Arena-v0 in logs/maddpg"),
        (["--env", "Arena-v1", "none"], "did you mean 'Arena-v0'"),
        (["--env", "Arena-v0", "--algo", "madpg"], "did you mean 'maddpg'"),
    ],
)
def test_evaluation_that_cannot_be_is_refused(arena, capsys, argv, message):
    assert main(["evaluate", *argv]) == (1 if "latest:logs" in argv else 2)
    assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["maddpg", "ppo"])
def test_the_packaged_recipes_train_the_swarm(algo, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["learning_starts:50", "train_freq:25"] if algo == "maddpg" else ["n_steps:16", "batch_size:32"]
    argv = ["train", "--algo", algo, "--env", "QuadSwarm-v0", "-n", "100", "--eval-freq", "64", "--eval-episodes", "1"]
    assert main([*argv, "--n-eval-envs", "1", "-params", *small]) == 0
    assert (tmp_path / "logs" / algo / "QuadSwarm-v0_1" / "QuadSwarm-v0.zip").is_file()
    out = capsys.readouterr().out
    assert f"zoo_configs/{algo}.yml" in out
    assert "eval_env_kwargs={'preset': 'paper', 'scenario': 'mixed', 'scale_observation': True}" in out


@pytest.mark.slow
def test_as_a_command(tmp_path):
    command = [sys.executable, "-m", "sb3_maddpg"]
    shown = subprocess.run([*command, "--help"], capture_output=True, text=True, check=True, cwd=tmp_path).stdout
    assert all(word in shown for word in ("train", "enjoy", "record", "evaluate", "latest:LOGDIR"))
    argv = ["train", "--env", "OwnBit-v0", "-n", "600", "--vec-env", "subproc", "--eval-freq", "-1", "--verbose", "0"]
    subprocess.run([*command, *argv, "-params", "n_envs:2"], check=True, cwd=tmp_path)
    assert MADDPG.load(tmp_path / "logs/maddpg/OwnBit-v0_1/OwnBit-v0.zip").num_timesteps == 600


@pytest.mark.slow
def test_the_script_finds_environments_in_the_present_folder(tmp_path):
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "spread.py").write_text("from mpe2.simple_spread_v3 import parallel_env\n")
    script = [str(Path(sys.executable).parent / "sb3-maddpg")]
    argv = ["train", "--env", "pack/spread", "-n", "100", "--eval-freq", "-1", "--verbose", "0"]
    subprocess.run([*script, *argv], check=True, cwd=tmp_path)
    assert (tmp_path / "logs" / "maddpg" / "pack-spread_1" / "pack-spread.zip").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "words", "message"),
    [
        ("tensorboard", [], "This needs the extra 'zoo': in the clone, pip install -e '.[zoo]'."),
        (
            "matplotlib",
            ["--tensorboard-log", "curves"],
            "needs the extra 'plot': in the clone, pip install -e '.[plot]'",
        ),
    ],
)
def test_missing_packages_are_told_with_their_extra_before_the_training(missing, words, message, tmp_path):
    (tmp_path / "fake").mkdir()
    (tmp_path / "fake" / f"{missing}.py").write_text(f"raise ModuleNotFoundError('No module named {missing}')")
    command = [sys.executable, "-m", "sb3_maddpg", "train", "--env", "QuadSwarm-v0", "--n-timesteps", "10", *words]
    path = os.pathsep.join([str(tmp_path / "fake"), *filter(None, sys.path)])
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    error = done.stderr.splitlines()[-1]
    assert message in error
    assert missing in error
    assert not list((tmp_path / "logs").rglob("*.zip"))
