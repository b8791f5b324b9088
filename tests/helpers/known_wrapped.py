"""
Wrappers around the known team: what is stored must be what the outermost environment means, as a recorder there saw it.
"""

import contextlib
import random
from collections.abc import Callable, Iterator
from copy import deepcopy
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import supersuit
from cases import Case, Silent
from gymnasium import spaces, wrappers
from known import LENGTH, NAMES, Giver, Known, KnownParallel, row, train
from pettingzoo import ParallelEnv
from pettingzoo.utils import wrappers as pettingzoo_wrappers
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_maddpg import MADDPG, TeamEnv

BOX = spaces.Box(-2, 2, (2,))


class KnownActs(Known):
    """The known team, which keeps what it received: numbers of episode and step, and the action."""

    def __init__(self, parts: bool = True, action_space: spaces.Space = Known.action_space):
        super().__init__(Giver("", lambda value: value), parts=parts)
        self.action_space, self.received = action_space, []

    def step(self, action):
        self.received.append((self.episode, self.time + 1, np.array(action)))
        return super().step(action)


class DifferentActs(KnownParallel):
    """The known team, whose agents act in different spaces, in PettingZoo."""

    def __init__(self):
        super().__init__(Giver("", lambda value: value))
        self.received = []

    def action_space(self, agent):
        return self.spaces[agent]

    spaces = {"ann": spaces.Box(-1, 3, (2,)), "bob": spaces.Box(0, 9, (1,))}  # noqa: RUF012

    def step(self, actions):
        self.received.append((self.episode, self.time + 1, deepcopy(actions)))
        return super().step(actions)


class Recorder(gymnasium.Wrapper):
    """Keeps copies of what an environment is sent and returns."""

    log: list[tuple]

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.log = []

    def reset(self, **kwargs):
        returned = self.env.reset(**kwargs)
        self.obs = np.array(returned[0])
        return returned

    def step(self, action):
        sent = np.array(action)
        returned = self.env.step(action)
        if len(returned) != 5:
            return returned
        obs, reward, terminated, truncated, info = deepcopy(returned)
        cut = bool(truncated and not terminated)
        self.log.append((self.obs, sent, np.array(obs), float(reward), bool(terminated or truncated), cut, info))
        self.obs = np.array(obs)
        return returned


def check_log(model: MADDPG, log: list[tuple], received: list[tuple] = (), env: int = 0) -> None:  # type: ignore[assignment]
    """
    :param model: a model after training
    :param log: of a recorder
    :param received: what the innermost environment received, if that is known
    :param env: index of the environment
    :raises Silent: if what is stored is not what was recorded, or does not fit together
    """
    kept = model.replay_buffer
    if not kept.size():
        raise Silent("nothing is stored")
    for k, (obs, action, after, reward, done, cut, info) in zip(range(kept.size()), log, strict=False):
        scaled = model.policy.actions.scale(action[None].astype(float))[0]
        rewards = np.broadcast_to(np.asarray(info.get("agent_rewards", reward), float), 2)
        for name, found, right in (
            ("observation", kept.observations, obs), ("next observation", kept.next_observations, after),
            ("reward", kept.rewards, reward), ("action", kept.actions, scaled), ("done", kept.dones, done),
            ("timeout", kept.timeouts, cut), ("agents' rewards", kept.agent_rewards, rewards),
        ):  # fmt: skip
            if name == "next observation" and done and not cut and "terminal_observation" not in info:
                continue  # nothing bootstraps from it
            if not np.allclose(found[k, env], right, atol=1e-5):
                raise Silent(f"{name} {k} is {found[k, env].tolist()}, but the environment meant {right}")
        # Whoever changes the team's reward alone does not mean it, unless it says so
        own = [row(*step[:2]).agent_rewards for step in received[k : k + 1]]
        alone = own and np.array_equal(own[0], rewards) and info.get("team_reward") != reward
        if alone and abs(rewards.mean() - reward) > 1e-5:
            raise Silent(f"agents' rewards {k} are {rewards}, the team's {reward}")
        if cut and (kept.agent_terminated[k, env] > 0).all():
            raise Silent(f"the team is cut in transition {k}, where all agents terminate")
    of_step = [info.get("inner_step", info.get("episode_step")) for *_, info in log]
    if any(a is not None and b not in (a + 1, 1, 2) for a, b in pairwise(of_step)):
        raise Silent(f"steps are lost: {of_step}")


