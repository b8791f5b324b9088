"""The state of callbacks, environments and generators in a checkpoint."""

import warnings
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
from resumed import EVERY, RUNS, STEPS, Killed, curriculum, edit, go_on, kill_at, make, normalized
from stable_baselines3.common import callbacks as sb3_callbacks
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EventCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_maddpg import MADDPG
from sb3_maddpg.checkpoints import state
from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.checkpoints.state import digest
from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
from sb3_maddpg.common.evaluation import TeamEvalCallback
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.states import Replayable


def evaluated(folder: Path) -> list[BaseCallback]:
    env = DummyVecEnv([lambda: Monitor(Replayable(OwnBit()))])
    env.seed(0)
    evaluation = EvalCallback(env, eval_freq=90, log_path=str(folder), verbose=0)
    return [RunCheckpoint(folder / "checkpoints", EVERY), evaluation]


@pytest.mark.slow
def test_without_the_checkpoint_s_state_a_run_ends_otherwise(tmp_path, monkeypatch):
    expected = digest(make("replayed").learn(STEPS))
    kill_at(monkeypatch, "committed", 3)
    with pytest.raises(Killed):
        make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    monkeypatch.setattr(state, "_set_random_state", lambda state: None)
    assert digest(go_on("replayed", tmp_path)) != expected


@pytest.mark.slow
def test_callbacks_go_on_where_they_were(tmp_path, monkeypatch):
    (whole := tmp_path / "whole").mkdir()
    make("replayed").learn(STEPS, callback=evaluated(whole))
    kill_at(monkeypatch, "committed", 4)
    (parts := tmp_path / "parts").mkdir()
    with pytest.raises(Killed):
        make("replayed").learn(STEPS, callback=evaluated(parts))
    go_on("replayed", parts / "checkpoints", evaluated(parts)[1:])
    with np.load(whole / "evaluations.npz") as one, np.load(parts / "evaluations.npz") as two:
        assert len(one["timesteps"]) == 7
        for name in ("timesteps", "results", "ep_lengths"):
            assert np.array_equal(one[name], two[name])


@pytest.mark.slow
def test_a_curriculum_goes_on_where_it_was(tmp_path, monkeypatch):
    def learn(folder: Path) -> MADDPG:
        return make("one swarm").learn(STEPS, callback=[RunCheckpoint(folder, EVERY), CurriculumCallback(0.1, 3)])

    whole = learn(tmp_path / "a")
    assert whole.curriculum_level > 0
    kill_at(monkeypatch, "committed", 4)
    with pytest.raises(Killed):
        learn(tmp_path / "b")
    resumed = go_on("one swarm", tmp_path / "b", [CurriculumCallback(0.1, 3)])
    assert digest(resumed) == digest(whole)
    assert resumed.curriculum_level == whole.curriculum_level


def test_arguments_of_nested_callbacks_are_those_passed_now_and_their_counters_go_on(tmp_path):
    def callbacks(eval_freq: int, at_most: int) -> list[BaseCallback]:
        none_better = StopTrainingOnNoModelImprovement(at_most)
        env = DummyVecEnv([lambda: Monitor(Replayable(OwnBit()))])
        return [EvalCallback(env, callback_after_eval=none_better, eval_freq=eval_freq, verbose=0)]

    first = callbacks(90, 100)
    make("replayed").learn(350, callback=[RunCheckpoint(tmp_path, EVERY), *first])
    (evaluation,) = callbacks(30, 200)
    seen = {}

    class Looks(RunCheckpoint):
        def _on_training_start(self):
            super()._on_training_start()
            seen.update(calls=evaluation.n_calls, best=evaluation.best_mean_reward, none=evaluation.callback.n_calls)

    model, callback = resume(tmp_path, Replayable(OwnBit()))
    callback.__class__ = Looks
    Looks.__name__ = "RunCheckpoint"
    model.learn(60, callback=[callback, evaluation], reset_num_timesteps=False)
    assert seen == {"calls": 300, "best": first[0].best_mean_reward, "none": 3}
    assert (evaluation.eval_freq, evaluation.callback.max_no_improvement_evals) == (30, 200)
    assert evaluation.evaluations_timesteps == []
    assert evaluation.callback.n_calls == 5, "evaluated at 330 and 360"


class Decays(BaseCallback):
    """Changes its argument during training."""

    def __init__(self, rate: float, factor: float = 1.0):
        super().__init__()
        self.rate, self.factor, self.began_at = rate, factor, -1

    def _init_callback(self) -> None:
        self.began_at = self.model.num_timesteps

    def _on_step(self) -> bool:
        self.rate -= 2**-10
        return True


