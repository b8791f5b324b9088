"""What exact results depend on is named if it differs."""

import importlib
import importlib.metadata
import re
import sys
import warnings

import pytest
from resumed import EVERY, SETTINGS, make

from sb3_maddpg import MADDPG
from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.utils import sources_of
from sb3_maddpg.vec_env.states import Replayable


def test_another_machine_is_named(tmp_path, monkeypatch):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    monkeypatch.setattr(sys.modules[resume.__module__], "fingerprint", lambda env: {"torch": "3.0"})
    with pytest.warns(UserWarning, match=r"may not be bit-identical: torch:? .* before, 3\.0 now"):
        resume(tmp_path, Replayable(OwnBit()))


def test_an_upgrade_of_package_environment_or_solver_is_named_in_one_line(tmp_path, monkeypatch):
    source = tmp_path / "own_env.py"
    source.write_text(
        "from sb3_maddpg.team.toys import OwnBit\nclass Env(OwnBit):\n    depends_on = {'solver': 'fast'}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    own = importlib.import_module("own_env")
    run = tmp_path / "run"
    MADDPG("MlpPolicy", Replayable(own.Env()), **SETTINGS).learn(250, callback=[RunCheckpoint(run, EVERY)])

    def told() -> str:
        sources_of.cache_clear()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            resume(run, Replayable(own.Env()))
        return "".join(str(one.message) for one in caught)

    assert told() == ""
    monkeypatch.setattr(own.Env, "depends_on", {"solver": "slow"})
    assert told() == "The run continues, but may not be bit-identical: environment's solver: fast before, slow now."
    source.write_text(source.read_text() + "A = 1\n")
    assert re.fullmatch(r".*: sources of own_env: \w{12} before, \w{12} now; environment's solver: .* now\.", told())
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "99.0")
    assert "; gymnasium: " in told()
    assert "sb3-maddpg: " in told()
    assert "\n" not in told()
