"""Checkpoints: a run that is killed at any moment goes on bit for bit."""

import errno
import importlib
import importlib.metadata
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import warnings
from copy import deepcopy
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch as th
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
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from quad_swarm import QuadSwarmParallelEnv
from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer, SafeVecNormalize, TeamEnv
from sb3_maddpg.checkpoints import checkpoints
from sb3_maddpg.checkpoints.checkpoints import RunCheckpoint, digest, locked, newest, resume
from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.utils import sources_of
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.states import Replayable
from studies.commit_points import POINTS, interrupt

SETTINGS = {"learning_starts": 60, "batch_size": 16, "seed": 0}
SWARM = {"preset": "flight", "n_robots": 3, "max_steps": 20}
PAIRS = {**SWARM, "observation": "state+memory+plan+told+mask+critic"}


def swarms():
    return VecMonitor(GymnasiumVecEnv(gymnasium.make_vec("QuadSwarm-v0", num_envs=4, **PAIRS)))


def curriculum():
    return gymnasium.make("QuadSwarm-v0", n_robots=2, max_steps=60, scenario="curriculum", end_at_arrival=True)


def parallel():
    return TeamEnv(QuadSwarmParallelEnv(**SWARM))


def normalized():
    return SafeVecNormalize(DummyVecEnv([lambda: Monitor(Replayable(OwnBit()))] * 2))


RUNS = {
    "swarms": (
        swarms,
        "PairPolicy",
        {"replay_buffer_class": PrioritizedTeamReplayBuffer, "n_steps": 3, "train_freq": 1},
    ),
    "one swarm": (curriculum, "MlpPolicy", {"train_freq": 7}),
    "PettingZoo": (parallel, "MlpPolicy", {"train_freq": 5}),
    "replayed": (lambda: Replayable(OwnBit()), "MlpPolicy", {"train_freq": (1, "episode")}),
    "normalized": (normalized, "MlpPolicy", {"train_freq": 2}),
    "memory": (
        lambda: Replayable(OwnBit()),
        "MlpPolicy",
        {
            "train_freq": 3,
            "optimize_memory_usage": True,
            "replay_buffer_kwargs": {"handle_timeout_termination": False},
        },
    ),
}
STEPS, EVERY = 640, 100


class Killed(BaseException):
    """Nothing catches it, as nothing catches a kill."""


def make(name: str, **kwargs) -> MADDPG:
    env, policy, settings = RUNS[name]
    if policy == "PairPolicy":
        settings = {**settings, "policy_kwargs": {"pair_credit": True}}
    return MADDPG(policy, env(), **{**SETTINGS, "buffer_size": 300, **settings, **kwargs})


def evaluated(folder: Path) -> list[BaseCallback]:
    env = DummyVecEnv([lambda: Monitor(Replayable(OwnBit()))])
    env.seed(0)
    evaluation = EvalCallback(env, eval_freq=90, log_path=str(folder), verbose=0)
    return [RunCheckpoint(folder / "checkpoints", EVERY), evaluation]


def go_on(name: str, folder: Path, others: list[BaseCallback] = []) -> MADDPG:  # noqa: B006 - never changed
    found = resume(folder, RUNS[name][0]())
    assert found is not None
    model, callback = found
    np.random.seed(5)  # noqa: NPY002 - whatever was drawn meanwhile
    th.manual_seed(5)
    return model.learn(STEPS - model.num_timesteps, callback=[callback, *others], reset_num_timesteps=False)


def kill_at(monkeypatch, point: str, times: int) -> None:
    """Kill when a point of writing is reached for so many times."""
    left = [times]

    def fault(name: str) -> None:
        left[0] -= name == point
        if not left[0]:
            left[0] = -1
            raise Killed

    interrupt(fault, monkeypatch.setattr)


@pytest.mark.parametrize("name", RUNS)
def test_a_resumed_run_ends_as_the_uninterrupted_one(name, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "_BLOCK", 5000)  # several blocks in each segment
    expected = digest(make(name).learn(STEPS, callback=[RunCheckpoint(tmp_path / "a", EVERY)]))
    assert expected == digest(make(name).learn(STEPS)), "checkpoints change nothing"
    kill_at(monkeypatch, "committed", 3)
    with pytest.raises(Killed):
        make(name).learn(STEPS, callback=[RunCheckpoint(tmp_path / "b", EVERY)])
    kill_at(monkeypatch, "committed", 2)
    with pytest.raises(Killed):
        go_on(name, tmp_path / "b")
    assert digest(go_on(name, tmp_path / "b")) == expected


