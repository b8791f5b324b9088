"""
A team whose transitions are known beforehand, in environments that reuse, cast or poison what they return.

The numbers follow from those of episode and step, whatever the agents do, and are integers, so that no cast rounds them.
"""

# ruff: noqa: E501, C901 - long tables and lists of cases

import random
import traceback
from collections.abc import Callable, Iterator
from decimal import Decimal
from fractions import Fraction
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch as th
from cases import Case, Silent, Theirs
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from pettingzoo import ParallelEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_maddpg import MADDPG
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from toys import SMALL

LENGTH = 5  # of an episode
STEPS = 28
OTHERS = 10  # episodes by which another environment is ahead
TRAINED: dict[str, Any] = {**SMALL, "learning_starts": 12, "batch_size": 8, "buffer_size": 400}
NAMES = ("ann", "bob")


def last_steps(episode: int) -> tuple[int, int]:
    """:return: the steps in which the two agents end: in every third episode one terminates, in the next is truncated"""
    return ((3, LENGTH), (LENGTH, 2), (LENGTH, LENGTH))[episode % 3]


def seen(episode: int, step: int) -> np.ndarray:
    """:return: the observation, (2, 3), with zeros for agents that are gone"""
    here = np.array(last_steps(episode)) >= step
    return (np.add.outer([0, 2], np.arange(3)) + 7 * episode + 3 * step + 1) % 50 * here[:, None]


class Row(NamedTuple):
    """What the replay buffer must hold of a transition."""

    observations: Any
    next_observations: Any
    rewards: Any
    agent_rewards: Any
    agent_terminated: Any
    agent_active: Any
    dones: Any
    timeouts: Any


def row(episode: int, step: int) -> Row:
    """:return: the transition of a step, which is counted from 1"""
    ends = np.array(last_steps(episode))
    acts, over = ends >= step, step == LENGTH
    terminated, cut = (ends == step) & (episode % 3 != 1), (ends == step) & (episode % 3 == 1)
    rewards = (2 * ((episode + step + np.arange(2)) % 5) - 4) * acts  # even, so that their mean is an integer
    return Row(
        seen(episode, step - 1),
        seen(episode, step),
        rewards.mean(),
        rewards,
        terminated,
        np.where(cut & (not over), 2, acts),
        over,
        over and bool(cut.any()),
    )