def _run(make: Callable[[], gymnasium.Env], wrap: Callable[[gymnasium.Env], gymnasium.Env], how: str = "dummy") -> None:
    inner = make()
    recorder = Recorder(wrap(inner))
    model = train({"dummy": lambda: recorder, "vector": lambda: DummyVecEnv([lambda: Monitor(recorder)])}[how]())
    base = inner.unwrapped
    received = base.parallel_env.unwrapped.received if isinstance(base, TeamEnv) else base.received
    check_log(model, recorder.log, received)


class Changed(gymnasium.Wrapper):
    """
    A user's own wrapper.

    :param change: maps the step's number in the episode and what ``step`` returned, as a list, to what it returns
    """

    def __init__(self, env: gymnasium.Env, change: Callable[[int, list], Any]):
        super().__init__(env)
        self.change = change

    def reset(self, **kwargs):
        self.time = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        self.time += 1
        returned = list(self.env.step(action))
        return tuple(self.change(self.time, returned) or returned)


def _put(index: int, value: Any, when: Callable[[int, list], bool] = lambda time, returned: True) -> Callable:
    def change(time: int, returned: list) -> None:
        if when(time, returned):
            returned[index] = value(returned) if callable(value) else value

    return change


def _info(**entries: Any) -> Callable[[list], dict]:
    return lambda returned: {**returned[4], **{k: v(returned[4]) if callable(v) else v for k, v in entries.items()}}


CHANGES: dict[str, Callable[[int, list], Any]] = {
    "nothing": lambda time, returned: None,
    "reward less 5": _put(1, lambda r: r[1] - 5),
    "reward of the last step": _put(1, lambda r: r[1] + 100, lambda time, r: r[2] or r[3]),
    "reward twice": _put(1, lambda r: r[1] * 2),
    "reward 0": _put(1, 0.0),
    "reward and team_reward": lambda time, r: [r[0], r[1] + 1, r[2], r[3], {**r[4], "team_reward": r[1] + 1}],
    "rewards of all": lambda time, r: [r[0], r[1] + 1, r[2], r[3], {
        **r[4], "agent_rewards": r[4].get("agent_rewards", np.full(2, r[1])) + 1, "team_reward": r[1] + 1}],
    "agents' rewards": _put(4, _info(agent_rewards=lambda i: i.get("agent_rewards", np.zeros(2)) * 2)),
    "agents' rewards left out": _put(4, lambda r: {k: v for k, v in r[4].items() if k != "agent_rewards"}),
    "ends in step 3": _put(2, True, lambda time, r: time == 3),
    "cut in step 3": _put(3, True, lambda time, r: time == 3),
    "ends become cuts": lambda time, r: [r[0], r[1], False, r[2] or r[3], r[4]],
    "cuts become ends": lambda time, r: [r[0], r[1], r[2] or r[3], False, r[4]],
    "both at once": lambda time, r: [r[0], r[1], r[2] or r[3], r[2] or r[3], r[4]],
    "no end": lambda time, r: [r[0], r[1], False, False, r[4]],
    "observation + 1": _put(0, lambda r: r[0] + 1),
    "observation doubled": _put(0, lambda r: r[0] * 2),
    "observation in half precision": _put(0, lambda r: r[0].astype(np.float16)),
    "observation as a list": _put(0, lambda r: r[0].tolist()),
    "observation flat": _put(0, lambda r: r[0].ravel()),
    "observation turned": _put(0, lambda r: r[0].T),
    "observation NaN": _put(0, lambda r: r[0] * np.nan),
    "last observation left out": _put(0, None, lambda time, r: r[2] or r[3]),
    "last observation zero": _put(0, lambda r: r[0] * 0, lambda time, r: r[2] or r[3]),
    "empty info": _put(4, lambda r: {}),
    "info of strings": _put(4, lambda r: {k: str(v) for k, v in r[4].items()}),
    "info without the agents' ends": _put(4, lambda r: {k: v for k, v in r[4].items() if "term" not in k}),
    "agent_active all": _put(4, _info(agent_active=np.ones(2, bool))),
    "TimeLimit.truncated": _put(4, _info(**{"TimeLimit.truncated": True})),
    "terminal_observation": _put(4, _info(terminal_observation=np.zeros((2, 3)))),
    "final_observation": _put(4, _info(final_observation=np.zeros((2, 3)), final_info={})),
    "inner_reward": _put(4, _info(inner_reward=7.0)),
    "inner_step": _put(4, _info(inner_step=3)),
    "episode_step 1": _put(4, _info(episode_step=1)),
    "episode of another": _put(4, _info(episode={"r": 1, "l": 2, "t": 3.0})),
}  # fmt: skip


