"""The search for hyperparameters, ``sb3-maddpg train -optimize``."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import optuna
import pytest
import yaml
from optuna.distributions import CategoricalDistribution
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_maddpg import MADDPG
from sb3_maddpg.cli.literals import parse_literal
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.safety import as_yaml
from sb3_maddpg.cli.tuning import SPACES, Searched, convert_params
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.utils import arguments_of
from toys import Neighbours, toy

ALGOS = {"maddpg": MADDPG, "matd3": MATD3}
NOISE = {"first_noise", "noise_left"}
SHARING = {"share_actor", "share_critic"}
RECIPE = {
    "n_timesteps": 60,
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8], "threshold": 0.25},
    "learning_starts": 20,
    "buffer_size": 1000,
}
SEARCH = ["-optimize", "--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]


class Fails(BaseCallback):
    """Goes wrong, by itself or because a network has."""

    def __init__(self, in_the_network: bool):
        super().__init__()
        self.in_the_network = in_the_network

    def _on_step(self):
        if self.in_the_network:
            self.model.actor.net.biases[0].data.fill_(float("nan"))
        raise ValueError("a callback that is wrong")


class Counts(BaseCallback):
    """Counts the trials."""

    trials = 0

    def _on_training_start(self):
        Counts.trials += 1

    def _on_step(self):
        return True


class Worse(OwnBit):
    """Pays the less, the later the trial."""

    def step(self, action):
        observation, _, *ends, info = super().step(action)
        reward = float(-Counts.trials)
        return observation, reward, *ends, {**info, "agent_rewards": np.full(self.n_agents, reward)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, and a module that recipes can name."""
    known = dict(gymnasium.registry)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "of_the_test", SimpleNamespace(Fails=Fails, Counts=Counts))
    monkeypatch.setattr(Counts, "trials", 0)
    gymnasium.register("Worse-v0", entry_point=Worse)
    yield tmp_path
    gymnasium.registry.clear()
    gymnasium.registry.update(known)


def train(*argv: str, env: str = "OwnBit-v0", algo: str = "maddpg", recipe: dict | None = None) -> int:
    Path("recipe.yml").write_text(yaml.safe_dump({env: {**RECIPE, **(recipe or {})}}))
    return main(
        ["train", "--algo", algo, "--env", env, "--conf-file", "recipe.yml", "--verbose", "0", "--seed", "1", *argv]
    )


def study(storage: str = "s.log", name: str = "s") -> optuna.Study:
    backend = optuna.storages.journal.JournalFileBackend(storage)
    return optuna.load_study(study_name=name, storage=optuna.storages.JournalStorage(backend))


def sample(algo: str, env, n_envs: int = 1, policy: str = "MlpPolicy", seed: int = 0, **hyperparams):
    """:return: a trial, and the arguments of the algorithm"""
    sampler = optuna.samplers.RandomSampler(seed=seed)
    trial = optuna.create_study(sampler=sampler).ask()
    searched = Searched(env, hyperparams, arguments_of(MADDPG.policy_aliases[policy]), n_envs)
    return trial, SPACES[algo](trial, searched)


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize(
    ("kind", "searched"),
    [
        ("binary", {"estimator"}),
        ("continuous", NOISE),
        ("categorical", {"estimator"}),
        ("heterogeneous", {"estimator"} | NOISE),
        ("mixed", {"estimator"} | NOISE),
    ],
)
def test_what_matters_to_the_team_is_searched(algo, kind, searched):
    env = toy(kind)
    space = {"estimator", "policy_delay", "target_policy_noise"} | NOISE | SHARING
    if algo == "matd3":
        searched = searched | {"policy_delay"} | ({"target_policy_noise"} if searched & NOISE else set())
    for seed in range(5):
        trial, params = sample(algo, env, seed=seed)
        # No two agents of these teams see as many numbers: they cannot share
        assert trial.params.keys() & space == searched
        assert ("temperature" in params) == (params.get("estimator", "score") not in ("score", "expected"))
        model = ALGOS[algo]("MlpPolicy", env, **params)
        assert model.gamma == pytest.approx(1 - trial.params["one_minus_gamma"])
        assert convert_params(trial.params) == params