class Sends(BaseCallback):
    """Sends this process a signal at a step, and again at a later one."""

    def __init__(self, *steps: int):
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        if self.num_timesteps in self.steps:
            signal.raise_signal(signal.SIGTERM)
        return True


@pytest.mark.parametrize(("steps", "ended_at"), [((120,), 150), ((120, 130), 130), ((620,), None)])
def test_a_signal_ends_the_run_after_the_rollout_and_a_second_one_at_once(steps, ended_at, tmp_path, monkeypatch):
    def end(number: int) -> None:
        assert number == signal.SIGTERM
        raise Killed

    monkeypatch.setattr(checkpoints, "_end_by", end)
    model = make("replayed", train_freq=50)
    if ended_at is None:  # in the last rollout
        model.learn(STEPS, callback=[Sends(*steps), RunCheckpoint(tmp_path, STEPS)])
        assert model.num_timesteps == 650
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(Killed):
            model.learn(STEPS, callback=[Sends(*steps), RunCheckpoint(tmp_path, STEPS)])
    finally:
        signal.signal(signal.SIGTERM, before)
    assert model.num_timesteps == ended_at
    path = newest(tmp_path)
    assert (path.name if path else None) == ("checkpoint-000000000150" if len(steps) == 1 else None)


@pytest.mark.parametrize("point", POINTS)
def test_a_kill_at_any_moment_of_a_commit_loses_nothing_but_that_checkpoint(point, tmp_path, monkeypatch):
    expected = digest(make("replayed").learn(STEPS))
    kill_at(monkeypatch, point, 3)
    with pytest.raises(Killed):
        make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    path = newest(tmp_path)
    assert path is not None
    assert int(path.name.rpartition("-")[2]) in (2 * EVERY, 3 * EVERY)
    assert digest(go_on("replayed", tmp_path)) == expected
    assert not list(tmp_path.glob("*.unfinished"))
    assert len(list(tmp_path.glob("checkpoint-*"))) == 2


def test_without_the_checkpoint_s_state_a_run_ends_otherwise(tmp_path, monkeypatch):
    expected = digest(make("replayed").learn(STEPS))
    kill_at(monkeypatch, "committed", 3)
    with pytest.raises(Killed):
        make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    monkeypatch.setattr(checkpoints, "_set_random_state", lambda state: None)
    assert digest(go_on("replayed", tmp_path)) != expected


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


def test_a_run_that_a_callback_ended_goes_on_with_another_argument(tmp_path):
    ended = make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, 50), StopTrainingOnMaxEpisodes(25)])
    assert ended.num_timesteps == 250
    model = go_on("replayed", tmp_path, [stop := StopTrainingOnMaxEpisodes(40)])
    assert model.num_timesteps == 400, "the episodes before are counted"
    assert (stop.max_episodes, stop._total_max_episodes, stop.n_episodes) == (40, 40, 40)
    assert digest(model) == digest(make("replayed").learn(STEPS, callback=StopTrainingOnMaxEpisodes(40)))
    model = go_on("replayed", tmp_path, [stop := StopTrainingOnMaxEpisodes(50)])
    assert (model.num_timesteps, stop.n_episodes) == (500, 50), "also after a second resumption"


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
        EveryNTimesteps(90, CheckpointCallback(1, str(tmp_path / "models"))),
        LogEveryNTimesteps(70),
        StopTrainingOnMaxEpisodes(10**6),
        EventCallback(MetricsCallback()),
        DashboardCallback(),
        CurriculumCallback(1.0, 50),
        bar,
    ]
    every = [one for callback in given for one in checkpoints._callbacks(callback)]
    assert {type(one) for one in every} == set(checkpoints._KEPT), "each is tried here"
    known = {one for one in vars(sb3_callbacks).values() if isinstance(one, type) and issubclass(one, BaseCallback)}
    assert known - set(checkpoints._KEPT) == {BaseCallback, CallbackList}
    before = [deepcopy({k: v for k, v in vars(callback).items() if k not in OBJECTS}) for callback in every]
    make("one swarm").learn(250, callback=given)
    changed = set()
    for callback, values in zip(every, before, strict=True):
        kept = {"n_calls", *checkpoints._KEPT[type(callback)]}
        differ = {name for name, value in vars(callback).items() if name not in OBJECTS and value != values.get(name)}
        assert differ <= kept | PASSING, type(callback)
        changed |= {(type(callback), name) for name in differ & kept}
    assert (StopTrainingOnMaxEpisodes, "n_episodes") in changed
    assert (EvalCallback, "best_mean_reward") in changed


