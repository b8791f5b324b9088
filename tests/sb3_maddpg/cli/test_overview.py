"""What there is to name on the command line."""

import gymnasium
import pytest
import yaml

from sb3_maddpg.cli.overview import ALGORITHMS, environments, overview, packaged_recipes
from sb3_maddpg.hub.pretrained import pretrained_models


@pytest.mark.slow
def test_everything_that_is_registered_is_named(monkeypatch):
    monkeypatch.setitem(
        gymnasium.registry, "Mine-v0", gymnasium.envs.registration.EnvSpec("Mine-v0", entry_point="mine:Mine")
    )
    assert {"Mine-v0", "OwnBit-v0", "QuadSwarm-v0"} <= set(environments())
    assert "CartPole-v1" not in environments()
    monkeypatch.setenv("COLUMNS", "100")
    text = overview()
    assert max(map(len, text.splitlines())) <= 100
    for columns in range(60, 121):
        monkeypatch.setenv("COLUMNS", str(columns))
        text = overview()
        for name in ("Mine-v0", *ALGORITHMS, *pretrained_models(), *packaged_recipes()):
            assert name in text, columns


def test_packaged_recipes_are_those_files():
    recipes = packaged_recipes()
    assert {"maddpg.yml", "quad_swarm_paper.yml"} <= set(recipes)
    assert all(isinstance(yaml.safe_load(path.read_text()), dict) for path in recipes.values())
