"""What robots load: as it was exported, and nothing else."""

import json
import shutil

import pytest

from quad_swarm.evaluation.export import export
from quad_swarm.robot.files import FORMAT, load
from quad_swarm.world.presets import make_config
from sb3_maddpg.hub.pretrained import pretrained_folder

pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.slow  # PyTorch takes its time to export
MODEL = str(pretrained_folder("quad-swarm-flight") / "model.zip")
CONFIG = make_config("flight", {"noise": {"wind": 0.5}}, n_robots=3)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export(f"{MODEL}@0.4", CONFIG, tmp_path_factory.mktemp("robots")).folder


def test_robots_are_loaded_as_they_were_exported(exported):
    files = load(exported)
    assert files.config == CONFIG
    assert (files.n_bits, files.threshold, files.model) == (2, 0.4, "quad-swarm-flight")
    robot = files.robot(2)
    assert robot.index == 2
    assert robot.policy.observation.size == 6 + 2 * 57
    content = json.loads((exported / "robot.json").read_text())
    assert content["columns"] == [column.name for column in robot.policy.observation.columns]
    assert set(content["versions"]) == {"sb3-maddpg", "torch", "onnx"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": FORMAT + 1}, "has format 2, but this version reads format 1"),
        ({"format": True}, "format=True"),
        ({"n_bits": 3}, "n_bits=3"),
        ({"world": {"n_robots": -1}}, "n_robots"),
        ({"world": {"robots": 3}}, "robots"),
        ({"observation": "state+nonsense"}, "nonsense"),
        ({"columns": ["own.vel_x"]}, "its 1 columns are not the 120"),
        ({"sha256": "0"}, "is not the file that robot.json describes"),
        ({"threshold": "a"}, "threshold='a'"),
        ({"observation": "state+mask"}, "actor.onnx"),
    ],
)
def test_what_does_not_fit_is_refused(exported, tmp_path, change, message):
    folder = shutil.copytree(exported, tmp_path / "robots")
    path = folder / "robot.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match=message) as error:
        load(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"[1]", b"{", b"\xff", b"[" * 100_000, b" " * (2**20 + 1)])
def test_damaged_descriptions_are_refused(exported, tmp_path, content):
    folder = shutil.copytree(exported, tmp_path / "robots")
    (folder / "robot.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"robot\.json"):
        load(folder)


@pytest.mark.parametrize("name", ["robot.json", "actor.onnx"])
def test_missing_files_are_named(exported, tmp_path, name):
    folder = shutil.copytree(exported, tmp_path / "robots")
    (folder / name).unlink()
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        load(folder)
