"""`evaluate` in any environment: the same episodes for all policies, tables, files and figures."""

import csv
import json

import numpy as np
import pytest
import yaml

from sb3_maddpg import MADDPG, SafeVecNormalize, make_vec_env
from sb3_maddpg.cli import returns
from sb3_maddpg.cli.main import main
from sb3_maddpg.common.evaluation import play

TEAM = """
import sys
sys.path.insert(0, {helpers!r})
from toys import Toy

def parallel_env(**kwargs):
    return Toy("categorical", **kwargs)
"""
SMALL = {"learning_starts": 20, "batch_size": 16, "train_freq": 5, "buffer_size": 1000, "n_timesteps": 200}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, request):
    """A folder with an environment, and trainings of several algorithms in it."""
    made = tmp_path_factory.mktemp("returns")
    helpers = str(request.config.rootpath / "tests" / "helpers")
    (made / "two_v0.py").write_text(TEAM.format(helpers=helpers))
    off = {"policy": "MlpPolicy", **SMALL}
    (made / "r.yml").write_text(yaml.safe_dump({"two_v0": off}))
    (made / "n.yml").write_text(yaml.safe_dump({"two_v0": {**off, "normalize": {"norm_reward": False}}}))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        for algo, recipe in (("maddpg", "r.yml"), ("matd3", "n.yml")):
            words = ["train", "--algo", algo, "--env", "two_v0", "--conf-file", recipe, "--eval-freq", "100"]
            assert main([*words, "--seed", "1", "-f", "logs", "--quiet"]) == 0
    return made