class Skips(gymnasium.Wrapper):
    """Repeats actions; ``how`` says what becomes of the rewards."""

    def __init__(self, env: gymnasium.Env, how: Callable[[list], float]):
        super().__init__(env)
        self.how = how

    def step(self, action):
        rewards = []
        for _ in range(2):
            obs, reward, terminated, truncated, info = self.env.step(action)
            rewards.append(reward)
            if terminated or truncated:
                break
        return obs, self.how(rewards), terminated, truncated, info


class ResetsItself(gymnasium.Wrapper):
    """Begins a new episode unnoticed: ``at`` a step, or where one ends if it is 0."""

    def __init__(self, env: gymnasium.Env, at: int):
        super().__init__(env)
        self.at, self.time = at, 0

    def step(self, action):
        self.time += 1
        obs, reward, terminated, truncated, info = self.env.step(action)
        if (self.at and self.time % self.at == 0) or (not self.at and (terminated or truncated)):
            obs, _ = self.env.reset()
            terminated = truncated = False
        return obs, reward, terminated, truncated, info


class NoopStart(gymnasium.Wrapper):
    """Makes a step in ``reset``, as Atari's wrappers do."""

    def reset(self, **kwargs):
        self.env.reset(**kwargs)
        obs, _, _, _, info = self.env.step(self.env.action_space.sample())
        return obs, info


class Keeps(gymnasium.Wrapper):
    """Returns one array always, into which it writes."""

    def reset(self, **kwargs):
        obs, info = self.env.reset(**kwargs)
        self.array = np.array(obs)
        return self.array, info

    def step(self, action):
        obs, *rest = self.env.step(action)
        self.array[...] = obs
        return self.array, *rest


class SpoilsActions(gymnasium.Wrapper):
    """Writes into the action that it got."""

    def step(self, action):
        returned = self.env.step(action)
        action[...] = 0
        return returned


GYMNASIUM: dict[str, Callable[[Any], gymnasium.Env]] = {
    **{name: lambda env, change=change: Changed(env, change) for name, change in CHANGES.items()},
    "skips, last reward": lambda env: Skips(env, lambda r: r[-1]),
    "skips, sum": lambda env: Skips(env, sum),
    "resets itself at the end": lambda env: ResetsItself(env, 0),
    "resets itself at 3": lambda env: ResetsItself(env, 3),
    "step in reset": NoopStart,
    "one array": Keeps,
    "writes into actions": SpoilsActions,
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda r: r / 10),
    "TransformReward to int": lambda env: wrappers.TransformReward(env, lambda r: int(r)),
    "ClipReward": lambda env: wrappers.ClipReward(env, -1, 1),
    "ClipReward too wide": lambda env: wrappers.ClipReward(env, -100, 100),
    "NormalizeReward": wrappers.NormalizeReward,
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda a: a, env.action_space),
    "TransformAction to ones": lambda env: wrappers.TransformAction(env, lambda a: a * 0 + 1, env.action_space),
    "RescaleAction": lambda env: wrappers.RescaleAction(env, -1, 1),
    "RescaleAction lopsided": lambda env: wrappers.RescaleAction(env, np.float32([-3, 0]), np.float32([1, 10])),
    "ClipAction": wrappers.ClipAction,
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, 3),
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, -1, 1),
    "FlattenObservation": wrappers.FlattenObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "FrameStackObservation of 1": lambda env: wrappers.FrameStackObservation(env, 1),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda o: o / 2, env.observation_space),
    "TransformObservation to more": lambda env: wrappers.TransformObservation(
        env, lambda o: np.concatenate([o, o], 1), spaces.Box(0, 60, (2, 6))),
    "TransformObservation to less": lambda env: wrappers.TransformObservation(
        env, lambda o: o[:, :2], spaces.Box(0, 60, (2, 2))),
    "TransformObservation to one agent": lambda env: wrappers.TransformObservation(
        env, lambda o: o[:1], spaces.Box(0, 60, (1, 3))),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float64),
    "DtypeObservation half": lambda env: wrappers.DtypeObservation(env, np.float16),
    "DtypeObservation uint8": lambda env: wrappers.DtypeObservation(env, np.uint8),
    "ReshapeObservation": lambda env: wrappers.ReshapeObservation(env, (3, 2)),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 1),
    "DelayObservation of 0": lambda env: wrappers.DelayObservation(env, 0),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 3),
    "TimeLimit at the end": lambda env: wrappers.TimeLimit(env, LENGTH),
    "TimeLimit of 1": lambda env: wrappers.TimeLimit(env, 1),
    "Autoreset": wrappers.Autoreset,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "Monitor": Monitor,
    "NumpyToTorch": wrappers.NumpyToTorch,
    "two TimeLimits": lambda env: wrappers.TimeLimit(wrappers.TimeLimit(env, 4), 2),
    "TimeLimit in TransformReward": lambda env: wrappers.TransformReward(wrappers.TimeLimit(env, 3), lambda r: r + 1),
}  # fmt: skip


