"""The rooms of the house, as CONTRIBUTING.md describes them: who imports whom, and where a module's test lies.

Imports are read from the source, those inside functions included.
"""

import ast
import importlib
import inspect
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = {"sb3_maddpg": ROOT / "sb3_maddpg", "quad_swarm": ROOT / "envs" / "quad_swarm"}

# The rooms of sb3_maddpg, from top to bottom: each may import those after it, and the modules in the package folder,
# which import no room
LIBRARY = [
    "cli",
    "hub",
    "checkpoints",
    "iddpg",
    "masac",
    "matd3",
    "maddpg",
    "images",
    "relational",
    "common",
    "vec_env",
    "team",
    "files",
]
# The public names under the paths that users and recipes know, and what `python -m sb3_maddpg` runs
DOORS = {"sb3_maddpg", "sb3_maddpg.__main__", "sb3_maddpg.callbacks"}

# What a room of quad_swarm may import beside itself. "" are the modules in the package folder: errors, geometry, ...
ROOMS = {
    "": set(),
    "native": {""},
    "jobs": {"", "native"},
    "planner": {"", "native"},
    "plants": {""},
    "world": {"", "native", "planner", "plants"},
    "task": {"", "native", "planner", "world"},
    "interfaces": {"", "planner", "world", "task"},
    "robot": {"", "native", "planner", "plants", "world", "task"},
    "realtime": {"", "native", "planner", "plants", "world", "robot"},
    "ros": {"", "plants", "world", "robot", "realtime"},
    "evaluation": {"", "jobs", "planner", "plants", "world", "task", "robot", "realtime", "ros"},
    "figures": {"", "planner", "world", "task", "realtime", "evaluation"},
    "models": set(),
}
# Foundations that stand on compiled code
ON_NATIVE = {"quad_swarm.quadrotor"}
# Drawing is optional, so whoever draws imports figures inside a function, where it is asked for.
DRAW_ON_REQUEST = {"quad_swarm.interfaces.env", "quad_swarm.evaluation.command", "quad_swarm.evaluation.real_time"}

NEED_NO_TEST = {"sb3_maddpg.__main__", "sb3_maddpg.callbacks", "quad_swarm.figures.colours"}
# Modules that are tested through what is built on them
TESTED_WITH = {
    "quad_swarm.realtime.udp_process": "quad_swarm.realtime.process",
    "quad_swarm.ros.link": "quad_swarm.ros.world",
    "quad_swarm.ros.process": "quad_swarm.ros.world",
    "sb3_maddpg.cli.algorithms": "sb3_maddpg.cli.experiment",
    "sb3_maddpg.cli.environments": "sb3_maddpg.cli.experiment",
    "sb3_maddpg.cli.models": "sb3_maddpg.cli.main",
    "sb3_maddpg.cli.offered": "sb3_maddpg.cli.experiment",
    "sb3_maddpg.cli.runs": "sb3_maddpg.cli.training",
    "sb3_maddpg.cli.show": "sb3_maddpg.cli.experiment",
    "sb3_maddpg.cli.study": "sb3_maddpg.cli.search",
    "sb3_maddpg.common.action_noise": "sb3_maddpg.common.actions",
    "sb3_maddpg.common.arguments": "sb3_maddpg.maddpg.maddpg",
    "sb3_maddpg.common.layout": "sb3_maddpg.relational.policy",
    "sb3_maddpg.common.team_algorithm": "sb3_maddpg.maddpg.maddpg",
    "sb3_maddpg.relational.networks": "sb3_maddpg.relational.policy",
    "sb3_maddpg.relational.resizing": "sb3_maddpg.relational.training",
    "sb3_maddpg.team.spaces": "sb3_maddpg.team.team",
    "sb3_maddpg.vec_env.arrivals": "sb3_maddpg.vec_env.checks",
    "sb3_maddpg.vec_env.border": "sb3_maddpg.vec_env.checks",
    "sb3_maddpg.vec_env.gymnasium": "sb3_maddpg.vec_env.checks",
    "sb3_maddpg.vec_env.wrap": "sb3_maddpg.vec_env.checks",
}


def modules(package: str) -> dict[str, Path]:
    """:return: a package's modules by name; an ``__init__`` has the name of its folder"""
    folder = SOURCES[package]
    names = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        names[".".join((package, *(part for part in parts if part != "__init__")))] = path
    return names


ALL = {name: path for package in SOURCES for name, path in modules(package).items()}


def imports(name: str, tree: ast.AST) -> set[str]:
    """:return: the modules of the project that a module imports, by full name"""
    found = set()
    folder = name if ALL[name].name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = folder.split(".")[: len(folder.split(".")) - node.level + 1]
            source = ".".join((*parents, *filter(None, [node.module]))) if node.level else node.module
            found |= {f"{source}.{alias.name}" if f"{source}.{alias.name}" in ALL else source for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant)}
    return {one for one in found if one.partition(".")[0] in {*SOURCES, "studies", "benchmarks", "tests"}}


