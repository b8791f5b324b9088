"""Files: what a saved model brings back, how it is resumed, and what happens when a file or an environment is wrong."""

import io
import json
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import plain_joint_space
from sb3_maddpg.team.toys import OtherBit, OwnBit
from toys import Toy

SMALL = {"learning_starts": 20, "batch_size": 16, "train_freq": 5, "buffer_size": 1000, "seed": 0}
OBS = np.random.default_rng(0).choice([-1.0, 1.0], (50, 3, 3)).astype(np.float32)


def learned(env="OwnBit-v0", steps: int = 100, **kwargs) -> MADDPG:
    return MADDPG("MlpPolicy", env, **{**SMALL, **kwargs}).learn(steps)


def assert_equal_state(a: dict, b: dict) -> None:
    """Networks and optimizers, leaf by leaf."""
    for x, y in zip(th.utils._pytree.tree_leaves(a), th.utils._pytree.tree_leaves(b), strict=True):
        assert th.equal(x, y) if isinstance(x, th.Tensor) else x == y


@pytest.mark.parametrize("share", [False, True, [["agent_0", 2]]])
def test_a_loaded_model_is_the_saved_one(tmp_path, share):
    kwargs = {"net_arch": [8], "share_actor": share, "share_critic": share, "threshold": 0.3}
    noise = {"exploration_noise": (0.3, 0.1), "n_steps": 3}
    temperature = LinearSchedule(1.1, 0.1, 1.0)
    model = learned(policy_kwargs=kwargs, estimator="score", max_grad_norm=None, temperature=temperature, **noise)
    model.curriculum_level = 2
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model.zip")
    assert_equal_state(model.get_parameters(), loaded.get_parameters())
    assert np.array_equal(model.predict(OBS, deterministic=True)[0], loaded.predict(OBS, deterministic=True)[0])
    th.manual_seed(1)
    exploring = model.predict(OBS)[0]
    th.manual_seed(1)
    assert np.array_equal(exploring, loaded.predict(OBS)[0])
    names = ("estimator", "max_grad_norm", "buffer_size", "num_timesteps", "_n_updates", "curriculum_level", "n_steps")
    for name in (*names, "noise_std", "policy_kwargs", "replay_buffer_kwargs"):
        assert getattr(loaded, name) == getattr(model, name)
    assert loaded.temperature(0.5) == temperature(0.5)
    assert loaded.policy.threshold == 0.3


def test_a_resumed_run_has_the_memory_of_the_interrupted_one(tmp_path):
    model = learned()
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    resumed = MADDPG.load(tmp_path / "model", env=OwnBit(), force_reset=False)
    resumed.load_replay_buffer(tmp_path / "buffer")
    for name in ("observations", "actions", "agent_rewards", "agent_terminated", "dones", "timeouts"):
        assert np.array_equal(getattr(model.replay_buffer, name), getattr(resumed.replay_buffer, name))


def test_a_model_without_environment_takes_no_memory_until_it_gets_one(tmp_path):
    learned(buffer_size=500).save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    assert loaded.buffer_size == 500
    assert loaded.replay_buffer.buffer_size == 1
    loaded.set_env(OwnBit())
    assert loaded.replay_buffer.buffer_size == 500
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.num_timesteps == 200
    assert loaded.replay_buffer.size() == 100


def test_set_env_keeps_a_filled_memory():
    model = learned()
    memory = model.replay_buffer
    model.set_env(OwnBit())
    assert model.replay_buffer is memory


def test_the_training_environment_is_written_as_json(tmp_path):
    env = make_vec_env("OwnBit-v0", 1, env_kwargs={"episode_length": 7})
    model = learned(env)
    model.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert json.loads(archive.read("data"))["env_spec"] == {"id": "OwnBit-v0", "kwargs": {"episode_length": 7}}
    assert MADDPG.load(tmp_path / "model").env_spec == model.env_spec
    model.set_env(OwnBit())  # not made by gymnasium.make
    assert model.env_spec is None