def test_the_window_of_a_curriculum_is_the_one_passed_now(tmp_path):
    make("one swarm").learn(250, callback=[RunCheckpoint(tmp_path, EVERY), CurriculumCallback(1.0, 50)])
    model, callback = resume(tmp_path, RUNS["one swarm"][0]())
    model.learn(1, callback=[callback, curriculum := CurriculumCallback(0.5, 3)], reset_num_timesteps=False)
    assert (curriculum.success_threshold, curriculum.successes.maxlen) == (0.5, 3)


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


@pytest.mark.parametrize("bare", ["first", "now"])
def test_a_list_of_one_callback_is_the_same_as_the_callback(bare, tmp_path):
    checkpoint = RunCheckpoint(tmp_path, EVERY)
    make("replayed").learn(250, callback=checkpoint if bare == "first" else [checkpoint])
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    given = CallbackList([CallbackList([callback])]) if bare == "first" else callback
    model.learn(STEPS - model.num_timesteps, callback=given, reset_num_timesteps=False)
    assert digest(model) == digest(make("replayed").learn(STEPS))


def test_only_new_transitions_are_written(tmp_path):
    make("replayed", buffer_size=500).learn(400, callback=[RunCheckpoint(tmp_path, EVERY)])
    sizes = [path.stat().st_size for path in sorted((tmp_path / "segments").iterdir())]
    assert len(sizes) == 3
    row = sizes[0] // 100
    assert all(abs(size / row - EVERY) < 8 for size in sizes)
    make("replayed", buffer_size=150).learn(STEPS, callback=[RunCheckpoint(tmp_path / "ring", EVERY)])
    assert len(list((tmp_path / "ring" / "segments").iterdir())) <= 4, "what the ring has overwritten is removed"


@pytest.mark.parametrize("name", ["swarms", "memory", "replayed"])
def test_a_slow_disk_does_not_change_a_checkpoint(name, tmp_path, monkeypatch):
    """The training overwrites all rows of the buffer while the thread writes."""
    expected = digest(make(name, buffer_size=100).learn(STEPS))
    monkeypatch.setattr(checkpoints, "_BLOCK", 1000)
    waited = []
    blocks, wait = checkpoints._stored_block, checkpoints._Writer.wait_for

    def slowly(*args):
        time.sleep(0.01)
        return blocks(*args)

    monkeypatch.setattr(checkpoints, "_stored_block", slowly)
    monkeypatch.setattr(checkpoints._Writer, "wait_for", lambda self, row: waited.append(row) or wait(self, row))
    kill_at(monkeypatch, "committed", 3)
    with pytest.raises(Killed):
        make(name, buffer_size=100).learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    assert waited, "the training would have overwritten rows that were not yet written"
    assert digest(go_on(name, tmp_path)) == expected


def test_observations_are_written_once(tmp_path):
    model = make("swarms")
    model.learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    record = model.replay_buffer.records.dtype
    for path in (tmp_path / "segments").iterdir():
        first, end = map(int, path.stem.split("-"))
        rows = (end - first) * model.n_envs
        assert path.stat().st_size < rows * (record.itemsize - 0.8 * record["next_observations"].itemsize)


@pytest.mark.parametrize(("seconds", "expected"), [(0.01, 66), (3.0, 10), (60.0, 0)])
def test_checkpoints_take_no_more_than_their_share(seconds, expected, tmp_path, monkeypatch):
    now = [1000.0]

    def begin() -> None:
        now[0] += seconds
        checkpoint.cost += seconds
        checkpoint.saved_at, checkpoint._ended = checkpoint.model.num_timesteps, now[0]

    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])
    checkpoint = RunCheckpoint(tmp_path)
    checkpoint.init_callback(make("replayed").learn(1))
    checkpoint.on_training_start({}, {})
    monkeypatch.setattr(checkpoint, "_bytes_to_write", lambda: int(seconds * checkpoints._BYTES_PER_SECOND))
    monkeypatch.setattr(checkpoint, "_begin", begin)
    steps = []
    while now[0] < 3000.0:
        checkpoint.model.num_timesteps += 1
        now[0] += 1.0
        checkpoint.on_rollout_start()
        if checkpoint.saved_at == checkpoint.model.num_timesteps:
            steps.append(checkpoint.saved_at)
            assert checkpoint.cost <= 0.02 * (now[0] - 1000.0)
    assert len(steps) == expected


