"""Many trainings by one command, some of which are killed."""

import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
import yaml
from processes import children, descendants

from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.seeds import parse_seeds

RECIPE = {"n_timesteps": 1500, "policy": "MlpPolicy", "learning_starts": 100, "batch_size": 16, "train_freq": 3}
ARGV = ["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1", "--checkpoint-every", "200"]


@pytest.mark.parametrize(("text", "seeds"), [("3", [3]), ("0-2", [0, 1, 2]), ("5, 1-2,1", [5, 1, 2])])
def test_seeds_are_numbers_and_ranges(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "2-1", "1-", "-1", "1.5", "1;2"])
def test_anything_else_is_refused(text):
    with pytest.raises(ValueError, match="write numbers and ranges, such as 0-4"):
        parse_seeds(text)


def test_too_many_seeds_are_refused():
    with pytest.raises(ValueError, match="a range holds at most 10000 seeds"):
        parse_seeds("0-99999999999")


@pytest.mark.parametrize("words", [["--seed", "3"], ["--seed=3"]])
def test_a_seed_beside_the_seeds_is_refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--env", "OwnBit-v0", "--seeds", "0", *words]) == 2
    assert "--seeds and --seed exclude each other" in capsys.readouterr().err


def weights(folder: Path) -> dict[str, bytes]:
    """Of each run by its seed."""
    found = {}
    for path in folder.glob("logs/maddpg/*_*/OwnBit-v0.zip"):
        seed = yaml.unsafe_load((path.parent / "OwnBit-v0" / "args.yml").read_text())["seed"]
        with zipfile.ZipFile(path) as archive:
            assert seed not in found
            found[seed] = archive.read("policy.pth")
    return found


def start(folder: Path, *words: str, steps: int = RECIPE["n_timesteps"]) -> subprocess.Popen:
    folder.mkdir(exist_ok=True)
    (folder / "r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**RECIPE, "n_timesteps": steps}}))
    command = [sys.executable, "-m", "sb3_maddpg", *ARGV, *words]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "RAY_worker_niceness": "0"}
    return subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_for_checkpoints(folder: Path, process: subprocess.Popen) -> None:
    end = time.monotonic() + 500
    while len(list(folder.glob("logs/maddpg/*/checkpoints/checkpoint-*[0-9]"))) < 2:
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGTERM])
def test_killed_and_begun_again_all_seeds_end_as_if_nothing_had_happened(kind, tmp_path):
    alone, parts = tmp_path / "alone", tmp_path / "parts"
    expected = start(alone, "--seeds", "1-2", "--jobs", "2")
    assert expected.wait(timeout=500) == 0, expected.stdout.read()
    process = start(parts, "--seeds", "1-2", "--jobs", "2")
    wait_for_checkpoints(parts, process)
    trainings = children(process.pid)
    assert len(trainings) == 2
    process.send_signal(kind)
    process.communicate(timeout=500)
    for _ in range(300):
        if not any(
            Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_text() for pid in trainings
        ):
            break
        time.sleep(0.1)
    else:
        raise AssertionError("trainings outlive the command")
    again = start(parts, "--seeds", "1-2", "--jobs", "2")
    output, _ = again.communicate(timeout=500)
    assert again.returncode == 0, output
    assert "resumes" in output
    assert weights(parts) == weights(alone)
    assert set(weights(parts)) == {1, 2}
    third = start(parts, "--seeds", "1-3", "--jobs", "2")
    output, _ = third.communicate(timeout=500)
    assert output.count("finished before") == 2
    assert set(weights(parts)) == {1, 2, 3}


def trainings_of(process: subprocess.Popen) -> list[int]:
    """Trainings in processes of Ray."""
    words = b"-m\0sb3_maddpg\0train\0"
    return [pid for pid in descendants(process.pid) if words in Path(f"/proc/{pid}/cmdline").read_bytes()]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_a_cluster_trains_the_same_whatever_dies(tmp_path):
    pytest.importorskip("ray")
    alone, there = tmp_path / "alone", tmp_path / "there"
    expected = start(alone, "--seeds", "1-2", "--jobs", "2", steps=6000)
    assert expected.wait(timeout=500) == 0, expected.stdout.read()
    words = ["--seeds", "1-2", "--jobs", "2", "--engine", "ray"]
    process = start(there, *words, steps=6000)
    wait_for_checkpoints(there, process)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=500)
    assert process.returncode == 128 + signal.SIGTERM
    assert not weights(there), "the trainings end with the command"
    process = start(there, *words, steps=6000)
    end = time.monotonic() + 500
    while not trainings_of(process):
        assert time.monotonic() < end
        time.sleep(0.1)
    training = trainings_of(process)[0]
    (worker,) = (pid for pid in descendants(process.pid) if training in children(pid))
    os.kill(worker, signal.SIGKILL)
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 0, output
    assert any("Resuming" in path.read_text() for path in there.glob("logs/seed_*.log"))
    assert weights(there) == weights(alone)


@pytest.mark.slow
def test_ctrl_c_ends_all_trainings_with_one_line(tmp_path):
    process = start(tmp_path, "--seeds", "1-2", "--jobs", "2", steps=100_000)
    wait_for_checkpoints(tmp_path, process)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 128 + signal.SIGINT
    assert "Interrupted; repeat the command to continue." in output
    assert "Traceback" not in output
    assert not weights(tmp_path)


@pytest.mark.slow
def test_a_training_that_fails_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**RECIPE, "batch_size": -1}}))
    assert main([*ARGV, "--seeds", "0-1", "--jobs", "1"]) == 2
    assert "seed 1: ended with 2, see" in capsys.readouterr().out
    assert "batch_size=-1" in Path("logs/seed_0.log").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seeds", "0-1", "--seed", "3"], "--seeds and --seed exclude each other"),
        (["--seeds", "0", "--jobs", "0"], "--jobs 0 must be at least 1"),
        (["--seeds", "x"], "write numbers and ranges"),
        (["--seeds", "0", "--resume"], "--resume continues one run"),
        (["--seeds", "0", "--engine", "rai"], "did you mean 'ray'?"),
        (["--seeds", "0", "--address", "auto"], "--address auto is for --engine ray only"),
        (["--engine", "ray"], "--jobs, --engine and --address are for --seeds"),
        (["--jobs", "2"], "a single training runs in this process"),
    ],
)
def test_what_does_not_go_together_is_refused(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*ARGV, *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_command_with_an_environment_of_the_present_folder_resumes_its_runs(tmp_path):
    pytest.importorskip("mpe2")
    (tmp_path / "my_team.py").write_text("from mpe2.simple_spread_v3 import parallel_env\n")
    (tmp_path / "r.yml").write_text(yaml.safe_dump({"default": RECIPE}))
    words = [*ARGV, "--env", "my_team/parallel_env", "--seeds", "0", "--jobs", "1"]
    for last in (False, True):
        command = [sys.executable, "-m", "sb3_maddpg", *words]
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if not last:
            wait_for_checkpoints(tmp_path, process)
            process.send_signal(signal.SIGTERM)
            process.communicate()
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert "seed 0: resumes logs" in output
    assert "Resuming logs" in (tmp_path / "logs" / "seed_0.log").read_text()
