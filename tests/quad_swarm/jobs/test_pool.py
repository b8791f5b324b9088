"""Processes that die, end with their parent, and give results back."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from pathlib import Path

import pytest

from quad_swarm.jobs import Pool

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")


def square(x: int) -> int:
    return x * x


def slow(k: int) -> tuple[int, int, str]:
    time.sleep(0.02)
    return k, os.getpid(), "x" * 100_000


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_until(marker: str) -> str:
    """Dies as often as there are letters left to write."""
    path = Path(marker)
    lives = len(path.read_text()) if path.exists() else 0
    if lives < 2:
        path.write_text("x" * (lives + 1))
        die()
    return "alive"


def fail(text: str) -> None:
    raise KeyError(text)


class TwoArguments(Exception):
    """Can be pickled, but not read again."""

    def __init__(self, first, second):
        super().__init__(first)


def fail_oddly() -> None:
    raise TwoArguments(1, 2)


def lambda_result():
    return lambda: None


def workers() -> list[int]:
    """Ids of the pool's processes."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_text().rpartition(")")[2].split()[1])
            command = (status.parent / "cmdline").read_text()
        except OSError:
            continue
        if parent == os.getpid() and "spawn_main" in command:
            found.append(int(status.parent.name))
    return found


def test_results_come_in_the_order_of_the_pieces():
    with Pool(2) as pool:
        assert list(pool.map(square, range(20))) == [x * x for x in range(20)]
        assert pool.submit(square, x=3).result() == 9
    with pytest.raises(RuntimeError, match="closed"):
        pool.submit(square, 1)


def test_no_processes_without_pieces():
    with Pool(2):
        assert not workers()
    with pytest.raises(ValueError, match="jobs=0"):
        Pool(0)


def test_errors_are_the_callers():
    with Pool(1) as pool:
        with pytest.raises(KeyError, match="'a key'") as raised:
            pool.submit(fail, "a key").result()
        assert "in fail" in str(raised.value.__cause__), "where it was raised"
        with pytest.raises(RuntimeError, match="cannot be sent"):
            pool.submit(fail_oddly).result()
        with pytest.raises(RuntimeError, match="a result cannot be sent"):
            pool.submit(lambda_result).result()
        with pytest.raises(AttributeError, match=r"local object|Can't pickle|Can't get"):
            pool.submit(lambda: None).result()
        assert pool.submit(square, 2).result() == 4, "the process lives on"


@pytest.mark.slow
def test_a_process_that_dies_costs_its_piece_only(tmp_path):
    with Pool(2) as pool:
        others = [pool.submit(square, x) for x in range(8)]
        twice = pool.submit(die_until, str(tmp_path / "deaths"))
        always = pool.submit(die)
        assert [future.result() for future in others] == [x * x for x in range(8)]
        assert twice.result() == "alive"
        with pytest.raises(ValueError, match="3 processes died in the same piece"):
            always.result()
        assert pool.submit(square, 3).result() == 9


@pytest.mark.slow
@linux
def test_processes_may_be_killed_at_any_moment():
    rng, over = random.Random(0), threading.Event()
    kills = []

    def killer() -> None:
        while not over.wait(0.3 + 0.5 * rng.random()):
            # Not one that is still starting: on a busy machine, the same piece would be lost until the pool gives up
            done = {future.result()[1] for future in futures if future.done()}
            if ready := sorted(done & set(workers())):
                kills.append(rng.choice(ready))
                os.kill(kills[-1], signal.SIGKILL)

    with Pool(2) as pool:
        futures = [pool.submit(slow, k) for k in range(300)]
        thread = threading.Thread(target=killer)
        thread.start()
        try:
            results = [future.result(timeout=500)[0] for future in futures]
        finally:
            over.set()
            thread.join()
    assert results == list(range(300))
    assert len(kills) >= 3
    assert not workers()


@linux
def test_an_exception_stops_what_runs():
    futures = []

    def interrupted() -> None:
        with Pool(1) as pool:
            futures.extend(pool.submit(time.sleep, 600) for _ in range(2))
            while not workers():
                time.sleep(0.02)
            raise KeyError

    with pytest.raises(KeyError):
        interrupted()
    running, waiting = futures
    with pytest.raises(RuntimeError, match="stopped"):
        running.result(timeout=500)
    with pytest.raises(CancelledError):
        waiting.result(timeout=500)
    assert not workers()


@pytest.mark.slow
@linux
def test_ctrl_c_reaches_the_parent_alone():
    script = "import time\nfrom quad_swarm.jobs import Pool\nif __name__ == '__main__':\n"
    script += "    with Pool(2) as pool:\n        print(*pool.map(abs, [-1, -2]), flush=True)\n"
    script += "        list(pool.map(time.sleep, [600, 600]))\n"
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == "1 2\n"
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, errors = process.communicate(timeout=500)
    assert errors.count("KeyboardInterrupt") == 1, errors
    assert process.returncode != 0


@pytest.mark.parametrize("python", ["this", "3.10"])
def test_files_of_the_current_folder_do_not_run_in_the_processes(python, tmp_path):
    for name in ("pickle", "socket", "struct", "random"):
        (tmp_path / f"{name}.py").write_text("import os; os.mkdir('RAN'); raise ImportError('mine')")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "my_pieces.py").write_text("def piece(): return 'found'")
    code = f"""
import sys
sys.path[:] = [*filter(None, sys.path), "elsewhere"]
import types
import quad_swarm.jobs.pool as pool
import my_pieces
if {python!r} != "this":
    pool.sys = types.SimpleNamespace(version_info=(3, 10))
with pool.Pool(2) as workers:
    print([workers.submit(my_pieces.piece).result() for _ in range(2)])
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    environment.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "['found', 'found']", done.stderr
    assert not (tmp_path / "RAN").exists()
