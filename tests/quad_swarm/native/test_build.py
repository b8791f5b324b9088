"""The kernels as pieces of software: compilers, cache, processes, sanitizers, and the same bits from every build."""

import ctypes
import hashlib
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
from quad_swarm.jobs.journal import default_folder
from quad_swarm.native import build as build_module
from quad_swarm.native import pairs
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_processes_may_build_at_once(cache):
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        results = pool.map(solve, ["float32"] * 3, chunksize=1)
    for result in results:
        assert_same(result, solve())
    assert len(libraries(cache)) == 1


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_fork_solves_the_same(filled):
    # In a process of its own: a fork of this one could wait for locks of threads that other tests have left.
    assert subprocess.run([sys.executable, "-c", FORK], timeout=500).returncode == 42


@pytest.mark.slow
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

    def run(command: list[str], temporary: str | None = None) -> str:
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


def run_harness(folder: Path, main: str, *flags: str, config: PlannerConfig = CONFIG, shaped: bool = False) -> str:
    """Compile a program around the sources and run it.

    :param config: the planner
    :param shaped: whether bodies have shapes and sizes
    """
    model = generate_model(OptimalControlProblem(config, QUADROTOR, 2, shaped))
    (folder / "model.hpp").write_text(model)
    (folder / "main.cpp").write_text(main)
    command = [*build_module.compiler(), *build_module._FLAGS, build_module._native_flag(), "-DREAL=float", *flags]
    command += [f"-I{folder}", f"-I{SOURCES}", str(folder / "main.cpp"), "-o", str(folder / "main")]
    subprocess.run(command, check=True, capture_output=True, text=True)
    done = subprocess.run([str(folder / "main")], check=False, capture_output=True, text=True, timeout=500)
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
    std::vector<double> clearance(count * N_OTHERS * N), shape(count * N_OTHERS * 3), size(count * N_OTHERS);
    std::vector<double> reference(count * N * 3), weight(count * N, 2.0), push(count * 3), steady(count * 4);
    for (auto* array : {&x, &goal, &others, &guess, &clearance, &shape, &size, &reference, &push, &steady})
      for (double& value : *array) value = normal(random);
    for (int k = 0; k < count; k += 4) x[k * 9] = bad[k / 4 % 3];
    std::vector<double> x_plan(count * (N + 1) * 9), u_plan(count * N * 4);
    std::vector<std::uint8_t> success(count);
    std::vector<std::int64_t> iterations(count);
    const auto some = [count](const std::vector<double>& array) { return count % 2 ? array.data() : nullptr; };
    quad_swarm_rti(count, x.data(), goal.data(), others.data(), some(clearance), some(shape), some(size),
                   some(reference), some(weight), some(push), some(steady), guess.data(), x_plan.data(), u_plan.data(),
                   success.data(), iterations.data(), 2, 6, 50, 1e-4);
    for (auto s : success) solved += s;
  }
  std::printf("%ld", solved);
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("everything", [False, True])
def test_sanitizers_find_nothing(everything, tmp_path):
    flags = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    config = PlannerConfig(commitment=1.0, disturbance_time=1.0) if everything else CONFIG
    solved = run_harness(tmp_path, SANITIZED, *flags, config=config, shaped=everything)
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