@pytest.mark.parametrize("damage", ["truncated", "flipped", "missing", "segment"])
def test_a_damaged_checkpoint_is_passed_over(damage, tmp_path):
    make("replayed").learn(350, callback=[RunCheckpoint(tmp_path, EVERY)])
    last = newest(tmp_path)
    path = last / "arrays.npz"
    if damage == "segment":
        path = max((tmp_path / "segments").iterdir())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2] if damage == "truncated" else content)
    with pytest.warns(UserWarning, match="is skipped: .*"):
        before = newest(tmp_path)
    assert before is not None
    assert before < last


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.ENOSPC, "No space left for a checkpoint at step .*: the previous one stays"),
        (errno.EDQUOT, "No space left for a checkpoint at step .*: the previous one stays"),
        (errno.EIO, "No checkpoint at step .*: the previous one stays.*check the disk"),
        (errno.EFBIG, "No checkpoint at step .*: the previous one stays.*raise the limit of file sizes"),
    ],
)
def test_a_full_disk_keeps_the_last_checkpoint(tmp_path, monkeypatch, number, told):
    expected = digest(make("replayed").learn(STEPS))

    def full(point: str) -> None:
        if point == "written model.zip" and len(list(tmp_path.glob("checkpoint-*"))) > 2:
            raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        interrupt(full, patched.setattr)
        with pytest.warns(UserWarning, match=told):
            model = make("replayed").learn(STEPS, callback=[RunCheckpoint(tmp_path, EVERY)])
    assert digest(model) == expected, "the training goes on"
    assert not list(tmp_path.glob("*.unfinished"))
    states = [json.loads((path / "state.json").read_text()) for path in tmp_path.glob("checkpoint-*")]
    needed = {one["name"] for state in states for one in state["segments"]}
    assert {path.name for path in (tmp_path / "segments").iterdir()} == needed
    assert digest(go_on("replayed", tmp_path)) == expected


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


def test_another_machine_is_named(tmp_path, monkeypatch):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    monkeypatch.setattr(checkpoints, "fingerprint", lambda env: {"torch": "3.0"})
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


def edit(folder: Path, change) -> None:
    """Change the state in the newest checkpoint, as somebody could who also knows its checksums."""
    (path,) = list(folder.glob("checkpoint-*"))[-1:]
    state = json.loads((path / "state.json").read_text())
    change(state)
    (path / "state.json").write_text(json.dumps(state))
    (path / "manifest.json").write_text("{}")


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


def test_a_segment_counts_once(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, lambda state: state["segments"].extend(state["segments"][:1] * 40))
    with pytest.warns(UserWarning, match="is skipped: it names a segment twice"):
        assert newest(tmp_path) is None


def test_other_names_than_numbers_are_no_checkpoints(tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY)])
    expected = newest(tmp_path)
    for name in ("checkpoint-²", "checkpoint-", "checkpoint-1e9", "checkpoint-+1", "checkpoint-٣x"):
        (tmp_path / name).mkdir()
    assert newest(tmp_path) == expected


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


@pytest.mark.parametrize("name", ["/dev/zero", "../" * 20 + "dev/zero", "..", "segments"])
@pytest.mark.parametrize("where", ["manifest", "segment"])
def test_a_checkpoint_names_files_in_its_folder_only(where, name, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    if where == "segment":
        edit(tmp_path, lambda state: state["segments"][0].update(name=name))
    else:
        (newest(tmp_path) / "manifest.json").write_text(json.dumps({name: "x"}))
    with pytest.warns(UserWarning, match=r"is skipped: InvalidFileError: there is no file .* in"):
        assert newest(tmp_path) is None


@pytest.mark.parametrize("rows", [{"end": 10**12}, {"first": 90, "end": 90}, {"end": 251}, {"first": "0"}])
def test_a_segment_holds_the_rows_that_it_claims(rows, tmp_path):
    make("replayed").learn(250, callback=[RunCheckpoint(tmp_path, EVERY, keep=1)])
    edit(tmp_path, lambda state: state["segments"][0].update(rows))
    with pytest.raises(ValueError, match=r"does not hold the rows|but rows from|its segments end"):
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


def test_two_processes_do_not_write_into_one_folder(tmp_path):
    program = textwrap.dedent("""
        import sys
        from sb3_maddpg.checkpoints import locked
        with locked(sys.argv[1]):
            print("locked", flush=True)
            sys.stdin.read()
    """)
    other = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "locked\n"
    with pytest.raises(ValueError, match=f"is in use by process {other.pid} on "), locked(tmp_path):
        pass
    other.kill()
    other.wait()
    with locked(tmp_path):
        assert "process" in (tmp_path / "lock").read_text()