def test_paths_as_in_sb3(tmp_path):
    model = learned()
    model.save(str(tmp_path / "new" / "folder" / "a"))
    model.save(tmp_path / "b.model")
    stream = io.BytesIO()
    model.save(stream)
    stream.seek(0)
    for saved in (tmp_path / "new" / "folder" / "a.zip", tmp_path / "b.model", stream):
        assert_equal_state(MADDPG.load(saved).get_parameters(), model.get_parameters())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.model", "new"]
    assert (tmp_path / "b.model").stat().st_mode & 0o777 == (tmp_path / "new/folder/a.zip").stat().st_mode & 0o777


def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path):
    model = learned()
    model.save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()

    class Unwritable:
        def __reduce__(self):
            raise OSError("disk full")

    model.policy_kwargs = {"activation_fn": Unwritable()}
    with pytest.raises(OSError, match="disk full"):
        model.save(tmp_path / "model", pickle=True)
    with pytest.raises(ValueError, match=r"policy_kwargs=.*Unwritable.* cannot be saved"):
        model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").read_bytes() == before
    model.replay_buffer.gamma = Unwritable()
    with pytest.raises(ValueError, match=r"gamma|arguments=.*Unwritable"):
        model.save_replay_buffer(tmp_path / "buffer")
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


@pytest.mark.parametrize("kind", ["missing", "truncated", "empty"])
def test_a_bad_file_is_refused(tmp_path, kind):
    path = tmp_path / "model.zip"
    if kind != "missing":
        learned().save(path)
        path.write_bytes(path.read_bytes()[:5000] if kind == "truncated" else b"")
    with pytest.raises((ValueError, FileNotFoundError), match=r"model\.zip"):
        MADDPG.load(path)


def test_the_price_of_actions_is_that_of_the_environment(tmp_path):
    env = OwnBit()
    env.action_cost = np.arange(9.0).reshape(3, 3)
    model = learned(env, use_action_cost=True)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    assert th.equal(loaded.cost.price, model.cost.price)
    assert model.cost.price.tolist() == env.action_cost.tolist()
    for env.action_cost in (0.5, 2.0):
        loaded.set_env(env)
        assert (loaded.cost.price == env.action_cost).all()
        assert (MADDPG.load(tmp_path / "model", env=env).cost.price == env.action_cost).all()
    with pytest.raises(ValueError, match="no attribute `action_cost`"):
        loaded.set_env(OwnBit())


def test_another_team_is_refused_with_both_spaces_and_a_remedy(tmp_path):
    model = learned()
    model.save(tmp_path / "model")
    for refused in (lambda: MADDPG.load(tmp_path / "model", env=OtherBit()), lambda: model.set_env(OtherBit())):
        with pytest.raises(ValueError, match=r"\(3, 3\).*\(2, 2\).*env_spec"):
            refused()


def broken(model: MADDPG) -> MADDPG:
    with th.no_grad():
        model.critic.net.weights[1][2, 0, 0] = float("nan")
    return model


def test_parameters_that_are_not_finite_are_not_saved(tmp_path):
    learned().save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    message = r"cannot be saved: parameter critic\.net\.weights\.1, of agent\(s\) agent_2, holds NaN .* earlier file"
    for target in (tmp_path / "model", io.BytesIO()):
        with pytest.raises(ValueError, match=message):
            broken(learned()).save(target)
    assert (tmp_path / "model.zip").read_bytes() == before
    model = learned()
    model.actor.optimizer.state_dict()["state"][0]["exp_avg"][0] = float("inf")
    with pytest.raises(ValueError, match=r"the state of actor\.optimizer holds NaN or infinity"):
        model.save(tmp_path / "model")
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


