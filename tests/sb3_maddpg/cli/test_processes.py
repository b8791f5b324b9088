"""Commands in processes of their own; what happens if they are killed is tested where they are used."""

import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from sb3_maddpg.cli.processes import _launcher, run_all


@dataclass(frozen=True)
class Command:
    name: str
    output: Path
    words: list[str]
    environment: dict[str, str] = field(default_factory=dict)

    def command(self) -> tuple[list[str], str]:
        return self.words, "starts" if self.words else "nothing to do"


@pytest.mark.slow
def test_runs_all_and_returns_the_status_of_one_that_failed(tmp_path, capsys):
    jobs = [
        Command("first", tmp_path / "1.log", ["pretrained"]),
        Command("second", tmp_path / "2.log", ["no-such-command"]),
        Command("third", tmp_path / "3.log", []),
        Command("fourth", tmp_path / "4.log", ["pretrained"]),
    ]
    assert run_all(jobs, parallel=2) == 2
    printed = capsys.readouterr().out
    assert f"first: starts; {jobs[0].output}" in printed
    assert "first: finished" in printed
    assert f"second: ended with 2, see {jobs[1].output}" in printed
    assert "third: nothing to do" in printed
    assert "quad-swarm-flight" in jobs[0].output.read_text() == jobs[3].output.read_text()
    assert "no-such-command" in jobs[1].output.read_text()
    assert not jobs[2].output.exists()


@pytest.mark.slow
def test_commands_get_their_environment(tmp_path):
    words = ["evaluate", "--policy", "none", "--episodes", "1"]
    job = Command("one", tmp_path / "1.log", words, {"QUAD_SWARM_CACHE": str(tmp_path / "cache")})
    assert run_all([job], parallel=1) == 0, job.output.read_text()
    assert list((tmp_path / "cache").glob("*.so"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parallel": 0}, "--jobs 0 must be at least 1"),
        ({"parallel": 1, "engine": "rai"}, "did you mean 'ray'"),
        ({"parallel": 1, "address": "auto"}, "--address auto is for --engine ray only"),
    ],
)
def test_refuses_what_cannot_run(arguments, message):
    with pytest.raises(ValueError, match=message):
        run_all([], **arguments)


# Modules that Python, multiprocessing or a command imports
SHADOWED = ("pickle", "socket", "selectors", "signal", "yaml", "gymnasium", "runpy", "multiprocessing")
TRAP = "from pathlib import Path\nPath(__file__).with_suffix('.caught').touch()\nraise RuntimeError('caught')\n"


def lay_traps(folder: Path) -> None:
    for name in SHADOWED:
        (folder / f"{name}.py").write_text(TRAP)


@pytest.mark.slow
@pytest.mark.parametrize("version", [(3, 10), (3, 11)])
def test_a_child_imports_nothing_from_the_current_folder_but_from_pythonpath(version, tmp_path, monkeypatch):
    if version > sys.version_info[:2]:
        pytest.skip("this Python has no -P")
    monkeypatch.setattr(sys, "version_info", (*version, 0, "final", 0))
    lay_traps(tmp_path)
    (tmp_path / "path").mkdir()
    (tmp_path / "path/on_the_path.py").write_text("print('imported from PYTHONPATH')\n")
    words = ["evaluate", "--gym-packages", "on_the_path", "--policy", "nope"]
    env = {**os.environ, "PYTHONPATH": str(tmp_path / "path")}
    done = subprocess.run([*_launcher(), *words], cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "imported from PYTHONPATH" in done.stdout
    assert not list(tmp_path.glob("*.caught")), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--vec-env", "subproc", "-params", "n_envs:2"], ["--seeds", "0", "--jobs", "1"]])
def test_processes_of_a_training_import_only_what_the_user_named(words, tmp_path):
    pytest.importorskip("mpe2")
    lay_traps(tmp_path)
    (tmp_path / "my_team.py").write_text("from mpe2.simple_spread_v3 import parallel_env\n")
    (tmp_path / "r.yml").write_text(
        "default: {n_timesteps: 60, policy: MlpPolicy, learning_starts: 20, batch_size: 8}\n"
    )
    script = Path(sys.executable).with_name("sb3-maddpg")
    if not script.exists():
        pytest.skip("the command is not installed beside Python")
    command = [str(script), "train", "--env", "my_team", "--conf-file", "r.yml", "--eval-freq", "-1", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=500)
    logs = "".join(path.read_text() for path in tmp_path.glob("logs/*.log"))
    assert done.returncode == 0, done.stdout + done.stderr + logs
    assert list(tmp_path.glob("logs/maddpg/my_team_1/my_team.zip"))
    assert not list(tmp_path.glob("*.caught")), done.stderr
