"""The command line with PettingZoo modules as environments."""

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

import quad_swarm
from sb3_maddpg import MADDPG
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.cli.recipe import check_env_kwargs, check_keys, recipe_path
from sb3_maddpg.cli.runs import latest_model
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo_ids import register

SPREAD = ["--env", "mpe2/simple_spread_v3"]


def write(recipe: dict, env_id: str) -> str:
    Path("recipe.yml").write_text(yaml.safe_dump({env_id: recipe}))
    return "recipe.yml"


@pytest.fixture
def in_logs(tmp_path, monkeypatch):
    """An empty folder to work in, and no window."""
    known = dict(gymnasium.registry)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield tmp_path / "logs"
    gymnasium.registry.clear()
    gymnasium.registry.update(known)


@pytest.mark.slow
def test_a_pettingzoo_module_is_trained_watched_and_recorded(in_logs, capsys):
    wrapped = {"continuous_actions": True, "state": True, "wrappers": [{"supersuit.frame_stack_v2": {"stack_size": 2}}]}
    recipe = {"n_timesteps": 120, "learning_starts": 40, "train_freq": 10, "n_envs": 2, "policy": "MlpPolicy"}
    conf = write({**recipe, "env_kwargs": wrapped}, SPREAD[1])
    argv = ["train", *SPREAD, "--conf-file", conf, "--verbose", "0", "--eval-episodes", "1", "--save-replay-buffer"]
    kwargs = ["--env-kwargs", "max_cycles:9", "--eval-env-kwargs", "max_cycles:7", "--eval-freq", "60"]
    assert main([*argv, *kwargs, "--vec-env", "subproc"]) == 0
    run = in_logs / "maddpg" / "mpe2-simple_spread_v3_1"
    assert {float(row.split(",")[1]) for row in (run / "0.monitor.csv").read_text().splitlines()[2:]} == {9}
    assert np.load(run / "evaluations.npz")["ep_lengths"].tolist() == [[7], [7]]
    model = latest_model("latest:logs", "maddpg", SPREAD[1])
    assert MADDPG.load(model).observation_space.state_dim == 54  # stacking is for the agents
    assert MADDPG.load(model).observation_space.obs_dims == (36,) * 3

    assert main([*argv, "--eval-freq", "-1", "-i", model, "-n", "40"]) == 0
    assert MADDPG.load(latest_model("latest:logs", "maddpg", SPREAD[1])).num_timesteps == 160

    capsys.readouterr()
    assert main(["enjoy", *SPREAD, "--exp-id", "1", "-n", "20"]) == 0
    assert "Mean episode length: 9.00" in capsys.readouterr().out
    assert main(["record", *SPREAD, "--exp-id", "1", "-n", "15"]) == 0
    (video,) = run.rglob("*.mp4")
    assert video.stat().st_size > 500


def test_a_pettingzoo_environment_without_a_window_is_watched_without(in_logs, monkeypatch, capsys):
    monkeypatch.setitem(quad_swarm.QuadSwarmParallelEnv.metadata, "render_modes", ["rgb_array"])
    swarm = ["--env", "quad_swarm/parallel_env", "--env-kwargs", "max_steps:5"]
    recipe = write({"n_timesteps": 10, "policy": "MlpPolicy"}, swarm[1])
    assert main(["train", *swarm, "--conf-file", recipe, "--eval-freq", "-1", "--verbose", "0"]) == 0
    assert main(["enjoy", *swarm[:2], "-n", "10"]) == 0
    out = capsys.readouterr().out
    assert "has no window" in out
    assert "Mean episode length: 5.00" in out
    failed = in_logs / "maddpg" / "quad_swarm-parallel_env_2"
    failed.mkdir()
    assert main(["enjoy", *swarm[:2], "-n", "10"]) == 0
    assert "Runs after quad_swarm-parallel_env_1 have no such model" in capsys.readouterr().out
    assert main(["enjoy", *swarm[:2], "-n", "10", "--exp-id", "2"]) == 1
    assert f"there is no {failed.relative_to(Path.cwd())}" in capsys.readouterr().err
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        assert main(["enjoy", *swarm[:2], "-n", "10"]) == 0
        assert "there is no display" in capsys.readouterr().out