def test_parameters_that_are_not_finite_are_not_loaded(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(MADDPG, "_not_finite", lambda *_: None)
        broken(learned()).save(tmp_path / "model")
    message = r"These parameters cannot be used: parameter critic\.net\.weights\.1, of agent\(s\) agent_2"
    with pytest.raises(ValueError, match=message):
        MADDPG.load(tmp_path / "model")
    model, before = learned(), learned().get_parameters()
    for parameters in (tmp_path / "model.zip", broken(learned()).get_parameters()):
        with pytest.raises(RuntimeError, match=message):
            model.set_parameters(parameters)
    assert_equal_state(model.get_parameters(), before)


class MyMADDPG(MADDPG):
    """An algorithm of a user."""


def test_a_subclass_reads_the_files_of_its_base(tmp_path):
    model = learned()
    model.save(tmp_path / "model")
    loaded = MyMADDPG.load(tmp_path / "model")
    assert_equal_state(loaded.get_parameters(), model.get_parameters())
    MyMADDPG("MlpPolicy", OwnBit()).save(tmp_path / "mine")
    assert type(MyMADDPG.load(tmp_path / "mine")) is MyMADDPG
    with pytest.raises(ValueError, match=r"holds a model of MyMADDPG: load it with `MyMADDPG\.load`"):
        MADDPG.load(tmp_path / "mine")


def test_a_replay_buffer_that_does_not_fit_is_refused_where_it_is_loaded(tmp_path):
    two = learned(make_vec_env("OwnBit-v0", 2))
    two.save_replay_buffer(tmp_path / "two")
    learned(OtherBit()).save_replay_buffer(tmp_path / "other")
    td3 = TD3("MlpPolicy", "Pendulum-v1", buffer_size=10)
    td3.save_replay_buffer(tmp_path / "td3")
    model = learned()
    present = model.replay_buffer
    for name, message in (
        ("two", r"transitions of 2 parallel environment\(s\), but the model needs transitions of 1 .*: resume with"),
        ("other", r"observations of .*\(2, 2\).*, but the model needs observations of .*\(3, 3\)"),
        ("td3", "not a replay buffer that this version writes. .* `trust=True`"),
    ):
        with pytest.raises(ValueError, match=message):
            model.load_replay_buffer(tmp_path / f"{name}.pkl")
        assert model.replay_buffer is present
    with pytest.raises(ValueError, match="holds a ReplayBuffer, but the model needs a TeamReplayBuffer"):
        model.load_replay_buffer(tmp_path / "td3", trust=True)


def test_training_needs_an_environment(tmp_path):
    MADDPG("MlpPolicy", OwnBit(), **SMALL).save(tmp_path / "model")
    model = MADDPG.load(tmp_path / "model")
    with pytest.raises(
        ValueError, match=r"no environment .* `MADDPG\.load\(path, env=env\)`, or call `set_env\(env\)`"
    ):
        model.learn(10)
    model.set_env(OwnBit())
    assert model.learn(10).num_timesteps == 10


def test_arguments_of_load_override_the_file_and_unknown_ones_are_refused(tmp_path):
    MADDPG("MlpPolicy", OwnBit(), **SMALL).save(tmp_path / "model")
    with pytest.raises(ValueError, match="Unknown argument of load 'learningrate': did you mean 'learning_rate'"):
        MADDPG.load(tmp_path / "model", learningrate=1e-3)
    with pytest.raises(ValueError, match="policy='PairPolicy' is no argument of load"):
        MADDPG.load(tmp_path / "model", policy="PairPolicy")
    model = MADDPG.load(tmp_path / "model", env=OwnBit(), learning_rate=1e-3, gamma=0.5, num_timesteps=7)
    assert (model.learning_rate, model.lr_schedule(1), model.gamma, model.num_timesteps) == (1e-3, 1e-3, 0.5, 7)


def test_other_numbers_of_environments_need_an_empty_replay_buffer():
    model = learned()
    before = model.get_env()
    with pytest.raises(ValueError, match=r"holds transitions of 1 parallel environment\(s\) .* those of 2: .*reset"):
        model.set_env(make_vec_env("OwnBit-v0", 2))
    assert model.get_env() is before
    model.replay_buffer.reset()
    model.set_env(make_vec_env("OwnBit-v0", 2))
    assert model.learn(40, reset_num_timesteps=False).replay_buffer.n_envs == 2


def spoilt(source: Path, **members: bytes) -> Path:
    """A copy of a model's zip with other contents of some members, by their names without what follows the dot."""
    target = source.with_name("spoilt.zip")
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, members.get(name.split(".")[0], old.read(name)))
    return target


def test_damaged_files_are_refused_in_one_line(tmp_path):
    model = learned()
    model.save(tmp_path / "model.zip")
    before = model.get_parameters()
    for members in ({"data": b"["}, {"data": b"[]"}, {"data": b"\xff"}, {"policy": b"x"}, {"actor": b""}):
        for read in (MADDPG.load, model.set_parameters):
            if "data" in members and read == model.set_parameters:
                continue  # which does not read it
            with pytest.raises(ValueError, match=r"spoilt\.zip(: [a-z.]+)? is damaged") as told:
                read(spoilt(tmp_path / "model.zip", **members))
            assert "\n" not in str(told.value)
    with pytest.raises(ValueError, match="5 is neither a path nor a file"):
        MADDPG.load(5)
    assert_equal_state(model.get_parameters(), before)


