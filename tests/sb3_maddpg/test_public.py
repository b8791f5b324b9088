"""The public names, which are imported when they are first used."""

import subprocess
import sys
from pathlib import Path

import pytest

import sb3_maddpg


def test_every_public_name_is_there():
    for name in sb3_maddpg.__all__:
        found = getattr(sb3_maddpg, name)
        assert found.__module__ == f"sb3_maddpg.{sb3_maddpg._MODULES[name]}"
        assert name in dir(sb3_maddpg)
    assert sb3_maddpg._MODULES.keys() == set(sb3_maddpg.__all__)


def test_type_checkers_see_the_same_names():
    source = Path(sb3_maddpg.__file__).read_text()
    block = source.partition("if TYPE_CHECKING:")[2].partition("_MODULES")[0]
    for name, module in sb3_maddpg._MODULES.items():
        (line,) = (line for line in block.splitlines() if f"from sb3_maddpg.{module} import " in line)
        assert name in line


def test_what_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'MADDGP'"):
        sb3_maddpg.MADDGP  # noqa: B018


@pytest.mark.slow
def test_importing_the_package_loads_no_pytorch():
    code = "import sys, sb3_maddpg; print('torch' in sys.modules); sb3_maddpg.MADDPG; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