def test_agents_that_are_alike_may_share():
    (homogeneous, _), (heterogeneous, _) = sample("maddpg", Neighbours()), sample("maddpg", toy("binary"))
    assert homogeneous.distributions["share_actor"] == CategoricalDistribution(["false", "true"])
    assert not SHARING & heterogeneous.params.keys()
    trial, _ = sample("maddpg", Neighbours(), policy="PairPolicy")
    assert not SHARING & trial.params.keys()

    from mpe2 import simple_tag_v3

    from sb3_maddpg.team.pettingzoo import TeamEnv

    tag = TeamEnv(simple_tag_v3.parallel_env(continuous_actions=True))
    trials = [sample("maddpg", tag, seed=seed) for seed in range(9)]
    choices = {json.dumps(params["policy_kwargs"]["share_critic"]) for _, params in trials}
    assert choices == {"false", "[[0, 1, 2]]"}  # the adversaries
    for _, params in trials[:3]:
        MADDPG("MlpPolicy", tag, buffer_size=2048, **params)


def test_updates_are_counted_in_transitions_and_noise_is_left_to_action_noise():
    env = DummyVecEnv([lambda: toy("continuous")] * 20)
    trial, params = sample("maddpg", env, n_envs=20, action_noise="given")
    assert (trial.distributions["train_freq"].low, trial.distributions["train_freq"].high) == (1, 10)
    assert "exploration_noise" not in params


@pytest.mark.parametrize(("buffer_size", "sizes"), [(100, {100}), (1000, {256, 512}), (1024, {256, 512, 1024})])
def test_batches_fit_into_the_replay_buffer_of_the_recipe(buffer_size, sizes):
    trials = [sample("maddpg", toy("binary"), seed=seed, buffer_size=buffer_size)[0] for seed in range(12)]
    assert {trial.params["batch_size"] for trial in trials} == sizes


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGOS)
def test_the_first_trial_of_a_study_is_taken_up_again(algo, folder, capsys):
    stored = ["--storage", "s.log", "--study-name", "s"]
    assert train(*SEARCH, *stored, algo=algo) == 0
    assert sorted(path.suffix for path in (folder / "logs" / algo).iterdir()) == [".csv", ".yml"]  # no run
    (trial,) = study().trials
    for trial_id in ("0", "1"):
        code = train(*stored, "--trial-id", trial_id, "--eval-freq", "-1", "-params", "n_steps:2", algo=algo)
        assert code == (0 if trial_id == "0" else 2)
    assert "Study s has no trial 1" in capsys.readouterr().err
    model = ALGOS[algo].load(f"logs/{algo}/OwnBit-v0_1/OwnBit-v0.zip")
    expected = convert_params(trial.params)
    policy_kwargs = {**RECIPE["policy_kwargs"], **expected.pop("policy_kwargs")}
    assert {key: model.policy_kwargs[key] for key in policy_kwargs} == policy_kwargs
    assert model.n_steps == 2  # the command line has the last word
    assert (model.tau, model.batch_size, model.estimator) == tuple(
        expected[key] for key in ("tau", "batch_size", "estimator")
    )


def test_the_best_trial_is_written_as_a_recipe(folder, capsys):
    assert train(*SEARCH, "--storage", "s.log", "--study-name", "s") == 0
    command = capsys.readouterr().out.splitlines()[-1]
    assert command == "  sb3-maddpg train --algo maddpg --env OwnBit-v0 --conf-file logs/maddpg/OwnBit-v0_best.yml"
    (recipe,) = yaml.safe_load(Path("logs/maddpg/OwnBit-v0_best.yml").read_text()).values()
    params = study().best_params
    assert recipe["gamma"] == pytest.approx(1 - params["one_minus_gamma"])
    assert recipe["tau"] == params["tau"]
    assert not recipe.keys() & {"one_minus_gamma", "first_noise", "noise_left", "net_arch"}
    assert recipe["policy_kwargs"]["threshold"] == 0.25  # of the recipe that was searched from
    assert main([*command.split()[1:], "--eval-freq", "-1", "--verbose", "0"]) == 0
    model = MADDPG.load("logs/maddpg/OwnBit-v0_1/OwnBit-v0.zip")
    assert (model.tau, model.gamma) == (recipe["tau"], recipe["gamma"])
    assert 60 <= model.num_timesteps < 60 + recipe["train_freq"]