def test_an_argument_that_the_training_changed_is_restored_and_another_value_is_named(tmp_path):
    make("replayed").learn(250, callback=[Decays(1.0), RunCheckpoint(tmp_path, EVERY)])

    def resumed(*arguments: float) -> Decays:
        model, callback = resume(tmp_path, Replayable(OwnBit()))
        model.learn(1, callback=[decays := Decays(*arguments), callback], reset_num_timesteps=False)
        return decays

    after = 1.0 - 210 / 2**10  # the rollout of an episode
    decays = resumed(1.0)
    assert (decays.rate, decays.began_at) == (after, 0)
    decays = resumed(1.0, 3.0)
    assert (decays.rate, decays.factor) == (after, 3.0)
    with pytest.warns(UserWarning, match=r"Decays: rate=2\.0 has no effect. The run began with 1\.0, .*: 0\.80"):
        assert resumed(2.0).rate == after


class Best(BaseCallback):
    """A callback of somebody else's that keeps its state in objects, and tells it."""

    def __init__(self, limit: int = 9):
        super().__init__()
        self.limit, self.seen, self.loaded = limit, {3, 1}, False

    def _on_step(self) -> bool:
        self.seen.add(int(self.num_timesteps))
        self.limit += 1
        return True

    def state_dict(self) -> dict:
        return {"seen": np.array(sorted(self.seen)), "note": ["x", None, 0.5]}

    def load_state_dict(self, state: dict) -> None:
        if state["note"] != ["x", None, 0.5]:
            raise ValueError("no note")
        self.seen, self.loaded = set(state["seen"].tolist()), True


def test_a_callback_that_tells_its_state_decides_what_is_kept(tmp_path):
    make("replayed").learn(250, callback=[first := Best(), RunCheckpoint(tmp_path, EVERY, keep=1)])
    assert first.limit > 200
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    steps = model.num_timesteps
    model.learn(1, callback=[best := Best(), callback], reset_num_timesteps=False)
    assert best.loaded
    assert best.seen == {3, 1, *range(1, steps + 11)}, "it went on for one episode"
    assert (best.n_calls, best.limit) == (steps + 10, 19), "only what it tells is kept, and its calls"

    class Silent(BaseCallback):
        def _on_step(self) -> bool:
            return True

    Silent.__name__ = "Best"
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    with pytest.raises(ValueError, match=r"The run's Best had state_dict\(\) and load_state_dict\(\), but now"):
        model.learn(1, callback=[Silent(), callback], reset_num_timesteps=False)
    edit(tmp_path, lambda state: state["callbacks"][0]["values"]["state_dict"].update(note=1))
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    with pytest.raises(ValueError, match="no note"):
        model.learn(1, callback=[Best(), callback], reset_num_timesteps=False)


@pytest.mark.parametrize("told", [[1], {"seen": {1, 2}}, {"model": object()}])
def test_a_state_that_cannot_be_written_is_refused_by_name(told, tmp_path, monkeypatch):
    monkeypatch.setattr(Best, "state_dict", lambda self: told)
    with pytest.raises(ValueError, match=r"Best\.state_dict\(\)"):
        make("replayed").learn(250, callback=[Best(), RunCheckpoint(tmp_path, EVERY)])


def test_a_callback_that_tells_its_state_reads_the_attributes_in_earlier_checkpoints(tmp_path):
    make("replayed").learn(250, callback=[Best(), RunCheckpoint(tmp_path, EVERY, keep=1)])
    before = {"n_calls": 200, "num_timesteps": 200, "verbose": 0, "limit": 209, "loaded": False}
    edit(tmp_path, lambda state: state["callbacks"][0].update(values=before, at_start={**before, "limit": 9}))
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    model.learn(1, callback=[best := Best(), callback], reset_num_timesteps=False)
    assert (best.n_calls, best.limit, best.loaded) == (210, 219, False)


# What begins anew in every process, or with every evaluation
OBJECTS = {"eval_env", "callback", "callback_on_new_best", "model", "parent", "pbar"}


PASSING = {"model", "parent", "locals", "globals", "num_timesteps", "pbar", "_is_success_buffer"}
PASSING |= {"_total_max_episodes", "n_levels"}  # follow from arguments and the environment
PASSING |= {"_tallies", "_episodes"}  # of one evaluation