class VecRecorder(VecEnvWrapper):
    """The same for vectorised environments."""

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self.log: list[tuple] = []

    def reset(self):
        self.obs = self.venv.reset()
        return self.obs

    def step_async(self, actions):
        self.actions = np.array(actions)
        self.venv.step_async(actions)

    def step_wait(self):
        obs, rewards, dones, infos = returned = self.venv.step_wait()
        with contextlib.suppress(Exception):  # the algorithm has to say what is wrong
            for k in range(self.num_envs):
                after = infos[k].get("terminal_observation", obs[k]) if dones[k] else obs[k]
                cut = bool(infos[k].get("TimeLimit.truncated", False)) and bool(dones[k])
                sent = (np.array(self.obs[k]), self.actions[k])
                self.log.append((*sent, np.array(after), float(rewards[k]), bool(dones[k]), cut, deepcopy(infos[k])))
        self.obs = obs
        return returned


class VecChanged(VecEnvWrapper):
    """A user's own wrapper of vectorised environments; ``change`` gets what ``step_wait`` returned, as a list."""

    def __init__(self, venv: VecEnv, change: Callable[[list], Any]):
        super().__init__(venv)
        self.change = change

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        returned = list(self.venv.step_wait())
        return tuple(self.change(returned) or returned)


def _without(*names: str) -> Callable[[list], Any]:
    return lambda r: [*r[:3], [{k: v for k, v in info.items() if k not in names} for info in r[3]]]


VECTOR: dict[str, Callable[[VecEnv], VecEnv]] = {
    "nothing": lambda venv: venv,
    "VecFrameStack": lambda venv: VecFrameStack(venv, 2),
    "VecFrameStack of 1": lambda venv: VecFrameStack(venv, 1),
    "VecMonitor": VecMonitor,
    "VecCheckNan": VecCheckNan,
    "VecMonitor twice": lambda venv: VecMonitor(VecMonitor(venv)),
    "reward less 5": lambda venv: VecChanged(venv, lambda r: [r[0], r[1] - 5, r[2], r[3]]),
    "reward to ints": lambda venv: VecChanged(venv, lambda r: [r[0], r[1].astype(int), r[2], r[3]]),
    "reward as a list": lambda venv: VecChanged(venv, lambda r: [r[0], r[1].tolist(), r[2], r[3]]),
    "rewards (n, 1)": lambda venv: VecChanged(venv, lambda r: [r[0], r[1][:, None], r[2], r[3]]),
    "observations twice": lambda venv: VecChanged(venv, lambda r: [r[0] * 2, *r[1:]]),
    "observations as lists": lambda venv: VecChanged(venv, lambda r: [r[0].tolist(), *r[1:]]),
    "observations NaN": lambda venv: VecChanged(venv, lambda r: [r[0] * np.nan, *r[1:]]),
    "no dones": lambda venv: VecChanged(venv, lambda r: [r[0], r[1], r[2] & False, r[3]]),
    "all dones": lambda venv: VecChanged(venv, lambda r: [r[0], r[1], r[2] | True, r[3]]),
    "dones as ints": lambda venv: VecChanged(venv, lambda r: [r[0], r[1], r[2].astype(int), r[3]]),
    "dones as halves": lambda venv: VecChanged(venv, lambda r: [r[0], r[1], r[2] * 0.5, r[3]]),
    "dones as a list": lambda venv: VecChanged(venv, lambda r: [r[0], r[1], r[2].tolist(), r[3]]),
    "no terminal observation": lambda venv: VecChanged(venv, _without("terminal_observation")),
    "no TimeLimit.truncated": lambda venv: VecChanged(venv, _without("TimeLimit.truncated")),
    "no agents' rewards": lambda venv: VecChanged(venv, _without("agent_rewards")),
    "no infos": lambda venv: VecChanged(venv, lambda r: [*r[:3], [{} for _ in r[3]]]),
    "infos as a tuple": lambda venv: VecChanged(venv, lambda r: [*r[:3], tuple(r[3])]),
    "one info less": lambda venv: VecChanged(venv, lambda r: [*r[:3], r[3][:-1]]),
    "infos None": lambda venv: VecChanged(venv, lambda r: [*r[:3], None]),
}  # fmt: skip


