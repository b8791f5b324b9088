"""Files of run folders that try to run code: none does, unless the user trusts them."""

import base64
import json
import pickle
import zipfile
from pathlib import Path

import pytest
import yaml

from sb3_maddpg.cli.commands import main
from sb3_maddpg.cli.safety import RunLoader

pytest.importorskip("rl_zoo3")
SHORT = ["--env", "OwnBit-v0", "-n", "60", "-params", "learning_starts:20", "buffer_size:500", "--eval-freq", "-1"]


class Trap:
    """Whoever unpickles it has run code: the file `caught` is there."""

    def __reduce__(self):
        return Path.touch, (Path("caught"),)


@pytest.fixture
def run(tmp_path, monkeypatch) -> Path:
    """:return: the folder of a run's config.yml and args.yml; its parent has the model"""
    monkeypatch.chdir(tmp_path)
    assert main(["train", *SHORT, "--verbose", "0", "--save-replay-buffer"]) == 0
    (config,) = Path("logs").rglob("config.yml")
    return config.parent


def poison(model: Path) -> None:
    with zipfile.ZipFile(model) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    value = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(Trap())).decode()}
    members["data"] = json.dumps({**json.loads(members["data"]), "ep_info_buffer": value}).encode()
    with zipfile.ZipFile(model, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_the_folder_of_a_run_is_read(run, capsys):
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) == 0
    assert "Mean reward" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["config.yml", "args.yml"])
def test_yaml_calls_nothing(run, capsys, name):
    (run / name).write_text("!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [caught]]")
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) == 2
    assert not Path("caught").exists()
    assert f"{name} holds a value that is not plain" in capsys.readouterr().err


def test_yaml_without_end_is_refused():
    with pytest.raises(ValueError, match="nested too deeply"):
        yaml.load("[" * 3000, RunLoader)


LAUGHS = "\n".join(
    [f"a{0}: &a0 [lol]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9)), "env_kwargs: *a8"]
)


@pytest.mark.parametrize("text", [LAUGHS, "a: &a [*a]", "a: &a {b: 1, c: *a}"])
def test_aliases_that_stand_for_too_many_values_are_refused(run, capsys, text):
    with pytest.raises(ValueError, match="holds more than 100000 values: shorten it"):
        yaml.load(text, RunLoader)
    assert yaml.load("a: &a [1, 2]\nb: *a", RunLoader) == {"a": [1, 2], "b": [1, 2]}
    (run / "config.yml").write_text(text)
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) == 2
    assert "config.yml holds more than 100000 values" in capsys.readouterr().err
    Path("r.yml").write_text(text)
    assert main(["train", "--env", "OwnBit-v0", "--conf-file", "r.yml"]) == 2
    assert "r.yml holds more than 100000 values" in capsys.readouterr().err


def test_text_in_a_recipe_of_a_run_is_not_evaluated(run, capsys):
    config = yaml.load((run / "config.yml").read_text(), RunLoader)
    config["normalize"] = "__import__('pathlib').Path('caught').touch()"
    (run / "config.yml").write_text(yaml.safe_dump(dict(config)))
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) == 2
    assert not Path("caught").exists()
    assert "__import__" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["enjoy", "train"])
def test_a_model_runs_nothing_unless_it_is_trusted(run, capsys, command):
    model = run.parent / "OwnBit-v0.zip"
    poison(model)
    argv = [command, "--env", "OwnBit-v0", "-n", "20", "--no-render"]
    if command == "train":
        argv = [command, *SHORT, "-i", str(model)]
    assert main(argv) == 2
    assert "holds pickled values (ep_info_buffer)" in capsys.readouterr().err
    assert not Path("caught").exists()
    main([*argv, "--trust"])
    assert Path("caught").exists()


@pytest.mark.parametrize("name", ["replay_buffer.pkl", "vecnormalize.pkl"])
def test_pickles_beside_a_model_are_refused(run, capsys, name):
    path = run.parent / name if name == "replay_buffer.pkl" else run / name
    path.write_bytes(pickle.dumps(Trap()))
    assert main(["train", *SHORT, "-i", str(run.parent / "OwnBit-v0.zip")]) == 2
    assert "--trust" in capsys.readouterr().err
    assert not Path("caught").exists()


def test_a_model_of_another_algorithm_needs_trust(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    recipe = {"CartPole-v1": {"n_timesteps": 64, "policy": "MlpPolicy", "n_steps": 32, "batch_size": 32}}
    Path("r.yml").write_text(yaml.safe_dump(recipe))
    argv = ["--algo", "ppo", "--env", "CartPole-v1"]
    assert main(["train", *argv, "--conf-file", "r.yml", "--eval-freq", "-1", "--verbose", "0"]) == 0
    (model,) = Path("logs").rglob("CartPole-v1.zip")
    poison(model)
    assert main(["enjoy", *argv, "-n", "20", "--no-render"]) == 2
    assert "holds pickled values" in capsys.readouterr().err
    assert not Path("caught").exists()


def test_a_recipe_names_nothing_of_the_present_folder_unless_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")  # as `python -m` does
    Path("lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\nMine = dict\n")
    recipe = {"n_timesteps": 60, "policy": "MlpPolicy", "buffer_size": 500, "callback": [{"lurking.Mine": {}}]}
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": recipe}))
    argv = ["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1"]
    assert main(argv) == 2
    assert not Path("caught").exists()
    assert "lurking.Mine in the recipe cannot be imported" in (told := capsys.readouterr().err)
    assert "--gym-packages" in told
    main([*argv, "--gym-packages", "lurking"])
    assert Path("caught").exists()
