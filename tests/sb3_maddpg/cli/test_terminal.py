"""Output that nobody can read any more, and lines of several threads."""

import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

from sb3_maddpg.cli.terminal import tell

RECIPE = {"n_timesteps": 10**7, "policy": "MlpPolicy", "learning_starts": 50, "buffer_size": 500, "batch_size": 16}
TRAIN = [sys.executable, "-m", "sb3_maddpg", "train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1"]


@pytest.fixture(autouse=True)
def _with_a_recipe(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    Path("r.yml").write_text(yaml.safe_dump({"OwnBit-v0": RECIPE}))


def wait_until(condition, process: subprocess.Popen) -> None:
    end = time.monotonic() + 500
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)


def checkpoints() -> list[str]:
    return sorted(path.name for path in Path().glob("logs/*/*/checkpoints/checkpoint-*") if path.name[-1].isdigit())


def trains() -> bool:
    return any(len(path.read_text().splitlines()) > 20 for path in Path().glob("logs/*/*/0.monitor.csv"))


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--log-interval", "1"], ["--progress"]])
def test_a_training_whose_terminal_is_closed_writes_its_checkpoint_and_ends_by_the_signal(words):
    ours, theirs = pty.openpty()
    # Its own session with this terminal, whose end is what makes Linux send SIGHUP
    process = subprocess.Popen(
        [sys.executable, "-c", "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
         "os.execv(sys.argv[1], sys.argv[1:])", *TRAIN, "--checkpoint-every", "1000000", *words],
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    reader = threading.Thread(target=read_all, args=(ours,), daemon=True)
    reader.start()
    try:
        wait_until(trains, process)
        assert checkpoints() == []
        os.close(ours)
        process.wait(timeout=500)
    finally:
        process.kill()
    assert process.returncode == -signal.SIGHUP
    assert len(checkpoints()) == 1


@pytest.mark.slow
def test_a_training_whose_tee_ends_with_the_terminal_writes_its_checkpoint_too():
    """Its tables meet the broken pipe before the signal arrives."""
    process = subprocess.Popen(
        [*TRAIN, "--checkpoint-every", "1000000", "--log-interval", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    try:
        while not trains():
            process.stdout.read1(65536)
            assert process.poll() is None
        process.stdout.close()
        time.sleep(0.05)
        process.send_signal(signal.SIGHUP)
        process.wait(timeout=500)
    finally:
        process.kill()
    assert process.returncode == -signal.SIGHUP
    assert len(checkpoints()) == 1


def read_all(terminal: int) -> None:
    try:
        while os.read(terminal, 65536):
            pass
    except OSError:
        return


@pytest.mark.slow
@pytest.mark.parametrize("words", [[], ["--seeds", "0", "--jobs", "1"]])
def test_ignored_signals_stay_ignored(words):
    with Path("out.txt").open("wb") as out:
        process = subprocess.Popen(
            [*TRAIN, "--checkpoint-every", "1000", *words],
            stdout=out,
            stderr=out,
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
        )
    try:
        wait_until(checkpoints, process)
        last = checkpoints()[-1]
        process.send_signal(signal.SIGHUP)
        wait_until(lambda: checkpoints()[-1] > last, process)  # the training goes on
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=500)
    finally:
        process.kill()
    assert process.returncode == (-signal.SIGTERM if not words else 128 + signal.SIGTERM)
    assert "SIGHUP" not in Path("out.txt").read_text()


@pytest.mark.slow
def test_a_reader_that_ends_is_no_error():
    process = subprocess.Popen(
        [sys.executable, "-m", "sb3_maddpg", "pretrained"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(timeout=500) == 128 + signal.SIGPIPE


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="shells close streams there in another way")
@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_commands_work_without_standard_streams(closed):
    command = [sys.executable, "-m", "sb3_maddpg", "evaluate", "--policy", "none", "--episodes", "1"]
    command += ["--scenario", "random", "--json", "table.json"]
    shell = f'"$@" {" ".join(f"{number}>&-" for number in closed)}'
    done = subprocess.run(["sh", "-c", shell, "sh", *command], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(Path("table.json").read_text())[0]["episodes"] == 1


def test_lines_of_threads_are_printed_in_one_piece(monkeypatch):
    pieces = []

    class Slow:
        def write(self, text: str) -> None:
            pieces.append(text)
            time.sleep(0.01)

        def flush(self) -> None:
            pass

    monkeypatch.setattr(sys, "stdout", Slow())
    threads = [threading.Thread(target=tell, args=(f"seed {number}",)) for number in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted("".join(pieces).splitlines()) == [f"seed {number}" for number in range(5)]