@pytest.fixture
def here(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def evaluate(*words: str) -> int:
    return main(["evaluate", "--env", "two_v0", *words])


def test_policies_of_all_kinds_are_compared(here, capsys, tmp_path):
    best = "logs/maddpg/two_v0_1/best_model.zip"
    files = ["--json", str(tmp_path / "r.json"), "--csv", str(tmp_path / "e.csv"), "--plot", str(tmp_path / "plots")]
    assert evaluate("--policy", "random", "latest:logs", best, "matd3:latest:logs", "--episodes", "20", *files) == 0
    printed = capsys.readouterr().out
    assert "minus the first's" in printed
    assert "return, matd3:latest:logs" in printed
    assert "20 episodes of two_v0 from seed 0" in printed
    rows = json.loads((tmp_path / "r.json").read_text())
    assert [row["policy"] for row in rows] == ["random", "latest:logs", best, "matd3:latest:logs"]
    with (tmp_path / "e.csv").open() as file:
        episodes = list(csv.DictReader(file))
    assert len(episodes) == 80
    for row in rows:
        mine = [float(one["return"]) for one in episodes if one["policy"] == row["policy"]]
        assert np.mean(mine) == pytest.approx(row["return"]["mean"])
        assert row["return"]["low"] < row["return"]["mean"] < row["return"]["high"]
        assert set(row["agents"]) == {"categorical_0", "categorical_1"}
    own = {one["seed"]: float(one["return"]) for one in episodes if one["policy"] == "latest:logs"}
    rival = {one["seed"]: float(one["return"]) for one in episodes if one["policy"] == "random"}
    assert rows[1]["difference"]["mean"] == pytest.approx(np.mean([own[seed] - rival[seed] for seed in own]))
    assert (tmp_path / "plots" / "returns.png").stat().st_size > 10_000


def test_what_the_command_says_is_what_the_model_does(here, capsys):
    assert evaluate("--policy", "latest:logs", "--episodes", "5", "--seed", "7", "--json", "-") == 0
    captured = capsys.readouterr()
    (row,) = json.loads(captured.out)
    assert "5 episodes" in captured.err
    import two_v0

    model = MADDPG.load("logs/maddpg/two_v0_1/two_v0.zip")
    expected = [one.team_return for one in play(model, make_vec_env(two_v0.parallel_env), 5, seed=7)]
    assert row["return"]["mean"] == pytest.approx(np.mean(expected))
    assert "difference" not in row


def test_normalised_models_are_normalised_with_and_without_their_folder(here, capsys, tmp_path):
    whole = "logs/matd3/two_v0_1/two_v0.zip"
    (tmp_path / "alone.zip").write_bytes((here / whole).read_bytes())
    assert (
        evaluate("--policy", f"matd3:{whole}", f"matd3:{tmp_path / 'alone.zip'}", "--episodes", "6", "--json", "-") == 0
    )
    with_folder, alone = json.loads(capsys.readouterr().out)
    assert with_folder["return"]["mean"] == pytest.approx(alone["return"]["mean"])
    raw = make_vec_env("two_v0")
    unlike = MADDPG.load("logs/maddpg/two_v0_1/two_v0.zip")
    assert not unlike.normalized_observations
    normalised = SafeVecNormalize.load("logs/matd3/two_v0_1/two_v0/vecnormalize.pkl", raw)
    assert normalised.obs_rms.count > 1


def test_statistics_that_are_missing_are_not_left_out(here, capsys, tmp_path):
    """The files of other algorithms do not hold them."""
    settings = tmp_path / "two_v0"
    settings.mkdir()
    (settings / "config.yml").write_bytes((here / "logs/matd3/two_v0_1/two_v0/config.yml").read_bytes())
    (tmp_path / "alone.zip").write_bytes((here / "logs/matd3/two_v0_1/two_v0.zip").read_bytes())
    assert evaluate("--policy", f"ppo:{tmp_path / 'alone.zip'}", "--episodes", "2") == 1
    assert "vecnormalize.pkl is missing" in capsys.readouterr().err
    assert evaluate("--policy", f"matd3:{tmp_path / 'alone.zip'}", "--episodes", "2") == 0


def test_arguments_of_the_environment_are_merged(here, capsys):
    words = ("--policy", "random", "--episodes", "3", "--env-kwargs", "length:4", "--json", "-")
    assert evaluate(*words) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["length"]["mean"] == 4
    assert row["env_kwargs"] == {"length": 4}


def test_trainings_in_environments_that_differ_are_named(here, capsys, tmp_path):
    words = ["train", "--algo", "maddpg", "--env", "two_v0", "--conf-file", "r.yml", "--env-kwargs", "length:5"]
    assert main([*words, "--eval-freq", "-1", "-f", str(tmp_path), "--quiet"]) == 0
    other = str(next((tmp_path / "maddpg").glob("two_v0_1/two_v0.zip")))
    assert evaluate("--policy", "latest:logs", other, "--episodes", "2") == 0
    assert f"latest:logs with {{}}, {other} with {{'length': 5}}" in capsys.readouterr().err
    assert evaluate("--policy", "latest:logs", other, "--episodes", "2", "--env-kwargs", "length:4") == 0
    assert "differ" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--policy", "randon"), "Did you mean 'random'?"),
        (("--policy", "nothing.zip"), "There is no file 'nothing.zip'"),
        (("--policy", "random", "random"), "--policy names random twice"),
        (("--policy", "random", "--plot", "r.yml"), "--plot r.yml is a file: name a folder"),
        (
            ("--policy", "logs/maddpg/two_v0_1/two_v0.zip", "--env", "mpe2/simple_spread_v3"),
            "was trained in two_v0, for a",
        ),
        (("--policy", "random", "--episodes", "0"), "choose 1 or more"),
        (("--policy", "random", "--env-kwargs", "lenght:4"), "lenght"),
        (("--policy", "matd3:logs/maddpg/two_v0_1/two_v0.zip"), "MADDPG"),
        (("--policy", "ppo:logs/maddpg/two_v0_1/two_v0.zip"), "two_v0.zip is no model of PPO"),
        ((), "--policy"),
    ],
)
def test_wrong_words_are_explained(here, words, message, capsys):
    assert evaluate(*words) in (1, 2)
    assert message in capsys.readouterr().err


def test_an_environment_that_is_not_there_is_explained(here, capsys):
    assert main(["evaluate", "--env", "tow_v0", "--policy", "random"]) == 2
    assert "Unknown environment 'tow_v0'" in capsys.readouterr().err
    assert main(["evaluate", "--env", "QuadSwarm-v1", "--policy", "random"]) == 2
    assert "QuadSwarm-v0" in capsys.readouterr().err


def test_the_help_is_that_of_the_environment(here, capsys):
    with pytest.raises(SystemExit) as ended:
        evaluate("--help")
    assert ended.value.code == 0
    assert "returns of the team and of each agent" in capsys.readouterr().out.lower()


def test_agents_that_live_longer_have_their_own_columns():
    def row(name: str, *lives: float) -> dict:
        figure = {"mean": 1.0, "low": None, "high": None}
        agents = {f"a{k}": {"return": figure, "length": {**figure, "mean": life}} for k, life in enumerate(lives)}
        return {
            "policy": name,
            "env": "e",
            "seed": 0,
            "episodes": 1,
            "return": figure,
            "length": figure,
            "agents": agents,
        }

    assert "steps, x" in returns.tables([row("x", 3, 4)])
    assert "steps, x" not in returns.tables([row("x", 4, 4)])
