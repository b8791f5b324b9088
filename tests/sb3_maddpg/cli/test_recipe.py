"""What a training is asked for, checked before anything runs."""

import json
from pathlib import Path

import pytest
import yaml

from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.recipe import check_recipe, read_recipe, recipe_path

RECIPE = {"n_timesteps": 100, "policy": "MlpPolicy", "learning_starts": 1000}


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def refused(capsys, *argv: str, status: int = 2) -> str:
    assert main(["train", "--env", "OwnBit-v0", "--verbose", "0", "--eval-freq", "-1", *argv]) == status
    assert not Path("logs").exists()
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n- 2\n", "holds list [1, 2] instead of recipes by environment. Write `OwnBit-v0:`"),
        ("5", "holds int 5 instead"),
        ("", "holds nothing instead"),
        ("OwnBit-v0: [1\n", "r.yml, line 2: this is not valid YAML"),
        ("OwnBit-v0: 3", "the recipe OwnBit-v0 is int 3"),
        ("Other-v0: {n_timesteps: 3}", "has no recipe for OwnBit-v0 and no `default`"),
        (None, "There is no recipe r.yml"),
        ("OwnBt-v0: {n_timesteps: 3}", "below it. Did you mean 'OwnBt-v0'?"),
    ],
)
def test_a_file_without_a_recipe_is_refused(capsys, text, message):
    if text is not None:
        Path("r.yml").write_text(text)
    assert message in refused(capsys, "--conf-file", "r.yml", status=1 if text is None else 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"learning_rate": float("nan")}, "learning_rate=nan: write a finite number, or lin_NUMBER"),
        ({"learning_rate": "nan"}, "learning_rate='nan': write a finite number, or lin_NUMBER"),
        ({"learning_rate": "lin_x"}, "learning_rate='lin_x': write a finite number, or lin_NUMBER"),
        ({"n_timesteps": 0}, "n_timesteps=0: input should be greater than 0"),
        ({"n_timesteps": "many"}, "n_timesteps='many': write a number"),
        ({"n_timesteps": None}, "n_timesteps=None: input should be a valid integer"),
        ({"n_envs": 1.5}, "n_envs=1.5: input should be a valid integer"),
        ({"env_kwargs": 3}, "env_kwargs=3: input should be a valid dictionary"),
        ({"policy_kwargs": "dict(net_arch=print(1))"}, "print(1) is not evaluated"),
        ({"policy_kwargs": "dict(net_arc=[8])"}, "did you mean 'net_arch'?"),
        ({"policy_kwargs": [1]}, "policy_kwargs=[1]: input should be a valid dictionary"),
        ({"batch_size": "big"}, "batch_size='big': write a number"),
        ({"tau": float("nan")}, "tau=nan: input should be a finite number"),
        ({"normalize": "dict(a=exit())"}, "exit() is not evaluated"),
        ({"n_envs": 1e9}, "n_envs=1000000000.0: choose 10000 or less"),
        ({"noise_type": "x", "noise_std": 1}, "noise_type='x': choose normal or ornstein-uhlenbeck"),
        ({"noise_type": "", "noise_std": 1}, "noise_type='': choose normal or ornstein-uhlenbeck"),
        ({"noise_std": 0.1}, "noise_std=0.1 needs noise_type: normal or ornstein-uhlenbeck"),
        ({"normalize": "dict(a=1)"}, "argument 'a'"),
        ({"normalize": {"gamma": 2}}, "gamma=2 must be a number between 0 and 1"),
        ({"noise_type": "normal"}, "noise_std=None: noise_type needs a standard deviation"),
        ({"noise_type": "normal", "noise_std": -1}, "noise_std=-1: input should be greater than or equal to 0"),
        ({"policy": ["x"]}, "policy=['x']: input should be a valid string"),
        ({"policy": {}}, "policy={}: input should be a valid string"),
        ({"policy": -1}, "policy=-1: input should be a valid string"),
        ({"monitor_kwargs": {"x": 1}}, "Unknown argument 'recipe for maddpg in r.yml: monitor_kwargs: x'"),
        ({"monitor_kwargs": {"info_keywords": 5}}, "monitor_kwargs: info_keywords=5: input should be a valid tuple"),
        ({1: 2}, "Unknown key in the recipe for maddpg '1'"),
    ],
)
def test_a_value_of_another_type_is_refused(capsys, changes, message):
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**RECIPE, **changes}}))
    assert message in refused(capsys, "--conf-file", "r.yml")


