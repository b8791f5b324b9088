"""Runs of the command line that are killed and resumed end as if nothing had happened."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_maddpg import MADDPG
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.resuming import _merged
from sb3_maddpg.cli.safety import RunLoader

SWARM = {
    "n_timesteps": 2400,
    "n_envs": 4,
    "vec_env": "gymnasium",
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [16]},
    "learning_starts": 200,
    "batch_size": 16,
    "buffer_size": 1200,
    "train_freq": 2,
    "env_kwargs": {
        "preset": "flight-v3",
        "n_robots": 3,
        "max_steps": 20,
        "scenario": {"symmetric_swap": 2, "forest": 1, "asymmetric_swap": 1},  # in no alphabetical order
    },
}
OWN = {"n_timesteps": 6000, "policy": "MlpPolicy", "learning_starts": 200, "batch_size": 16, "buffer_size": 1200}
RECIPES = {"QuadSwarm-v0": SWARM, "OwnBit-v0": {**OWN, "train_freq": 3, "normalize": "{'norm_reward': False}"}}
CURVES = ("timesteps", "results", "ep_lengths")


def start(words: list[str], folder: Path) -> subprocess.Popen:
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "sb3_maddpg", "train", *words]
    return subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def checkpoints(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("logs/*/*/checkpoints/checkpoint-*") if path.name[-1].isdigit())


def wait_for(process: subprocess.Popen, count: int, folder: Path, beyond: str = "") -> None:
    """Until there are so many checkpoints after a name."""
    end = time.monotonic() + 500
    while sum(path.name > beyond for path in checkpoints(folder)) < count:
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.02)


def results(folder: Path, env_id: str) -> dict:
    """What a run leaves behind, without the time."""
    (run,) = folder.glob("logs/maddpg/*_1")
    with zipfile.ZipFile(run / f"{env_id}.zip") as archive:
        found = {name: archive.read(name) for name in archive.namelist() if name.endswith(".pth")}
    with (run / "0.monitor.csv").open() as file:
        file.readline()
        found["monitor"] = [(row["r"], row["l"]) for row in csv.DictReader(file)]
    with np.load(run / "evaluations.npz") as curves:
        found |= {name: curves[name].tolist() for name in CURVES}
    found["files"] = sorted(str(path.relative_to(run)) for path in run.rglob("*"))
    (log,) = folder.glob("tb/*/*")
    # As TensorBoard reads it: what a later session writes again takes the place of what was written
    events = EventAccumulator(str(log), size_guidance={"scalars": 0}).Reload()
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith(("time/", "planner/solve_us"))]
    return found | {tag: [(one.step, one.value) for one in events.Scalars(tag)] for tag in tags}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", RECIPES)
def test_killed_and_resumed_twice_a_run_ends_as_the_uninterrupted_one(env_id, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    argv = ["--env", env_id, "--conf-file", "r.yml", "--seed", "1", "--checkpoint-every", "300", "--verbose", "0"]
    argv += ["--eval-freq", "800", "--eval-episodes", "2", "--tensorboard-log", "tb"]
    for folder in (whole, parts):
        folder.mkdir()
        (folder / "r.yml").write_text(yaml.safe_dump({env_id: RECIPES[env_id]}, sort_keys=False))
    uninterrupted = start(argv, whole)

    process = start(argv, parts)
    wait_for(process, 2, parts)
    process.kill()
    process.wait()
    last = checkpoints(parts)[-1].name
    process = start(["--resume", "--tensorboard-log", "tb"], parts)
    wait_for(process, 1, parts, last)
    process.send_signal(signal.SIGTERM)
    output = process.communicate()[0]
    assert process.returncode == -signal.SIGTERM, output
    assert "Ended by SIGTERM at step" in output
    process = start(["--resume", "--tensorboard-log", "tb"], parts)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert "Resuming logs/maddpg/" in output

    assert uninterrupted.communicate() is not None
    assert uninterrupted.returncode == 0
    expected, found = results(whole, env_id), results(parts, env_id)
    assert len(expected["monitor"]) > 20
    assert len(expected["timesteps"]) >= 3
    assert len(expected["train/critic_loss"]) > 2
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        assert found[name] == value, name
    assert not any("checkpoint" in name or "before" in name for name in found["files"])


@pytest.mark.slow
def test_a_copied_run_writes_into_the_copy_only(tmp_path):
    (tmp_path / "r.yml").write_text(yaml.safe_dump({"OwnBit-v0": OWN | {"train_freq": 3}}))
    argv = ["--env", "OwnBit-v0", "--conf-file", "r.yml", "--checkpoint-every", "300", "--verbose", "0"]
    process = start([*argv, "--eval-freq", "250", "--eval-episodes", "1"], tmp_path)
    wait_for(process, 2, tmp_path)
    process.kill()
    process.wait()
    run, copy = tmp_path / "logs/maddpg/OwnBit-v0_1", tmp_path / "copy"
    shutil.copytree(run, copy)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    process = start(["--resume", "copy"], tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    with np.load(copy / "evaluations.npz") as curves:
        assert curves["timesteps"].tolist() == list(range(250, 6001, 250))


@pytest.mark.slow
def test_resuming_a_run_that_trains_does_not_touch_it(tmp_path):
    (tmp_path / "r.yml").write_text(yaml.safe_dump({"OwnBit-v0": OWN | {"train_freq": 3, "n_timesteps": 100_000}}))
    argv = ["--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--checkpoint-every", "300"]
    process = start([*argv, "--verbose", "0"], tmp_path)
    wait_for(process, 1, tmp_path)
    second = start(["--resume"], tmp_path)
    output = second.communicate()[0]
    assert second.returncode == 1, output
    assert f"checkpoints is in use by process {process.pid}" in output
    process.send_signal(signal.SIGINT)
    output = process.communicate()[0]
    assert process.returncode == 130, output
    (run,) = tmp_path.glob("logs/maddpg/*_1")
    assert [path.name for path in run.glob("*.csv*")] == ["0.monitor.csv"]
    assert len((run / "0.monitor.csv").read_text().splitlines()) > 20


def test_what_cannot_be_resumed_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for argv, message in (
        (["--resume"], "no run in logs has checkpoints"),
        (["--resume", "nowhere"], "--resume 'nowhere': there is no such folder"),
        (["--resume", "."], ". is not the folder of a run with checkpoints (it has 0 args.yml)"),
        (["--env", "OwnBit-v0", "-f", ""], "--log-folder is empty"),
        (["--env", "OwnBit-v0", "--checkpoint-every", "-5"], "--checkpoint-every -5: pass a number of steps, or 0"),
    ):
        assert main(["train", *argv]) == 2
        assert message in capsys.readouterr().err
    Path("run/OwnBit-v0").mkdir(parents=True)
    Path("run/OwnBit-v0/args.yml").write_text("env: OwnBit-v0\n")
    assert main(["train", "--resume", "run"]) == 1
    assert "run has no complete checkpoint: begin again, without --resume" in capsys.readouterr().err
    Path("run/OwnBit-v0.zip").touch()
    assert main(["train", "--resume", "run"]) == 1
    assert "run is finished and has no checkpoints: train its model further with `train -i run/OwnBit-v0.zip" in (
        capsys.readouterr().err
    )


def test_checkpoints_can_be_switched_off(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**OWN, "n_timesteps": 300}}))
    argv = ["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--verbose", "0"]
    assert main([*argv, "--checkpoint-every", "0"]) == 0
    assert not list(Path("logs").rglob("checkpoints"))


@pytest.mark.slow
def test_an_interrupted_run_keeps_its_checkpoints(tmp_path):
    (tmp_path / "r.yml").write_text(yaml.safe_dump({"OwnBit-v0": OWN | {"train_freq": 3}}))
    argv = ["--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--checkpoint-every", "300"]
    process = start([*argv, "--verbose", "0"], tmp_path)
    wait_for(process, 1, tmp_path)
    process.send_signal(signal.SIGINT)
    output = process.communicate()[0]
    assert process.returncode == 130, output
    assert "Interrupted: saving" in output
    assert checkpoints(tmp_path)
    process = start(["--resume"], tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert not checkpoints(tmp_path)


@pytest.mark.slow
def test_another_number_of_environments_is_refused_until_it_is_as_before(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    recipe = OWN | {"train_freq": 3, "n_envs": 2}
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": recipe}))
    argv = ["--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--checkpoint-every", "300"]
    process = start([*argv, "--verbose", "0"], tmp_path)
    wait_for(process, 1, tmp_path)
    process.kill()
    process.wait()
    (run,) = Path("logs/maddpg").glob("*_1")

    def episodes() -> list[list[str]]:
        return [row.split(",")[:2] for row in (run / "0.monitor.csv").read_text().splitlines()]

    before = episodes()[1:15]
    for n_envs in (1, 3):
        Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": recipe | {"n_envs": n_envs}}))
        for words in (["-params", f"n_envs:{n_envs}"], ["--conf-file", "r.yml"]):
            assert main(["train", "--resume", *words]) != 0
            error = capsys.readouterr().err
            assert f"has n_envs=2, but the recipe or env has n_envs={n_envs} now: set it to 2 to resume" in error
            assert error.count("\n") == 1
    assert main(["train", "--resume"]) == 0, "the recipe of the run's folder is as it was"
    assert episodes()[1:15] == before


@pytest.mark.slow
def test_options_beside_resume_replace_those_of_the_run(killed, tmp_path, monkeypatch):
    monkeypatch.chdir(shutil.copytree(killed, tmp_path / "copy"))
    assert main(["train", "--resume", "-n", "1500", "--save-replay-buffer"]) == 0
    (run,) = Path("logs/maddpg").glob("*_1")
    assert MADDPG.load(run / "OwnBit-v0.zip").num_timesteps == 1500
    assert (run / "replay_buffer.pkl").exists()
    assert yaml.safe_load((run / "OwnBit-v0/args.yml").read_text())["checkpoint_every"] == 300


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """:return: a folder with a killed run"""
    folder = tmp_path_factory.mktemp("killed")
    (folder / "r.yml").write_text(yaml.safe_dump({"OwnBit-v0": OWN | {"train_freq": 3}}))
    argv = ["--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--checkpoint-every", "300"]
    process = start([*argv, "--verbose", "0"], folder)
    wait_for(process, 1, folder)
    process.kill()
    process.wait()
    return folder


def change(name: str, **values) -> None:
    (path,) = Path("logs").rglob(name)
    path.write_text(yaml.safe_dump({**yaml.load(path.read_text(), RunLoader), **values}))


CHECKPOINTS = "stable_baselines3.common.callbacks.CheckpointCallback"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "values", "told"),
    [
        ("config.yml", {"callback": [{"os.mkdir": {"path": "caught"}}]}, "callback names 'os.mkdir'"),
        ("config.yml", {"policy": "lurking.Policy"}, "policy names 'lurking.Policy'"),
        ("config.yml", {"replay_buffer_class": "lurking.Buffer"}, "replay_buffer_class names 'lurking.Buffer'"),
        ("config.yml", {"env_wrapper": "lurking.Wrapper"}, "env_wrapper names 'lurking.Wrapper'"),
        (
            "config.yml",
            {"callback": [{CHECKPOINTS: {"save_freq": 9, "save_path": "../victim"}}]},
            "save_path is '../victim', which may be a path outside",
        ),
        ("config.yml", {"monitor_kwargs": {"info_keywords": ["a/b"]}}, "info_keywords is 'a/b'"),
        ("args.yml", {"gym_packages": ["lurking"]}, "args.yml imports 'lurking'"),
        ("args.yml", {"gym_packages": ["gymnasium", "lurking"]}, "args.yml imports 'lurking'"),
        ("args.yml", {"env": "lurking"}, "args.yml imports 'lurking'"),
        ("args.yml", {"tensorboard_log": "/victim"}, "--tensorboard-log is '/victim', outside"),
        ("args.yml", {"tensorboard_log": "../tb"}, "--tensorboard-log is '../tb', outside"),
        ("args.yml", {"algo": "ppo"}, "algo is 'ppo'"),
        ("args.yml", {"n_timesteps": "many"}, "args.yml: argument -n/--n-timesteps: 'many' is no integer"),
        ("args.yml", {"vec_env": "--track"}, "invalid choice: '--track'"),
    ],
)
def test_the_folder_of_someone_elses_run_runs_no_code(killed, tmp_path, monkeypatch, capsys, name, values, told):
    folder = shutil.copytree(killed, tmp_path / "copy")
    monkeypatch.chdir(folder)
    monkeypatch.delitem(sys.modules, "lurking", raising=False)  # a module of this name is imported by other tests
    monkeypatch.syspath_prepend("")  # as `python -m` does
    (folder / "lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\n")
    change(name, **values)
    before = sorted(tmp_path.rglob("*"))
    assert main(["train", "--resume"]) == 1
    assert told in (error := capsys.readouterr().err)
    assert error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_options_that_only_begin_a_run_are_not_taken_from_its_folder(killed, tmp_path, monkeypatch):
    folder = shutil.copytree(killed, tmp_path / "copy")
    monkeypatch.chdir(folder)
    (folder / "lurking.py").write_text("from pathlib import Path\nPath('caught').touch()\n")
    further = {"conf_file": "lurking", "track": True, "optimize_hyperparameters": True, "log_folder": "/victim"}
    change("args.yml", **further, storage="victim.log", hyperparams={"callback": "os.system"}, n_timesteps=1200)
    assert main(["train", "--resume"]) == 0
    assert not (folder / "caught").exists()
    assert not (folder / "victim.log").exists()


@pytest.mark.slow
def test_someone_elses_run_is_resumed_if_it_runs_no_code(killed, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(shutil.copytree(killed, tmp_path / "copy"))
    change("config.yml", n_timesteps=1200, policy="sb3_maddpg.MADDPGPolicy")
    assert main(["train", "--resume"]) == 0
    assert "Resuming logs" in capsys.readouterr().out

    monkeypatch.chdir(shutil.copytree(killed, tmp_path / "trusted"))
    change("config.yml", callback=[{CHECKPOINTS: {"save_freq": 50, "save_path": "caught"}}])
    assert main(["train", "--resume"]) == 1
    assert not Path("caught").exists()
    assert "may be a path outside" in capsys.readouterr().err
    assert main(["train", "--resume", "--trust"]) == 2
    assert "CheckpointCallback" in (error := capsys.readouterr().err)
    assert "resume with the same ones" in error


@pytest.mark.slow
def test_what_a_run_imports_and_writes_elsewhere_is_named_again(tmp_path):
    pytest.importorskip("mpe2")
    (tmp_path / "my_team.py").write_text("from mpe2.simple_spread_v3 import parallel_env\n")
    (tmp_path / "my_callbacks.py").write_text(
        "from stable_baselines3.common.callbacks import CallbackList\nclass Own(CallbackList):\n"
        "    def __init__(self):\n        super().__init__([])\n"
    )
    recipe = {**OWN, "n_timesteps": 3000, "callback": "my_callbacks.Own"}
    (tmp_path / "r.yml").write_text(yaml.safe_dump({"default": recipe}))
    argv = ["--env", "my_team/parallel_env", "--conf-file", "r.yml", "--eval-freq", "-1", "--checkpoint-every", "200"]
    named = ["--gym-packages", "my_callbacks", "--tensorboard-log", "tb"]
    process = start([*argv, *named, "--verbose", "0"], tmp_path)
    wait_for(process, 1, tmp_path)
    process.kill()
    process.wait()
    for words, missing in (
        (["--resume"], "imports 'my_callbacks'"),
        (["--resume", *named[:2]], "imports 'my_team'"),
        (["--resume", *named[:2], "--env", argv[1]], "--tensorboard-log is 'tb', outside"),
    ):
        process = start(words, tmp_path)
        output = process.communicate()[0]
        assert process.returncode == 1
        assert missing in output
        assert "pass --trust" in output
    process = start(["--resume", *named, "--env", argv[1]], tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert "Resuming logs/maddpg" in output


def test_zeros_of_a_run_stay_zeros():
    written = {"seed": 0, "verbose": 0, "checkpoint_every": 0, "progress": False, "conf_file": None}
    args = _merged(written, ["--resume", "run"], Path("args.yml"))
    assert [getattr(args, name) for name in ("seed", "verbose", "checkpoint_every")] == [0, 0, 0]
    assert args.progress is False
