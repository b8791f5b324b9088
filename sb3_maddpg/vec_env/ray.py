"""Vectorised environment in the processes of a Ray cluster, for environments that are slow to step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import Wrapper
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError, NoStateError
from sb3_maddpg.vec_env.border import at_border
from sb3_maddpg.vec_env.ray_cluster import connect
from sb3_maddpg.vec_env.states import Replayable, load_vec_env_state, tells_state, vec_env_state

Call = tuple[str, tuple[Any, ...]]


class RayVecEnv(VecEnv):
    """
    Vectorised environment that consists of shards, each a process of a Ray cluster (https://docs.ray.io). It returns
    exactly what the same shards would return in this process, so training gives bit-identical results.

    If a process dies, a new one restores the last snapshot of its shard and repeats the calls since. Environments
    without ``state_dict`` are wrapped in ``Replayable``, which assumes that they are deterministic given the seed and
    the actions.

    Ray adds some milliseconds per step, so this pays off for slow environments only. Wrap it in ``VecMonitor`` for
    episode statistics.

    :param shards: functions that each create a vectorised environment, all with the same spaces
    :param snapshot_every: number of steps between snapshots
    :param address: address of a running cluster, ``auto`` or ``HOST:PORT``; None starts a cluster on this machine and
        stops it on ``close``
    :raises ValueError: if Ray is not installed, there is no such cluster, or there are no shards
    """

    def __init__(self, shards: Sequence[Callable[[], VecEnv]], snapshot_every: int = 100, address: str | None = None):
        if not shards or snapshot_every < 1:
            raise InvalidArgumentError(
                f"{len(shards)} shards and snapshot_every={snapshot_every}: both must be at least 1."
            )
        self._ray, self._begun = connect(address, len(shards))
        self._shards = [_Remote(self._ray, make) for make in shards]
        self.snapshot_every = snapshot_every
        described = self._all("describe")
        sizes = [size for size, *_ in described]
        self._ends = np.cumsum(sizes).tolist()
        observation_space, action_space = described[0][1:]
        if any(spaces[1:] != described[0][1:] for spaces in described):
            raise InvalidEnvironmentError("The shards have different spaces.")
        self._waiting: list[Any] = []
        self._steps = 0
        super().__init__(sum(sizes), observation_space, action_space)
        self.reset_infos = [{} for _ in range(self.num_envs)]

    @property
    def _parts(self) -> list[slice]:
        return [slice(begin, end) for begin, end in zip([0, *self._ends], self._ends, strict=False)]

    def _all(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of all shards in parallel, with the same arguments."""
        for shard in self._shards:
            shard.begin(method, *arguments)
        return [shard.result() for shard in self._shards]

    def reset(self) -> VecEnvObs:
        for shard, part in zip(self._shards, self._parts, strict=True):
            shard.begin("reset", self._seeds[part], self._options[part])
        results = [shard.result() for shard in self._shards]
        self.reset_infos = [info for _, infos in results for info in infos]
        self._reset_seeds()
        self._reset_options()
        return np.concatenate([obs for obs, _ in results])

    def step_async(self, actions: np.ndarray) -> None:
        for shard, part in zip(self._shards, self._parts, strict=True):
            shard.begin("step", np.asarray(actions[part]))

    def step_wait(self) -> VecEnvStepReturn:
        results = [shard.result() for shard in self._shards]
        self._steps += 1
        if self._steps % self.snapshot_every == 0:
            for shard in self._shards:
                shard.take_snapshot()
        observations, rewards, dones, infos, reset_infos = zip(*results, strict=True)
        self.reset_infos = [info for part in reset_infos for info in part]
        return (
            np.concatenate(observations),
            np.concatenate(rewards),
            np.concatenate(dones),
            [info for part in infos for info in part],
        )

    def close(self) -> None:
        for shard in self._shards:
            shard.end()
        self._shards = []
        if self._begun and self._ray.is_initialized():
            self._ray.shutdown()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """:return: the attribute of each of the given environments"""
        return self._at("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the given environments."""
        self._at("set_attr", indices, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices: VecEnvIndices = None, **method_kwargs) -> list[Any]:
        """Call a method of the given environments and return the results."""
        return self._at("env_method", indices, method_name, method_args, method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """:return: whether each of the given environments has the wrapper"""
        return self._at("env_is_wrapped", indices, wrapper_class)

    def _at(self, method: str, indices: VecEnvIndices, *arguments: Any) -> list[Any]:
        """Call a method for the given environments in the shards that hold them."""
        wanted = list(self._get_indices(indices))
        found: dict[int, Any] = {}
        for shard, part in zip(self._shards, self._parts, strict=True):
            own = [index for index in wanted if part.start <= index < part.stop]
            if own:
                shard.begin(method, [index - part.start for index in own], *arguments)
                found |= dict(zip(own, shard.result() or [None] * len(own), strict=True))
        return [found[index] for index in wanted]


class _Remote:
    """Handle of a shard: its Ray actor, its last snapshot, and the calls since."""

    def __init__(self, ray: Any, make: Callable[[], VecEnv]):
        self._ray, self._make = ray, make
        self._snapshot: dict[str, Any] | None = None
        self._done: list[Call] = []
        self._present: Call | None = None
        self._reference: Any = None
        self._actor = self._hire()

    def _hire(self) -> Any:
        actor = self._ray.remote(_Shard).options(num_cpus=1, max_restarts=0)
        return actor.remote(self._make, self._snapshot, self._done)

    def begin(self, method: str, *arguments: Any) -> None:
        """Call a method of the shard without waiting for its result, see ``result``."""
        self._present = (method, arguments)
        self._reference = self._actor.call.remote(method, arguments)

    def result(self) -> Any:
        """:return: the result of the call that ``begin`` started, from a new process if the old one died"""
        assert self._present is not None
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                result = self._ray.get(self._reference)
                break
            except self._ray.exceptions.RayTaskError as error:
                raise error.cause from error  # the environment's own exception
            except self._ray.exceptions.RayActorError as error:
                if attempt == _ATTEMPTS:
                    reason = str(error).strip().splitlines()[-1]
                    raise InvalidEnvironmentError(
                        f"{attempt} processes died during {self._present[0]}() of a shard: {reason}"
                    ) from error
                self._ray.kill(self._actor)  # it may only be unreachable
                self._actor = self._hire()
                self.begin(self._present[0], *self._present[1])
        if self._present[0] in _CHANGES:
            self._done.append(self._present)
        return result

    def take_snapshot(self) -> None:
        """Take a snapshot, from which a new process can continue."""
        self.begin("state")
        self._snapshot, self._done = self.result(), []

    def end(self) -> None:
        """Stop the process."""
        self._ray.kill(self._actor)


_ATTEMPTS = 4  # attempts at a call before the environment itself is assumed to be at fault
# Calls that a new process must repeat
_CHANGES = ("reset", "step", "set_attr", "env_method")


class _Shard:
    """
    Ray actor that holds a vectorised environment.

    :param make: creates the environment
    :param snapshot: state to restore, None for a new environment
    :param done: calls to repeat after that
    """

    def __init__(self, make: Callable[[], VecEnv], snapshot: dict[str, Any] | None, done: Sequence[Call]):
        self.env = make()
        inner = self.env.unwrapped
        if isinstance(inner, DummyVecEnv):
            inner.envs = [at_border(one if tells_state(one) else Replayable(one)) for one in inner.envs]
        if snapshot is not None:
            load_vec_env_state(self.env, deepcopy(snapshot))  # Ray's arrays are read-only
        for call in done:
            self.call(*call)

    def call(self, method: str, arguments: tuple[Any, ...]) -> Any:
        return getattr(self, f"_{method}")(*arguments)

    def _describe(self) -> tuple[Any, ...]:
        return self.env.num_envs, self.env.observation_space, self.env.action_space

    def _reset(self, seeds: list[int | None], options: list[dict[str, Any]]) -> tuple[Any, list[dict[str, Any]]]:
        self.env._seeds, self.env._options = list(seeds), list(options)
        return self.env.reset(), self.env.reset_infos

    def _step(self, actions: np.ndarray) -> tuple[Any, ...]:
        observations, rewards, dones, infos = self.env.step(np.array(actions))  # Ray's arrays are read-only
        return np.array(observations), np.array(rewards), np.array(dones), infos, self.env.reset_infos

    def _state(self) -> dict[str, Any]:
        try:
            return vec_env_state(self.env)
        except NoStateError as error:
            raise InvalidEnvironmentError(f"A shard could not be restored if its process died: {error}") from error

    def _get_attr(self, indices: list[int], name: str) -> list[Any]:
        return self.env.get_attr(name, self._given(indices))

    def _set_attr(self, indices: list[int], name: str, value: Any) -> None:
        self.env.set_attr(name, value, self._given(indices))

    def _env_method(self, indices: list[int], name: str, arguments: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        return self.env.env_method(name, *arguments, indices=self._given(indices), **kwargs)

    def _env_is_wrapped(self, indices: list[int], wrapper_class: type[Wrapper]) -> list[bool]:
        return self.env.env_is_wrapped(wrapper_class, self._given(indices))

    def _given(self, indices: list[int]) -> list[int] | None:
        """:return: None for all environments, since some vectorised environments accept nothing else"""
        return None if len(indices) == self.env.num_envs else indices
