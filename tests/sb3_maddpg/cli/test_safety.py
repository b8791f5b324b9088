"""Files of run folders that try to run code: none does, unless the user trusts them."""

import base64
import contextlib
import json
import os
import pickle
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from sb3_maddpg.cli.commands import main
from sb3_maddpg.cli.safety import RunLoader, check_names

pytest.importorskip("rl_zoo3")
SHORT = ["--env", "OwnBit-v0", "-n", "60", "-params", "learning_starts:20", "buffer_size:500", "--eval-freq", "-1"]
SPREAD = "mpe2/simple_spread_v3"
# Wrappers that together call os.mkdir("caught")
CALLS = [{"unittest.mock.Mock": {"return_value": "caught"}}, "operator.call", "os.mkdir"]


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


@pytest.fixture
def spread(tmp_path, monkeypatch) -> Path:
    """:return: the folder of the config.yml of a run in a PettingZoo environment with a wrapper"""
    pytest.importorskip("mpe2")
    monkeypatch.chdir(tmp_path)
    wrappers = "wrappers:[{supersuit.frame_stack_v2: {stack_size: 2}}]"
    argv = ["train", "--env", SPREAD, "--env-kwargs", wrappers, "--verbose", "0", *SHORT[2:7], "batch_size:16"]
    assert main(argv) == 0
    (config,) = Path("logs").rglob("config.yml")
    return config.parent


def change(path: Path, **values) -> None:
    path.write_text(yaml.safe_dump({**yaml.load(path.read_text(), RunLoader), **values}))


@pytest.mark.skipif(sys.version_info < (3, 11), reason="operator.call is new")
@pytest.mark.parametrize("command", ["enjoy", "record"])
@pytest.mark.parametrize("key", ["env_wrapper", "vec_env_wrapper"])
def test_wrappers_of_a_run_call_nothing_unless_it_is_trusted(run, capsys, key, command):
    change(run / "config.yml", **{key: CALLS})
    argv = [command, "--env", "OwnBit-v0", "-n", "20", *(["--no-render"] if command == "enjoy" else [])]
    assert main(argv) == 2
    assert not Path("caught").exists()
    told = capsys.readouterr().err
    assert f"config.yml: {key} names 'unittest.mock.Mock'" in told
    assert "--trust" in told
    if key == "env_wrapper":
        with contextlib.suppress(AttributeError):  # os.mkdir does not return an environment
            main([*argv, "--trust"])
        assert Path("caught").exists()


@pytest.mark.parametrize("name", ["config.yml", "args.yml"])
def test_wrappers_of_a_parallel_environment_call_nothing(spread, capsys, name):
    argv = ["enjoy", "--env", SPREAD, "-n", "20", "--no-render"]
    assert main(argv) == 0
    change(spread / name, env_kwargs={"wrappers": CALLS})
    assert main(argv) == 2
    assert not Path("caught").exists()
    assert f"{name}: wrappers names 'unittest.mock.Mock'" in capsys.readouterr().err
    Path("lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\n")
    change(spread / name, env_kwargs={"entry": "lurking"})
    assert main(argv) == 2
    assert not Path("caught").exists()
    assert "remove `entry`" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[]", "1", "env_kwargs: [1]"])
def test_a_damaged_config_is_named(run, capsys, text):
    (run / "config.yml").write_text(text)
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) == 2
    assert "config.yml" in capsys.readouterr().err


def test_a_run_with_a_wrapper_of_the_users_package_is_read(run, monkeypatch):
    monkeypatch.setattr(sys, "modules", sys.modules.copy())
    Path("own_wrappers.py").write_text(
        "import gymnasium\nfrom pathlib import Path\nclass Own(gymnasium.Wrapper):\n    pass\nPath('caught').touch()\n"
    )
    change(run / "config.yml", env_wrapper="own_wrappers.Own")
    argv = ["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]
    assert main(argv) == 2
    assert not Path("caught").exists()
    assert main([*argv, "--gym-packages", "own_wrappers"]) == 0
    assert Path("caught").exists()


@pytest.mark.parametrize(
    ("key", "name", "allowed"),
    [
        ("env_wrapper", "gymnasium.wrappers.TimeLimit", True),
        ("env_wrapper", "sb3_contrib.common.wrappers.TimeFeatureWrapper", True),
        ("env_wrapper", "supersuit.frame_stack_v2", True),
        ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecCheckNan", True),
        ("env_wrapper", "stable_baselines3.common.vec_env.VecCheckNan", False),
        ("env_wrapper", "supersuit.utils.make_defaultdict.make_defaultdict", False),
        ("env_wrapper", "os.system", False),
        ("env_wrapper", "this.s", False),
        ("env_wrapper", "gymnasium.__main__.Wrapper", False),
        ("env_wrapper", ".os.system", False),
        ("env_wrapper", "system", False),
    ],
)
def test_files_name_wrappers_of_installed_libraries(key, name, allowed, capsys):
    pytest.importorskip("supersuit")
    before = set(sys.modules)
    if allowed:
        check_names({key: [{name: {}}]}, "OwnBit-v0", "file")
    else:
        with pytest.raises(ValueError, match=f"file: {key} names '{name}'"):
            check_names({key: name}, "OwnBit-v0", "file")
        assert {"this", "gymnasium.__main__"}.isdisjoint(set(sys.modules) - before)


def test_a_package_in_the_present_folder_does_not_count_as_installed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(os.getcwd())
    Path("posing.py").write_text("from pathlib import Path\nPath('caught').touch()\n")
    Path("posing-1.0.dist-info").mkdir()
    Path("posing-1.0.dist-info/METADATA").write_text("Name: posing\nVersion: 1.0\nRequires-Dist: gymnasium\n")
    Path("posing-1.0.dist-info/top_level.txt").write_text("posing\n")
    with pytest.raises(ValueError, match=r"names 'posing\.Wrapper'"):
        check_names({"env_wrapper": "posing.Wrapper"}, "OwnBit-v0", "file")
    assert not Path("caught").exists()