def test_classes_of_a_trial_have_a_form_in_a_recipe():
    from torch import nn

    params = {"policy_kwargs": {"activation_fn": nn.Tanh, "net_arch": {"pi": [64]}}, "gamma": 0.9}
    written = yaml.safe_load(yaml.safe_dump(as_yaml(params)))
    assert parse_literal(written["policy_kwargs"]) == params["policy_kwargs"]
    assert written["gamma"] == 0.9


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--trial-id", "0"], "pass --storage and --study-name"),
        (["--trial-id", "0", "--storage", "t.log", "--study-name", "s"], "There is no file t.log"),
        (["--trial-id", "0", "--storage", "s.log", "--study-name", "stud"], "did you mean 'study'"),
    ],
)
def test_a_trial_that_is_not_there_is_refused(folder, capsys, argv, message):
    backend = optuna.storages.journal.JournalFileBackend("s.log")
    optuna.create_study(study_name="study", storage=optuna.storages.JournalStorage(backend))
    assert train(*argv) == (1 if "t.log" in argv else 2)
    assert message in capsys.readouterr().err
    assert not Path("t.log").exists()


def test_a_trial_whose_network_diverged_is_pruned_and_any_other_error_ends_the_search(folder, capsys):
    stored = [*SEARCH, "--storage", "s.log", "--study-name", "s"]
    callback = "of_the_test.Fails"
    assert train(*stored, recipe={"callback": [{callback: {"in_the_network": True}}]}) == 1
    out, error = capsys.readouterr()
    assert "Trial 0 diverged" in out
    assert "No trials are completed yet" in error
    assert train(*stored, recipe={"callback": [{callback: {"in_the_network": False}}]}) == 1
    assert "a callback that is wrong" in capsys.readouterr().err
    assert [trial.state.name for trial in study().trials] == ["PRUNED", "FAIL"]
    assert train(*stored, "-params", "estimater:'score'") == 2
    assert "did you mean 'estimator'" in capsys.readouterr().err


def test_a_trial_behind_the_others_is_pruned(folder):
    search = [*SEARCH, "--storage", "s.log", "--study-name", "s", "--n-startup-trials", "1"]
    argv = [*search, "--n-trials", "3", "--n-evaluations", "4"]
    assert train(*argv, env="Worse-v0", recipe={"callback": ["of_the_test.Counts"]}) == 0
    states = [trial.state.name for trial in study().trials]
    assert states[0] == "COMPLETE"
    assert states[-1] == "PRUNED"


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["logs/s.log", "sqlite:///s.db"])
def test_workers_share_a_study(folder, storage):
    Path("recipe.yml").write_text(yaml.safe_dump({"OwnBit-v0": RECIPE}))
    command = [sys.executable, "-m", "sb3_maddpg", "train", "--env", "OwnBit-v0", "--conf-file", "recipe.yml"]
    command += [*SEARCH, "--n-trials", "2", "--storage", storage, "--study-name", "s", "--seed", "1"]
    workers = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) for _ in range(2)]
    for worker in workers:
        output, _ = worker.communicate(timeout=500)
        assert worker.returncode == 0, output
    both = study(storage) if storage.endswith(".log") else optuna.load_study(study_name="s", storage=storage)
    assert [trial.state.name for trial in both.trials] == ["COMPLETE"] * 4
    # The same seed, but no trial twice
    assert len({trial.params["tau"] for trial in both.trials}) == 4
    assert list(Path("logs/maddpg").glob("report*.csv"))
