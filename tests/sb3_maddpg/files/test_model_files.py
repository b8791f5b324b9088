"""Model files: whose they are, which format they have, and numbers that are not finite."""

import base64
import inspect
import io
import json
import zipfile
from pathlib import Path

import pytest
import torch as th
from stable_baselines3 import PPO, TD3

from sb3_maddpg import MADDPG
from sb3_maddpg.files.archive import Archive, opened
from sb3_maddpg.files.model_files import _ATTRIBUTES, FILE_FORMAT, optimizer_not_finite, read_data
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.toys import OwnBit

_NAN = base64.b64encode(b"\x00\x00\xc0\x7f").decode()
NAN_BOUND = {"$": "array", "dtype": "f4", "shape": [9], "base64": _NAN, "repeated": True}


def learned(steps: int = 30) -> MADDPG:
    return MADDPG("MlpPolicy", OwnBit(), learning_starts=20, batch_size=16, train_freq=5, buffer_size=100).learn(steps)


def assert_equal_state(a: dict, b: dict) -> None:
    """Networks and optimizers, leaf by leaf."""
    for x, y in zip(th.utils._pytree.tree_leaves(a), th.utils._pytree.tree_leaves(b), strict=True):
        assert th.equal(x, y) if isinstance(x, th.Tensor) else x == y


def test_what_is_no_archive_is_refused(tmp_path):
    path = tmp_path / "model.zip"
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"model\.zip is damaged or holds something else: it is no zip file"):
        MADDPG.load(path)


def test_a_missing_file_is_named_as_it_was_given(tmp_path):
    for name in ("nothing.zip", "nothing"):
        with pytest.raises(FileNotFoundError) as caught:
            MADDPG.load(tmp_path / name)
        assert str(caught.value.filename) == str(tmp_path / "nothing.zip")


def test_a_stream_can_be_read_after_the_check(tmp_path):
    learned().save(tmp_path / "model.zip")
    stream = io.BytesIO((tmp_path / "model.zip").read_bytes())
    stream.seek(7)
    with opened(stream) as file:
        assert read_data(Archive(file, "model"), "MADDPG", {"MADDPG"})["algorithm"] == "MADDPG"
    assert stream.tell() == 0
    with zipfile.ZipFile(stream) as archive:
        assert json.loads(archive.read("data"))["file_format"] == FILE_FORMAT


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), float("-inf")])
def test_one_number_of_an_optimizer_that_is_not_finite_is_found(wrong):
    weight = th.nn.Parameter(th.ones(3))
    optimizer = th.optim.Adam([weight])
    assert not optimizer_not_finite(optimizer.state_dict())
    weight.sum().backward()
    optimizer.step()
    assert not optimizer_not_finite(optimizer.state_dict())
    optimizer.state[weight]["exp_avg"][1] = wrong
    assert optimizer_not_finite(optimizer.state_dict())


def rewritten(source: Path, target: Path, **changes) -> Path:
    """:return: the model's file with other entries in its data, None to leave one out"""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "data":
                data = {**json.loads(content), **changes}
                content = json.dumps({key: value for key, value in data.items() if value is not None}).encode()
            new.writestr(name, content)
    return target


