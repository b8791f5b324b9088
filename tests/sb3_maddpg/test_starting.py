"""Ctrl-C while the command imports its modules, and in what must not be cut short."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_maddpg.starting import uninterrupted

# Stands for an import that takes long: it sends Ctrl-C to itself
SLOW = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nimport time\ntime.sleep(60)\n"


@pytest.mark.parametrize("words", [["-m", "sb3_maddpg", "train"], ["sb3-maddpg", "train"]])
def test_ctrl_c_during_the_imports_is_one_line(words, tmp_path):
    trap(tmp_path, SLOW)
    (tmp_path / "sb3-maddpg").write_text("from sb3_maddpg.cli.main import main\nmain()\n")
    if words[0] != "-m":
        words = [str(tmp_path / words[0]), *words[1:]]
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, env=environment(tmp_path), capture_output=True, text=True
    )
    assert done.returncode == 128 + signal.SIGINT
    assert done.stderr == "Interrupted.\n"


def test_other_programs_keep_their_keyboard_interrupt(tmp_path):
    trap(tmp_path, SLOW)
    program = "try:\n    from sb3_maddpg import MADDPG\nexcept KeyboardInterrupt:\n    print('as usual')\n"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment(tmp_path), capture_output=True, text=True
    )
    assert done.stdout == "as usual\n", done.stderr


def test_background_jobs_keep_ignoring_it(tmp_path):
    trap(tmp_path, SLOW.replace("time.sleep(60)", "print('goes on', flush=True)\nos._exit(0)"))
    done = subprocess.run(
        [sys.executable, "-m", "sb3_maddpg", "train"],
        cwd=tmp_path,
        env=environment(tmp_path),
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert done.stdout == "goes on\n", done.stderr


def test_what_must_not_be_cut_short_is_finished_first():
    done = []

    @uninterrupted()
    def work():
        signal.raise_signal(signal.SIGINT)
        done.append("all")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["all"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with uninterrupted():
        pass  # without an interrupt, nothing is raised


def trap(folder: Path, code: str) -> None:
    """Not in the current folder, from which a command imports nothing."""
    (folder / "path").mkdir()
    (folder / "path/torch.py").write_text(code)


def environment(folder: Path) -> dict[str, str]:
    return {"PYTHONPATH": str(folder / "path"), "PATH": "/usr/bin:/bin", "HOME": str(folder)}


def test_parts_of_it_may_be_cut_short():
    done = []

    def work():
        with uninterrupted() as allowed:
            signal.raise_signal(signal.SIGINT)
            done.append("all")
            with allowed():
                done.append("an earlier interrupt raises first")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["all"]
    with uninterrupted() as allowed:
        with pytest.raises(KeyboardInterrupt), allowed():
            signal.raise_signal(signal.SIGINT)
        done.append("then it is finished again")
    assert len(done) == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
