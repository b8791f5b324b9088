"""Names of classes in files."""

import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_maddpg import MADDPG, allow_in_files
from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.files import registry
from sb3_maddpg.files.registry import class_in_files, name_in_files
from sb3_maddpg.iddpg.iddpg import IndependentPolicy
from sb3_maddpg.images.cnn_policy import CnnPolicy
from sb3_maddpg.relational.policy import PairPolicy
from sb3_maddpg.team.toys import OwnBit


@pytest.fixture(autouse=True)
def _restored(monkeypatch):
    monkeypatch.setattr(registry, "_allowed", dict(registry._allowed))
    monkeypatch.setattr(registry, "_names", dict(registry._names))


class Falling:
    """A schedule of somebody else's."""

    def __init__(self, start: float):
        self.start = start

    def __call__(self, progress: float) -> float:
        return self.start * progress


class Other(Falling):
    pass


@pytest.mark.parametrize(
    ("cls", "name"),
    [
        (MADDPGPolicy, "sb3_maddpg.policies.MADDPGPolicy"),
        (PairPolicy, "sb3_maddpg.relational.PairPolicy"),
        (CnnPolicy, "sb3_maddpg.cnn_policy.CnnPolicy"),
        (IndependentPolicy, "sb3_maddpg.iddpg.IndependentPolicy"),
        (TeamReplayBuffer, "sb3_maddpg.buffers.TeamReplayBuffer"),
        (PrioritizedTeamReplayBuffer, "sb3_maddpg.buffers.PrioritizedTeamReplayBuffer"),
        (ReplayBuffer, "stable_baselines3.common.buffers.ReplayBuffer"),
        (th.nn.ReLU, "torch.nn.modules.activation.ReLU"),
    ],
)
def test_files_name_classes_as_they_always_did(cls, name):
    assert name_in_files(cls) == name
    assert class_in_files(name) is cls


@pytest.mark.parametrize("name", [None, "their_package.Falling"])
def test_a_class_of_ones_own_is_written_once_it_is_allowed(name, tmp_path):
    with pytest.warns(UserWarning, match="learning_rate=.*Falling.* cannot be saved"):
        model = MADDPG("MlpPolicy", OwnBit(), learning_rate=Falling(0.5), buffer_size=100, batch_size=10)
    with pytest.raises(ValueError, match=r"learning_rate=.*Falling.*sb3_maddpg\.allow_in_files"):
        model.save(tmp_path / "model")
    assert allow_in_files(Falling, name=name) is Falling
    assert name_in_files(Falling) == (name or f"{__name__}.Falling")
    model.save(tmp_path / "model")
    assert MADDPG.load(tmp_path / "model").learning_rate(0.5) == 0.25
    del registry._allowed[name_in_files(Falling)]
    with pytest.raises(
        InvalidFileError, match=r"model: learning_rate is damaged: Unknown class '.*Falling'.*allow_in_"
    ):
        MADDPG.load(tmp_path / "model")


def test_a_class_that_was_renamed_is_still_read(tmp_path):
    allow_in_files(name="their_package.Falling")(Falling)
    model = MADDPG("MlpPolicy", OwnBit(), learning_rate=Falling(0.5), buffer_size=100, batch_size=10)
    model.save(tmp_path / "model")
    del registry._allowed["their_package.Falling"]
    allow_in_files(Other, name="their_package.Falling")
    assert type(MADDPG.load(tmp_path / "model").learning_rate) is not Falling
    assert MADDPG.load(tmp_path / "model").learning_rate(0.5) == 0.25


def test_only_what_can_be_imported_may_be_named():
    class Local:
        pass

    for wrong in (Local, Local(), lambda x: x, None):
        with pytest.raises(InvalidArgumentError, match="cannot be named in files"):
            allow_in_files(wrong)
    with pytest.raises(InvalidArgumentError, match="name=3 must be a string"):
        allow_in_files(Falling, name=3)


@pytest.mark.parametrize(
    "name", ["sb3_maddpg.policies.MADDPGPolicy", "stable_baselines3.common.utils.ConstantSchedule", "theirs.Other"]
)
def test_a_name_belongs_to_one_class(name):
    allow_in_files(Other, name="theirs.Other")
    with pytest.raises(
        InvalidArgumentError, match=rf"Files name [\w.]+ by '{name}': choose another name for .*Falling"
    ):
        allow_in_files(Falling, name=name)
