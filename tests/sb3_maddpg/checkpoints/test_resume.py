"""A run that is killed at any moment goes on bit for bit."""

import json
import shutil

import numpy as np
import pytest
from resumed import EVERY, RUNS, SETTINGS, STEPS, Killed, edit, go_on, kill_at, make, normalized
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_maddpg import MADDPG, SafeVecNormalize
from sb3_maddpg.checkpoints import writer
from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.commit import newest
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.checkpoints.state import digest
from sb3_maddpg.common.callbacks import CurriculumCallback
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.states import Replayable


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_resumed_run_ends_as_the_uninterrupted_one(name, tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "_BLOCK", 5000)  # several blocks in each segment
    expected = digest(make(name).learn(STEPS, callback=[RunCheckpoint(tmp_path / "a", EVERY)]))
    assert expected == digest(make(name).learn(STEPS)), "checkpoints change nothing"
    kill_at(monkeypatch, "committed", 3)
    with pytest.raises(Killed):
        make(name).learn(STEPS, callback=[RunCheckpoint(tmp_path / "b", EVERY)])
    kill_at(monkeypatch, "committed", 2)
    with pytest.raises(Killed):
        go_on(name, tmp_path / "b")
    assert digest(go_on(name, tmp_path / "b")) == expected


@pytest.mark.slow
def test_a_run_that_a_callback_ended_goes_on_with_another_argument(tmp_path):
    ended = make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, 50), StopTrainingOnMaxEpisodes(25)])
    assert ended.num_timesteps == 250
    model = go_on("replayed", tmp_path, [stop := StopTrainingOnMaxEpisodes(40)])
    assert model.num_timesteps == 400, "the episodes before are counted"
    assert (stop.max_episodes, stop._total_max_episodes, stop.n_episodes) == (40, 40, 40)
    assert digest(model) == digest(make("replayed").learn(STEPS, callback=StopTrainingOnMaxEpisodes(40)))
    model = go_on("replayed", tmp_path, [stop := StopTrainingOnMaxEpisodes(50)])
    assert (model.num_timesteps, stop.n_episodes) == (500, 50), "also after a second resumption"


@pytest.mark.slow
def test_what_tells_no_state_goes_on_with_new_episodes_and_says_so(tmp_path):
    for env in (lambda: DummyVecEnv([OwnBit]), lambda: SubprocVecEnv([OwnBit])):
        model = MADDPG("MlpPolicy", env(), buffer_size=300, train_freq=5, **SETTINGS)
        callback = RunCheckpoint(tmp_path, EVERY)
        model.learn(250, callback=[callback])
        assert callback.inexact
        model.env.close()
        resumed, callback = resume(tmp_path, env())
        with pytest.warns(UserWarning, match="continues with new episodes and will not be bit-identical"):
            resumed.learn(100, callback=[callback], reset_num_timesteps=False)
        resumed.env.close()
        shutil.rmtree(tmp_path)


