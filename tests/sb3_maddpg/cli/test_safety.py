"""Files of run folders that try to run code: none does, unless the user trusts them."""

import base64
import contextlib
import json
import os
import pickle
import shutil
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from sb3_maddpg.cli.environments import Environments
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.safety import RunLoader, check_names, read_settings, write_settings

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


def test_settings_are_read_as_they_were_written(tmp_path):
    """The keys of a value in their order, too: an environment may name its agents by them."""
    written = {"policy": "MlpPolicy", "env_kwargs": {"agents": {"zoe": 1, "adam": (2.0, None)}}}
    write_settings(tmp_path / "config.yml", written)
    read = read_settings(tmp_path / "config.yml")
    assert list(read) == sorted(written)
    assert list(read["env_kwargs"]["agents"]) == ["zoe", "adam"]
    assert read["env_kwargs"] == written["env_kwargs"]


@pytest.mark.parametrize("name", ["config.yml", "args.yml"])
def test_yaml_calls_nothing(run, capsys, name):
    (run / name).write_text("!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [caught]]")
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) in (1, 2)
    assert not Path("caught").exists()
    assert f"{name} holds a value that is not plain" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[" * 3000, "[" * 102 + "]" * 102, "{a: " * 3000, "- " * 3000])
def test_yaml_that_is_nested_too_deeply_is_refused(text):
    with pytest.raises(ValueError, match="nested too deeply"):
        yaml.load(text, RunLoader)
    assert yaml.load("[" * 90 + "]" * 90, RunLoader)


LAUGHS = "\n".join(
    [f"a{0}: &a0 [lol]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9)), "env_kwargs: *a8"]
)


@pytest.mark.parametrize("text", [LAUGHS, "a: &a [*a]", "a: &a {b: 1, c: *a}"])
def test_aliases_that_stand_for_too_many_values_are_refused(run, capsys, text):
    with pytest.raises(ValueError, match="holds more than 100000 values: shorten it"):
        yaml.load(text, RunLoader)
    assert yaml.load("a: &a [1, 2]\nb: *a", RunLoader) == {"a": [1, 2], "b": [1, 2]}
    (run / "config.yml").write_text(text)
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) in (1, 2)
    assert "config.yml holds more than 100000 values" in capsys.readouterr().err
    Path("r.yml").write_text(text)
    assert main(["train", "--env", "OwnBit-v0", "--conf-file", "r.yml"]) in (1, 2)
    assert "r.yml holds more than 100000 values" in capsys.readouterr().err


def test_text_in_a_recipe_of_a_run_is_not_evaluated(run, capsys):
    config = yaml.load((run / "config.yml").read_text(), RunLoader)
    config["normalize"] = "__import__('pathlib').Path('caught').touch()"
    (run / "config.yml").write_text(yaml.safe_dump(dict(config)))
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) in (1, 2)
    assert not Path("caught").exists()
    assert "__import__" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["enjoy", "train"])
def test_a_model_runs_nothing_unless_it_is_trusted(run, capsys, command):
    model = run.parent / "OwnBit-v0.zip"
    poison(model)
    argv = [command, "--env", "OwnBit-v0", "-n", "20", "--no-render"]
    if command == "train":
        argv = [command, *SHORT, "-i", str(model)]
    assert main(argv) in (1, 2)
    assert "holds pickled values (ep_info_buffer)" in capsys.readouterr().err
    assert not Path("caught").exists()
    main([*argv, "--trust"])
    assert Path("caught").exists()


@pytest.mark.parametrize("name", ["replay_buffer.pkl", "vecnormalize.pkl"])
def test_pickles_beside_a_model_are_refused(run, capsys, name):
    path = run.parent / name if name == "replay_buffer.pkl" else run / name
    path.write_bytes(pickle.dumps(Trap()))
    assert main(["train", *SHORT, "-i", str(run.parent / "OwnBit-v0.zip")]) in (1, 2)
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
    assert main(["enjoy", *argv, "-n", "20", "--no-render"]) in (1, 2)
    assert "holds pickled values" in capsys.readouterr().err
    assert not Path("caught").exists()


def test_a_recipe_names_nothing_of_the_present_folder_unless_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")  # as `python -m` does
    Path("lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\nMine = dict\n")
    recipe = {"n_timesteps": 60, "policy": "MlpPolicy", "buffer_size": 500, "callback": [{"lurking.Mine": {}}]}
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": recipe}))
    argv = ["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1"]
    assert main(argv) in (1, 2)
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
    assert main(argv) in (1, 2)
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
    assert main(argv) in (1, 2)
    assert not Path("caught").exists()
    assert f"{name}: wrappers names 'unittest.mock.Mock'" in capsys.readouterr().err
    Path("lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\n")
    change(spread / name, env_kwargs={"entry": "lurking"})
    assert main(argv) in (1, 2)
    assert not Path("caught").exists()
    assert "remove `entry`" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[]", "1", "env_kwargs: [1]"])
