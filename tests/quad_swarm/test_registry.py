"""Names from outside: by entry points of packages that are really there, as strangers would write them."""

import json
import os
import subprocess
import sys

import pytest

from quad_swarm.registry import Registry

# A package of a stranger, who does not edit this one
THEIRS = '''
import casadi as ca
import numpy as np

from quad_swarm.planner import OptimalControlProblem, RtiSolver
from quad_swarm.plants import Simulator


class Boat(OptimalControlProblem):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.nx, self.nu, self.max_input = 6, 2, ca.DM([1, 1])

    def derivative(self, x, u, wind):
        return ca.vertcat(x[3:5], 0, u - 0.4 * (x[3:5] - wind), 0)


def careful(problem):
    return RtiSolver(problem, sqp_iterations=4)


class Water:
    """Boats that the current carries along +y at 0.2 m/s."""

    def __init__(self, vehicle, drag, dt, n_swarms, n_robots):
        self.dt, self.current = dt, {"calm": 0.0, "river": 0.2}[vehicle]

    def place(self, swarm, state):
        pass

    def keep(self, swarms):
        pass

    def fork(self):
        return self

    def step(self, state, u, air, factors=None):
        state = state.copy()
        state[..., 3:5] += self.dt * (u[..., :2] - 0.4 * state[..., 3:5])
        state[..., :2] += self.dt * (state[..., 3:5] + [0, self.current])
        return state


LAKE = Simulator(Water, ("calm", "river"))
'''
OFFERS = """
[quad_swarm.problems]
boat = their_boats:Boat
[quad_swarm.solvers]
careful = their_boats:careful
[quad_swarm.plants]
lake = their_boats:LAKE
"""
WORLD = {"planner": {"problem": "boat"}, "plant": "lake:river"}


def put(folder, package: str, offers: str, code: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{package.replace('-', '_')}.py").write_text(code)
    info = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Name: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(offers)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install packages, as far as Python can tell."""
    imported = set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path / "site")
    yield lambda package, offers, code="": put(tmp_path / "site", package, offers, code)
    for name in set(sys.modules) - imported:
        if name.startswith(("their_", "other_")):
            del sys.modules[name]


def registry() -> Registry:
    return Registry("solver", "quad_swarm.solvers", {"rti": 1})


def test_what_a_package_offers_is_loaded_when_it_is_asked_for(installed):
    installed("their-boats", "[quad_swarm.solvers]\ncareful = their_boats:thing\n", "thing = 7")
    mine = registry()
    assert mine.find("rti") == 1
    assert "their_boats" not in sys.modules
    assert (mine.find("careful"), mine["careful"]) == (7, 7)


def test_what_the_registry_holds_comes_first(installed):
    installed("their-boats", "[quad_swarm.solvers]\nrti = their_boats:thing\n", "thing = 7")
    assert registry().find("rti") == 1


def test_unknown_names_are_told_with_what_packages_offer(installed):
    installed("their-boats", "[quad_swarm.solvers]\ncareful = their_boats:thing\n", "thing = 7")
    with pytest.raises(ValueError, match=r"Unknown solver 'carefull'; known: .*careful, rti. Did you mean 'careful'"):
        registry().find("carefull")
    with pytest.raises(ValueError, match=r"Unknown solver 3; known: auto, .*rti"):
        registry().find(3, ("auto",))
    assert "their_boats" not in sys.modules


@pytest.mark.parametrize(
    ("value", "code", "problem"),
    [
        ("their_boats:thing", "raise KeyError('sail')", "KeyError: 'sail'"),
        ("their_boats:thing", "import jsom", "ModuleNotFoundError: No module named 'jsom'"),
        ("their_boats:thing", "raise SystemExit(3)", "SystemExit: 3"),
        ("their_boats:thing", "", "AttributeError"),
        ("nowhere:thing", "", "ModuleNotFoundError"),
    ],
)
def test_a_broken_offer_is_told_with_its_package(value, code, problem, installed):
    installed("their-boats", f"[quad_swarm.solvers]\ncareful = {value}\n", code)
    with pytest.raises(
        ImportError, match=r"their-boats is installed, but its entry point quad_swarm.solvers: "
    ) as told:
        registry().find("careful")
    assert problem in str(told.value)
    assert "repair or uninstall their-boats" in str(told.value)


def test_two_packages_with_one_name_are_both_told(installed):
    for package in ("their-boats", "other-boats"):
        name = package.replace("-", "_")
        installed(package, f"[quad_swarm.solvers]\ncareful = {name}:thing\n", "thing = 7")
    with pytest.raises(ValueError, match=r"other-boats \(other_boats:thing\) and their-boats \(their_boats:thing\)"):
        registry().find("careful")


def run(code: str, folder, *words: str) -> str:
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, *(["-c", code] if code else []), *words],
        cwd=folder.parent,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


FLIGHT = """
import json
import gymnasium as gym
import numpy as np
import quad_swarm
world = json.loads(%r)
env = gym.make("QuadSwarm-v0", n_robots=2, solver="careful", world=world).unwrapped
starts = [[-2, 0, 1.5], [2, 1, 1.5]]
env.reset(seed=0, options={"starts": starts, "goals": starts[::-1]})
for _ in range(60):
    *_, info = env.step(np.ones(2, np.int8))
swarm = env.task.swarm
print(json.dumps([
    type(swarm.planner.solver.problem).__name__, swarm.planner.solver.sqp_iterations, swarm.state[0].tolist(),
    swarm.goal[0].tolist(), info["planner"]["status"].tolist(), bool(info["collision"]),
]))
"""


@pytest.mark.slow
def test_vehicle_solver_and_plant_of_a_package_fly_together(tmp_path):
    """The plant runs in a process of its own, which imports the package, too."""
    put(tmp_path / "site", "their-boats", OFFERS, THEIRS)
    name, iterations, state, goal, status, collision = json.loads(run(FLIGHT % json.dumps(WORLD), tmp_path / "site"))
    assert (name, iterations, status, collision) == ("Boat", 4, [0, 0], False)
    for robot, at in zip(state, goal, strict=True):
        beside = [a - b for a, b in zip(robot[:3], at, strict=True)]
        assert abs(beside[0]) < 0.1
        assert 0.02 < beside[1] < 0.6, "the current, which the planner does not know"
        assert beside[2] == 0


@pytest.mark.slow
@pytest.mark.parametrize("way", ["entry points", "--gym-packages"])
def test_the_commands_fly_with_them_in_several_processes(way, tmp_path):
    site, out = tmp_path / "site", tmp_path / "rows.json"
    register = """
from quad_swarm.planner import PROBLEMS, SOLVERS
from quad_swarm.plants import SIMULATORS
PROBLEMS["boat"], SOLVERS["careful"], SIMULATORS["lake"] = Boat, careful, LAKE
"""
    put(site, "their-boats", OFFERS if way == "entry points" else "", THEIRS + register * (way != "entry points"))
    words = ["-m", "sb3_maddpg", "evaluate", "--policy", "full", "none", "--scenario", "random", "--episodes", "4"]
    words += ["--solver", "careful", "--jobs", "2", "--json", str(out), "--n-robots", "2"]
    words += ["--world", "planner.problem=boat", "plant=lake:calm", "max_steps=40"]
    run("", site, *words, *(["--gym-packages", "their_boats"] if way != "entry points" else []))
    assert out.exists()