def test_parameters_of_other_networks_are_refused_and_nothing_has_changed():
    model = learned()
    before = model.get_parameters()
    name, weights = next(iter(before["policy"].items()))
    moments = before["actor.optimizer"]["state"]
    for spoilt_parameters in (
        {**before, "policy": {**before["policy"], name: weights[:0]}},
        {**before, "policy": {**before["policy"], name: weights.double() + 1e300}},
        {**before, "policy": {**before["policy"], name: weights.long()}},
        {**before, "policy": []},
        {**before, "actor.optimizer": {}},
        {**before, "actor.optimizer": before["critic.optimizer"]},
        {
            **before,
            "actor.optimizer": {
                **before["actor.optimizer"],
                "state": {**moments, 0: {**moments[0], "exp_avg": th.zeros(2)}},
            },
        },
    ):
        with pytest.raises(ValueError, match="These parameters cannot be used") as told:
            model.set_parameters(spoilt_parameters)
        assert "\n" not in str(told.value)
        assert_equal_state(model.get_parameters(), before)


def test_a_truncated_replay_buffer_is_refused(tmp_path):
    model = learned()
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    content = (tmp_path / "buffer.pkl").read_bytes()
    (tmp_path / "buffer.pkl").write_bytes(content[: len(content) // 2])
    present = model.replay_buffer
    with pytest.raises(ValueError, match=r"buffer\.pkl is not a replay buffer that this version writes"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer is present


@pytest.mark.parametrize("lean", ["actor", "critic"])
def test_a_lean_file_acts_the_same_and_trains_on_from_what_it_has(tmp_path, lean):
    model = learned()
    model.save(tmp_path / "whole")
    model.save(tmp_path / "lean", lean=lean)
    with zipfile.ZipFile(tmp_path / "lean.zip") as archive:
        assert "actor.optimizer.pth" not in archive.namelist()
    assert (tmp_path / "lean.zip").stat().st_size < 0.6 * (tmp_path / "whole.zip").stat().st_size
    loaded = MADDPG.load(tmp_path / "lean", env=OwnBit())
    assert loaded.lean == lean
    assert np.array_equal(model.predict(OBS, deterministic=True)[0], loaded.predict(OBS, deterministic=True)[0])
    assert_equal_state(loaded.actor.state_dict(), loaded.actor_target.state_dict())
    assert_equal_state(loaded.critic.state_dict(), loaded.critic_target.state_dict())
    same = all(map(th.equal, model.critic.parameters(), loaded.critic.parameters()))
    assert same == (lean == "critic")
    with pytest.warns(UserWarning, match="saved without .*optimizers' state, which are initialised afresh"):
        loaded.learn(60)
    assert loaded.lean is None
    other = MADDPG("MlpPolicy", OwnBit(), **{**SMALL, "seed": 5})
    other.set_parameters(tmp_path / "lean.zip")
    assert np.array_equal(model.predict(OBS, deterministic=True)[0], other.predict(OBS, deterministic=True)[0])


def test_lean_is_one_of_two_and_needs_the_actor(tmp_path):
    model = learned()
    for wrong in ({"lean": "actors"}, {"lean": "actor", "pickle": True}, {"lean": True}):
        with pytest.raises(ValueError, match="lean must be one of"):
            model.save(tmp_path / "model", **wrong)
    model.save(tmp_path / "model", lean="actor")
    with zipfile.ZipFile(tmp_path / "model.zip") as old, zipfile.ZipFile(tmp_path / "other.zip", "w") as new:
        for name in old.namelist():
            changed = json.dumps({**json.loads(old.read("data")), "lean": "critic"}).encode()
            new.writestr(name, changed if name == "data" else old.read(name))
    with pytest.raises(ValueError, match=r"they have no critic\."):
        MADDPG.load(tmp_path / "other")


def test_a_loaded_replay_buffer_follows_the_model(tmp_path):
    learned(gamma=0.95).save_replay_buffer(tmp_path / "buffer")
    model = MADDPG(
        "MlpPolicy", "OwnBit-v0", **SMALL, gamma=0.5, replay_buffer_kwargs={"handle_timeout_termination": False}
    )
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.gamma == 0.5
    assert not model.replay_buffer.handle_timeout_termination
    model.gamma = 0.25
    model.learn(40)
    assert model.replay_buffer.sample(4).discounts == 0.25


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 3}, "holds windows of n_steps=1, but the model needs windows of n_steps=3"),
        (
            {"replay_buffer_class": PrioritizedTeamReplayBuffer},
            "in a TeamReplayBuffer, but the model needs .* Prioritized",
        ),
        (
            {
                "optimize_memory_usage": True,
                "replay_buffer_kwargs": {"handle_timeout_termination": False},
            },
            "optimize_memory_usage=False, but the model needs",
        ),
    ],
)
def test_a_replay_buffer_of_other_arguments_is_refused(tmp_path, kwargs, message):
    learned().save_replay_buffer(tmp_path / "buffer")
    model = MADDPG("MlpPolicy", "OwnBit-v0", **SMALL, **kwargs)
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 0


