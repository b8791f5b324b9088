"""Commands in processes of their own; what happens if they are killed is tested where they are used."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from sb3_maddpg.cli.processes import run_all


@dataclass(frozen=True)
class Command:
    name: str
    output: Path
    words: list[str]
    environment: dict[str, str] = field(default_factory=dict)

    def command(self) -> tuple[list[str], str]:
        return self.words, "starts" if self.words else "nothing to do"


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