def _run_vector(wrap: Callable[[VecEnv], VecEnv], parts: bool, n: int, where: str) -> None:
    inner = [KnownActs(parts) for _ in range(n)]
    how = SubprocVecEnv if where == "subproc" else DummyVecEnv
    kwargs = {"start_method": "fork"} if where == "subproc" else {}
    recorder = VecRecorder(wrap(how([lambda env=env: env for env in inner], **kwargs)))
    venv: VecEnv = (
        VecNormalize(recorder, norm_reward=where != "observations") if where in ("normal", "observations") else recorder
    )
    model = train(venv)
    for k in range(n):
        check_log(model, recorder.log[k::n], [] if where == "subproc" else inner[k].received, k)


def _run_outside(wrap: Callable[[VecEnv], VecEnv]) -> None:
    inside = VecRecorder(DummyVecEnv([KnownActs]))
    outside = VecRecorder(wrap(VecNormalize(inside, norm_obs=False)))
    model = train(outside)
    check_log(model, [(*a[:4], *b[4:]) for a, b in zip(inside.log, outside.log, strict=True)])


class ParallelRecorder(BaseParallelWrapper):
    """The same for PettingZoo environments."""

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.log: list[tuple] = []

    def reset(self, seed=None, options=None):
        returned = self.env.reset(seed=seed, options=options)
        self.obs = deepcopy(returned[0])
        return returned

    def step(self, actions):
        returned = self.env.step(actions)
        self.log.append((self.obs, deepcopy(actions), *deepcopy(returned)))
        self.obs = deepcopy(returned[0])
        return returned


PETTINGZOO: dict[str, Callable[[Any], Any]] = {
    "nothing": lambda env: env,
    "BaseParallelWrapper": BaseParallelWrapper,
    "reward_lambda_v0": lambda env: supersuit.reward_lambda_v0(env, lambda r: r / 2),
    "clip_reward_v0": lambda env: supersuit.clip_reward_v0(env, -1, 1),
    "normalize_obs_v0": lambda env: supersuit.normalize_obs_v0(env, -1, 1),
    "frame_skip_v0": lambda env: supersuit.frame_skip_v0(env, 2),
    "frame_skip_v0 of 1": lambda env: supersuit.frame_skip_v0(env, 1),
    "frame_stack_v2": lambda env: supersuit.frame_stack_v2(env, 3),
    "frame_stack_v1": lambda env: supersuit.frame_stack_v1(env, 2),
    "dtype_v0": lambda env: supersuit.dtype_v0(env, np.float16),
    "dtype_v0 uint8": lambda env: supersuit.dtype_v0(env, np.uint8),
    "flatten_v0": supersuit.flatten_v0,
    "reshape_v0": lambda env: supersuit.reshape_v0(env, (3, 1)),
    "pad_observations_v0": supersuit.pad_observations_v0,
    "pad_action_space_v0": supersuit.pad_action_space_v0,
    "black_death_v3": supersuit.black_death_v3,
    "sticky_actions_v0": lambda env: supersuit.sticky_actions_v0(env, 0.5),
    "delay_observations_v0": lambda env: supersuit.delay_observations_v0(env, 1),
    "agent_indicator_v0": supersuit.agent_indicator_v0,
    "max_observation_v0": lambda env: supersuit.max_observation_v0(env, 2),
    "nan_zeros_v0": supersuit.nan_zeros_v0,
    "nan_noop_v0": supersuit.nan_noop_v0,
    "scale_actions_v0": lambda env: supersuit.scale_actions_v0(env, 0.5),
    "clip_actions_v0": supersuit.clip_actions_v0,
    "observation_lambda_v0": lambda env: supersuit.observation_lambda_v0(env, lambda o, s: o * 2, lambda s: s),
    "action_lambda_v1": lambda env: supersuit.action_lambda_v1(env, lambda a, s: a, lambda s: s),
    "MultiEpisodeParallelEnv": lambda env: pettingzoo_wrappers.MultiEpisodeParallelEnv(env, 2),
    "black death below": lambda env: BaseParallelWrapper(supersuit.black_death_v3(env)),
    "padded and flat": lambda env: supersuit.flatten_v0(supersuit.pad_observations_v0(env)),
    "clipped and skipped": lambda env: supersuit.clip_reward_v0(supersuit.frame_skip_v0(env, 2)),
}  # fmt: skip