def test_the_arguments_of_the_policy_may_be_repeated(tmp_path):
    kwargs = {"net_arch": [8], "threshold": 0.3}
    learned(policy_kwargs=kwargs).save(tmp_path / "model")
    assert MADDPG.load(tmp_path / "model", OwnBit(), policy_kwargs=kwargs).policy.threshold == 0.3
    with pytest.raises(ValueError, match=r"policy_kwargs: net_arch, threshold differ .* Leave them out"):
        MADDPG.load(tmp_path / "model", OwnBit(), policy_kwargs={"net_arch": [9]})


def test_a_model_remembers_that_its_observations_were_normalised(tmp_path):
    MADDPG("MlpPolicy", VecNormalize(make_vec_env("OwnBit-v0", 1)), **SMALL).save(tmp_path / "normalised")
    learned().save(tmp_path / "plain")
    with pytest.warns(UserWarning, match="trained with VecNormalize"):
        MADDPG.load(tmp_path / "normalised").agent_policy(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MADDPG.load(tmp_path / "plain").agent_policy(0)


def test_files_whose_joint_action_space_lost_data_types_still_load(tmp_path, monkeypatch):
    """As files of earlier versions have them."""

    class Integers(Toy):
        def __init__(self):
            super().__init__("continuous")
            self.spaces = tuple(spaces.Box(0, 9, (2,), np.int64) for _ in self.spaces)

    with monkeypatch.context() as earlier:
        earlier.setattr("sb3_maddpg.team.pettingzoo.joint_action_space", plain_joint_space)
        model = MADDPG("MlpPolicy", Integers(), **SMALL)
        model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=Integers())
    obs = TeamEnv(Integers()).reset(seed=0)[0]
    before, after = (one.predict(obs, deterministic=True)[0] for one in (model, loaded))
    assert np.abs(before - after).max() <= 0.5  # rounded now
    assert loaded.agent_policy(0).predict(obs[0, :2])[0].dtype == np.int64
    loaded.learn(30)


def test_a_file_does_not_decide_where_curves_are_written(tmp_path, monkeypatch):
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.mkdir()
    monkeypatch.chdir(here)
    (here / "link").symlink_to(tmp_path)
    for folder in (str(elsewhere), "../elsewhere", "link/elsewhere"):
        MADDPG("MlpPolicy", "OwnBit-v0", **SMALL, tensorboard_log=folder).save("model")
        with pytest.warns(UserWarning, match=f"logs to '{folder}', which is outside the current folder.*load"):
            model = MADDPG.load("model", env=OwnBit())
        model.learn(30)
        assert not elsewhere.exists()
        for asked in ({"trust": True}, {"tensorboard_log": folder}, {"custom_objects": {"tensorboard_log": folder}}):
            assert MADDPG.load("model", **asked).tensorboard_log == folder
    MADDPG("MlpPolicy", "OwnBit-v0", **SMALL, tensorboard_log="curves").save("model")
    assert MADDPG.load("model").tensorboard_log == "curves"
