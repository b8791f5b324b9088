"""What is released: the sdist has what the wheel is built from, and the wheel all that its users need."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

tomllib = pytest.importorskip("tomllib")  # in Python from 3.11 on
ROOT = Path(__file__).parents[2]
SOURCES = {"sb3_maddpg": "sb3_maddpg", "envs/quad_swarm": "quad_swarm", "zoo_configs": "sb3_maddpg/zoo_configs"}
HOOK = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def run(*command: object, cwd: Path, status: int = 0) -> str:
    """:return: what a command says that knows nothing of this folder"""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"COLUMNS": "100"}
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from the sdist, which is built from a copy of the sources."""
    folder = tmp_path_factory.mktemp("release")
    clean = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in SOURCES:
        shutil.copytree(ROOT / name, folder / "checkout" / name, ignore=clean)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / "checkout")
    run(sys.executable, "-c", HOOK, "build_sdist", folder, cwd=folder / "checkout")
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    run(sys.executable, "-c", HOOK, "build_wheel", folder, cwd=folder / sdist.name.removesuffix(".tar.gz"))
    (found,) = folder.glob("*.whl")
    return found


def dependencies(name: str) -> set[str]:
    """:return: distributions that one needs, without its extras, and those that they need"""
    found, left = set(), [Requirement(name)]
    while left:
        one = left.pop()
        extras = one.extras or {""}
        if one.marker is not None and not one.marker.evaluate({"extra": ""}):
            continue
        key = canonicalize_name(one.name)
        if (key, *sorted(extras)) in found:
            continue
        try:
            requires = distribution(one.name).requires or []
        except PackageNotFoundError:  # of an extra of somebody else's, not needed here
            continue
        found.add((key, *sorted(extras)))
        for requirement in map(Requirement, requires):
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
                requirement.marker = None
                left.append(requirement)
    return {key for key, *_ in found} - {canonicalize_name(name)}


def link(names: set[str], site: Path) -> None:
    """Let an environment have distributions of this one, and what they depend on."""
    for name in names.union(*map(dependencies, names)):
        found = distribution(name)
        for top in {file.parts[0] for file in found.files or []} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(Path(found.locate_file(top)).resolve())


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The programs of an environment with the wheel and what it depends on, without extras: links to what is here."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    site = Path(run(python, "-c", "import site; print(site.getsitepackages()[0])", cwd=folder).strip())
    link(dependencies("sb3-maddpg"), site)
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    return python.parent


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_the_packages(wheel):
    expected = {
        f"{packed}/{path.relative_to(ROOT / source).as_posix()}"
        for source, packed in SOURCES.items()
        for path in (ROOT / source).rglob("*")
        if path.is_file()
        and not {"__pycache__", "node_modules", "page"} & set(path.parts)  # page: made into replay.html
    }
    names = set(zipfile.ZipFile(wheel).namelist())
    assert expected <= names, sorted(expected - names)
    assert (
        not {name.split("/")[0] for name in names}
        - {"sb3_maddpg", "quad_swarm"}
        - {f"{wheel.name.split('-py3')[0]}.dist-info"}
    )


@pytest.mark.slow
def test_the_description_is_the_readme(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        head, _, description = archive.read(name).decode().partition("\n\n")
    assert "Description-Content-Type: text/markdown" in head
    assert description.strip() == (ROOT / "README.md").read_text(encoding="utf-8").strip()


@pytest.mark.slow
def test_the_packages_come_from_the_wheel(installed, tmp_path):
    code = "import sb3_maddpg, quad_swarm; print(sb3_maddpg.__file__, quad_swarm.__file__)"
    for path in run(installed / "python", "-c", code, cwd=tmp_path).split():
        assert Path(path).is_relative_to(installed.parent), path
    code = "import importlib.util as u; print(*(u.find_spec(n) for n in ('optuna', 'matplotlib', 'mpe2', 'scipy')))"
    assert run(installed / "python", "-c", code, cwd=tmp_path).split() == ["None"] * 4, "extras are not there"


@pytest.mark.slow
def test_the_examples_of_the_readme_run_without_extras(installed, tmp_path):
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    code = "\n".join(block for block in blocks if "mpe2" not in block)  # an extra
    code = re.sub(r"total_timesteps=[\d_]+", "total_timesteps=300", code)
    (tmp_path / "readme.py").write_text(f"{code}\nprint(pretrained('quad-swarm-any').policy)\n")
    assert "PairPolicy" in run(installed / "python", "readme.py", cwd=tmp_path)


@pytest.mark.slow
def test_the_command_works_without_extras(installed, tmp_path):
    command = installed / "sb3-maddpg"
    shown = run(command, "--help-all", cwd=tmp_path)
    recipes = [path.name for path in (ROOT / "zoo_configs").glob("*.yml")]
    assert all(name in shown for name in (*recipes, "QuadSwarm-v0", "pretrained:quad-swarm-paper"))
    assert "quad-swarm-dense" in run(command, "pretrained", cwd=tmp_path)
    words = ["--policy", "none", "pretrained:quad-swarm-paper", "--scenario", "random"]
    table = run(command, "evaluate", *words, "--episodes", 2, "--json", "table.json", cwd=tmp_path)
    assert "quad-swarm-paper" in table
    # Where there is a compiler, pairs.cpp and kernel.cpp are in the wheel
    line = json.loads((tmp_path / "table.json").read_text())[0]
    assert line["solver"] == ("rti" if shutil.which("c++") or shutil.which("g++") else "fatrop")
    run(command, "replay", *words, "--out", "page.html", cwd=tmp_path)
    assert "<canvas" in (tmp_path / "page.html").read_text(encoding="utf-8")
    for words, extra in ((["train", "--env", "OwnBit-v0"], "zoo"), (["identify", "--plant", "crazyflow"], "plants")):
        assert f"pip install -e '.[{extra}]'" in run(command, *words, cwd=tmp_path, status=1)


def test_the_swarm_alone_needs_a_part_of_what_the_package_needs():
    whole, alone = (tomllib.loads((ROOT / path / "pyproject.toml").read_text())["project"] for path in ("", "envs"))
    assert alone["version"] == whole["version"]
    assert alone["requires-python"] == whole["requires-python"]
    assert set(alone["dependencies"]) < set(whole["dependencies"])


@pytest.mark.slow
def test_a_robot_flies_from_the_swarm_alone(tmp_path):
    checkout = tmp_path / "envs"
    shutil.copytree(ROOT / "envs", checkout, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build"))
    run(sys.executable, "-c", HOOK, "build_wheel", tmp_path, cwd=checkout)
    (wheel,) = tmp_path.glob("quad_swarm-*.whl")
    run(sys.executable, "-m", "venv", "--without-pip", "venv", cwd=tmp_path)
    python = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    requirements = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]["dependencies"]
    site = Path(run(python, "-c", "import site; print(site.getsitepackages()[0])", cwd=tmp_path).strip())
    link({Requirement(one).name for one in requirements}, site)
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    assert "never closer than" in run(python, ROOT / "examples" / "one_robot.py", "--quick", cwd=tmp_path)
    missing = "import importlib.util as u; print(*(u.find_spec(n) for n in ('torch', 'gymnasium', 'pettingzoo')))"
    assert run(python, "-c", missing, cwd=tmp_path).split() == ["None"] * 3
