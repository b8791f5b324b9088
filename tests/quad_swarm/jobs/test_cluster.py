"""Ray as an executor: the same results, whatever dies."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from quad_swarm.evaluation.evaluation import fly_all
from quad_swarm.evaluation.flight import Condition
from quad_swarm.jobs import Cluster, Pool, cluster, make_executor
from quad_swarm.world.presets import make_config

ray = pytest.importorskip("ray")
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::ResourceWarning")


@pytest.fixture(scope="module", autouse=True)
def on_this_machine():
    """One cluster for all tests but those that begin their own."""
    with pytest.MonkeyPatch.context() as patch:
        # Processes of the cluster find the tests' functions
        patch.setenv(
            "PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep if os.environ.get("PYTHONPATH") else None
        )
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)
        yield
        ray.shutdown()


def square(x: int) -> int:
    return x * x


def fail(text: str) -> None:
    raise KeyError(text)


class TwoArguments(Exception):
    """Can be pickled, but not read again."""

    def __init__(self, first, second):
        super().__init__(first)


def fail_oddly() -> None:
    raise TwoArguments(1, 2)


def die_once(marker: str) -> str:
    path = Path(marker)
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def process_of(folder: str, k: int) -> int:
    """Takes a while, and tells where it is."""
    Path(folder, str(os.getpid())).touch()
    time.sleep(0.2)
    return k


def untimed(flown):
    return {key: [{**row, "solve_seconds": 0.0} for row in rows] for key, rows in flown.items()}


@pytest.mark.slow
def test_functions_of_scripts_are_worked_off_too():
    names: dict = {"__name__": "__main__"}
    exec("def shifted(x):\n    return x + offset\n\noffset = 3", names)  # as in a script
    with Cluster(2) as executor:
        assert list(executor.map(names["shifted"], range(3))) == [3, 4, 5]


@pytest.mark.slow
def test_flights_are_those_of_this_process():
    conditions = [Condition(policy, "symmetric_swap", make_config("flight", n_robots=3)) for policy in ("none", "full")]
    with Cluster(2) as executor:
        there = fly_all(conditions, 300, executor=executor)
    assert untimed(there) == untimed(fly_all(conditions, 300))


@pytest.mark.slow
def test_errors_are_the_callers():
    with Cluster(2) as executor:
        assert list(executor.map(square, range(5))) == [0, 1, 4, 9, 16]
        with pytest.raises(KeyError, match="'a key'") as raised:
            executor.submit(fail, "a key").result(timeout=500)
        assert "in fail" in str(raised.value.__cause__)
        with pytest.raises(RuntimeError, match="TwoArguments"):
            executor.submit(fail_oddly).result(timeout=500)


@pytest.mark.slow
def test_a_piece_whose_process_dies_is_begun_again(tmp_path):
    with Cluster(2) as executor:
        assert executor.submit(die_once, str(tmp_path / "died")).result(timeout=500) == "alive"
        assert (tmp_path / "died").exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_processes_may_be_killed_at_random(tmp_path):
    over = threading.Event()
    killed = set()

    def killer() -> None:
        while not over.wait(2.0):
            for path in set(tmp_path.iterdir()) - killed:
                killed.add(path)
                try:
                    os.kill(int(path.name), signal.SIGKILL)
                except ProcessLookupError:
                    continue
                break

    thread = threading.Thread(target=killer)
    with Cluster(2) as executor:
        futures = [executor.submit(process_of, str(tmp_path), k) for k in range(60)]
        thread.start()
        try:
            assert [future.result(timeout=500) for future in futures] == list(range(60))
        finally:
            over.set()
            thread.join()
    assert len(killed) >= 2


@pytest.mark.slow
def test_machines_of_another_kind_are_refused_unless_asked_for(monkeypatch):
    monkeypatch.setattr(cluster, "machine", lambda: "a processor of its own")
    with (
        Cluster(2) as executor,
        pytest.raises(ValueError, match=r"machine that differs from this one.*a processor of its own"),
    ):
        executor.submit(square, 2).result(timeout=500)
    with Cluster(2, mixed=True) as executor:
        assert executor.submit(square, 2).result(timeout=500) == 4


def test_results_of_other_code_are_refused_in_any_case(monkeypatch):
    monkeypatch.setattr(cluster, "_code", lambda modules: {"quad_swarm": "digest of sources with one line changed"})
    for mixed in (False, True):
        with (
            Cluster(2, mixed=mixed) as executor,
            pytest.raises(ValueError, match="computed with another content of quad_swarm than this command"),
        ):
            executor.submit(square, 2).result(timeout=500)


@pytest.mark.slow
def test_a_module_or_model_that_is_another_there_is_noticed(tmp_path, monkeypatch):
    """The processes of the cluster import other modules of the same name, and read another file."""
    for folder, text in (("here", "A = 1"), ("there", "A = 2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "module_of_a_user.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path / "here")
    executor = Cluster(2, ["module_of_a_user"])
    with_path = ray.remote(cluster._run).options(runtime_env={"env_vars": {"PYTHONPATH": str(tmp_path / "there")}})
    executor._run = with_path
    with executor, pytest.raises(ValueError, match="another content of module_of_a_user"):
        executor.submit(len, ()).result(timeout=500)


def test_an_exception_stops_what_runs():
    futures = []

    def interrupted() -> None:
        with Cluster(2) as executor:
            futures.extend(executor.submit(time.sleep, 600) for _ in range(3))
            raise KeyError

    with pytest.raises(KeyError):
        interrupted()
    for future in futures:
        with pytest.raises(RuntimeError, match="stopped"):
            future.result(timeout=500)


def test_engines_by_name(monkeypatch):
    with make_executor("local", 1) as executor:
        assert isinstance(executor, Pool)
    with make_executor("ray", 2) as executor:
        assert isinstance(executor, Cluster)
    with pytest.raises(ValueError, match=r"Did you mean 'ray'\?"):
        make_executor("rai", 1)
    with pytest.raises(ValueError, match="address='auto' is for engine='ray'"):
        make_executor("local", 1, address="auto")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r'Ray is not installed .*pip install -e "\.\[ray\]"'):
        make_executor("ray", 1)


@pytest.mark.slow
def test_a_machine_may_be_lost(tmp_path):
    from ray.cluster_utils import Cluster as Machines

    ray.shutdown()
    machines = Machines(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 100 * 2**20})
    second = machines.add_node(num_cpus=1, object_store_memory=100 * 2**20)
    machines.wait_for_nodes()
    try:
        with Cluster(2, address=machines.address) as executor:
            futures = [executor.submit(process_of, str(tmp_path), k) for k in range(40)]
            while len(list(tmp_path.iterdir())) < 2:
                time.sleep(0.05)
            machines.remove_node(second)
            assert [future.result(timeout=500) for future in futures] == list(range(40))
    finally:
        ray.shutdown()
        machines.shutdown()
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="ends Ray by signal")
def test_a_cluster_by_its_port_gets_the_users_token(tmp_path):
    """Ray asks for a token as soon as the user has one, but sends it only to clusters that it finds by itself."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("12345678-1234-1234-1234-123456789abc")
    env = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    env |= {"HOME": str(tmp_path), "OMP_NUM_THREADS": "1"}
    start = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", f"--port={port}", "--num-cpus=1"]
    folder = tempfile.mkdtemp(dir="/tmp")  # sockets need short paths
    start += ["--include-dashboard=false", f"--temp-dir={folder}", "--object-store-memory=100000000", "--block"]
    script = f"from quad_swarm.jobs import Cluster\nwith Cluster(1, address='127.0.0.1:{port}') as executor:\n"
    script += "    print('there:', executor.submit(pow, 3, 2).result(timeout=500))"
    head = subprocess.Popen(start, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert any("Ray runtime started" in line for line in head.stdout)
        done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=500)
        assert "there: 9" in done.stdout, done.stderr
    finally:
        head.terminate()
        head.communicate(timeout=500)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_without_an_address_a_cluster_starts_here(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # of another cluster, as in any job of Ray
    ray.shutdown()
    try:
        with Cluster(1) as executor:
            assert executor.submit(square, 3).result(timeout=500) == 9
    finally:
        monkeypatch.undo()
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)


@pytest.mark.slow
def test_an_address_where_nobody_answers(monkeypatch):
    # "auto" must not find the clusters of tests that run at the same time
    monkeypatch.setattr("ray._private.services._find_address_from_flag", lambda flag: set())
    ray.shutdown()
    try:
        for address in ("auto", "127.0.0.1:1", "127.0.0.1:99999"):
            with pytest.raises(ValueError, match=f"address='{address}': no Ray cluster responds there"):
                Cluster(1, address=address)
    finally:
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)