@pytest.mark.parametrize("stream", [False, True])
def test_models_of_other_algorithms_are_refused(tmp_path, stream):
    PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8).save(tmp_path / "ppo.zip")
    TD3("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "td3.zip")
    MATD3("MlpPolicy", OwnBit()).save(tmp_path / "matd3.zip")
    learned().save(tmp_path / "maddpg.zip")
    for algorithm, name, message in (
        (MADDPG, "ppo", "holds a model of another algorithm than MADDPG"),
        (MADDPG, "td3", "holds a model of another algorithm than MADDPG"),
        (MATD3, "td3", "holds a model of another algorithm than MATD3"),
        (MADDPG, "matd3", r"holds a model of MATD3: load it with `MATD3\.load`"),
        (MATD3, "maddpg", r"holds a model of MADDPG: load it with `MADDPG\.load`"),
    ):
        path = tmp_path / f"{name}.zip"
        with pytest.raises(ValueError, match=message):
            algorithm.load(io.BytesIO(path.read_bytes()) if stream else path)
    assert MATD3.load(tmp_path / "matd3").algorithm == "MATD3"
    th.save({"weights": 1}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match=r"other\.pt holds no model of MADDPG"):
        MADDPG.load(tmp_path / "other.pt")
    model = learned()
    model.agent_policy(0).export(tmp_path / "agent.pt")
    with pytest.raises(ValueError, match=r"holds no model of MADDPG\. It may be an exported agent: .*torch\.jit\.load"):
        MADDPG.load(tmp_path / "agent.pt")
    model.save_replay_buffer(tmp_path / "buffer.zip")
    with pytest.raises(ValueError, match=r"holds no model of MADDPG\. It is a replay buffer's file"):
        MADDPG.load(tmp_path / "buffer.zip")
    with pytest.raises(ValueError, match=r"holds no replay buffer of format 1\. It is a model's file"):
        model.load_replay_buffer(tmp_path / "maddpg.zip")
    with pytest.raises(ValueError, match="is a folder: name a model file in it"):
        MADDPG.load(tmp_path)


@pytest.mark.parametrize("changes", [{"file_format": 1}, {"file_format": 99}, {"file_format": None, "algorithm": None}])
def test_a_file_of_another_format_is_refused(tmp_path, changes):
    model = learned()
    model.save(tmp_path / "model.zip")
    path = rewritten(tmp_path / "model.zip", tmp_path / "other.zip", **changes)
    written = changes["file_format"] or 1
    with pytest.raises(ValueError, match=rf"other\.zip has format {written}, .* reads format 3: install the version"):
        MADDPG.load(path)
    same = MADDPG.load(rewritten(tmp_path / "model.zip", tmp_path / "same.zip"))
    assert_equal_state(same.get_parameters(), model.get_parameters())


@pytest.mark.parametrize(
    "changes",
    [
        {"_n_updates": "x"},
        {"num_timesteps": -1},
        {"num_timesteps": 2**63},
        {"start_time": float("nan")},
        {"normalized_observations": "true"},
        {"normalized_observations": []},
        {"_stats_window_size": 10**30},
        {"ep_info_buffer": {"$": "deque", "items": [1], "maxlen": 100}},
        {"ep_info_buffer": {"$": "deque", "items": [{"r": None, "l": 3, "t": 1.0}], "maxlen": 100}},
        {"ep_info_buffer": {"$": "deque", "items": [{"r": 1.0, "t": 1.0}], "maxlen": 100}},
        {"agent_windows": []},
        {"agent_windows": {"rollout/ep_rew_mean_a": 1.0}},
        {"agent_windows": {"rollout/ep_rew_mean_a": {"$": "deque", "items": [], "maxlen": 100}}},
        {"agent_windows": {"rollout/ep_rew_mean_a": {"$": "deque", "items": ["x"], "maxlen": 100}}},
    ],
)
def test_counters_that_no_training_wrote_are_refused(tmp_path, changes):
    learned().save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=f"its {next(iter(changes))} is"):
        MADDPG.load(rewritten(tmp_path / "model.zip", tmp_path / "other.zip", **changes))


def test_each_attribute_in_a_file_has_a_check(tmp_path):
    learned().save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        written = set(json.loads(archive.read("data")))
    arguments = set(inspect.signature(MADDPG.__init__).parameters)
    format_and_spaces = {"algorithm", "file_format", "policy_class", "action_space", "observation_space", "action_cost"}
    recreated = {"lr_schedule", "sde_sample_freq", "_last_episode_starts"}
    attributes = {name for names in _ATTRIBUTES.values() for name in names}
    assert written - arguments - format_and_spaces - recreated <= attributes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train_freq": {"$": "TrainFreq", "frequency": -1, "unit": "step"}}, "train_freq=.* must be an integer"),
        ({"train_freq": {"$": "TrainFreq", "frequency": 0.5, "unit": "step"}}, "train_freq=.* must be an integer"),
        ({"temperature": 1e39}, r"temperature=1e\+39 must be"),
        ({"policy_regularization": 1e39}, r"policy_regularization=1e\+39 must be"),
        ({"ep_success_buffer": {"$": "deque", "items": ["x"], "maxlen": 100}}, "its ep_success_buffer is"),
        ({"action_space": {"$": "Box", "low": NAN_BOUND, "high": NAN_BOUND}}, "action_space is damaged"),
        ({"observation_space": {"$": "Box", "low": 1, "high": 0}}, "observation_space is damaged"),
        ({"action_space": {"$": "Tuple", "spaces": [None] * 10**5}}, "100000 agents or parts of a space, more than"),
        ({"action_space": {"$": "MixedActions", "agents": [None] * 10**5}}, "100000 agents or parts of a space"),
    ],
)
def test_values_that_training_would_stumble_over_are_refused_in_one_line_when_read(tmp_path, changes, message):
    learned().save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=rf"^[^\n]*{message}[^\n]*$"):
        MADDPG.load(rewritten(tmp_path / "model.zip", tmp_path / "other.zip", **changes))