def test_other_callbacks_and_other_environments_are_refused(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    with pytest.raises(
        ValueError, match=r"The run had the callbacks .* now they are .*CurriculumCallback.*: resume with"
    ):
        model.learn(100, [callback, CurriculumCallback()], reset_num_timesteps=False)
    model, callback = resume(tmp_path, OwnBit())
    with pytest.raises(ValueError, match="The state belongs to a Replayable, but this is a OwnBit"):
        model.learn(100, [callback], reset_num_timesteps=False)
    assert resume(tmp_path / "nothing", OwnBit()) is None
    for wrong in ({"every": 0}, {"every": 5, "keep": 0}):
        with pytest.raises(ValueError, match="both must be at least 1"):
            RunCheckpoint(tmp_path, **wrong)


def test_another_number_of_environments_is_named(tmp_path):
    make("normalized").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    for n_envs in (1, 3):
        env = SafeVecNormalize(DummyVecEnv([lambda: Monitor(Replayable(OwnBit()))] * n_envs))
        told = rf"checkpoint-0+\d+ has n_envs=2, but the recipe or env has n_envs={n_envs} now: set it to 2 to resume"
        with pytest.raises(ValueError, match=told):
            resume(tmp_path, env)
    assert resume(tmp_path, normalized())[0].n_envs == 2


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("python", 1, 3), -1),
        (("python", 1, 3), 2**32),
        (("python", 1, 3), 0.5),
        (("python", 1, 624), 625),
        (("python", 1, 624), -(2**31)),
        (("python", 1), [1, 2]),
        (("python", 0), 2),
        (("python", 2), "x"),
        (("python", 2), {"$": "float", "value": "nan"}),
        (("numpy", "state", "pos"), 2**31 - 700),
        (("numpy", "state", "pos"), -5),
        (("numpy", "bit_generator"), "Philox"),
        (("numpy", "gauss"), {"$": "float", "value": "inf"}),
        (("numpy", "has_gauss"), 7),
        (("numpy",), None),
        (("torch",), {"$": "array", "dtype": "u1", "shape": [16], "base64": "AA==", "repeated": True}),
        (("torch",), {"$": "array", "dtype": "u1", "shape": [5056], "base64": "/w==", "repeated": True}),
        (("torch",), {"$": "array", "dtype": "f4", "shape": [5056], "base64": "AAAAAA==", "repeated": True}),
        (("torch",), 1),
    ],
)
def test_random_generators_of_a_checkpoint_are_checked(path, value, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])

    def change(state):
        owner = state["random"]
        for key in path[:-1]:
            owner = owner[key]
        owner[path[-1]] = value

    edit(tmp_path, change)
    with pytest.raises(ValueError, match=r"^[^\n]*(checkpoint|generator)[^\n]*$"):
        resume(tmp_path, Replayable(OwnBit()))


NAN = {"$": "float", "value": "nan"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.update(every=NAN), "every=nan"),
        (lambda state: state.update(every=0.5), "every=0.5"),
        (lambda state: state.update(every=-3), "every=-3"),
        (lambda state: state.update(every=True), "every=True"),
        (lambda state: state.update(action_noise="x"), "action_noise is 'x'"),
        (lambda state: state.update(action_noise=0), "action_noise is 0"),
        (lambda state: state.update(action_noise=[]), r"action_noise is \[\]"),
        (lambda state: state.update(inexact=1), "inexact is not text"),
        (lambda state: state.update(fingerprint=[]), r"fingerprint is \[\]"),
        (lambda state: state["logger"]["name_to_count"].update(a=-1), "name_to_count holds"),
        (lambda state: state["logger"]["name_to_count"].update(a=0.5), "name_to_count holds"),
        (lambda state: state["logger"]["name_to_value"].update(a=[]), "name_to_value holds"),
        (lambda state: state["logger"]["name_to_excluded"].update(a=1), "name_to_excluded holds"),
        (lambda state: state["counters"].update(n_added=2**63 - 1), "n_added=9223372036854775807"),
        (lambda state: state["counters"].update(n_added=7), "of a replay buffer of .* rows do not fit n_added=7"),
        (lambda state: state["counters"].update(pos=3), "pos=3"),
        (lambda state: state["segments"].pop(0), "but rows from .* are missing|its segments end at row"),
        (lambda state: state["segments"].pop(), "but rows from .* are missing|its segments end at row"),
    ],
)
def test_values_of_a_checkpoint_are_checked_when_it_is_read(change, message, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, change)
    with pytest.raises(ValueError, match=rf"^[^\n]*({message})[^\n]*$"):
        resume(tmp_path, Replayable(OwnBit()))


def test_compressed_arrays_are_refused(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    np.savez_compressed(newest(tmp_path) / "arrays.npz", zeros=np.zeros(10**6))
    edit(tmp_path, lambda state: None)
    with pytest.raises(ValueError, match=r"arrays\.npz is damaged: it has members of \d+ bytes, more than the file"):
        resume(tmp_path, Replayable(OwnBit()))


def test_nothing_in_a_checkpoint_is_a_pickle(tmp_path):
    make("normalized").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    state = json.loads((newest(tmp_path) / "state.json").read_text())
    assert ":serialized:" not in json.dumps(state)
    with np.load(newest(tmp_path) / "arrays.npz", allow_pickle=False) as arrays:
        assert all(arrays[name].dtype.kind in "biuf" for name in arrays.files)