@pytest.mark.slow
def test_the_table_of_callbacks_holds_all_that_training_changes_in_them(tmp_path):
    env = DummyVecEnv([lambda: Monitor(curriculum())])
    evaluation = EvalCallback(
        env,
        StopTrainingOnRewardThreshold(1e9),
        StopTrainingOnNoModelImprovement(100),
        eval_freq=90,
        log_path=str(tmp_path),
        verbose=0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bar = ProgressBarCallback()
    given = [
        evaluation,
        TeamEvalCallback(DummyVecEnv([lambda: Monitor(curriculum())]), "robot_0", eval_freq=90, verbose=0),
        EveryNTimesteps(90, CheckpointCallback(1, str(tmp_path / "models"))),
        LogEveryNTimesteps(70),
        StopTrainingOnMaxEpisodes(10**6),
        EventCallback(MetricsCallback()),
        DashboardCallback(),
        CurriculumCallback(1.0, 50),
        bar,
    ]
    every = [one for callback in given for one in state.callbacks_in(callback)]
    assert {type(one) for one in every} == set(state.KEPT), "each is tried here"
    known = {one for one in vars(sb3_callbacks).values() if isinstance(one, type) and issubclass(one, BaseCallback)}
    assert known - set(state.KEPT) == {BaseCallback, CallbackList}
    before = [deepcopy({k: v for k, v in vars(callback).items() if k not in OBJECTS}) for callback in every]
    make("one swarm").learn(250, callback=given)
    changed = set()
    for callback, values in zip(every, before, strict=True):
        kept = {"n_calls", *state.KEPT[type(callback)]}
        differ = {name for name, value in vars(callback).items() if name not in OBJECTS and value != values.get(name)}
        assert differ <= kept | PASSING, type(callback)
        changed |= {(type(callback), name) for name in differ & kept}
    assert (StopTrainingOnMaxEpisodes, "n_episodes") in changed
    assert (EvalCallback, "best_mean_reward") in changed
    assert (TeamEvalCallback, "best_value") in changed


def test_the_window_of_a_curriculum_is_the_one_passed_now(tmp_path):
    make("one swarm").learn(250, callback=[RunCheckpoint(tmp_path, EVERY), CurriculumCallback(1.0, 50)])
    model, callback = resume(tmp_path, RUNS["one swarm"][0]())
    model.learn(1, callback=[callback, curriculum := CurriculumCallback(0.5, 3)], reset_num_timesteps=False)
    assert (curriculum.success_threshold, curriculum.successes.maxlen) == (0.5, 3)


@pytest.mark.slow
def test_checkpoints_without_the_values_at_the_start_are_read(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1), StopTrainingOnMaxEpisodes(90)])

    def as_before(state: dict) -> None:
        for one in state["callbacks"]:
            del one["at_start"]
        values = {"n_calls": 100, "num_timesteps": 100, "verbose": 0}
        state["callbacks"].insert(0, {"class": "CallbackList", "values": values, "eval_env": None})

    edit(tmp_path, as_before)
    model = go_on("replayed", tmp_path, [stop := StopTrainingOnMaxEpisodes(90)])
    assert (model.num_timesteps, stop.n_episodes) == (STEPS, 64)


@pytest.mark.parametrize("value", [None, 1, {"$": "array", "dtype": "f4", "shape": [1], "base64": "AAAAAA=="}])
def test_last_observations_that_do_not_fit_the_environment_are_refused(value, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, lambda state: state["last"].update(_last_obs=value))
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    with pytest.raises(ValueError, match="A checkpoint is damaged: its _last_obs is"):
        model.learn(100, [callback], reset_num_timesteps=False)


def test_normalised_observations_need_the_original_ones(tmp_path):
    make("normalized").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, lambda state: state["last"].update(_last_original_obs=None))
    model, callback = resume(tmp_path, normalized())
    with pytest.raises(ValueError, match="A checkpoint is damaged: its _last_original_obs is None"):
        model.learn(100, [callback], reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reset_infos", [1, 2]),
        ("reset_infos", []),
        ("_seeds", [None]),
        ("_options", [{}]),
        ("returns", {"$": "array", "dtype": "f8", "shape": [3], "base64": "AAAAAAAAAAA=", "repeated": True}),
        ("training", 1),
    ],
)
def test_values_of_a_vectorised_environment_fit_its_copies(name, value, tmp_path):
    make("normalized").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])

    def change(state):
        owner = state["env"] if name in state["env"]["values"] else state["env"]["inner"]
        assert name in owner["values"]
        owner["values"][name] = value

    edit(tmp_path, change)
    model, callback = resume(tmp_path, normalized())
    with pytest.raises(ValueError, match=f"cannot be the {name} of a"):
        model.learn(100, [callback], reset_num_timesteps=False)
