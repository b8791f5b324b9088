"""Modules of PettingZoo under ids of Gymnasium."""

import gymnasium
import pytest
from gymnasium import spaces

from sb3_maddpg.cli.environments import find_environment
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.team import pettingzoo_ids


@pytest.fixture
def registry():
    known = dict(gymnasium.registry)
    yield
    gymnasium.registry.clear()
    gymnasium.registry.update(known)


@pytest.mark.usefixtures("registry")
def test_a_module_is_an_environment_id():
    assert pettingzoo_ids.register("mpe2/simple_tag_v3")
    assert pettingzoo_ids.register("mpe2/simple_tag_v3")
    wrappers = ["supersuit.pad_observations_v0", {"supersuit.frame_stack_v2": {"stack_size": 2}}]
    env = gymnasium.make("mpe2/simple_tag_v3", num_good=2, state=True, wrappers=wrappers, render_mode="rgb_array")
    team = env.observation_space
    assert team.names == (*(f"adversary_{i}" for i in range(3)), "agent_0", "agent_1")
    assert (team.obs_dims, team.state_dim) == ((2 * 20,) * 5, 3 * 20 + 2 * 18)
    env.reset(seed=0)
    assert env.render().shape[2] == 3
    assert pettingzoo_ids.register("quad_swarm/parallel_env")
    assert gymnasium.make("quad_swarm/parallel_env").action_space == spaces.MultiBinary(12)
    for unknown in ("mpe2/simple_tig_v3", "mpe2/_mpe_utils", "no_such/module", "phys-2d/CartPole-v7", "simple_tag_v3"):
        assert not pettingzoo_ids.register(unknown)


def test_a_module_that_fails_is_no_unknown_id(tmp_path, monkeypatch):
    (tmp_path / "lacking_v1.py").write_text("import no_such_library")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="lacking_v1 cannot be imported: No module named 'no_such_library'"):
        pettingzoo_ids.register("lacking_v1/parallel_env")
    with pytest.raises(ValueError, match="no function parallel_env in mpe2"):
        parallel.make("mpe2.simple_sprad_v3")


def test_arguments_are_those_of_the_module():
    assert pettingzoo_ids.arguments("mpe2.simple_tag_v3") >= {"num_good", "continuous_actions", "state", "wrappers"}
    assert "info_mask" in pettingzoo_ids.arguments("mpe2.simple_tag_v3")
    assert not {"entry", "kwargs"} & pettingzoo_ids.arguments("mpe2.simple_tag_v3")
    assert pettingzoo_ids.arguments("quad_swarm") is None  # takes whatever QuadSwarmEnv does
    assert "mpe2/simple_tag_v3" in pettingzoo_ids.siblings("mpe2/simple_tig_v3")


@pytest.mark.parametrize("env_id", ["rescue_team/Rescue", "rescue_team:Rescue"])
def test_a_class_is_no_environment_id_and_the_message_says_what_to_add(env_id, tmp_path, monkeypatch):
    (tmp_path / "rescue_team.py").write_text("class Rescue: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    message = pettingzoo_ids.unknown(env_id)
    assert message.endswith("Add `parallel_env = Rescue` to rescue_team.py, and use the id 'rescue_team'.")


@pytest.mark.usefixtures("registry")
def test_a_file_in_the_present_folder_is_an_environment_id(tmp_path, monkeypatch):
    (tmp_path / "flat_team.py").write_text("from mpe2.simple_spread_v3 import parallel_env\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert pettingzoo_ids.register("flat_team")
    assert gymnasium.make("flat_team").observation_space.names == ("agent_0", "agent_1", "agent_2")


@pytest.mark.usefixtures("registry")
def test_a_turn_based_module_is_an_environment_id():
    assert find_environment("pettingzoo.classic.tictactoe_v3") == "pettingzoo.classic.tictactoe_v3"
    assert gymnasium.make("pettingzoo.classic.tictactoe_v3").observation_space.names == ("player_1", "player_2")
    with pytest.raises(ValueError, match=r"is no id for Gymnasium: write pettingzoo\.classic\.tictactoe_v3"):
        pettingzoo_ids.register("pettingzoo.classic/tictactoe_v3")
    with pytest.raises(InvalidArgumentError, match=r"Did you mean 'pettingzoo\.classic\.tictactoe_v3'\?"):
        find_environment("tictactoe_v3")


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("mpe2/simple_spread", "did you mean 'mpe2/simple_spread_v3'"),  # which is a package without an environment
        ("sisl/pursuit_v4", r"in this folder\?$"),  # not the standard library's ssl
        ("mpe2/no_module_v0", r"did you mean|nearest ids"),
        ("MPE2/simple_spread_v9", r"Did you mean 'mpe2'\?$"),
    ],
)
def test_an_id_that_is_unknown_is_not_what_is_suggested(env_id, message):
    with pytest.raises(InvalidArgumentError, match=message) as refused:
        find_environment(env_id)
    assert f"mean '{env_id}'" not in str(refused.value)


def test_packages_with_a_module_are_found():
    assert pettingzoo_ids.packaged("simple_spread_v3") == ["mpe2/simple_spread_v3"]
    assert pettingzoo_ids.packaged("no_module_v0") == []
    with pytest.raises(InvalidArgumentError, match=r"'simple_tag_v3'\. Did you mean 'mpe2/simple_tag_v3'\?"):
        find_environment("simple_tag_v3")
