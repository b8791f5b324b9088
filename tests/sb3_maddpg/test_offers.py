"""Entry points of installed packages that are broken, each in a package that is really there."""

import subprocess
import sys
from pathlib import Path

import pytest

from sb3_maddpg.cli.main import main
from sb3_maddpg.files import registry, typed_json

DASHBOARD = "LAYOUT = {'Learning': {'return': ['Multiline', ['eval/mean_reward']]}}\n"
TRAIN = ["train", "--env", "OwnBit-v0", "-n", "100", "--eval-freq", "50", "--eval-episodes", "1", "--n-eval-envs", "1"]


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install packages, as far as Python can tell."""
    imported = set(sys.modules)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.syspath_prepend(tmp_path)

    def install(package: str, group: str, line: str, code: str = "", at: str = "") -> Path:
        module = tmp_path / (at or f"{package.replace('-', '_')}.py")
        module.parent.mkdir(exist_ok=True)
        module.write_text(code)
        info = tmp_path / f"{package.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Name: {package}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[sb3_maddpg.{group}]\n{line}\n")
        return module.parent

    registry._load_entry_points.cache_clear()
    yield install
    registry._load_entry_points.cache_clear()
    for name in set(sys.modules) - imported:
        if name.startswith(("their_", "other_")):
            del sys.modules[name]


def refused(argv: list[str], capsys) -> str:
    """:return: the last line that a command prints on the error stream; libraries may warn there before"""
    assert main(argv) in (1, 2)
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error.splitlines()[-1]


@pytest.mark.parametrize(
    ("code", "value", "problem"),
    [
        ("main = 3", "their_package:main", "is 3, not a function of the command's arguments"),
        ("", "their_package", "not a function of the command's arguments"),
        ("def main(): pass", "their_package:main", "failed (TypeError: main() takes 0 positional arguments"),
        ("def main(argv): raise KeyError('a\\nb')", "their_package:main", r"failed (KeyError: 'a\nb')"),
        ("def main(argv): return 'fine'", "their_package:main", "returned 'fine', which is no exit status"),
        ("def main(argv): return 0.5", "their_package:main", "returned 0.5, which is no exit status"),
        ("def other(argv): return 0", "their_package:main", "cannot be loaded (AttributeError"),
    ],
)
@pytest.mark.parametrize(
    ("group", "command"),
    [("evaluators", "evaluate"), ("replays", "replay"), ("identifiers", "identify"), ("exporters", "export")],
)
def test_a_command_that_cannot_be_called_is_refused(group, command, code, value, problem, install, capsys):
    install("their-package", group, f"Their-v0 = {value}", code)
    told = refused([command, "--env", "Their-v0"], capsys)
    assert f"their-package is installed, but its entry point sb3_maddpg.{group}: Their-v0 = {value} " in told
    assert problem in told
    assert "repair or uninstall their-package." in told


def test_a_command_without_an_exit_status_succeeded(install, capsys):
    install("their-package", "evaluators", "Their-v0 = their_package:main", "def main(argv): print(*argv)")
    assert main(["evaluate", "--env", "Their-v0", "none"]) == 0
    assert capsys.readouterr().out == "none\n"


@pytest.mark.parametrize("argv", [["evaluate", "--help"], ["evaluate", "--help-all"]])
def test_examples_that_are_no_text_are_refused(argv, install, capsys):
    install("their-package", "evaluators", "Their-v0 = their_package:main", "EXAMPLES = 3\ndef main(argv): return 0")
    assert "their_package:main has EXAMPLES=3, which is no text: repair" in refused(argv, capsys)


def test_two_packages_with_a_command_for_one_environment_are_both_named(install, capsys):
    for package in ("their-package", "other-package"):
        module = package.replace("-", "_")
        install(package, "evaluators", f"Their-v0 = {module}:main", "def main(argv): return 0")
    told = refused(["evaluate", "--env", "Their-v0"], capsys)
    assert "other-package (other_package:main) and their-package (their_package:main) both have" in told
    assert "uninstall all but one." in told


def test_entry_points_that_cannot_be_read_belong_to_a_package(install, capsys):
    install("their-package", "models", "no equals sign")
    told = refused(["pretrained"], capsys)
    assert "their-package" in told
    assert "repair or uninstall" in told


@pytest.mark.parametrize(
    ("value", "code", "problem"),
    [
        ("their_package", "", "which is no package"),
        ("their_package:FOLDER", "FOLDER = 3", "is 3, which is no package"),
        ("their_package:find", "def find(): pass", "which is no package"),
    ],
)
def test_models_come_from_a_package(value, code, problem, install, capsys):
    install("their-package", "models", f"theirs = {value}", code)
    told = refused(["pretrained"], capsys)
    assert problem in told
    assert "repair or uninstall their-package." in told


def test_a_package_without_models_is_refused_and_one_with_models_need_not_have_a_readme(install, capsys):
    folder = install("their-package", "models", "theirs = their_models", at="their_models/code.py")  # a namespace
    assert "has no folder with a model.zip: repair or uninstall their-package." in refused(["pretrained"], capsys)
    (folder / "theirs").mkdir()
    (folder / "theirs" / "model.zip").touch()
    assert main(["pretrained"]) == 0
    assert "\ntheirs " in capsys.readouterr().out
    assert main(["pretrained", "theirs"]) == 0
    assert capsys.readouterr().out == f"Files: {folder / 'theirs'}\n"


def test_two_packages_with_a_model_of_one_name_are_both_named(install, capsys):
    folder = install("their-package", "models", "theirs = their_models", at="their_models/__init__.py")
    (folder / "quad-swarm-flight").mkdir()
    (folder / "quad-swarm-flight" / "model.zip").touch()
    told = refused(["pretrained", "quad-swarm-flight"], capsys)
    assert "their-package" in told
    assert "sb3-maddpg" in told
    assert "both have a pretrained model 'quad-swarm-flight': uninstall one of them." in told


CLASSES = """
from sb3_maddpg import TeamReplayBuffer, allow_in_files
class Unknown(TeamReplayBuffer): pass
@allow_in_files
class Known(TeamReplayBuffer): pass
"""


@pytest.mark.parametrize("value", ["their_package", "their_package:Known"])
def test_classes_of_a_package_are_known(value, install):
    install("their-package", "allowed_in_files", f"theirs = {value}", CLASSES)
    assert typed_json.decode({"$": "class", "name": "their_package.Known"}, "buffer").__name__ == "Known"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "code", "problem"),
    [
        ("their_package:Unknown", CLASSES, "neither a module nor a class registered with `allow_in_files`"),
        ("their_package:CLASS", "CLASS = 3", "is 3, neither a module nor a class registered"),
        ("their_package", "from sb3_maddpg import allow_in_files\nallow_in_files(3)", "3 cannot be named in files"),
    ],
)
def test_classes_that_are_not_registered_are_refused_and_the_file_is_not_blamed(
    value, code, problem, install, tmp_path
):
    install("their-package", "allowed_in_files", f"theirs = {value}", code)
    command = [sys.executable, "-m", "sb3_maddpg", "evaluate", "--policy", "pretrained:quad-swarm-flight"]
    done = subprocess.run(
        [*command, "--episodes", "1"],
        env={"PYTHONPATH": str(tmp_path), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    told = done.stderr.splitlines()[-1]
    assert problem in told
    assert "damaged" not in told
    assert told.count("their-package is installed") == 1
    assert "repair or uninstall their-package." in told


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        ("import no_such_module", "cannot be loaded (ModuleNotFoundError: No module named 'no_such_module')"),
        (DASHBOARD, "which has no LAYOUT or no function draw(model, env_kwargs)"),
        ("def draw(model, env_kwargs): return {}", "which has no LAYOUT or no function draw(model, env_kwargs)"),
        ("LAYOUT = 3\ndef draw(model, env_kwargs): return {}", "has a wrong LAYOUT (layout=3 must map titles"),
        (DASHBOARD + "def draw(model): return {}", "could not draw the model (TypeError: draw() got an unexpected"),
        (DASHBOARD + "def draw(model, env_kwargs): return {}['a']", "could not draw the model (KeyError: 'a')"),
        (DASHBOARD + "def draw(model, env_kwargs): pass", "draw returned None: it must return a dict of figures"),
        (DASHBOARD + "def draw(model, env_kwargs): return {'a/b': 'c'}", "draw returned 'c' for 'a/b': it must be"),
        (DASHBOARD + "def draw(model, env_kwargs): return {3: 0.5}", "draw returned 0.5 for 3: it must be"),
    ],
)
def test_a_broken_dashboard_is_refused(code, problem, install, capsys):
    install("their-package", "dashboards", "OwnBit-v0 = their_package", code)
    told = refused([*TRAIN, "--tensorboard-log", "curves", "-params", "learning_starts:1000"], capsys)
    assert "their-package is installed, but its entry point sb3_maddpg.dashboards: OwnBit-v0 = their_package" in told
    assert problem in told
    assert "'plot'" not in told  # the extra is for the swarm's figures


def test_a_dashboard_of_another_package_is_drawn(install, capsys):
    code = DASHBOARD + "def draw(model, env_kwargs): return {'theirs/number': 7, 'theirs/other': 0.5}"
    install("their-package", "dashboards", "OwnBit-v0 = their_package", code)
    assert main([*TRAIN, "--tensorboard-log", "curves", "-params", "learning_starts:1000"]) == 0
    assert "theirs/" in capsys.readouterr().out


@pytest.mark.parametrize("code", ["raise RuntimeError('a\\nb')", "def (", "raise SystemExit(3)", "1 / 0"])
@pytest.mark.parametrize(
    "argv",
    [
        ["evaluate", "--algo", "their_package:Loader", "none"],
        ["evaluate", "--gym-packages", "their_package", "--policy", "none"],
        ["train", "--env", "OwnBit-v0", "--gym-packages", "their_package"],
        ["train", "--env", "their_package"],
        [*TRAIN, "-params", "callback:['their_package.Watch']"],
        [*TRAIN, "-params", "env_wrapper:'their_package.Watch'"],
        [*TRAIN, "-params", "vec_env_wrapper:'their_package.Watch'"],
        [*TRAIN, "-params", "policy:'their_package.Policy'"],
        [*TRAIN, "-params", "replay_buffer_class:'their_package.Buffer'"],
    ],
)
def test_a_module_that_raises_anything_when_imported_is_named(argv, code, install, capsys):
    install("their-package", "none", "", code)
    told = refused(argv, capsys)
    assert "their_package" in told
    assert {"r": "RuntimeError: a b", "d": "SyntaxError", "1": "ZeroDivisionError"}[code[0]] in told or (
        "SystemExit: 3" in told
    )


PARTS = """
from stable_baselines3.common.callbacks import BaseCallback
class Abstract(BaseCallback): pass
class Raising(BaseCallback):
    def __init__(self): raise KeyError("key")
    def _on_step(self): return True
