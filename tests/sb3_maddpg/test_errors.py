"""The package's own errors: what is raised for what."""

import zipfile

import gymnasium
import numpy as np
import pytest
import torch as th

from sb3_maddpg import MADDPG
from sb3_maddpg.errors import (
    DivergedError,
    InvalidArgumentError,
    InvalidEnvironmentError,
    InvalidFileError,
    TeamError,
    UntrustedFileError,
)
from sb3_maddpg.files.archive import as_damage
from sb3_maddpg.team.toys import OwnBit

SMALL = {"buffer_size": 100, "batch_size": 10, "learning_starts": 20, "seed": 0}


def make() -> MADDPG:
    return MADDPG("MlpPolicy", OwnBit(), **SMALL)


def diverge() -> None:
    model = make()
    with th.no_grad():
        next(iter(model.policy.actor.parameters())).fill_(np.nan)
    model.learn(40)


class NoTeam(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Discrete(3)


@pytest.mark.parametrize(
    ("error", "call"),
    [
        (InvalidArgumentError, lambda: MADDPG("MlpPolicy", OwnBit(), gamma=3)),
        (InvalidArgumentError, lambda: MADDPG("Policy", OwnBit())),
        (InvalidArgumentError, lambda: make().set_threshold(7)),
        (InvalidEnvironmentError, lambda: MADDPG("MlpPolicy", NoTeam())),
        (DivergedError, diverge),
    ],
)
def test_an_error_says_what_is_wrong_by_its_class(error, call):
    with pytest.raises(error) as raised:
        call()
    assert isinstance(raised.value, ValueError)


def test_files_that_are_damaged_or_pickled_are_told_apart(tmp_path):
    make().save(tmp_path / "model")
    make().save(tmp_path / "pickled", pickle=True)
    (tmp_path / "damaged.zip").write_bytes((tmp_path / "model.zip").read_bytes()[:2000])
    with zipfile.ZipFile(tmp_path / "model.zip") as old, zipfile.ZipFile(tmp_path / "other.zip", "w") as new:
        for name in old.namelist():
            new.writestr(name, b"no weights" if name == "policy.pth" else old.read(name))
    for name in ("damaged", "other"):
        with pytest.raises(InvalidFileError):
            MADDPG.load(tmp_path / name)
    with pytest.raises(UntrustedFileError):
        MADDPG.load(tmp_path / "pickled")


def test_errors_of_the_package_pass_and_others_are_damage():
    with pytest.raises(DivergedError, match="ours"), as_damage("a file"):
        raise DivergedError("ours")
    with pytest.raises(FileNotFoundError), as_damage("a file"):
        raise FileNotFoundError
    for other in (ValueError("x\ny"), KeyError("x"), RuntimeError("x")):
        told = r"^a file is damaged or does not hold a model .*x'?\)\.$"
        with pytest.raises(InvalidFileError, match=told), as_damage("a file"):
            raise other
    assert issubclass(TeamError, ValueError)