def test_a_damaged_config_is_named(run, capsys, text):
    (run / "config.yml").write_text(text)
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) in (1, 2)
    assert "config.yml" in capsys.readouterr().err


def test_a_run_with_a_wrapper_of_the_users_package_is_read(run, monkeypatch):
    monkeypatch.setattr(sys, "modules", sys.modules.copy())
    Path("own_wrappers.py").write_text(
        "import gymnasium\nfrom pathlib import Path\nclass Own(gymnasium.Wrapper):\n    pass\nPath('caught').touch()\n"
    )
    change(run / "config.yml", env_wrapper="own_wrappers.Own")
    argv = ["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]
    assert main(argv) in (1, 2)
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


@pytest.mark.parametrize("command", ["enjoy", "record"])
@pytest.mark.parametrize("name", ["config.yml", "args.yml"])
@pytest.mark.parametrize(
    "kwargs",
    [
        {"--folder=other/x": 1},
        {"--gym-packages=lurking\n": 1},
        {"--reward-log=caught": 1},
        {"-o": "caught"},
        {"--": 1},
        {"episode_length": "10 --folder=other"},
    ],
)
def test_keys_of_a_run_are_no_options(run, capsys, monkeypatch, command, name, kwargs):
    monkeypatch.delitem(sys.modules, "lurking", raising=False)
    Path("lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\n")
    for folder in ("other", "other/x:1"):  # runs that these options would choose
        run_there = Path(folder, "maddpg/OwnBit-v0_1/OwnBit-v0")
        run_there.mkdir(parents=True)
        (run_there / "config.yml").write_text(yaml.safe_dump({"env_wrapper": {"os.mkdir": {"path": "caught"}}}))
    change(run / name, env_kwargs=kwargs)
    before = sorted(Path().rglob("*"))
    argv = [command, "--env", "OwnBit-v0", "-n", "20", *(["--no-render"] if command == "enjoy" else [])]
    assert main(argv) in (1, 2)
    assert sorted(Path().rglob("*")) == before
    printed = capsys.readouterr()
    assert "Loading other" not in printed.out
    assert "argument of OwnBit-v0" in printed.err or "episode_length='10 --folder=other'" in printed.err
    assert len(printed.err.splitlines()) == 1


def test_the_arguments_of_a_run_arrive_as_they_are_and_the_command_line_replaces_them(run, monkeypatch):
    found = {}
    monkeypatch.setattr(Environments, "make", lambda *args, **kwargs: found.update(env_kwargs=args[2]) or 1 / 0)
    change(run / "config.yml", env_kwargs={"episode_length": [1, "two\nthree", {"c": None}], "render_mode": "human"})
    with pytest.raises(ZeroDivisionError):
        main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render", "--env-kwargs", "render_mode:ansi"])
    assert found["env_kwargs"] == {"episode_length": [1, "two\nthree", {"c": None}], "render_mode": "ansi"}


@pytest.mark.parametrize(
    ("key", "value", "name"),
    [
        ("env_wrapper", {"stable_baselines3.common.monitor.Monitor": {"filename": "{}/victim"}}, "filename"),
        ("env_wrapper", {"stable_baselines3.common.monitor.Monitor": {"filename": "victim"}}, "filename"),
        ("env_wrapper", [{"gymnasium.wrappers.RecordVideo": {"video_folder": "~/victim"}}], "video_folder"),
        ("env_wrapper", [{"gymnasium.wrappers.RecordVideo": {"video_folder": b"../victim"}}], "video_folder"),
        (
            "vec_env_wrapper",
            {"stable_baselines3.common.vec_env.VecMonitor": {"filename": "logs/../victim"}},
            "filename",
        ),
        ("env_kwargs", {"notes": {"to": ["{}/victim"]}}, "to"),
        ("env_kwargs", "dict(save_path='victim')", "save_path"),
    ],
)
def test_a_run_names_no_path_outside_its_folder(run, capsys, key, value, name):
    if key == "env_wrapper":
        value = (
            json.loads(json.dumps(value).replace("{}", str(Path.cwd()))) if b"" not in str(value).encode() else value
        )
    change(run / "config.yml", **{key: value})
    before = sorted(Path().rglob("*"))
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) in (1, 2)
    told = capsys.readouterr().err
    assert f"config.yml: {name} is " in told
    assert "may be a path outside" in told
    assert "--trust" in told
    assert sorted(Path().rglob("*")) == before