def test_a_key_that_is_missing_is_named(capsys):
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {"n_timesteps": 10}}))
    assert "recipe for maddpg in r.yml: policy is missing" in refused(capsys, "--conf-file", "r.yml")
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {"policy": "MlpPolicy"}}))
    assert "n_timesteps is missing" in refused(capsys, "--conf-file", "r.yml")
    words = refused(capsys, "--conf-file", "r.yml", "-params", "learning_rate:abc", "n_timesteps:10")
    assert "recipe for maddpg in r.yml with -params: learning_rate='abc'" in words
    assert main(["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "-n", "20", "--verbose", "0"]) == 0


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["-n", "0"], "--n-timesteps: 0: choose 1 or more, or -1"),
        (["-n", "-5"], "--n-timesteps: -5: "),
        (["--n-eval-envs", "0"], "--n-eval-envs: 0: choose 1 or more"),
        (["--eval-freq", "0"], "--eval-freq: 0: "),
        (["--save-freq", "-7"], "--save-freq: -7: "),
        (["--eval-episodes", "0"], "--eval-episodes: 0: "),
        (["--num-threads", "0"], "--num-threads: 0: "),
        (["--seed", "4294967296"], "--seed: 4294967296: choose 4294967295 or less"),
        (["-optimize", "--storage", "x"], "--storage: 'x': name a file FILE.log, or the URL of a database"),
        (["-optimize", "--storage", ""], "--storage: '': name a file FILE.log, or the URL of a database"),
        (["-optimize", "--storage", "x://y"], "--storage: 'x://y': name a file FILE.log, or the URL of a database"),
        (
            ["--storage", "sqlite:////no/such/x.db", "--study-name", "a", "--trial-id", "0"],
            "cannot be opened: unable to",
        ),
        (["--gym-packages", "../.."], "--gym-packages '../..': write the names of packages"),
        (["--n-eval-envs", "1000000000"], "--n-eval-envs: 1000000000: choose 10000 or less"),
        (["-params", "n_envs:1e9"], "n_envs=1000000000.0: choose 10000 or less"),
        (["-params", "learning_rate:nan"], "nan is not a finite number"),
        (["-params", "learning_rate:1e999"], "inf is not a finite number"),
    ],
)
def test_a_number_that_no_training_can_be_asked_for_is_refused(capsys, argv, message):
    assert message in refused(capsys, *argv)


@pytest.mark.parametrize("command", ["enjoy", "record", "bench"])
def test_how_long_is_at_least_one_step(capsys, command):
    assert main([command, "--env", "OwnBit-v0", "-n", "-3"]) == 2
    assert "--n-timesteps: -3: choose 1 or more" in capsys.readouterr().err


def test_without_an_environment_the_option_is_named(capsys):
    for command in ("train", "tune", "bench", "enjoy", "record"):
        assert main([command]) == 2
        assert "--env is missing" in capsys.readouterr().err


def test_text_stands_for_its_number_and_a_call_of_dict_for_the_dict():
    given = {
        **RECIPE,
        "n_timesteps": "1e5",
        "learning_rate": "1e-3",
        "tau": "1e-2",
        "policy_kwargs": "dict(net_arch=[8])",
    }
    checked = check_recipe("maddpg", given, "recipe")
    assert (checked["n_timesteps"], checked["learning_rate"], checked["tau"]) == (100_000, 0.001, 0.01)
    assert checked["policy_kwargs"] == {"net_arch": [8]}
    given = {"n_timesteps": 10, "policy": "MlpPolicy", "clip_range": "lin_0.2", "clip_range_vf": None}
    assert check_recipe("ppo", given, "recipe") == given


@pytest.mark.parametrize("algo", ["maddpg", "matd3", "ppo"])
def test_packaged_recipes_pass_unchanged(algo):
    for recipe in yaml.safe_load(Path(recipe_path(None, algo, "mpe2/simple_spread_v3")).read_text()).values():
        checked = check_recipe(algo, recipe, "recipe")
        assert json.loads(json.dumps(checked)) == recipe  # but for tuples