def expected(first: int, steps: int) -> list[Row]:
    """:return: the transitions from the beginning of an episode on"""
    return [row(first + k // LENGTH, k % LENGTH + 1) for k in range(steps)]


SLOTS = ("obs", "reward", "terminated", "truncated", "agent_rewards", "agent_terminated", "agent_truncated", "agent_active",
         "team_reward", "episode_step", "metrics", "is_success")  # fmt: skip
OF_AGENTS = SLOTS[4:8]


class Giver:
    """
    Hands out what an environment returns, spoilt in one place.

    :param slot: what is spoilt
    :param spoil: returns what is returned instead
    :param again: whether what was returned is overwritten in the next call: "own", or "shared" with other environments
    :param kept: what was returned, where it is shared
    """

    def __init__(self, slot: str, spoil: Callable[[Any], Any], again: str = "", kept: dict[str, Any] | None = None):
        self.slot, self.spoil, self.again = slot, spoil, again
        self.kept: dict[str, Any] = {} if kept is None else kept

    def poison(self) -> None:
        """Overwrite what was returned in the call before."""
        if self.again == "own":
            for value in self.kept.values():
                overwrite(value, None)
            self.kept.clear()

    def give(self, slot: str, value: Any, who: str = "") -> Any:
        if self.slot not in (slot, "all"):
            return value
        new = self.spoil(value)
        if not self.again or not isinstance(new, (dict, list, np.ndarray, th.Tensor)):
            return new
        if self.again == "shared" and slot + who in self.kept:
            overwrite(self.kept[slot + who], new)
            return self.kept[slot + who]
        self.kept[slot + who] = new
        return new


def overwrite(old: Any, new: Any) -> None:
    """Write into an array, list or dict that was returned before."""
    if isinstance(old, dict):
        old.clear()
        old.update({} if new is None else new)
    elif isinstance(old, list):
        for index, value in enumerate(old):
            if isinstance(value, list):
                overwrite(value, None if new is None else new[index])
            else:
                old[index] = 33 if new is None else new[index]
    elif isinstance(old, (np.ndarray, th.Tensor)):
        old[...] = (33 if getattr(old, "dtype", None) not in (bool, th.bool) else True) if new is None else new


class Known(gymnasium.Env):
    """
    The team as a Gymnasium environment.

    :param giver: spoils what it returns
    :param dtype: of the observation space
    :param first: number of the first episode
    :param parts: whether infos hold what belongs to single agents
    """

    action_space = spaces.MultiBinary(2)

    def __init__(self, giver: Giver, dtype: Any = np.float32, first: int = 0, parts: bool = True):
        self.observation_space = spaces.Box(0, 60, (2, 3), dtype)
        self.giver, self.episode, self.parts = giver, first - 1, parts

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.giver.poison()
        self.episode += 1
        self.time = 0
        return self.giver.give("obs", self._seen()), {}

    def _seen(self):
        return seen(self.episode, self.time).astype(self.observation_space.dtype)

    def step(self, action):
        self.giver.poison()
        self.time += 1
        now = row(self.episode, self.time)
        ends = np.array(last_steps(self.episode)) == self.time
        info = {
            "agent_rewards": now.agent_rewards.astype(np.float32), "agent_terminated": now.agent_terminated,
            "agent_truncated": ends & ~now.agent_terminated, "agent_active": now.agent_active > 0,
            "team_reward": float(now.rewards), "episode_step": self.time, "metrics": {"env/x": float(self.time)},
        }  # fmt: skip
        if now.dones:
            info["is_success"] = self.episode % 2 == 0
        info = {name: self.giver.give(name, value) for name, value in info.items()} if self.parts else {}
        give = self.giver.give
        ends_by_itself, cut = bool(now.dones and not now.timeouts), bool(now.timeouts)
        return (
            give("obs", self._seen()),
            give("reward", float(now.rewards)),
            give("terminated", ends_by_itself),
            give("truncated", cut),
            give("info", info),
        )


class KnownParallel(ParallelEnv):
    """
    The same team as a PettingZoo environment.

    :param giver: spoils what it returns for the second agent
    :param dtype: of the observation spaces
    """

    metadata = {"name": "known", "render_modes": []}  # noqa: RUF012

    def __init__(self, giver: Giver, dtype: Any = np.float32, first: int = 0):
        self.possible_agents = list(NAMES)
        self.space, self.giver, self.episode = spaces.Box(0, 60, (3,), dtype), giver, first - 1

    def observation_space(self, agent):
        return self.space

    def action_space(self, agent):
        return spaces.MultiBinary(1)

    def _seen(self, agents):
        found = seen(self.episode, self.time).astype(self.space.dtype)
        return {a: self._of(a, "obs", found[NAMES.index(a)]) for a in agents}

    def _of(self, agent, slot, value):
        return self.giver.give(slot, value, agent) if agent == "bob" or self.giver.again else value

    def reset(self, seed=None, options=None):
        self.giver.poison()
        self.episode += 1
        self.time, self.agents = 0, list(NAMES)
        return self.giver.give("dict", self._seen(NAMES)), {agent: {} for agent in NAMES}

    def step(self, actions):
        self.giver.poison()
        self.time += 1
        now, acted = row(self.episode, self.time), list(self.agents)
        ends = np.array(last_steps(self.episode)) == self.time
        of = {agent: k for k, agent in enumerate(NAMES) if agent in acted}
        infos = {
            a: {"metrics": self._of(a, "metrics", {"env/x": float(self.time)})}
            | ({"is_success": self._of(a, "is_success", self.episode % 2 == 0)} if ends[k] else {})
            for a, k in of.items()
        }
        parts = (
            self._seen(acted),
            {a: self._of(a, "reward", float(now.agent_rewards[k])) for a, k in of.items()},
            {a: self._of(a, "terminated", bool(now.agent_terminated[k])) for a, k in of.items()},
            {a: self._of(a, "truncated", bool(ends[k] and not now.agent_terminated[k])) for a, k in of.items()},
            infos,
        )
        self.agents = [agent for agent in acted if not ends[of[agent]]]
        return tuple(self.giver.give("dict", part, str(k)) for k, part in enumerate(parts))


class Spoil(NamedTuple):
    """A way to return something else, and what it means: the same numbers, or nothing, so that it must be refused."""

    name: str
    change: Callable[[Any], Any]
    means: bool = True


def _objects(kind: Callable[[int], Any]) -> Callable[[Any], Any]:
    def convert(array: Any) -> Any:
        whole = np.empty(np.shape(array), object)
        whole[...] = np.vectorize(lambda one: kind(int(one)), otypes=[object])(array)
        return whole

    return convert


def _part(array: Any, index: int, value: Any) -> np.ndarray:
    changed = np.array(array, object if isinstance(value, (complex, str)) or value is None else float)
    changed.flat[index] = value
    return changed.astype(complex) if isinstance(value, complex) else changed


def _read_only(array: Any) -> np.ndarray:
    fixed = np.array(array)
    fixed.flags.writeable = False
    return fixed


class Reluctant:
    """Numbers that become an array only when asked."""

    def __init__(self, array: Any):
        self.array = np.array(array)

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return self.array.astype(dtype or self.array.dtype)


ARRAYS = (
    *(Spoil(name, lambda a, name=name: np.asarray(a).astype(name)) for name in
      ("float64", "float16", "longdouble", "int8", "int64", "uint8", ">f8", ">i2", "complex64")),
    Spoil("read-only", _read_only),
    Spoil("negative strides", lambda a: np.array(a)[::-1].copy()[::-1]),
    Spoil("every other column", lambda a: np.repeat(a, 2, axis=-1)[..., ::2]),
    Spoil("Fortran order", lambda a: np.asfortranarray(a)),
    Spoil("masked array", lambda a: np.ma.array(a)),
    Spoil("torch", lambda a: th.as_tensor(np.array(a))),
    Spoil("torch with gradient", lambda a: th.as_tensor(np.array(a, np.float32)).requires_grad_()),
    Spoil("torch half", lambda a: th.as_tensor(np.array(a, np.float32)).half()),
    Spoil("torch bfloat16", lambda a: th.as_tensor(np.array(a, np.float32)).bfloat16()),
    Spoil("list", lambda a: np.asarray(a).tolist()),
    Spoil("tuple of arrays", lambda a: tuple(np.asarray(a))),
    Spoil("object array", _objects(int)),
    Spoil("fractions", _objects(Fraction)),
    Spoil("decimals", _objects(Decimal)),
    Spoil("its own array class", Reluctant),
    Spoil("recarray", lambda a: np.array(a).view(np.recarray)),
    Spoil("nan", lambda a: _part(a, 0, np.nan), False),
    Spoil("inf in the last place", lambda a: _part(a, -1, np.inf), False),
    Spoil("2**70", lambda a: _part(a, 1, 2.0**70), False),
    Spoil("1e39", lambda a: _part(a, 1, 1e39), False),
    Spoil("an imaginary part", lambda a: _part(a, 0, 1 + 2j), False),
    Spoil("a masked entry", lambda a: np.ma.array(a, mask=np.arange(np.size(a)).reshape(np.shape(a)) == 0), False),
    Spoil("None inside", lambda a: _part(a, 0, None), False),
    Spoil("a word inside", lambda a: _part(a, 0, "x"), False),
    Spoil("None", lambda a: None, False),
    Spoil("a number", lambda a: 1.0, False),
    Spoil("a dict", lambda a: {"x": a}, False),
    Spoil("empty", lambda a: np.asarray(a)[:0], False),
    Spoil("one entry less", lambda a: np.asarray(a)[..., :-1], False),
    Spoil("one more axis", lambda a: np.asarray(a)[None], False),
    Spoil("one more axis behind", lambda a: np.asarray(a)[..., None], False),
    Spoil("twice", lambda a: np.concatenate([a, a]), False),
    Spoil("ragged", lambda a: [[1.0], [1.0, 2.0]], False),
    Spoil("dates", lambda a: np.asarray(a).astype("datetime64[s]"), False),
)  # fmt: skip
BITS = (
    Spoil("halves", lambda a: np.asarray(a) * 0.5 + 0.5, False),
    Spoil("twos", lambda a: np.asarray(a) * 2.0 + 2.0, False),
    Spoil("minus", lambda a: np.asarray(a) * 1.0 - 1.0, False),
    Spoil("words", lambda a: [str(one) for one in np.ravel(a)], False),
)
NUMBERS = (
    Spoil("int", int), Spoil("np.int8", np.int8), Spoil("np.float16", np.float16), Spoil("np.float64", np.float64),
    Spoil("np.longdouble", np.longdouble), Spoil("0-d array", np.array), Spoil("0-d float32", np.float32),
    Spoil("size-1 array", lambda r: np.array([r])), Spoil("(1, 1)", lambda r: np.array([[r]])),
    Spoil("list of one", lambda r: [r]), Spoil("torch", th.tensor), Spoil("torch of one", lambda r: th.tensor([r])),
    Spoil("torch with gradient", lambda r: th.tensor(float(r)).requires_grad_()),
    Spoil("Fraction", lambda r: Fraction(int(r))), Spoil("Decimal", lambda r: Decimal(int(r))),
Spoil("masked scalar", lambda r: np.ma.array(r)),
    Spoil("read-only", _read_only), Spoil("0-d object", lambda r: np.array(r, object)),
    Spoil("nan", lambda r: np.nan, False), Spoil("-inf", lambda r: -np.inf, False), Spoil("1e39", lambda r: 1e39, False),
    Spoil("10**400", lambda r: 10**400, False), Spoil("None", lambda r: None, False), Spoil("text", lambda r: "x", False),
    Spoil("an imaginary part", lambda r: r + 2j, False), Spoil("masked", lambda r: np.ma.masked, False),
    Spoil("one for each agent", lambda r: np.array([r, r]), False), Spoil("empty", lambda r: np.array([]), False),
    Spoil("a dict", lambda r: {"x": r}, False), Spoil("an object", lambda r: object(), False),
)  # fmt: skip
FLAGS = (
    Spoil("np.bool_", np.bool_), Spoil("int", int), Spoil("float", float), Spoil("0-d array", np.array),
    Spoil("size-1 array", lambda b: np.array([b])), Spoil("torch", th.tensor), Spoil("np.int64", np.int64),
    Spoil("torch of one", lambda b: th.tensor([b])), Spoil("read-only", _read_only),
    Spoil("text", str, False), Spoil("nan", lambda b: np.nan, False), Spoil("two", lambda b: 2, False),
    Spoil("a half", lambda b: 0.5, False), Spoil("one for each agent", lambda b: np.array([b, b]), False),
    Spoil("None", lambda b: None, False), Spoil("empty", lambda b: np.array([]), False),
    Spoil("a dict", lambda b: {"x": b}, False), Spoil("an object", lambda b: object(), False),
)  # fmt: skip
METRICS = (
    Spoil("numpy", lambda m: {k: np.float32(v) for k, v in m.items()}),
    Spoil("arrays of one", lambda m: {k: np.array([v]) for k, v in m.items()}),
    Spoil("torch", lambda m: {k: th.tensor(v) for k, v in m.items()}),
    Spoil("0-d arrays", lambda m: {k: np.array(v) for k, v in m.items()}),
    Spoil("empty", lambda m: {}),
    Spoil("two numbers", lambda m: {k: [v, v] for k, v in m.items()}, False),
    Spoil("nested", lambda m: {"x": m}, False),
    Spoil("text", lambda m: dict.fromkeys(m, "x"), False),
    Spoil("nan", lambda m: dict.fromkeys(m, np.nan), False),
    Spoil("a list", list, False),
    Spoil("a number", lambda m: 1.0, False),
    Spoil("names that are numbers", lambda m: dict(enumerate(m.values()))),
)
TABLES = {
    **dict.fromkeys(("obs", "agent_rewards"), ARRAYS),
    **dict.fromkeys(("agent_terminated", "agent_truncated", "agent_active"), (*ARRAYS, *BITS)),
    **dict.fromkeys(("reward", "team_reward", "episode_step"), NUMBERS),
    **dict.fromkeys(("terminated", "truncated", "is_success"), FLAGS),
    "metrics": METRICS,
}


def _same_step(envs: list[Callable[[], gymnasium.Env]], how: Any, **kwargs: Any) -> VecEnv:
    return GymnasiumVecEnv(how(envs, autoreset_mode=AutoresetMode.SAME_STEP, **kwargs))


CARRIERS: dict[str, Callable[[list[Callable[[], gymnasium.Env]]], VecEnv]] = {
    "DummyVecEnv": lambda envs: DummyVecEnv([lambda env=env: Monitor(env()) for env in envs]),
    "SubprocVecEnv": lambda envs: SubprocVecEnv(envs, start_method="fork"),
    "SyncVectorEnv": lambda envs: _same_step(envs, SyncVectorEnv),
    "SyncVectorEnv(copy=False)": lambda envs: _same_step(envs, SyncVectorEnv, copy=False),
    "AsyncVectorEnv": lambda envs: _same_step(envs, AsyncVectorEnv, context="fork"),
}

APART = ("SubprocVecEnv", "AsyncVectorEnv")  # in other processes, of which only what arrives is known


def check_stored(model: MADDPG, refused: bool = False, firsts: tuple[int, ...] = (0,)) -> None:
    """
    :param model: a model after training in known environments
    :param refused: whether what they returned means nothing
    :param firsts: first episode of each
    :raises Silent: if the replay buffer holds anything else than the known transitions
    """
    if refused:
        raise Silent("was taken for something")
    kept, count = model.replay_buffer, model.replay_buffer.size()
    if count < STEPS // len(firsts):
        raise Silent(f"only {count} transitions are stored")
    for env, first in enumerate(firsts):
        for index, right in enumerate(expected(first, count)):
            for name, value in right._asdict().items():
                found = getattr(kept, name)[index, env]
                if not np.array_equal(found, np.asarray(value, float)):
                    raise Silent(f"{name}[{index}] of environment {env} is {found.tolist()}, not {value}")


def train(env: Any) -> MADDPG:
    return MADDPG("MlpPolicy", env, **TRAINED).learn(STEPS, log_interval=1)


def returns(rng: random.Random) -> Iterator[Case]:
    """:return: trainings in environments that return something else than they should, or write into it later"""

    def gymnasium_case(carrier: str, n: int, slot: str, spoil: Spoil, again: str, dtype: Any = np.float32) -> Case:
        def run() -> None:
            kept: dict[str, Any] = {}
            makers = [
                lambda k=k: Known(
                    Giver(slot, spoil.change, again, kept if again == "shared" else None), dtype, OTHERS * k
                )
                for k in range(n)
            ]
            # What the environment really did is known in this process
            refused = not spoil.means and (slot not in ("team_reward", "episode_step") or carrier in APART)
            refused &= (slot, spoil.name) not in (("is_success", "None"), ("episode_step", "1e39"))
            if slot == "obs" and spoil.name in ("2**70", "1e39") and dtype is np.float64:
                refused = False
            try:
                model = train(CARRIERS[carrier](makers))
            except Exception as error:
                *_, last = traceback.walk_tb(error.__traceback__)
                if carrier in APART and "sb3_maddpg" not in last[0].f_code.co_filename:
                    raise Theirs(str(error)) from error  # their process, or the library between, cannot take it
                raise
            if carrier == "AsyncVectorEnv" and (
                slot in ("terminated", "truncated") or spoil.name in ("a masked entry", "dates")
            ):
                return  # Gymnasium has cast it before
            check_stored(model, refused, tuple(OTHERS * k for k in range(n)))

        return Case(f"{carrier} of {n}, {np.dtype(dtype)}: {slot} {spoil.name}{f', {again} again' * bool(again)}", run)

    def pettingzoo_case(slot: str, spoil: Spoil, again: str, dtype: Any = np.float32) -> Case:
        def run() -> None:
            refused = not spoil.means and (slot, spoil.name) != ("is_success", "None")
            check_stored(train(KnownParallel(Giver(slot, spoil.change, again), dtype)), refused)

        return Case(f"PettingZoo, {np.dtype(dtype)}: {slot} {spoil.name}{f', {again} again' * bool(again)}", run)

    for slot, table in TABLES.items():
        for spoil in table:
            if (slot == "obs" and spoil.name == "2**70") or (slot == "agent_rewards" and spoil.name == "uint8"):
                continue  # a number of single precision, and none of negative rewards
            yield gymnasium_case("DummyVecEnv", 1, slot, spoil, "")
            more = [name for name in CARRIERS if name not in ("DummyVecEnv", "SyncVectorEnv(copy=False)")]
            yield gymnasium_case(rng.choice(more), 2, slot, spoil, "")
            if slot in ("obs", "reward", "terminated", "truncated", "metrics", "is_success"):
                yield pettingzoo_case(slot, spoil, "")
            if slot == "obs":
                for dtype in (np.uint8, np.int64):
                    if spoil.name not in ("1e39",):
                        yield gymnasium_case("DummyVecEnv", 2, slot, spoil, "", dtype)
                        yield pettingzoo_case(slot, spoil, "", dtype)
    for dtype in (np.uint8, np.int64):
        yield gymnasium_case("DummyVecEnv", 1, "obs", next(s for s in ARRAYS if s.name == "2**70"), "", dtype)
        yield pettingzoo_case("obs", next(s for s in ARRAYS if s.name == "2**70"), "", dtype)
    again = (
        Spoil("array", np.array), Spoil("list", lambda a: np.asarray(a).tolist()),
        Spoil("torch", lambda a: th.as_tensor(np.array(a))), Spoil("float64", lambda a: np.array(a, float)),
    )  # fmt: skip
    for slot in (*SLOTS, "info", "dict"):
        table = again
        if slot in ("info", "dict", "metrics"):
            table = (Spoil("dict", dict),)
        elif slot == "is_success":
            table = (Spoil("0-d array", np.array), Spoil("torch", th.tensor))
        for spoil in table:
            for carrier in CARRIERS if slot != "dict" else ():
                if slot in ("obs", *OF_AGENTS, "info", "metrics") or spoil.name not in ("list",):
                    # Other processes reset at once, so that only what is natural can be noticed
                    how = "shared" if carrier in APART else "own"
                    yield gymnasium_case(carrier, 1 if carrier == "DummyVecEnv" else 2, slot, spoil, how)
                    if carrier in ("DummyVecEnv", "SyncVectorEnv"):
                        yield gymnasium_case(carrier, 2, slot, spoil, "shared")
            if slot in ("obs", "reward", "terminated", "truncated", "metrics", "is_success", "dict"):
                yield pettingzoo_case(slot, spoil, "own")
                yield pettingzoo_case(slot, spoil, "shared")
    yield gymnasium_case("DummyVecEnv", 1, "all", Spoil("object", lambda value: value), "own")
