"""Searches whose processes are killed: nothing that is finished is tried again, nothing that was begun is lost."""

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pandas as pd
import pytest
import yaml
from optuna.storages.journal import JournalFileBackend
from optuna.study import _optimize as optuna_loop
from optuna.trial import TrialState
from processes import children, descendants

from sb3_maddpg.cli import study as study_module
from sb3_maddpg.cli.main import main
from sb3_maddpg.cli.search import kept_search, mark_owner, open_storage, register_worker, retry_lost_trials, tell_best

RECIPE = {"n_timesteps": 400, "policy": "MlpPolicy", "learning_starts": 20, "policy_kwargs": {"net_arch": [8]}}
COMMAND = [sys.executable, "-m", "sb3_maddpg", "train", "-optimize", "--env", "OwnBit-v0", "--conf-file", "recipe.yml"]
COMMAND += ["--n-evaluations", "2", "--n-eval-envs", "1", "--n-startup-trials", "2"]  # without a seed, as documented


def start(*words: str) -> subprocess.Popen:
    Path("recipe.yml").write_text(yaml.safe_dump({"OwnBit-v0": RECIPE}))
    return subprocess.Popen([*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def states() -> list[TrialState]:
    """Of all trials of the search that is kept here."""
    try:
        (path,) = Path("logs/maddpg").glob("*_search_*.log")
        return [trial.state for trial in optuna.load_study(storage=open_storage(str(path)), study_name="search").trials]
    except (ValueError, KeyError):  # it has not begun
        return []


def kill_within_a_trial(process: subprocess.Popen, finished: int) -> None:
    """SIGKILL once so many trials are finished and another one runs."""
    end = time.monotonic() + 500
    while sum(state.is_finished() for state in states()) < finished or TrialState.RUNNING not in states():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.05)
    process.kill()
    process.communicate()


@pytest.mark.slow
def test_a_search_goes_on_after_kills(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--n-trials", "4"]
    for finished in (0, 2):
        kill_within_a_trial(start(*words), finished)
    process = start(*words)
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 0, output
    assert "The search continues after" in output
    (report,) = Path("logs/maddpg").glob("report*.csv")
    states = list(pd.read_csv(report)["state"])
    assert states.count("COMPLETE") + states.count("PRUNED") == 4
    assert states.count("FAIL") == 2, "those that were killed"
    assert set(states) == {"COMPLETE", "PRUNED", "FAIL"} or set(states) == {"COMPLETE", "FAIL"}
    assert not list(Path("logs/maddpg").glob("*_search_*")), "nothing is kept of what is done"
    assert Path("logs/maddpg/OwnBit-v0_best.yml").exists()


@pytest.mark.parametrize("function", ["symlink", "fsync", "rename", "unlink"])
def test_an_interrupt_leaves_a_whole_journal(function, tmp_path, monkeypatch):
    """Ctrl-C while Optuna takes its lock, writes an entry, and releases the lock."""
    path = tmp_path / "s.log"
    study = optuna.create_study(storage=open_storage(str(path)), study_name="s")
    before = getattr(os, function)

    def interrupted(*args):
        before(*args)
        monkeypatch.setattr(os, function, before)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(os, function, interrupted)
    with pytest.raises(KeyboardInterrupt):
        study.set_user_attr("note", 1)
    assert [one.name for one in tmp_path.iterdir()] == ["s.log"], "no lock is left"
    assert optuna.load_study(storage=open_storage(str(path)), study_name="s").user_attrs == {"note": 1}
    assert study.user_attrs == {"note": 1}


@pytest.mark.parametrize("function", ["_tell_with_warning", "_run_trial"])
def test_an_interrupt_within_optuna_is_kept_until_the_next_trial(function, tmp_path, monkeypatch, capsys):
    """Between two trials, and while one is finished: there, Optuna itself would raise another error."""
    monkeypatch.chdir(tmp_path)
    Path("recipe.yml").write_text(yaml.safe_dump({"OwnBit-v0": RECIPE}))
    before = getattr(optuna_loop, function)

    def interrupted(*args, **kwargs):
        monkeypatch.setattr(optuna_loop, function, before)
        signal.raise_signal(signal.SIGINT)
        return before(*args, **kwargs)

    monkeypatch.setattr(optuna_loop, function, interrupted)
    assert main([*COMMAND[3:], "--n-trials", "4"]) == 130
    assert "The search was interrupted; repeat the command to continue." in capsys.readouterr().out
    completed = 1 if function == "_tell_with_warning" else 0
    assert sorted(states()) == [TrialState.COMPLETE] * completed + [TrialState.FAIL]


@pytest.mark.slow
def test_an_interrupted_search_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    process = start("--n-trials", "50")
    end = time.monotonic() + 500
    while TrialState.COMPLETE not in states():
        assert time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 130, output
    assert "The search was interrupted; repeat the command to continue. Its trials are in logs/maddpg/OwnBit" in output
    assert output.endswith("Interrupted.\n")
    assert len(list(Path("logs/maddpg").glob("*_search_*.log"))) == 1
    assert Path("logs/maddpg/OwnBit-v0_best.yml").exists()


@pytest.mark.slow
@pytest.mark.parametrize("named", [True, False])
def test_a_search_interrupted_in_its_first_trial_says_how_to_continue(named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    process = start("--n-trials", "3", "--storage", "s.log", *(["--study-name", "s"] if named else []), "-n", "1000000")
    end = time.monotonic() + 500
    while not Path("s.log").exists() or b"process" not in Path("s.log").read_bytes():  # a trial has been signed
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 130, output
    assert "Traceback" not in output
    (name,) = optuna.get_all_study_names(open_storage("s.log"))
    how = "the command" if named else f"the command with --study-name {name}"
    assert f"The search was interrupted; repeat {how} to continue.\nInterrupted.\n" in output
    assert not Path("logs/maddpg/OwnBit-v0_best.yml").exists()
    (trial,) = optuna.load_study(storage=open_storage("s.log"), study_name=name).trials
    assert trial.state is TrialState.FAIL


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_workers_of_a_command_share_its_trials_whatever_dies(engine, tmp_path, monkeypatch):
    if engine == "ray":
        pytest.importorskip("ray")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAY_worker_niceness", "0")
    words = ["--n-trials", "6", "--storage", "s.log", "--study-name", "s", "--jobs", "2", "--engine", engine]

    def trials() -> list[optuna.trial.FrozenTrial]:
        try:
            return optuna.load_study(storage=open_storage("s.log"), study_name="s").trials
        except KeyError:
            return []

    process = start(*words)
    end = time.monotonic() + 500
    while sum("process" in trial.user_attrs for trial in trials()) < 3:
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.05)
    workers = [pid for pid in descendants(process.pid) if b"tune" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert len(workers) == 2
    if engine == "local":
        process.kill()
        process.communicate(timeout=500)
        process = start(*words)
    else:
        (parent,) = (pid for pid in descendants(process.pid) if workers[0] in children(pid))
        os.kill(parent, signal.SIGKILL)
    output, _ = process.communicate(timeout=500)
    assert process.returncode == 0, output
    assert "Recipe of the best trial: logs/maddpg/OwnBit-v0_best.yml" in output
    assert Path("logs/maddpg/OwnBit-v0_best.yml").exists()
    states = [trial.state for trial in trials()]
    assert TrialState.RUNNING not in states
    # A worker may start a trial while the other finishes the last one
    assert 6 <= states.count(TrialState.COMPLETE) + states.count(TrialState.PRUNED) <= 7
    assert states.count(TrialState.FAIL) <= 2


def test_several_workers_need_a_study_to_share(capsys, monkeypatch):
    assert main(["tune", "--env", "OwnBit-v0", "--jobs", "2"]) == 2
    assert "--jobs and --engine ray need --storage and --study-name" in capsys.readouterr().err
    called = []
    monkeypatch.setattr(study_module.Search, "run", lambda search: called.append(search))
    assert main(["tune", "--env", "OwnBit-v0", "--jobs", "1"]) == 0
    assert len(called) == 1, "one worker needs no one to share with"


def test_a_worker_that_a_cluster_restarts_elsewhere_repeats_its_trial(study, monkeypatch):
    monkeypatch.setenv("SB3_MADDPG_WORKER", "a")
    mine, others = begin(study, "else 1 2 a"), begin(study, "else 1 2 b")
    assert retry_lost_trials(study) == 1
    states = {trial.number: trial.state for trial in study.trials}
    assert states[mine.number] == TrialState.FAIL
    assert states[others.number] == TrialState.RUNNING
    signed = study.ask()
    mark_owner(signed)
    assert retry_lost_trials(study) == 0, "this process runs"


@pytest.fixture
def study(tmp_path) -> optuna.Study:
    return optuna.create_study(storage=open_storage(str(tmp_path / "s.log")), study_name="s")


def begin(study: optuna.Study, process: str | None) -> optuna.Trial:
    trial = study.ask()
    trial.suggest_float("x", 0, 1)
    if process is not None:
        trial.set_user_attr("process", process)
    return trial


def test_trials_of_processes_that_are_gone_come_back_with_their_parameters(study):
    host = socket.gethostname()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    killed = begin(study, f"{host} {gone.pid} 1")
    another_process_has_its_number = begin(study, f"{host} {os.getpid()} 1")
    elsewhere, older, odd = (begin(study, text) for text in (f"else {gone.pid} 1", None, "?"))
    mine = study.ask()
    mark_owner(mine)
    expected = 2 if Path("/proc/self/stat").exists() else 1
    assert retry_lost_trials(study) == expected
    states = {trial.number: trial.state for trial in study.trials}
    assert states[killed.number] == TrialState.FAIL
    assert (states[another_process_has_its_number.number] == TrialState.FAIL) == (expected == 2)
    assert {states[trial.number] for trial in (elsewhere, older, odd, mine)} == {TrialState.RUNNING}
    assert retry_lost_trials(study) == 0, "once is enough"
    again = study.ask()
    assert again.suggest_float("x", 0, 1) == killed.params["x"]


@pytest.mark.parametrize("alive", [False, True])
def test_a_trial_whose_process_was_killed_before_it_signed_comes_back(study, alive):
    """Only if no worker is left that may be about to sign it."""
    study.set_user_attr(f"worker {socket.gethostname()} {2**22 + 1} 1", True)
    if alive:
        register_worker(study)
    unsigned = study.ask()
    assert retry_lost_trials(study) == 1 - alive
    assert (study.trials[unsigned.number].state == TrialState.RUNNING) == alive


def test_a_lock_that_a_killed_process_left_is_released(tmp_path, monkeypatch):
    """Optuna looks for the age of what the lock points to, which it does not find by a relative path."""
    monkeypatch.chdir(tmp_path)
    optuna.create_study(storage=open_storage("s.log"), study_name="s")
    backend = open_storage("s.log")._backend
    backend._lock.acquire()
    assert Path("s.log.lock").exists(), "not a link to nothing"
    monkeypatch.setattr(backend._lock, "grace_period", 0.2)
    backend._lock.acquire()
    backend._lock.release()


@pytest.mark.parametrize("text", ["not json\n", "hello", '{"mine": 1}', "[]\n", '{"op_code":0,"worker_id":"x"}\n'])
@pytest.mark.parametrize("words", [[], ["--study-name", "s"]])
def test_a_file_that_is_no_journal_is_named_and_left_alone(text, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("notes.log").write_text(text)
    argv = ["tune", "--env", "OwnBit-v0", "-n", "100", "--n-trials", "1", "--storage", "notes.log"]
    assert main([*argv, *words]) == 1
    assert "notes.log is not a journal of Optuna" in capsys.readouterr().err
    assert Path("notes.log").read_text() == text


def test_the_command_for_the_best_recipe_can_be_pasted(capsys):
    tell_best("maddpg", "OwnBit-v0", Path("my logs/best.yml"))
    assert "--conf-file 'my logs/best.yml'" in capsys.readouterr().out


def test_the_same_settings_name_the_same_search(tmp_path):
    assert kept_search(tmp_path, "Env-v0", ({"a": 1}, 2)) == kept_search(tmp_path, "Env-v0", ({"a": 1}, 2))
    assert kept_search(tmp_path, "Env-v0", ({"a": 1}, 2)) != kept_search(tmp_path, "Env-v0", ({"a": 1}, 3))


def journal(path: Path) -> optuna.Study:
    study = optuna.create_study(storage=open_storage(str(path)), study_name="s", direction="maximize")
    for value in (1.0, 2.0):
        trial = study.ask()
        trial.suggest_float("tau", 0.001, 0.05)
        trial.report(value, 1)
        study.tell(trial, value)
    return study


@pytest.mark.parametrize("missing", [1, 2, 20, 60])
def test_the_unfinished_last_line_of_a_journal_is_dropped(tmp_path, missing):
    path = tmp_path / "t.log"
    journal(path)
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    path.write_bytes(whole[:-missing])
    again = optuna.load_study(storage=open_storage(str(path)), study_name="s")
    assert [trial.value for trial in again.trials] == [1.0, 2.0 if missing == 1 else None]
    assert path.read_bytes() == (whole if missing == 1 else b"".join(lines[:-1]))
    again.set_user_attr("a", 1)  # appends a line
    assert optuna.load_study(storage=open_storage(str(path)), study_name="s").user_attrs == {"a": 1}
    assert not list(tmp_path.glob("t.log.*"))


@pytest.mark.parametrize("rest", [b"\0" * 30, b"\n", b'{"op_code":5,"worker_id":"x"}\n'])
def test_a_damaged_last_line_of_a_journal_is_dropped(tmp_path, rest):
    """Zeros of a file system after a power loss, or an entry that Optuna appended to an unfinished one."""
    path = tmp_path / "t.log"
    journal(path)
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    path.write_bytes(whole[:-20] + rest)
    again = optuna.load_study(storage=open_storage(str(path)), study_name="s")
    assert [trial.value for trial in again.trials] == [1.0, None]
    assert path.read_bytes() == b"".join(lines[:-1])
    again.set_user_attr("a", 1)
    assert optuna.load_study(storage=open_storage(str(path)), study_name="s").user_attrs == {"a": 1}


def test_a_journal_that_is_damaged_elsewhere_stays_as_it_is(tmp_path):
    path = tmp_path / "t.log"
    journal(path)
    first, *lines = path.read_bytes().splitlines(keepends=True)
    for damaged in ([first, b"{\n", *lines], [first, *lines, b'{"op_code":77,"worker_id":"x"}\n']):
        path.write_bytes(b"".join(damaged))
        with pytest.raises(ValueError, match=r"t\.log is not a journal of Optuna"):
            optuna.load_study(storage=open_storage(str(path)), study_name="s")
        assert path.read_bytes() == b"".join(damaged)


def test_a_disk_that_is_full_from_the_start_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(JournalFileBackend, "append_logs", full)
    assert main(["tune", "--env", "OwnBit-v0", "-n", "100", "--n-trials", "1"]) == 1
    assert "No space left on device: free space, then repeat the command to continue." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"values":[2.0]', '"values":["two"]'),
        ('"values":[2.0]', '"values":2.0'),
        ('"values":[2.0]', '"values":[true]'),
        ('"intermediate_value":2.0', '"intermediate_value":"x"'),
        ('"step":1', '"step":"one"'),
        ('"param_value_internal":', '"param_value_internal":"x","was":'),
        ('"param_value_internal":', '"param_value_internal":9,"was":'),
    ],
)
def test_edited_types_in_a_journal_are_told_in_one_line(tmp_path, monkeypatch, capsys, old, new):
    monkeypatch.chdir(tmp_path)
    journal(Path("t.log"))
    text = Path("t.log").read_text()
    assert old in text
    Path("t.log").write_text(text.replace(old, new))
    for words in (["-optimize", "--n-trials", "1"], ["--trial-id", "1"]):
        assert main(["train", "--env", "OwnBit-v0", *words, "--storage", "t.log", "--study-name", "s"]) == 1
        (told,) = capsys.readouterr().err.strip().splitlines()
        assert told.startswith("error: --storage ")
        assert "t.log is damaged" in told or "t.log is not a journal" in told
        assert "name another" in told


@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({"callback": "os.system"}, "callback names 'os.system', which may run any code"),
        ({"env_wrapper": "lurking.Wrapper"}, "env_wrapper names 'lurking.Wrapper'"),
        ({"net_arch": "huge"}, "which are no parameters of maddpg"),
        ({"share_actor": "x"}, "which are no parameters of maddpg"),
    ],
)
def test_the_trial_of_someone_else_names_no_code(tmp_path, monkeypatch, capsys, params, told):
    monkeypatch.chdir(tmp_path)
    study = optuna.create_study(storage=open_storage("t.log"), study_name="s", direction="maximize")
    choices = {key: optuna.distributions.CategoricalDistribution([value]) for key, value in params.items()}
    study.add_trial(optuna.trial.create_trial(value=1.0, params=params, distributions=choices))
    argv = ["train", "--env", "OwnBit-v0", "--trial-id", "0", "--storage", "t.log", "--study-name", "s"]
    assert main(argv) == 1
    assert told in capsys.readouterr().err


@pytest.mark.slow
def test_a_full_disk_during_a_search_is_told_and_the_search_goes_on_later(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("recipe.yml").write_text(yaml.safe_dump({"OwnBit-v0": {**RECIPE, "n_timesteps": 60}}))
    words = ["train", *COMMAND[4:], "--n-trials", "2", "--verbose", "0"]
    append, trials = JournalFileBackend.append_logs, []

    def full(backend, logs):
        trials.extend(log for log in logs if "values" in log)
        if len(trials) == 2:
            with open(backend._file_path, "ab") as file:
                file.write(b'{"op_code":6,"wor')  # as far as there was space
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(backend, logs)

    with monkeypatch.context() as patched:
        patched.setattr(JournalFileBackend, "append_logs", full)
        assert main(words) == 1
    error = capsys.readouterr().err
    assert "No space left on device: free space, then repeat the command to continue" in error
    assert "Should not reach" not in error
    assert main(words) == 0
    assert "The search continues after 1 finished trials" in capsys.readouterr().out