class _Acts(KnownParallel):
    def __init__(self):
        super().__init__(Giver("", lambda value: value))
        self.received = []


def _run_pettingzoo(make: Callable[[], Any], wrap: Callable[[Any], Any]) -> None:
    try:
        env = ParallelRecorder(wrap(make()))
        env.reset(seed=0)
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    except Exception:  # without us
        return
    env.log.clear()
    model = train(env)
    kept = model.replay_buffer
    for k, (obs, actions, after, rewards, terminated, truncated, _) in zip(range(kept.size()), env.log, strict=False):
        for place, agent in enumerate(NAMES):
            acts = agent in actions
            if bool(kept.agent_active[k, 0, place]) != acts:
                raise Silent(f"{agent} is active in transition {k}: {not acts}")
            if not acts:
                continue
            here, there = (np.ravel(one[agent]) for one in (obs, after))
            for name, found, right in (
                ("observation", kept.observations[k, 0, place, : len(here)], here),
                ("next observation", kept.next_observations[k, 0, place, : len(there)], there),
                ("reward", kept.agent_rewards[k, 0, place], rewards[agent]),
                ("termination", kept.agent_terminated[k, 0, place], terminated[agent]),
            ):
                if not np.allclose(found, right, atol=1e-5):
                    raise Silent(f"{name} {k} of {agent} is {np.asarray(found).tolist()}, not {right}")
        over = all(terminated[a] or truncated[a] for a in actions)
        if kept.dones[k, 0] != over:
            raise Silent(f"done {k} is {kept.dones[k, 0]}, not {over}")


def wrapped(rng: random.Random) -> Iterator[Case]:
    """:return: trainings in wrapped environments"""
    makers = {
        "team": KnownActs,
        "team without parts": lambda: KnownActs(False),
        "continuous team": lambda: KnownActs(True, BOX),
        "PettingZoo": lambda: TeamEnv(DifferentActs()),
    }
    for name, wrap in GYMNASIUM.items():
        for what, make in makers.items():
            yield Case(f"{name} of {what}", lambda make=make, wrap=wrap: _run(make, wrap))
        yield Case(f"{name} in DummyVecEnv", lambda wrap=wrap: _run(KnownActs, wrap, "vector"))
    for name, wrap in VECTOR.items():
        for parts in (True, False):
            for n, where in ((1, "dummy"), (2, "dummy"), (1, "normal"), (1, "observations"), (2, "subproc")):
                if where != "subproc" or rng.random() < 0.5:
                    yield Case(
                        f"vector: {name} of {n} ({where}, parts {parts})",
                        lambda wrap=wrap, parts=parts, n=n, where=where: _run_vector(wrap, parts, n, where),
                    )
        yield Case(f"vector: {name} outside of VecNormalize", lambda wrap=wrap: _run_outside(wrap))
    for name, wrap in PETTINGZOO.items():
        for make in (_Acts, DifferentActs):
            yield Case(f"{make.__name__}: {name}", lambda make=make, wrap=wrap: _run_pettingzoo(make, wrap))