def test_a_run_may_name_paths_in_its_folder_and_trusted_runs_any(run):
    wrapper = "stable_baselines3.common.monitor.Monitor"
    change(run / "config.yml", env_wrapper={wrapper: {"filename": str(run / "again")}})
    argv = ["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]
    assert main(argv) == 0
    assert (run / "again.monitor.csv").exists()
    change(run / "config.yml", env_wrapper={wrapper: {"filename": "elsewhere"}})
    assert main([*argv, "--trust"]) == 0
    assert Path("elsewhere.monitor.csv").exists()


def test_paths_are_accepted_that_the_user_names_again(run):
    Path("mine.yml").touch()
    change(run / "config.yml", env_kwargs={"episode_length": "./mine.yml"})
    argv = ["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]
    assert main(argv) in (1, 2)
    assert main([*argv, "--env-kwargs", "episode_length:10"]) == 0


def test_links_in_a_run_do_not_lead_out_of_it(run, tmp_path, capsys):
    (tmp_path / "victim").mkdir()
    (run.parent / "videos").symlink_to(tmp_path / "victim")
    (run.parent / "inside.zip").symlink_to(run.parent / "OwnBit-v0.zip")
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) in (1, 2)
    assert "videos' is a link out of the run's folder" in capsys.readouterr().err
    (run.parent / "videos").unlink()
    assert main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"]) == 0


@pytest.mark.parametrize(
    ("change_to", "told"),
    [
        ({"frame_stack": None}, None),
        ({"frame_stack": {}}, "frame_stack={}"),
        ({"frame_stack": -1}, "frame_stack=-1"),
        ({"env_wrapper": [[1]]}, "env_wrapper=[[1]]"),
        ({"env_wrapper": {"gymnasium.wrappers.TimeLimit": {}}}, "needs max_episode_steps"),
        ({"env_wrapper": {"gymnasium.wrappers.TimeLimit": {"steps": 3}}}, "unexpected keyword argument 'steps'"),
        ({"env_wrapper": {"gymnasium.wrappers.TimeLimit": 3}}, "has int 3 instead of arguments"),
        ({"env_wrapper": {"gymnasium.wrappers.ReshapeObservation": {"shape": "x"}}}, "cannot wrap the environment"),
        ({"env_wrapper": "gymnasium.wrappers.NoSuch"}, "gymnasium.wrappers.NoSuch"),
        ({"vec_env_wrapper": 1}, "vec_env_wrapper=1"),
        ({"vec_env_wrapper": {"stable_baselines3.common.vec_env.VecFrameStack": {}}}, "needs n_stack"),
        ({"normalize": {"a": 1}}, "argument 'a'"),
        ({"normalize": "dict(clip_obs='x')"}, "clip_obs='x'"),
        ({"env_kwargs": "dict("}, "dict("),
        ({"replay_buffer_class": None}, None),
        ({"normalize": None}, None),
    ],
)
def test_settings_of_a_run_are_checked(run, capsys, change_to, told):
    change(run / "config.yml", **change_to)
    status = main(["enjoy", "--env", "OwnBit-v0", "-n", "20", "--no-render"])
    error = capsys.readouterr().err
    assert status in ((0,) if told is None else (1, 2)), error
    if told is not None:
        assert told in error
        assert len(error.splitlines()) == 1


@pytest.mark.parametrize("name", ["OwnBit-v0_²", "OwnBit-v0_٣", "OwnBit-v0_2x"])
def test_folders_that_look_like_runs_are_passed_over(run, name):
    Path("logs/maddpg", name).mkdir()
    argv = ["--env", "OwnBit-v0", "-n", "20"]
    assert main(["enjoy", *argv, "--no-render"]) == 0
    assert main(["train", *SHORT, "--tensorboard-log", "tb"]) == 0
    Path("tb/OwnBit-v0/MADDPG_1²").mkdir()
    assert main(["train", *SHORT, "--tensorboard-log", "tb"]) == 0
    assert sorted(path.name for path in Path("tb/OwnBit-v0").iterdir()) == ["MADDPG_1", "MADDPG_1²", "MADDPG_2"]
    assert sorted(path.name for path in Path("logs/maddpg").iterdir() if path.name != name) == [
        f"OwnBit-v0_{number}" for number in (1, 2, 3)
    ]


@pytest.mark.parametrize("option", ["--folder", "--fold", "-f"])
def test_abbreviated_options_choose_the_run_that_is_checked(spread, capsys, option):
    """There is one parser, which also finds out what is checked."""
    shutil.copytree("logs", "other")
    (args,) = Path("other").rglob("args.yml")
    change(args, env_kwargs={"wrappers": [{"os.mkdir": {"path": "caught"}}]})
    assert main(["enjoy", "--env", SPREAD, option, "other", "-n", "20", "--no-render"]) in (1, 2)
    assert "names 'os.mkdir'" in capsys.readouterr().err
    assert not Path("caught").exists()


def test_abbreviated_arguments_of_the_environment_arrive(run, capsys):
    assert main(["enjoy", "--env", "OwnBit-v0", "--env-k", "nonsense:5", "-n", "20", "--no-render"]) in (1, 2)
    assert "Unknown argument of OwnBit-v0 'nonsense'" in capsys.readouterr().err