def nothing(env): return None
class NoWrapper:
    def __init__(self, env): pass
"""


@pytest.mark.parametrize(
    ("key", "name", "problem"),
    [
        ("callback", "Abstract", "in the recipe cannot be created (TypeError: Can't instantiate abstract class"),
        ("callback", "Raising", "in the recipe cannot be created (KeyError: 'key'): repair it, or leave it out."),
        ("env_wrapper", "nothing", "returned None: it must return a gymnasium.core.Env around the environment."),
        ("env_wrapper", "NoWrapper", "it must return a gymnasium.core.Env around the environment."),
        ("vec_env_wrapper", "nothing", "returned None: it must return a stable_baselines3."),
        ("vec_env_wrapper", "NoWrapper", "it must return a stable_baselines3."),
    ],
)
def test_what_a_recipe_names_must_be_what_it_is_used_for(key, name, problem, install, capsys):
    install("their-package", "none", "", PARTS)
    told = refused([*TRAIN, "-params", f"{key}:['their_package.{name}']"], capsys)
    assert f"{key}: ['their_package.{name}'] " in told
    assert problem in told


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        ("raise RuntimeError('a\\nb')", "--conf-file their_package cannot be imported (RuntimeError: a b)"),
        ("", "--conf-file their_package: the module has no `hyperparams`"),
        ("hyperparams = 3", "their_package holds int 3 instead of recipes by environment."),
        ("hyperparams = {'OwnBit-v0': 3}", "their_package: the recipe OwnBit-v0 is int 3."),
        ("hyperparams = {'Other-v0': {}}", "their_package has no recipe for OwnBit-v0"),
    ],
)
def test_a_module_of_recipes_is_checked_like_a_file(code, problem, install, capsys):
    install("their-package", "none", "", code)
    assert problem in refused([*TRAIN, "--conf-file", "their_package"], capsys)


def test_a_module_of_recipes_is_used(install, capsys):
    code = "hyperparams = {'OwnBit-v0': {'n_timesteps': 20, 'policy': 'MlpPolicy', 'learning_starts': 100}}"
    install("their-package", "none", "", code)
    assert main(["train", "--env", "OwnBit-v0", "--eval-freq", "-1", "--conf-file", "their_package"]) == 0