def imports_of(name: str) -> set[str]:
    return imports(name, ast.parse(ALL[name].read_text(encoding="utf-8")))


def room(name: str) -> str:
    """:return: the folder of a module of quad_swarm; that of the package's ``__init__`` is "top" """
    parts = name.split(".")
    if len(parts) == 1:
        return "top"
    return parts[1] if parts[1] in ROOMS else ""


@pytest.mark.parametrize("name", ALL)
def test_a_package_imports_itself_only(name):
    package = name.partition(".")[0]
    assert {one.partition(".")[0] for one in imports_of(name)} <= {package}


def rank(name: str) -> int:
    """:return: how far up a module of sb3_maddpg lies"""
    parts = name.split(".")
    if name in DOORS:
        return len(LIBRARY)
    return len(LIBRARY) - 1 - LIBRARY.index(parts[1]) if parts[1] in LIBRARY else -1


@pytest.mark.parametrize("name", [name for name in modules("sb3_maddpg") if name not in DOORS])
def test_the_library_imports_downwards(name):
    # The command line uses the library as users do
    allowed = {"sb3_maddpg"} if name.startswith("sb3_maddpg.cli") else set()
    assert not [one for one in imports_of(name) - allowed if rank(one) > rank(name)], LIBRARY


@pytest.mark.parametrize("name", [name for name in modules("quad_swarm") if name != "quad_swarm"])
def test_a_room_imports_what_lies_below_it(name):
    allowed = {room(name), *ROOMS[room(name)]}
    if name in DRAW_ON_REQUEST:
        allowed.add("figures")
    if name in ON_NATIVE:
        allowed.add("native")
    beyond = {one for one in imports_of(name) if room(one) not in allowed}
    assert not beyond, f"{name} may import {sorted(allowed)}"


@pytest.mark.parametrize("name", sorted(DRAW_ON_REQUEST))
def test_figures_are_imported_on_request_only(name):
    tree = ast.parse(ALL[name].read_text(encoding="utf-8"))
    top = ast.Module([node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))], [])
    assert not [one for one in imports(name, top) if room(one) == "figures"]


def test_imports_are_no_circle():
    """Those of quad_swarm could be one within a room only, as rooms import what lies below them."""
    graph = {name: imports_of(name) - {name, "sb3_maddpg"} for name in modules("sb3_maddpg")}
    TopologicalSorter(graph).prepare()


def test_every_folder_is_a_room_with_a_rule():
    folders = {package: {path.parent.name for path in SOURCES[package].glob("*/__init__.py")} for package in SOURCES}
    assert folders == {"sb3_maddpg": set(LIBRARY), "quad_swarm": set(ROOMS) - {""}}


def test_of(name: str) -> str:
    """:return: where the test of a module lies, relative to the root"""
    package, *folders, module = name.split(".")
    return "/".join(("tests", package, *folders, f"test_{module}.py"))


test_of.__test__ = False


def test_every_module_has_its_test_file():
    named = {TESTED_WITH.get(name, name) for name, path in ALL.items() if path.name != "__init__.py"} - NEED_NO_TEST
    without = sorted(test_of(name) for name in named if not (ROOT / test_of(name)).exists())
    assert not without, "every module has a test file of its name: write " + ", ".join(without)


def test_importing_a_module_does_not_replace_what_its_package_exports():
    """``from quad_swarm.evaluation import fly`` was a module after that had been imported."""
    for name in [name for name, path in ALL.items() if path.name == "__init__.py"]:
        package = importlib.import_module(name)
        for one in set(getattr(package, "__all__", ())) - {"errors"}:
            if f"{name}.{one}" in ALL:
                importlib.import_module(f"{name}.{one}")
                assert not inspect.ismodule(getattr(package, one)), f"{name} exports {one}"


def test_the_guide_names_every_room():
    guide = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"^\| `([\w/]+/)`", guide, re.MULTILINE))
    rooms = {f"envs/quad_swarm/{room}/" for room in ROOMS if room}
    rooms |= {f"sb3_maddpg/{room}/" for room in LIBRARY}
    assert {"sb3_maddpg/", "envs/quad_swarm/", *rooms} <= paths
    assert all((ROOT / path).is_dir() for path in paths)


def test_every_package_is_in_the_wheel():
    text = (ROOT / "pyproject.toml").read_text()
    listed = set(re.findall(r'"([\w.]+)"', text.partition("\npackages = [")[2].partition("]")[0]))
    on_disk = {name for name, path in ALL.items() if path.name == "__init__.py"}
    assert listed == on_disk | {"sb3_maddpg.zoo_configs"}