def test_no_home_is_told_with_the_remedy(monkeypatch, tmp_path):
    for name in ("QUAD_SWARM_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as for a user without an entry and without HOME
    message = r"there is no cache ~/\.cache/quad_swarm .*; set QUAD_SWARM_CACHE to a writable directory"
    with pytest.raises(BuildError, match=message):
        build_module.cache_directory()
    with pytest.warns(RuntimeWarning, match=message):
        assert isinstance(make_planner(CONFIG, QUADROTOR, 5).solver, FatropSolver)
    with pytest.warns(RuntimeWarning, match=f"Finished pieces are not kept: {message}"):
        assert default_folder() is None
    pairs.compiled.cache_clear()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert make_planner(CONFIG, QUADROTOR, 5, "fatrop").solver.name == "fatrop"
            assert pairs.compiled() is None
    finally:
        pairs.compiled.cache_clear()


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("QUAD_SWARM_CACHE", ".", "."),
        ("QUAD_SWARM_CACHE", "here", "here"),
        ("QUAD_SWARM_CACHE", "~/there", "home/there"),
        ("XDG_CACHE_HOME", "~", "home/quad_swarm"),
        ("XDG_CACHE_HOME", ".", "quad_swarm"),
    ],
)
def test_the_cache_s_path_is_absolute(name, value, expected, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("QUAD_SWARM_CACHE")
    monkeypatch.setenv(name, value)
    assert build_module.cache_directory() == tmp_path / expected


@pytest.mark.slow
def test_a_cache_in_the_current_folder_works(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("QUAD_SWARM_CACHE", ".")
    assert_same(solve(), solve())
    assert len(list(tmp_path.glob("rti-*.so"))) == 1


def test_a_compiler_of_c_is_named_as_the_cause(cache, tmp_path, monkeypatch):
    library = cache / "rti-x.so"
    cache.mkdir(parents=True, exist_ok=True)
    (tmp_path / "x.cpp").write_text("int of_no_library();\nint f() { return of_no_library(); }\n")
    command = [*build_module.compiler(), "-shared", "-fPIC", "-nodefaultlibs", str(tmp_path / "x.cpp")]
    subprocess.run([*command, "-o", str(library)], check=True)
    library.chmod(0o755)
    build_module._checksum_file(library).write_text(hashlib.sha256(library.read_bytes()).hexdigest())
    build_module._checksum_file(library).chmod(0o644)
    with pytest.raises(BuildError, match=r"cannot load .*rti-x.so \(undefined symbol.*such as g\+\+ instead of gcc"):
        build_module.load(str(library))


@pytest.mark.slow
def test_temporary_files_of_the_compiler_are_in_the_cache(cache, monkeypatch, tmp_path):
    seen = []
    run = subprocess.run
    monkeypatch.setattr(
        subprocess, "run", lambda command, **kwargs: (seen.append((command, kwargs["env"])), run(command, **kwargs))[1]
    )
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    build_kernel(generate_model(OptimalControlProblem(CONFIG, QUADROTOR, 1)), "float32")
    ((_, environment),) = [one for one in seen if "-o" in one[0]]
    assert Path(environment["TMPDIR"]).parent == cache


posix = pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")


@posix
@pytest.mark.parametrize("which", ["library", "checksum"])
@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_what_others_may_write_is_compiled_again(which, mode, stub_compiler):
    library = build_kernel("model", "float32")
    path = library if which == "library" else build_module._checksum_file(library)
    path.chmod(mode)
    assert not build_module._is_whole(library)
    with pytest.raises(BuildError, match="another user owns it or may write into it"):
        build_module.load(str(library))
    assert build_kernel("model", "float32") == library
    assert build_module._is_whole(library)


@posix
def test_a_library_that_cannot_be_replaced_is_not_loaded(stub_compiler, monkeypatch):
    """As where another user's file is in a folder in which only owners replace theirs."""
    library = build_kernel("model", "float32")
    library.chmod(0o777)
    put = build_module._put

    def refused(content: bytes, path: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(build_module, "_put", refused)
    with pytest.raises(BuildError, match=r"cannot replace .*belongs to another user; set QUAD_SWARM_CACHE"):
        build_kernel("model", "float32")
    monkeypatch.setattr(build_module, "_put", put)
    assert build_kernel("model", "float32") == library


@posix
def test_in_a_folder_that_others_may_write_nothing_is_compiled(cache, monkeypatch):
    places = []
    monkeypatch.setattr(
        build_module, "_run", lambda command, temporary=None: places.append(temporary) or write(command)
    )

    def write(command: list[str]) -> str:
        if "-o" in command:
            Path(command[-1]).write_bytes(b"library")
        return ""

    cache.mkdir(parents=True, exist_ok=True)
    cache.chmod(0o777)
    library = build_kernel("model", "float32")
    assert build_module._is_whole(library)
    assert library.parent == cache
    assert Path(places[-1]).parent != cache


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="a library is loaded by its path here")
def test_what_is_loaded_is_what_was_checked(cache, tmp_path, monkeypatch):
    """Although someone exchanges the file between the two."""

    def compiled(answer: int) -> Path:
        source, library = tmp_path / f"{answer}.cpp", tmp_path / f"{answer}.so"
        source.write_text(f'extern "C" int answer() {{ return {answer}; }}')
        subprocess.run([*build_module.compiler(), "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
        library.chmod(0o755)
        return library

    mine, foreign = compiled(1), compiled(2)
    build_module._checksum_file(mine).write_text(hashlib.sha256(mine.read_bytes()).hexdigest())
    build_module._checksum_file(mine).chmod(0o644)
    check = build_module._check

    def exchanged(descriptor: int, library: Path) -> None:
        check(descriptor, library)
        os.replace(foreign, mine)

    monkeypatch.setattr(build_module, "_check", exchanged)
    function = build_module.load(str(mine), "answer").answer
    function.restype = ctypes.c_int
    assert function() == 1
