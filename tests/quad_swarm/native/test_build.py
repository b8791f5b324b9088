"""The kernels as pieces of software: compilers, cache, processes, sanitizers, and the same bits from every build."""

import multiprocessing
import os
import pickle
import shutil
import stat
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from planning import QUADROTOR, assert_same

from quad_swarm import planner
from quad_swarm.native import build as build_module
from quad_swarm.planner import (
    BuildError,
    FatropSolver,
    OptimalControlProblem,
    PlannerConfig,
    Problems,
    RtiSolver,
    make_planner,
)
from quad_swarm.planner.rti.codegen import generate_model
from quad_swarm.planner.rti.solver import build_kernel

CONFIG = PlannerConfig(horizon=3)
SOURCES = Path(planner.__file__).parent / "rti"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("QUAD_SWARM_CACHE", str(tmp_path / "cache"))
    planner._warn_once.cache_clear()
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> Path:
    """A cache with the library of `solve` in both precisions, for tests that are not about compiling it."""
    folder = tmp_path_factory.mktemp("compiled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("QUAD_SWARM_CACHE", str(folder))
        for precision in ("float32", "float64"):
            build_kernel(generate_model(OptimalControlProblem(CONFIG, QUADROTOR, 2)), precision)
    return folder


@pytest.fixture
def filled(cache, compiled) -> Path:
    return shutil.copytree(compiled, cache)


def libraries(cache: Path) -> list[str]:
    """The names in the cache but those of the checksums: one for each library."""
    return sorted(name for name in os.listdir(cache) if not name.endswith(".sha256"))


def solve(precision: str = "float32", solver: RtiSolver | None = None):
    rng = np.random.default_rng(0)
    problems = Problems(rng.normal(size=(21, 9)) * 0.3, rng.normal(size=(21, 3)), rng.normal(size=(21, 2, 3, 3)))
    solver = solver or RtiSolver(OptimalControlProblem(CONFIG, QUADROTOR, 2), precision=precision)
    return solver.solve(problems, np.zeros((21, 4, 9)), np.zeros((21, 3, 4)))


def test_compiles_once_for_each_problem(cache):
    first = solve()
    (library,) = libraries(cache)
    modified = (cache / library).stat().st_mtime_ns
    build_module.load.cache_clear()
    assert_same(solve(), first)
    assert (cache / library).stat().st_mtime_ns == modified
    solve("float64")
    assert len(libraries(cache)) == 2  # and no temporary folders


def test_every_number_of_the_problem_is_in_the_key(cache, stub_compiler):
    for config in (CONFIG, PlannerConfig(horizon=3, goal_weight=9.0)):
        model = generate_model(OptimalControlProblem(config, QUADROTOR, 1))
        assert build_kernel(model, "float32").is_file()
    assert len(libraries(cache)) == 2


def test_the_cache_is_where_the_user_wants_it(monkeypatch, tmp_path):
    monkeypatch.delenv("QUAD_SWARM_CACHE")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert build_module.cache_directory() == tmp_path / "quad_swarm"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert build_module.cache_directory() == Path.home() / ".cache" / "quad_swarm"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert build_module.cache_directory() == tmp_path / "local" / "quad_swarm"


def test_processes_may_build_at_once(cache):
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        results = pool.map(solve, ["float32"] * 3, chunksize=1)
    for result in results:
        assert_same(result, solve())
    assert len(libraries(cache)) == 1


def test_travels_to_another_process(filled):
    solver = RtiSolver(OptimalControlProblem(CONFIG, QUADROTOR, 2), sqp_iterations=3)
    expected = solve(solver=solver)
    assert_same(solve(solver=pickle.loads(pickle.dumps(solver))), expected)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert_same(pool.apply(solve, ("float32", solver)), expected)


FORK = f"""
import os, sys
sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[2] / "helpers")]}
from test_build import CONFIG, OptimalControlProblem, QUADROTOR, RtiSolver, assert_same, solve
solver = RtiSolver(OptimalControlProblem(CONFIG, QUADROTOR, 2), sqp_iterations=3)
expected = solve(solver=solver)
child = os.fork()
if child == 0:
    assert_same(solve(solver=solver), expected)
    os._exit(42)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_fork_solves_the_same(filled):
    # In a process of its own: a fork of this one could wait for locks of threads that other tests have left.
    assert subprocess.run([sys.executable, "-c", FORK], timeout=120).returncode == 42


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_every_build_gives_the_same_bits(precision, filled, monkeypatch):
    expected = solve(precision)
    compiler = " ".join(build_module.compiler())
    for option in ("-DLANES_VECTOR_BYTES=16", "-DLANES_VECTOR_BYTES=32", "-fno-inline -fno-tree-vectorize"):
        monkeypatch.setenv("CXX", f"{compiler} {option}")
        assert_same(solve(precision), expected)


def break_compiler(kind: str, folder: Path, monkeypatch) -> str:
    """Make it impossible to compile; returns what the message must name."""
    if kind == "absent":
        monkeypatch.delenv("CXX", raising=False)
        monkeypatch.setenv("PATH", str(folder))
        return "no C\\+\\+ compiler: install"
    if kind == "misnamed":
        monkeypatch.setenv("CXX", "no-such-compiler")
        return "CXX='no-such-compiler' is not a command"
    if kind == "cache":
        (folder / "file").touch()
        monkeypatch.setenv("QUAD_SWARM_CACHE", str(folder / "file"))
        return "cannot write to the cache .*QUAD_SWARM_CACHE"
    script = folder / "broken"
    script.write_text("#!/bin/sh\necho 'broken.cpp:1: error: out of order' >&2\nexit 3\n")
    script.chmod(0o755)
    monkeypatch.setenv("CXX", str(script))
    return "fails .*out of order"


@pytest.mark.parametrize("kind", ["absent", "misnamed", "failing", "cache"])
def test_without_a_compiler(kind, tmp_path, monkeypatch):
    message = break_compiler(kind, tmp_path, monkeypatch)
    with pytest.raises(BuildError, match=f"solver='rti' cannot run: .*{message}.*solver='fatrop' needs no compiler"):
        make_planner(CONFIG, QUADROTOR, 2, "rti")
    with pytest.warns(RuntimeWarning, match=message) as notices:
        assert isinstance(make_planner(CONFIG, QUADROTOR, 2).solver, FatropSolver)
    assert len(notices) == 1
    assert "\n" not in str(notices[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once is enough
        assert make_planner(CONFIG, QUADROTOR, 2).solver.name == "fatrop"


def test_with_a_compiler_the_fast_solver_is_the_default(filled):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert make_planner(CONFIG, QUADROTOR, 3).solver.name == "rti"


def flip_a_bit(library: Path) -> None:
    content = bytearray(library.read_bytes())
    content[len(content) // 2] ^= 1
    library.unlink()  # never write into a file that a process has loaded
    library.write_bytes(content)


@pytest.fixture
def stub_compiler(monkeypatch) -> None:
    """Writes something for a library, at once."""

    def run(command: list[str]) -> str:
        if "-o" in command:
            Path(command[-1]).write_bytes(b"library" * 99)
        return ""

    monkeypatch.setattr(build_module, "_run", run)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: (path.unlink(), path.write_bytes(b"no library")),
        flip_a_bit,
        lambda path: build_module._checksum_file(path).unlink(),
    ],
    ids=["no library", "a bit", "no checksum"],
)
def test_a_damaged_library_is_compiled_again(damage, stub_compiler):
    library = build_kernel("model", "float32")
    content = library.read_bytes()
    damage(library)
    assert build_kernel("model", "float32") == library
    assert library.read_bytes() == content
    assert build_module._is_whole(library)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_library_of_another_user_is_not_loaded(stub_compiler, monkeypatch):
    library = build_kernel("model", "float32")
    assert stat.S_IMODE(library.parent.stat().st_mode) & 0o022 == 0
    owner = library.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    assert build_module._is_whole(library) == (owner == 0), "of the system's user, or of nobody that is known"


@pytest.mark.parametrize("kind", ["absent", "misnamed", "failing"])
def test_without_a_compiler_the_cache_will_do(kind, filled, tmp_path, monkeypatch):
    expected = solve()
    break_compiler(kind, tmp_path, monkeypatch)
    build_module.load.cache_clear()
    assert_same(solve(), expected)
    for library in build_module.cache_directory().glob("*.so"):
        flip_a_bit(library)
    with pytest.raises(BuildError, match=r"C\+\+ compiler"):
        solve()


def test_a_library_of_another_machine_is_not_used(tmp_path, monkeypatch, stub_compiler):
    library = build_kernel("model", "float32")
    break_compiler("absent", tmp_path, monkeypatch)
    assert build_kernel("model", "float32") == library
    monkeypatch.setattr(build_module, "_machine", lambda: "a processor without vectors")
    with pytest.raises(BuildError, match="no C\\+\\+ compiler"):
        build_kernel("model", "float32")


@pytest.mark.parametrize("value", [" ", "'x"])
def test_nonsense_in_cxx_is_named(value, monkeypatch):
    monkeypatch.setenv("CXX", value)
    with pytest.raises(BuildError, match=f"CXX={value!r} is not a command"):
        build_module.compiler()


def test_folders_of_killed_builds_are_removed(cache, stub_compiler):
    old, young = cache / "building-old", cache / "building-young"
    for folder in (old, young):
        folder.mkdir(parents=True)
    os.utime(old, (0, 0))
    build_kernel("model", "float32")
    assert not old.exists()
    assert young.exists(), "another process may be at work in it"


def run_harness(folder: Path, main: str, *flags: str) -> str:
    """Compile a program around the sources and run it."""
    model = generate_model(OptimalControlProblem(CONFIG, QUADROTOR, 2))
    (folder / "model.hpp").write_text(model)
    (folder / "main.cpp").write_text(main)
    command = [*build_module.compiler(), *build_module._FLAGS, build_module._native_flag(), "-DREAL=float", *flags]
    command += [f"-I{folder}", f"-I{SOURCES}", str(folder / "main.cpp"), "-o", str(folder / "main")]
    subprocess.run(command, check=True, capture_output=True, text=True)
    done = subprocess.run([str(folder / "main")], check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


SANITIZED = r"""
#include "kernel.cpp"
#include <cstdio>
#include <limits>
#include <random>

int main() {
  std::mt19937 random(0);
  std::normal_distribution<double> normal;
  const double bad[] = {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(), 1e30};
  long solved = 0;
  for (int count : {0, 1, 2, 3, 5, 8, 9, 16, 17, 33, 50}) {
    std::vector<double> x(count * 9), goal(count * 3), others(count * N_OTHERS * N * 3), guess(count * N * 4);
    std::vector<double> clearance(count * N_OTHERS * N);
    for (auto* array : {&x, &goal, &others, &guess, &clearance})
      for (double& value : *array) value = normal(random);
    for (int k = 0; k < count; k += 4) x[k * 9] = bad[k / 4 % 3];
    std::vector<double> x_plan(count * (N + 1) * 9), u_plan(count * N * 4);
    std::vector<std::uint8_t> success(count);
    std::vector<std::int64_t> iterations(count);
    quad_swarm_rti(count, x.data(), goal.data(), others.data(), count % 2 ? clearance.data() : nullptr, guess.data(),
                   x_plan.data(), u_plan.data(), success.data(), iterations.data(), 2, 6, 50, 1e-4);
    for (auto s : success) solved += s;
  }
  std::printf("%ld", solved);
}
"""


def test_sanitizers_find_nothing(tmp_path):
    solved = run_harness(tmp_path, SANITIZED, "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert int(solved) > 70  # of 144 problems a quarter are absurd


FUNCTIONS = r"""
#include "lanes.hpp"
#include <cstdio>

template <class T, class F, class G>
double error(F mine, G exact, double limit) {
  using V = typename LaneTypes<T, VECTOR_BYTES / sizeof(T)>::Real;
  double worst = 0;
  for (int k = -100000; k <= 100000; k++) {
    const T a = static_cast<T>(limit * k / 100000);
    const double expected = exact(static_cast<double>(a));
    const double difference = std::abs(mine(splat<V>(a))[0] - expected);
    if (expected != 0) worst = std::max(worst, difference / std::abs(expected));
  }
  return worst;
}

int main() {
  const auto tan_ = [](auto a) { return tangent(a); };
  const auto cos_ = [](auto a) { return cosine(a); };
  const auto exp_ = [](auto a) { return exponential(a); };
  const auto tan_exact = [](double a) { return std::tan(a); };
  const auto cos_exact = [](double a) { return std::cos(a); };
  const auto exp_exact = [](double a) { return std::exp(a); };
  std::printf("%g %g %g %g ", error<double>(tan_, tan_exact, 0.6), error<double>(tan_, tan_exact, 1.0),
              error<float>(tan_, tan_exact, 1.0), error<double>(cos_, cos_exact, 1.0));
  std::printf("%g %g %g", error<float>(cos_, cos_exact, 1.0), error<double>(exp_, exp_exact, 40),
              error<float>(exp_, exp_exact, 40));
}
"""


def test_functions_of_lanes_are_accurate(tmp_path):
    errors = [float(text) for text in run_harness(tmp_path, FUNCTIONS).split()]
    limits = [3e-12, 2e-9, 5e-7, 1e-12, 3e-7, 1e-15, 3e-7]
    assert all(error <= limit for error, limit in zip(errors, limits, strict=True)), errors
