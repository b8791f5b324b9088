"""When checkpoints are written, and what signals and full disks do."""

import errno
import json
import os
import signal

import pytest
from resumed import EVERY, STEPS, Killed, go_on, make
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_maddpg.checkpoints import callback
from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.commit import newest
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.checkpoints.state import digest
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.states import Replayable
from studies.commit_points import interrupt


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

    monkeypatch.setattr(callback, "_end_by", end)
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


@pytest.mark.slow
@pytest.mark.parametrize("bare", ["first", "now"])
def test_a_list_of_one_callback_is_the_same_as_the_callback(bare, tmp_path):
    checkpoint = RunCheckpoint(tmp_path, EVERY)
    make("replayed").learn(250, callback=checkpoint if bare == "first" else [checkpoint])
    model, callback = resume(tmp_path, Replayable(OwnBit()))
    given = CallbackList([CallbackList([callback])]) if bare == "first" else callback
    model.learn(STEPS - model.num_timesteps, callback=given, reset_num_timesteps=False)
    assert digest(model) == digest(make("replayed").learn(STEPS))


@pytest.mark.parametrize(("seconds", "expected"), [(0.01, 66), (3.0, 10), (60.0, 0)])
def test_checkpoints_take_no_more_than_their_share(seconds, expected, tmp_path, monkeypatch):
    now = [1000.0]

    def begin() -> None:
        now[0] += seconds
        checkpoint.cost += seconds
        checkpoint.saved_at, checkpoint._ended = checkpoint.model.num_timesteps, now[0]

    monkeypatch.setattr(callback.time, "monotonic", lambda: now[0])
    checkpoint = RunCheckpoint(tmp_path)
    checkpoint.init_callback(make("replayed").learn(1))
    checkpoint.on_training_start({}, {})
    monkeypatch.setattr(checkpoint, "_bytes_to_write", lambda: int(seconds * callback._BYTES_PER_SECOND))
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


@pytest.mark.slow
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