@pytest.mark.parametrize("key", ["env_wrapper", "vec_env_wrapper", "callback"])
@pytest.mark.parametrize("name", ["os.path", "no.such.module", "x"])
def test_a_wrapper_or_callback_that_is_no_class_is_refused(key, name):
    recipe = {"n_timesteps": 10, "policy": "MlpPolicy"}
    for value in (name, [name], {name: {}}, [{name: {"a": 1}}]):
        with pytest.raises(ValueError, match=f"{key}: {name}"):
            check_recipe("maddpg", {**recipe, key: value}, "recipe")


@pytest.mark.parametrize("name", ["os.system", "collections.OrderedDict", "gymnasium.wrappers.TimeLimit"])
def test_what_is_no_callback_is_not_called(capsys, name):
    """Calling it would run anything, and Stable-Baselines3 would then fail at its result."""
    argv = ["train", "--env", "OwnBit-v0", "--eval-freq", "-1", "-params", f"callback:[{{{name}: {{command: exit}}}}]"]
    assert main(argv) == 2
    assert f"callback: {name} in the recipe is no subclass" in capsys.readouterr().err


LIMIT, STACK = "gymnasium.wrappers.TimeLimit", "stable_baselines3.common.vec_env.VecFrameStack"
CHECKPOINT = "stable_baselines3.common.callbacks.CheckpointCallback"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("env_wrapper", LIMIT, f"needs max_episode_steps: write `{LIMIT}: {{max_episode_steps: VALUE}}`."),
        ("env_wrapper", [{LIMIT: {}}], "needs max_episode_steps"),
        ("env_wrapper", {LIMIT: None}, f"has nothing instead of arguments: write `{LIMIT}: {{ARGUMENT: VALUE}}`."),
        (
            "env_wrapper",
            {LIMIT: {"max_steps": 5}},
            "keyword argument 'max_steps'. Its arguments are: max_episode_steps.",
        ),
        ("env_wrapper", {LIMIT: {"env": 5}}, "multiple values for argument 'env'. Its arguments are: max_episode"),
        ("vec_env_wrapper", STACK, "needs n_stack"),
        (
            "callback",
            [CHECKPOINT],
            f"needs save_freq and save_path: write `{CHECKPOINT}: {{save_freq: VALUE, save_path: VALUE}}`.",
        ),
    ],
)
def test_a_wrapper_or_callback_without_its_arguments_is_refused(capsys, key, value, message):
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**RECIPE, key: value}}))
    error = refused(capsys, "--conf-file", "r.yml")
    assert f"{key}: " in error
    assert message in error


def test_a_wrapper_with_its_arguments_is_accepted():
    wrappers = ["gymnasium.wrappers.OrderEnforcing", {LIMIT: {"max_episode_steps": 7}}]
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**RECIPE, "env_wrapper": wrappers}}))
    assert main(["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--verbose", "0"]) == 0


def test_a_recipe_that_is_neither_file_nor_module_is_refused(capsys):
    assert main(["train", "--env", "OwnBit-v0", "--conf-file", "../.."]) == 2
    assert "neither a YAML file nor a module" in capsys.readouterr().err


def test_a_key_that_is_given_twice_is_named(tmp_path):
    path = tmp_path / "recipe.yml"
    path.write_text("base: &base {gamma: 0.9}\na: &a {b: &b {<<: *base, gamma: 0.8}}\nc: {<<: *b, gamma: 0.7}\n")
    assert read_recipe(str(path), "maddpg", "c") == {"gamma": 0.7}, "merging is no repetition"
    path.write_text("c:\n  gamma: 0.9\n  n_timesteps: 100\n  gamma: 0.8\n")
    with pytest.raises(ValueError, match=r"recipe\.yml: 'gamma' is given twice"):
        read_recipe(str(path), "maddpg", "c")


def test_ppo_trains_own_environments_with_a_default():
    assert read_recipe(recipe_path(None, "ppo", "my_env_v0"), "ppo", "my_env_v0")["policy"] == "MlpPolicy"
    with pytest.raises(ValueError, match=r"no packaged recipe of a2c for my_env_v0: .* `my_env_v0: \{n_timesteps"):
        recipe_path(None, "a2c", "my_env_v0")