@pytest.mark.parametrize("name", ["target_noise_clip", "target_policy_noise"])
def test_numbers_beyond_single_precision_are_refused(name):
    with pytest.raises(ValueError, match=rf"{name}=1e\+39 must be a finite"):
        MATD3("MlpPolicy", OwnBit(), **{name: 1e39})


def test_one_of_the_two_buffers_of_episodes_is_not_enough(tmp_path):
    learned().save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    data["ep_success_buffer"] = None
    path = tmp_path / "other.zip"
    with zipfile.ZipFile(tmp_path / "model.zip") as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    with pytest.raises(ValueError, match="only one of ep_info_buffer and ep_success_buffer"):
        MADDPG.load(path)


@pytest.mark.parametrize("name", ["predict", "train", "logger", "load", "_logger", "device"])
def test_values_that_would_replace_methods_or_what_belongs_to_the_process_are_refused(tmp_path, name):
    learned().save(tmp_path / "model.zip")
    path = rewritten(tmp_path / "model.zip", tmp_path / "other.zip", **{name: 3})
    with pytest.raises(ValueError, match=f"it has values for {name}, which models do not save"):
        MADDPG.load(path)
    if name == "device":
        assert MADDPG.load(path, custom_objects={"device": th.device("cpu")}).device.type == "cpu"


def zeros(*shape: int) -> dict:
    """:return: the JSON of an array of zeros"""
    zero = base64.b64encode(bytes(4)).decode()
    return {"$": "array", "dtype": "f4", "shape": shape, "base64": zero, "repeated": True}


def team_of(n_agents: int, length: int) -> dict:
    """:return: the JSON of the observations of a team"""
    names, bounds = [str(agent) for agent in range(n_agents)], zeros(n_agents, length)
    return {
        "$": "TeamObservation",
        "names": names,
        "lengths": [length] * n_agents,
        "state": 0,
        "low": bounds,
        "high": bounds,
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy_kwargs": {"net_arch": [12_000, 12_000]}}, "asks for too much memory: its networks need more than 2"),
        ({"policy_kwargs": {"net_arch": [64] * 20_000}}, "asks for too much memory"),
        ({"policy_kwargs": {"n_critics": 10**6}}, "asks for too much memory"),
        (
            {"action_space": {"$": "CategoricalActions", "agents": [{"$": "Discrete", "n": 10**8, "start": 0}] * 3}},
            "asks",
        ),
        ({"observation_space": team_of(3, 10**5)}, "asks for too much memory"),
        ({"observation_space": team_of(4000, 2), "action_space": {"$": "MultiBinary", "n": 4000}}, "asks"),
        ({"something": [zeros(10**7)] * 3}, "is damaged: it has arrays of 300000"),
        ({f"something_{k}": zeros(10**7) for k in range(3)}, "is damaged: it has arrays of 300000"),
    ],
)
def test_files_that_ask_for_much_more_memory_than_their_weights_take_are_refused(tmp_path, changes, message):
    learned().save(tmp_path / "model.zip")
    path = rewritten(tmp_path / "model.zip", tmp_path / "other.zip", **changes)
    with pytest.raises(ValueError, match=message):
        MADDPG.load(path)


class LargeTeam(OwnBit):
    """Critics read 24 * 65 numbers, actors 64: with one wide layer, critics are 24 times as large as actors."""

    n_agents, action_dim, obs_dim = 24, 1, 64


def test_models_of_large_teams_are_loaded_from_files_without_the_critics(tmp_path):
    kwargs = {"policy_kwargs": {"net_arch": [256]}, "buffer_size": 20, "batch_size": 10}
    model = MADDPG("MlpPolicy", LargeTeam(), **kwargs)
    model.save(tmp_path / "lean.zip", lean="actor")
    critics = sum(one.numel() * one.element_size() for one in model.critic.parameters())
    assert critics > 15 * (tmp_path / "lean.zip").stat().st_size
    obs = model.observation_space.sample()
    loaded = MADDPG.load(tmp_path / "lean.zip")
    assert (loaded.predict(obs, deterministic=True)[0] == model.predict(obs, deterministic=True)[0]).all()
