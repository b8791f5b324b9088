"""What files would need to be trusted for."""

import json
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import IDDPG, MADDPG, SafeVecNormalize, untrusted
from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.hub.pretrained import pretrained_folder, pretrained_models
from sb3_maddpg.team.toys import OwnBit


class Trap:
    """Whoever unpickles it has run code: the file `caught` is there."""

    def __reduce__(self):
        return Path.touch, (Path("caught"),)


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def model() -> MADDPG:
    return MADDPG("MlpPolicy", OwnBit(), buffer_size=100, learning_starts=10, batch_size=8).learn(20)


def test_what_this_package_writes_needs_no_trust(model):
    model.save("model.zip")
    model.save_replay_buffer("buffer.pkl")
    SafeVecNormalize(DummyVecEnv([OwnBit])).save("statistics.pkl")
    IDDPG("MlpPolicy", OwnBit(), buffer_size=100, batch_size=8).save("iddpg.zip")
    for name in ("model.zip", "buffer.pkl", "statistics.pkl", "iddpg.zip"):
        assert untrusted(name) == [], name
    for name in pretrained_models():
        assert untrusted(pretrained_folder(name) / "model.zip") == []


def test_pickled_values_are_named_and_not_loaded(model, tmp_path):
    model.save("model.zip", pickle=True)
    found = untrusted("model.zip")
    assert "learning_rate is pickled" in found or "policy_class is pickled" in found
    PPO("MlpPolicy", gymnasium.make("CartPole-v1"), n_steps=8, batch_size=8).save("ppo.zip")
    assert "policy_class is pickled" in untrusted("ppo.zip")
    VecNormalize(DummyVecEnv([lambda: gymnasium.make("CartPole-v1")])).save("statistics.pkl")
    assert untrusted("statistics.pkl") == ["the whole file is a pickle"]
    Path("trap.pkl").write_bytes(pickle.dumps(Trap()))
    assert untrusted(Path("trap.pkl")) == ["the whole file is a pickle"]
    assert not Path("caught").exists()


def test_classes_that_are_not_registered_are_named(model):
    model.save("model.zip")
    with zipfile.ZipFile("model.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    data["policy_kwargs"] = {"optimizer_class": {"$": "class", "name": "os.system"}, "x": [{"$": "object", "class": 3}]}
    members["data"] = json.dumps(data).encode()
    with zipfile.ZipFile("model.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    assert untrusted("model.zip") == ["3 is not registered", "os.system is not registered"]


@pytest.mark.parametrize("content", [b"", b"hello", b"[1]", b"{", b"{" * 5000])
def test_another_file_is_refused(content):
    Path("file").write_bytes(content)
    with pytest.raises(ValueError, match=r"file is (neither a model|damaged)"):
        untrusted("file")


@pytest.mark.slow
def test_the_classes_of_this_package_are_known_before_they_are_imported(model):
    IDDPG("MlpPolicy", OwnBit(), buffer_size=100, batch_size=8).save("iddpg.zip")
    code = "from sb3_maddpg import untrusted; print(untrusted('iddpg.zip'))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_huge_member_is_not_read():
    for method, told in (
        (zipfile.ZIP_STORED, "data is too large"),
        (zipfile.ZIP_DEFLATED, "has members of 20000003 bytes"),
    ):
        with zipfile.ZipFile("model.zip", "w", method) as archive:
            archive.writestr("data", b"[" + b"1," * 10_000_000 + b"1]")
        with pytest.raises(InvalidFileError, match=told):
            untrusted("model.zip")
    np.save("array.npy", np.zeros(3))
    with pytest.raises(ValueError, match="neither a model"):
        untrusted("array.npy")