@pytest.mark.parametrize("algo", ["maddpg", "matd3"])
def test_the_packaged_recipes_are_for_environments_that_are_there(in_logs, algo):
    load_environments()
    recipes = yaml.safe_load(Path(recipe_path(None, algo, "default")).read_text())
    for env_id in ("spread_v3", "speaker_listener_v4", "tag_v3", "adversary_v3"):
        assert register(f"mpe2/simple_{env_id}")
        recipe = recipes[f"mpe2/simple_{env_id}"]
        check_keys(algo, recipe)
        check_env_kwargs(f"mpe2/simple_{env_id}", recipe["env_kwargs"])
        assert recipe["env_kwargs"] == {"continuous_actions": True}


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "discrete"), [(MADDPG, True), (MATD3, False), (MATD3, True)])
def test_the_packaged_recipes_train_both_kinds_of_actions(in_logs, capsys, algorithm, discrete):
    algo = ["--algo", algorithm.__name__.lower(), *SPREAD]
    argv = ["train", *algo, "-n", "60", "--eval-freq", "50", "--eval-episodes", "1", "--verbose", "0"]
    small = ["-params", "learning_starts:10", "train_freq:10", "batch_size:8", "buffer_size:100"]
    assert main([*argv, *small, *(["--env-kwargs", "continuous_actions:False"] if discrete else [])]) == 0
    model = algorithm.load(latest_model("latest:logs", algo[1], SPREAD[1]))
    assert isinstance(model.action_space, gymnasium.spaces.MultiDiscrete if discrete else gymnasium.spaces.Box)
    assert (model.gamma, model.learning_rate(1), model.max_grad_norm) == (0.95, 0.01, 0.5)
    assert model.noise_std == pytest.approx(0.1)  # at the end, on actions of [-1, 1]
    assert model.policy.n_critics == (2 if algorithm is MATD3 else 1)
    capsys.readouterr()
    assert main(["enjoy", *algo, "-n", "30"]) == 0
    assert "Mean episode length: 25.00" in capsys.readouterr().out
    if not discrete:
        assert main(["record", *algo, "-n", "5"]) == 0
        (video,) = in_logs.rglob("*.mp4")
        assert video.stat().st_size > 500


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--env", "mpe2/simple_spred_v3"], "did you mean 'mpe2/simple_spread_v3'?"),
        (["--env", "mpe3/simple_spread_v3"], "Did you mean 'mpe2/simple_spread_v3'?"),
        (["--env", "mpe3/mine_v0"], "no module mpe3.mine_v0 with a function parallel_env"),
        (["--env", "QuadSwram-v0"], "did you mean 'QuadSwarm-v0'?"),
        (["--env", "zzzz"], "A PettingZoo environment is PACKAGE/MODULE, or MODULE for a file in this folder"),
        ([*SPREAD, "--env-kwargs", "continous_actions:True"], "did you mean 'continuous_actions'?"),
        ([*SPREAD, "--eval-env-kwargs", "entry:'mpe2.simple_v3'"], "Unknown argument of mpe2/simple_spread_v3 'entry'"),
        ([*SPREAD, "--env-kwargs", "wrappers:['supersuit.dtype_v1']"], "supersuit.dtype_v1 cannot be imported"),
        ([*SPREAD, "--env-kwargs", "wrappers:['supersuit.black_death_v3']"], "black_death_v3 keeps dead agents"),
    ],
)
def test_what_is_no_pettingzoo_module_is_refused(in_logs, capsys, argv, message):
    assert main(["train", *argv, "--verbose", "0"]) in (1, 2)
    error = capsys.readouterr().err
    assert message in error
    assert error.count("-v") < 10  # the nearest few of all ids


def test_false_turns_an_argument_off(in_logs):
    argv = ["train", *SPREAD, "-n", "30", "--env-kwargs", "continuous_actions:false", "--verbose", "0"]
    assert main([*argv, "--eval-freq", "-1"]) == 0
    space = MADDPG.load(latest_model("latest:logs", "maddpg", SPREAD[1])).action_space
    assert isinstance(space, gymnasium.spaces.MultiDiscrete)
